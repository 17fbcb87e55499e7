"""The least model: its bound against the plate played twice, each option taken and refused, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import hapticrender as hr
from hapticrender import cli
from hapticrender.fidelity.choice import fidelity
from hapticrender.fidelity.plate import OPTIONS, bound
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.recordings.judge import LARGEST_INFLATION, fit, window_length

AMPLITUDE = 10e-6  # m


def temporal(finger, *frequencies, amplitude=AMPLITUDE, **more):
    partials = tuple((f / frequencies[0], 1.0, 0.3 * f) for f in frequencies)
    texture = hr.Grating(amplitude=amplitude, frequency=frequencies[0], partials=partials)
    return hr.Scene(texture=texture, finger=finger, duration=4.0, **more)


def spatial(finger, wavelength=1e-3):
    return hr.Scene(texture=hr.Grating(amplitude=AMPLITUDE, wavelength=wavelength), finger=finger, duration=4.0)


def reduced(scene, *names):
    """The scene with these options, "finger order 0" and the like, taken."""
    for name in names:
        (option,) = [each for each in OPTIONS if f"{each.name} {each.value}" == name]
        scene = option.reduced(scene)
        assert isinstance(scene, hr.Scene)
    return scene


def faded(frequency, bands, rate):
    """Share of each target that is asked for at a carrier's frequency (Hz), by the band model's account."""
    size, highest = abs(frequency), min(1000.0, 0.4 * rate)
    ramp = np.clip(size / 10.0 - 1.0, 0.0, 1.0), np.clip(5.0 - 4.0 * size / highest, 0.0, 1.0)
    return np.where(bands.wavenumber > 0.0, np.prod([x**2 * (3 - 2 * x) for x in ramp], axis=0), 1.0)


def drive_of(scene, bands, time):
    """Current (A, (n, coils)) that makes the target on the rigid model of `scene`, were the finger at rest.

    It is held over a sample, so it is what is needed in the sample's middle, made larger by what the hold takes.
    """
    plate = PlateParameters.with_overrides(scene.plant)
    at, _, grip = scene.finger.touch(time).T
    at = np.nan_to_num(at)
    rate = 1 / (time[1] - time[0])
    time = time + 0.5 / rate
    position = scene.finger.position(time)
    carriers = bands.instantaneous_frequency(np.gradient(np.nan_to_num(position), time))
    force, phase = np.zeros((len(time), 2)), bands.carrier_phase(time, position)
    lever = np.stack([np.ones_like(at), at / plate.half_spacing], axis=1)
    for k, frequency in enumerate(carriers.T):
        size = np.maximum(abs(frequency), 1e-3)
        known, back = np.unique(size.round(9), return_inverse=True)
        stiffness = plate.dynamic_stiffness(known)[back]
        if plate.finger_dynamics:
            felt = (2j * np.pi * known * scene.finger.mechanics.impedance(known))[back] * grip
            stiffness = stiffness + felt[:, None, None] * lever[:, :, None] * lever[:, None, :]
        stiffness = np.where(frequency[:, None, None] < 0, stiffness.conj(), stiffness)
        needed = stiffness @ [1.0, scene.gradient * plate.half_spacing]
        if plate.degrees_of_freedom == 1:
            needed[:, 1] = 0.0
        elif plate.coils == 1:  # heave is 1 and no couple acts
            needed = np.stack([1.0 / np.linalg.inv(stiffness)[:, 0, 0], np.zeros(len(time))], axis=1)
        wanted = faded(carriers, bands, rate)[:, k] * bands.envelope[k] * np.exp(1j * phase[:, k])
        wanted = wanted / np.sinc(frequency / rate)
        force += (needed * wanted[:, None]).real
    return force @ np.linalg.pinv(plate.force_from_drive).T


def played(scene, drive):
    """True motion (m, (n, 3)) of the scene's plate under `drive`, which no electronics limit."""
    plate = replace(
        PlateParameters.with_overrides(scene.plant), current_limit=1e3, current_bits=0, sensor_noise=0.0, sensor_bits=0
    )
    return Plate(plate, scene.finger).run(drive).motion


