"""Limits of the band bank: overload, resolution, junk, silence, time without end, and reversals through zero speed."""

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.methods import METHODS
from hapticrender.drivers.base import BaseDriver
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Flag

RATE = 5000.0
IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}
OURS = pytest.mark.parametrize("method", ["h", "h2"])


def tones(*pairs):
    """Fixed carriers from (frequency, amplitude) pairs."""
    frequency, amplitude = np.array(pairs, float).T
    count = len(pairs)
    return Bands(
        frequency=frequency,
        wavenumber=np.zeros(count),
        phase=np.zeros(count),
        envelope=amplitude.astype(complex),
    )


def grating(wavelength, amplitude):
    return Bands(
        frequency=np.zeros(1),
        wavenumber=np.array([1 / wavelength]),
        phase=np.zeros(1),
        envelope=np.array([amplitude + 0j]),
    )


def design(method, bands, parameters=None, **changes):
    parameters = parameters or PlateParameters()
    model = parameters.device_model(parameters.rate, parameters.delay)
    return METHODS[method].design(dataclasses.replace(model, **changes), bands)


def line(motion, frequency, rate=RATE):
    """Amplitude (m) of each column at `frequency`, over whole periods."""
    n = np.arange(len(motion))
    return abs(2 * np.mean(motion * np.exp(-2j * np.pi * frequency * n / rate)[:, None], axis=0))


def overload(method):
    """2 s of 1 mm at 400 Hz, which needs 10.6 A, then 2 s of 100 um: drive, flags, motion and the plate's limit."""
    parameters = PlateParameters()
    before, after = (tones((400.0, wanted)) for wanted in (1e-3, 1e-4))
    controller = design(method, before, parameters)
    plate = Plate(parameters, hr.Finger.absent())
    first = plate.closed_loop(controller, np.zeros(10_000))
    controller.send(after)
    second = plate.closed_loop(controller, np.zeros(10_000))
    drive, flags = np.concatenate([first[0], second[0]]), np.concatenate([first[2], second[2]])
    return drive, flags, np.concatenate([first[3].motion, second[3].motion]), parameters.current_limit


@OURS
def test_overload_is_cut_as_a_whole_and_left_in_a_quarter_of_a_second(method):
    """Without back-calculation a complex integral never returns, and polar loops need seconds."""
    drive, flags, motion, limit = overload(method)
    peak = abs(drive).max(axis=0)
    assert peak.max() <= limit
    assert peak.min() > 0.99 * limit  # both coils; their springs differ by 2 %
    assert np.mean(flags[500:10_000] & Flag.SATURATED != 0) > 0.5
    # what 3 A in each coil can do at 400 Hz is 0.279 mm
    reach = limit * abs(PlateParameters().device_model(RATE, 1).response(400.0).sum(axis=-1)[0])
    assert line(motion[9000:10_000], 400.0)[0] == pytest.approx(reach, rel=0.15)
    period = 25  # samples: two turns of the carrier
    blocks = motion[10_000:, :].reshape(-1, period, 3)
    error = np.array([abs(line(block, 400.0)[0] / 1e-4 - 1) for block in blocks])
    late = (np.flatnonzero(error > 0.05)[-1] + 1) * period / RATE
    assert late <= 0.25
    assert not (flags[-5000:] & Flag.SATURATED).any()


@OURS
def test_overload_does_not_distort(method):
    """Third harmonic of the true motion <= 0.01 um while 3 A are reached (9.3 um where each sample is clipped)."""
    _, _, motion, _ = overload(method)
    assert line(motion[5000:10_000], 1200.0)[0] <= 0.01e-6


def spurs(motion):
    """Largest line (m) between 180 and 220 Hz, edges included."""
    spectrum = abs(np.fft.rfft(motion * np.hanning(len(motion)) * 2)) * 2 / len(motion)
    frequency = np.fft.rfftfreq(len(motion), 1 / RATE)
    return spectrum[(frequency >= 179.5) & (frequency <= 220.5)].max()


@OURS
@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_a_shaped_command_leaves_no_spurs(method, noise):
    """12 bit, 1 um at 20 Hz: 0.24-0.31 um at 180-220 Hz, above touch's threshold; shaped: 0.011."""
    found = {}
    for name, step in (("shaped", PlateParameters().current_step), ("plain", 0.0)):
        controller = design(method, tones((20.0, 1e-6)), drive_step=step)
        plate = Plate(PlateParameters(sensor_noise=noise), hr.Finger.absent())
        found[name] = spurs(plate.closed_loop(controller, np.zeros(40_000))[3].motion[-25_000:, 0])
    assert found["shaped"] <= 0.02e-6
    assert 0.2e-6 < found["plain"] < 0.4e-6


