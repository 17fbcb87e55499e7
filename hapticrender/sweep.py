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
from hapticrender.judge import fit
from hapticrender.protocols import Array

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
    """Relative amplitude error of every band from `start` (s) on, rms over windows of 0.1 s, shape (3, bands)."""
    scenario, rate = played.scenario, played.scenario.plate.rate
    size = int(round(LENGTH * rate))
    first = np.arange(int(start * rate), len(played.motion) - size + 1, size)
    if not len(first):
        raise ValueError(f"{len(played.motion) / rate:g} s: must be >= {start + LENGTH:g} s to be judged")
    index = first[:, None] + np.arange(size)
    position = np.nan_to_num(played.position)
    phase = scenario.bands.carrier_phase(np.arange(len(played.motion)) / rate, position)
    found = fit(phase[index], played.motion[index])[0]
    return np.sqrt(np.mean((abs(found) / abs(np.asarray(scenario.bands.envelope)) - 1.0) ** 2, axis=0))


def worst_error(played: Played) -> float:
    """Largest of `errors` at the centre."""
    return float(errors(played)[0].max())
