"""Identification of a plate through a driver that shares no code with the library's plants."""

import dataclasses
import tomllib
import warnings

import numpy as np
import pytest
from other_plate import REACH, SPACING, TRUTH, OtherPlate

import hapticrender as hr
from hapticrender import cli, loop
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.fitting import sampled_response
from hapticrender.plants.identify import MECHANICAL, NAMES, compare, identify
from hapticrender.plants.multisine import design_multisine
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Flag

PAPER = PlateParameters(current_bits=0)
SIGMAS_95 = 1.96
LIGHT = (0.2e-3, 1.5, 1e3)  # kg, N s/m, N/m: skin, Grigorii et al. 2021, table 1


def found(expected=PAPER, how=None, **plate):
    with OtherPlate(**plate) as driver:
        return identify(driver, expected, **(how or {}))


def truth_of(plate):
    """Values of `NAMES` of an `OtherPlate`."""
    first, second = plate["gains"]
    difference = 2 * (second - first) / (first + second)
    return np.array([*(plate[name] for name in MECHANICAL), plate["delay"], difference])


def random_plate(seed):
    """Draw a plate of up to 1.4 times or 1/1.4 of the paper's numbers, 1 to 5 samples late, gains of mean 1."""
    rng = np.random.default_rng(seed)
    plate = {name: TRUTH[name] * 1.4 ** rng.uniform(-1.0, 1.0) for name in MECHANICAL}
    plate["stiffness_2"] = plate["stiffness_1"] * rng.uniform(0.9, 1.1)
    difference = rng.uniform(-0.05, 0.05)
    return plate | {"delay": int(rng.integers(1, 6)), "gains": (1 - difference / 2, 1 + difference / 2)}


@pytest.fixture(scope="module")
def eight():
    """Eight random plates, and what was identified of each."""
    plates = [random_plate(seed) for seed in range(8)]
    return [(plate, found(seed=seed, **plate)) for seed, plate in enumerate(plates)]


@pytest.fixture(scope="module")
def one():
    return found()


def test_one_second_of_100_um_meets_the_target(eight):
    """m, I, k within 0.3 %, b within 1 %, delay within 0.01 sample, gain difference within 0.003, 1 um of noise."""
    for plate, identified in eight:
        values = np.array([identified.estimates[name].value for name in NAMES])
        error = abs(values - truth_of(plate)) / [*(plate[name] for name in MECHANICAL), 1.0, 1.0]
        assert (error <= [3e-3] * 4 + [1e-2] * 2 + [0.01, 0.003]).all()
        assert identified.explained
        assert identified.parameters.delay == plate["delay"]
        assert identified.noise == pytest.approx(1e-6, rel=0.08)  # 4 sigmas of an rms from 1300 real numbers


def test_intervals_cover_the_truth_as_often_as_they_say(eight):
    """Of 64 intervals of 95 %, more than 10 miss with p = 3e-4; squared errors of a number: a chi-square of 8 degrees.

    That lies outside 0.65 to 32 with p = 1e-4 each side, so intervals of a third of the width would fail.
    """
    errors = np.array(
        [
            [(identified.estimates[name].value - value) / identified.estimates[name].interval for name, value in pairs]
            for plate, identified in eight
            for pairs in [list(zip(NAMES, truth_of(plate), strict=True))]
        ]
    )
    assert (abs(errors) > 1).sum() <= 10
    chi_square = ((SIGMAS_95 * errors) ** 2).sum(axis=0)
    assert chi_square.min() > 0.65
    assert chi_square.max() < 32


def test_intervals_shrink_with_amplitude_and_duration(one):
    """As 1/amplitude, and as 1/sqrt(seconds)."""
    loud, long = found(how={"amplitude": 500e-6}), found(how={"seconds": 2.0})
    for name in NAMES:
        assert one.estimates[name].interval / loud.estimates[name].interval == pytest.approx(5, rel=0.15)
        assert one.estimates[name].interval / long.estimates[name].interval == pytest.approx(2**0.5, rel=0.25)


FAR = {"mass": 22e-3, "stiffness_1": 33e3, "stiffness_2": 16e3, "damping_1": 0.42, "damping_2": 1.7}


def test_without_noise_it_is_exact_however_far_the_expected_plate_is():
    """The equation error has one minimum; what remains is rounding and the last step of the search."""
    late = {"delay": 20, "block": 7, "told": 7}
    identified = found(noise=0.0, **FAR, **late)
    for name, true in (TRUTH | FAR | late).items():
        if name in NAMES:
            assert identified.estimates[name].value == pytest.approx(true, rel=1e-6)


