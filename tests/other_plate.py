"""A plate behind a driver of its own, written from the equations of motion; imports no plant of the library."""

import numpy as np
from scipy.linalg import expm

import hapticrender as hr

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
        arms = np.array([[1.0, -SPACING / 2], [1.0, SPACING / 2]])  # sides from [x_c, theta]
        touch = np.array([1.0, position])
        mass, damping, stiffness = finger or (0.0, 0.0, 0.0)
        m = np.diag([truth["mass"], truth["inertia"]]) + mass * np.outer(touch, touch)
        c = arms.T @ np.diag([truth["damping_1"], truth["damping_2"]]) @ arms + damping * np.outer(touch, touch)
        k = arms.T @ np.diag([truth["stiffness_1"], truth["stiffness_2"]]) @ arms + stiffness * np.outer(touch, touch)
        flow = np.zeros((7, 7))
        flow[:2, 2:4] = np.eye(2)
        flow[2:4] = np.linalg.solve(m, np.hstack([-k, -c, FORCE_CONSTANT * arms.T, -load * touch[:, None]]))
        step = expm(flow / rate)
        self._phi, self._gamma, self._push = step[:4, :4], step[:4, 4:6] @ self.coils, step[:4, 6]
        ends = np.array([[1.0, -REACH, 0.0, 0.0], [1.0, REACH, 0.0, 0.0]])
        self._show = self.sensors @ np.diag(truth["gains"]) @ ends
        self._state = np.zeros(4)
        if load:
            self._state = np.linalg.solve(np.eye(4) - self._phi, self._push)
        self._queue = [np.zeros(2)] * (truth["delay"] - self.block)
        self._rng = np.random.default_rng(seed)
        self.played, self.is_open = [], False

    def __enter__(self):
        self.is_open = True
        return self

    def __exit__(self, *exc):
        self.is_open = False

    def play(self, drive):
        sensed = np.empty((self.block, 2))
        for i, row in enumerate(drive):
            sensed[i] = self._show @ self._state
            self._queue.append(row)
            self._state = self._phi @ self._state + self._gamma @ self._queue.pop(0) + self._push
        self.played.append(drive.copy())
        sensed += self.noise * self._rng.standard_normal(sensed.shape)
        sensed = hr.Sensed(sensed)
        return self.spoil(len(self.played) - 1, sensed) if self.spoil else sensed
