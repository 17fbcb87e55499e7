"""Control methods, one small file each; this list drives the choice by name, the tests and the charts."""

from __future__ import annotations

from hapticrender.control.methods.boxcar import Boxcar
from hapticrender.control.methods.inverse import DynamicStiffness, StaticInverse
from hapticrender.control.methods.paper import CommonMode, PerSide
from hapticrender.control.methods.resonant import Resonant
from hapticrender.control.methods.stiffness import ErrorObserver, SignalObserver
from hapticrender.protocols import Method

_ALL: tuple[Method, ...] = (
    PerSide(),
    CommonMode(),
    Boxcar(),
    StaticInverse(),
    DynamicStiffness(),
    Resonant(),
    SignalObserver(),
    ErrorObserver(),
)
METHODS = {method.name: method for method in _ALL}


def method_named(name: str) -> Method:
    """Return the method called `name`; a ValueError lists the known ones."""
    if name not in METHODS:
        raise ValueError(f"method = {name!r}: must be one of {', '.join(METHODS)}")
    return METHODS[name]
