"""Control methods, one small file each; this list drives the choice by name, the tests and the charts."""

from __future__ import annotations

from hapticrender.control.methods.paper import CommonMode, PerSide
from hapticrender.protocols import Method

METHODS: dict[str, Method] = {method.name: method for method in (PerSide(), CommonMode())}


def method_named(name: str) -> Method:
    """Return the method called `name`; a ValueError lists the known ones."""
    if name not in METHODS:
        raise ValueError(f"method = {name!r}: must be one of {', '.join(METHODS)}")
    return METHODS[name]
