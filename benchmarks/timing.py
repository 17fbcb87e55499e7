"""Time two runs in turns, so that other work of the machine affects both alike."""

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


class Absent(RuntimeError):
    """A compiler or package that a benchmark compares with is not installed."""


@dataclass(frozen=True)
class Figure:
    """One line of the table: a ratio against a named reference in the same run, with its target and its floor."""

    name: str
    measured: float
    unit: str
    target: float
    floor: float
    at_least: bool
    reference: str
    note: str = ""

    def within(self, margin: float = 1.0) -> bool:
        """Whether the figure stays within `margin` times its floor."""
        if self.at_least:
            return self.measured >= self.floor / margin
        return self.measured <= self.floor * margin

    def __str__(self) -> str:
        sign, value = ">=" if self.at_least else "<=", f"{self.measured:.3g} {self.unit}"
        verdict = "met" if self.within() else "MISSED"
        row = f"{self.name:<56} {value:>11} target {self.target:<5g} floor {sign} {self.floor:<5g} {verdict:<6} "
        return f"{row}{self.reference}; {self.note}".rstrip("; ")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def compare(
    candidate: Callable[[], object],
    reference: Callable[[], object],
    pairs: int,
    clock: Callable[[], float] = time.thread_time,
) -> tuple[float, float, float]:
    """Median seconds of candidate and reference, and median of the pairs' ratios reference/candidate.

    Each timed run follows an untimed one of its own: caches and wide registers are as in steady operation.
    """  # fmt: skip

    def seconds(run: Callable[[], object]) -> float:
        run()
        start = clock()
        run()
        return clock() - start

    rows = [(seconds(candidate), seconds(reference)) for _ in range(pairs)]
    ours, theirs = (statistics.median(column) for column in zip(*rows, strict=True))
    return ours, theirs, statistics.median(reference / candidate for candidate, reference in rows)
