"""The analyser alone: scipy's lock-in, blocks, channels, hours of play, silence, bad input."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from hapticrender.control.analyser import REFRESH, Analyser
from hapticrender.control.stdft import StarSTDFT

RATE = 48_000.0
BANDWIDTH = 10.0
# double: what scipy's direct form itself loses, eps (rate/(2 pi bandwidth))^2 = 1.3e-10; single: the carrier's turn is
# rounded by 6e-8 and taken 64 times
BOUNDS = pytest.mark.parametrize(("precision", "bound"), [("double", 1.3e-10), ("single", 64 * 6e-8)])


def comb(bands):
    return np.linspace(0.0, 1000.0, bands)


def lock_in(samples, frequency, bandwidth=BANDWIDTH, rate=RATE):
    """2 x exp(-j w t) through scipy's Butterworth."""
    turns = np.outer(np.arange(len(samples)) / rate, frequency)
    heard = 2 * samples[:, :, None] * np.exp(-2j * np.pi * turns)[:, None, :]
    return scipy.signal.sosfilt(scipy.signal.butter(2, bandwidth, fs=rate, output="sos"), heard, axis=0)


@BOUNDS
@pytest.mark.parametrize("bands", [1, 7, 8, 9, 16, 33, 64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_it_is_scipys_lock_in(bands, channels, precision, bound, rng):
    samples = rng.standard_normal((700, channels))
    found = Analyser(comb(bands), BANDWIDTH, RATE, channels, precision).run(samples)
    wanted = lock_in(samples, comb(bands))
    assert found.dtype == {"double": np.complex128, "single": np.complex64}[precision]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=bound * abs(wanted).max())


@pytest.mark.parametrize("bandwidth", [0.5, 40.0, 900.0, 2400.0])
def test_it_is_scipys_lock_in_at_any_bandwidth(bandwidth, rng):
    samples = rng.standard_normal((2000, 1))
    found = Analyser([0.0, 60.0, 2499.0], bandwidth, 5000.0).run(samples)
    wanted = lock_in(samples, [0.0, 60.0, 2499.0], bandwidth, 5000.0)
    bound = 1e-12 + 2.3e-16 * (5000.0 / (2 * np.pi * bandwidth)) ** 2  # 1000 turns are known to 1e-13, in radians 7e-13
    np.testing.assert_allclose(found, wanted, rtol=0, atol=bound * abs(wanted).max())


def test_it_is_the_estimator_on_fixed_carriers(rng):
    samples, frequency = rng.standard_normal((300, 2)), comb(5)
    phase = 2 * np.pi * np.outer(np.arange(300) / RATE, frequency)
    wanted = StarSTDFT(bandwidth=BANDWIDTH, rate=RATE).start(channels=2, bands=5).run(samples, phase)
    found = Analyser(frequency, BANDWIDTH, RATE, 2).run(samples)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1.3e-10 * abs(wanted).max())


@pytest.mark.parametrize("precision", ["double", "single"])
@given(cuts=st.lists(st.integers(0, 300), max_size=5))
def test_any_split_into_blocks_gives_the_same_envelopes(precision, cuts):
    samples = np.random.default_rng(7).standard_normal((300, 2))
    whole = Analyser(comb(20), BANDWIDTH, RATE, 2, precision).run(samples)
    analyser, edges = Analyser(comb(20), BANDWIDTH, RATE, 2, precision), [0, *sorted(cuts), 300]
    parts = [analyser.run(samples[i:j]) for i, j in zip(edges, edges[1:], strict=False)]
    assert np.array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize(("precision", "bound"), [("double", 1e-9), ("single", 4.6e-5)])
