"""The paper's controller and the free plate in plain numpy, vectorised over bands: reference and twin of the kernels.

Grigorii et al. 2021: amplitude and phase loops on the STDFT* of each side, for fixed carriers and constant targets.
Nothing of the library is imported; the plate's numbers are those of the paper.
"""

import numpy as np
from scipy.linalg import expm
from scipy.signal import bilinear, butter

MASS, INERTIA, SPACING, LENGTH = 32e-3, 4e-5, 55e-3, 110e-3  # kg, kg m2, m, m
STIFFNESS, DAMPING, FORCE = np.array([22.4e3, 22.9e3]), np.array([0.85, 0.85]), 7.4  # N/m, N s/m, N/A
SIDES = np.array([[1.0, -SPACING / 2], [1.0, SPACING / 2]])  # displacement of each side from (centre, angle)
LOOP, FILTER = 5.0, 10.0  # Hz


def matrices():
    """Mass, damping, stiffness and input matrix of (centre, angle)."""
    return (
        np.diag([MASS, INERTIA]), SIDES.T @ np.diag(DAMPING) @ SIDES, SIDES.T @ np.diag(STIFFNESS) @ SIDES,
        FORCE * SIDES.T,
    )  # fmt: skip


def controller_section(rate):
    """Second-order reduction ki p/(s (s + p)) of T/(1 - L T), with T of 5 Hz and L of 10 Hz, both Butterworth."""
    wt, wl = 2 * np.pi * LOOP, 2 * np.pi * FILTER
    ki, p = wt * wl / (np.sqrt(2) * (wt + wl)), np.sqrt(2) * wt * wl / (wl - wt)
    return bilinear([ki * p], [1, p, 0], rate)


class NumpyPolar:
    """The paper's controller, one numpy expression a line; arrays are (sides, bands)."""

    def __init__(self, frequency, phase, target, rate=5000.0, law=None, limit=np.inf):
        self.frequency, self.turns, self.rate, self.limit = (
            np.asarray(frequency),
            np.array(phase) / 2 / np.pi,
            rate,
            limit,
        )
        self.filter = butter(2, FILTER, fs=rate)
        self.law = controller_section(rate) if law is None else law
        mass, damping, stiffness, force = matrices()
        s = 2j * np.pi * self.frequency[:, None, None]
        together = np.linalg.solve(mass * s**2 + damping * s + stiffness, (force @ [1.0, 1.0])[:, None])[..., 0]
        self.gain = abs(together @ SIDES.T).T * np.sinc(self.frequency / rate)  # as a sweep of the plate shows it
        self.listen = SIDES @ np.linalg.inv([[1.0, -LENGTH / 2], [1.0, LENGTH / 2]])
        self.unit, self.target = np.exp(1j * np.angle(target)), np.abs(target)
        self.low = np.zeros((2, 2, len(self.frequency)), complex)
        self.amplitude, self.angle = np.zeros((2, 2, 2, len(self.frequency)))

    def step(self, sensed):
        carrier = np.exp(2j * np.pi * self.turns)
        self.turns = np.mod(self.turns + self.frequency / self.rate, 1.0)
        (b0, b1, b2), (_, a1, a2) = self.filter
        u = 2.0 * (self.listen @ sensed)[:, None] * carrier.conj()
        x = b0 * u + self.low[0]
        self.low = np.stack([b1 * u - a1 * x + self.low[1], b2 * u - a2 * x])
        lag = np.angle(x * self.unit.conj())
        lag = np.where(lag > np.pi / 2, lag - 2 * np.pi, lag)
        (b0, b1, b2), (_, a1, a2) = self.law
        theta = b0 * -lag + self.angle[0]
        self.angle = np.stack([b1 * -lag - a1 * theta + self.angle[1], b2 * -lag - a2 * theta])
        error = self.target - abs(x)
        command = np.maximum(b0 * error + self.amplitude[0], 0.0)
        self.amplitude = np.stack([b1 * error - a1 * command + self.amplitude[1], b2 * error - a2 * command])
        drive = (command / self.gain * (self.unit * carrier * np.exp(1j * theta)).real).sum(axis=1)
        return np.clip(drive, -self.limit, self.limit)


class NumpyPlate:
    """Free plate, ideal electronics."""

    def __init__(self, rate=5000.0):
        mass, damping, stiffness, force = matrices()
        a, inverse = np.zeros((6, 6)), np.linalg.inv(mass)
        a[:2, 2:4] = np.eye(2)
        a[2:4] = inverse @ np.hstack([-stiffness, -damping, force])
        self.step_matrix = expm(a / rate)[:4]
        self.state = np.zeros(6)

    def sense(self):
        return np.array([[1.0, -LENGTH / 2], [1.0, LENGTH / 2]]) @ self.state[:2]

    def advance(self, current):
        self.state[4:] = current
        self.state[:4] = self.step_matrix @ self.state


def run(controller, plate, samples):
    """Drive and sensed displacement (samples, 2) of plate and controller in a loop with one sample of delay."""
    drive, sensed, last = np.zeros((samples, 2)), np.zeros((samples, 2)), np.zeros(2)
    for n in range(samples):
        sensed[n] = plate.sense()
        plate.advance(last)
        drive[n] = last
        last = controller.step(sensed[n])
    return drive, sensed
