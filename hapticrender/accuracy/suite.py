"""The accuracy suite: every case of every device kind, run for the methods that are asked for.

The plate's cases are those of `accuracy`, those of the friction devices, and of all kinds together, of
`accuracy_friction`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from hapticrender.accuracy import friction as accuracy_friction
from hapticrender.accuracy import plate as accuracy
from hapticrender.accuracy.figures import Figure, Target
from hapticrender.errors import DesignError

Case = Callable[[str], dict[str, float]]


def _on_the_plate(case: Callable[[accuracy.Bench], dict[str, float]], method: str) -> dict[str, float]:
    return case(accuracy.Bench(method=method))


PLATE: dict[str, Case] = {name: partial(_on_the_plate, case) for name, case in accuracy.CASES.items()}
CASES: dict[str, Case] = PLATE | accuracy_friction.CASES
METHOD_FREE = frozenset((*accuracy.METHOD_FREE, *accuracy_friction.METHOD_FREE))
TARGETS: tuple[Target, ...] = (*accuracy.TARGETS, *accuracy_friction.TARGETS)


def run_suite(
    methods: Iterable[str], cases: Iterable[str] | None = None, progress: Callable[[str], None] | None = None
) -> list[Figure]:
    """Run the suite and return every figure, target by target, method by method.

    Parameters
    ----------
    methods : iterable of str
        Names of the methods; what diverges, or refuses a case, counts as infinite.
    cases : iterable of str, optional
        Names of the cases (`CASES`); all by default.
    progress : callable, optional
        Called with a line before each case.

    Returns
    -------
    list of Figure
        A case of `METHOD_FREE` is run once, and stands for every method.
    """
    found: dict[tuple[str, str], dict[str, float]] = {}
    chosen, methods = list(cases or CASES), list(methods)
    for case in chosen:
        for method in methods:
            if case in METHOD_FREE and method != methods[0]:
                found[case, method] = found[case, methods[0]]
                continue
            if progress is not None:
                progress(case if case in METHOD_FREE else f"{case}: {method}")
            found[case, method] = _figures(case, method)
    figures = []
    for target in TARGETS:
        for method in methods if target.case in chosen else ():
            value = found[target.case, method].get(target.key, np.inf)
            figures.append(Figure(target, method, target.shown(value) if np.isfinite(value) else np.inf))
    return figures


def _figures(case: str, method: str) -> dict[str, float]:
    """Figures of a case; none where the method refuses what is asked of it."""
    try:
        return CASES[case](method)
    except DesignError:
        return {}
