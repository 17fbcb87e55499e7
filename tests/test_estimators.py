"""Estimators: whole records against naive twins, and predicted against measured responses."""

import math

import naive
import numpy as np
import pytest
import scipy.signal

from hapticrender.control.estimators import BoxcarSTDFT, ResidualObserver, StarSTDFT

RATE = 5000.0
STAR = StarSTDFT(bandwidth=10.0, rate=RATE)
BOXCAR = BoxcarSTDFT(length=250, rate=RATE)
BOTH = pytest.mark.parametrize("stdft", [BOXCAR, STAR], ids=["boxcar", "star"])
COMB = [47.0, 72.0, 111.0, 170.0, 261.0]
OBSERVERS = {
    "no DC": ResidualObserver(bandwidth=10.0, rate=RATE),
    "type 1": ResidualObserver(bandwidth=10.0, rate=RATE, dc_bandwidth=3.0, dc_type=1),
    "type 2": ResidualObserver(bandwidth=10.0, rate=RATE, dc_bandwidth=3.0, dc_type=2),
}
ALL = pytest.mark.parametrize("observer", OBSERVERS.values(), ids=OBSERVERS)


def phases(samples, *frequencies, rate=RATE):
    return 2 * np.pi * np.multiply.outer(np.arange(samples) / rate, frequencies)


def observed(observer, signal, carrier_phase):
    """Envelopes, DC estimate and residual of one channel, by the recursion of the class docstring."""
    g, (dc, h) = observer.gain, observer.dc_gains
    envelope, level, drift, out = np.zeros(carrier_phase.shape[1], complex), 0.0, 0.0, []
    for y, carrier in zip(signal, np.exp(1j * carrier_phase), strict=True):
        e = y - level - (envelope * carrier).real.sum()
        envelope = envelope + g * e * carrier.conj()
        level, drift = level + dc * e + drift, drift + h * e
        out.append((envelope, level, e))
    return [np.array(column) for column in zip(*out, strict=True)]


@BOTH
def test_a_whole_record_equals_its_naive_twin(stdft, rng):
    signal, carrier_phase = rng.normal(size=(800, 2)), rng.uniform(0, 2 * np.pi, size=(800, 3))
    if stdft is BOXCAR:
        wanted = naive.boxcar_stdft(signal, carrier_phase, 250)
    else:
        wanted = naive.star_stdft(signal, carrier_phase, *scipy.signal.butter(2, 10.0, fs=RATE))
    # rounding of a direct form: eps times the square of rate/pole, (5000/63)^2
    np.testing.assert_allclose(
        stdft.demodulate(signal, carrier_phase), wanted, rtol=0, atol=1e-12 * np.abs(wanted).max()
    )


@BOTH
@pytest.mark.parametrize("carrier", [20.0, 261.0])
@pytest.mark.parametrize("offset", [-7.0, 1.0, 10.0, 45.0])
def test_the_measured_response_of_a_transform_is_the_predicted_one(stdft, carrier, offset):
    frequency, tone = carrier + offset, 0.8 * np.exp(0.4j)
    time = np.arange(2 * int(RATE)) / RATE
    signal = (tone * np.exp(2j * np.pi * frequency * time)).real[:, None]
    envelopes = stdft.demodulate(signal, phases(time.size, carrier))[:, 0, 0]
    settled = time >= 1.0  # by then what the start left has died away by exp(-44)
    lines = np.exp(2j * np.pi * np.multiply.outer(time[settled], [offset, -(frequency + carrier)]))
    direct, image = np.linalg.lstsq(lines, envelopes[settled], rcond=None)[0] / [tone, tone.conjugate()]
    predicted = stdft.tone_response(frequency, carrier)
    assert direct == pytest.approx(predicted.direct, abs=1e-9)
    assert image == pytest.approx(predicted.image, abs=1e-9)