def test_modulus_is_the_peak_amplitude_and_angle_the_phase_after_minutes(precision, bound):
    """A tone at a frequency that no period of the rate holds, 5 million samples on, its image taken off.

    In single precision a state of 6e-8 is rounded once a sample, and remembers rate/(2 pi bandwidth) = 764 of them.
    """
    frequency, count, block = 1234.567, 5_000_000, 100_000
    analyser = Analyser([frequency], BANDWIDTH, RATE, 1, precision)
    for _ in range(count // block - 1):
        analyser.run(np.zeros((block, 1)))
    turns = np.mod(frequency * np.arange(count - block, count) / RATE, 1.0)
    late = analyser.run(3e-6 * np.cos(2 * np.pi * turns + 0.7)[:, None])[block // 2 :, 0, 0]
    image = StarSTDFT(bandwidth=BANDWIDTH, rate=RATE).tone_response(frequency, frequency).image
    bare = late - image * 3e-6 * np.exp(-0.7j - 4j * np.pi * turns[block // 2 :])
    np.testing.assert_allclose(bare, 3e-6 * np.exp(0.7j), rtol=bound)


@pytest.mark.parametrize("precision", ["double", "single"])
def test_silence_becomes_zero_and_leaves_no_tiny_numbers_behind(precision):
    analyser = Analyser(comb(9), 1000.0, RATE, 1, precision)
    found = analyser.run(np.ones((1, 1)))
    assert abs(found).max() > 0
    assert not analyser.run(np.zeros((40 * REFRESH, 1)))[-1].any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.7e308])
def test_what_is_no_number_counts_as_zero(bad, rng):
    samples = rng.standard_normal((200, 2))
    broken = samples.copy()
    samples[[3, 150], [0, 1]], broken[[3, 150], [0, 1]] = 0.0, bad
    analyser = Analyser(comb(5), BANDWIDTH, RATE, 2, "single")
    assert np.array_equal(analyser.run(broken), Analyser(comb(5), BANDWIDTH, RATE, 2, "single").run(samples))
    assert analyser.replaced == 2


@pytest.mark.parametrize(("bands", "precision"), [(3, "double"), (512, "double"), (512, "single")])
def test_envelopes_go_where_they_are_asked_to(bands, precision, rng):
    samples = rng.standard_normal((70, 2))
    analyser, other = (Analyser(comb(bands), BANDWIDTH, RATE, 2, precision) for _ in range(2))
    room = analyser.room(70)
    assert analyser.run(samples, out=room) is room
    assert np.array_equal(room, other.run(samples))


@pytest.mark.parametrize(
    ("out", "message"),
    [
        (np.zeros((4, 2, 2), complex), r"out.shape=\(4, 2, 2\) must be \(4, 2, 1\)"),
        (np.zeros((4, 2, 1), np.complex64), "out, of complex64, must be a writeable C-contiguous array of complex128"),
        (np.zeros((1, 2, 4), complex).T, "out, of complex128, must be a writeable C-contiguous array of complex128"),
    ],
)
def test_an_unfit_place_for_the_envelopes_is_refused(out, message):
    with pytest.raises(ValueError, match=message):
        Analyser([100.0], BANDWIDTH, RATE, 2).run(np.zeros((4, 2)), out=out)


def test_no_samples_give_no_envelopes():
    assert Analyser([100.0], BANDWIDTH, RATE, 2).run(np.zeros((0, 2))).shape == (0, 2, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frequency": []}, r"frequency.shape=\(0,\) must be \(bands,\)"),
        ({"frequency": [[100.0]]}, r"frequency.shape=\(1, 1\) must be \(bands,\)"),
        ({"frequency": [1.0, -2.0]}, r"frequency=-2.0 Hz must lie between 0 and half the rate, 24000 Hz"),
        ({"frequency": [24_000.5]}, r"frequency=24000.5 Hz must lie between 0 and half the rate, 24000 Hz"),
        ({"frequency": [np.nan]}, "frequency=nan Hz must lie"),
        ({"bandwidth": 0.0}, "bandwidth=0.0 Hz must lie between 0 and half the rate, 24000 Hz"),
        ({"bandwidth": 24_000.0}, "bandwidth=24000.0 Hz must lie between 0 and half the rate, 24000 Hz"),
        ({"rate": 0.0}, "rate=0.0 must be positive and finite"),
        ({"channels": 0}, "channels=0 must be a whole number >= 1"),
        ({"channels": 1.5}, "channels=1.5 must be a whole number >= 1"),
        ({"precision": "half"}, "precision='half': must be one of double, single"),
    ],
)
def test_bad_parameters_are_refused_with_value_bound_and_unit(change, message):
    with pytest.raises(ValueError, match=message):
        Analyser(**{"frequency": [100.0], "bandwidth": BANDWIDTH, "rate": RATE} | change)


def test_frequencies_on_their_bounds_are_taken():
    Analyser([0.0, RATE / 2], BANDWIDTH, RATE)


@pytest.mark.parametrize("shape", [(4,), (4, 1), (4, 2, 1)])
def test_samples_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"samples.shape=.* must be \(n, 2\)"):
        Analyser([100.0], BANDWIDTH, RATE, 2).run(np.zeros(shape))