def true_error(scene, lesser):
    """Largest envelope of the difference of both plates in any of the judge's windows, relative to its target."""
    plate = PlateParameters.with_overrides(scene.plant)
    rate = plate.rate
    time = np.arange(int(scene.duration * rate)) / rate
    position, bands = scene.finger.position(time), scene.texture.bands(rate)
    drive = drive_of(lesser, bands, time)
    apart = played(scene, drive) - played(lesser, drive)
    first = int(scene.settle * rate)
    frequency = bands.instantaneous_frequency(np.gradient(np.nan_to_num(position), time))
    phase, weight = bands.carrier_phase(time, position), faded(frequency, bands, rate)
    wanted = (weight * bands.envelope * np.exp(1j * phase)).real.sum(axis=1)
    size = round(window_length(bands, rate, position[first:], (scene.duration - scene.settle) / 2) * rate)
    size += size % 2  # so the judge counts
    signals = np.column_stack([apart, wanted])

    def windows(start):
        index = start[:, None] + np.arange(size)
        envelope, inflation, _ = fit(phase[index], signals[index])
        quarters = [abs(part.mean(axis=1)) for part in np.array_split(frequency[index], 4, axis=1)]
        read = (np.min(quarters, axis=0) >= 20.0) & (weight[index].min(axis=1) > 0.0) & (inflation <= LARGEST_INFLATION)
        return np.where(read[:, None, :], abs(envelope), 0.0), read

    hop, last = max(1, size // 32), len(time) - size
    coarse = np.arange(first, last + 1, hop)
    size_of, read = windows(coarse)
    if not read.any():
        return 0.0
    target = np.sqrt((size_of[:, 3] ** 2).sum(axis=0) / np.maximum(read.sum(axis=0), 1))
    target = np.where(read.any(axis=0), np.maximum(target, scene.tolerance * target.max()), np.inf)
    grown = 1.0 + scene.gradient * plate.glass_length / 2 * np.array([0.0, -1.0, 1.0])
    found = (size_of[:, :3] / target / grown[:, None]).max(axis=(1, 2))
    worst = found.max()
    for best in coarse[np.argsort(found)[-4:]]:  # what turns faster than a hop is looked for where the error is large
        near = np.arange(max(first, best - hop), min(last, best + hop) + 1)
        near = near[:: max(1, len(near) // 40)]
        worst = max(worst, (windows(near)[0][:, :3] / target / grown[:, None]).max())
    return worst


LIGHT, HEAVY = {"mechanics": "light", "normal_load": 0.3}, {"mechanics": "heavy", "normal_load": 0.8}
STEADY = {"normal_load": ((0.0, 4.0), (0.6, 0.61))}
SCALED = {"mechanics": "heavy", "normal_load": ((0.0, 4.0), (0.3, 1.2)), "load_scaling": True}
FREE, RESTING, SLIDING = hr.Finger.absent(), hr.Finger.still(0.015, **HEAVY), hr.Finger.sliding(0.1, **HEAVY)
SWIPING = hr.Finger.swiping(frequency=1.0, stroke=0.04, **LIGHT)
BOUNDED = [
    (temporal(FREE, 20.0), "degrees of freedom 1"),
    (temporal(FREE, 147.0), "degrees of freedom 1"),
    (temporal(FREE, 400.0), "degrees of freedom 1"),
    (temporal(FREE, 170.0, plant={"bending_frequency": 1250.0}), "degrees of freedom 1"),
    (temporal(hr.Finger.still(0.015, **LIGHT), 72.0), "finger order 0"),
    (temporal(RESTING, 189.0), "finger order 0"),
    (temporal(RESTING, 143.0), "degrees of freedom 1"),
    (temporal(RESTING, 72.0, 400.0), "finger order 2"),
    (temporal(RESTING, 400.0, plant={"bending_frequency": 1250.0}), "finger order 0"),
    (temporal(hr.Finger.sliding(0.1, **LIGHT), 20.0), "finger order 0"),
    (temporal(SLIDING, 20.0), "finger static"),
    (temporal(SLIDING, 20.0), "finger order 2"),
    (temporal(SLIDING, 72.0), "degrees of freedom 1"),
    (temporal(SLIDING, 143.0), "finger static"),
    (temporal(SLIDING, 189.0), "finger order 0"),
    (temporal(SLIDING, 400.0), "finger order 2"),
    (temporal(SLIDING, 400.0), "finger static, finger order 0"),
    (temporal(SLIDING, 20.0, 60.0, 143.0, 261.0, 400.0), "finger order 2"),
    (temporal(SWIPING, 111.0), "finger static"),
    (temporal(hr.Finger.sliding(0.05, **SCALED), 143.0), "load scaling off"),
    (temporal(hr.Finger.still(0.01, **SCALED), 261.0), "load scaling off"),
    (spatial(hr.Finger.swiping(frequency=1.0, speed=0.1, **LIGHT)), "finger order 0"),
    (spatial(hr.Finger.swiping(frequency=1.0, speed=0.1, **HEAVY)), "degrees of freedom 1"),
    (spatial(hr.Finger.swiping(frequency=1.0, speed=0.1, **HEAVY)), "finger order 2"),
]


@pytest.mark.parametrize(("scene", "options"), BOUNDED)
def test_the_bound_is_never_below_the_true_error_and_at_most_half_as_much_above(scene, options):
    lesser = reduced(scene, *options.split(", "))
    found, true = bound(scene, lesser), true_error(scene, lesser)
    assert true > 2e-4  # four times what nothing is told below
    assert true <= found <= 1.5 * true


@pytest.mark.parametrize("frequency", [20.0, 72.0, 189.0, 400.0])
def test_an_error_too_small_to_tell_is_still_bounded(frequency):
    """One band, one place: a finger of order 2 can be exact there."""
    scene = temporal(RESTING, frequency)
    lesser = reduced(scene, "finger order 2")
    assert true_error(scene, lesser) <= bound(scene, lesser) < 2e-4


def test_heave_only_is_off_as_much_as_the_stiffness_matrix_says():
    """Free plate, both coils alike, D11 each: ends at twice the coils' distance."""
    stiffness = PlateParameters().dynamic_stiffness(np.array([111.0]))[0]
    heave, rocking = np.linalg.solve(stiffness, np.array([stiffness[0, 0], 0.0]))
    by_hand = max(abs(heave - 1.0 + 2 * rocking), abs(heave - 1.0 - 2 * rocking))
    scene = temporal(FREE, 111.0)
    # accuracy adds 5e-5, settling exp(-16) for every touch, the images of the hold (111/4900)^3 of it
    assert bound(scene, reduced(scene, "degrees of freedom 1")) == pytest.approx(by_hand, rel=1e-4, abs=6e-5)


@pytest.mark.parametrize(
    ("scene", "option", "taken"),
    [
        (temporal(FREE, 400.0), "degrees of freedom 1", True),
        (temporal(FREE, 147.0), "degrees of freedom 1", False),
        (temporal(hr.Finger.still(0.0, **LIGHT), 20.0), "finger order 0", True),
        (temporal(RESTING, 143.0), "finger order 0", False),
        (temporal(RESTING, 143.0), "finger order 2", True),
        (temporal(SLIDING, 20.0, 60.0, 143.0, 261.0, 400.0), "finger order 2", False),
        (temporal(hr.Finger.swiping(frequency=0.5, stroke=0.01, **LIGHT), 400.0), "finger static", True),
        (temporal(SLIDING, 143.0), "finger static", False),
        (temporal(hr.Finger.still(0.01, **(SCALED | STEADY)), 143.0), "load scaling off", True),
        (temporal(hr.Finger.still(0.01, **SCALED), 143.0), "load scaling off", False),
    ],
)
def test_an_option_is_taken_where_it_costs_little_and_refused_where_it_does_not(scene, option, taken):
    found = fidelity(scene)
    (choice,) = [each for each in found.choices if f"{each.option} {each.value}" == option]
    assert choice.taken is taken
    assert (choice.bound <= found.tolerance) is taken
    assert (choice in found.taken) is taken


def test_the_least_model_holds_all_that_was_taken_and_its_bound():
    finger = hr.Finger.swiping(frequency=0.5, stroke=0.005, **LIGHT)
    scene = temporal(finger, 400.0, tolerance=1.0)
    found = fidelity(scene)
    assert [f"{each.option} {each.value}" for each in found.taken] == [
        "finger static",
        "finger order 0",
        "degrees of freedom 1",
    ]
    assert found.plant == {"finger_dynamics": 0, "degrees_of_freedom": 1}
    assert abs(found.finger.motion.at) < 1e-6  # m: the middle of a symmetric path
    assert found.bound == bound(scene, found.least) <= found.tolerance == 0.1
    assert found.least == replace(scene, plant=found.plant, finger=found.finger)
    assert "\n  may be left out: rocking (degrees of freedom 1: off by at most " in found.text()
    assert "\n  left out: rocking" in found.text(used=True)


def test_the_tolerance_decides():
    scene = temporal(RESTING, 72.0)
    level = bound(scene, reduced(scene, "finger order 0"))
    assert fidelity(scene, 1.001 * level).plant["finger_dynamics"] == 0
    assert "finger_dynamics" not in fidelity(scene, 0.999 * level).plant
    assert fidelity(scene, 1e-9).least == scene
    assert fidelity(scene, 1e-9).bound == 0.0


@pytest.mark.parametrize(
    ("scene", "note"),
    [
        (temporal(hr.Finger.still(touches=[(0.7, 4.0)], **HEAVY), 72.0), "after its finger last came or went"),
        (temporal(hr.Finger.still(touches=[(0.0, 3.0)], **HEAVY), 72.0), "after its finger last came or went"),
        (temporal(FREE, 72.0, settle=0.1), "it is judged from 0.1 s on, less than 0.62"),
        (spatial(SLIDING), "changes its speed at once"),
        (hr.Scene(texture=hr.Synthetic(amplitude=1e-5, speed=0.1), finger=SLIDING, duration=4.0), "no constant envel"),
        (
            replace(temporal(hr.Finger.sampled([0.0, 0.01], times=[0.0, 90.0], **HEAVY), 72.0), duration=90.0),
            "path is longer than 60 s",
        ),
        (temporal(FREE, 4000.0), "it reaches 4000 Hz, more than half the rate of 5000 Hz"),
        (temporal(FREE, 72.0, plant={"damping_1": 0.0, "damping_2": 0.0}), "less than inf s after"),
        (replace(temporal(FREE, 72.0), device="other"), "other has no lesser ones"),
    ],
)
def test_where_no_tight_bound_is_known_the_full_model_stays_and_says_why(scene, note):
    found = fidelity(scene)
    assert (found.least, found.choices, found.bound) == (scene, (), 0.0)
    assert note in found.text()


def test_a_finger_that_came_in_time_is_bounded():
    scene = temporal(hr.Finger.still(0.015, touches=[(0.3, 5.0)], **HEAVY), 72.0)
    lesser = reduced(scene, "finger order 0")
    true = true_error(scene, lesser)
    assert true <= bound(scene, lesser) <= 1.5 * true


def test_a_long_scene_is_looked_at_only_where_it_has_to_be():
    """100 h, of which none but the last minute and what leads to it could be held in memory."""
    scene = replace(temporal(SLIDING, 20.0), duration=360_000.0, settle=100_000.0)
    known = bound(temporal(SLIDING, 20.0), reduced(temporal(SLIDING, 20.0), "finger order 2"))
    assert bound(scene, reduced(scene, "finger order 2")) == pytest.approx(known, rel=0.05)  # other windows, same path


def test_a_texture_over_position_keeps_its_finger_moving():
    found = fidelity(spatial(hr.Finger.swiping(frequency=1.0, speed=0.1, **LIGHT)))
    assert found.choices[0].bound is None
    assert found.choices[0].reason == "the texture is read at the finger's position"
    assert not found.choices[0].taken


@pytest.mark.parametrize(
    ("tolerance", "error", "match"),
    [
        (0.0, ValueError, "tolerance = 0.0: must be > 0 and <= 10"),
        (11, ValueError, "tolerance = 11: must be"),
        (float("nan"), ValueError, "tolerance = nan: must be"),
        ("1 %", TypeError, "tolerance = '1 %': must be a number"),
        (True, TypeError, "tolerance = True: must be a number"),
    ],
)
def test_bad_tolerances_are_refused(tolerance, error, match):
    with pytest.raises(error, match=match):
        fidelity(temporal(FREE, 72.0), tolerance)


def test_a_scene_that_the_plate_cannot_have_is_refused():
    with pytest.raises(ValueError, match=r"plant.mass = -1.0: must be > 0 kg"):
        fidelity(temporal(FREE, 72.0, plant={"mass": -1.0}))


def test_render_says_what_could_be_left_out_and_leaves_it_out_when_asked(tmp_path, capsys):
    scene = replace(temporal(hr.Finger.still(0.0, **LIGHT), 20.0), duration=2.0)
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    asked = ["render", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out")]
    assert cli.main(asked) == 0
    assert "\n  may be left out: the finger's mechanics" in capsys.readouterr().out
    assert hr.Scene.from_toml(tmp_path / "out" / "scene.toml").plant == {}
    assert cli.main([*asked, "--least-model"]) == 0
    assert "\n  left out: the finger's mechanics" in capsys.readouterr().out
    assert hr.Scene.from_toml(tmp_path / "out" / "scene.toml").plant == {"finger_dynamics": 0}
