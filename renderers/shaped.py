"""Drivers behind a static characteristic of their drive, which a renderer puts before a user's device."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hapticrender.checks import require
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.protocols import Array, Driver, Sensed

LEAST_SAMPLES = 4  # in a turn of a carrier


@dataclass(frozen=True)
class Port:
    """Numbers of a driver, or of a part of one, on which a device model depends."""

    rate: float  # Hz
    delay: int  # samples
    block: int  # samples
    drive_channels: int = 1
    sensed_channels: int = 1
    plant: Any = None  # what is simulated behind it


class WrappedDriver:
    """A driver whose drive or measurements are converted on the way; a subclass fills in `play`, by `put`.

    While `resting` the device's own drive fades to zero: what zero drive of the controller becomes may be a bias.
    """

    motion_source = "true"  # of the motion that `play` returns, where it does
    resting = False  # set by the loop from a stop on
    calls_back = False  # whether a `RealtimeEntry` with the square root converts the drive as `play` does

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.rate, self.block, self.delay = driver.rate, driver.block, driver.delay
        self.drive_channels, self.sensed_channels = driver.drive_channels, driver.sensed_channels
        self._level = 1.0  # factor on the device's drive

    def put(self, drive: Array) -> Sensed:
        """Play a block of the device's own drive."""
        if not self.resting:
            self._level = 1.0
            return self.driver.play(drive)
        fade = np.arange(1, len(drive) + 1) / (FADE_OUT * self.driver.rate)
        level = np.maximum(self._level - fade, 0.0)
        self._level = float(level[-1])
        return self.driver.play(level[:, None] * drive)

    def __enter__(self) -> Self:
        self.driver.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.driver.__exit__(*exc)


def thinned(sensed: Sensed, hold: int) -> Sensed:
    """Measurements once in `hold` samples; flags of all of them."""
    first = Sensed(*(None if column is None else column[::hold] for column in sensed))
    if sensed.flags is None:
        return first
    return first._replace(flags=np.bitwise_or.reduce(np.reshape(sensed.flags, (-1, hold)), axis=1))


class ShapedDriver(WrappedDriver):
    """A driver that plays `shape` of its drive: the device's from the controller's, sample by sample (n, channels).

    What it senses, or knows, of the friction is taken as a magnitude: a tribometer that keeps the sign of the lateral
    force changes it with the finger's direction, and the friction does not.
    """

    calls_back = True

    def __init__(self, driver: Driver, shape: Callable[[Array], Any]) -> None:
        super().__init__(driver)
        self.shape = shape

    def play(self, drive: Array) -> Sensed:
        """Play `shape` of a block."""
        sensed = self.put(self.shape(drive))
        motion = None if sensed.motion is None else np.abs(sensed.motion)
        return sensed._replace(sensed=np.abs(sensed.sensed), motion=motion)


class CarrierDriver(ShapedDriver):
    """A driver without sensors that plays the carrier itself: ``shape(drive) cos(2 pi frequency t)``.

    To the controller it is a device at a whole part of the driver's rate, whose drive is held: the lowest rate >=
    `envelope_rate` (Hz) that block and delay allow.  The carrier (`frequency`, Hz) starts at its crest, so that a
    device that blocks direct current keeps no charge.
    """

    calls_back = False

    def __init__(
        self, driver: Driver, shape: Callable[[Array], Any], *, frequency: float, envelope_rate: float
    ) -> None:
        senses, least = driver.sensed_channels, LEAST_SAMPLES * frequency
        bound = "0 where output = 'carrier'; a driver that senses gets the envelope"
        require(not senses, "driver.sensed_channels", senses, bound)
        bound = f">= {least:g} Hz where output = 'carrier', {LEAST_SAMPLES} samples a turn of {frequency:g} Hz"
        require(driver.rate >= least, "driver.rate", driver.rate, bound)
        super().__init__(driver, shape)
        whole = math.gcd(driver.block, driver.delay)
        most = max(int(driver.rate / envelope_rate), 1)
        self.hold = max(each for each in range(1, min(whole, most) + 1) if whole % each == 0)
        self.rate = driver.rate / self.hold
        self.block, self.delay = driver.block // self.hold, driver.delay // self.hold
        self._step, self._turns = frequency / driver.rate, 0.0  # turns a sample; phase of the next one
        self._droop = float(np.sinc(self._step))  # of the carrier behind the device's hold

    def play(self, drive: Array) -> Sensed:
        """Play the carrier under `shape` of a block."""
        count = len(drive) * self.hold
        carrier = np.cos(2 * np.pi * (self._turns + self._step * np.arange(count))) / self._droop
        self._turns = (self._turns + self._step * count) % 1.0
        sensed = self.put(np.repeat(self.shape(drive), self.hold, axis=0) * carrier[:, None])
        return thinned(sensed, self.hold)
