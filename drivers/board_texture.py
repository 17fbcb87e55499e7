"""A texture on a board that is no sum of bands: a table along the surface, and samples in time, sent ahead of play.

One that needs time and position at once is sent as samples, too, evaluated for where the finger will be when they play,
and again wherever the finger's motion has changed: a frame replaces samples that have not been played.
"""

from __future__ import annotations

from binascii import crc32
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import WRAP, Capabilities, Kind
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array, Texture
from hapticrender.touch.composed import InseparableTexture, SeparatedTexture, evaluated

if TYPE_CHECKING:
    from hapticrender.control.device_model import DeviceModel

FULL_SCALE = 32767  # of i16
ROWS = 64  # points or samples in a frame: a longer one takes a Cortex-M4 too long beside the law (benchmarks/board.py)
AHEAD, EVALUATED = 0.5, 0.1  # s: of samples that are on the board before they play; of those that may be replaced
BLEND = 16  # samples at either end of a frame in which it fades over what it replaces, and back
SPARE = 5  # samples: a frame that is sent arrives no later than the slowest of late, and these
SLOW = 0.02  # of a deviation, by which an estimate is corrected a frame: clocks that drift, frames that are faster
EXTRAPOLATED, PATIENCE = 0.05, 0.2  # s: BOARD_EXTRAPOLATE_MS and BOARD_FINGER_MS of board.h
LEAST_POINTS = 512
FINE, COARSE = 1e-3, 0.1  # rms error of the table over rms: more points are taken; the texture is refused
BETWEEN = 0.382  # of a step, where the error is taken: no wavelength fits into it and the step
REACH, MARGIN = 0.1, 2e-3  # m: to either side of the middle where a model does not show its ends; beyond the ends


class Pointed(NamedTuple):
    """A finger as it was set."""

    time: float  # s, of the host's clock
    position: float  # m from the middle, NaN: lifted
    velocity: float  # m/s
    load: float  # N

    def path(self, time: Array) -> Array:
        """Position (m) at `time` (s), as the board extrapolates it."""
        age = time - self.time
        return np.where(age <= PATIENCE, self.position + self.velocity * np.minimum(age, EXTRAPOLATED), np.nan)


LIFTED = Pointed(0.0, np.nan, 0.0, 0.0)


