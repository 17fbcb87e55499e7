"""Errors of designs, drivers and devices; those of one module alone (`MissingExtra`, `SweepError`) are there.

Bad arguments are plain ``ValueError`` and ``TypeError``; the classes here add what a caller may want to catch by kind.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hapticrender.recordings.recording import Recording


class HapticError(Exception):
    """Root of the library's own errors."""


class SceneError(HapticError, ValueError):
    """A scene, or a file that it names, is malformed: states file, key, value, bound and unit."""


class DesignError(HapticError):
    """A design cannot be made stable or accurate enough: states which margin and which parameter."""


class DriverError(HapticError):
    """A driver failed: states device and operation."""


class DeviceNotFound(DriverError):
    """No such device, port or file."""


class DeviceTimeout(DriverError):
    """The device did not reply in time."""


class DeviceLost(DriverError):
    """The device went away while it played."""


class ProtocolError(DriverError):
    """The device sent something that its protocol does not allow."""


class DeviceFault(DriverError):
    """The device does not follow its drive: states the most likely cause, when, and what to check.

    `time` (s) counts from the start of the run, NaN before it; `recording` holds every sample that was played, None
    before the first one.
    """

    def __init__(self, message: str, time: float = math.nan) -> None:
        super().__init__(message)
        self.time = time
        self.recording: Recording | None = None


class WatchdogTimeout(HapticError):
    """The application hung: it made no call for as long as its watchdog allows, and the drive was stopped.

    `time` (s) counts from the start of the run.
    """

    def __init__(self, time: float, watchdog: float | None = None) -> None:
        super().__init__(time, watchdog)  # what it is made from again, in another process
        self.time = time

    def __str__(self) -> str:
        time, watchdog = self.args
        allowed = "the time of its watchdog" if watchdog is None else f"{watchdog:.3g} s, the time of its watchdog"
        cure = "set the finger again while it rests, or give Player another watchdog (math.inf: none)"
        return f"stopped at {time:.4g} s: no method of the player was called for {allowed}: {cure}"


class PlateMismatch(UserWarning):
    """The device differs from the model that a controller is designed for; states by how much, and what to do.

    Raised as an error, where warnings are, it holds the `recording` of the run, if there was one.
    """

    recording: "Recording | None" = None


# what a wrong scene or file may raise
REFUSED = (ValueError, TypeError, ArithmeticError, RecursionError, MemoryError, HapticError)


@contextmanager
def noted_on(first: BaseException | None, during: str = "closing") -> Iterator[None]:
    """Note what fails within, such as while `closing`, on the error that came before; without one it is raised."""
    try:
        yield
    except Exception as late:
        if first is None:
            raise
        first.add_note(f"and while {during}: {late}")


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Begin every message within but a driver's with `where`, a file or a scene, and raise it as a `SceneError`."""
    try:
        yield
    except DriverError:
        raise
    except REFUSED as problem:
        start = f"{' '.join(str(where).split())}: "
        text = "; ".join([str(problem), *getattr(problem, "__notes__", ())])
        raise SceneError(text if text.startswith(start) else start + text) from problem
