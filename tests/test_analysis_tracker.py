"""Filters and tracker: predicted response and noise against measured ones, and any split into blocks."""

import numpy as np
import pytest
from test_analysis_plate import open_loop
from waves import phasor

import hapticrender as hr
from hapticrender.analysis.contact import clear_sigmas
from hapticrender.analysis.course import MotionFilter
from hapticrender.analysis.lock_in import demodulate, window_length
from hapticrender.analysis.records import LOADED
from hapticrender.analysis.smoothing import LocalLine, convolve, derivative_kernels, half_width, spread_of
from hapticrender.analysis.tracker import LEAST_RATE
from hapticrender.plants.plate import Plate, PlateParameters

RATE = 5000.0
PLATE = PlateParameters()


@pytest.mark.parametrize("frequency", [20.0, 100.0, 400.0])
def test_kernels_differentiate_as_they_say(frequency):
    """To what a kernel that ends at 5 spreads leaves out: exp(-12.5) of its largest tap, 27 s^-2 for g''."""
    spread, w = spread_of(100.0), 2 * np.pi * frequency
    n = half_width(spread, RATE)
    signal = np.cos(w * (np.arange(5000 + 2 * n) - n) / RATE)
    for order, taps in enumerate(derivative_kernels(spread, RATE)):
        expected = (1j * w) ** order * np.exp(-0.5 * (w * spread) ** 2)
        measured = phasor(convolve(signal, taps), frequency)
        assert abs(measured - expected) < 27 * np.exp(-12.5) / spread**order


@pytest.mark.parametrize("lookahead", [0.0, 0.02, 1.0])
def test_local_line_has_the_response_and_noise_it_says(lookahead, rng):
    spread = spread_of(10.0)
    line = LocalLine(spread, RATE, min(round(lookahead * RATE), half_width(spread, RATE)))
    count, frequency = 50_000, 8.0
    time = (np.arange(count + line.behind + line.ahead) - line.behind) / RATE
    signal = np.column_stack([np.cos(2 * np.pi * frequency * time), rng.standard_normal(len(time))])
    everywhere, nearly = np.ones(len(time), bool), np.arange(len(time)) > 0
    level, slope, of_level, of_slope = line.fit(signal, nearly)
    for mine, plain in zip((level, slope, of_level, of_slope), line.fit(signal, everywhere), strict=True):
        np.testing.assert_allclose(mine[1000:], plain[1000:], rtol=1e-6, atol=1e-9 * np.abs(plain).max())
    expected = [each[0] for each in line.response([frequency])]
    whole = slice(625, 625 + 48_125)  # 77 periods
    shift = np.exp(-2j * np.pi * frequency * 625 / RATE)
    assert abs(phasor(level[whole, 0], frequency) * shift - expected[0]) < 1e-6
    assert abs(phasor(slope[whole, 0], frequency) * shift / (2j * np.pi * frequency) - expected[1]) < 1e-6
    independent = count / RATE / (2 * spread)  # values, so that their mean square is certain to sqrt(2/n)
    for found, predicted in ((level, of_level), (slope, of_slope)):
        assert abs(np.mean(found[1000:, 1] ** 2 / predicted[1000:]) - 1) < 4 * np.sqrt(2 / independent)


def test_lock_in_separates_near_carriers_and_a_drift(rng):
    """Weighted least squares leave no crosstalk between constant amplitudes; noise is as predicted."""
    frequency = np.array([20.0, 31.0, 400.0])
    length = window_length(frequency, RATE)
    assert length == round(4 / 11 * RATE)
    time = np.arange(200 * length) / RATE
    wanted = np.array([1.0, 0.5j, 0.1])
    starts = np.arange(0, 200 * length, length)
    for noise in (0.0, 0.1):
        signal = 30 + 5 * time + (np.exp(2j * np.pi * np.outer(time, frequency)) @ wanted).real
        signal = signal + noise * rng.standard_normal(len(time))
        found = demodulate(signal[:, None], starts, length, np.tile(frequency, (200, 1)), RATE)
        error = found.amplitude[..., 0] * np.exp(-2j * np.pi * np.outer(found.time, frequency)) - wanted
        if noise:
            share = (np.abs(error) ** 2).mean(axis=0) / (2 * noise**2 * found.variance[0])
            assert (np.abs(share - 1) < 4 / np.sqrt(200)).all()
        else:
            assert np.abs(error).max() < 1e-9


