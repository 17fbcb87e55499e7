"""Measure two things in turns, so that what the machine does meanwhile meets both alike."""

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

Run = Callable[[], object]


@dataclass(frozen=True)
class Paired:
    """Seconds a run of candidate and reference (medians), and the pairs' ratios reference/candidate.

    `ratio` is their median; a quarter of them is below `low`, a quarter above `high`.
    """

    candidate: float
    reference: float
    ratio: float
    low: float
    high: float


CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def keep_to_one_core() -> None:
    """Stay on the core that runs this process, where the system can tell it to."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(CORES)})


def use(cores: set[int]) -> None:
    """Run on any of these, in a process that works beside others."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)


def seconds(run: Run, clock: Callable[[], float] = time.perf_counter, settled: bool = False) -> float:
    """Time of one run, after another that does not count where it is to be settled."""
    if settled:
        run()
    start = clock()
    run()
    return clock() - start


def interleave(
    candidate: Run,
    reference: Run,
    pairs: int,
    clock: Callable[[], float] = time.perf_counter,
    settled: bool = False,
) -> Paired:
    """Run both `pairs` times in turns, after one run each that does not count.

    On a core that others share, a long run meets them and a short one does not: where one takes many times as long as
    the other, and both work in this thread only, `clock` should be the thread's own, `time.thread_time`.  The short one
    also pays for what the long one left, caches and wide registers asleep (0.1 ms were seen): where both are to be seen
    as they run on and on, each run that counts is `settled` by one of its own before.
    """
    candidate()
    reference()
    rows = [(seconds(candidate, clock, settled), seconds(reference, clock, settled)) for _ in range(pairs)]
    ratios = [reference / candidate for candidate, reference in rows]
    low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive") if pairs > 1 else 3 * ratios
    return Paired(
        candidate=statistics.median(row[0] for row in rows),
        reference=statistics.median(row[1] for row in rows),
        ratio=middle,
        low=low,
        high=high,
    )
