"""A board in live play: the loop runs on the board, and `hapticrender.Player` asks it what it asks a `LiveLoop`."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.drivers.row_reader import WRAP, RowReader
from hapticrender.errors import DeviceFault, HapticError, WatchdogTimeout
from hapticrender.protocols import Array, Flag, Rendering

if TYPE_CHECKING:
    from hapticrender.drivers.serial import SerialDriver

TELEMETRY = 0.05  # s between two frames of telemetry
CARRIER = ("frequency", "wavenumber", "phase")
CHANGE = 0.02  # s in which a carrier fades out before another one takes its place,
REFRESH = 64  # samples of a run between two looks of the board at other carriers
MOST_BANDS = 255  # that a frame can count


class _Piece(NamedTuple):
    """Reference from a sample of the run on: bands, turns of their carriers until then, gain."""

    start: int
    bands: Bands
    turns: Array
    gain: float


class BoardLoop:
    """A rendering that plays on a board; what `hapticrender.live.LiveLoop` is for a controller of this process.

    Parameters
    ----------
    rendering : Rendering
        With a texture of constant amplitudes, which is all that a board plays.
    driver : SerialDriver
    stream : int
        Samples between two rows that the board streams back for a recording; what lies between repeats the last one.

    Raises
    ------
    ValueError
        The texture is a recording.
    """

    whole, silent = True, False  # textures are exchanged under one law
    senses = False  # the host says where the finger is
    motion_source = "sensors"

    def __init__(self, rendering: Rendering, driver: SerialDriver, stream: int = 1) -> None:
        self.rendering, self.driver, self.model = rendering, driver, rendering.model
        self.samples, self.flags = 0, Flag(0)
        self._client, self._stream, self._first = driver.client, stream, 0
        self._pieces = [_Piece(0, _playable(rendering), np.zeros(MOST_BANDS), 1.0)]
        self._reader: RowReader | None = None
        self._connections = 0
        self._fault: HapticError | None = None
        self._watchdog: float | None = None  # s
        self._called = math.inf

    def start(self) -> None:
        """Set the bands and play; the port is open."""
        last = self._pieces[-1]
        self._client.set_bands(last.bands)
        self._client.set_gain(last.gain)
        self._client.start(stream=self._stream, telemetry=TELEMETRY)
        self._read()

    def _read(self) -> None:
        """Read the rows of the run that the board has begun, after those of an earlier one."""
        self._first = (self._client.started - self.samples) % WRAP
        self._reader = RowReader(self._client, self._client.started, self._stream)
        self._connections = self._client.reconnections

    def exchange(self, rendering: Rendering) -> None:
        """Glide to the texture of another rendering of the same device, within 20 ms."""
        bands = _playable(rendering)
        taken, last = (self._client.set_bands(bands) - self._first) % WRAP, self._pieces[-1]
        start = -(-(taken + round(CHANGE * self.driver.rate) + 1) // REFRESH) * REFRESH
        turns, both = np.zeros(MOST_BANDS), slice(min(len(bands), len(last.bands)))
        same = [getattr(bands, name)[both] == getattr(last.bands, name)[both] for name in CARRIER]
        turns[both] = np.where(np.all(same, axis=0), self._turns(start)[both], 0.0)  # another carrier starts anew
        self._pieces.append(_Piece(start, bands, turns, last.gain))
        self.rendering = rendering

    def finger(self, position: float, velocity: float, load: float) -> None:
        """Say where the finger is (m, m/s, N)."""
        self._client.finger(position, velocity, load)

    def watch(self, seconds: float | None) -> None:
        """Stop the drive once the application has not called for so long (s); None: never."""
        self._watchdog = seconds
        self.alive()

    def alive(self) -> None:
        """Note a call of the application."""
        self._called = time.monotonic()

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, 0 to 1."""
        last = self._pieces[-1]
        if gain == last.gain:
            return
        if self._reader is None:
            self._pieces[-1] = last._replace(gain=gain)
            return
        start = max((self._client.set_gain(gain) - self._first) % WRAP, last.start)
        self._pieces.append(_Piece(start, last.bands, self._turns(start), gain))

    def _turns(self, sample: int) -> Array:
        """Turns of the carriers at a sample of the run."""
        last, turns = self._pieces[-1], self._pieces[-1].turns.copy()
        turns[: len(last.bands)] += (sample - last.start) / self.driver.rate * last.bands.frequency
        return turns

    def silence(self) -> None:
        """Fade out within 10 ms."""
        self._client.stop()

    def fill(self) -> None:
        """Look at the telemetry; a `DriverError` where board or line are gone.

        A board that was lost and found again plays a new run, whose carriers begin anew; what was lost is not counted.
        """
        if self._reader is not None and self._client.reconnections != self._connections:
            self.flags |= Flag.OVERRUN
            self._pieces = [self._pieces[-1]._replace(start=self.samples, turns=np.zeros(MOST_BANDS))]
            self._read()
        if self._watchdog is not None and time.monotonic() - self._called > self._watchdog and self._fault is None:
            self._client.stop()
            self._fault, self.flags = WatchdogTimeout(self.samples / self.driver.rate), self.flags | Flag.STOPPED
        try:
            self.flags |= self._client.telemetry().flags
        except DeviceFault as fault:
            self._fault = fault
            self.flags |= Flag.STOPPED

    def signals(self, start: int) -> tuple[int, dict[str, Array]]:
        """Return `start` and the signals of what the board has streamed back since the last call."""
        rows = self._reader.arrived() if self._reader is not None else np.zeros((0, 0))
        drive, sensed, position, load, flags = (
            np.repeat(each, self._stream, axis=0) for each in self.driver.columns(rows)
        )
        count = len(flags)
        first, self.samples = self.samples, self.samples + count
        model = self.model
        return first, {
            "drive": drive,
            "sensed": sensed,
            "motion": sensed @ (model.place_from_coordinate @ model.coordinate_from_sensed).T,
            "position": position,
            "normal_load": load,
            "reference": self._reference(first, position),
            "target": np.zeros((count, 0), complex),
            "flags": flags,
        }

    def _reference(self, first: int, position: Array) -> Array:
        """Reference of the samples from `first` on, without the 20 ms in which the board glides."""
        reference, sample = np.zeros(len(position)), first + np.arange(len(position))
        for piece in self._pieces:
            since, bands = sample >= piece.start, piece.bands
            time = (sample[since] - piece.start) / self.driver.rate
            phase = bands.carrier_phase(time, position[since]) + 2 * np.pi * piece.turns[: len(bands)]
            texture = (bands.envelope * np.exp(1j * phase)).real.sum(axis=1)  # type: ignore[operator]
            away = np.isnan(position[since]) & bands.follows_finger
            reference[since] = np.where(away, 0.0, piece.gain * texture)
        while len(self._pieces) > 1 and self._pieces[1].start <= first:
            del self._pieces[0]
        return reference

    def figures(self) -> list[tuple[float, float, float, float]]:
        """Return what the board last said of every band: frequency (Hz), target, achieved (m) and relative error."""
        rows = []
        for hertz, band in zip(self._pieces[-1].bands.frequency, self._client.telemetry().bands, strict=False):
            size, error = abs(band.target), abs(band.measured - band.target)
            rows.append((float(hertz), size, abs(band.measured), error / size if size > 0.0 else math.nan))
        return rows

    def fault(self) -> HapticError | None:
        """Return why the board stopped the drive, if it did."""
        return self._fault


def _playable(rendering: Rendering) -> Bands:
    bands = rendering.bands
    if bands.envelope is None or bands.differentiated:
        kind = type(rendering.scene.texture).__name__
        raise ValueError(f"texture: {kind} is a waveform, or a force: a board plays gratings, and sums of them")
    return bands
