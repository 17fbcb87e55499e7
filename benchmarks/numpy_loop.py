"""The same closed loop in plain numpy, vectorised over bands: reference of the benchmark and twin of the kernels.

It follows hapticrender/control/kernels.py for fixed carriers with constant
targets and hapticrender/plants/vibrotactile.py without a finger, and shares
no code with either: the plate is stepped with scipy's matrix exponential.
"""

import numpy as np
from scipy.linalg import expm


class NumpyPolar:
    """Paper's controller, one numpy expression a line; arrays are (coordinates, bands)."""

    def __init__(self, tables):
        self.listen, self.speak, self.numbers = tables.listen, tables.speak, tables.numbers
        self.frequency, _, phase, re, im = tables.tone
        wanted = re + 1j * im
        coordinates, bands = len(tables.gain), len(wanted)
        self.turns = phase.copy()
        self.s = np.zeros((2, coordinates, bands), complex)
        self.amplitude = np.zeros((2, coordinates, bands))
        self.angle = np.zeros((2, coordinates, bands))
        at = self.frequency / self.numbers.table_step
        self.gain = np.array([np.interp(at, np.arange(row.size), row) for row in tables.gain])
        self.unit = np.exp(1j * np.angle(wanted))
        self.wanted = abs(wanted)

    def step(self, sensed):
        carrier = np.exp(2j * np.pi * self.turns)
        self.turns = np.mod(self.turns + self.frequency / self.numbers.rate, 1.0)
        y = (self.listen @ sensed)[:, None]
        b0, b1, b2, a1, a2 = self.numbers.filter
        u = 2.0 * y * carrier.conj()
        x = b0 * u + self.s[0]
        self.s = np.stack([b1 * u - a1 * x + self.s[1], b2 * u - a2 * x])
        lag = np.angle(x * self.unit.conj())
        lag = np.where(lag > np.pi / 2, lag - 2 * np.pi, lag)
        b0, b1, b2, a1, a2 = self.numbers.law
        theta = b0 * -lag + self.angle[0]
        self.angle = np.stack([b1 * -lag - a1 * theta + self.angle[1], b2 * -lag - a2 * theta])
        error = self.wanted - abs(x)
        command = np.maximum(b0 * error + self.amplitude[0], 0.0)
        self.amplitude = np.stack([b1 * error - a1 * command + self.amplitude[1], b2 * error - a2 * command])
        force = (command / self.gain * (self.unit * carrier * np.exp(1j * theta)).real).sum(axis=1)
        limit = self.numbers.drive_limit
        return np.clip(self.speak @ force, -limit, limit)


class NumpyPlate:
    """Free plate, ideal electronics apart from the given noise."""

    def __init__(self, parameters):
        inverse = np.linalg.inv(parameters.mass_matrix)
        a = np.zeros((6, 6))
        a[:2, 2:4] = np.eye(2)
        a[2:4, :2] = -inverse @ parameters.stiffness_matrix
        a[2:4, 2:4] = -inverse @ parameters.damping_matrix
        a[2:4, 4:] = inverse @ parameters.force_from_drive
        self.step_matrix = expm(a / parameters.rate)[:4]
        reach = parameters.glass_length / parameters.coil_spacing
        self.sense_matrix = np.array([[1.0, -reach], [1.0, reach]])
        self.state = np.zeros(6)

    def sense(self):
        return self.sense_matrix @ self.state[:2]

    def advance(self, current):
        self.state[4:] = current
        self.state[:4] = self.step_matrix @ self.state


def run(controller, plate, samples, noise):
    """Drive and sensed motion (samples, 2) of plate and controller in a loop with one sample of delay."""
    drive = np.zeros((samples, 2))
    sensed = np.zeros((samples, 2))
    last = np.zeros(2)
    for n in range(samples):
        sensed[n] = plate.sense() + noise[n]
        plate.advance(last)
        drive[n] = last
        last = controller.step(sensed[n])
    return drive, sensed
