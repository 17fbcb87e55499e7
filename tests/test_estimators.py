"""The filter of the STDFT* to its printed digits, and the error observer's predicted innovation against it."""

import math

import numpy as np
import pytest
import scipy.signal
from test_bandwidth import GAINS, MODEL

from hapticrender.control.margin_check import error_loop
from hapticrender.control.stdft import StarSTDFT

RATE = 5000.0
STAR = StarSTDFT(bandwidth=10.0, rate=RATE)
COMB = np.array([47.0, 72.0, 111.0, 170.0, 261.0])


def test_the_star_is_a_butterworth_filter_to_the_printed_digits():
    b, a = STAR.coefficients
    np.testing.assert_allclose(b, 3.913021e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(a, [1, -1.98222893, 0.98238545], rtol=0, atol=5e-9)
    np.testing.assert_allclose(np.concatenate([b, a]), np.concatenate(scipy.signal.butter(2, 10, fs=RATE)), rtol=1e-9)
    offset = np.array([-522.0, -45.0, 1.0, 10.0, 40.0])  # Hz from the carrier; images at twice it
    response = scipy.signal.freqz(*scipy.signal.butter(2, 10, fs=RATE), offset, fs=RATE)[1]
    assert STAR.frequency_response(offset) == pytest.approx(response, rel=1e-9)
    assert abs(STAR.frequency_response(10.0)) == pytest.approx(math.sqrt(0.5), rel=1e-10)
    assert f"{abs(STAR.frequency_response(40.0)):.3f}" == "0.062"  # ripple of an amplitude at 20 Hz
    step = 1e-3
    assert -np.angle(STAR.frequency_response(step)) / (2 * np.pi * step) == pytest.approx(STAR.delay, rel=1e-6)


@pytest.mark.parametrize("frequency", [0.5, 60.0, 111.0, 900.0])
def test_the_measured_innovation_of_the_observer_is_the_predicted_one(frequency):
    """By the recursion of docs/theory.md: own carriers, between and beyond them; 1/(return difference) of the loop."""
    loop, carriers = error_loop(MODEL, COMB, GAINS, "low"), np.exp(2j * np.pi * COMB / RATE)
    turn, envelope, level, drift, measured = np.ones(5, complex), np.zeros(5, complex), 0.0, 0.0, []
    z = np.exp(2j * np.pi * frequency / RATE)
    for n in range(40_000):  # the slowest pole, of the DC estimate, has died away by exp(-90) in the first 20 000
        e = (z**n).real - level - (envelope * turn).real.sum()
        envelope = envelope + GAINS.observer * e * turn.conj()
        level, drift = level + GAINS.dc * e + drift, drift + GAINS.dc_drift * e
        turn = turn * carriers
        measured.append(e)
    predicted = 0.0 if frequency in COMB else 1.0 / loop.controller(np.array([z]))[1][0]
    expected = (predicted * z ** np.arange(20_000, 40_000)).real
    np.testing.assert_allclose(measured[20_000:], expected, rtol=0, atol=1e-9)


def test_parameters_out_of_bounds_are_refused():
    with pytest.raises(ValueError, match="bandwidth=2500.0 Hz must lie between 0 and half the rate"):
        StarSTDFT(bandwidth=2500.0, rate=RATE)
    with pytest.raises(ValueError, match="bandwidth=nan Hz must lie between"):
        StarSTDFT(bandwidth=float("nan"), rate=RATE)
