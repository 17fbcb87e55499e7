"""Validation of arguments and parameters: an error names key, value, bound and unit in one line."""

import inspect
import math
import os
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, field, fields
from numbers import Integral, Real
from typing import Any, NoReturn, Self

import numpy as np

End = float | None  # of a range of numbers; None: open
LONGEST_LIST = 10_000_000  # numbers in one list of a scene
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 60
_short.maxlong = 30


def show(value: object) -> str:
    """Format any value as one short line."""
    if isinstance(value, int) and abs(value) >= 10**30:
        return "an integer beyond 1e30"
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        value = value.item()
    if isinstance(value, Mapping | list | tuple | np.ndarray) and len(value) > 4:
        return f"{type(value).__name__} of {len(value)} entries"
    return " ".join(_short.repr(value).split())


def plain(key: object) -> str:
    """Format a key of a table for a message."""
    return key if isinstance(key, str) and key.isidentifier() else show(key)


def refuse(key: str, value: object, bound: str, error: type[Exception] = ValueError) -> NoReturn:
    """Raise `error` as "key = value: must be bound"; a value of None reads as missing."""
    if value is None:
        raise error(f"{key} is missing: must be {bound}")
    raise error(f"{key} = {show(value)}: must be {bound}")


def require(good: bool, key: str, value: object, bound: str, error: type[Exception] = ValueError) -> None:
    """Refuse `value` unless `good`."""
    if not good:
        refuse(key, value, bound, error)


def _is_number(value: Any) -> bool:
    if type(value) is float:  # a long list is of these
        return True
    value = value[()] if isinstance(value, np.ndarray) else value  # one without dimensions, as `numpy.where` returns
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)


def _bound(kind: str, unit: str, above: End, least: End, most: End) -> str:
    parts = [f"> {above:g}"] if above is not None else [f">= {least:g}"] if least is not None else []
    parts += [f"<= {most:g}"] if most is not None else []
    return f"{kind} {' and '.join(parts)} {unit}".replace("  ", " ").strip()


def number(key: str, value: Any, unit: str = "", *, above: End = None, least: End = None, most: End = None) -> float:
    """Return `value` as float, if it is a finite real number (no bool) inside its bounds."""
    bound = _bound("a finite number", unit, above, least, most)
    require(_is_number(value), key, value, bound, TypeError)
    try:
        result = float(value)
    except OverflowError:
        refuse(key, value, bound)
    low = result > above if above is not None else least is None or result >= least
    require(math.isfinite(result) and low and (most is None or result <= most), key, value, bound)
    return result


def integer(key: str, value: Any, unit: str = "", *, least: float, most: float | None = None) -> int:
    """Return `value` as int, if it is an integer (no bool) inside its bounds."""
    bound = _bound("an integer", unit, None, least, most)
    require(isinstance(value, Integral) and not isinstance(value, bool), key, value, bound, TypeError)
    require(least <= int(value) <= (math.inf if most is None else most), key, value, bound)
    return int(value)


def numbers(
    key: str, value: Any, unit: str = "", *, least: float, most: float, count: int | None = None
) -> tuple[float, ...]:
    """Return a list or array of finite real numbers (exactly `count`, or any) inside their bounds as floats."""
    size = f"1 to {LONGEST_LIST}" if count is None else f"{count}"
    bound = f"a list of {size} finite numbers >= {least:g} and <= {most:g} {unit}".strip()
    if isinstance(value, np.ndarray):
        require(value.ndim == 1 and value.dtype.kind in "iuf", key, value, bound, TypeError)
        require(not np.ma.is_masked(value), key, value, f"{bound}, none of them masked: fill them")
    else:
        require(isinstance(value, list | tuple) and all(map(_is_number, value)), key, value, bound, TypeError)
    require(1 <= len(value) <= LONGEST_LIST and count in (None, len(value)), key, value, bound)
    try:
        found = np.array([float(entry) for entry in value])
    except OverflowError:
        refuse(key, value, bound)
    for first in np.flatnonzero(~((found >= least) & (found <= most)))[:1]:
        refuse(f"{key}[{first}]", found[first], _bound("a finite number", unit, None, least, most))
    return tuple(found.tolist())


