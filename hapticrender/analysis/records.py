"""What the analysis of recordings finds, each number with its standard error."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from hapticrender.protocols import Array

UNLOADED, DOUBTFUL, LOADED = 0, 1, 2  # contact of a sample
KINDS = {UNLOADED: "unloaded", DOUBTFUL: "doubtful", LOADED: "loaded"}


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over time."""

    value: Array  # (n,), in SI; NaN where the quantity is not defined
    standard_error: Array  # (n,), of each in the same unit; NaN where `value` is
    bandwidth: float  # Hz, at which the estimator passes half of the power


@dataclass(frozen=True)
class Segment:
    """A span of one kind of contact: `kind` is UNLOADED, DOUBTFUL or LOADED, `start` and `stop` are in s."""

    kind: int
    start: float
    stop: float


@dataclass(frozen=True, eq=False)
class Impedance:
    """Mechanical impedance of the finger over time and frequency, ``Z_f = F_f / v`` at the finger.

    Consecutive windows are independent: each is as long as the estimator's memory.  The standard errors of real and
    imaginary part are taken as equal and independent.
    """

    time: Array  # (n,), s: middle of each window
    frequency: Array  # (n, bands), Hz: carrier in the middle of each window
    value: Array  # complex (n, bands), N s/m; NaN where it is masked
    standard_error: Array  # (n, bands), N s/m: of the real part, and of the imaginary part
    normal_load: Array  # (n,), N
    position: Array  # (n,), m
    velocity: Array = field(default_factory=lambda: np.zeros((0, 0), complex))  # amplitude of v, m/s: (n, bands)

    @property
    def force(self) -> Array:
        """Amplitude of the finger's force F_f = Z_f v (N, complex); its standard error is that of Z_f times abs(v)."""
        return np.asarray(self.value * self.velocity)


@dataclass(frozen=True, eq=False)
class PlateTrack:
    """The plate's "stiffness_1", "stiffness_2" (N/m), "damping_1" and "damping_2" (N s/m) over time."""

    time: Array  # (n,), s
    values: dict[str, Array]  # (n,) each
    standard_errors: dict[str, Array]
    measured: bool  # they come from unloaded spans of the recording; otherwise they are the profile's


@dataclass(frozen=True, eq=False)
class Touch:
    """Estimates of a finger over time."""

    time: Array  # (n,), s, evenly spaced
    normal_load: Series  # N
    position: Series  # m from the middle of the surface
    velocity: Series  # m/s
    contact: Array  # int (n,): UNLOADED, DOUBTFUL or LOADED


def joined(parts: Sequence[Any]) -> Any:
    """Join consecutive spans: of a `Touch`, and so of each `Series` and array in it."""
    first = parts[0]
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, float):
        return first
    return type(first)(*(joined([getattr(part, each.name) for part in parts]) for each in fields(first)))


@dataclass(frozen=True, eq=False)
class FingerRecord(Touch):
    """Measured quantities of the finger in a recording, whose `name` it has.

    Over `time` (s, shape (n,), evenly spaced): `normal_load` (N), `position` (m from the middle of the surface) and
    `velocity` (m/s), a `Series` each, and `contact` (UNLOADED, DOUBTFUL or LOADED); `segments` are its spans of one
    kind, in order.  `impedance` is the finger's; `plate` has the plate's parameters over time; from `least_load` (N) on
    the position's standard error is below 1 mm; `notes` state what could not be measured, and why.
    """

    name: str
    segments: tuple[Segment, ...]
    plate: PlateTrack
    impedance: Impedance
    least_load: float
    notes: tuple[str, ...] = ()

    def of_kind(self, kind: int) -> tuple[Segment, ...]:
        """Segments of one kind of contact."""
        return tuple(each for each in self.segments if each.kind == kind)

    def at(self, time: Array) -> Array:
        """Indices of the samples nearest to times (s)."""
        step = self.time[1] - self.time[0] if len(self.time) > 1 else 1.0
        return np.clip(np.rint((np.asarray(time) - self.time[0]) / step).astype(int), 0, len(self.time) - 1)