def test_force_noise_is_as_predicted(rng):
    """Of the force that shows contact; its samples are correlated over a spread, so that 8 in 1000 are independent."""
    motion = MotionFilter(PLATE, RATE, spread_of(100.0))
    sensed = 1e-6 * rng.standard_normal((100_000, 2))
    signals = motion.update(np.zeros((100_000, 2)), sensed)
    theta = np.array([32e-3, 4e-5, 22.4e3, 22.9e3, 0.85, 0.85])
    found = signals.residual(theta, PLATE.half_spacing).std(axis=0)
    np.testing.assert_allclose(found, motion.force_noise([1e-6, 1e-6]), rtol=4 / np.sqrt(2 * 800) + 0.01)


def test_what_the_drive_bends_of_the_glass_is_no_force():
    """To what kernels that end at 5 spreads leave of the terms of the balance, see `test_kernels_differentiate`."""
    bends = {"bending_frequency": 1250.0, "bending_coil": 0.1, "bending_damping": 1 / 60}
    plate = PlateParameters(**bends, sensor_noise=0.0, sensor_bits=0)
    drive, spread = open_loop(np.arange(10_000) / RATE, np.array([31.0, 111.0, 170.0, 261.0])), spread_of(100.0)
    sensed = Plate(plate, hr.Finger.absent(), seed=1).run(drive).sensed
    k, b, m = (matrix[0, 0] for matrix in (plate.stiffness_matrix, plate.damping_matrix, plate.mass_matrix))
    left = 27 * np.exp(-12.5) * (k + b / spread + m / spread**2) * np.abs(sensed).max()
    for model, good in ((plate, True), (PLATE, False)):
        signals = MotionFilter(model, RATE, spread).update(drive, sensed)
        theta = np.array([32e-3, 4e-5, 22.4e3, 22.9e3, 0.85, 0.85])
        residual = signals.residual(theta, plate.half_spacing)[5000:]
        assert (np.abs(residual).max() < left) == good


def run(finger, seconds, **changes):
    """Drive (A) at rest and measurement (m) of a plate under a finger."""
    drive = np.zeros((round(seconds * RATE), 2))
    parameters = PlateParameters.with_overrides(changes)
    return drive, Plate(parameters, finger, seed=7).run(drive).sensed


def tracked(tracker, drive, sensed, block=5000):
    starts = range(0, len(drive), block)
    parts = [tracker.update(drive[i : i + block], sensed[i : i + block]) for i in starts]
    names = {"load": "normal_load", "position": "position", "velocity": "velocity"}
    found = {"time": np.concatenate([each.time for each in parts])}
    found["contact"] = np.concatenate([each.contact for each in parts])
    for name, long in names.items():
        found[name] = np.concatenate([getattr(each, long).value for each in parts])
        found[f"{name}_error"] = np.concatenate([getattr(each, long).standard_error for each in parts])
    return found


@pytest.mark.parametrize("blocks", [[1, 2, 64, 333, 9600], [10_000]])
def test_any_split_into_blocks_gives_the_same(blocks):
    finger = hr.Finger.swiping(frequency=1.5, speed=0.1, normal_load=0.5, touches=[(0.7, 1.4)])
    drive, sensed = run(finger, 2.0)
    whole = tracked(hr.FingerTracker(PLATE), drive, sensed, len(drive))
    tracker, parts, edges = hr.FingerTracker(PLATE), [], np.cumsum([0, *blocks])
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        parts.append(tracker.update(drive[first:last], sensed[first:last]))
    assert sum(len(each.time) for each in parts) == len(drive) - tracker.latency
    np.testing.assert_array_equal(np.concatenate([each.contact for each in parts]), whole["contact"])
    for name, series in (("load", "normal_load"), ("position", "position"), ("velocity", "velocity")):
        split = np.concatenate([getattr(each, series).value for each in parts])
        np.testing.assert_allclose(split, whole[name], rtol=1e-6, atol=1e-5 * np.nanmax(whole[name]))


@pytest.mark.parametrize("lookahead", [0.0, 0.02, 1.0])
def test_bandwidth_and_latency_are_as_predicted(lookahead):
    """At the stated frequencies half of the power of a changing load, and of a moving finger's velocity, passes."""
    tracker = hr.FingerTracker(PLATE, lookahead=lookahead)
    ideal = {"sensor_noise": 0.0, "sensor_bits": 0}
    times = np.arange(0, 12.5, 2e-4)
    for of_load, frequency in zip((True, False), tracker.bandwidth, strict=True):
        wave = np.cos(2 * np.pi * frequency * times)
        load = (times.tolist(), (1.0 + 0.2 * wave).tolist())
        place = hr.Finger.sampled(0.005 * wave, times=times, normal_load=1.0)
        drive, sensed = run(hr.Finger.still(position=0.0, normal_load=load) if of_load else place, 12.5, **ideal)
        found = tracked(hr.FingerTracker(PLATE, lookahead=lookahead, noise=[1e-6, 1e-6]), drive, sensed)
        periods = int(frequency * 10)
        at = slice(10_000, 10_000 + round(periods / frequency * RATE))
        signal = found["load"] if of_load else found["velocity"]
        amplitude = abs(phasor(signal[at], frequency)) / (0.2 if of_load else 2 * np.pi * frequency * 0.005)
        assert amplitude == pytest.approx(np.sqrt(0.5), rel=0.01)  # a frequency is stated to 0.05 Hz: 0.4 % of gain
    assert len(found["time"]) == len(drive) - tracker.latency


