"""Identification of a plate through a driver that shares no code with the library's plants."""

import dataclasses
import re
import sys

import numpy as np
import pytest
from held import amplitude
from other_plate import TRUTH, OtherPlate
from strangers_plate import WRONG, StrangersPlate
from waves import phasor

import hapticrender as hr
from hapticrender import cli, loop
from hapticrender.plants.identify import MECHANICAL, NAMES, identify
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Flag

PAPER = PlateParameters(current_bits=0)
SIGMAS_95 = 1.96
LIGHT = (0.2e-3, 1.5, 1e3)  # kg, N s/m, N/m: skin, Grigorii et al. 2021, table 1


def found(expected=PAPER, **plate):
    with OtherPlate(**plate) as driver:
        return identify(driver, expected)


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
        late = [each for each in identified.differences(PAPER) if each.startswith("delay")]
        assert len(late) == (plate["delay"] > 1)
        assert all(re.fullmatch(r"delay \+\d\.\d{4} \+- 0\.00\d\d samples", each) for each in late)
        assert (f"set it to {plate['delay']}" in identified.text()) == (plate["delay"] > 1)
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


def assert_noise_reaches_the_design(identified, noise, **tolerance):
    measured = identified.profile()["sensor_noise"]
    assert measured == pytest.approx(noise, **tolerance)
    tone = hr.Grating(frequency=72.0, amplitude=1e-5)
    scene = hr.Scene(texture=tone, duration=1.0, profile={"sensor_noise": measured})
    assert hr.prepare(scene).model.sensed_noise == measured


FAR = {"mass": 22e-3, "stiffness_1": 33e3, "stiffness_2": 16e3, "damping_1": 0.42, "damping_2": 1.7}


def test_without_noise_it_is_exact_however_far_the_expected_plate_is():
    """The equation error has one minimum; what remains is rounding and the last step of the search.

    In blocks of 7 the drive fades in and out without a step beyond that of the multi-sine itself, and ends in zeros.
    """
    late = {"delay": 20, "block": 7, "told": 7}
    with OtherPlate(noise=0.0, **FAR, **late) as driver:
        identified = identify(driver, PAPER)
    for name, true in (TRUTH | FAR | late).items():
        if name in NAMES:
            assert identified.estimates[name].value == pytest.approx(true, rel=1e-6)
    assert_noise_reaches_the_design(identified, 0.0, abs=1e-12)
    drive = np.concatenate(driver.played)
    assert not drive[-7:].any()
    inside = abs(np.diff(drive[2000:6000], axis=0)).max()
    assert abs(np.diff(np.concatenate([np.zeros((1, 2)), drive]), axis=0)).max() <= inside
    assert abs(drive).max() <= PAPER.current_limit


def designed_for(plate, profile):
    tone = hr.Grating(frequency=72.0, amplitude=50e-6)
    return loop.prepare(hr.Scene(texture=tone, duration=1.0, profile=profile), driver=plate).model


