"""The accuracy suite: every case of every device kind, run for the given methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from hapticrender.accuracy import friction, plate
from hapticrender.accuracy.figures import TARGETS, Figure
from hapticrender.errors import DesignError


def _on_the_plate(case: Callable[[plate.Bench], dict[str, float]], method: str) -> dict[str, float]:
    return case(plate.Bench(method=method))


CASES: dict[str, Callable[[str], dict[str, float]]] = {
    **{name: partial(_on_the_plate, case) for name, case in plate.CASES.items()},
    **friction.CASES,
}
METHOD_FREE = frozenset(("identified", *friction.METHOD_FREE))  # cases that do not depend on the method


def run_suite(
    methods: Iterable[str], cases: Iterable[str] | None = None, progress: Callable[[str], None] | None = None
) -> list[Figure]:
    """Run the suite and return every figure, target by target, method by method.

    Parameters
    ----------
    methods : iterable of str
        Names of the methods; what diverges, or refuses a case, counts as infinite.
    cases : iterable of str, optional
        Names of the cases (`CASES`); all by default.  A case of `METHOD_FREE` is run once for all methods.
    progress : callable, optional
        Called with a line before each case.
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
            try:
                found[case, method] = CASES[case](method)
            except DesignError:  # the method refuses the case
                found[case, method] = {}
    return [
        Figure(target, method, target.shown(found[target.case, method].get(target.key, np.inf)))
        for target in TARGETS
        if target.case in chosen
        for method in methods
    ]
