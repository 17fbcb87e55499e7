"""A texture on a board that is no sum of bands: a table along the surface, and samples in time, sent ahead of play."""

from __future__ import annotations

from binascii import crc32
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import WRAP, Capabilities, Kind
from hapticrender.protocols import Array, Texture
from hapticrender.touch.composed import SeparatedTexture

if TYPE_CHECKING:
    from hapticrender.control.device_model import DeviceModel

FULL_SCALE = 32767  # of i16
ROWS = 64  # points or samples in a frame: a longer one takes a Cortex-M4 too long beside the law (benchmarks/board.py)
AHEAD = 0.5  # s: of samples that are on the board before they play
LEAST_POINTS = 512
FINE, COARSE = 1e-3, 0.1  # rms error of the table over rms: more points are taken; the texture is refused
BETWEEN = 0.382  # of a step, where the error is taken: no wavelength fits into it and the step
REACH, MARGIN = 0.1, 2e-3  # m: to either side of the middle where a model does not show its ends; beyond the ends


class BoardTexture:
    """A texture, parted by `SeparatedTexture`, as a board takes it; its table reaches from end to end of the surface.

    The table has at most `board.points`; in between the board takes cubic interpolation, whose error for a sine of
    wavelength L at steps h is (3/128)(2 pi h/L)^4: 0.2 % at 12 points a wavelength, 10 % at 4.4.  Samples are rounded
    to 1/32767 of the largest of their frame.  A ValueError where the texture is too fine for the table.
    """

    def __init__(self, texture: Texture, board: Capabilities, model: DeviceModel) -> None:
        self.parts, self.rate = SeparatedTexture(texture), board.rate
        self.written, self._number = 0, 0
        self.began: int | None = None  # sample of the board's clock at which its sample 0 plays
        self._ahead = min(round(AHEAD * board.rate), board.ring - 2 * ROWS)
        self._name = type(texture).__name__
        self._start, self._step, self._table = 0.0, 1.0, np.zeros(0)
        if self.parts.spatial:
            lever = model.lever_per_metre  # by which the plate's ends are in its coordinates
            ends = float(abs(model.place_from_coordinate[:, 1]).max()) / lever + MARGIN if lever else REACH
            self._start = -ends
            self._step, self._table = self._sampled(board.points)
        self._scale = max(float(abs(self._table).max(initial=0.0)) / FULL_SCALE, 1e-30)

    def at(self, time: Array, position: Array) -> Array:
        """Displacement (m, shape (n,)) at `time` (s since it began) with the finger at `position` (m, NaN: lifted)."""
        along = self.parts.along_surface(position) if self.parts.spatial else np.zeros(len(time))
        return along + (self.parts.in_time(time) if self.parts.timed else 0.0)

    def frames(self, number: int) -> Iterator[tuple[Kind, bytes]]:
        """Commands that describe it under this number (0 to 255), send its table and first samples, and play it."""
        self.written, self.began, self._number = 0, None, number
        table = np.rint(self._table / self._scale).astype("<i2")
        fields = number, self.parts.timed, len(table), self._start, self._step, self._scale
        described = protocol.pack(Kind.TEXTURE, *fields)
        yield Kind.TEXTURE, described
        for first in range(0, len(table), ROWS):
            yield Kind.PROFILE, protocol.pack(Kind.PROFILE, first) + table[first : first + ROWS].tobytes()
        while samples := self.samples(0):
            yield Kind.SAMPLES, samples
            self.written += ROWS
        yield Kind.PLAY, protocol.pack(Kind.PLAY, crc32(table.tobytes(), crc32(described)))

    def samples(self, played: int) -> bytes | None:
        """Payload of the next `ROWS` samples, from `written` on; None where enough of them lie ahead of `played`."""
        if not self.parts.timed or self.written >= played + self._ahead:
            return None
        values = self.parts.in_time((self.written + np.arange(ROWS)) / self.rate)
        scale = max(float(abs(values).max()) / FULL_SCALE, 1e-30)
        head = protocol.pack(Kind.SAMPLES, self._number, self.written % WRAP, scale)
        return head + np.rint(values / scale).astype("<i2").tobytes()

    def _sampled(self, most: int) -> tuple[float, Array]:
        """Step (m) and values (m) of the table: as few points as are fine enough."""
        points = min(LEAST_POINTS, most)
        while True:
            places, step = np.linspace(self._start, -self._start, points, retstep=True)
            table, x = self.parts.along_surface(places), BETWEEN
            truth = self.parts.along_surface(places[1:-2] + x * step)
            inner = (1 + x) * (2 - x) / 2 * ((1 - x) * table[1:-2] + x * table[2:-1])
            off = inner - x * (1 - x) / 6 * ((2 - x) * table[:-3] + (1 + x) * table[3:]) - truth
            error = float(np.linalg.norm(off) / max(np.linalg.norm(truth), 1e-30))
            if error <= FINE or 2 * points > most:
                break
            points *= 2
        if error > COARSE:
            raise ValueError(
                f"texture {self._name}: {points} points, {1e6 * step:.3g} um apart, are {100 * error:.2g} % off it: "
                f"must be <= {100 * COARSE:g} %; narrow its passband, or compile the board with more TEXTURE_POINTS"
            )
        return float(step), table