@pytest.mark.parametrize(
    ("bending", "rate", "true"), [((700.0, 30, 0.1), 4009.8, {}), ((1900.0, 50, -0.1), 5000.0, WRONG)]
)
def test_the_bending_mode_of_a_third_partys_plate_is_found_and_reaches_the_design(bending, rate, true):
    """m, I, k .05 %, b .2 %, delay .002 samples; f .5 Hz (1900 Hz: 1 Hz), damping 5 %, shape 5 % with its sign.

    So do gains and delay.  At 4009.8 Hz no line falls on a whole number of Hz.
    """
    plate = StrangersPlate(seed=3, bending=bending, rate=rate, substeps=12, told=1, **true)
    identified = identify(plate, PAPER)
    assert identified.parameters.rate == rate
    found, true = identified.estimates, TRUTH | {"gain_1": 1.0, "gain_2": 1.0} | true
    error = [found[name].value / true[name] - 1 for name in MECHANICAL]
    assert (abs(np.array(error)) <= [5e-4] * 4 + [2e-3] * 2).all()
    assert found["delay"].value == pytest.approx(true["delay"], abs=0.002)
    assert found["gain_difference"].value == pytest.approx(true["gain_2"] - true["gain_1"], abs=0.002)
    frequency, quality, coil = bending
    near = pytest.approx(frequency, abs=0.5 if frequency < 1500 else 1.0)
    assert found["bending_frequency"].value == near
    assert found["bending_damping"].value == pytest.approx(0.5 / quality, rel=0.05)
    assert found["bending_coil"].value == pytest.approx(coil, rel=0.05)
    assert identified.significance > 100
    assert identified.explained
    model = designed_for(plate, identified.profile())
    assert (model.bending.measured, model.bending.frequency, model.delay) == (True, near, true["delay"])
    assert model.bending.coupling[0] == pytest.approx(coil / 9.5e-3, rel=0.05)
    assert model.coordinate_from_sensed[0] == pytest.approx([0.5 / true["gain_1"], 0.5 / true["gain_2"]], rel=1e-3)


def test_a_bending_mode_is_found_from_five_standard_deviations_on():
    """A shape of .003 at the coils is 7 of them; .001 and a rigid plate with a command of 10 bits show no mode.

    The law is then that of rigid glass; where nothing is stated the mode may have either sign.
    """
    assert identify(StrangersPlate(bending=(1250.0, 30, 0.003)), PAPER).significance > 5
    for coil, bits in ((0.001, 0), (0.0, 10)):
        plate = StrangersPlate(bending=(1250.0, 30, coil), drive_bits=bits)
        none = identify(plate, PAPER)
        assert none.significance == 0.0
        assert "no bending found up to 219" in none.text()
        assert none.profile()["bending_frequency"] == 0.0
        assert designed_for(plate, none.profile()).rigid
    assert designed_for(plate, {}).bending.measured is False


shown = []  # by the plate that the command line opens


def keep(sample, sensed):
    shown.append(sensed.sensed.copy())
    return sensed


@pytest.mark.parametrize(
    ("limits", "bounds"),
    [({}, (1.0, 1.0, 200e-6)), ({"peak_drive": 0.1}, (0.1, 1.0, 1.0)), ({"rms_drive": 0.05}, (1.0, 0.05, 1.0))]
    + [({"displacement": 40e-6}, (1.0, 1.0, 40e-6))],
)
def test_the_limits_of_the_device_are_held_while_it_is_identified(tmp_path, monkeypatch, limits, bounds):
    """Without any 0.8 A, 0.3 A rms and more than 40 um; by the command line, from a scene."""
    scene = tmp_path / "scene.toml"
    scene.write_text(
        hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=5e-6), duration=1.0, limits=limits).to_toml()
    )
    driver = OtherPlate(seed=2, spoil=keep)
    monkeypatch.setattr(sys.modules[__name__], "watched", lambda: driver, raising=False)
    shown.clear()
    assert cli.main(["identify", "--driver", f"{__name__}:watched", "--scene", str(scene)]) == 0
    drive, sensed = np.concatenate(driver.played), np.concatenate(shown)
    found = abs(drive).max(), np.sqrt((drive**2).mean(axis=0)).max(), abs(sensed).max()
    assert (np.array(found) <= bounds).all()
    assert limits or (np.array(found) > (0.5, 0.2, 60e-6)).all()


def test_a_third_partys_plate_is_held_although_everything_is_wrong():
    """k +5, m -5, b -20 %, gains +-2 %, a sample late: the wave's mean amplitude within 3 % at every place."""
    plate = StrangersPlate(**WRONG, told=2, bending=(1250.0, 30, 0.1))
    scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=50e-6), duration=1.5)
    with pytest.warns(hr.PlateMismatch):
        hr.render(scene, driver=plate)
    assert abs(phasor(plate.truth[5000:7500], 72.0)) == pytest.approx([50e-6] * 4, rel=0.03)


