"""The demodulator against scipy's filters and its printed digits; the error observer's innovation against its law."""

import copy
import math
import pickle

import numpy as np
import pytest
import scipy.signal
from scipy.signal import butter, sosfilt
from test_stability import MODEL, SETTINGS

import hapticrender as hr
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.margin_check import error_loop

RATE, BANDWIDTH = 5000.0, 5.0


@pytest.mark.parametrize(("bands", "channels"), [(1, 1), (17, 3), (64, 1)])
def test_it_is_a_lock_in_by_scipy(bands, channels, rng):
    """Roundings behind poles 2 pi 5/5000 from 1 add up to eps/(2 pi 5/5000)^2 = 6e-12; 64 turns add 64 eps."""
    frequency, samples = np.linspace(20.0, 400.0, bands), rng.standard_normal((500, channels))
    turned = 2 * samples[:, :, None] * np.exp(-2j * np.pi * np.outer(np.arange(500), frequency) / RATE)[:, None]
    expected = sosfilt(butter(2, BANDWIDTH, fs=RATE, output="sos"), turned, axis=0)
    found = hr.Demodulator(frequency, BANDWIDTH, RATE, channels).run(samples)
    assert found.shape == (500, channels, bands)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-11 * abs(expected).max())


def test_any_split_into_blocks_gives_the_same(rng):
    samples, frequency = rng.standard_normal((300, 2)), np.linspace(20.0, 400.0, 20)
    split = hr.Demodulator(frequency, BANDWIDTH, RATE, 2)
    parts = [split.run(part) for part in np.split(samples, [1, 63, 64, 65, 200])]
    assert np.array_equal(np.concatenate(parts), hr.Demodulator(frequency, BANDWIDTH, RATE, 2).run(samples))


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_copies_go_on_each_for_itself(duplicate, rng):
    """Their memory is aligned, without which the compiled code ends the interpreter."""
    samples, one = rng.standard_normal((300, 2)), hr.Demodulator([20.0, 72.0], BANDWIDTH, RATE, 2)
    before, copies = one.run(samples[:200]), [duplicate(one) for _ in range(8)]
    assert before.any()
    assert all(each._tiles.ctypes.data % 64 == 0 for each in copies)
    after = one.run(samples[200:])
    del one
    assert all(np.array_equal(each.run(samples[200:]), after) for each in copies)


def test_after_an_hour_the_phase_is_the_tone_s():
    """3600 s of 5 kHz are 281 250 refreshes, each a rounding of 1.1e-16 turns at most: 2e-10 rad."""
    demodulator, block = hr.Demodulator([123.4567], BANDWIDTH, RATE), 250_000
    for _ in range(71):
        demodulator.run(np.zeros((block, 1)))
    turns = np.mod(123.4567 * (np.arange(block) + 71 * block) / RATE, 1.0)
    late = demodulator.run(3e-6 * np.cos(2 * np.pi * turns + 0.7)[:, None])[block // 2 :, 0, 0]
    image = 3e-6 * (BANDWIDTH / (2 * 123.4567)) ** 2  # what is left of the image at twice the carrier
    assert abs(late.mean() - 3e-6 * np.exp(0.7j)) < 1e-4 * image + 3e-6 * 1e-9
    assert abs(abs(late - late.mean()).max() / image - 1.0) < 0.02


def test_a_sample_that_is_no_number_counts_as_zero(rng):
    broken = rng.standard_normal((50, 2))
    broken[10, 0], broken[20, 1] = np.nan, np.inf
    repaired = np.where(np.isfinite(broken), broken, 0.0)
    found, expected = (hr.Demodulator([50.0, 90.0], BANDWIDTH, RATE, 2).run(each) for each in (broken, repaired))
    assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    ("bandwidth", "rate", "channels", "message"),
    [
        (10.0, np.inf, 1, "rate = inf: must be a finite number > 0 Hz"),
        (10.0, None, 1, "rate is missing: must be a finite number"),
        ("10", RATE, 1, "bandwidth = '10': must be a finite number Hz"),
        (10.0, RATE, 1.5, "channels = 1.5: must be an integer >= 1"),
        (10.0, RATE, 0, "channels = 0: must be an integer >= 1"),
    ],
)
def test_what_cannot_be_is_refused(bandwidth, rate, channels, message):
    """An infinite rate gave envelopes of zero."""
    with pytest.raises((ValueError, TypeError), match=message):
        hr.Demodulator([50.0], bandwidth, rate, channels)


def test_it_writes_where_it_is_asked_to(rng):
    samples, room = rng.standard_normal((40, 2)), np.empty((40, 2, 3), complex)
    demodulator = hr.Demodulator([50.0, 90.0, 140.0], BANDWIDTH, RATE, 2)
    assert demodulator.run(samples, out=room) is room
    for wrong in (np.empty((40, 2, 2), complex), np.empty((40, 2, 3)), np.empty((40, 2, 6), complex)[:, :, ::2]):
        with pytest.raises(ValueError, match="out of shape"):
            demodulator.run(samples, out=wrong)


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
    loop, carriers = error_loop(MODEL, COMB, SETTINGS, "low"), np.exp(2j * np.pi * COMB / RATE)
    turn, envelope, level, drift, measured = np.ones(5, complex), np.zeros(5, complex), 0.0, 0.0, []
    z = np.exp(2j * np.pi * frequency / RATE)
    for n in range(25_000):  # the slowest pole, of the DC estimate, has died away by exp(-90) in the first 20 000
        e = (z**n).real - level - (envelope * turn).real.sum()
        envelope = envelope + SETTINGS["observer"] * e * turn.conj()
        level, drift = level + SETTINGS["dc"] * e + drift, drift + SETTINGS["dc_drift"] * e
        turn = turn * carriers
        measured.append(e)
    predicted = 0.0 if frequency in COMB else 1.0 / loop.controller(np.array([z]))[1][0]
    expected = (predicted * z ** np.arange(20_000, 25_000)).real
    np.testing.assert_allclose(measured[20_000:], expected, rtol=0, atol=1e-9)
