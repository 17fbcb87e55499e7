"""What every simulated device shares: a finger, a clock of samples, and the controllers that it closes a loop with."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.plants.closed import STEPS
from hapticrender.protocols import Array, Controller

if TYPE_CHECKING:
    from hapticrender.touch.finger import Finger


class TouchedPlant:
    """Base of the plants behind the `Plant` protocol; counts samples from 0.

    Parameters
    ----------
    finger : Finger
    rate : float, Hz
        Sampling rate.
    """

    closed_with: Collection[type] = STEPS  # tables of the controllers that `closed_loop` takes

    def __init__(self, finger: Finger, rate: float) -> None:
        self.finger = finger
        self.rate = float(rate)
        self._samples = 0

    def _time(self, n: int) -> Array:
        """Time (s, shape (n,)) of the next n samples."""
        return (self._samples + np.arange(n)) / self.rate

    def closes(self, controller: Controller) -> bool:
        """Whether `closed_loop` has compiled code for this controller."""
        return type(getattr(controller, "tables", None)) in self.closed_with

    def finger_position(self, n: int) -> Array:
        """Finger positions (m, shape (n,)) of the next n samples, NaN while lifted; the plant does not advance."""
        return self.finger.position(self._time(n))
