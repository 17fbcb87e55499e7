"""A sweep over scenarios: side by side in the lanes of a core, and on as many cores or machines as an executor has.

Anything that follows `concurrent.futures.Executor` will do: a pool of processes on this machine, or a cluster::

    from concurrent.futures import ProcessPoolExecutor
    with ProcessPoolExecutor() as pool:
        worst = sweep(scenarios, 2.0, worst_error, executor=pool)

    from dask.distributed import Client
    worst = sweep(scenarios, 2.0, worst_error, executor=Client(address).get_executor())
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np

from hapticrender.batch import LANES, Played, Scenario, simulate
from hapticrender.protocols import Array
from hapticrender.recordings.judge import fit

AT_A_TIME = 4 * LANES  # scenarios a task: enough to be worth sending
LENGTH = 0.1  # s: of the windows in which envelopes are taken


def sweep(
    scenarios: Sequence[Scenario],
    seconds: float,
    judge: Callable[[Played], Any],
    *,
    method: str = "h2",
    executor: Executor | None = None,
    at_a_time: int = AT_A_TIME,
) -> list[Any]:
    """Play every scenario and keep what `judge` makes of it.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Those that differ in finger, plate, seed or amplitude only run side by side; see `simulate`.
    seconds : float, > 0
        Of each.
    judge : callable
        From `Played` to what is kept; a function of a module, where the executor has to send it to other processes.
    method : str
        Name of the control method.
    executor : concurrent.futures.Executor, optional
        Who does the work; by default this thread.
    at_a_time : int, >= 1
        Scenarios a task.

    Returns
    -------
    list
        In the order of the scenarios.

    Raises
    ------
    ValueError
        A number is out of its bound, or a target is no constant envelope.
    """
    if at_a_time < 1:
        raise ValueError(f"{at_a_time=}: must be >= 1 scenario")
    parts = [list(scenarios[start : start + at_a_time]) for start in range(0, len(scenarios), at_a_time)]
    if executor is None:
        return [found for part in parts for found in _judged(part, seconds, method, judge)]
    futures = [executor.submit(_judged, part, seconds, method, judge) for part in parts]
    try:
        return [found for future in futures for found in future.result()]
    except BaseException:
        for future in futures:
            future.cancel()
        raise


def _judged(part: list[Scenario], seconds: float, method: str, judge: Callable[[Played], Any]) -> list[Any]:
    return [judge(played) for played in simulate(part, seconds, method=method)]


def errors(played: Played, start: float = 0.5) -> Array:
    """Relative amplitude error of every band from `start` (s) on, rms over windows of 0.1 s, shape (places, bands).

    NaN for a band of which nothing is wanted.  Where carriers follow the finger, windows without it do not count.
    """
    if start < 0.0:
        raise ValueError(f"{start=}: must be >= 0 s")
    scenario, rate = played.scenario, played.scenario.plate.rate
    size = int(round(LENGTH * rate))
    first = int(start * rate)
    count = (len(played.motion) - first) // size
    if count < 1:
        raise ValueError(f"{len(played.motion) / rate:g} s: must be >= {start + LENGTH:g} s to be judged")
    part = slice(first, first + count * size)
    motion = played.motion[part].reshape(count, size, -1)
    if (scenario.bands.wavenumber > 0.0).any():
        there = np.isfinite(played.position[part]).reshape(count, size).all(axis=1)
        if not there.any():
            raise ValueError(f"the finger is never there for {LENGTH:g} s after {start:g} s")
        phase = scenario.bands.carrier_phase(np.arange(part.stop) / rate, played.position[: part.stop])[part]
        found = fit(phase.reshape(count, size, -1)[there], motion[there])[0]
    else:  # an amplitude is the same wherever its carrier begins: all windows are signals of one
        phase = scenario.bands.carrier_phase(np.arange(size) / rate, np.zeros(size))
        found = fit(phase[None], motion.transpose(1, 0, 2).reshape(1, size, -1))[0].reshape(*motion.shape[::2], -1)
    wanted = abs(np.asarray(scenario.bands.envelope))
    off = abs(found) / np.where(wanted > 0.0, wanted, np.nan) - 1.0
    return np.sqrt(np.mean(off**2, axis=0))


def worst_error(played: Played) -> float:
    """Largest of `errors` at the centre, of bands of which something is wanted."""
    found = errors(played)[0]
    return float(found[np.isfinite(found)].max(initial=0.0)) if np.isfinite(played.motion).all() else np.inf
