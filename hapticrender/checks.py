"""Validation of arguments and parameters: an error names key, value, bound and unit in one line."""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import field, fields
from numbers import Integral, Real
from typing import Any, NoReturn, Self

import numpy as np

LONGEST_LIST = 10_000_000  # numbers in one list of a scene
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 60
_short.maxlong = 30


def show(value: object) -> str:
    """Format any value as one short line."""
    if isinstance(value, int) and abs(value) >= 10**30:
        return "an integer beyond 1e30"
    if isinstance(value, Mapping | list | tuple | np.ndarray) and len(value) > 4:
        return f"{type(value).__name__} of {len(value)} entries"
    if isinstance(value, np.generic):
        value = value.item()
    return " ".join(_short.repr(value).split())


def refuse(key: str, value: object, bound: str, error: type[Exception] = ValueError) -> NoReturn:
    """Raise `error` as "key = value: must be bound"; a value of None reads as missing."""
    if value is None:
        raise error(f"{key} is missing: must be {bound}")
    raise error(f"{key} = {show(value)}: must be {bound}")


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)


def _bound(kind: str, unit: str, above: float | None, least: float | None, most: float | None) -> str:
    parts = [f"> {above:g}"] if above is not None else [f">= {least:g}"] if least is not None else []
    parts += [f"<= {most:g}"] if most is not None else []
    return f"{kind} {' and '.join(parts)} {unit}".replace("  ", " ").strip()


def number(
    key: str,
    value: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
) -> float:
    """Return `value` as float, if it is a finite real number (no bool) inside its bounds."""
    bound = _bound("a finite number", unit, above, least, most)
    if not _is_number(value):
        refuse(key, value, bound, TypeError)
    try:
        result = float(value)
    except OverflowError:
        refuse(key, value, bound)
    inside = (
        (above is None or result > above) and (least is None or result >= least) and (most is None or result <= most)
    )
    if not (math.isfinite(result) and inside):
        refuse(key, value, bound)
    return result


def integer(key: str, value: Any, unit: str = "", *, least: float, most: float | None = None) -> int:
    """Return `value` as int, if it is an integer (no bool) inside its bounds."""
    bound = _bound("an integer", unit, None, least, most)
    if not isinstance(value, Integral) or isinstance(value, bool):
        refuse(key, value, bound, TypeError)
    if not least <= int(value) <= (math.inf if most is None else most):
        refuse(key, value, bound)
    return int(value)


def numbers(key: str, value: Any, unit: str = "", *, least: float, most: float, count: int = 1) -> tuple[float, ...]:
    """Return a list or array of at least `count` finite real numbers inside their bounds as a tuple of floats."""
    bound = f"a list of {count} to {LONGEST_LIST} finite numbers >= {least:g} and <= {most:g} {unit}".strip()
    array = _array(key, value, bound)
    if not count <= array.size <= LONGEST_LIST:
        refuse(key, value, bound)
    wrong = ~((array >= least) & (array <= most))
    if wrong.any():
        first = int(np.argmax(wrong))
        refuse(f"{key}[{first}]", array[first], _bound("a finite number", unit, None, least, most))
    return tuple(array.tolist())


def _array(key: str, value: Any, bound: str) -> np.ndarray[Any, Any]:
    if isinstance(value, np.ndarray):
        if value.ndim != 1 or value.dtype.kind not in "iuf":
            refuse(key, value, bound, TypeError)
        return value.astype(float)
    if not isinstance(value, list | tuple) or not all(map(_is_number, value)):
        refuse(key, value, bound, TypeError)
    try:
        return np.array([float(entry) for entry in value])
    except OverflowError:
        refuse(key, value, bound)


def rising(key: str, value: Any, count: int) -> tuple[float, ...]:
    """Return `count` rising times (s) from 0 to 100 h as a tuple of floats."""
    times = numbers(key, value, "s", least=0, most=360_000)
    if len(times) != count or any(later <= sooner for sooner, later in zip(times, times[1:], strict=False)):
        refuse(key, value, f"{count} rising times in s")
    return times


