"""The least model: the predicted difference against two played levels, what is taken, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from random_plates import random_case

import hapticrender as hr
from hapticrender.plants.levels import REDUCTIONS, difference, least_model
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.recordings.envelopes import LARGEST_INFLATION, fit, window_length

AMPLITUDE = 10e-6  # m


def temporal(finger, *frequencies, amplitude=AMPLITUDE, **more):
    partials = tuple((f / frequencies[0], 1.0, 0.3 * f) for f in frequencies)
    texture = hr.Grating(amplitude=amplitude, frequency=frequencies[0], partials=partials)
    return hr.Scene(texture=texture, finger=finger, duration=4.0, **more)


def reduced(scene, name):
    """The scene with one level less."""
    return REDUCTIONS[scene.device][name](scene)


def faded(frequency, bands, rate):
    """Share of each target that is asked for at a carrier's frequency (Hz), by the band model's account."""
    size, highest = abs(frequency), min(1000.0, 0.4 * rate)
    ramp = np.clip(size / 10.0 - 1.0, 0.0, 1.0), np.clip(5.0 - 4.0 * size / highest, 0.0, 1.0)
    return np.where(bands.wavenumber > 0.0, np.prod([x**2 * (3 - 2 * x) for x in ramp], axis=0), 1.0)


def drive_of(scene, bands, time):
    """Current (A, (n, coils)) that makes the target on the rigid model of `scene`, were the finger at rest.

    It is held over a sample, so it is what is needed in the sample's middle, made larger by what the hold takes.
    """
    plate = PlateParameters.with_overrides({**scene.profile, **scene.simulation})
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
        PlateParameters.with_overrides({**scene.profile, **scene.simulation}),
        current_limit=1e3,
        current_bits=0,
        sensor_noise=0.0,
        sensor_bits=0,
    )
    return Plate(plate, scene.finger).run(drive).motion


def true_error(scene, lesser):
    """Largest envelope of the difference of both plates in any of the judge's windows, relative to its target."""
    plate = PlateParameters.with_overrides({**scene.profile, **scene.simulation})
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
FREE, RESTING, SLIDING = hr.Finger.absent(), hr.Finger.still(0.015, **HEAVY), hr.Finger.sliding(0.1, **HEAVY)
ONE, STATIC, SECOND = "one coordinate (heave)", "finger's load only", "finger of 2nd order"
BENDING = {"bending_frequency": 1250.0}
CASES = [
    (temporal(FREE, 20.0), ONE),
    (temporal(FREE, 147.0), ONE),
    (temporal(FREE, 400.0), ONE),
    (temporal(FREE, 170.0, simulation=BENDING), ONE),
    (temporal(FREE, 400.0, simulation=BENDING), "rigid glass"),
    (temporal(hr.Finger.still(0.015, **LIGHT), 72.0), STATIC),
    (temporal(hr.Finger.still(0.015, **LIGHT), 72.0), "no finger"),
    (temporal(RESTING, 189.0), STATIC),
    (temporal(RESTING, 143.0), ONE),
    (temporal(RESTING, 72.0, 400.0), SECOND),
    (temporal(SLIDING, 261.0), STATIC),
    (temporal(SLIDING, 261.0, simulation=BENDING), "rigid glass"),
]


@pytest.mark.parametrize(("scene", "name"), CASES, ids=lambda each: each if isinstance(each, str) else "")
def test_the_prediction_is_1_to_2_times_the_difference_of_two_played_levels(scene, name):
    lesser = reduced(scene, name)
    true = true_error(scene, lesser)
    assert true > 1e-4
    assert 1.0 <= difference(scene, lesser) / true <= 2.0


def test_random_plates():
    """60 random plates, fingers and textures: wherever a difference is predicted it is 1 to 2 times the played one.

    Not predicted are carriers that sweep (through a mode they never settle), near carriers under a moving finger (they
    exchange sidebands) and a sag that changes by as much as the difference: none of them is quasi-static.
    """
    judged = 0
    for seed in range(60):
        scene, lesser, names = random_case(seed)
        predicted = difference(scene, lesser)
        if not np.isfinite(predicted):
            continue
        true = true_error(scene, lesser)
        if true > 2e-4:  # below, rounding of the fit counts
            assert 1.0 <= predicted / true <= 2.0, (seed, names)
            judged += 1
    assert judged >= 15


def test_levels_are_taken_within_the_tolerance_only():
    """A light finger at 20 Hz: without its mechanics 0.8 % off; a heavy one near the mode is needed."""
    light = temporal(hr.Finger.still(0.0, **LIGHT), 72.0)
    found = least_model(light, tolerance=0.5)
    assert "no finger" in found.left_out
    assert 0.0 < found.difference <= 0.5
    assert isinstance(found.scene.finger.motion, type(FREE.motion))
    strict = least_model(temporal(RESTING, 189.0), tolerance=1e-3)
    assert STATIC not in strict.left_out
    assert "not taken, predicted difference" in strict.text
    for level in strict.levels:
        assert level.taken == (level.difference <= 1e-3)


def test_what_cannot_be_predicted_is_not_taken_and_says_why():
    found = least_model(temporal(SLIDING, 120.0), tolerance=10.0)
    reasons = {level.name: level.reason for level in found.levels}
    assert reasons["no finger"] == "the finger moves: its load moves the plate, or the texture follows it"
    assert reasons[ONE] == "the load of a moving finger tilts the plate"
    with pytest.raises(ValueError, match="tolerance=0.0: must be > 0 and <= 10"):
        least_model(temporal(FREE, 120.0), tolerance=0.0)
    hybrid = replace(temporal(FREE, 120.0), device="hybrid")
    assert least_model(hybrid).text.endswith("the device has one level only")


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_the_carrier_of_a_friction_device_is_left_out_where_its_difference_is_small(device):
    """Both levels rendered: the difference of the friction's envelopes stays below the predicted one.

    It is no tight bound: the loop makes up for most of the difference, and what is left is the noise of both.
    """
    scene = hr.Scene(
        texture=hr.Grating(frequency=120.0, velocity=10e-3), finger=hr.Finger.sliding(0.08, normal_load=0.4),
        device=device, duration=2.5, simulation={"level": "carrier"},
    )  # fmt: skip
    found = least_model(scene, tolerance=0.5)
    assert found.left_out == ("envelope of the carrier",)
    one, other = (hr.render(each).envelopes for each in (scene, found.scene))
    late = one.time > 1.0
    target = np.abs(one.target[late, 0]).mean()
    apart = abs(np.abs(one.achieved[late, 0, 0]).mean() - np.abs(other.achieved[late, 0, 0]).mean()) / target
    print(device, found.difference, apart)
    assert apart < max(found.difference, 1e-3)
