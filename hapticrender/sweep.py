"""Render many scenes, in this thread or on any executor.

``ProcessPoolExecutor()`` of `concurrent.futures` is one, ``Client(address).get_executor()`` of dask another.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import partial
from typing import Any

from hapticrender import checks
from hapticrender.errors import HapticError
from hapticrender.loop import render
from hapticrender.recordings.recording import Recording
from hapticrender.touch.scene import Scene

AT_A_TIME = 16  # scenes sent to a process at once: enough to be worth it


class SweepError(HapticError):
    """A scene of a sweep failed; its number, its name and the cause are in the message."""


def sweep(
    scenes: Iterable[Scene],
    judge: Callable[[Recording], Any] | None = None,
    *,
    method: str | None = None,
    executor: Executor | None = None,
    at_a_time: int = AT_A_TIME,
) -> list[Any]:
    """Render every scene, of any device, on its simulated device; return in order what `judge` makes of each recording.

    `judge` takes a `Recording` and returns what is kept of it, by default its summary; for an executor of other
    processes it is a function of a module.  `method` is the name of a control method, by default that of each scene;
    `executor` is by default this thread; one that has processes hands `at_a_time` (>= 1) scenes at once to each of them
    (`chunksize` of its `map`, which others ignore).  A `SweepError` where a scene fails; tasks that have not begun are
    cancelled.

    Examples
    --------
    >>> import hapticrender as hr
    >>> scenes = [hr.Scene(texture=hr.Grating(frequency=f, amplitude=1e-5), duration=1.0) for f in (47.0, 111.0)]
    >>> [worst < 0.02 for worst in sweep(scenes, worst_error)]
    [True, True]
    """
    at_a_time = checks.integer("at_a_time", at_a_time, "scenes", least=1)
    checks.require(isinstance(scenes, Iterable), "scenes", scenes, "scenes, in a list for example", TypeError)
    spread = map if executor is None else partial(executor.map, chunksize=at_a_time)
    run = partial(_run, judge=judge, method=method)
    return list(spread(run, list(enumerate(scenes))))  # where one raises, `Executor.map` cancels the others


def worst_error(recording: Recording) -> float:
    """Waveform error at the worst place; infinite where nothing can be judged."""
    errors = [figures["waveform_error"] for figures in recording.waveform["places"].values() if figures]
    return max(errors, default=float("inf"))


def _run(numbered: tuple[int, Scene], judge: Callable[[Recording], Any] | None, method: str | None) -> Any:
    """Result of a scene, by its number."""
    index, scene = numbered
    try:
        recording = render(scene, method=method)
        return recording.summary() if judge is None else judge(recording)
    except Exception as error:
        name = getattr(scene, "name", type(scene).__name__)
        problem = f"scenes[{index}] ({name!r}): {type(error).__name__}: {error}"
        raise SweepError(problem) from None  # a cause might not be pickled