def test_rate_and_bending_mode_are_those_of_the_device():
    """At 4009.8 Hz no line falls on a whole number of Hz; a mode that is not in [device] shows in the misfit."""
    plate = dataclasses.replace(PAPER, rate=4009.8, bending_frequency=1200.0)
    with SimulatedDriver(Plate(plate, hr.Finger.absent())) as driver:
        known, unknown = identify(driver, plate), identify(driver, PAPER)
    assert known.parameters.rate == 4009.8
    assert known.explained
    assert known.parameters.mass == pytest.approx(PAPER.mass, rel=3e-3)
    assert not unknown.explained


def test_the_sampled_plate_is_stiffness_hold_and_delay_with_all_images():
    """X = D^-1 F under the hold and its images; those past the 400th hold less than (f/rate)^3/400^2 = 4e-9 of it.

    Without images 400 Hz is off by 7e-4, more than the error allowed for m.
    """
    frequency, late = np.array([20.0, 147.0, 189.0, 400.0]), 1.3
    images = frequency[:, None] + 5000.0 * np.arange(-400, 401)
    turn = images / 5000.0
    hold = np.sinc(turn) * np.exp(-2j * np.pi * turn * (late + 0.5))
    reach = REACH / (SPACING / 2)
    response = np.array([[1.0, -reach], [1.0, reach]]) @ PAPER.device_model(5000.0, 1).response(images)
    each = hold[..., None, None] * response
    driven, _ = sampled_response(PAPER, 5000.0, late, frequency / 5000.0)
    scale = abs(driven).max(axis=(1, 2))
    assert (abs(driven - each.sum(axis=1)).max(axis=(1, 2)) / scale).max() < 1e-8
    assert 6e-4 < (abs(driven - each[:, 400]).max(axis=(1, 2)) / scale)[-1] < 8e-4


def test_a_profile_is_the_device_table_of_a_scene(eight):
    """Written, read and given to a scene, the profile makes the identified plate, gains included."""
    plate, identified = eight[3]
    text = identified.to_toml()
    device = tomllib.loads(text)["device"]
    assert device.pop("kind") == "vt-plate"
    assert device == identified.profile() == {**identified.profile(), "current_bits": 0}
    assert text.count("# +- ") == 9
    assert PlateParameters.with_overrides(device) == identified.parameters
    true = np.array([3e-5, -1e-5])  # heave and rocking (m)
    reach = REACH / (SPACING / 2)
    sensed = plate["gains"] * (np.array([[1.0, -reach], [1.0, reach]]) @ true)
    error = 2 * identified.estimates["gain_difference"].interval * 3e-5
    np.testing.assert_allclose(
        identified.parameters.device_model(5000.0, 1).coordinate_from_sensed @ sensed, true, atol=error
    )


def amplitude(scene, recording):
    """Mean amplitude (m) at centre and ends over the last second."""
    n = np.arange(len(recording))[-int(recording.rate) :]
    turn = np.exp(-2j * np.pi * scene.texture.frequency * n / recording.rate)
    return abs(2 * np.mean(recording.motion[n] * turn[:, None], axis=0))


def test_the_command_line_identifies_a_wrong_plate_and_render_then_holds_it(tmp_path, capsys):
    """k +7 %, m -6 %, gains +-2 %: a warning and 2 % of error at the ends before, neither after identification."""
    truth = {"mass": 30e-3, "stiffness_1": 24e3, "stiffness_2": 24.5e3, "sensor_gain_1": 1.02, "sensor_gain_2": 0.98}
    scene = hr.Scene(texture=hr.Grating(frequency=143.0, amplitude=30e-6), duration=3.0, simulation=truth)
    (tmp_path / "wrong.toml").write_text(scene.to_toml())
    with pytest.warns(hr.PlateMismatch, match="at 143 Hz; remove the finger and replace .*`hapticrender identify"):
        before = amplitude(scene, hr.render(scene))
    arguments = ["identify", "--scene", str(tmp_path / "wrong.toml"), "--out", str(tmp_path / "plate.toml")]
    assert cli.main(arguments) == 0
    assert "differs from [device]: mass -6." in capsys.readouterr().out
    device = tomllib.loads((tmp_path / "plate.toml").read_text())["device"]
    device.pop("kind")
    after = amplitude(scene, hr.render(dataclasses.replace(scene, profile=device)))
    assert abs(before / 30e-6 - 1).max() > 0.015
    assert abs(after / 30e-6 - 1).max() < 0.003