def scales(key: str, value: Any, channels: int = 0) -> float | tuple[float, ...]:
    """Return a finite number > 0 as float, or a list of them, one each of `channels` (0: any), as floats."""
    if not isinstance(value, list | tuple | np.ndarray) or np.ndim(value) == 0:
        return number(key, value, above=0.0)
    bound = f"a number, or a list of {channels or 'one a channel'}"
    require(len(value) == (channels or len(value) or 1), key, value, bound)
    return tuple(number(f"{key}[{i}]", each, above=0.0) for i, each in enumerate(value))


def frequencies(value: Any, *, zero: bool) -> np.ndarray[Any, Any]:
    """Return frequencies (Hz) as an array, if all are finite and > 0, or `zero`."""
    bound = f"finite numbers {'>=' if zero else '>'} 0 Hz"
    try:
        hertz = np.asarray(value, float)
    except (TypeError, ValueError):
        refuse("frequency", value, bound, TypeError)
    good = (np.isfinite(hertz) & ((hertz >= 0) if zero else (hertz > 0))).all()
    require(bool(good), "frequency", value, bound)
    return hertz


def table(key: str, value: Any) -> dict[str, Any]:
    """Return a table as a dict."""
    require(isinstance(value, Mapping), key, value, "a table of parameters", TypeError)
    return dict(value)


def rising(key: str, value: Any, count: int) -> tuple[float, ...]:
    """Return `count` rising times (s) from 0 to 100 h as a tuple of floats."""
    times = numbers(key, value, "s", least=0, most=360_000)
    good = len(times) == count and all(np.diff(times) > 0)
    require(good, key, value, f"{count} rising times in s")
    return times


def flag(key: str, value: Any) -> bool:
    """Return `value`, if it is true or false."""
    require(isinstance(value, bool | np.bool_), key, value, "true or false", TypeError)
    return bool(value)


def choice(key: str, value: Any, options: Iterable[str]) -> str:
    """Return `value`, if it is one of the texts in `options`."""
    bound = "one of " + ", ".join(options)
    require(isinstance(value, str), key, value, bound, TypeError)
    require(value in options, key, value, bound)
    return value


def text(key: str, value: Any, longest: int = 200, lines: bool = False) -> str:
    """Return `value`, if it is a text of at most `longest` printable characters, or of `lines` of any."""
    bound = f"a text of{'' if lines else ' printable'} characters, at most {longest}"
    good = isinstance(value, str) and (lines or value.isprintable()) and len(value) <= longest
    require(good, key, value, bound)
    return value


def name(key: str, value: Any) -> str:
    """Return `value`, if it can be a name and part of a file name: 1 to 100 printable characters, no path."""
    bound = "1 to 100 printable characters without / \\ : and not starting with a dot"
    require(isinstance(value, str), key, value, bound, TypeError)
    good = 1 <= len(value) <= 100 and value.isprintable() and value[0] != "." and not set(value) & set("/\\:")
    require(good, key, value, bound)
    return value


def file_name(key: str, value: Any) -> str:
    """Return a path as absolute text, so that a scene means the same file wherever it is read again."""
    bound = "the name of a file, without control characters"
    require(isinstance(value, str | os.PathLike), key, value, bound, TypeError)
    name = os.fspath(value)
    require(isinstance(name, str) and name.isprintable() and name != "", key, value, bound)
    return os.path.abspath(name)


def exactly_one(**values: Any) -> str:
    """Return the name of the only value that is not None; refuse none and several."""
    given = {key: value for key, value in values.items() if value is not None}
    if len(given) != 1:
        found = " and ".join(f"{key} = {show(value)}" for key, value in given.items())
        raise ValueError(f"{', '.join(values)}: exactly one must be given; {f'{found} are' if given else 'none is'}")
    return next(iter(given))


def keep(instance: object, **values: Any) -> None:
    """Write checked values into a frozen dataclass while it is being made."""
    for key, value in values.items():
        object.__setattr__(instance, key, value)


@contextmanager
def inside(table: str) -> Iterator[None]:
    """Put the name of a table before the key of whatever is refused within."""
    try:
        yield
    except (TypeError, ValueError) as problem:
        kind = TypeError if isinstance(problem, TypeError) else ValueError
        raise kind(f"{table}.{problem}") from None


