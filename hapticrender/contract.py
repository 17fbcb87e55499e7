"""What is asked of a driver and of every block that it returns, checked before either can do harm."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hapticrender.errors import ProtocolError
from hapticrender.protocols import Array, Sensed

_MEMBERS = ("rate", "drive_channels", "sensed_channels", "block", "delay", "play", "__enter__", "__exit__")
_LEAST = {"drive_channels": 1, "sensed_channels": 0, "block": 1}


def check_driver(driver: Any) -> None:
    """Refuse an object that is no driver, naming what it lacks or which number is out of its bound.

    Parameters
    ----------
    driver : object
        What should follow the page above.

    Raises
    ------
    TypeError
        A member is missing.
    ValueError
        A count or the rate is out of its bound.
    """
    kind = type(driver).__name__
    missing = [name for name in _MEMBERS if not hasattr(driver, name)]
    if missing:
        raise TypeError(f"{kind} is no driver: it lacks {', '.join(missing)}")
    if not (math.isfinite(driver.rate) and driver.rate > 0):
        raise ValueError(f"{kind}: rate={driver.rate!r} must be finite and > 0 Hz")
    for name, least in (_LEAST | {"delay": driver.block}).items():
        value = getattr(driver, name)
        if value != int(value) or value < least:
            raise ValueError(f"{kind}: {name}={value!r} must be a whole number >= {least}")


def check_sensed(driver: Any, sensed: Sensed, places: int) -> Sensed:
    """Return a block with its columns as contiguous float64, or refuse it where a shape is not the driver's.

    Parameters
    ----------
    driver : Driver
        Who returned it.
    sensed : Sensed
        What `play` returned.
    places : int
        Judged places, the columns of `motion`.

    Returns
    -------
    Sensed

    Raises
    ------
    ProtocolError
        A column has another shape, or is no number.
    """
    block = driver.block
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
    return Sensed(**columns)


def _column(driver: Any, name: str, value: Any, shape: tuple[int, ...]) -> Array:
    try:
        column = np.ascontiguousarray(value, np.int64 if name == "flags" else float)
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"{type(driver).__name__}: play: {name} is no array of numbers: {error}") from None
    if np.shape(value) != shape:
        raise ProtocolError(f"{type(driver).__name__}: play: {name} has shape {np.shape(value)}, must be {shape}")
    return column
