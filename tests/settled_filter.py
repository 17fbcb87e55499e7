"""Prediction of the settled motion filter: its response, its half-power frequency, and what its noise leaves."""

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from hapticrender.touch import latency_budget as budget
from hapticrender.touch.motion_estimator import transition


def frequency_response(estimator, rate, frequency, ahead=0.0, order=0):
    """Estimate over position at `frequency` (Hz, below rate/2), complex, of samples at `rate` (Hz).

    `order` 0 is the position `ahead` (s) of the last sample, which without error is ``exp(j w ahead)``; 1 the velocity
    there, per position, which is ``j w exp(j w ahead)``.
    """
    a, b = budget._system(budget.settled_gain(estimator, rate), 1.0 / rate)
    z = np.exp(2j * np.pi * np.atleast_1d(np.asarray(frequency, float)) / rate)
    states = np.linalg.solve(z[:, None, None] * np.eye(3) - a[:3, :3], z[:, None, None] * b[:3, None])
    return np.asarray(transition(ahead)[order] @ states[..., 0].T)


def bandwidth(estimator, rate):
    """Frequency (Hz) at which the position's power is down to half; rate/2 where it never is."""
    grid = np.linspace(0.0, 0.5 * rate, 4001)[1:]
    below = np.flatnonzero(abs(frequency_response(estimator, rate, grid)) ** 2 < 0.5)
    return float(grid[below[0]]) if below.size else 0.5 * rate


def noise_errors(estimator, rate, ahead=0.0):
    """Standard errors of position (m) and velocity (m/s), `ahead` (s) of the last sample, by its noise alone."""
    a, b = budget._system(budget.settled_gain(estimator, rate), 1.0 / rate)
    spread = estimator.variance * solve_discrete_lyapunov(a[:3, :3], np.outer(b[:3], b[:3]))
    position, velocity, _ = np.sqrt(np.diagonal(transition(ahead) @ spread @ transition(ahead).T)).tolist()
    return position, velocity
