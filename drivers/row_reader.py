"""Rows that a board streams back, put in order; those that were lost on the line are filled in."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import WRAP
from hapticrender.errors import DeviceTimeout
from hapticrender.protocols import Array, Flag

if TYPE_CHECKING:
    from hapticrender.drivers.board_client import BoardClient
LONGEST_GAP = 2**16  # rows


class RowReader:
    """Rows that a board streams back, in order, those that were lost on the line filled in.

    Parameters
    ----------
    client : BoardClient
    first : int, optional
        Sample of the board's clock of the first row; of the first one that comes unless given.
    stride : int
        Samples between two rows.
    finger : callable, optional
        Called again and again while rows are awaited.
    """

    def __init__(
        self,
        client: BoardClient,
        first: int | None = None,
        stride: int = 1,
        finger: Callable[[], None] = lambda: None,
    ) -> None:
        self._client, self._stride, self._finger = client, stride, finger
        self._next = None if first is None else -(-first // stride) * stride
        self._rows: list[Array] = []
        self._last: Array | None = None

    def take(self, count: int) -> Array:
        """Return the next rows: drive (A), sensed (m), position (m), load (N) and flags, shape (count, columns).

        A lost row repeats the one before, with `Flag.OVERRUN`.  A `DeviceTimeout` where none come.
        """
        client, clock = self._client, self._client.clock
        end = clock.monotonic() + client.timeout
        while len(self._rows) < count:
            self._finger()
            for block in client.rows():
                self._append(block)
                end = clock.monotonic() + client.timeout
            if clock.monotonic() >= end:
                raise DeviceTimeout(f"{client.port}: stream: {len(self._rows)} of {count} rows in {client.timeout:g} s")
            client.pause()
        found, self._rows = self._rows[:count], self._rows[count:]
        return np.array(found)

    def arrived(self) -> Array:
        """Return the rows that have arrived and were not taken, see `take`; none is waited for."""
        for block in self._client.rows():
            self._append(block)
        found, self._rows = self._rows, []
        return np.array(found)

    def _append(self, block: protocol.Stream) -> None:
        rows = np.array(block.rows)
        missing = 0 if self._next is None else (block.first - self._next) % WRAP // self._stride
        if missing >= LONGEST_GAP or not len(rows):
            return  # of an earlier run
        if missing:
            lost = np.array(rows[0] if self._last is None else self._last)
            lost[-1] = int(lost[-1]) | Flag.OVERRUN
            self._rows += [lost] * missing
        self._rows += list(rows)
        self._last = rows[-1]
        self._next = (block.first + len(rows) * self._stride) % WRAP
