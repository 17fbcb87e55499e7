"""The residual-coupled observer: twin, blocks, predicted against measured responses, crosstalk, pole rule, limits."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticrender.bands import Bands
from hapticrender.control.observer import ResidualObserver

RATE = 5000.0
COMB = [47.0, 72.0, 111.0, 170.0, 261.0]
KINDS = {
    "no level": ResidualObserver(bandwidth=10.0, rate=RATE),
    "type 1": ResidualObserver(bandwidth=10.0, rate=RATE, level_bandwidth=3.0, level_type=1),
    "type 2": ResidualObserver(bandwidth=10.0, rate=RATE, level_bandwidth=3.0, level_type=2),
}
ALL = pytest.mark.parametrize("observer", KINDS.values(), ids=KINDS)
BOTH = pytest.mark.parametrize("level_type", [1, 2])


def phases(samples, carriers, rate=RATE):
    return 2 * np.pi * np.multiply.outer(np.arange(samples) / rate, carriers)


def twin(observer, signal, carrier_phase):
    """The four lines of the module's docstring, complex numbers and all."""
    g, (dc, h) = observer.gain, observer.level_gains
    X = np.zeros((signal.shape[1], carrier_phase.shape[1]), complex)
    level, drift = np.zeros(signal.shape[1]), np.zeros(signal.shape[1])
    out = []
    for y, phi in zip(signal, carrier_phase, strict=True):
        carrier = np.exp(1j * phi)
        e = y - level - (X * carrier).real.sum(axis=1)
        X = X + g * e[:, None] * carrier.conj()
        level, drift = level + dc * e + drift, drift + h * e
        out.append((X, level, e))
    return [np.array(column) for column in zip(*out, strict=True)]


def settled(observer, carriers):
    """Samples until the slowest pole has died away by exp(-40), below rounding."""
    return int(np.ceil(40 / -np.log(abs(observer.poles(carriers)).max())))


@ALL
def test_kernel_equals_its_naive_twin(observer, rng):
    signal, carrier_phase = rng.normal(size=(1000, 2)), rng.uniform(0, 2 * np.pi, size=(1000, 3))
    found = observer.start(channels=2, bands=3).run(signal, carrier_phase)
    for ours, theirs in zip(found, twin(observer, signal, carrier_phase), strict=True):
        # the recursion never amplifies (energy), so 1000 samples of some ten roundings each
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e4 * 2.2e-16 * abs(theirs).max())


@cache
def record():
    generator = np.random.default_rng(7)
    return generator.normal(size=(600, 2)), generator.uniform(0, 2 * np.pi, size=(600, 3))


@ALL
@given(cuts=st.lists(st.integers(0, 600), max_size=5))
def test_any_split_into_blocks_gives_the_same(observer, cuts):
    signal, carrier_phase = record()
    whole = observer.start(channels=2, bands=3).run(signal, carrier_phase)
    running = observer.start(channels=2, bands=3)
    edges = [0, *sorted(cuts), 600]
    parts = [running.run(signal[i:j], carrier_phase[i:j]) for i, j in zip(edges, edges[1:], strict=False)]
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.array_equal(np.concatenate(pieces), column)


@ALL
@pytest.mark.parametrize("frequency", [0.5, 20.0, 47.0, 49.0, 60.0, 111.0, 140.0, 261.5, 900.0])
def test_measured_response_is_the_predicted_one(observer, frequency):
    """One tone in; every band's envelope, level and residual out: own carriers, neighbours, between and beyond them."""
    tone, start = 0.8 * np.exp(0.4j), settled(observer, COMB)
    n = np.arange(start + 10_000)  # 2 s: whole periods of every line below
    w, w_k = 2 * np.pi * frequency / RATE, 2 * np.pi * np.array(COMB) / RATE
    signal = (tone * np.exp(1j * w * n)).real[:, None]
    found = observer.start(channels=1, bands=5).run(signal, phases(n.size, COMB))
    predicted = observer.frequency_response(frequency, COMB)
    late = n[start:]
    for k in range(5):
        lines = np.exp(1j * np.multiply.outer(late, [w - w_k[k], -(w + w_k[k])]))
        direct, image = np.linalg.lstsq(lines, found.envelope[start:, 0, k], rcond=None)[0] / [tone, tone.conjugate()]
        assert direct == pytest.approx(predicted.direct[k], abs=1e-10)
        assert image == pytest.approx(predicted.image[k], abs=1e-10)
    for name in ("level", "residual"):
        wanted = (getattr(predicted, name) * tone * np.exp(1j * w * late)).real
        np.testing.assert_allclose(getattr(found, name)[start:, 0], wanted, rtol=0, atol=1e-10)


