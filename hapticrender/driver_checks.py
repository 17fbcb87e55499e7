"""Checks of a driver and of every block that it returns."""

import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any

import numpy as np

from hapticrender.checks import require
from hapticrender.errors import ProtocolError
from hapticrender.protocols import Array, Flag, Sensed

_MEMBERS = ("rate", "drive_channels", "sensed_channels", "block", "delay", "play", "__enter__", "__exit__")
_LEAST = {"drive_channels": 1, "sensed_channels": 0, "block": 1}
FARTHEST = 2.0  # m from the middle: as far as motions reach; most positions in mm are beyond
LOADS = (-1.0, 100.0)  # N: no finger presses harder, most loads in mN are beyond; one's offset may be negative
MOST_RATE = 1e7  # Hz: of the fastest device that parameters can state; filters and logs take memory by it
FLAGS = sum(Flag)  # all bits
OPEN: set[int] = set()  # identities of the devices that play


@contextmanager
def opened_once(device: object) -> Iterator[None]:
    """Refuse a device that a player or a run of this process has open."""
    if id(device) in OPEN:
        raise ValueError(f"driver: {type(device).__name__} is already open in a Player or a run: end that one first")
    OPEN.add(id(device))
    try:
        yield
    finally:
        OPEN.discard(id(device))


def check_driver(driver: Any) -> None:
    """Refuse an object that is no ``protocols.Driver``: a member is missing, or a number is out of its bound."""
    if inspect.isclass(driver):
        raise TypeError(f"driver = {driver.__name__}: must be an instance, not the class: {driver.__name__}(...)")
    kind = type(driver).__name__
    missing = [name for name in _MEMBERS if not hasattr(driver, name)]
    if missing:
        raise TypeError(f"{kind} is no driver: it lacks {', '.join(missing)}")
    rate = driver.rate
    if not isinstance(rate, Real) or not 0.0 < float(rate) <= MOST_RATE:
        raise ValueError(f"{kind}: rate={rate!r} must be finite and > 0 Hz, and <= {MOST_RATE:g} Hz")
    for name, least in (*_LEAST.items(), ("delay", driver.block)):
        value = getattr(driver, name)
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise ValueError(f"{kind}: {name}={value!r} must be a whole number >= {least}, an int")


def check_channels(driver: Any, drive: Mapping[int, str], sensed: Mapping[int, str]) -> None:
    """Refuse a driver whose numbers of channels are not among those in `drive` and `sensed`, each with its meaning."""
    for name, known in (("drive_channels", drive), ("sensed_channels", sensed)):
        found = getattr(driver, name)
        bound = " or ".join(f"{count} ({meaning})" if meaning else str(count) for count, meaning in known.items())
        require(found in known, f"driver.{name}", found, bound)


def check_sensed(driver: Any, sensed: Sensed, places: int, stated: bool = False) -> Sensed:
    """Return a block that `driver` returned with copies of its columns, contiguous float64 (flags int64).

    A `ProtocolError` names the column that has no numbers, or not the driver's shape; `motion` has `places` columns,
    and may not be missing once it was `stated`: a recording has one source of it.
    """
    block, kind = driver.block, type(driver).__name__
    if not hasattr(sensed, "sensed"):
        raise ProtocolError(f"{kind}: play returned {type(sensed).__name__}: must return a hapticrender.Sensed")
    shapes = {
        "sensed": (block, driver.sensed_channels),
        "position": (block,),
        "motion": (block, places),
        "normal_load": (block,),
        "flags": (block,),
    }
    columns = {}
    for name, shape in shapes.items():
        value = getattr(sensed, name, None)
        if value is None and name != "sensed":
            continue
        columns[name] = _column(driver, name, value, shape)
    if stated and "motion" not in columns:
        raise ProtocolError(f"{kind}: play: motion is None, and was stated before: must be stated in every block")
    return Sensed(**columns)


def _column(driver: Any, name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Contiguous float64 copy of a column, of flags int64; what would be cut off in that is refused."""
    where, kind = f"{type(driver).__name__}: play: {name}", np.int64 if name == "flags" else float
    try:
        given = np.asarray(value)
        if given.dtype.kind == "c":
            raise TypeError("it is complex")
        if given.dtype == kind:
            column = given.copy()  # the driver may use its own again
        else:
            with np.errstate(invalid="ignore"):
                column = np.array(given, kind, order="C")
        if name == "flags" and given.dtype.kind in "fO" and not (column == given).all():
            raise TypeError("it has fractions, NaN or infinity")
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"{where} is no array of {'whole ' * (kind is np.int64)}numbers: {error}") from None
    if given.shape != shape:
        raise ProtocolError(f"{where} has shape {given.shape}, must be {shape}")
    if name == "position" and (beyond := abs(column) > FARTHEST).any():
        found = (
            f"{column[beyond][0]:g} m: must be within {FARTHEST:g} m of the middle, in m and not mm, NaN while lifted"
        )
        raise ProtocolError(f"{where} is {found}")
    if name == "normal_load" and (beyond := (column < LOADS[0]) | (column > LOADS[1])).any():
        bound = f"from {LOADS[0]:g} to {LOADS[1]:g} N, NaN where it is not known"
        raise ProtocolError(f"{where} is {column[beyond][0]:g} N: must be {bound}")
    if kind is np.int64 and (unknown := int(np.bitwise_or.reduce(column)) & ~FLAGS):
        raise ProtocolError(f"{where} has bits {unknown}, must be of hapticrender.Flag, 0 to {FLAGS}")
    return column
