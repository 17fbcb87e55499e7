"""Show progress: a percentage on a terminal, and a line a scene anywhere."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO


@contextmanager
def progress(label: str, stream: TextIO) -> Iterator[Callable[[float, float], None]]:
    """Yield ``tick(done, total)`` (s), which shows the share that is done on a terminal; write `label` at the end.

    >>> import sys
    >>> with progress("1/2 first", sys.stdout) as tick:
    ...     tick(0.5, 1.0)
    1/2 first
    """
    terminal = stream.isatty()

    def tick(done: float, total: float) -> None:
        if terminal:
            print(f"\r{label} {100 * done / total:3.0f} %", end="", file=stream, flush=True)

    try:
        yield tick
    except BaseException:
        if terminal:
            print(file=stream)
        raise
    print(f"\r{label}\x1b[K" if terminal else label, file=stream, flush=True)
