"""Parameters of plants, checked field by field against a table of bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, NamedTuple, TypeVar

Parameters = TypeVar("Parameters")


class Bound(NamedTuple):
    """What a parameter may be: `least` to `most` in `unit`; `above`: `least` itself is refused."""

    unit: str = ""
    least: float = 0.0
    most: float = math.inf
    above: bool = False


def positive(unit: str = "") -> Bound:
    """Bound of a parameter that must be > 0."""
    return Bound(unit, above=True)


def check_fields(parameters: Any, bounds: Mapping[str, Bound]) -> None:
    """Refuse the first field of a dataclass, in its order, that is no number of its kind inside its bound."""
    for field in fields(parameters):
        if field.name in bounds:
            check_number(field.name, getattr(parameters, field.name), bounds[field.name], whole=field.type == "int")


def check_number(name: str, value: Any, bound: Bound, *, whole: bool = False) -> None:
    """Refuse what is no finite number (or, if `whole`, integer) inside `bound`."""
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        raise TypeError(f"{name} = {value!r}: must be {'an integer' if whole else 'a number'}")
    if not math.isfinite(value) or value < bound.least or (bound.above and value == bound.least):
        raise ValueError(
            f"{name} = {value!r}: must be {'>' if bound.above else '>='} {bound.least:g} {bound.unit}".rstrip()
        )
    if value > bound.most:
        raise ValueError(f"{name} = {value!r}: must be <= {bound.most:g} {bound.unit}".rstrip())


def overridden(kind: type[Parameters], overrides: Mapping[str, Any], table: str = "plant") -> Parameters:
    """Defaults of a dataclass with some replaced; whatever is refused is named with the `table` it stands in."""
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    for name in overrides:
        if name not in known:
            raise ValueError(f"{table}.{name}: no such parameter; known: {', '.join(sorted(known))}")
    try:
        return kind(**overrides)
    except (ValueError, TypeError) as error:
        raise type(error)(f"{table}.{error}") from None
