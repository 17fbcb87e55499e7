"""What is installed and what is there: kinds of device, drivers, extras; and drivers chosen by a text."""

import ast
import errno
import inspect
import os
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.checks import require
from hapticrender.errors import DriverError, HapticError
from hapticrender.formatting import table

if TYPE_CHECKING:
    from hapticrender.protocols import Driver
    from hapticrender.touch.device_profile import DeviceProfile

EXTRAS = (  # package, extra, what it is good for
    ("sounddevice", "audio", "sound cards"),
    ("matplotlib", "plot", "pictures"),
    ("h5py", "hdf5", "HDF5 files"),
    ("distributed", "cluster", "sweeps on a cluster"),
)
SIMULATED = "simulated"
SCALES = ("drive_per_full_scale", "sensed_per_full_scale", "delay")  # entries of a calibration that a driver takes
_MADE: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()  # by `open_driver`, by their id
FORMS = (
    "NAME, NAME:ARGUMENT, NAME:ARGUMENT?OPTION=VALUE&..., or for one of your own package.module:callable, alike with "
    ":ARGUMENT and ?OPTION=VALUE&..."
)


def registered(group: str, name: str) -> Any:
    """Load what the entry-point `group` (renderers, drivers) registers under `name`."""
    found, what = _points(group), "device" if group == "renderers" else "driver"
    if name not in found:
        raise ValueError(f"{what} {name!r} is not installed: must be one of {', '.join(found) or 'none'}")
    try:
        return found[name].load()
    except Exception as error:
        reason = f"{what} {name!r} cannot be loaded: {type(error).__name__}: {error}{_cure(error)}"
        raise HapticError(reason) from error


def open_driver(text: str, profile: "DeviceProfile | None" = None, overwrite: bool = False) -> "Driver | None":
    """Make the driver that a text names, for a ``with`` statement to open; None for the simulated device.

    `text` is "simulated"; the name of an installed driver, with its argument after a colon ("audio:0",
    "serial:/dev/ttyACM0", "wavefile:drive.wav"); or "package.module:callable", which is called with what follows a
    second colon, if anything does ("package.module:callable?block=10" has options alone).  Behind a "?" are keyword
    arguments, numbers, numbers with commas between or words:
    "audio:0?block=256&rate=44100&channels=3,4", "serial:/dev/ttyACM0?baud=921600".  A driver gets those entries of the
    calibration in the device's `profile`, by keyword, that its parameters name (``drive_per_full_scale``,
    ``sensed_per_full_scale``, ``delay``, ``gain_uncertainty``), and a parameter ``profile`` the profile itself; a
    warning names what is stated and not taken.  `overwrite` is handed, where true, to a driver that has a parameter of
    that name.

    A ValueError where there is no such driver, or it does not take the argument; a HapticError where a package that it
    needs is not installed, or cannot be loaded; a DriverError where the device is not there, or the callable raised
    what is neither a ValueError nor a TypeError.

    >>> open_driver("simulated") is None
    True
    >>> open_driver("wavefile:drive.wav").rate
    48000.0
    """
    if text == SIMULATED:
        return None
    name, colon, argument = text.partition(":")
    if name == SIMULATED:
        raise ValueError(f"driver = {text!r}: must be {SIMULATED!r}, without an argument")
    if name in _points("drivers"):
        factory = registered("drivers", name)
    else:
        called, mark, after = argument.partition("?")  # options may have colons in them
        called, colon, argument = called.partition(":")
        factory, name, argument = imported(text, name, called), f"{name}:{called}", argument + mark + after
    try:
        with naming_driver(text, ValueError, TypeError):
            argument, options = _split(argument, factory, bool(colon))
            taken = inspect.signature(factory).parameters if profile or overwrite else {}
            offered = {
                **(vars(profile.calibration) if profile else {}),
                "profile": profile,
                "overwrite": overwrite or None,
            }
            known = {name: value for name, value in offered.items() if name in taken and value is not None}
            made = factory(*[argument] * bool(colon), **known | options)
    except TypeError as error:
        raise ValueError(f"driver = {text!r}: {error}; give its argument as {name}:ARGUMENT?OPTION=VALUE") from error
    if not hasattr(made, "play"):
        kind = type(made).__name__
        raise ValueError(f"driver = {text!r}: it returned a {kind}: must be a driver, see hapticrender.drivers.base")
    warn_of_calibration(text, profile, lambda name, _: name in taken or "profile" in taken)
    with suppress(TypeError):  # of what cannot be referred to weakly
        _MADE[id(made)] = made
    return made  # type: ignore[no-any-return]


