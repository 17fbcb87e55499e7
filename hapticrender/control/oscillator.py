"""A carrier at unit amplitude, its phase counted in whole 2^-64 turns so that it never drifts."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from hapticrender.protocols import Array


class Oscillator:
    """A cosine that goes on from block to block; it starts at its crest.

    Parameters
    ----------
    frequency, rate : float, Hz
        Of the carrier, and of its samples; the frequency is kept to 2^-65 of the rate.
    """

    def __init__(self, frequency: float, rate: float) -> None:
        self._advance = round(Fraction(frequency) / Fraction(rate) * 2**64)
        self._phase = 0  # of the next sample, 2^64 a turn

    def take(self, count: int) -> Array:
        """Return the next `count` samples, shape (count,)."""
        turns = np.uint64(self._phase) + np.arange(count, dtype=np.uint64) * np.uint64(self._advance % 2**64)
        self._phase = (self._phase + count * self._advance) % 2**64
        return np.cos(2 * np.pi * 2.0**-64 * turns)