@pytest.mark.parametrize("method", ["h2", "h"])
def test_a_target_grows_over_its_ramp_and_does_not_strike_the_modes(method):
    """50 ms leave a peak of x1.02 near the modes, where a step leaves x1.5-1.75."""
    for frequency in (143.0, 170.0):
        controller = design(method, tones((frequency, 1e-5)), PlateParameters(**IDEAL))
        _, target, _, sensed = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).closed_loop(
            controller, np.zeros(5000)
        )
        ramp = round(1 / controller.settings["fade_in"])
        n = np.arange(1, ramp + 1) / ramp
        np.testing.assert_allclose(target[: n.size, 0].real, 1e-5 * n**2 * (3 - 2 * n), rtol=0, atol=1e-17)
        assert abs(sensed.motion[:, 0]).max() <= 1.03e-5


JUNK = st.one_of(
    st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 1e300, 5e-324]), st.floats(allow_nan=True, width=64)
)
SPOILT = st.lists(st.tuples(st.integers(0, 599), st.sampled_from(["sensed", "position", "wanted"]), JUNK), max_size=30)


@OURS
@pytest.mark.parametrize("analysed", [False, True])
@given(spoilt=SPOILT)
def test_drive_is_finite_and_inside_its_limit_whatever_comes_in(method, analysed, spoilt):
    """Any number at any sample of any input: the implausible ones that are read raise a flag, and no state is lost."""
    bands = Bands(
        frequency=np.array([47.0, 0.0]),
        wavenumber=np.array([0.0, 500.0]),
        phase=np.zeros(2),
        envelope=None if analysed else np.full(2, 1e-5 + 0j),
    )
    controller = design(method, bands)
    time = np.arange(900) / RATE
    given_ = {
        "sensed": 1e-5 * np.sin(300 * time)[:, None] * np.ones(2),
        "position": 0.1 * time,
        "wanted": 1e-5 * np.cos(2 * np.pi * 47 * time),
    }
    for n, name, value in spoilt:
        given_[name][n] = value
    drive, target, flags = controller.run(given_["sensed"], given_["position"], given_["wanted"])
    assert np.isfinite(drive).all()
    assert abs(drive).max() <= controller.settings["drive_limit"]
    assert np.isfinite(target).all()
    for name in controller.tiles.dtype.names:
        assert np.isfinite(controller.tiles[name]).all(), name
    for (n, name), value in {(n, name): value for n, name, value in spoilt}.items():
        unread = np.isnan(value) if name == "position" else name == "wanted" and not analysed  # NaN there: no finger
        absurd = not abs(value) <= 1e3 and not unread
        assert not absurd or flags[n] & Flag.NONFINITE, (n, name, value)


@OURS
def test_after_junk_it_finds_its_target_again(method):
    """0.2 s of a dead sensor in closed loop; 3 s later the tone is back within 1 %."""
    parameters = PlateParameters(**IDEAL)
    controller = design(method, tones((111.0, 1e-5)), parameters)
    plate = Plate(parameters, hr.Finger.absent())
    drive, late = np.zeros((1, 2)), []
    for n in range(10_000):
        sensed = plate.run(drive)
        values = sensed.sensed if not 3000 <= n < 4000 else np.full((1, 2), np.nan)
        drive, _, flags = controller.run(values, np.full(1, np.nan), np.zeros(1))
        assert (flags[0] & Flag.NONFINITE != 0) == (3000 <= n < 4000)
        if 3200 <= n < 4000:
            assert not drive.any()
        late.append(sensed.motion[0])
    assert line(np.array(late[-5000:]), 111.0) == pytest.approx(1e-5, rel=0.01)


class Listening(BaseDriver):
    """A plate behind a driver of two samples a block, which keeps what it is played and may break down."""

    def __init__(self, parameters, breaks_after=None):
        super().__init__(rate=RATE, drive_channels=2, sensed_channels=2, block=2)
        self.plate = Plate(parameters, hr.Finger.absent(), block=2)
        self.played, self.breaks_after = [], breaks_after

    def _play(self, drive):
        self.played.append(drive.copy())
        if len(self.played) == self.breaks_after:
            raise hr.DriverError("listening: play: it broke")
        return self.plate.run(drive)