def check_calibration(driver: "Driver", profile: "DeviceProfile") -> None:
    """Warn where a profile states what an object of the caller's does not have: it gets nothing of a profile.

    An attribute of the entry's name and value says that it was taken; a `delay` may be longer.
    """

    def takes(name: str, value: Any) -> bool:
        taken: Any = getattr(driver, name, None)
        return np.array_equal(taken, value) or (name == "delay" and getattr(driver, name, 0) >= value - 0.5)

    if _MADE.get(id(driver)) is not driver and not hasattr(driver, "plant"):
        warn_of_calibration(type(driver).__name__, profile, takes)


def warn_of_calibration(who: str, profile: "DeviceProfile | None", takes: Callable[[str, float], Any]) -> None:
    """Warn of the entries of a calibration that a driver does not take; `gain_uncertainty` is the recording's."""
    stated = {name: getattr(profile and profile.calibration, name, None) for name in SCALES}
    shown = {name: np.atleast_1d(each) for name, each in stated.items() if each is not None and not takes(name, each)}
    lost = [f"{name} = {', '.join(f'{each:g}' for each in values)}" for name, values in shown.items()]
    if lost:
        cure = "give a driver these numbers itself, and keep them as its attributes, or a parameter of that name"
        problem = f"{', '.join(lost)}: {who} does not take it, so it has no effect: {cure}"
        warnings.warn(f"calibration: {problem}", stacklevel=4)


@contextmanager
def naming_driver(text: str, *passed: type[Exception]) -> Iterator[None]:
    """Raise what a driver raises within as a `DriverError` with the text that names it; the library's errors pass.

    So do those `passed`, files that cannot be read or written, and all of the simulated device.
    """
    try:
        yield
    except Exception as error:
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
        ours = isinstance(error, HapticError | MemoryError) or getattr(error, "filename", None) is not None or full
        if text == SIMULATED or ours or isinstance(error, passed):
            raise
        raise DriverError(f"{text}: {type(error).__name__}: {error}") from error


def imported(text: str, module: str, called: str) -> Any:
    """Return what "module:callable" names; a ValueError lists the drivers that are installed."""
    if not called:
        try:
            return registered("drivers", module)  # which refuses it, and lists what there is
        except ValueError as error:
            raise ValueError(f"{error}; or {FORMS}") from None
    try:
        factory = getattr(import_module(module), called)
    except (ImportError, AttributeError, ValueError) as error:
        names = ", ".join(_points("drivers"))
        raise ValueError(f"driver = {text!r}: {error}{_cure(error)}; installed are {names}; or {FORMS}") from error
    except Exception as error:  # a user's own module may fail in any way
        raise HapticError(f"driver = {text!r}: {module} cannot be loaded: {type(error).__name__}: {error}") from error
    if not callable(factory):
        raise ValueError(f"driver = {text!r}: {called} is a {type(factory).__name__}: must be a class or a function")
    return factory