@ALL
def test_at_its_own_carrier_a_band_hears_all_and_the_others_nothing(observer):
    found = observer.frequency_response(np.array(COMB), COMB)
    np.testing.assert_allclose(found.direct, np.eye(5), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.image, 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose([found.level, found.residual], 0, rtol=0, atol=1e-12)


@BOTH
def test_a_steady_load_is_the_levels_alone(level_type):
    observer = ResidualObserver(bandwidth=10.0, rate=RATE, level_bandwidth=3.0, level_type=level_type)
    found = observer.frequency_response(0.0, COMB)
    assert found.level == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose([*found.direct, *found.image, found.residual], 0, rtol=0, atol=1e-12)


def test_a_ramp_lags_behind_a_type_1_level_and_not_behind_type_2():
    """v per sample: e settles at v/g_dc, of which K bands explain g K/2 at 0 Hz; the level has digested this sample."""
    speed = 1e-3
    ramp = speed * np.arange(50_000)[:, None]
    lag = {}
    for name in ("type 1", "type 2"):
        found = KINDS[name].start(channels=1, bands=2).run(ramp, phases(len(ramp), [47.0, 72.0]))
        lag[name] = ramp[-1, 0] - found.level[-1, 0]
    observer = KINDS["type 1"]
    assert lag["type 1"] == pytest.approx(speed * ((1 - observer.gain) / observer.level_gains[0] - 1), rel=1e-9)
    assert lag["type 2"] == pytest.approx(-speed, rel=1e-6)  # it already stands where the ramp will be next


def test_the_pole_rule_is_the_bandwidth_of_a_lone_band():
    """An envelope that turns by d meets wL/(wL + j d): -3 dB at the bandwidth, to second order in wL/w0."""
    observer = ResidualObserver(bandwidth=2.0, rate=48_000.0)
    found = observer.frequency_response(np.array([998.0, 1002.0]), [1000.0]).direct[:, 0]
    np.testing.assert_allclose(abs(found), np.sqrt(0.5), rtol=2 * 2.0 / 1000.0)
    slowest = -np.log(abs(observer.poles([1000.0]))) * 48_000 / (2 * np.pi)
    np.testing.assert_allclose(slowest, 2.0, rtol=1e-3)


def test_delay_is_the_slope_of_the_phase_at_the_carrier():
    observer = ResidualObserver(bandwidth=2.0, rate=48_000.0)
    step = 1e-4
    around = np.angle(observer.frequency_response(1000.0 + np.array([-step, step]), [1000.0]).direct[:, 0])
    assert -np.diff(around)[0] / (4 * np.pi * step) == pytest.approx(observer.delay, rel=2 * 2.0 / 1000.0)


def test_a_dead_beat_comb_settles_in_one_period_of_its_spacing():
    """N = 21 samples, ten carriers and a level: all poles at 0, and a Fourier transform is what is left."""
    observer = ResidualObserver.deadbeat(spacing=50.0, rate=1050.0)
    assert observer.gain == pytest.approx(2 * 50.0 / 1050.0)
    carriers = 50.0 * np.arange(1, 11)
    coefficients = np.poly(observer.poles(carriers))
    np.testing.assert_allclose(coefficients[1:], 0, atol=1e-12)
    wanted = np.linspace(0.1, 1, 10) * np.exp(1j * np.arange(10))
    carrier_phase = phases(60, carriers, 1050.0)
    signal = 0.7 + (wanted * np.exp(1j * carrier_phase)).real.sum(axis=1)[:, None]
    found = observer.start(channels=1, bands=10).run(signal, carrier_phase)
    np.testing.assert_allclose(found.envelope[20:, 0], np.broadcast_to(wanted, (40, 10)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.level[20:], 0.7, rtol=0, atol=1e-12)
    assert abs(found.envelope[19, 0] - wanted).max() > 1e-3


def test_twice_the_dead_beat_gain_rings_instead():
    fast = ResidualObserver(bandwidth=100.0 / (2 * np.pi), rate=1050.0)
    assert abs(fast.poles(50.0 * np.arange(1, 11))).max() > 0.9


@pytest.mark.parametrize("level_bandwidth", [0.0, 40.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_stable_exactly_while_all_gains_stay_below_two(share, level_bandwidth):
    """g K + g_dc < 2, on both sides, by poles and by energy of a run."""
    carriers = np.array([31.0, 170.0, 171.0, 400.0])
    dc = 2 * np.pi * level_bandwidth / 1000.0
    observer = ResidualObserver(
        bandwidth=share * (2 - dc) / 4 * 1000.0 / (4 * np.pi),
        rate=1000.0,
        level_bandwidth=level_bandwidth,
        level_type=1,
    )
    assert (abs(observer.poles(carriers)).max() < 1) == (share < 1)
    assert observer.most_bands == (4 if share < 1 else 3)
    if share < 1:
        assert observer.start(channels=1, bands=4).bands == 4
    else:
        with pytest.raises(ValueError, match=r"bands=4 must be <= 3 at a bandwidth of"):
            observer.start(channels=1, bands=4)


@given(seed=st.integers(0, 10**6), bands=st.integers(1, 8), share=st.floats(0.01, 1.0))
def test_energy_never_grows_whatever_the_carriers_do(seed, bands, share):
    """Random phases are the wildest chirp: sum |X|^2/g + l^2/g_dc of an unforced observer only falls."""
    generator = np.random.default_rng(seed)
    g = share * 2 / (bands + 0.5)
    observer = ResidualObserver(
        bandwidth=g * RATE / (4 * np.pi), rate=RATE, level_bandwidth=0.5 * g * RATE / (2 * np.pi), level_type=1
    )
    running = observer.start(channels=1, bands=bands)
    carrier_phase = generator.uniform(0, 2 * np.pi, (200, bands))
    signal = np.zeros((200, 1))
    signal[:20] = generator.normal(size=(20, 1))
    found = running.run(signal, carrier_phase)
    energy = (abs(found.envelope[:, 0]) ** 2).sum(axis=1) / g + found.level[:, 0] ** 2 / observer.level_gains[0]
    assert np.diff(energy[19:]).max() <= 1e-14 * energy.max()


@ALL
def test_the_error_is_observed_exactly_while_the_reference_races(observer, rng):
    """y = reference + error: the observer of the error equals one of the error alone, chirp and ramp included."""
    n = np.arange(4000)
    carrier_phase = 2 * np.pi * np.stack([20.0 * n / RATE + 80 * (n / RATE) ** 2, 111.0 * n / RATE], axis=1)
    reference = (np.stack([n / 4000.0, np.cos(n / 50.0)], axis=1) * np.exp(0.3j))[:, None, :]
    error = rng.normal(size=(4000, 2))
    signal = error + (reference * np.exp(1j * carrier_phase)[:, None, :]).real.sum(axis=-1)
    found = observer.start(channels=2, bands=2).run(signal, carrier_phase, reference)
    wanted = observer.start(channels=2, bands=2).run(error, carrier_phase)
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11)


def test_a_locked_carrier_follows_the_finger_through_its_reversal():
    """Grating of 0.5 mm under a swipe: the envelope in position's phase is constant, so it stays found at 0 Hz too."""
    time = np.arange(20_000) / RATE
    position = 5e-3 * np.sin(2 * np.pi * 2.0 * time)
    bands = Bands(frequency=np.zeros(1), wavenumber=np.array([2000.0]), phase=np.zeros(1), envelope=None)
    carrier_phase = bands.carrier_phase(time, position)
    signal = (3.0 * np.exp(1j * (carrier_phase + 0.7))).real
    found = KINDS["no level"].start(channels=1, bands=1).run(signal, carrier_phase)
    np.testing.assert_allclose(found.envelope[-5000:, 0, 0], 3.0 * np.exp(0.7j), rtol=0, atol=1e-9)


def test_it_coasts_over_what_no_sensor_can_show(rng):
    signal, carrier_phase = rng.normal(size=(300, 2)), phases(300, [40.0, 80.0])
    signal[[20, 21, 200], [0, 1, 1]] = [np.nan, np.inf, -np.inf]
    running = KINDS["no level"].start(channels=2, bands=2)
    found = running.run(signal, carrier_phase)
    assert running.skipped == 3
    assert np.isfinite(found.envelope).all()
    assert np.array_equal(found.envelope[20, 0], found.envelope[19, 0])
    assert not np.array_equal(found.envelope[20, 1], found.envelope[19, 1])


def test_channels_do_not_hear_each_other(rng):
    signal, carrier_phase = rng.normal(size=(300, 3)), phases(300, COMB)
    together = KINDS["type 2"].start(channels=3, bands=5).run(signal, carrier_phase)
    for c in range(3):
        alone = KINDS["type 2"].start(channels=1, bands=5).run(signal[:, [c]], carrier_phase)
        assert np.array_equal(together.envelope[:, c], alone.envelope[:, 0])


def test_no_band_at_all_is_a_level_alone():
    found = KINDS["type 1"].start(channels=1, bands=0).run(np.ones((5000, 1)), np.zeros((5000, 0)))
    assert found.level[-1, 0] == pytest.approx(1.0, abs=1e-6)
    assert found.envelope.shape == (5000, 1, 0)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: ResidualObserver(bandwidth=0.0, rate=RATE), "bandwidth=0.0 must be positive"),
        (lambda: ResidualObserver(bandwidth=10.0, rate=np.nan), "rate=nan must be positive"),
        (lambda: ResidualObserver(bandwidth=800.0, rate=RATE), "bandwidth=800.0 Hz must be below 795.775 Hz"),
        (lambda: ResidualObserver(bandwidth=1.0, rate=RATE, level_bandwidth=-1.0), "level_bandwidth=-1.0 Hz must be"),
        (lambda: ResidualObserver(bandwidth=1.0, rate=RATE, level_type=3), "level_type=3 must be 1 or 2"),
        (lambda: ResidualObserver.deadbeat(spacing=-1.0, rate=RATE), "spacing=-1.0 must be positive"),
        (lambda: KINDS["type 1"].poles([20.0, 20.0]), r"must be distinct: equal ones cannot be told apart"),
        (lambda: KINDS["type 1"].poles([0.0]), r"must be a list of frequencies between 0 and 2500 Hz"),
        (lambda: KINDS["type 1"].frequency_response(20.0, [[20.0]]), r"must be a list of frequencies"),
    ],
)
def test_parameters_out_of_bounds_are_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()


def test_arrays_of_another_shape_are_refused():
    running = KINDS["type 1"].start(channels=2, bands=3)
    with pytest.raises(ValueError, match=r"signal.shape=\(10,\) must be \(n, 2\)"):
        running.run(np.zeros(10), np.zeros((10, 3)))
    with pytest.raises(ValueError, match=r"carrier_phase.shape=\(9, 3\) must be \(10, 3\)"):
        running.run(np.zeros((10, 2)), np.zeros((9, 3)))