def checked(check: Callable[..., Any], default: Any = MISSING, *, about: str = "", **bounds: Any) -> Any:
    """Field of a `Validated` class: keeps what ``check(name, value, **bounds)`` returns; a default of None stays.

    `about` is its line in the docstring of the class.
    """
    described = {"about": about, "unit": bounds.get("unit", "")} if about else {}
    return field(default=default, metadata={"check": check, "bounds": bounds, **described})


def mapping(check: Callable[[str, Any], Any], about: str = "") -> Any:
    """Field of a `Validated` class: a mapping, empty by default, that keeps what ``check(name, value)`` returns."""
    return field(default_factory=dict, hash=False, metadata=checked(check, about=about).metadata)


def parameter(
    default: Any = MISSING, unit: str = "", about: str = "", *, above: End = None, least: float = 0.0, most: End = None
) -> Any:
    """Field of a `Validated` class: a number (integer where annotated so) > `above` or >= `least`, <= `most`."""
    low: dict[str, Any] = {"least": least} if above is None else {"above": above}
    line = f"{about}; {_bound('', '', above, least, most)}" if about else ""
    return checked(number, default, about=line, unit=unit, most=most, **low)


def option(default: str, *known: str, about: str = "") -> Any:
    """Field of a `Validated` class: one of the texts in `known`."""
    return checked(choice, default, about=f"{about}: {' or '.join(known)}" if about else "", options=known)


class Validated:
    """Base of dataclasses with fields made by `checked`, `parameter` and `option`, and checked when one is made.

    Where a docstring has no section Parameters and every field has an `about`, the fields that no base class has
    make that section.
    """

    def __init_subclass__(cls) -> None:
        above = {name for base in cls.__mro__[1:] for name in getattr(base, "__dataclass_fields__", ())}
        hints = vars(cls).get("__annotations__", {})
        own = [name for name, hint in hints.items() if name not in above and "ClassVar" not in str(hint)]
        about = {name: getattr(vars(cls).get(name), "metadata", {}) for name in own}
        text = inspect.cleandoc(cls.__doc__ or "")
        if about and "Parameters\n---" not in text and all("about" in each for each in about.values()):
            rows = []
            for name, each in about.items():  # types without their modules
                hint = hints[name].__name__ if isinstance(hints[name], type) else str(hints[name])
                kind = re.sub(r"\b[a-z][\w.]*\.(?=\w)", "", hint)
                rows += [f"{name} : {kind}, {each.get('unit', '')}".rstrip(", "), f"    {each['about']}."]
            summary, *rest = re.split(r"\n\n(?=\w+\n-{3,}\n)", text, maxsplit=1)
            cls.__doc__ = "\n\n".join([summary, "\n".join(["Parameters", "-" * 10, *rows]), *rest])

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            check, value = each.metadata.get("check"), getattr(self, each.name)
            if check is None or (value is None and each.default is None):
                continue
            check = integer if check is number and "int" in str(each.type) else check
            keep(self, **{each.name: check(each.name, value, **each.metadata["bounds"])})

    @classmethod
    def names(cls) -> set[str]:
        """Names of the fields that are checked."""
        return {each.name for each in fields(cls) if "check" in each.metadata}  # type: ignore[arg-type]

    @classmethod
    def with_overrides(cls, overrides: Mapping[str, Any]) -> Self:
        """Defaults with the parameters in `overrides` replaced; a name that is unknown is a ValueError."""
        check_names(overrides, cls.names())
        return cls(**overrides)

    @classmethod
    def read(cls, key: str, value: Any) -> Self:
        """Return `value`, which is one, or the table of one."""
        if isinstance(value, cls):
            return value
        require(isinstance(value, Mapping), key, value, f"a table or {cls.__name__}", TypeError)
        with inside(key):
            return cls.with_overrides(value)


def check_names(given: Mapping[str, Any], known: Iterable[str], in_file: Iterable[str] = ()) -> None:
    """Refuse a key that is not `known`; the message lists those that are, and what such a table of a file may have."""
    also = f"; in a file also {', '.join(sorted(in_file))}" if in_file else ""
    for key, value in given.items():
        if key not in known:
            raise ValueError(f"{plain(key)} = {show(value)}: unknown key; known: {', '.join(sorted(known))}{also}")
