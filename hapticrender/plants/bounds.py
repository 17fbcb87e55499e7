"""Parameter classes whose fields say their own bounds, and check them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field, fields
from typing import Any, Self


def number(
    default: float, unit: str = "", *, above: float | None = None, least: float = 0.0, most: float = math.inf
) -> Any:
    """Field of a parameter class: > `above`, or >= `least`, and <= `most`, in `unit`."""
    return field(default=default, metadata={"unit": unit, "above": above, "least": least, "most": most})


def choice(default: str, *known: str) -> Any:
    """Field of a parameter class that is one of the words in `known`."""
    return field(default=default, metadata={"known": known})


class Validated:
    """Parameter class whose fields are made by `number` and `choice`, and say so when they are broken."""

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]
            if "free" not in each.metadata:  # checked by its own class
                check = _check_choice if "known" in each.metadata else _check_number
                check(each, getattr(self, each.name))

    @classmethod
    def names(cls) -> set[str]:
        """Names of the parameters that `number` and `choice` made."""
        return {each.name for each in fields(cls) if "free" not in each.metadata}  # type: ignore[arg-type]

    @classmethod
    def with_overrides(cls, overrides: Mapping[str, Any], also: Iterable[str] = ()) -> Self:
        """Defaults with some parameters replaced.

        Parameters
        ----------
        overrides : mapping
            Values by name.
        also : iterable of str
            What else a scene's `plant` table knows, read elsewhere.

        Raises
        ------
        ValueError
            A name is unknown; the known ones are listed, `also` among them.
        """
        check_names(overrides, cls.names(), also)
        try:
            return cls(**overrides)
        except (ValueError, TypeError) as error:
            raise type(error)(f"plant.{error}") from None


def check_names(given: Iterable[str], known: Iterable[str], also: Iterable[str] = ()) -> None:
    """Refuse a name of a scene's `plant` table that is not `known`; list those that are, and what is known `also`."""
    known = set(known)
    for name in given:
        if name not in known:
            listed = ", ".join(sorted(known.union(also)))
            raise ValueError(f"plant.{name}: no such parameter; known: {listed}")


def _check_choice(each: Any, value: Any) -> None:
    if value not in each.metadata["known"]:
        raise ValueError(f"{each.name} = {value!r}: must be one of {', '.join(each.metadata['known'])}")


def _check_number(each: Any, value: Any) -> None:
    whole = each.type in (int, "int")
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        raise TypeError(f"{each.name} = {value!r}: must be {'an integer' if whole else 'a number'}")
    unit, above, least, most = (each.metadata[key] for key in ("unit", "above", "least", "most"))
    bound = f">= {least:g}" if above is None else f"> {above:g}"
    if not math.isfinite(value) or (value < least if above is None else value <= above):
        raise ValueError(f"{each.name} = {value!r}: must be {bound} {unit}".rstrip())
    if value > most:
        raise ValueError(f"{each.name} = {value!r}: must be <= {most:g} {unit}".rstrip())
