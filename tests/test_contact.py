"""The sliding contact: lag and tribometer against their closed forms, and what sticks, lifts or clips."""

import numpy as np
import pytest
from waves import phasor

from hapticrender.inferred import ContactLag
from hapticrender.jit import kernel
from hapticrender.plants.sliding_contact import SlidingParameters, sliding_record, sliding_step

QUIET = SlidingParameters(force_noise=0.0)
SPEEDS = [5e-3, 40e-3, 160e-3]


@kernel
def _run(record, steady, speed, noise, out):
    for n in range(steady.shape[0]):
        out[n, 0], out[n, 1] = sliding_step(record[0], steady[n], speed[n], noise[n])


def run(steady, speed, parameters=QUIET, noise=None):
    """Friction and measured friction, shape (n, 2)."""
    steady = np.asarray(steady, float)
    speed = np.broadcast_to(np.asarray(speed, float), steady.shape).copy()
    noise, out = np.zeros(steady.size) if noise is None else noise, np.empty((steady.size, 2))
    _run(sliding_record(parameters), steady, speed, noise, out)
    return out


def measured(frequency, speed):
    """Responses at `frequency` (whole Hz) to a steady friction of 1 N: over the second of two seconds."""
    time = np.arange(2 * int(QUIET.rate)) / QUIET.rate
    out = run(np.cos(2 * np.pi * frequency * time), speed)[time >= 1.0]
    return phasor(out, frequency, QUIET.rate)


@pytest.mark.parametrize(("frequency", "speed"), [(20.0, 5e-3), (170.0, 40e-3), (400.0, 160e-3)])
def test_measured_responses_are_the_predicted_ones(frequency, speed):
    """The start dies away by exp(-69) (lag at 5 mm/s: exp(-435)) in a second; the rest is rounding of 1e4 terms."""
    friction, sensed = measured(frequency, speed)
    assert friction == pytest.approx(QUIET.lag_response(frequency, speed), rel=1e-9)
    assert sensed == pytest.approx(
        QUIET.lag_response(frequency, speed) * QUIET.tribometer_response(frequency), rel=1e-9
    )


@pytest.mark.parametrize("speed", SPEEDS)
def test_the_lag_is_first_order_behind_a_hold(speed):
    """Hold and lag delay by T/2 + T/x, x = |v| T/delta; sampled, by T/(1 - exp(-x)) = T/x + T/2 + x T/12 - ..."""
    frequency = np.array([20.0, 100.0, 400.0])
    angle, renewed = 2 * np.pi * frequency / QUIET.rate, speed / (QUIET.rate * QUIET.memory_length)
    hold = np.sinc(frequency / QUIET.rate) * np.exp(-0.5j * angle)
    cutoff = speed / (2 * np.pi * QUIET.memory_length)
    first_order = hold / (1 + 1j * frequency / cutoff)
    error = abs(QUIET.lag_response(frequency, speed) / first_order - 1)
    assert np.all(error < angle * (renewed + angle) / 12)  # the next order is that of the straight line


def test_tribometer_is_flat_within_half_a_decibel_up_to_400_hz():
    """As Grigorii et al. 2021; and it is the second-order resonance to the error of the straight line, (w T)^2/12."""
    frequency = np.linspace(20.0, 400.0, 200)
    response = QUIET.tribometer_response(frequency)
    assert abs(20 * np.log10(abs(response))).max() < 0.5
    ratio = frequency / QUIET.tribometer_frequency
    exact = 1 / (1 - ratio**2 + 2j * QUIET.tribometer_damping * ratio)
    assert np.all(abs(response / exact - 1) < 1.02 * (2 * np.pi * frequency / QUIET.rate) ** 2 / 12)
    barely = SlidingParameters(tribometer_damping=0.39)
    assert 20 * np.log10(abs(barely.tribometer_response(400.0))) > 0.5


def test_a_slow_contact_sticks_and_keeps_its_friction():
    steady = np.r_[np.ones(3000), np.zeros(3000)]
    speed = np.r_[np.full(3000, 0.05), np.full(3000, 0.99e-3)]
    held = run(steady, speed)
    assert held[-1, 0] == held[3000, 0] == pytest.approx(1.0, rel=1e-12)
    speed[3000:] = -1.01e-3  # slides, backwards
    passed = np.exp(-1.01e-3 * 2999 / QUIET.rate / QUIET.memory_length)
    assert run(steady, speed)[-1, 0] == pytest.approx(passed, rel=1e-9)


def test_a_lifted_finger_has_no_friction():
    speed = np.full(6000, 0.05)
    speed[3000:] = np.nan
    out = run(np.ones(6000), speed)
    assert out[3000, 0] > 0.99
    assert not out[3001:, 0].any()
    assert abs(out[-1, 1]) < 1e-9
    assert np.isfinite(out).all()


def test_tribometer_noise_resolution_and_range():
    noise = np.random.default_rng(5).standard_normal(20_000)
    sensed = run(np.zeros(20_000), 0.0, SlidingParameters(), noise=noise)[:, 1]
    assert sensed.std() == pytest.approx(1e-3, rel=3 / np.sqrt(2 * 20_000))  # three standard deviations of it
    coarse = SlidingParameters(force_noise=0.0, force_range=0.8, force_bits=4)
    sensed = run(np.ones(3000), 0.05, coarse)[:, 1]
    assert sensed.max() == 0.8
    np.testing.assert_allclose(sensed / 0.1, np.round(sensed / 0.1), atol=1e-12)


LENGTH, SPEED, RATE = 12e-6, 0.05, 12e3


@pytest.mark.parametrize("sizes", [[1] * 600, [25] * 24, [600]])
def test_a_ramp_is_followed_late_by_the_length_over_the_speed(sizes):
    """u = t gives y = t - tau + tau exp(-t/tau), tau = length/speed, however it is split."""
    time, lag, parts = np.arange(600) / RATE, ContactLag(LENGTH), []
    for part in np.split(time, np.cumsum(sizes)[:-1]):
        parts.append(lag.run(part[:, None], SPEED * part))
    tau = LENGTH / SPEED
    np.testing.assert_allclose(np.concatenate(parts)[:, 0], time - tau * -np.expm1(-time / tau), rtol=1e-9, atol=1e-15)


def test_a_lifted_finger_leaves_nothing_and_a_resting_one_changes_nothing():
    position = np.r_[0.0, np.nan, 0.01, np.full(3, 0.01)]
    values = np.array([1.0, 0.0, 5.0, 7.0, 9.0, 9.0])[:, None]
    np.testing.assert_allclose(ContactLag(LENGTH).run(values, position)[:, 0], [1.0, 0.0, 5.0, 5.0, 5.0, 5.0])
    np.testing.assert_array_equal(ContactLag(0.0).run(values, position), values)
