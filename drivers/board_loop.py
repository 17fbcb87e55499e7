"""A board in live play: the loop runs on the board, with the interface of `hapticrender.live_loop.LiveLoop`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.bands import Bands
from hapticrender.drivers.board_texture import BoardTexture
from hapticrender.drivers.protocol import Capabilities
from hapticrender.errors import DeviceFault, HapticError, WatchdogTimeout
from hapticrender.protocols import Array, Flag, Rendering

if TYPE_CHECKING:
    from hapticrender.drivers.serial import SerialDriver

TELEMETRY = 0.05  # s between two frames of telemetry
JUDGED = 0.25  # s of signal that the figures of a texture are of


class BoardLoop:
    """A rendering that plays on a board; what `hapticrender.live_loop.LiveLoop` is for a controller of this process.

    A ValueError where a board cannot play its texture, which must be of displacements.
    """

    senses = False  # the host sends the finger's position

    def __init__(self, rendering: Rendering, driver: SerialDriver) -> None:
        self.rendering, self.driver, self.model = rendering, driver, rendering.model
        self.samples, self.flags = 0, Flag(0)
        self.motion_source = "sensors" if driver.sensed_channels else "unknown"
        self._client = client = driver.client
        self.finger, self.watch, self.alive, self.silence = client.finger, client.watch, client.beat, client.stop
        self._bands, self._texture = self.made(rendering)
        self._recent = np.zeros((0, 3))  # reference, motion and position, m
        self._reconnections = 0  # that have been noted
        self._fault: HapticError | None = None

    def start(self) -> None:
        """Set the bands and play; the port is open."""
        self.driver.protect(self.rendering)
        self._client.set_bands(self._bands, self._texture)
        self._client.start(stream=1, telemetry=TELEMETRY)
        self._reconnections = self._client.reconnections

    def made(self, rendering: Rendering) -> tuple[Bands, BoardTexture | None]:
        """Return what the board plays of a rendering; a ValueError where it cannot play it."""
        return playable(rendering, self.driver.capabilities)

    def replace(self, rendering: Rendering, bands: Bands, texture: BoardTexture | None) -> None:
        """Change to what was `made` of another rendering of the device: within 20 ms from bands to bands, else 40."""
        self._client.set_bands(bands, texture)
        self.rendering, self._bands, self._texture = rendering, bands, texture

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, 0 to 1."""
        self._client.gain = gain

    def fill(self) -> None:
        """Check the telemetry; a `DriverError` where board or line are gone.

        A board that was lost and found again plays a new run, whose carriers begin anew; what was lost is not counted.
        """
        if self._client.reconnections != self._reconnections:
            self._reconnections = self._client.reconnections
            self.flags |= Flag.OVERRUN
        try:
            self.flags |= self._client.telemetry().flags
        except (DeviceFault, WatchdogTimeout) as fault:
            self._fault = fault
            self.flags |= Flag.STOPPED

    def signals(self, start: int) -> tuple[int, dict[str, Array]]:
        """Return the number of the first sample and the signals that the board has streamed since the last call."""
        found = self.driver.signals(self._client.rows())
        first, count = self.samples, len(found["flags"])
        self.samples += count
        senses = self.driver.sensed_channels > 0
        motion = found["sensed"] @ self.model.place_from_sensed.T if senses else np.full((count, 1), np.nan)
        recent = np.vstack([self._recent, np.stack([found["reference"], motion[:, 0], found["position"]], axis=1)])
        self._recent = recent[-round(JUDGED * self.driver.rate) :]
        return first, {**found, "motion": motion, "target": np.zeros((count, 0), complex)}

    def figures(self) -> list[tuple[float, float, float, float]]:
        """Return frequency (Hz), target, achieved (m) and relative error of every band, from the latest telemetry.

        Of a texture that is no sum of bands the amplitudes are rms, over the last quarter of a second.
        """
        if self._texture is not None and len(self._recent):
            reference, motion, _ = (self._recent - self._recent.mean(axis=0)).T
            target, achieved, off = (float(np.sqrt(np.mean(x**2))) for x in (reference, motion, motion - reference))
            return [(0.0, target, achieved, off / target if target > 0.0 else math.nan)]
        speed = np.nan_to_num(abs(np.diff(self._recent[:, 2]))).sum() * self.driver.rate / max(len(self._recent) - 1, 1)
        rows, frequency = [], self._bands.frequency + self._bands.wavenumber * speed
        for hertz, band in zip(frequency, self._client.telemetry().bands, strict=False):
            moves = float(hertz > 0.0)  # a grating under a finger that rests has no amplitude
            size, error = moves * abs(band.target), abs(band.measured - band.target)
            rows.append((float(hertz), size, moves * abs(band.measured), error / size if size > 0.0 else math.nan))
        return rows

    def fault(self) -> HapticError | None:
        """Return why the board stopped the drive, if it did."""
        return self._fault


def playable(rendering: Rendering, board: Capabilities) -> tuple[Bands, BoardTexture | None]:
    """Return what a board plays of a rendering: its bands, or none and a texture, which `BoardTexture` may refuse.

    A screen plays all as textures: its law makes friction of a waveform's derivative.
    """
    bands, texture = rendering.bands, rendering.scene.texture
    if bands.envelope is not None and len(bands) and not (bands.modulated or board.friction):
        return bands, None
    return Bands.none(spatial=False), BoardTexture(texture, board, rendering.model, rendering.waveform_of)
