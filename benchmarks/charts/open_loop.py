"""The plate of ``tests/strangers_plate.py`` without sensors: what a method plays on it is its open loop."""

import numpy as np

from hapticrender import Sensed
from hapticrender.bands import Bands
from tests.strangers_plate import StrangersPlate


class SensorlessPlate(StrangersPlate):
    """The plate without its sensors and without what it reports of the finger."""

    sensed_channels = 0

    def play(self, drive):
        super().play(drive)
        return Sensed(np.empty((self.block, 0)), np.full(self.block, np.nan))


class AlongPath:
    """A texture read along a known path (m at times in s): a waveform in time, for which no finger is reported."""

    def __init__(self, texture, path):
        self.texture, self.path = texture, path

    def bands(self, rate):
        return Bands.none(spatial=False)

    def waveform(self, time, position):
        return self.texture.waveform(time, self.path(time))
