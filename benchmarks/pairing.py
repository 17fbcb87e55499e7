"""Measure two things in turns, so that what the machine does meanwhile meets both alike."""

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

Run = Callable[[], object]


@dataclass(frozen=True)
class Paired:
    """Seconds a run of candidate and reference (medians), and the median of the pairs' ratios reference/candidate."""

    candidate: float
    reference: float
    ratio: float


CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def keep_to_one_core() -> None:
    """Stay on the core that runs this process, where the system can tell it to."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(CORES)})


def use(cores: set[int]) -> None:
    """Run on any of these, in a process that works beside others."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)


def seconds(run: Run) -> float:
    """Wall-clock time of one run."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def interleave(candidate: Run, reference: Run, pairs: int) -> Paired:
    """Run both `pairs` times in turns, after one run each that does not count."""
    candidate()
    reference()
    rows = [(seconds(candidate), seconds(reference)) for _ in range(pairs)]
    return Paired(
        candidate=statistics.median(row[0] for row in rows),
        reference=statistics.median(row[1] for row in rows),
        ratio=statistics.median(row[1] / row[0] for row in rows),
    )
