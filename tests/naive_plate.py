"""A slow, obvious twin of the compiled plate: dense matrices and scipy's expm, importing nothing under test."""

import numpy as np
from scipy.linalg import expm

M_PLATE, INERTIA, SPACING, REACH = 32e-3, 4e-5, 55e-3, 55e-3
K1, K2, B1, B2, FORCE_CONSTANT = 22.4e3, 22.9e3, 0.85, 0.85, 7.4


def continuous(position=0.0, skin=(0.0, 0.0, 0.0), phalanx=None):
    """A (n, n) and B (n, 3) of x' = A x + B [i1, i2, W] with x = [x_c, theta (rad), (x_p), and rates]."""
    h = np.array([1.0, position])
    coils = np.array([[1.0, 1.0], [-SPACING / 2, SPACING / 2]])
    sides = np.array([[1.0, -SPACING / 2], [1.0, SPACING / 2]])
    mass = np.diag([M_PLATE, INERTIA]) + skin[0] * np.outer(h, h)
    damping = sides.T @ np.diag([B1, B2]) @ sides + skin[1] * np.outer(h, h)
    stiffness = sides.T @ np.diag([K1, K2]) @ sides + skin[2] * np.outer(h, h)
    if phalanx is not None:
        link = np.append(h, -1.0)
        blank = np.zeros((3, 3))
        blank[:2, :2] = np.diag([M_PLATE, INERTIA]) + skin[0] * np.outer(h, h)
        blank[2, 2] = phalanx[0]
        mass = blank
        big_c, big_k = np.zeros((3, 3)), np.zeros((3, 3))
        big_c[:2, :2] = sides.T @ np.diag([B1, B2]) @ sides
        big_k[:2, :2] = sides.T @ np.diag([K1, K2]) @ sides
        damping = big_c + skin[1] * np.outer(link, link) + np.diag([0, 0, phalanx[1]])
        stiffness = big_k + skin[2] * np.outer(link, link) + np.diag([0, 0, phalanx[2]])
    n = len(mass)
    force = np.zeros((n, 3))
    force[:2, :2] = FORCE_CONSTANT * coils
    force[:2, 2] = -h
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    return a, np.vstack([np.zeros((n, 3)), inverse @ force])


def simulate(drive, load, rate, **finger):
    """Centre and end displacements (m) at the start of each held sample, finger fixed."""
    a, b = continuous(**finger)
    n = len(a)
    step = expm(np.block([[a, b], [np.zeros((3, n + 3))]]) / rate)
    state = np.zeros(n)
    motion = np.zeros((len(drive), 3))
    for i, row in enumerate(drive):
        motion[i] = state[0], state[0] - REACH * state[1], state[0] + REACH * state[1]
        state = step[:n, :n] @ state + step[:n, n:] @ np.append(row, load)
    return motion


def simulate_moving(drive, position, load, strength, finger, rate):
    """The same with a 4th-order finger whose place, load and grip (a factor on m, b and k) change with every sample."""
    state = np.zeros(6)  # x_c, theta, x_p, and rates
    motion = np.zeros((len(drive), 3))
    for i, row in enumerate(drive):
        motion[i] = state[0], state[0] - REACH * state[1], state[0] + REACH * state[1]
        if strength[i] > 0:
            scale = strength[i]
            skin = scale * np.array([finger.mass, finger.damping, finger.stiffness])
            phalanx = scale * np.array([finger.phalanx_mass, finger.phalanx_damping, finger.phalanx_stiffness])
            a, b = continuous(position[i], skin, phalanx)
            keep, push = slice(None), np.append(row, load[i])
        else:
            a, b = continuous()
            state[[2, 5]] = 0.0
            keep, push = [0, 1, 3, 4], np.append(row, 0.0)
        n = len(a)
        step = expm(np.block([[a, b], [np.zeros((3, n + 3))]]) / rate)
        state[keep] = step[:n, :n] @ state[keep] + step[:n, n:] @ push
    return motion