def _split(argument: str, factory: Callable[..., Any], first: bool) -> tuple[str, dict[str, Any]]:
    """Split "0?block=256&channels=3,4" into argument and options of the factory; its `first` parameter is no option.

    A "?" without names and values behind it, or in the name of a file that is there, is of the argument.
    """
    before, mark, after = argument.rpartition("?")
    pairs = [each.partition("=") for each in after.split("&")]
    named = bool(mark) and all(name.isidentifier() and equals for name, equals, _ in pairs)
    if not named or os.path.exists(argument):
        require(first or not argument, "options", argument, "?OPTION=VALUE&...")
        return argument, {}
    options: dict[str, Any] = {name: value for name, _, value in pairs}
    taken = inspect.signature(factory).parameters
    if not any(each.kind is each.VAR_KEYWORD for each in taken.values()):
        known = list(taken)[first:]
        for name in options.keys() - known:
            raise ValueError(f"option {name!r}: must be one of {', '.join(known)}")
    for name, value in options.items():
        with suppress(ValueError, SyntaxError):  # a word
            options[name] = ast.literal_eval(value)
    return before, options


def _cure(error: BaseException) -> str:
    """Say what to install where a package of an extra, or the library behind it, is missing."""
    if isinstance(error, OSError) and "PortAudio" in str(error):
        return "; to get it: install PortAudio (Debian: apt-get install libportaudio2)"
    missing = getattr(error, "name", None) if isinstance(error, ImportError) else None
    extra = {package: extra for package, extra, _ in EXTRAS}.get(str(missing))
    return f'; to get it: pip install "hapticrender[{extra}]"' if extra else ""


def text() -> str:
    """Everything as a table for the terminal."""
    kinds = [["kind", "installed", "simulated", "a real one needs"]]
    for entry, loaded, trouble in _loaded("renderers"):
        simulated, needs = "yes" if hasattr(loaded, "plant") else "no", getattr(loaded, "needs", "a driver")
        kinds.append([entry.name, "broken" if trouble else "yes", simulated, trouble or f"{needs}  ({entry.value})"])
    drivers = [["driver", "installed", "what it does"]]
    there = [["--driver", "what is there"]]
    for entry, loaded, trouble in _loaded("drivers"):
        first = str(loaded.__doc__ or "").strip().partition("\n")[0]
        drivers.append([entry.name, "broken" if trouble else "yes", trouble or f"{first}  ({entry.value})"])
        there += _there(entry.name, loaded)
    extras = [["extra", "installed", "for"]]
    for package, extra, use in EXTRAS:
        extras.append([extra, "yes" if find_spec(package) else "no", f'{use} (pip install "hapticrender[{extra}]")'])
    hint = f"--driver takes {FORMS}: hapticrender.drivers.base describes a driver in a page."
    return "\n\n".join([table(kinds), table(drivers), hint, table(there), table(extras)])


def _points(group: str) -> dict[str, Any]:
    """Entry points of a group by their names, in order."""
    return {entry.name: entry for entry in sorted(entry_points(group=f"hapticrender.{group}"), key=lambda e: e.name)}


def _loaded(group: str) -> Iterator[tuple[Any, Any, str]]:
    """Entry points and what they are, or None and why it cannot be used."""
    for entry in _points(group).values():
        try:
            found, trouble = entry.load(), ""
        except (Exception, SystemExit) as error:  # a third party's module may fail in any way; the list must go on
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            found, trouble = None, f"cannot be loaded from {entry.value} ({reason}){_cure(error)}"
        yield entry, found, trouble


def _there(name: str, driver: Any) -> list[list[str]]:
    """Rows of the devices that a driver finds; see `found` in `hapticrender.drivers.base`."""
    if name == SIMULATED:
        return [[SIMULATED, "always: a model of the scene's device, with its finger"]]
    if not hasattr(driver, "found"):
        return []
    try:
        rows = [each.partition("  ")[::2] for each in driver.found()]
    except (Exception, SystemExit) as error:  # a third party's search may fail in any way; the list must go on
        reason = " ".join(f"{type(error).__name__}: {error}{_cure(error)}".split())
        return [[f"{name}:", f"cannot be searched ({reason})"]]
    return [[f"{name}:{argument}", about.strip()] for argument, about in rows] or [[f"{name}:", "none"]]
