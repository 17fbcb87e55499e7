"""The STDFT and the STDFT*: twins, blocks, predicted against measured responses, the branch cut."""

import math
from functools import cache

import naive
import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from hapticrender.control.stdft import BoxcarSTDFT, StarSTDFT, phase, phase_error

RATE = 5000.0
STAR = StarSTDFT(bandwidth=10.0, rate=RATE)
BOXCAR = BoxcarSTDFT(length=250, rate=RATE)
BOTH = pytest.mark.parametrize("stdft", [BOXCAR, STAR], ids=["boxcar", "star"])


def carriers(samples, *frequencies):
    return 2 * np.pi * np.multiply.outer(np.arange(samples) / RATE, frequencies)


def twin(stdft, signal, carrier_phase):
    if isinstance(stdft, BoxcarSTDFT):
        return naive.boxcar_stdft(signal, carrier_phase, stdft.length)
    return naive.star_stdft(signal, carrier_phase, *scipy.signal.butter(2, stdft.bandwidth, fs=stdft.rate))


@BOTH
def test_kernel_equals_its_naive_twin(stdft, rng):
    signal, carrier_phase = rng.normal(size=(800, 2)), rng.uniform(0, 2 * np.pi, size=(800, 3))
    found = stdft.start(channels=2, bands=3).run(signal, carrier_phase)
    wanted = twin(stdft, signal, carrier_phase)
    # rounding of a direct form: eps times the square of rate/pole, (5000/63)^2
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


@cache
def record():
    generator = np.random.default_rng(7)
    return generator.normal(size=(600, 2)), generator.uniform(0, 2 * np.pi, size=(600, 3))


@BOTH
@given(cuts=st.lists(st.integers(0, 600), max_size=5))
def test_any_split_into_blocks_gives_the_same_envelopes(stdft, cuts):
    signal, carrier_phase = record()
    whole = stdft.start(channels=2, bands=3).run(signal, carrier_phase)
    estimator = stdft.start(channels=2, bands=3)
    edges = [0, *sorted(cuts), 600]
    parts = [estimator.run(signal[i:j], carrier_phase[i:j]) for i, j in zip(edges, edges[1:], strict=False)]
    assert np.array_equal(np.concatenate(parts), whole)


@BOTH
@pytest.mark.parametrize("carrier", [20.0, 72.0, 261.0])
@pytest.mark.parametrize("offset", [-7.0, -0.5, 1.0, 3.0, 10.0, 45.0])
def test_measured_response_is_the_predicted_one(stdft, carrier, offset):
    frequency, tone = carrier + offset, 0.8 * np.exp(0.4j)
    time = np.arange(2 * int(RATE)) / RATE
    signal = (tone * np.exp(2j * np.pi * frequency * time)).real[:, None]
    envelopes = stdft.start(channels=1, bands=1).run(signal, carriers(time.size, carrier))[:, 0, 0]
    settled = time >= 1.0  # by then what the start left has died away by exp(-44)
    lines = np.exp(2j * np.pi * np.multiply.outer(time[settled], [offset, -(frequency + carrier)]))
    direct, image = np.linalg.lstsq(lines, envelopes[settled], rcond=None)[0] / [tone, tone.conjugate()]
    predicted = stdft.tone_response(frequency, carrier)
    assert direct == pytest.approx(predicted.direct, abs=1e-9)
    assert image == pytest.approx(predicted.image, abs=1e-9)


@BOTH
def test_modulus_is_the_peak_amplitude_and_angle_the_phase(stdft):
    signal = 3e-6 * np.cos(carriers(10_000, 40.0) + 0.7)
    envelope = stdft.start(channels=1, bands=1).run(signal, carriers(10_000, 40.0))[-2500:, 0, 0].mean()
    assert envelope == pytest.approx(3e-6 * np.exp(0.7j), rel=1e-12)


def test_amplitude_at_20_hz_ripples_by_6_2_percent():
    """The first claim of the design study: |L(40 Hz)| to its last printed digit."""
    amplitude = abs(STAR.start(channels=1, bands=1).run(np.cos(carriers(10_000, 20.0)), carriers(10_000, 20.0)))
    settled = amplitude[5000:]
    assert np.ptp(settled) / 2 == pytest.approx(0.062, abs=5e-4)
    assert np.ptp(settled) / 2 == pytest.approx(abs(STAR.tone_response(20.0, 20.0).image), rel=2e-3)


