"""Signals that end the process, which Python handles in the main thread.

The first one raises an exception there; further ones wait until what plays is at rest and closed.
"""

import atexit
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

DEFAULT: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}  # Ctrl-C; what they do otherwise
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
    """Raise the exception of a signal; not while that of an earlier one is handled, or a device is set to rest."""
    error = sys.exception()
    if not GUARDED:  # the last guard was closed by another thread, which may not restore the handler
        signal.signal(number, DEFAULT[number])
        signal.raise_signal(number)
    elif CLOSING or (isinstance(error, KeyboardInterrupt | Terminated) and error not in GUARDED):
        WAITING.append(number)
    else:
        raise _error(number)


def _exchange(old: dict[int, Any], new: dict[int, Any]) -> None:
    """Replace handlers; those of somebody else, as of `nohup`, stay, and so do all in another thread than the main."""
    with suppress(ValueError):
        for each in old:
            if signal.getsignal(each) is old[each]:
                signal.signal(each, new[each])


@contextmanager
def stopped_by_signal(wait: bool = False) -> Iterator[None]:
    """Turn signals into exceptions where the main thread enters; may be nested, or overlap; or let them `wait`."""
    own, waits, ours = sys.exception(), [None] * wait, dict.fromkeys(DEFAULT, _end)
    _exchange(DEFAULT, ours)
    GUARDED.append(own)
    CLOSING.extend(waits)
    try:
        yield
    finally:
        del CLOSING[: len(waits)]
        GUARDED.remove(own)
        if not GUARDED:
            _exchange(ours, DEFAULT)
        if WAITING and not CLOSING:
            number = WAITING.pop()
            WAITING.clear()
            if threading.current_thread() is threading.main_thread():
                raise _error(number)
            signal.raise_signal(number)


@contextmanager
def ended_with_program() -> Iterator[threading.Event]:
    """Set an event where the program ends before what is within, in a daemon thread, and wait until that has ended."""
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
