"""Designs that were made before: a run repeats its own, and a sweep designs for the same device again and again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

MOST = 256  # designs

P = ParamSpec("P")
T = TypeVar("T")


def remembered(function: Callable[P, T]) -> Callable[P, T]:
    """Remember what a pure function made of arguments with these contents; nobody may change what it returns."""
    known: dict[Hashable, T] = {}

    @wraps(function)
    def recall(*args: P.args, **named: P.kwargs) -> T:
        key = contents((args, tuple(sorted(named.items()))))
        if key not in known:
            if len(known) >= MOST:
                known.clear()
            known[key] = function(*args, **named)
        return known[key]

    return recall


def contents(value: Any) -> Hashable:
    """What a value holds, to be found again: numbers, arrays, and sequences and data classes of such.

    What cannot be told from others of its kind is never found again.
    """
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), *(contents(getattr(value, each.name)) for each in fields(value))
    if isinstance(value, tuple | list):
        return type(value), *(contents(each) for each in value)
    return type(value), value if isinstance(value, Hashable) else object()