def flag(key: str, value: Any) -> bool:
    """Return `value`, if it is true or false."""
    if not isinstance(value, bool | np.bool_):
        refuse(key, value, "true or false", TypeError)
    return bool(value)


def choice(key: str, value: Any, options: Iterable[str]) -> str:
    """Return `value`, if it is one of the words in `options`."""
    bound = "one of " + ", ".join(options)
    if not isinstance(value, str):
        refuse(key, value, bound, TypeError)
    if value not in options:
        refuse(key, value, bound)
    return value


def word(key: str, value: Any) -> str:
    """Return `value`, if it can be a name and part of a file name: 1 to 100 printable characters, no path."""
    bound = "1 to 100 printable characters without / \\ : and not starting with a dot"
    if not isinstance(value, str):
        refuse(key, value, bound, TypeError)
    if not (1 <= len(value) <= 100 and value.isprintable() and value[0] != "." and not set(value) & set("/\\:")):
        refuse(key, value, bound)
    return value


def file_name(key: str, value: Any) -> str:
    """Return a path as absolute text, so that a scene means the same file wherever it is read again."""
    bound = "the name of a file, without control characters"
    if not isinstance(value, str | os.PathLike):
        refuse(key, value, bound, TypeError)
    name = os.fspath(value)
    if not isinstance(name, str) or not name or not name.isprintable():
        refuse(key, value, bound)
    return os.path.abspath(name)


def one_of_two(first: str, one: object, second: str, other: object) -> None:
    """Refuse unless exactly one of two values is given."""
    if (one is None) == (other is None):
        given = "neither is" if one is None else f"{first} = {show(one)} and {second} = {show(other)} are"
        raise ValueError(f"{first}, {second}: exactly one must be given; {given}")


def keep(instance: object, **values: Any) -> None:
    """Write checked values into a frozen dataclass while it is being made."""
    for key, value in values.items():
        object.__setattr__(instance, key, value)


@contextmanager
def inside(table: str) -> Iterator[None]:
    """Put the name of a table before the key of whatever is refused within."""
    try:
        yield
    except TypeError as problem:
        raise TypeError(f"{table}.{problem}") from None
    except ValueError as problem:
        raise ValueError(f"{table}.{problem}") from None


def parameter(
    default: float, unit: str = "", *, above: float | None = None, least: float = 0.0, most: float | None = None
) -> Any:
    """Field of a `Validated` class: a number > `above`, or >= `least`, and <= `most`, in `unit`."""
    low = {"least": least} if above is None else {"above": above}
    return field(default=default, metadata={"unit": unit, "most": most, **low})


def option(default: str, *known: str) -> Any:
    """Field of a `Validated` class: one of the words in `known`."""
    return field(default=default, metadata={"known": known})


class Validated:
    """Base of parameter classes whose fields are made by `parameter` and `option` and checked when one is made."""

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            bounds, value = each.metadata, getattr(self, each.name)
            if "known" in bounds:
                choice(each.name, value, bounds["known"])
            elif "unit" in bounds:
                (integer if each.type in (int, "int") else number)(each.name, value, **bounds)

    @classmethod
    def names(cls) -> set[str]:
        """Names of the parameters that `parameter` and `option` made."""
        return {each.name for each in fields(cls) if not {"known", "unit"}.isdisjoint(each.metadata)}  # type: ignore[arg-type]

    @classmethod
    def with_overrides(cls, overrides: Mapping[str, Any]) -> Self:
        """Defaults with the parameters in `overrides` replaced; a name that is unknown is a ValueError."""
        check_names(overrides, cls.names())
        return cls(**overrides)


def check_names(given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse a name that is not `known`; the message lists those that are."""
    for name in given:
        if name not in known:
            raise ValueError(f"{name}: no such parameter; known: {', '.join(sorted(known))}")
