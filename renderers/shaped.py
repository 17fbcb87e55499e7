"""Drivers behind a square root of their drive, or a carrier, which a renderer puts before a user's device."""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hapticrender.checks import require
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.defaults import FADE
from hapticrender.jit import CONVERSION, CFunction, record_of
from hapticrender.protocols import Array, Driver, Sensed
from hapticrender.renderers.conversions import ROOT, magnitude_sense, root_act

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
    """A driver whose drive or measurements are converted on the way; a subclass fills in `play`, by `put`, and steps.

    Compiled steps convert: `act` makes `played` of the controller's drive, `sense` what the controller gets of `raw`
    (see `jit.CONVERSION`), from a `state`.  A `RealtimeEntry` takes the same steps where the device calls back, and
    refuses a driver that has none.  A sample of the controller is `hold` of the device.  While `resting` the device's
    own drive fades to zero: what zero drive of the controller becomes may be a bias.
    """

    motion_source = "true"  # of the motion that `play` returns, where it does
    resting = False  # set by the loop from a stop on
    act: CFunction | None = None
    sense: CFunction | None = None
    state: Array

    def __init__(self, driver: Driver, hold: int = 1) -> None:
        self.driver, self.hold = driver, hold
        self.rate, self.block, self.delay = driver.rate / hold, max(driver.block // hold, 1), driver.delay // hold
        self.drive_channels, self.sensed_channels = driver.drive_channels, driver.sensed_channels
        self._level = 1.0  # factor on the device's drive
        rows, long = self.block, self.block * hold
        self.signals = {
            "drive": np.zeros((rows, self.drive_channels)),
            "played": np.zeros((long, self.drive_channels)),
            "raw": np.zeros((long, self.sensed_channels)),
            "sensed": np.zeros((rows, self.sensed_channels)),
            "finger": np.zeros((rows, 2)),
            "flags": np.zeros(rows, np.int64),
        }
        if self.sense is None:
            self.signals["sensed"] = self.signals["raw"]
        self.conversion = record_of(CONVERSION, **self.signals)

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
        for each in (self.act, self.sense):
            _ = each and each.address  # compiled before anything is live
        self.driver.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.driver.__exit__(*exc)


def thinned(sensed: Sensed, hold: int) -> Sensed:
    """Measurements once in `hold` samples; flags of all of them."""
    first = Sensed._make(None if column is None else column[::hold] for column in sensed)
    if sensed.flags is None:
        return first
    return first._replace(flags=np.bitwise_or.reduce(np.reshape(sensed.flags, (-1, hold)), axis=1))


class ShapedDriver(WrappedDriver):
    """A driver whose last channel plays a root of the drive: the peak of a carrier, sample by sample.

    What it senses, or knows, of the friction is taken as a magnitude: a tribometer that keeps the sign of the lateral
    force changes it with the finger's direction, and the friction does not.
    """

    act, sense = root_act, magnitude_sense

    def __init__(self, driver: Driver, root: Any, hold: int = 1, turn: float = 0.0) -> None:
        super().__init__(driver, hold)
        numbers = {"channels": self.drive_channels, "sensors": self.sensed_channels, "hold": hold, "gain": 1.0}
        numbers["rise"] = 1.0 / round(FADE * self.rate)
        crest = 1.0 / float(np.sinc(turn))  # of a carrier behind the device's hold
        self.state = record_of(ROOT, **numbers, turn=turn, crest=crest)
        if root is not None:
            self.reshape(root)
            self.state["bias"] = root.bias

    def reshape(self, root: Any) -> None:
        """Let the bias rise to that of another `SquareRoot` within `FADE`; a smaller one is not taken."""
        values = {"floor": root.floor / root.bias, "gain": root.gain, "straight": root.straight, "goal": root.bias}
        for name, value in values.items():  # the goal last: until then a callback has no bias, or what it had before
            self.state[name] = value

    def convert(self, drive: Array) -> Array:
        """Return what is played for a block of the controller's drive."""
        self.signals["drive"][:] = drive
        root_act(self.state.ctypes.data, self.conversion.ctypes.data, 0, self.block)
        return self.signals["played"].copy()

    def play(self, drive: Array) -> Sensed:
        """Play a block behind the root."""
        sensed = self.put(self.convert(drive))
        motion = None if sensed.motion is None else np.abs(sensed.motion)
        return thinned(sensed._replace(sensed=np.abs(sensed.sensed), motion=motion), self.hold)


class CarrierDriver(ShapedDriver):
    """A driver without sensors that plays the carrier itself: ``root(drive) cos(2 pi frequency t)``.

    To the controller it is a device at a whole part of the driver's rate, whose drive is held: the lowest rate >=
    `envelope_rate` (Hz) that block and delay allow.  The carrier (`frequency`, Hz) starts at its crest, so that a
    device that blocks direct current keeps no charge.
    """

    sense = None

    def __init__(self, driver: Driver, root: Any, *, frequency: float, envelope_rate: float) -> None:
        senses, least = driver.sensed_channels, LEAST_SAMPLES * frequency
        bound = "0 where output = 'carrier'; a driver that senses gets the envelope"
        require(not senses, "driver.sensed_channels", senses, bound)
        bound = f">= {least:g} Hz where output = 'carrier', {LEAST_SAMPLES} samples a turn of {frequency:g} Hz"
        require(driver.rate >= least, "driver.rate", driver.rate, bound)
        whole, most = math.gcd(driver.block, driver.delay), max(int(driver.rate / envelope_rate), 1)
        hold = max(each for each in range(1, min(whole, most) + 1) if whole % each == 0)
        super().__init__(driver, root, hold, frequency / driver.rate)
