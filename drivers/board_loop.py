"""A board in live play: the loop runs on the board, and `hapticrender.Player` asks it what it asks a `LiveLoop`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.drivers.board_texture import BoardTexture
from hapticrender.drivers.protocol import WRAP, Capabilities
from hapticrender.drivers.row_reader import RowReader
from hapticrender.errors import DeviceFault, HapticError, WatchdogTimeout
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array, Flag, Rendering

if TYPE_CHECKING:
    from hapticrender.drivers.serial import SerialDriver

TELEMETRY = 0.05  # s between two frames of telemetry
CARRIER = ("frequency", "wavenumber", "phase")
CHANGE = 0.02  # s in which a carrier fades out before another one takes its place,
FADE = 0.04  # s in which a texture fades into the next one
JUDGED = 0.25  # s of signal that the figures of a texture are of
REFRESH = 64  # samples of a run between two looks of the board at other carriers
MOST_BANDS = 255  # that a frame can count


class _Piece(NamedTuple):
    """Reference from a sample of the run on, fully after `fade` samples more."""

    start: int
    bands: Bands
    turns: Array  # of the bands' carriers until `start`
    gain: float
    texture: BoardTexture | None = None
    began: int = 0  # sample of the run at which the texture's sample 0 plays
    fade: int = 0

    def values(self, sample: Array, position: Array, rate: float) -> Array:
        """Reference (m, shape (n,)) at samples of the run."""
        if self.texture is not None:
            return self.gain * self.texture.at((sample - self.began) / rate, position)
        bands = self.bands
        phase = bands.carrier_phase((sample - self.start) / rate, position) + 2 * np.pi * self.turns[: len(bands)]
        texture = (bands.envelope * np.exp(1j * phase)).real.sum(axis=1)  # type: ignore[operator]
        return self.gain * np.where(np.isnan(position) & bands.follows_finger, 0.0, texture)


class BoardLoop:
    """A rendering that plays on a board; what `hapticrender.live_loop.LiveLoop` is for a controller of this process.

    Parameters
    ----------
    rendering : Rendering
        With a texture of displacements.
    driver : SerialDriver
    stream : int
        Samples between two rows that the board streams back for a recording; what lies between repeats the last one.

    Raises
    ------
    ValueError
        A board cannot play the texture.
    """

    senses = False  # the host says where the finger is
    motion_source = "sensors"

    def __init__(self, rendering: Rendering, driver: SerialDriver, stream: int = 1) -> None:
        self.rendering, self.driver, self.model = rendering, driver, rendering.model
        self.samples, self.flags = 0, Flag(0)
        self._client, self._stream, self._first = driver.client, stream, 0
        bands, texture = playable(rendering, driver.capabilities)
        self._pieces = [_Piece(0, bands, np.zeros(MOST_BANDS), 1.0, texture)]
        self._recent = np.zeros((0, 2))  # reference and motion, m
        self._reader: RowReader | None = None
        self._connections = 0
        self._fault: HapticError | None = None

    def start(self) -> None:
        """Set the bands and play; the port is open."""
        last = self._pieces[-1]
        self._client.set_bands(last.bands, last.texture)
        self._client.set_gain(last.gain)
        self._client.start(stream=self._stream, telemetry=TELEMETRY)
        self._read()

    def _read(self) -> None:
        """Read the rows of the run that the board has begun, after those of an earlier one."""
        self._first = (self._client.started - self.samples) % WRAP
        self._reader = RowReader(self._client, self._client.started, self._stream)
        self._connections = self._client.reconnections

    def exchange(self, rendering: Rendering) -> None:
        """Go over to the texture of another rendering of the same device: within 20 ms from bands to bands, else 40."""
        last, (bands, texture) = self._pieces[-1], playable(rendering, self.driver.capabilities)
        taken = (self._client.set_bands(bands, texture) - self._first) % WRAP
        self.rendering = rendering
        if texture is not None:
            began = ((texture.began or 0) - self._first) % WRAP
            fade = round(FADE * self.driver.rate)
            self._pieces.append(_Piece(began, bands, np.zeros(MOST_BANDS), last.gain, texture, began, fade))
            return
        start = -(-(taken + round(CHANGE * self.driver.rate) + 1) // REFRESH) * REFRESH
        turns, both = np.zeros(MOST_BANDS), slice(min(len(bands), len(last.bands)))
        same = [getattr(bands, name)[both] == getattr(last.bands, name)[both] for name in CARRIER]
        turns[both] = np.where(np.all(same, axis=0), self._turns(start)[both], 0.0)  # another carrier starts anew
        self._pieces.append(_Piece(start, bands, turns, last.gain))

    def finger(self, position: float, velocity: float, load: float) -> None:
        """Say where the finger is (m, m/s, N)."""
        self._client.finger(position, velocity, load)

    def watch(self, seconds: float | None) -> None:
        """Let the board stop once the application has not called for so long (s); None: never."""
        self._client.watch(seconds)

    def alive(self) -> None:
        """Note a call of the application."""
        self._client.beat()

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, 0 to 1."""
        last = self._pieces[-1]
        if gain == last.gain:
            return
        if self._reader is None:
            self._pieces[-1] = last._replace(gain=gain)
            return
        start = max((self._client.set_gain(gain) - self._first) % WRAP, last.start)
        self._pieces.append(last._replace(start=start, turns=self._turns(start), gain=gain, fade=0))

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
            anew = {"start": self.samples, "began": self.samples, "turns": np.zeros(MOST_BANDS), "fade": 0}
            self._pieces = [self._pieces[-1]._replace(**anew)]
            self._read()
        try:
            self.flags |= self._client.telemetry().flags
        except (DeviceFault, WatchdogTimeout) as fault:
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
        model, reference = self.model, self._reference(first, position)
        motion = sensed @ (model.place_from_coordinate @ model.coordinate_from_sensed).T
        recent = np.vstack([self._recent, np.stack([reference, motion[:, 0]], axis=1)])
        self._recent = recent[-round(JUDGED * self.driver.rate) :]
        return first, {
            "drive": drive,
            "sensed": sensed,
            "motion": motion,
            "position": position,
            "normal_load": load,
            "reference": reference,
            "target": np.zeros((count, 0), complex),
            "flags": flags,
        }

    def _reference(self, first: int, position: Array) -> Array:
        """Reference of the samples from `first` on, without the 20 ms in which the board glides."""
        reference, sample = np.zeros(len(position)), first + np.arange(len(position))
        for piece in self._pieces:
            since = sample >= piece.start
            weight = smoothstep((sample[since] - piece.start + 1) / max(piece.fade, 1))
            values = piece.values(sample[since], position[since], self.driver.rate)
            reference[since] += weight * (values - reference[since])
        while len(self._pieces) > 1 and self._pieces[1].start + self._pieces[1].fade <= first:
            del self._pieces[0]
        return reference

    def figures(self) -> list[tuple[float, float, float, float]]:
        """Return what the board last said of every band: frequency (Hz), target, achieved (m) and relative error.

        Of a texture that is no sum of bands the amplitudes are rms, over the last quarter of a second.
        """
        rows = []
        if self._pieces[-1].texture is not None and len(self._recent):
            reference, motion = (self._recent - self._recent.mean(axis=0)).T
            target, achieved, off = (float(np.sqrt(np.mean(x**2))) for x in (reference, motion, motion - reference))
            return [(0.0, target, achieved, off / target if target > 0.0 else math.nan)]
        for hertz, band in zip(self._pieces[-1].bands.frequency, self._client.telemetry().bands, strict=False):
            size, error = abs(band.target), abs(band.measured - band.target)
            rows.append((float(hertz), size, abs(band.measured), error / size if size > 0.0 else math.nan))
        return rows

    def fault(self) -> HapticError | None:
        """Return why the board stopped the drive, if it did."""
        return self._fault


def playable(rendering: Rendering, board: Capabilities) -> tuple[Bands, BoardTexture | None]:
    """Return what a board plays of a rendering: its bands, or none and a texture of samples.

    Raises
    ------
    ValueError
        `BoardTexture` refuses the texture.
    """
    bands, texture = rendering.bands, rendering.scene.texture
    if bands.envelope is not None and len(bands) and not bands.modulated:
        return bands, None
    return Bands.none(spatial=False), BoardTexture(texture, board, rendering.model)
