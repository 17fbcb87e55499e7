"""Rows that a board streams back, in order."""

import numpy as np

from hapticrender.drivers.protocol import WRAP, Stream
from hapticrender.protocols import Array, Flag

LONGEST_GAP = 2**16  # rows


class Rows:
    """Rows of a run: drive (A), sensed (m), position (m), load (N), reference (m) and flags.

    A row that was lost on the line repeats the one before, with `Flag.OVERRUN`.  `first` is the sample of the board's
    clock from which on it streams, that of the first row that comes unless given; `stride` the samples between two
    rows, 0 where none are streamed.
    """

    def __init__(self, first: int | None = None, stride: int = 1) -> None:
        self._stride = stride or 1
        self._next = None if first is None else -(-first // self._stride) * self._stride
        self._rows: list[Array] = []
        self._last: Array | None = None
        self._broken = False  # rows were lost; their number is unknown

    def __len__(self) -> int:
        return len(self._rows)

    def restart(self, first: int) -> None:
        """Go on with the same rows after the board began anew at sample `first`, on a clock that may be another."""
        if self._missing(first) >= LONGEST_GAP:
            self._next, self._broken = -(-first // self._stride) * self._stride, True

    def _missing(self, first: int) -> int:
        return 0 if self._next is None else (first - self._next) % WRAP // self._stride

    def add(self, block: Stream) -> None:
        """Append the rows of a frame, after those that were lost before it."""
        rows, missing = np.array(block.rows), self._missing(block.first)
        if missing >= LONGEST_GAP or not len(rows):
            return  # of an earlier run
        if self._broken:
            rows[0, -1], self._broken = int(rows[0, -1]) | Flag.OVERRUN, False
        if missing:
            lost = np.array(rows[0] if self._last is None else self._last)
            lost[-1] = int(lost[-1]) | Flag.OVERRUN
            self._rows += [lost] * missing
        self._rows += list(rows)
        self._last = rows[-1]
        self._next = (block.first + len(rows) * self._stride) % WRAP

    def take(self, count: int | None = None) -> Array:
        """Remove and return the first `count` rows, all unless given; shape (n, columns)."""
        found, self._rows = self._rows[:count], self._rows[count:] if count is not None else []
        return np.array(found)
