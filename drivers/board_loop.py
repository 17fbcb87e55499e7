"""A board in live play: the loop runs on the board, and `hapticrender.Player` asks it what it asks a `LiveLoop`."""

from __future__ import annotations

import numpy as np

from hapticrender.bands import Bands
from hapticrender.drivers.serial import SerialDriver
from hapticrender.errors import DeviceFault
from hapticrender.live import Row, Signals
from hapticrender.protocols import Array, Flag, Rendering

TELEMETRY = 0.05  # s between two frames of telemetry


class BoardLoop:
    """A rendering that plays on a board.

    Parameters
    ----------
    rendering : Rendering
        With a texture of constant amplitudes: a board plays bands.
    driver : SerialDriver
    stream : int
        Samples between two rows that the board streams back, for a recording.
    """

    whole, silent, senses = True, False, False  # textures are exchanged under one law; the host says where the finger is
    motion_source = "sensors"

    def __init__(self, rendering: Rendering, driver: SerialDriver, stream: int = 1) -> None:
        self.rendering, self.driver, self.model = rendering, driver, rendering.model
        self.flags = Flag(0)
        self._client, self._stream = driver.client, stream
        self._gain = self._gain_played = 1.0
        self._bands = _playable(rendering)
        self._first: int | None = None
        self._samples = self._streamed = 0

    def start(self) -> None:
        """Set the bands, and play; the port is open."""
        self._client.set_bands(self._bands)
        self._client.gain = self._gain
        self._first = self._client.start(stream=self._stream, telemetry=TELEMETRY)
        self._reader = self.driver.reader(self._first, self._stream)

    def exchange(self, rendering: Rendering) -> None:
        """Glide to the bands of another rendering of the same device, within 20 ms."""
        bands = _playable(rendering)
        self._client.set_bands(bands)
        self.rendering, self._bands = rendering, bands
