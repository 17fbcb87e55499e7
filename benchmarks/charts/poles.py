"""Poles of the linear loop of the error observer: one sample of it as a matrix, beside its transfer functions."""

from __future__ import annotations

import numpy as np

from hapticrender.control.linear import ErrorLoop
from hapticrender.protocols import Array

LEAST_POLE = 1e-300  # stands for a pole at z = 0, whose logarithm is not finite


def loop_matrix(loop: ErrorLoop) -> Array:
    """State matrix of the closed loop, real, shape (s, s): one sample from every unit state."""
    n, c = loop.plant.b.shape
    count, past = len(loop.frequency), loop.taps.shape[1] - 1
    sizes = [n, loop.delay * c, 2 * c * count, 2 * c * count, c, c, past * c]
    unit = np.eye(sum(sizes))
    x, forces, eps, nu, level, drift, deviations = np.split(unit, np.cumsum(sizes)[:-1])
    eps, nu = (each[: c * count] + 1j * each[c * count :] for each in (eps, nu))
    eps, nu = (each.reshape(c, count, -1) for each in (eps, nu))
    turn, gain, fading, kept = (each[:, None] for each in loop.recursion)
    y = loop.plant.c @ x
    e, deviation = y - level - eps.real.sum(axis=1), y - nu.real.sum(axis=1)
    eps = kept * eps + gain * e[:, None]
    rate = -loop.integral * eps - fading * nu
    nu = kept * nu - loop.integral / loop.plant.rate * eps
    deviations = np.concatenate([deviation, deviations])
    force = np.einsum("kij,jks->is", loop.law, nu).real + np.einsum("kij,jks->is", loop.slope, rate).real
    force -= loop.inner * np.einsum("it,tis->is", loop.taps, deviations.reshape(past + 1, c, -1))
    eps, nu = ((turn * each).reshape(c * count, -1) for each in (eps, nu))
    x = loop.plant.a @ x + loop.plant.b @ forces[:c]
    forces = np.concatenate([forces[c:], force])
    level, drift = level + loop.dc * e + drift, drift + loop.dc_drift * e
    return np.concatenate([x, forces, eps.real, eps.imag, nu.real, nu.imag, level, drift, deviations[: past * c]])


def logarithms(z: Array, rate: float) -> Array:
    """Poles (1/s, complex: growth and angular frequency) of those at `z` and a rate (Hz)."""
    z = z.astype(complex)
    return rate * np.log(np.where(z == 0, LEAST_POLE, z))


def loop_poles(loop: ErrorLoop) -> Array:
    """Closed-loop poles (1/s, complex): growth and angular frequency."""
    return logarithms(np.linalg.eigvals(loop_matrix(loop)), loop.plant.rate)


def growth(loop: ErrorLoop) -> float:
    """Growth of the slowest-decaying pole (1/s), < 0 for a stable loop."""
    return float(loop_poles(loop).real.max())
