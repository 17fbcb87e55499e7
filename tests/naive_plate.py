"""A slow, obvious twin of the compiled plate: dense matrices and scipy's expm, importing nothing under test."""

import functools

import numpy as np
from scipy.linalg import expm

M_PLATE, INERTIA, SPACING, REACH = 32e-3, 4e-5, 55e-3, 55e-3
K1, K2, B1, B2, FORCE_CONSTANT = 22.4e3, 22.9e3, 0.85, 0.85, 7.4
BENDING_MASS, BENDING_RATIO, BENDING_COIL = 9.5e-3, 0.01, -0.1
BETA = 2.365020372431352 / REACH  # rad/m, wavenumber of the first mode of a free bar


def bar(x):
    """Shape of the bending mode at x (m from the middle), 1 at the ends."""
    return 0.5 * (np.cosh(BETA * x) / np.cosh(BETA * REACH) + np.cos(BETA * x) / np.cos(BETA * REACH))


@functools.lru_cache(maxsize=4096)
def continuous(finger, position=0.0, strength=1.0, bending=0.0):
    """A, B and the coordinates kept of x' = A x + B [i1, i2, W], x = [x_c, theta, e, x_p] and its rates.

    `finger` has order, mass, damping, ...; `bending` is the frequency of that mode (Hz), 0: rigid glass.
    """
    order = finger.order if strength > 0 else 0
    glass = np.array([1.0, position, bar(position), 0.0])
    tissue = glass - np.array([0.0, 0.0, 0.0, 1.0 if order == 4 else 0.0])
    sides = np.array([[1.0, -SPACING / 2, 0.0, 0.0], [1.0, SPACING / 2, 0.0, 0.0]])
    omega = 2 * np.pi * bending
    mass = np.diag([M_PLATE, INERTIA, BENDING_MASS, strength * finger.phalanx_mass])
    damping = np.diag([0.0, 0.0, 2 * BENDING_RATIO * omega * BENDING_MASS, strength * finger.phalanx_damping])
    stiffness = np.diag([0.0, 0.0, omega**2 * BENDING_MASS, strength * finger.phalanx_stiffness])
    damping += sides.T @ np.diag([B1, B2]) @ sides
    stiffness += sides.T @ np.diag([K1, K2]) @ sides
    if order:
        mass += strength * finger.mass * np.outer(glass, glass)
        damping += strength * finger.damping * np.outer(tissue, tissue)
        stiffness += strength * finger.stiffness * np.outer(tissue, tissue)
    force = np.zeros((4, 3))
    force[:3, :2] = FORCE_CONSTANT * np.array([[1.0, 1.0], [-SPACING / 2, SPACING / 2], [BENDING_COIL] * 2])
    force[:, 2] = -glass
    kept = [0, 1] + [2] * (bending > 0) + [3] * (order == 4)
    inverse, n = np.linalg.inv(mass[np.ix_(kept, kept)]), len(kept)
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:, :n], a[n:, n:] = -inverse @ stiffness[np.ix_(kept, kept)], -inverse @ damping[np.ix_(kept, kept)]
    return a, np.vstack([np.zeros((n, 3)), inverse @ force[kept]]), kept


@functools.lru_cache(maxsize=4096)
def held(finger, position, strength, bending, rate):
    """Step of [x, u] over a sample with u held."""
    a, b, kept = continuous(finger, position, strength, bending)
    return expm(np.block([[a, b], [np.zeros((3, len(a) + 3))]]) / rate)[: len(a)], kept


def simulate(drive, finger, position, load, strength, rate, bending=0.0):
    """Centre and ends (m) at the start of each held sample; a finger that touches anew starts at rest."""
    state = np.zeros(8)
    motion = np.zeros((len(drive), 3))
    places = np.array([[1.0, 0.0, bar(0.0)], [1.0, -REACH, 1.0], [1.0, REACH, 1.0]])
    for i, row in enumerate(drive):
        motion[i] = places @ state[:3]
        if not strength[i] > 0:
            state[[3, 7]] = 0.0
        step, kept = held(finger, position[i] if strength[i] > 0 else 0.0, strength[i], bending, rate)
        kept = np.r_[kept, 4 + np.array(kept)]
        state[kept] = step @ np.concatenate([state[kept], row, [load[i]]])
    return motion
