"""What an accuracy suite says: figures against their targets, as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Target:
    """A figure of the suite: its bound must hold, its aim is wanted; both in `unit`, which is `scale` of the figure."""

    case: str
    key: str
    what: str
    unit: str
    scale: float
    bound: float
    aim: float

    def shown(self, value: float) -> float:
        """Value of the figure in `unit`; a ratio is shown in dB where that is the unit."""
        return float(20 * np.log10(max(value, 1e-12))) if self.unit == "dB" else value * self.scale


@dataclass(frozen=True)
class Figure:
    """What a method reached for a target, in the target's unit."""

    target: Target
    method: str
    value: float

    @property
    def passed(self) -> bool:
        """True where the bound holds."""
        return bool(self.value <= self.target.bound)

    @property
    def reached(self) -> bool:
        """True where the aim holds."""
        return bool(self.value <= self.target.aim)


def as_rows(figures: Iterable[Figure], methods: Iterable[str]) -> list[list[str]]:
    """Rows of a table: target, unit, bound, aim, then a column a method."""
    names = list(methods)
    rows = [["case", "figure", "unit", "bound", "aim", *names]]
    values = {(figure.target, figure.method): figure for figure in figures}
    for target in dict.fromkeys(figure.target for figure in values.values()):
        found = [values[target, name] for name in names]
        marks = [f"{each.value:.3g}{'' if each.passed else ' MISSED'}{' *' if each.reached else ''}" for each in found]
        rows.append([target.case, target.what, target.unit, f"{target.bound:g}", f"{target.aim:g}", *marks])
    return [*rows, ["", "* reaches its aim", "", "", "", *([""] * len(names))]]


def write_json(path: Path, figures: Iterable[Figure]) -> None:
    """Write every figure with its target, unit, bound and aim; one that is not finite is null."""
    rows = [
        {
            **{key: getattr(figure.target, key) for key in ("case", "key", "what", "unit", "bound", "aim")},
            "method": figure.method,
            "value": figure.value if np.isfinite(figure.value) else None,
            "passed": figure.passed,
            "reached": figure.reached,
        }
        for figure in figures
    ]
    path.write_text(json.dumps({"suite": "accuracy", "figures": rows}, indent=2) + "\n", encoding="utf-8")
