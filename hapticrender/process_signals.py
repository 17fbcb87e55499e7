"""Signals that end the process: Ctrl-C, SIGTERM, SIGHUP.

Python runs their handlers in the main thread, and lets only that one set them.  The first signal raises an exception
there; further ones wait until what plays is at rest and closed.
"""

from __future__ import annotations

import atexit
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

DEFAULT: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}  # what they do otherwise
DEFAULT |= {getattr(signal, name): signal.SIG_DFL for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)}
GUARDED: list[BaseException | None] = []  # for each guard that is open, the exception that was handled as it opened
CLOSING: list[None] = []  # an entry for each device that is being set to rest
WAITING: list[int] = []  # signals that came meanwhile
ENDED = 5.0  # s: longest wait for a run at the end of the program


class Terminated(SystemExit):
    """SIGTERM or SIGHUP: ends the process by an exception, so that devices are left at rest."""


def _error(number: int) -> BaseException:
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(128 + number)


def _end(number: int, frame: object) -> None:
    """Handle a signal: raise its exception, unless an earlier one is on its way, or a device is being set to rest."""
    error = sys.exception()
    if not GUARDED:  # the last guard was closed by another thread, which cannot restore what was there before
        signal.signal(number, DEFAULT[number])
        signal.raise_signal(number)
    elif CLOSING or (isinstance(error, KeyboardInterrupt | Terminated) and error not in GUARDED):
        WAITING.append(number)
    else:
        raise _error(number)


def _main() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextmanager
def stopped_by_signal() -> Iterator[None]:
    """Turn the signals of `DEFAULT` into exceptions in the main thread; may be nested, or overlap.

    One that somebody else handles, or that `nohup` ignores, is left alone, and so are all where another thread enters.
    """
    ours = [each for each in DEFAULT if _main() and signal.getsignal(each) in (DEFAULT[each], _end)]
    if not ours:
        yield
        return
    GUARDED.append(own := sys.exception())
    for each in ours:
        signal.signal(each, _end)
    try:
        yield
    finally:
        GUARDED.remove(own)
        for each in DEFAULT if _main() and not GUARDED else ():
            if signal.getsignal(each) is _end:
                signal.signal(each, DEFAULT[each])
        if WAITING:
            number = WAITING.pop()
            WAITING.clear()
            if _main():
                raise _error(number)
            signal.raise_signal(number)


@contextmanager
def signals_wait() -> Iterator[None]:
    """Let signals wait until the guard is closed."""
    CLOSING.append(None)
    try:
        yield
    finally:
        CLOSING.pop()


@contextmanager
def ended_with_program() -> Iterator[threading.Event]:
    """Set an event where the program ends before what is within, in a daemon thread, and wait for that to end."""
    ending, ended = threading.Event(), threading.Event()

    def end() -> None:
        ending.set()
        ended.wait(ENDED)

    atexit.register(end)
    try:
        yield ending
    finally:
        ended.set()
        atexit.unregister(end)
