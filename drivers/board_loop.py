"""A board in live play: the loop runs on the board, and `hapticrender.Player` asks it what it asks a `LiveLoop`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.bands import Bands
from hapticrender.drivers.row_reader import RowReader
from hapticrender.errors import DeviceFault
from hapticrender.protocols import Array, Flag, Rendering

if TYPE_CHECKING:
    from hapticrender.drivers.serial import SerialDriver

TELEMETRY = 0.05  # s between two frames of telemetry


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
        self._client, self._stream, self._gain = driver.client, stream, 1.0
        self._bands, self._fault = _playable(rendering), None
        self._reader: RowReader | None = None

    def start(self) -> None:
        """Set the bands and play; the port is open."""
        self._client.set_bands(self._bands)
        self._client.gain = self._gain
        first = self._client.start(stream=self._stream, telemetry=TELEMETRY)
        self._reader = RowReader(self._client, first, self._stream)

    def exchange(self, rendering: Rendering) -> None:
        """Glide to the texture of another rendering of the same device, within 20 ms."""
        bands = _playable(rendering)
        self._client.set_bands(bands)
        self.rendering, self._bands = rendering, bands

    def finger(self, position: float, velocity: float, load: float) -> None:
        """Say where the finger is (m, m/s, N)."""
        self._client.finger(position, velocity, load)

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, 0 to 1."""
        if gain != self._gain:
            self._client.gain = gain
            self._gain = gain

    def silence(self) -> None:
        """Fade out within 10 ms."""
        self._client.stop()

    def fill(self) -> None:
        """Look at the telemetry; a `DriverError` where board or line are gone."""
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
        model, time = self.model, (first + np.arange(count)) / self.driver.rate
        phase, envelope = self._bands.carrier_phase(time, position), self._bands.envelope
        texture = np.zeros(count) if envelope is None else (envelope * np.exp(1j * phase)).real.sum(axis=1)
        away = np.isnan(position) & self._bands.follows_finger
        return first, {
            "drive": drive,
            "sensed": sensed,
            "motion": sensed @ (model.place_from_coordinate @ model.coordinate_from_sensed).T,
            "position": position,
            "normal_load": load,
            "reference": np.where(away, 0.0, self._gain * texture),
            "target": np.zeros((count, 0), complex),
            "flags": flags,
        }

    def figures(self) -> list[tuple[float, float, float, float]]:
        """Return what the board last said of every band: frequency (Hz), target, achieved (m) and relative error."""
        rows = []
        for hertz, band in zip(self._bands.frequency, self._client.telemetry().bands, strict=False):
            size, error = abs(band.target), abs(band.measured - band.target)
            rows.append((float(hertz), size, abs(band.measured), error / size if size > 0.0 else math.nan))
        return rows

    def fault(self) -> DeviceFault | None:
        """Return why the board stopped the drive, if it did."""
        return self._fault


def _playable(rendering: Rendering) -> Bands:
    bands = rendering.bands
    if bands.envelope is None or bands.differentiated:
        kind = type(rendering.scene.texture).__name__
        raise ValueError(f"texture: {kind} is a waveform, or a force: a board plays gratings, and sums of them")
    return bands