@OURS
@pytest.mark.parametrize("breaks_after", [None, 500])
def test_a_run_ends_in_zero_drive(method, breaks_after):
    """Also where it ends in the middle: the delay is two samples, so the block that leaving plays reaches the coils."""
    scene = hr.Scene(
        texture=hr.Grating(frequency=111.0, amplitude=1e-5),
        finger=hr.Finger.absent(),
        device="vt-plate",
        duration=0.3,
        profile={"delay": 2},
    )
    driver = Listening(PlateParameters(delay=2), breaks_after)
    if breaks_after is None:
        hr.render(scene, driver=driver, method=method)
    else:
        with pytest.raises(hr.DriverError, match="it broke"):
            hr.render(scene, driver=driver, method=method)
    assert abs(driver.played[-2]).max() > 0
    assert not driver.played[-1].any()


PITCHES = (47.0, 111.3, 399.7)


def turns_after(samples, frequency):
    """Exact fraction of a turn that a carrier has left over after so many samples."""
    return float(Fraction(samples) * Fraction(frequency) / Fraction(RATE) % 1)


def test_the_phase_keeps_to_one_turn_and_does_not_drift():
    """400 s: each refresh, of 64 samples, adds and rounds a number below 8 twice, by at most 2^-51; so does reading."""
    n = 2_000_000
    controller = design("h2", tones(*((f, 1e-9) for f in PITCHES)))
    for _ in range(10):
        controller.run(np.zeros((n // 10, 2)), np.full(n // 10, np.nan), np.zeros(n // 10))
        assert np.all((controller.turns >= 0) & (controller.turns < 1))
    for found, frequency in zip(controller.turns, PITCHES, strict=True):
        apart = found - turns_after(n, frequency)
        assert abs(apart - round(apart)) <= (n / 64 + 1) * 2.0**-50


@OURS
@pytest.mark.parametrize("samples", [10**8, 36_000 * 5000])
def test_after_ten_hours_it_plays_as_in_the_first_second(method, samples):
    """The state jumps ahead; a controller whose carriers start at that phase plays the same to rounding.

    A growing time in float32 is by then good to 2 ms, half a turn.
    """
    late = design(method, tones(*((f, 1e-6) for f in PITCHES)))
    late.tiles["active"][0, : len(PITCHES)] = 1.0
    late.tiles["turns"][0, : len(PITCHES)] = [turns_after(samples, f) for f in PITCHES]
    early = design(
        method,
        dataclasses.replace(
            tones(*((f, 1e-6) for f in PITCHES)),
            phase=2 * np.pi * np.array([turns_after(samples, f) for f in PITCHES]),
        ),
    )
    found, expected = (c.run(np.zeros((3000, 2)), np.full(3000, np.nan), np.zeros(3000))[0] for c in (late, early))
    exact = 2 * np.pi * np.array([turns_after(samples + 2999, f) for f in PITCHES])
    carrier = [late.field(part) for part in ("cos", "sin")]
    np.testing.assert_allclose(carrier, [np.cos(exact), np.sin(exact)], rtol=0, atol=1e-11)
    assert abs(expected).max() > 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())
    naive = np.float32(samples / RATE) * np.float32(PITCHES[1]) % 1
    assert abs(naive - turns_after(samples, PITCHES[1])) > 0.01


SPEED, SWIPES = 50e-3, 3.0  # m/s at most, swipes there and back a second


def swipe(method, wavelength, mechanics):
    """Drive, frequency and its largest sweep (Hz/s) after the first 1.5 s of 10 um under swipes, ideal electronics."""
    time = np.arange(17_501) / RATE
    reach = SPEED / (2 * np.pi * SWIPES)
    path = reach * np.sin(2 * np.pi * SWIPES * time)
    load = 0.0 if mechanics == "none" else 0.8
    finger = hr.Finger.sampled(path, rate=RATE, normal_load=load, mechanics=mechanics)
    parameters = PlateParameters(**IDEAL)
    controller = design(method, grating(wavelength, 1e-5), parameters)
    drive, _, flags, _ = Plate(parameters, finger).closed_loop(controller, np.zeros(17_500))
    assert not flags.any()
    frequency = SPEED / wavelength * np.cos(2 * np.pi * SWIPES * time[:-1])
    return drive[7500:], frequency[7500:], 2 * np.pi * SWIPES * SPEED / wavelength


@pytest.mark.parametrize("wavelength", [0.5e-3, 1e-3, 2e-3])
@pytest.mark.parametrize(("method", "mechanics"), [("h", "none"), ("h2", "none"), ("h2", "heavy")])
def test_reversals_through_zero_speed_do_not_click(method, mechanics, wavelength):
    """3 Hz swipes of +-50 mm/s: no step in drive larger than its own slope at the band's frequency.

    A drive of size A cos(phi) moves by at most A w/rate a sample, w the highest; while the carrier fades between 20
    and 10 Hz, its third-order step of n samples adds A 1.5/n.
    """
    drive, frequency, sweep = swipe(method, wavelength, mechanics)
    size, fade = abs(drive).max(), 10.0 / sweep * RATE
    fastest, slow = 2 * np.pi * np.array([abs(frequency).max(), 20.0]) / RATE
    assert size > 0.02
    assert abs(np.diff(drive, axis=0)).max() <= size * max(fastest, slow + 1.5 / fade)
    assert abs(np.diff(drive, 2, axis=0)).max() <= size * fastest  # a lone step, with the carrier's slope taken out


@pytest.mark.parametrize("wavelength", [0.5e-3, 1e-3, 2e-3])
@pytest.mark.parametrize("mechanics", ["none", "heavy"])
def test_near_zero_speed_the_grating_fades_to_rest(mechanics, wavelength):
    """Below 10 Hz what is left of 30 mA stays under one step of the 12-bit command, 1.46 mA."""
    drive, frequency, _ = swipe("h2", wavelength, mechanics)
    assert abs(drive[abs(frequency) < 9.0]).max() < PlateParameters().current_step


EXTREMES = {  # plate, carriers
    "delay of 5 samples": ({"delay": 5}, [47.0, 189.0]),
    "20 kHz": ({"rate": 20_000.0}, [47.0, 189.0]),
    "48 kHz": ({"rate": 48_000.0}, [47.0, 189.0]),
    "one band at 20 Hz": ({}, [20.0]),
    "64 bands": ({}, np.linspace(20.0, 650.0, 64)),
    "half a hertz apart": ({}, [100.0, 100.5]),
}


@pytest.mark.parametrize("extreme", EXTREMES)
def test_h2_holds_at_the_edges_of_its_range(extreme):
    """Noise-free and unquantised, free plate: every band within 0.1 % from 3 s on."""
    plate, carriers = EXTREMES[extreme]
    parameters = PlateParameters(**IDEAL, **plate)
    carriers, wanted = np.array(carriers), 1e-5 / np.sqrt(len(carriers))
    controller = design("h2", tones(*((f, wanted) for f in carriers)), parameters)
    samples = int(5 * parameters.rate)
    drive, _, _, sensed = Plate(parameters, hr.Finger.absent()).closed_loop(controller, np.zeros(samples))
    turns = np.multiply.outer(np.arange(samples)[-round(2 * parameters.rate) :] / parameters.rate, carriers)
    basis = np.concatenate([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    found = np.linalg.lstsq(basis, sensed.motion[-len(basis) :, 0], rcond=None)[0]
    real, imaginary = found[: len(carriers)], -found[len(carriers) :]
    np.testing.assert_allclose(real + 1j * imaginary, wanted, rtol=0, atol=1e-3 * wanted)
    assert abs(drive).max() < parameters.current_limit


@pytest.mark.parametrize(
    ("method", "analysed"),
    [
        ("h2", False),
        ("h", False),
        ("h", True),
        ("h2", True),
    ],
)
def test_without_sensors_it_drives_from_what_it_knows(method, analysed):
    """Open loop on the plate of the design: the law alone is right."""
    parameters = PlateParameters(**IDEAL)
    bands = dataclasses.replace(tones((47.0, 1e-5)), **({"envelope": None} if analysed else {}))
    model = parameters.device_model(RATE, 1)
    controller = METHODS[method].design(model, bands, feedback=False)
    wanted = 1e-5 * np.cos(2 * np.pi * 47.0 * np.arange(15_000) / RATE)
    drive, _, _ = controller.run(np.zeros((15_000, 0)), np.full(15_000, np.nan), wanted)
    played = np.vstack([np.zeros((1, 2)), drive[:-1]])
    motion = Plate(parameters, hr.Finger.absent()).run(played).motion
    np.testing.assert_allclose(line(motion[-5000:], 47.0), 1e-5, rtol=2e-3)