def test_the_command_line_identifies_a_wrong_plate_and_render_then_holds_it(tmp_path, capsys):
    """k +7 %, m -6 %, gains +-2 %: a warning and 2 % of error at the ends before, neither after identification."""
    truth = {"mass": 30e-3, "stiffness_1": 24e3, "stiffness_2": 24.5e3, "sensor_gain_1": 1.02, "sensor_gain_2": 0.98}
    scene = hr.Scene(texture=hr.Grating(frequency=143.0, amplitude=30e-6), duration=3.0, simulation=truth)
    (tmp_path / "wrong.toml").write_text(scene.to_toml())
    with pytest.warns(
        hr.PlateMismatch, match="the controller adds .* remove the finger and take .*`hapticrender identify"
    ):
        before = amplitude(hr.render(scene).motion, 143.0, 1.0)
    arguments = ["identify", "--scene", str(tmp_path / "wrong.toml"), "--out", str(tmp_path / "plate.toml")]
    assert cli.main(arguments) == 0
    assert "differs from [device]: mass -6." in capsys.readouterr().out
    measured = dataclasses.replace(scene, device=str(tmp_path / "plate.toml"))
    after = amplitude(hr.render(measured).motion, 143.0, 1.0)
    assert measured.source.startswith("plate (")
    assert abs(before / 30e-6 - 1).max() > 0.015
    assert abs(after / 30e-6 - 1).max() < 0.003


@pytest.mark.parametrize(("noise", "hum"), [(3e-6, 0.0), (1e-9, 0.6e-6)])
def test_the_noise_of_the_sensors_goes_into_the_profile(noise, hum):
    """A hum of 50 Hz is no noise.  The median of 700 bins has a standard error of 1.44/(2 sqrt(700)), 2.7 %."""

    def humming(sample, sensed):
        return sensed._replace(sensed=sensed.sensed + hum * np.sin(2 * np.pi * 50 * sample / 5000))

    # 4 standard errors; leaks of the hum
    assert_noise_reaches_the_design(found(noise=noise, spoil=humming), noise, rel=0.11, abs=1e-9 if hum else 1e-12)


def test_no_more_is_played_than_the_driver_can():
    """With a converter that rounds up, too: by `drive_limit` the lines are smaller, and less well determined."""
    driver, expected = OtherPlate(), PlateParameters(current_bits=8)
    driver.drive_limit = 0.51  # 21.8 steps
    with driver:
        identified = identify(driver, expected)
    assert 0.51 - 1.5 * expected.current_step <= abs(np.concatenate(driver.played)).max() <= 0.51
    assert identified.parameters.mass == pytest.approx(TRUTH["mass"], rel=0.01)


def test_the_same_plate_gives_no_difference_and_another_one_its_numbers(one):
    """k +5 %, m -5 % are named with their amounts; k +0.5 % is significant, too."""
    other = dataclasses.replace(PAPER, mass=PAPER.mass / 0.95, stiffness_1=PAPER.stiffness_1 / 1.05)
    assert one.differences(PAPER) == ()
    near = dataclasses.replace(PAPER, stiffness_1=PAPER.stiffness_1 / 1.005)
    assert [each.split()[0] for each in one.differences(near)] == ["stiffness_1"]
    assert [each.split()[0] for each in one.differences(other)] == ["mass", "stiffness_1"]
    mass, interval = one.estimates["mass"]
    for times, count in ((1.9, 0), (2.1, 1)):  # its half-width of 95 %
        assert len(one.differences(dataclasses.replace(PAPER, mass=mass + times * interval))) == count
    text = "; ".join(one.differences(other))
    assert re.match(r"mass -[45]\.\d\d \+- 0\.0\d %; stiffness_1 \+[45]\.\d\d", text)