def test_the_amplitude_at_20_hz_ripples_by_6_2_percent():
    """|L(40 Hz)| to its last printed digit."""
    amplitude = abs(STAR.demodulate(np.cos(phases(10_000, 20.0)), phases(10_000, 20.0)))[5000:]
    assert np.ptp(amplitude) / 2 == pytest.approx(0.062, abs=5e-4)
    assert np.ptp(amplitude) / 2 == pytest.approx(abs(STAR.tone_response(20.0, 20.0).image), rel=2e-3)


def test_the_coefficients_of_the_star_are_those_of_a_butterworth_filter():
    b, a = STAR.coefficients
    np.testing.assert_allclose(b, 3.913021e-5 * np.array([1, 2, 1]), rtol=0, atol=1e-11)
    np.testing.assert_allclose(a, [1, -1.98222893, 0.98238545], rtol=0, atol=5e-9)
    np.testing.assert_allclose(np.concatenate([b, a]), np.concatenate(scipy.signal.butter(2, 10, fs=RATE)), rtol=1e-9)
    assert abs(STAR.frequency_response(10.0)) == pytest.approx(math.sqrt(0.5), rel=1e-10)


@BOTH
def test_the_delay_is_the_slope_of_the_phase_at_rest(stdft):
    step = 1e-3
    assert -np.angle(stdft.frequency_response(step)) / (2 * np.pi * step) == pytest.approx(stdft.delay, rel=1e-6)


def test_a_boxcar_removes_whole_turns_and_so_the_image():
    assert abs(BOXCAR.frequency_response([20.0, 40.0, -60.0, 4980.0])).max() < 1e-14
    assert abs(BOXCAR.tone_response(20.0, 20.0).image) < 1e-14
    assert abs(BOXCAR.frequency_response(30.0)) == pytest.approx(2 / (3 * np.pi), rel=1e-3)
    np.testing.assert_allclose(BoxcarSTDFT(length=1, rate=RATE).frequency_response([0.0, 100.0, 2500.0]), 1, rtol=1e-14)


@ALL
@pytest.mark.parametrize("frequency", [0.5, 47.0, 60.0, 900.0])
def test_the_measured_response_of_the_observer_is_the_predicted_one(observer, frequency):
    """One tone in; every envelope, DC estimate and residual out: own carriers, between and beyond them."""
    tone = 0.8 * np.exp(0.4j)
    start = int(np.ceil(40 / -np.log(abs(observer.poles(COMB)).max())))  # the slowest pole has died away by exp(-40)
    n = np.arange(start + 10_000)  # 2 s: whole periods of every line below
    w, w_k = 2 * np.pi * frequency / RATE, 2 * np.pi * np.array(COMB) / RATE
    envelope, dc, residual = observed(observer, (tone * np.exp(1j * w * n)).real, phases(n.size, *COMB))
    predicted = observer.frequency_response(frequency, COMB)
    late = n[start:]
    for k in range(5):
        lines = np.exp(1j * np.multiply.outer(late, [w - w_k[k], -(w + w_k[k])]))
        direct, image = np.linalg.lstsq(lines, envelope[start:, k], rcond=None)[0] / [tone, tone.conjugate()]
        if frequency == COMB[k]:
            assert direct == pytest.approx(1.0, abs=1e-10)
        assert direct == pytest.approx(predicted.direct[k], abs=1e-10)
        assert image == pytest.approx(predicted.image[k], abs=1e-10)
    for measured, gain in ((dc, predicted.dc), (residual, predicted.residual)):
        np.testing.assert_allclose(measured[start:], (gain * tone * np.exp(1j * w * late)).real, rtol=0, atol=1e-10)


