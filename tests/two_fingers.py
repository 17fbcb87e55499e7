"""A third party's plate under any number of resting fingers; of the library it knows `Sensed` alone.

With q = [x_c, a theta, x_1, x_2 ...] (heave and rocking at the coils, then the phalanx of each finger), h = [1, p/a] at
a finger and s whether it touches, M q'' + C q' + K q = B i - sum s W h; a finger adds m h h^T to M, and b and k between
h q and its phalanx to C and K.  The exact step of each set of touching fingers comes from a matrix exponential.
"""

import numpy as np
from scipy.linalg import expm

import hapticrender as hr

MASS, INERTIA, STIFFNESS, DAMPING, FORCE, ARM = 32e-3, 4e-5, (22.4e3, 22.9e3), 0.85, 7.4, 27.5e-3
SIDES = np.array([[1.0, -1.0], [1.0, 1.0]])
LIGHT, HEAVY = (0.2e-3, 1.5, 1e3, 4e-3, 1.0, 200.0), (0.2e-3, 8.0, 8e3, 4e-3, 1.5, 300.0)  # Table 1 of the paper


class TwoFingers:
    """Fingers are (mechanics, position m, load N, on s, off s); the position of the first one is reported, or `place`.

    `wrong` is a factor on the plate's stiffness; `senses` False leaves the controller without sensors.
    """

    drive_channels, block, delay, rate, probe = 2, 1, 1, 5000.0, False

    def __init__(self, *fingers, wrong=1.0, place=None, senses=True, noise=1e-6, seed=0):
        self.fingers, self.wrong, self.place, self.noise = fingers, wrong, place, noise
        self.sensed_channels, self.rng = 2 * senses, np.random.default_rng(seed)
        self.state, self.truth, self.steps = np.zeros(4 + 2 * len(fingers)), [], {}

    def step(self, touching):
        """Phi and Gamma (currents, load) over a sample."""
        if touching in self.steps:
            return self.steps[touching]
        n = 2 + len(self.fingers)
        m, c, k, b = np.eye(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 3))
        m[:2, :2], c[:2, :2] = np.diag([MASS, INERTIA / ARM**2]), SIDES.T @ SIDES * DAMPING
        k[:2, :2], b[:2, :2] = self.wrong * SIDES.T @ np.diag(STIFFNESS) @ SIDES, FORCE * SIDES.T
        for i, (mechanics, place, load, *_) in enumerate(self.fingers):
            skin, damping, stiffness, m[2 + i, 2 + i], c[2 + i, 2 + i], k[2 + i, 2 + i] = mechanics
            h, stretch = np.zeros(n), np.zeros(n)
            h[:2] = stretch[:2] = 1.0, place / ARM
            stretch[2 + i] = -1.0
            m += touching[i] * skin * np.outer(h, h)
            c += touching[i] * damping * np.outer(stretch, stretch)
            k += touching[i] * stiffness * np.outer(stretch, stretch)
            b[:, 2] -= touching[i] * load * h
        flow = np.zeros((2 * n + 3, 2 * n + 3))
        flow[:n, n : 2 * n], flow[n : 2 * n] = np.eye(n), np.linalg.solve(m, np.hstack([-k, -c, b]))
        found = expm(flow / self.rate)[: 2 * n]
        self.steps[touching] = found[:, : 2 * n], found[:, 2 * n :]
        return self.steps[touching]

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def play(self, drive):
        time = len(self.truth) / self.rate
        touching = tuple(on <= time < off for *_, on, off in self.fingers)
        phi, gamma = self.step(touching)
        heave, rocking = self.state[:2]
        self.truth.append((heave, heave - 2 * rocking, heave + 2 * rocking))
        sensed = np.array([self.truth[-1][1:]]) + self.noise * self.rng.standard_normal((1, 2))
        sensed = (2e-3 / 2**14 * np.round(sensed / (2e-3 / 2**14)))[:, : self.sensed_channels]
        self.state = phi @ self.state + gamma @ np.append(drive[0], 1.0)
        first = self.fingers[0]
        place = np.nan if not touching[0] else first[1] if self.place is None else self.place
        return hr.Sensed(sensed, np.array([place]), normal_load=np.array([touching[0] * first[2]]))

    def error(self, reference, start, stop):
        """Deviation of the motion from the reference in the middle and at both ends, of the reference, rms."""
        rows = slice(round(start * self.rate), round(stop * self.rate))
        motion, wanted = np.array(self.truth)[rows], reference[rows]
        return ((motion - motion.mean(axis=0)) - wanted[:, None]).std(axis=0) / wanted.std()