def test_a_delay_longer_than_the_wait_is_found():
    """Of a sound card in blocks of 4096: 0.34 s; the record would begin before the plate moves."""
    identified = identify(StrangersPlate(rate=48e3, block=4096, told=16_384, delay=12_289), PAPER)
    assert identified.estimates["delay"].value == pytest.approx(16_384, abs=0.1)
    assert identified.parameters.mass == pytest.approx(0.032, rel=1e-3)


def test_a_finger_is_refused_by_its_load_or_by_its_motion():
    with pytest.raises(hr.DesignError, match=r"static load = 0\.(19|2)\d* N: must be within \+-0.05 N; remove"):
        found(load=0.2, position=27.5e-3)
    with pytest.raises(hr.DesignError, match=r"unexplained motion = \d+\.?\d* %: must be <= 1 %; remove the finger"):
        found(finger=LIGHT, position=15e-3)


SWAP = [[0.0, 1.0], [1.0, 0.0]]


@pytest.mark.parametrize(
    ("wiring", "message"),
    [
        ({"coils": SWAP}, "(sensors, or actuators|actuators, or sensors), are swapped: rewire"),
        (
            {"sensors": np.diag([-1.0, 1.0])},
            "explains .* % of the drive force: must be >= 95 %; sensor 1 is inverted: rewire",
        ),
        ({"coils": np.diag([0.0, 1.0])}, "actuator 1 is dead: rewire"),
        ({"sensors": np.diag([1.0, 0.0])}, r"sensor 2: response \S+ m per line must be > \S+ m, 10 times the noise"),
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
        ({"seconds": 0.3}, {}, r"seconds = 0.3: must be >= 0.391 s"),
        ({}, {"mass": 1e-3}, r"rate = 5000 Hz: must be >= 5\d+ Hz for a mode at 1\d+ Hz"),
    ],
)
def test_what_cannot_be_identified_is_refused_before_anything_is_played(how, expected, message):
    with OtherPlate() as driver:
        with pytest.raises(ValueError, match=message):
            identify(driver, dataclasses.replace(PAPER, **expected), **how)
        assert driver.played == []


def lost(sensed):
    raise hr.DeviceLost("device: play: gone")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda s: s._replace(flags=np.array([Flag.SATURATED])), hr.DesignError, "SATURATED.*decrease amplitude"),
        (lambda s: s._replace(sensed=np.full((1, 2), 1e-3)), hr.DesignError, r"0.001 m at .* within \+-0.001 m; check"),
        (lost, hr.DeviceLost, "play: gone"),
    ],
    ids=["saturated", "clipped", "lost"],
)
def test_a_fault_of_the_device_ends_at_zero_drive(change, error, message):
    with OtherPlate(spoil=lambda sample, sensed: change(sensed) if sample == 3000 else sensed) as driver:
        with pytest.raises(error, match=message):
            identify(driver, PAPER)
        assert not driver.played[-1].any()
        assert driver.is_open


def test_a_record_that_lost_samples_is_played_again(one):
    """Not one more than ten times; in the tenth all is identified, to the bounds of a device that loses none."""
    spoiled = []

    def lose(sensed):
        spoiled.append(len(spoiled))
        return sensed._replace(flags=np.array([Flag.OVERRUN]))

    with OtherPlate(spoil=lambda sample, sensed: lose(sensed) if sample == 3000 and not spoiled else sensed) as driver:
        identified = identify(driver, PAPER)
    for name in NAMES:
        (value, interval), expected = identified.estimates[name], one.estimates[name].value
        assert abs(value - expected) < 3 * interval, name  # other noise: sqrt(2) times the interval, and some
    with OtherPlate(spoil=lambda sample, sensed: lose(sensed) if sample >= 3000 else sensed) as driver:
        spoiled.clear()
        cures = r"--driver 'audio:NAME\?block.*'serial:PORT\?baud="
        with pytest.raises(hr.DesignError, match=f"reports OVERRUN, in 10 tries: free .*{cures}"):
            identify(driver, PAPER)
        assert not driver.played[-1].any()
    assert len(spoiled) == 10 + 10  # and the zeros after each