def test_the_command_line_takes_any_registered_driver(monkeypatch, capsys):
    known = loop.registered
    other = lambda group, name: OtherPlate if name == "other" else known(group, name)  # noqa: E731
    monkeypatch.setattr(loop, "registered", other)
    assert cli.main(["identify", "--driver", "other:0.04"]) == 0
    assert "mass                0.040" in capsys.readouterr().out
    assert cli.main(["identify", "--driver", "other:0.04", "--amplitude", "1e-6"]) == 2
    assert "10 times the noise: check drive and sensor connections, or increase amplitude" in capsys.readouterr().err


def test_the_command_line_refuses_other_kinds_and_open_loop_drivers(tmp_path, capsys):
    scene = hr.Scene(texture=hr.Grating(frequency=100.0, amplitude=0.01), device="electroadhesion", duration=1.0)
    (tmp_path / "screen.toml").write_text(scene.to_toml())
    assert cli.main(["identify", "--scene", str(tmp_path / "screen.toml")]) == 2
    assert "device.kind = 'electroadhesion': must be 'vt-plate'" in capsys.readouterr().err
    assert cli.main(["identify", "--driver", f"wavefile:{tmp_path / 'x.wav'}"]) == 2
    assert "WaveFileDriver: sensed_channels = 0: must be 2" in capsys.readouterr().err


def test_the_same_plate_gives_no_difference_and_another_one_its_numbers(one):
    """k +5 %, m -5 % named with their amounts and a warning; k +0.5 % is significant, yet needs no warning."""
    other = dataclasses.replace(PAPER, mass=PAPER.mass / 0.95, stiffness_1=PAPER.stiffness_1 / 1.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compare(one, PAPER) == ()
        near = dataclasses.replace(PAPER, stiffness_1=PAPER.stiffness_1 / 1.005)
        assert [each.name for each in compare(one, near)] == ["stiffness_1"]
    with pytest.warns(hr.PlateMismatch, match=r"for: mass -[45]\.\d\d \+- 0\.0\d %; stiffness_1 \+[45]\.\d\d"):
        assert [each.name for each in compare(one, other)] == ["mass", "stiffness_1"]


def test_a_delay_that_the_driver_does_not_state_is_found():
    identified = found(delay=2)
    assert identified.estimates["delay"].value == pytest.approx(2, abs=0.01)
    assert "driver.delay = 1 samples: measured 2.00, set it to 2" in identified.text()
    with pytest.warns(hr.PlateMismatch, match=r"delay \+1.00\d\d \+- 0.00\d\d samples"):
        compare(identified, PAPER)


def test_a_finger_is_refused_by_its_load_or_by_its_motion():
    with pytest.raises(hr.DesignError, match=r"static load = 0\.(19|2)\d* N: must be within \+-0.05 N; remove"):
        found(load=0.2, position=27.5e-3)
    assert found(how={"contact": 0.3}, load=0.2).load == pytest.approx(0.2, rel=0.01)
    with pytest.raises(hr.DesignError, match=r"unexplained motion = \d+\.?\d* %: must be <= 1 %; remove the finger"):
        found(finger=LIGHT, position=15e-3)


SWAP = [[0.0, 1.0], [1.0, 0.0]]


@pytest.mark.parametrize(
    ("wiring", "message"),
    [
        ({"coils": SWAP}, "sensors 1 and 2, or coils 1 and 2, are swapped: rewire"),
        ({"coils": -np.array(SWAP)}, "sensors or coils are both swapped and inverted: rewire"),
        (
            {"sensors": np.diag([-1.0, 1.0])},
            "explains .* % of the drive force: must be >= 95 %; sensor 1 is inverted: rewire",
        ),
        ({"coils": np.diag([0.0, 1.0])}, "coil 1 has no effect: rewire"),
        ({"sensors": np.diag([1.0, 0.0])}, r"sensor 2: response \S+ m per line must be > \S+ m, 10 times the noise"),
        ({"coils": np.zeros((2, 2))}, "sensor 1: response .* check drive and sensor connections, or increase"),
    ],
)
def test_a_wiring_fault_is_named(wiring, message):
    with pytest.raises(hr.DesignError, match=message):
        found(**wiring, **FAR, delay=5)


@pytest.mark.parametrize(
    ("how", "expected", "message"),
    [
        (
            {"amplitude": 0.9e-3},
            {},
            r"amplitude = 0.0009 m: needs \d\.\d+ A, must be <= 3 A; the drive allows 0.000\d+ m",
        ),
        ({"amplitude": float("nan")}, {}, r"amplitude = nan: must be > 0"),
        ({"seconds": 0.3}, {}, r"seconds = 0.3: must be >= 0.391 s"),
        ({}, {"coils": 1}, "coils = 1: must be 2 to identify heave and rocking"),
        ({}, {"mass": 1e-3}, r"rate = 5000 Hz: must be >= 5\d+ Hz for a mode at 1\d+ Hz"),
    ],
)
def test_what_cannot_be_identified_is_refused_before_anything_is_played(how, expected, message):
    with OtherPlate() as driver:
        with pytest.raises(ValueError, match=message):
            identify(driver, dataclasses.replace(PAPER, **expected), **how)
        assert driver.played == []


def at_3000(change):
    return lambda sample, sensed: change(sensed) if sample == 3000 else sensed


def lost(sensed):
    raise hr.DeviceLost("device: play: gone")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda s: s._replace(flags=np.array([Flag.OVERRUN])),
            hr.DesignError,
            "sample 3000: the device reports .*OVERR",
        ),
        (lambda s: s._replace(flags=np.array([Flag.SATURATED])), hr.DesignError, "SATURATED.*decrease amplitude"),
        (
            lambda s: s._replace(sensed=np.full((1, 2), np.nan)),
            hr.DesignError,
            r"sensor 1: nan m at sample \d+: must be",
        ),
        (lambda s: s._replace(sensed=np.full((1, 2), 1e-3)), hr.DesignError, r"0.001 m at .* within \+-0.001 m; check"),
        (lambda s: s._replace(sensed=np.zeros(2)), hr.ProtocolError, r"sensed has shape \(2,\), must be \(1, 2\)"),
        (lost, hr.DeviceLost, "play: gone"),
    ],
    ids=["overrun", "saturated", "nan", "clipped", "shape", "lost"],
)
def test_a_fault_of_the_device_ends_at_zero_drive(change, error, message):
    with OtherPlate(spoil=at_3000(change)) as driver:
        with pytest.raises(error, match=message):
            identify(driver, PAPER)
        assert not driver.played[-1].any()
        assert driver.is_open


