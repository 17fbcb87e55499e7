"""Polar and complex control as one would first write them, many cases at once, in numpy alone.

Arrays are (cases, bands) or (cases, 2, bands); every case has a plate of its own. Each option is one mistake; the
defaults are the choices that do not fail.
"""

from collections import namedtuple

import numpy as np
from naive_plate import B1, B2, FORCE_CONSTANT, INERTIA, K1, K2, M_PLATE, SPACING, continuous
from scipy.linalg import expm
from scipy.signal import bilinear, butter

RATE, LIMIT = 5000.0, 3.0
SIDES = np.array([[1.0, -SPACING / 2], [1.0, SPACING / 2]])
MASS = np.diag([M_PLATE, INERTIA])
DAMPING, STIFFNESS = (SIDES.T @ np.diag(pair) @ SIDES for pair in ((B1, B2), (K1, K2)))
INPUT = FORCE_CONSTANT * SIDES.T


class Section:
    """Second-order section on arrays: y = b x - a y."""

    def __init__(self, b, a, shape, dtype=complex):
        self.b, self.a, self.s1, self.s2 = b, a, np.zeros(shape, dtype), np.zeros(shape, dtype)

    def __call__(self, x, limit=None):
        y = self.b[0] * x + self.s1
        y = y if limit is None else np.maximum(y, limit)
        self.s1 = self.b[1] * x - self.a[1] * y + self.s2
        self.s2 = self.b[2] * x - self.a[2] * y
        return y


def law(loop, low):
    """The paper's controller ki p/(s (s + p)) for a loop and a low pass of these bandwidths (Hz)."""
    wt, wl = 2 * np.pi * loop, 2 * np.pi * low
    ki, p = wt * wl / (np.sqrt(2) * (wt + wl)), np.sqrt(2) * wt * wl / (wl - wt)
    return bilinear([ki * p], [1, p, 0], RATE)


NO_FINGER = namedtuple("Finger", "order phalanx_mass phalanx_damping phalanx_stiffness")(0, 0.0, 0.0, 0.0)


class Plates:
    """One plate a case, with one sample of delay and `late` more; sensed and true are (centre, angle)."""

    def __init__(self, cases, late=0, finger=None):
        a, b, _ = continuous(**(finger or {"finger": NO_FINGER}))
        n = len(a)
        step = expm(np.block([[a, b[:, :2]], [np.zeros((2, n + 2))]]) / RATE)
        self.step, self.push = step[:n, :n].T, step[:n, n:].T
        self.state, self.line = np.zeros((cases, n)), [np.zeros((cases, 2))] * (1 + late)

    def advance(self, drive):
        self.line.append(np.clip(drive, -LIMIT, LIMIT))
        self.state = self.state @ self.step + self.line.pop(0) @ self.push


def polar(frequency, wanted, samples, *, clamp=True, relative=True, faster=1.0, late=0):
    """Amplitude and phase loops on heave with a look-up gain; true motion of the centre (samples, cases), phase angle.

    `frequency` (cases, bands) Hz; `wanted` (cases, bands), or a function of the sample.
    """
    frequency = np.atleast_2d(np.asarray(frequency, float))
    plates, low = Plates(len(frequency), late), butter(2, 10 * faster, fs=RATE)
    estimate, amplitude, angle = (
        Section(*pair, frequency.shape, kind)
        for pair, kind in ((low, complex), (law(5 * faster, 10 * faster), float), (law(5 * faster, 10 * faster), float))
    )
    s = 2j * np.pi * frequency[..., None, None]
    gain = abs(np.linalg.solve(MASS * s**2 + DAMPING * s + STIFFNESS, (INPUT @ [1, 1])[:, None])[..., 0, 0])
    motion, turn = np.zeros((samples, len(frequency))), frequency / RATE
    for n in range(samples):
        carrier = np.exp(2j * np.pi * (n * turn % 1))
        target = wanted(n) if callable(wanted) else wanted
        motion[n] = plates.state[:, 0]
        x = estimate(2 * motion[n][:, None] * carrier.conj())
        miss = np.angle(target * x.conj()) if relative else np.angle(target) - np.angle(x)
        theta = angle(miss)
        command = amplitude(abs(target) - abs(x), 0.0 if clamp else None)
        drive = (command / gain * (carrier * np.exp(1j * theta)).real).sum(axis=1)
        plates.advance(np.stack([drive, drive], axis=1))
    return motion, theta


def complex_inverse(frequency, wanted, samples, *, slope=True, filtered=True, forward=1.0, twist=0.0, delay=1, late=0,
                    finger=None):  # fmt: skip
    """2 x 2 envelopes through D of the free plate: sum of D V + D' V'; true (centre, angle), (samples, cases, 2).

    `delay` is the delay (samples) that the inverse compensates, `late` what the plate has beyond one sample.
    """
    frequency = np.atleast_2d(np.asarray(frequency, float))
    shape = (len(frequency), 2, frequency.shape[1])
    plates, low, loop = Plates(len(frequency), late, finger), butter(2, 10, fs=RATE), law(5, 10)
    estimate, feedback, reference = (Section(*pair, shape) for pair in (low, loop, low))
    w = 2 * np.pi * frequency[:, None, None, :]
    matrix = [each[None, :, :, None] for each in (MASS, DAMPING, STIFFNESS)]
    stiffness = matrix[2] + 1j * w * matrix[1] - w**2 * matrix[0]
    change = (matrix[1] + 2j * w * matrix[0]) * RATE * slope
    ahead = np.exp(1j * (2 * np.pi * frequency * (delay + 0.5) / RATE + np.reshape(twist, (-1, 1))))
    ahead = ahead / np.sinc(frequency / RATE)
    inverse, last, turn = np.linalg.inv(INPUT).T, np.zeros(shape, complex), frequency / RATE
    motion = np.zeros((samples, len(frequency), 2))
    for n in range(samples):
        carrier = np.exp(2j * np.pi * (n * turn % 1))
        target = np.zeros(shape, complex)
        target[:, 0] = wanted(n) if callable(wanted) else wanted
        motion[n] = plates.state[:, :2]
        x = estimate(2 * motion[n][:, :, None] * carrier.conj()[:, None])
        delayed = reference(target)
        v = feedback((delayed if filtered else target) - x) + forward * target
        force = (stiffness * v[:, None]).sum(axis=2) + (change * (v - last)[:, None]).sum(axis=2)
        last = v
        plates.advance((force * (ahead * carrier)[:, None]).real.sum(axis=2) @ inverse)
    return motion
