"""What the analysis of a recording finds, each number with its standard error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hapticrender.protocols import Array

UNLOADED, DOUBTFUL, LOADED = 0, 1, 2  # contact of a sample
KINDS = {UNLOADED: "unloaded", DOUBTFUL: "doubtful", LOADED: "loaded"}


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over time.

    Parameters
    ----------
    value : ndarray, shape (n,)
        Estimates in SI; NaN where the quantity is not defined.
    standard_error : ndarray, shape (n,)
        Standard error of each, in the same unit; NaN where `value` is.
    bandwidth : float
        Frequency at which the estimator passes half of the power (Hz).
    """

    value: Array
    standard_error: Array
    bandwidth: float


@dataclass(frozen=True)
class Segment:
    """A span of one kind of contact: `kind` is UNLOADED, DOUBTFUL or LOADED, `start` and `stop` are in s."""

    kind: int
    start: float
    stop: float


@dataclass(frozen=True, eq=False)
class Impedance:
    """Mechanical impedance of the finger over time and frequency, ``Z_f = F_f / v`` at the finger.

    Consecutive windows are independent: each is as long as the estimator's memory.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Middle of each window (s).
    frequency : ndarray, shape (n, bands)
        Carrier in the middle of each window (Hz).
    value : ndarray of complex, shape (n, bands)
        Impedance (N s/m); NaN where it is masked.
    standard_error : ndarray, shape (n, bands)
        Standard error of the real part and of the imaginary part (N s/m), which are taken as equal and independent.
    normal_load, position : ndarray, shape (n,)
        Of the finger (N, m).
    velocity : ndarray of complex, shape (n, bands), optional
        Amplitude of the velocity v at the finger (m/s).
    """

    time: Array
    frequency: Array
    value: Array
    standard_error: Array
    normal_load: Array
    position: Array
    velocity: Array = field(default_factory=lambda: np.zeros((0, 0), complex))

    @property
    def force(self) -> Array:
        """Amplitude of the finger's force F_f = Z_f v (N, complex); its standard error is that of Z_f times abs(v)."""
        return np.asarray(self.value * self.velocity)


@dataclass(frozen=True, eq=False)
class PlateTrack:
    """The plate's stiffness and damping over time.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Times (s).
    values, standard_errors : mapping of str to ndarray, shape (n,)
        Of "stiffness_1", "stiffness_2" (N/m), "damping_1" and "damping_2" (N s/m).
    measured : bool
        Whether they come from unloaded spans of the recording; otherwise they are the profile's.
    """

    time: Array
    values: dict[str, Array]
    standard_errors: dict[str, Array]
    measured: bool


@dataclass(frozen=True, eq=False)
class Touch:
    """Estimates of a finger over time.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Times of the series (s), evenly spaced.
    normal_load, position, velocity : Series
        In N, m from the middle of the surface, and m/s.
    contact : ndarray of int, shape (n,)
        UNLOADED, DOUBTFUL or LOADED.
    """

    time: Array
    normal_load: Series
    position: Series
    velocity: Series
    contact: Array


def joined(parts: Sequence[Touch]) -> Touch:
    """Join consecutive spans."""
    time, contact = (np.concatenate([getattr(part, name) for part in parts]) for name in ("time", "contact"))
    names = ("normal_load", "position", "velocity")
    load, position, velocity = (_joined([getattr(part, name) for part in parts]) for name in names)
    return Touch(time, load, position, velocity, contact)


def _joined(parts: Sequence[Series]) -> Series:
    value, error = (np.concatenate([getattr(part, name) for part in parts]) for name in ("value", "standard_error"))
    return Series(value, error, parts[0].bandwidth)


@dataclass(frozen=True, eq=False)
class FingerRecord(Touch):
    """Measured quantities of the finger in a recording.

    Parameters
    ----------
    name : str
        Of the recording.
    segments : tuple of Segment
        Spans of one kind of contact, in order.
    plate : PlateTrack
        The plate's parameters over time.
    impedance : Impedance
        Of the finger.
    least_load : float
        Load (N) from which on the position's standard error is below 1 mm.
    notes : tuple of str
        What could not be measured, and why, a sentence each.
    """

    name: str
    segments: tuple[Segment, ...]
    plate: PlateTrack
    impedance: Impedance
    least_load: float
    notes: tuple[str, ...] = field(default=())

    def of_kind(self, kind: int) -> tuple[Segment, ...]:
        """Segments of one kind of contact."""
        return tuple(each for each in self.segments if each.kind == kind)

    def at(self, time: Array) -> Array:
        """Indices of the samples nearest to times (s)."""
        step = self.time[1] - self.time[0] if len(self.time) > 1 else 1.0
        return np.clip(np.rint((np.asarray(time) - self.time[0]) / step).astype(int), 0, len(self.time) - 1)