def test_the_drive_fades_in_and_out_and_rests_at_zero():
    """No step beyond that of the multi-sine itself, and zeros at the end."""
    with OtherPlate(delay=7, block=7, told=7) as driver:
        identify(driver, PAPER)
    drive = np.concatenate(driver.played)
    assert not drive[-7:].any()
    inside = abs(np.diff(drive[2000:6000], axis=0)).max()
    assert abs(np.diff(np.concatenate([np.zeros((1, 2)), drive]), axis=0)).max() <= inside
    assert abs(drive).max() <= PAPER.current_limit


def test_the_multisine_moves_every_line_alike():
    """12 Hz grid, 3 Hz around both modes, heave and rocking in turn, crest below 2.5, on the steps of the command.

    Its design leaves out the images of the hold, 7e-4 at 400 Hz.
    """
    sine = design_multisine(PAPER, 5000.0, 5000, 100e-6)
    apart = np.diff(sine.bins)
    assert apart.max() < 12 + 3
    for mode in PAPER.modes()[0]:
        assert np.all(apart[abs(sine.bins[:-1] - mode) < 9] == 3)
    np.testing.assert_array_equal(sine.coordinate, np.arange(len(sine.bins)) % 2)
    plate = OtherPlate(noise=0.0)
    sensed = np.concatenate([plate.play(row[None]).sensed for row in np.tile(sine.drive, (3, 1))])[10_000:]
    lines = np.fft.rfft(sensed, axis=0)[sine.bins] * (2 / 5000)
    heave, rocking = (lines[:, 1] + lines[:, 0]) / 2, (lines[:, 1] - lines[:, 0]) / 2
    np.testing.assert_allclose(abs(np.where(sine.coordinate == 0, heave, rocking)), sine.motion, rtol=1e-3)
    assert abs(sensed).max() == pytest.approx(100e-6, rel=1e-3)
    assert abs(sensed).max() / np.sqrt((sensed**2).mean(axis=0).min()) < 2.5
    coarse = PlateParameters()
    steps = design_multisine(coarse, 5000.0, 5000, 100e-6).drive / coarse.current_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert abs(steps).max() > 100