def test_star_coefficients_are_the_published_ones():
    """FACTS 1: L at 5 kHz."""
    b, a = STAR.coefficients
    np.testing.assert_allclose(b, 3.913021e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(a, [1, -1.98222893, 0.98238545], rtol=0, atol=5e-9)
    np.testing.assert_allclose(np.concatenate([b, a]), np.concatenate(scipy.signal.butter(2, 10, fs=RATE)), rtol=1e-9)


def test_star_is_3_db_down_at_its_bandwidth():
    assert abs(STAR.frequency_response(10.0)) == pytest.approx(math.sqrt(0.5), rel=1e-10)


@BOTH
def test_delay_is_the_slope_of_the_phase_at_rest(stdft):
    step = 1e-3
    slope = -np.angle(stdft.frequency_response(step)) / (2 * np.pi * step)
    assert slope == pytest.approx(stdft.delay, rel=1e-6)


def test_delay_of_the_defaults():
    assert pytest.approx(22.5e-3, rel=2e-3) == STAR.delay  # sqrt2/(2 pi 10 Hz) is 22.5 ms
    assert BOXCAR.delay == 249 / (2 * RATE)


def test_boxcar_is_blind_to_whole_turns_and_so_to_the_image():
    assert abs(BOXCAR.frequency_response([20.0, 40.0, -60.0, 4980.0])).max() < 1e-14
    assert abs(BOXCAR.tone_response(20.0, 20.0).image) < 1e-14
    assert abs(BOXCAR.frequency_response(30.0)) == pytest.approx(2 / (3 * np.pi), rel=1e-3)


def test_boxcar_of_one_sample_passes_everything():
    np.testing.assert_allclose(BoxcarSTDFT(length=1, rate=RATE).frequency_response([0.0, 100.0, 2500.0]), 1, rtol=1e-14)


def test_boxcar_forgets_the_rounding_of_a_burst(rng):
    """A plain running sum would keep about 1e9 times the machine's epsilon for ever: 1e-7."""
    signal = rng.normal(size=(1500, 1))
    signal[:100] *= 1e9
    carrier_phase = carriers(1500, 60.0)
    found = BOXCAR.start(channels=1, bands=1).run(signal, carrier_phase)[1000:]
    np.testing.assert_allclose(found, naive.boxcar_stdft(signal, carrier_phase, 250)[1000:], rtol=0, atol=1e-14)


@BOTH
@pytest.mark.parametrize("junk", [np.nan, np.inf, -np.inf])
def test_non_finite_samples_count_as_zero_and_are_told(stdft, junk, rng):
    signal, carrier_phase = rng.normal(size=(300, 2)), carriers(300, 40.0, 80.0)
    silenced = signal.copy()
    signal[[20, 21, 200], [0, 1, 1]] = junk
    silenced[[20, 21, 200], [0, 1, 1]] = 0.0
    estimator = stdft.start(channels=2, bands=2)
    found = estimator.run(signal, carrier_phase)
    assert estimator.replaced == 3
    assert np.array_equal(found, stdft.start(channels=2, bands=2).run(silenced, carrier_phase))


@BOTH
def test_arrays_of_another_shape_are_refused(stdft):
    estimator = stdft.start(channels=2, bands=3)
    with pytest.raises(ValueError, match=r"signal.shape=\(10,\) must be \(n, 2\)"):
        estimator.run(np.zeros(10), np.zeros((10, 3)))
    with pytest.raises(ValueError, match=r"carrier_phase.shape=\(9, 3\) must be \(10, 3\)"):
        estimator.run(np.zeros((10, 2)), np.zeros((9, 3)))


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: BoxcarSTDFT(length=0, rate=RATE), "length=0 must be a whole number of samples >= 1"),
        (lambda: BoxcarSTDFT(length=2.5, rate=RATE), "length=2.5 must be a whole"),
        (lambda: BoxcarSTDFT(length=10, rate=-1.0), "rate=-1.0 must be positive"),
        (lambda: StarSTDFT(bandwidth=0.0, rate=RATE), "bandwidth=0.0 Hz must lie between 0 and half the rate, 2500"),
        (lambda: StarSTDFT(bandwidth=2500.0, rate=RATE), "bandwidth=2500.0 Hz must lie between"),
        (lambda: StarSTDFT(bandwidth=float("nan"), rate=RATE), "bandwidth=nan Hz must lie between"),
        (lambda: StarSTDFT(bandwidth=10.0, rate=float("inf")), "rate=inf must be positive and finite"),
    ],
)
def test_parameters_out_of_bounds_are_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()


@pytest.mark.parametrize("cut", [np.pi, np.pi / 2, 0.3])
def test_phase_equals_its_naive_twin(cut, rng):
    envelopes = np.exp(1j * rng.uniform(-20, 20, size=200))
    wanted = [naive.cut_phase(envelope, cut) for envelope in envelopes]
    np.testing.assert_allclose(phase(envelopes, cut=cut), wanted, rtol=0, atol=1e-14)


def test_the_cut_lies_where_it_is_put():
    just = np.radians(1e-3)
    around = np.exp(1j * (np.pi + np.array([-just, just])))
    assert np.ptp(phase(around)) == pytest.approx(2 * np.pi - 2 * just)
    assert np.ptp(phase(around, cut=np.pi / 2)) == pytest.approx(2 * just)
    around = np.exp(1j * (np.pi / 2 + np.array([-just, just])))
    assert np.ptp(phase(around)) == pytest.approx(2 * just)
    np.testing.assert_allclose(phase(around, cut=np.pi / 2), np.radians([90 - 1e-3, -270 + 1e-3]))


def test_edges_of_the_range():
    assert phase(-1.0 + 0.0j) == np.pi
    assert phase(complex(-1.0, -0.0)) == np.pi
    assert phase(1j, cut=np.pi / 2) == np.pi / 2
    assert phase(0.0j) == 0.0


def test_phase_error_has_no_seam_between_neighbours():
    assert phase_error(2 * np.exp(3.1j), 5 * np.exp(-3.1j)) == pytest.approx(6.2 - 2 * np.pi)
    assert phase_error(np.exp(1.6j), np.exp(1.5j)) == pytest.approx(0.1)
