"""Finger trajectories: position as a pure function of time."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from hapticrender.checks import Validated, checked, exactly_one, keep, numbers, parameter, rising
from hapticrender.protocols import Array

FARTHEST = 1.0  # m from the middle; each renderer checks its own surface
LONGEST_TIME = 360_000.0  # s: 100 h
MOST_SPEED = 10.0  # m/s


@dataclass(frozen=True)
class Nowhere:
    """No finger at all: the position is NaN at all times."""

    kind: ClassVar[str] = "none"

    def position(self, time: Array) -> Array:
        """NaN, shape (n,)."""
        return np.full(np.shape(time), np.nan)


@dataclass(frozen=True)
class Still(Validated):
    """A finger that rests `at` a position (m from the middle of the surface)."""

    kind: ClassVar[str] = "still"

    at: float = parameter(0.0, "m", least=-FARTHEST, most=FARTHEST)

    def position(self, time: Array) -> Array:
        """Position (m, shape (n,))."""
        return np.full(np.shape(time), self.at)


@dataclass(frozen=True)
class TriangleMotion(Validated):
    """Constant speed, back and forth between two ends; starts at the centre, towards the positive end.

    Examples
    --------
    >>> TriangleMotion(speed=0.1, span=0.05).position(np.array([0.0, 0.25, 0.5, 0.75])).round(9).tolist()
    [0.0, 0.025, 0.0, -0.025]
    """

    kind: ClassVar[str] = "sliding"

    speed: float = parameter(unit="m/s", above=0, most=MOST_SPEED)
    span: float = parameter(0.05, "m", least=1e-4, most=FARTHEST)  # between the ends
    centre: float = parameter(0.0, "m", least=-FARTHEST, most=FARTHEST)  # from the middle of the surface

    def position(self, time: Array) -> Array:
        """Position (m, shape (n,)): a triangle wave."""
        turns = np.asarray(time, float) * (self.speed / (2 * self.span)) + 0.25
        turns -= np.floor(turns)
        return self.centre + self.span * (0.5 - np.abs(2 * turns - 1))


@dataclass(frozen=True)
class SineMotion(Validated):
    """Sinusoidal swipes, ``centre + stroke/2 sin(2 pi frequency t)``."""

    kind: ClassVar[str] = "swiping"

    frequency: float = parameter(unit="Hz", least=1e-3, most=100)  # of whole back-and-forth swipes
    speed: float | None = parameter(None, "m/s", above=0, most=MOST_SPEED)  # peak, pi frequency stroke; or else
    stroke: float | None = parameter(None, "m", above=0, most=FARTHEST)  # from end to end
    centre: float = parameter(0.0, "m", least=-FARTHEST, most=FARTHEST)  # from the middle of the surface

    def __post_init__(self) -> None:
        super().__post_init__()
        exactly_one(speed=self.speed, stroke=self.stroke)

    def position(self, time: Array) -> Array:
        """Position (m, shape (n,))."""
        stroke = self.stroke if self.speed is None else self.speed / (np.pi * self.frequency)
        turns = np.mod(np.asarray(time, float) * self.frequency, 1.0)
        return self.centre + stroke / 2 * np.sin(2 * np.pi * turns)  # type: ignore[operator]


@dataclass(frozen=True)
class Sampled(Validated):
    """Positions measured or made elsewhere, joined by straight lines and held at both ends.

    Examples
    --------
    >>> Sampled(positions=[0.0, 0.01], times=[1.0, 2.0]).position(np.array([0.0, 1.5, 9.0])).tolist()
    [0.0, 0.005, 0.01]
    """

    kind: ClassVar[str] = "sampled"

    positions: tuple[float, ...] = checked(numbers, unit="m", least=-FARTHEST, most=FARTHEST)
    rate: float | None = parameter(None, "Hz", least=1e-3, most=1e7)  # of the samples, the first at t = 0; or else
    times: tuple[float, ...] | None = None  # s, of each sample, rising, >= 0

    def __post_init__(self) -> None:
        super().__post_init__()
        exactly_one(rate=self.rate, times=self.times)
        if self.times is not None:
            keep(self, times=rising("times", self.times, len(self.positions)))

    @cached_property
    def _curve(self) -> tuple[Array, Array]:
        positions = np.array(self.positions)
        times = np.array(self.times) if self.rate is None else np.arange(positions.size) / self.rate
        return times, positions

    def position(self, time: Array) -> Array:
        """Position (m, shape (n,))."""
        return np.interp(np.asarray(time, float), *self._curve)
