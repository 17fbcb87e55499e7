"""Show progress: one bar on a terminal, a line per scene elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TextIO

_WIDTH = 30  # characters


class Progress:
    """Show how much of a list of scenes of given durations (s, > 0) is done, by default on standard error.

    Examples
    --------
    >>> progress = Progress([1.0, 3.0], stream=sys.stdout)
    >>> for name in ("first", "second"):
    ...     with progress.scene(name) as tick:
    ...         tick(0.5, 1.0)
    1/2 first
    2/2 second
    """

    def __init__(self, durations: Sequence[float], stream: TextIO | None = None) -> None:
        self._durations = durations
        self._stream = sys.stderr if stream is None else stream
        self._bar = self._stream.isatty()
        self._finished = 0
        self._drawn = ""

    @contextmanager
    def scene(self, name: str) -> Iterator[Callable[[float, float], None]]:
        """Yield ``tick(done_seconds, total_seconds)`` for a scene, which counts as done unless it raises."""
        tick = partial(self._show, name)
        tick(0.0, 1.0)
        try:
            yield tick
            tick(1.0, 1.0)
            self._finished += 1
        except BaseException:
            self._write("\n" if self._bar else "")
            raise
        if not self._bar:
            self._write(f"{self._finished}/{len(self._durations)} {name}\n")
        elif self._finished == len(self._durations):
            self._write("\n")

    def _show(self, name: str, done: float, total: float) -> None:
        """Redraw the bar, when a whole percent or the scene has changed."""
        past, now = sum(self._durations[: self._finished]), self._durations[self._finished]
        share = (past + now * min(done / total, 1.0)) / sum(self._durations)
        bar = f"[{'#' * int(_WIDTH * share):.<{_WIDTH}}] {100 * share:3.0f} %  {name}"
        if self._bar and bar != self._drawn:
            self._write(f"\r{bar}\x1b[K")
            self._drawn = bar

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()