@ALL
def test_at_its_own_carrier_a_band_takes_all_and_the_others_nothing(observer):
    found = observer.frequency_response(np.array(COMB), COMB)
    np.testing.assert_allclose(found.direct, np.eye(5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.image, 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose([found.dc, found.residual], 0, rtol=0, atol=1e-12)


def test_the_pole_rule_is_the_bandwidth_of_a_lone_band():
    """An envelope that turns by d is passed by wL/(wL + j d): -3 dB at the bandwidth, to second order in wL/w0."""
    observer = ResidualObserver(bandwidth=2.0, rate=48_000.0)
    found = observer.frequency_response(np.array([998.0, 1002.0]), [1000.0]).direct[:, 0]
    np.testing.assert_allclose(abs(found), np.sqrt(0.5), rtol=2 * 2.0 / 1000.0)
    slowest = -np.log(abs(observer.poles([1000.0]))) * 48_000 / (2 * np.pi)
    np.testing.assert_allclose(slowest, 2.0, rtol=1e-3)


def test_a_comb_at_twice_the_spacing_over_the_rate_is_dead_beat():
    """N = 21 samples, ten carriers and a DC estimate of half the gain: all poles at 0, settled after one period."""
    observer = ResidualObserver(bandwidth=50.0 / (2 * np.pi), rate=1050.0, dc_bandwidth=50.0 / (2 * np.pi), dc_type=1)
    carriers = 50.0 * np.arange(1, 11)
    np.testing.assert_allclose(np.poly(observer.poles(carriers))[1:], 0, atol=1e-12)
    wanted = np.linspace(0.1, 1, 10) * np.exp(1j * np.arange(10))
    carrier_phase = phases(60, *carriers, rate=1050.0)
    envelope, dc, _ = observed(observer, 0.7 + (wanted * np.exp(1j * carrier_phase)).real.sum(axis=1), carrier_phase)
    np.testing.assert_allclose(envelope[20:], np.broadcast_to(wanted, (40, 10)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(dc[20:], 0.7, rtol=0, atol=1e-12)
    fast = ResidualObserver(bandwidth=100.0 / (2 * np.pi), rate=1050.0)
    assert abs(fast.poles(carriers)).max() > 0.9


@pytest.mark.parametrize("dc_bandwidth", [0.0, 40.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_it_is_stable_exactly_while_all_gains_stay_below_two(share, dc_bandwidth):
    """g K + g_dc < 2 for a DC estimate of type 1, on both sides."""
    carriers, dc = np.array([31.0, 170.0, 171.0, 400.0]), 2 * np.pi * dc_bandwidth / 1000.0
    bandwidth = share * (2 - dc) / 4 * 1000.0 / (4 * np.pi)
    observer = ResidualObserver(bandwidth=bandwidth, rate=1000.0, dc_bandwidth=dc_bandwidth, dc_type=1)
    assert (abs(observer.poles(carriers)).max() < 1) == (share < 1)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: BoxcarSTDFT(length=0, rate=RATE), "length=0 must be a whole number of samples >= 1"),
        (lambda: BoxcarSTDFT(length=2.5, rate=RATE), "length=2.5 must be a whole"),
        (lambda: BoxcarSTDFT(length=10, rate=-1.0), "rate=-1.0 must be positive"),
        (lambda: StarSTDFT(bandwidth=2500.0, rate=RATE), "bandwidth=2500.0 Hz must lie between 0 and half the rate"),
        (lambda: StarSTDFT(bandwidth=float("nan"), rate=RATE), "bandwidth=nan Hz must lie between"),
        (lambda: ResidualObserver(bandwidth=0.0, rate=RATE), "bandwidth=0.0 must be positive"),
        (lambda: ResidualObserver(bandwidth=1.0, rate=RATE, dc_bandwidth=-1.0), "dc_bandwidth=-1.0 Hz must be"),
        (lambda: ResidualObserver(bandwidth=1.0, rate=RATE, dc_type=3), "dc_type=3 must be 1 or 2"),
        (lambda: OBSERVERS["type 1"].poles([20.0, 20.0]), r"must be distinct: equal carriers cannot be separated"),
        (lambda: OBSERVERS["type 1"].poles([0.0]), r"must be a list of frequencies between 0 and 2500 Hz"),
    ],
)
def test_parameters_out_of_bounds_are_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()
