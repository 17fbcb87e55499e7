"""The finger of an application, as a motion: for a simulated device that is played live."""

from __future__ import annotations

import math

import numpy as np

from hapticrender.protocols import Array
from hapticrender.realtime_kernel import HORIZON


class LiveMotion:
    """The position and load that the application has last set."""

    def __init__(self) -> None:
        self._clock = 0.0  # s
        self._last = (0.0, math.nan, 0.0, 0.0)  # since (s), position, velocity, load

    def update(self, position: float, velocity: float, load: float) -> None:
        """Take up the application's finger (m, m/s, N)."""
        self._last = (self._clock, position, velocity, load)

    def position(self, time: Array) -> Array:
        """Position (m) at `time` (s): at the last speed, for `HORIZON` at most."""
        time, (since, place, velocity, _) = np.asarray(time, float), self._last
        self._clock = float(time[-1]) if time.size else self._clock
        return place + velocity * np.clip(time - since, 0.0, HORIZON)

    def load(self, time: Array) -> Array:
        """Return the normal load (N)."""
        return np.full(np.shape(time), self._last[3])