def test_position_is_undefined_under_a_load_that_is_too_small():
    """The error of the position grows as 1/load; from `least_load` on it is below 1 mm."""
    for load in (0.04, 1.5 * hr.FingerTracker(PLATE).least_load(10e-3, 1e-3)):
        finger = hr.Finger.still(position=10e-3, normal_load=load, touches=[(1.0, 4.0)])
        found = tracked(hr.FingerTracker(PLATE), *run(finger, 4.0))
        at = (found["time"] > 1.2) & (found["time"] < 3.9)
        errors = found["position_error"][at]
        assert np.nanmedian(errors) > 1e-3 if load == 0.04 else np.nanmedian(errors) < 1e-3


def test_threshold_of_contact_is_that_of_the_noise():
    """False once in a thousand times ten minutes of 200 Hz noise; a touch below it is no contact, one above it is."""
    assert clear_sigmas(200.0) == pytest.approx(5.76, abs=0.01)
    tracker = hr.FingerTracker(PLATE)
    for share in (0.6, 1.5):
        load = share * tracker.threshold
        finger = hr.Finger.still(position=0.0, normal_load=load, touches=[(1.0, 3.0)])
        found = tracked(hr.FingerTracker(PLATE), *run(finger, 3.5))
        assert (found["contact"] == LOADED).any() == (share > 1.0)


def test_at_the_least_rate_the_kernels_hold_the_load():
    """Of a displacement at rest: sums of g and g'' are 1 + e and -(2 pi rate)^2 e, e = 2 exp(-2 (pi spread rate)^2)."""
    spread, k, m = spread_of(100.0), PLATE.stiffness_1 + PLATE.stiffness_2, PLATE.mass
    for rate, bound in ((LEAST_RATE, 0.003), (400.0, 0.03)):
        sums = derivative_kernels(spread, rate).sum(axis=1)
        e = 2 * np.exp(-2 * (np.pi * spread * rate) ** 2)
        off = (k * sums[0] + m * sums[2]) / k - 1
        assert off == pytest.approx(e * (1 - m / k * (2 * np.pi * rate) ** 2), rel=0.02)  # e^4 and the ends left out
        assert 0.5 * bound < -off < bound


def test_measurements_that_are_no_numbers_are_held():
    finger = hr.Finger.still(position=5e-3, normal_load=0.5, touches=[(0.5, 1.5)])
    drive, sensed = run(finger, 2.0)
    sensed[[100, 3000, 3001], [0, 1, 1]] = np.nan, np.inf, np.nan
    drive = np.array(drive)
    drive[200, 0] = np.nan
    found = tracked(hr.FingerTracker(PLATE), drive, sensed)
    at = (found["time"] > 0.7) & (found["time"] < 1.4)
    assert (np.abs(found["load"][at] - 0.5) < 0.02).all()
    assert np.isfinite(found["load"][found["time"] > 1.6]).all()


@pytest.mark.parametrize(("left", "ends"), [(0.0, True), (0.04, True), (0.1, False)])
def test_a_suspension_that_creeps_under_a_touch(left, ends):
    """A lift may leave 4 % of the load, which is then the zero; 10 % are a lighter touch."""
    finger = hr.Finger.still(position=5e-3, normal_load=1.0, touches=[(1.0, 3.0), (4.0, 4.5)])
    drive, sensed = run(finger, 5.0)
    time = np.arange(len(drive)) / RATE
    sensed[time >= 1.0] -= left * 1.0 / PLATE.stiffness_matrix[0, 0] * np.minimum(time[time >= 1.0] - 1.0, 1.0)[:, None]
    found = tracked(hr.FingerTracker(PLATE), drive, sensed)
    loaded = found["contact"] == LOADED
    assert loaded[(found["time"] > 3.01) & (found["time"] < 3.99)].any() != ends
    if ends:
        assert not loaded[found["time"] > 4.51].any()
        again = (found["time"] > 4.1) & (found["time"] < 4.4)
        assert (np.abs(found["load"][again] - 1.0) < 0.02).all()
