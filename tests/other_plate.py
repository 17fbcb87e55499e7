"""A plate behind a driver of its own, written from the equations of motion; imports no plant of the library."""

import sys

import numba
import numpy as np
from scipy.linalg import expm

import hapticrender as hr

sys.modules.setdefault("other_plate", sys.modules[__name__])  # kernels cached under this name are found under both

SPACING, REACH, FORCE_CONSTANT = 55e-3, 55e-3, 7.4  # m, m, N/A
TRUTH = {
    "mass": 32e-3,
    "inertia": 4e-5,
    "stiffness_1": 22.4e3,
    "stiffness_2": 22.9e3,
    "damping_1": 0.85,
    "damping_2": 0.85,
    "delay": 1,
    "gains": (1.0, 1.0),
}


@numba.njit(cache=True)
def advance(state, phi, gamma, push, show, drive, sensed):
    """Add what is shown of the state to each row of `sensed` (n, 2), and step over the row of drive that acts then."""
    new = np.empty(len(state))
    for n in range(len(sensed)):
        for k in range(2):
            sensed[n, k] += show[k, 0] * state[0] + show[k, 1] * state[1]
        for i in range(len(state)):
            new[i] = push[i] + gamma[i, 0] * drive[n, 0] + gamma[i, 1] * drive[n, 1]
            for j in range(len(state)):
                new[i] += phi[i, j] * state[j]
        state[:] = new


class OtherPlate:
    """Two coils, two sensors, and optionally a mass-spring-damper finger at `position` (m) with `load` (N).

    `sensors` and `coils` (2, 2) rewire it; `spoil(sample, sensed) -> Sensed` replaces a measurement.
    """

    drive_channels = sensed_channels = 2
    block = 1

    def __init__(self, argument="", *, seed=0, rate=5000.0, noise=1e-6, finger=None, load=0.0, position=0.0, **wiring):
        truth = {**TRUTH, **{name: wiring.pop(name) for name in TRUTH if name in wiring}}
        if argument:
            truth["mass"] = float(argument)
        self.truth, self.rate, self.noise = truth, rate, noise
        self.sensors, self.coils = (np.array(wiring.pop(name, np.eye(2))) for name in ("sensors", "coils"))
        self.spoil, self.delay, self.block = wiring.pop("spoil", None), wiring.pop("told", 1), wiring.pop("block", 1)
        if wiring:
            raise TypeError(f"unknown {wiring}")
        self.fingers = [(finger or (0.0, 0.0, 0.0), position, load)]
        self._design([True])
        self._show = self.sensors @ np.diag(truth["gains"]) @ [[1.0, -REACH], [1.0, REACH]]
        self._state = np.linalg.solve(np.eye(len(self._phi)) - self._phi, self._push)
        self._queue = np.zeros((max(truth["delay"] - self.block, 0), 2))
        self._rng = np.random.default_rng(seed)
        self.played, self.is_open = [], False

    def _design(self, touching):
        """Step over a sample with held currents while some of the fingers (mechanics, position m, load N) touch.

        q = [x_c, theta, phalanges]; mechanics are m, b, k, and those of a phalanx where there is one.
        """
        n, truth = 2 + len(self.fingers), self.truth
        arms = np.pad([[1.0, -SPACING / 2], [1.0, SPACING / 2]], ((0, 0), (0, n - 2)))  # sides
        m, push = np.diag([truth["mass"], truth["inertia"], *[1.0] * (n - 2)]), np.zeros(n)
        c = arms.T @ np.diag([truth["damping_1"], truth["damping_2"]]) @ arms
        k = arms.T @ np.diag([truth["stiffness_1"], truth["stiffness_2"]]) @ arms
        for i, ((mass, damping, stiffness, *phalanx), place, load) in enumerate(self.fingers, 2):
            m[i, i], c[i, i], k[i, i] = phalanx or (1.0, 0.0, 1.0)
            glass = np.eye(n)[0] + place * np.eye(n)[1]
            skin = glass - (np.eye(n)[i] if phalanx else 0.0)
            if touching[i - 2]:
                m += mass * np.outer(glass, glass)
                c += damping * np.outer(skin, skin)
                k += stiffness * np.outer(skin, skin)
                push -= load * glass
        flow = np.zeros((2 * n + 3, 2 * n + 3))
        flow[:n, n : 2 * n] = np.eye(n)
        flow[n : 2 * n] = np.linalg.solve(m, np.hstack([-k, -c, FORCE_CONSTANT * arms.T, push[:, None]]))
        step = expm(flow / self.rate)[: 2 * n]
        self._phi, self._gamma, self._push = step[:, : 2 * n], step[:, 2 * n : -1] @ self.coils, step[:, -1]

    def __enter__(self):
        self.is_open = True
        return self

    def __exit__(self, *exc):
        self.is_open = False

    def play(self, drive):
        self.played.append(drive.copy())
        acting = np.concatenate([self._queue, drive])
        self._queue = acting[self.block :]
        sensed = self.noise * self._rng.standard_normal((self.block, 2))
        advance(self._state, self._phi, self._gamma, self._push, self._show, acting, sensed)
        sensed = hr.Sensed(sensed)
        return self.spoil(len(self.played) - 1, sensed) if self.spoil else sensed
