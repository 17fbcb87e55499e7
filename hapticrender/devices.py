"""What is installed: kinds of device, drivers and extras, what each needs and whether it is installed."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

from hapticrender.formatting import table

EXTRAS = (  # package, extra, what it is good for
    ("matplotlib", "plot", "pictures"),
    ("h5py", "hdf5", "HDF5 files"),
    ("distributed", "cluster", "sweeps on a cluster"),
)


def text() -> str:
    """Everything as a table for the terminal."""
    kinds = [["kind", "installed", "simulated", "a real one needs"], *map(_kind, _registered("renderers"))]
    drivers = [["driver", "installed", "what it does"], *map(_driver, _registered("drivers"))]
    extras = [
        ["extra", "installed", "for"],
        *([extra, "yes" if find_spec(package) else "no", use] for package, extra, use in EXTRAS),
    ]
    hint = "A driver of your own serves any kind: hapticrender.drivers.base says in a page what it is."
    return "\n\n".join([table(kinds), table(drivers), hint, table(extras)])


def _registered(group: str) -> list[Any]:
    return sorted(entry_points(group=f"hapticrender.{group}"), key=lambda entry: entry.name)


def _kind(entry: Any) -> list[str]:
    """Row of a kind of device: whether a model of it comes along, and what hardware it takes."""
    loaded, trouble = _load(entry)
    if loaded is None:
        return [entry.name, "broken", "no", trouble]
    simulated = "yes" if hasattr(loaded, "plant") else "no"
    return [entry.name, "yes", simulated, f"{getattr(loaded, 'needs', 'a driver')}  ({entry.value})"]


def _driver(entry: Any) -> list[str]:
    """Row of a driver."""
    loaded, trouble = _load(entry)
    if loaded is None:
        return [entry.name, "broken", trouble]
    first = str(loaded.__doc__ or "").strip().partition("\n")[0]
    return [entry.name, "yes", f"{first}  ({entry.value})"]


def _load(entry: Any) -> tuple[Any, str]:
    """Return what an entry point is, or None and why it cannot be used."""
    try:
        return entry.load(), ""
    except (Exception, SystemExit) as error:  # a third party's module may fail in any way; the list must go on
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return None, f"cannot be loaded from {entry.value} ({reason})"
