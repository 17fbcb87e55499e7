"""What every control method promises, and where the plain ones stop: the figures of FACTS section 3 on this plate."""

from dataclasses import replace

import numpy as np
import pytest
from held import amplitude_error, fixed, grating, hold
from synthetic import make_bands
from waves import phasor

import hapticrender as hr
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.methods import METHODS, Resonant, least_decay
from hapticrender.plants.plate import Plate, PlateParameters

RATE = 5000.0
WANTED = 10e-6
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)
MODEL = IDEAL.device_model(RATE, 1)
POLAR = ("paper", "paper-common", "boxcar")


def tones(*frequency):
    return make_bands(frequency, WANTED)


def mixed():
    """A fixed carrier and two that are locked to the finger, whose targets are analysed from a waveform."""
    return make_bands([47.0, 0.0, 0.0], None, [0.0, 1000.0, 2500.0], [0.0, 0.4, -1.0])


def steps_of(n, rng):
    """A noisy, moving, at times lifted finger as n samples of what a controller is given."""
    time = np.arange(n) / RATE
    position = np.where((time > 0.04) & (time < 0.06), np.nan, 0.02 * np.sin(20 * time))
    return 1e-5 * rng.standard_normal((n, 2)), position, 1e-5 * np.sin(2 * np.pi * 61.0 * time)


@pytest.mark.parametrize(("name", "block"), [*((name, 1) for name in METHODS), ("h2", 25)])
def test_any_split_into_blocks_gives_the_same_run(name, block, rng):
    """To the last bit, the converter included."""
    columns = sensed, position, wanted = steps_of(1000 * block, rng)
    model = replace(PlateParameters(delay=block).device_model(RATE, block), block=block)
    whole = METHODS[name].design(model, mixed()).run(*columns)
    assert abs(whole[0]).max() > 1e-3
    pieces, cuts = METHODS[name].design(model, mixed()), block * np.array([1, 2, 255, 256, 700])
    parts = [
        pieces.run(*rows)
        for rows in zip(*(np.split(column, cuts) for column in (sensed, position, wanted)), strict=True)
    ]
    for i, column in enumerate(whole):
        assert np.array_equal(column, np.concatenate([part[i] for part in parts]))


@pytest.mark.parametrize("name", sorted(set(METHODS) - {"inverse"}))  # it expects a finger where one is said to be
def test_a_grating_felt_backwards_is_the_same_function_of_time(name):
    """cos(2 pi x/wavelength) at +v and -v; and a finger that turns round at 0.6 s meets it again in mirror image."""
    time = np.arange(6001) / RATE
    motion = {}
    for way, position in (
        ("there", 0.01 * time),
        ("back", -0.01 * time),
        ("turned", 0.01 * np.abs(time - 0.6)),
        ("turned, below", -0.01 * np.abs(time - 0.6)),
    ):
        finger = hr.Finger.sampled(position, rate=RATE, normal_load=0.0, mechanics="none")
        motion[way] = hold(name, grating(2e-4, WANTED), 1.2, IDEAL, finger=finger)[1]
    assert abs(motion["there"][-500:, 0]).max() > 0.5 * WANTED
    np.testing.assert_allclose(motion["back"], motion["there"], rtol=0, atol=1e-9 * WANTED)
    np.testing.assert_allclose(motion["turned, below"], motion["turned"], rtol=0, atol=1e-9 * WANTED)


def image(name, frequency):
    """Gain of a method's estimator on the image at twice the carrier."""
    if name == "boxcar":
        turn = 2 * frequency / RATE
        return abs(np.sinc(250 * turn) / np.sinc(turn))
    return abs(StarSTDFT(bandwidth=10.0, rate=RATE).frequency_response(2 * frequency))


@pytest.mark.parametrize("frequency", [47.0, 261.0])
@pytest.mark.parametrize("name", METHODS)
def test_a_tone_off_resonance_is_held_exactly(name, frequency):
    """Free plate, ideal electronics, 4 s.

    Complex loops integrate the mean error to nothing; what is left has decayed by exp(-2 * 4) of 1e-3 for the slowest
    (h2 at rest, whose feed-forward leaves it that much).  Polar ones hold the mean of |X| = A |1 + i e^{-2j phi}|,
    which is A (1 + i^2/4), i the estimator's image; the common mode has no say in the ends.
    """
    found = abs(amplitude_error(hold(name, tones(frequency), 4.0, IDEAL)[1], frequency, WANTED))
    bound = 1.1 * image(name, frequency) ** 2 / 4 + 1e-5 if name in POLAR else 1e-6
    assert (found[0] if name == "paper-common" else found.max()) < bound


@pytest.mark.parametrize("name", METHODS)
def test_without_sensors_it_drives_open_loop(name):
    """The free plate is known, and 47 and 400 Hz lie on the grid of the polar methods' table.

    What is left are the hold's images at rate -+ f, which the samples cannot tell from f: at 400 Hz 2.1e-4.
    """
    controller = METHODS[name].design(MODEL, fixed((47.0, 1e-6), (400.0, 1e-6)), feedback=False)
    drive, _, _ = controller.run(np.zeros((15_000, 0)), np.full(15_000, np.nan), np.zeros(15_000))
    motion = Plate(IDEAL, hr.Finger.absent()).run(np.vstack([np.zeros((1, 2)), drive[:-1]])).motion
    for frequency in (47.0, 400.0):
        assert phasor(motion[10_000:15_000, 0], frequency) == pytest.approx(1e-6, rel=3e-4)


@pytest.mark.parametrize(("gain", "holds"), [(15.0, True), (17.5, False)])
@pytest.mark.parametrize("frequency", [(20.0,), (20.0, 31.0, 47.0, 72.0)], ids=["1 band", "4 bands"])
def test_integrators_without_a_low_pass_take_the_damping_of_a_mode(gain, holds, frequency):
    """FACTS 3: ki <= 15.  All bands together take away rocking's decay rate, zeta w = 0.01737 * 2 pi 147.27 1/s.

    That is a limit of 16.07 1/s for carriers far below the mode; delay and hold, 0.3 ms, turn the force by 16 degrees
    and leave 3 % more.
    """
    assert least_decay(PlateParameters().device_model(RATE, 1)) == pytest.approx(16.07, abs=0.01)
    finger = hr.Finger.still(position=27.5e-3, normal_load=0.01, mechanics="none")  # something to start rocking
    motion = hold(Resonant(gain=gain, checked=False), tones(*frequency), 30.0, IDEAL, finger=finger)[1]
    rocking = motion[:, 1] - motion[:, 2]
    early, late = (np.ptp(rocking[round(t * RATE) :][:5000]) for t in (2.0, 29.0))
    assert late < 0.01 * early if holds else late > 10 * early


def test_the_resonant_method_refuses_a_gain_that_drives_a_mode():
    with pytest.raises(hr.DesignError, match=r"gain=17 1/s must be below 16\.1 1/s"):
        Resonant(gain=17.0).design(MODEL, tones(47.0))


@pytest.mark.parametrize("name", ["boxcar", "static", "stiffness", "resonant"])
def test_too_long_a_delay_is_refused(name):
    with pytest.raises(hr.DesignError, match="margin|unstable|sensitivity"):
        METHODS[name].design(PlateParameters(delay=25_000).device_model(RATE, 25_000), tones(47.0))
