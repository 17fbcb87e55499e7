"""A vibrating surface that shares no code with the library's: a mode, the finger on it, and its sensor."""

import numpy as np
from live_devices import Bench
from scipy.linalg import expm

import hapticrender as hr

MASS = 5e-3  # kg


def scaled(gain):
    """What a sensor `tell`s that shows `gain` times too much."""
    return lambda sample, sensed: sensed._replace(sensed=gain * sensed.sensed)


class Resonator(Bench):
    """A mode driven in V and sensed in m, exact for a held drive and a finger that stays over a block.

    A finger of the load W (N) adds 14 W^0.4 N s/m and 9 W^0.3 mg; `load` is W over time (s).  `tell(sample, sensed)` is
    what the sensor shows, `late` its delay (samples) that nobody states, `noise` in m.
    """

    rate, drive_channels, sensed_channels, probe = 192e3, 1, 1, False

    def __init__(
        self,
        frequency=30.1e3,
        quality=150.0,
        force=1.6,
        load=lambda time: 0.0,
        tell=lambda sample, sensed: sensed,
        block=64,
        late=0,
        noise=2e-9,
    ):
        self.stiffness, self.force = MASS * (2 * np.pi * frequency) ** 2, force
        self.damping = 2 * np.pi * frequency * MASS / quality
        self.load, self.tell, self.noise, self.rng = load, tell, noise, np.random.default_rng(0)
        self.block = self.delay = block
        self.queue, self.x, self.v, self.touched = [0.0] * late, 0.0, 0.0, None
        self.played, self.moved = [], []

    def touch(self, load):
        """Take the step of the mode from the exponential of its matrix, where the load has changed."""
        if load != self.touched:
            mass, damping = MASS + 9e-6 * load**0.3, self.damping + 14.0 * load**0.4
            rows = [[0.0, 1.0, 0.0], [-self.stiffness / mass, -damping / mass, self.force / mass], [0.0, 0.0, 0.0]]
            self.touched, self.step = load, expm(np.array(rows) / self.rate)[:2].ravel().tolist()

    def play(self, drive):
        sample = self.block * len(self.played)
        self.touch(float(self.load(sample / self.rate)))
        (a, b, c, d, e, f), x, v, moved = self.step, self.x, self.v, []
        self.queue += drive[:, 0].tolist()
        for u in self.queue[: len(drive)]:
            moved.append(x)
            x, v = a * x + b * v + c * u, d * x + e * v + f * u
        del self.queue[: len(drive)]
        self.x, self.v = x, v
        self.played.append(drive.copy())
        self.moved.append(np.array(moved)[:, None])
        return self.tell(sample, hr.Sensed(self.moved[-1] + self.noise * self.rng.standard_normal(drive.shape)))