class BoardTexture:
    """A texture as a board takes it: parted by `SeparatedTexture` or, where it cannot be, evaluated on a finger's path.

    Its table reaches from end to end of the surface, and has at most `board.points`; in between the board takes cubic
    interpolation, whose error for a sine of wavelength L at steps h is (3/128)(2 pi h/L)^4: 0.2 % at 12 points a
    wavelength, 10 % at 4.4.  Samples are rounded to 1/32767 of the largest of their frame.  A ValueError where the
    texture is too fine for the table, or not the same when it is evaluated twice.  `waveform_of` makes the texture's
    waveform in the device's quantity; by default it has its own.
    """

    def __init__(self, texture: Texture, board: Capabilities, model: DeviceModel, waveform_of: Any = None) -> None:
        self.rate, self.lookahead = board.rate, board.lookahead
        self.written, self._number, self._name = 0, 0, type(texture).__name__
        self._start, self._step, self._table = 0.0, 1.0, np.zeros(0)
        try:
            self.parts: SeparatedTexture | None = SeparatedTexture(texture, waveform_of)
            self.timed = self.parts.timed
        except InseparableTexture:
            self.parts, self.timed = None, True
            waveform = waveform_of(texture) if waveform_of else texture.waveform
            self._waveform = evaluated(self._name, texture.bands(board.rate), waveform)
        self._blend = 0 if self.parts else BLEND
        self._ahead = min(round((AHEAD if self.parts else EVALUATED) * board.rate), board.ring - 2 * ROWS)
        if self.parts and self.parts.spatial:
            lever = model.lever_per_metre  # by which the plate's ends are in its coordinates
            ends = float(abs(model.place_from_coordinate[:, 1]).max()) / lever + MARGIN if lever else REACH
            self._start = -ends
            self._step, self._table = self._sampled(self.parts, board.points)
        self._scale = max(float(abs(self._table).max(initial=0.0)) / FULL_SCALE, 1e-30)
        self._began = 0  # sample of the board's clock at which its first plays; and that is, by the host's (s),
        self._least = self._most = self._played_from = 0.0  # no sooner than, no later than, and probably at
        self._held = np.zeros(board.ring)  # what the board holds of one that is evaluated
        self._frame = 0, np.zeros(ROWS)  # the last: number of its first sample, and values
        self._pointed, self._next, self._late = LIFTED, 0, 0.0  # evaluated for; up to; samples until a frame is there

    def begin(self, sample: int, now: float) -> None:
        """Note the sample of the board's clock at which its sample 0 plays, which is now (s)."""
        self._began, self._least, self._most, self._played_from = sample, now, now, now

    def played(self, now: float) -> int:
        """Samples that have been played by `now` (s)."""
        return max(round((now - self._played_from) * self.rate), 0)

    def frames(self, number: int, now: float, finger: Pointed) -> Iterator[tuple[Kind, bytes]]:
        """Commands that describe it under this number (0 to 255), send its table and first samples, and play it."""
        self.written, self._number = 0, number
        self.begin(0, now)
        table = np.rint(self._table / self._scale).astype("<i2")
        described = protocol.pack(Kind.TEXTURE, number, self.timed, len(table), self._start, self._step, self._scale)
        yield Kind.TEXTURE, described
        for first in range(0, len(table), ROWS):
            yield Kind.PROFILE, protocol.pack(Kind.PROFILE, first) + table[first : first + ROWS].tobytes()
        while self.written < self._ahead and (samples := self.samples(now, finger)):
            yield Kind.SAMPLES, samples
            self.taken()
        yield Kind.PLAY, protocol.pack(Kind.PLAY, crc32(table.tobytes(), crc32(described)))

    def samples(self, now: float, finger: Pointed) -> bytes | None:
        """Payload of the frame of `ROWS` samples that is due at `now` (s); None where there is none.

        Enough of them have to lie ahead; then those of a texture that is evaluated are replaced, the next ones first,
        once the finger has been set anew.
        """
        if not self.timed:
            return None
        first = max(self.written - self._blend, 0)
        if self.written >= self.played(now) + self._ahead:
            if finger is not self._pointed:
                self._pointed = finger
                self._next = self.played(now) + self.lookahead + round(self._late) + SPARE
            if self.parts or self._next >= first:
                return None
            first = self._next
        self._frame = first, self._values(first + np.arange(ROWS), finger)
        values = self._frame[1]
        scale = max(float(abs(values).max()) / FULL_SCALE, 1e-30)
        head = protocol.pack(Kind.SAMPLES, self._number, first % WRAP, scale)
        return head + np.rint(values / scale).astype("<i2").tobytes()

    def taken(self) -> None:
        """Note that the board holds the last frame."""
        first, values = self._frame
        self.written = max(self.written, first + ROWS)
        self._held[(first + np.arange(ROWS)) % len(self._held)] = values
        self._next = max(self._next, first + ROWS - self._blend) if first <= self._next else self._next

    def arrived(self, sample: int, sent: float, now: float) -> None:
        """Compare the clocks: a frame that was sent (s) came at a sample of the board's, and its reply is there now."""
        expected = self.played(now)
        number = expected + (sample - self._began - expected + WRAP // 2) % WRAP - WRAP // 2
        late = number - (sent - self._played_from) * self.rate - self._late
        self._late += late * (1.0 if late > 0.0 else SLOW)
        least, most = sent - number / self.rate - self._least, now - number / self.rate - self._most
        self._least += least * (1.0 if least > 0.0 else SLOW)
        self._most += most * (1.0 if most < 0.0 else SLOW)
        self._played_from = (self._least + self._most) / 2

    def _values(self, number: Array, finger: Pointed) -> Array:
        """Samples with these numbers; those of a frame amid others fade over them, and back at its end."""
        time = number / self.rate
        if self.parts:
            return self.parts.in_time(time)
        values, held = self._waveform(time, finger.path(self._played_from + time)), self._held[number % len(self._held)]
        edge = number - number[0] + 1
        if number[-1] < self.written:
            edge = np.minimum(edge, number[-1] + 1 - number)
        return np.where(number < self.written, held + smoothstep(edge / BLEND) * (values - held), values)

    def _sampled(self, parts: SeparatedTexture, most: int) -> tuple[float, Array]:
        """Step (m) and values (m) of the table: as few points as are fine enough."""
        points = min(LEAST_POINTS, most)
        while True:
            places, step = np.linspace(self._start, -self._start, points, retstep=True)
            table, x = parts.along_surface(places), BETWEEN
            truth = parts.along_surface(places[1:-2] + x * step)
            inner = (1 + x) * (2 - x) / 2 * ((1 - x) * table[1:-2] + x * table[2:-1])
            off = inner - x * (1 - x) / 6 * ((2 - x) * table[:-3] + (1 + x) * table[3:]) - truth
            error = float(np.linalg.norm(off)) / max(float(np.linalg.norm(truth)), 1e-30)
            if error <= FINE or 2 * points > most:
                break
            points *= 2
        if error > COARSE:
            raise ValueError(
                f"texture {self._name}: {points} points, {1e6 * step:.3g} um apart, are {100 * error:.2g} % off it: "
                f"must be <= {100 * COARSE:g} %; narrow its passband, or compile the board with more TEXTURE_POINTS"
            )
        return float(step), table
