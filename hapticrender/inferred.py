"""Friction that is inferred: what an attraction or an amplitude makes of it behind the lag of the contact."""

import math

import numpy as np

from hapticrender.protocols import Array

SHORT = 1e-6  # of the length: for a shorter path the first term of the series is exact to rounding


class ContactLag:
    """A contact that renews itself over a length: friction follows with dy/dx = (u - y)/length along the finger's path.

    Exact for u on straight lines between samples, block after block.  Where a finger has come anew, y begins at u; at a
    `length` of 0 (m) friction follows at once.
    """

    def __init__(self, length: float) -> None:
        self.length = length
        self._before, self._level, self._position = np.zeros(0), np.zeros(0), math.nan

    def run(self, values: Array, position: Array) -> Array:
        """Friction (shape (n, places)) for `values` alike and the finger's `position` (m, shape (n,), NaN: lifted)."""
        found = np.array(values, float)
        if self.length == 0.0:
            return found
        for n, path in enumerate(np.abs(np.diff(position, prepend=self._position)) / self.length):
            if np.isfinite(path):
                passed = -math.expm1(-path)
                new = 1.0 - passed / path if path > SHORT else path / 2.0
                found[n] = (1.0 - passed) * self._level + (passed - new) * self._before + new * values[n]
            self._before, self._level = values[n], found[n].copy()
        self._position = position[-1] if len(position) else self._position
        return found
