"""The accuracy suite: cases of every kind of device, their targets, and their figures as a table and as JSON.

Bounds of friction devices that their goals do not give: tones and reversals a tenth of the least 10 % that is noticed
[Israr 2006]; the comb as if one of its 20 bands had the whole error, 10 %/sqrt(20); swipes the plate's bound for 1600
Hz/s, as 3 Hz and +-50 mm/s sweep by 1885 Hz/s over 0.5 mm; a touch the time constant of the 20 Hz lock.  Their aims are
half of the bound (6 dB), but 1 % of area and velocity, and 2.5 ms of a touch, the amplitude's response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hapticrender.accuracy import friction, plate
from hapticrender.errors import DesignError
from hapticrender.formatting import as_json
from hapticrender.report.outputs import write_report

SCALE = {"%": 100.0, "ms": 1e3, "um": 1e6, "samples": 1.0}  # of a figure in SI


class Target(NamedTuple):
    """A figure of a case: its bound must hold, its aim is a goal; both in `unit`."""

    case: str
    key: str
    what: str
    unit: str
    bound: float
    aim: float

    def shown(self, value: float) -> float:
        """Value of the figure in `unit`; a ratio becomes dB where that is the unit, what is not finite infinite."""
        if not np.isfinite(value):
            return np.inf
        return float(20 * np.log10(max(value, 1e-12))) if self.unit == "dB" else value * SCALE[self.unit]


class Figure(NamedTuple):
    """Value that a method reached for a target, in the target's unit."""

    target: Target
    method: str
    value: float

    @property
    def passed(self) -> bool:
        """Whether the bound holds."""
        return bool(self.value <= self.target.bound)

    @property
    def reached(self) -> bool:
        """Whether the aim holds."""
        return bool(self.value <= self.target.aim)


TARGETS = (
    Target("free", "error", "free plate, 11 frequencies, ends included, noise averaged", "%", 0.05, 0.03),
    Target("slide", "centre", "heavy finger sliding at 100 mm/s, rms at the centre", "%", 0.4, 0.2),
    Target("slide", "ends", "the same at the ends", "%", 1.5, 0.6),
    Target("touch", "peak", "touch in 1 ms, lift-off in a sample, 143-400 Hz: peak at the centre", "%", 18.0, 10.0),
    Target("touch", "back", "the same: back within 5 %", "ms", 50.0, 25.0),
    Target("touch", "left", "the same: left after 0.6 s (a limit cycle would show)", "%", 5.0, 1.0),
    Target("chirp", "200 Hz/s", "chirp of 200 Hz/s under a finger, rms", "%", 0.6, 0.4),
    Target("chirp", "400 Hz/s", "chirp of 400 Hz/s", "%", 0.8, 0.5),
    Target("chirp", "800 Hz/s", "chirp of 800 Hz/s", "%", 1.5, 0.7),
    Target("chirp", "1600 Hz/s", "chirp of 1600 Hz/s", "%", 2.5, 1.1),
    Target("comb", "centre", "20 bands under a sliding heavy finger, centre", "dB", -48.0, -51.0),
    Target("comb", "ends", "the same at the ends", "dB", -35.0, -40.0),
    Target("press", "pressed", "1 um at 20 Hz under a press of 0.5 N", "%", 1.0, 0.5),
    Target("press", "0.1 um", "mean of a target of 0.1 um", "%", 2.0, 1.0),
    Target("wobble", "held", "wobble of a held amplitude", "um", 0.025, 0.015),
    Target("wobble", "AM", "30 % AM at 5 Hz", "%", 0.5, 0.5),
    Target("wrong", "free", "plate wrong (k +5, m -5, b -20 %, gains +-2 %, delay +1): free", "%", 1.0, 0.6),
    Target("wrong", "touch", "the same: touch", "%", 18.0, 13.0),
    Target("wrong", "slide", "the same: slide", "%", 1.0, 0.5),
    Target("late", "error", "known delay of 60 ms: free plate", "%", 1.0, 0.1),
    Target("overload", "back", "2 s of 1 mm at 400 Hz, then 100 um: back within 5 %", "ms", 250.0, 220.0),
    Target("overload", "third", "third harmonic while overloaded", "um", 0.01, 0.005),
    Target("identified", "m, I, k", "identification in 1 s at 100 um: mass, inertia, stiffness", "%", 0.3, 0.1),
    Target("identified", "b", "the same: damping", "%", 1.0, 0.4),
    Target("identified", "delay", "the same: delay", "samples", 0.01, 0.001),
    Target("electroadhesion: area", "error", "area +-30 %, gap 0.5-3 um, rms of the force", "%", 3.0, 1.0),
    Target("electroadhesion: harmonic", "second", "second harmonic of friction, with the square root", "%", 0.1, 0.05),
    *(
        Target(f"{device}: {case}", key, what, unit, bound, aim)
        for device in ("electroadhesion", "ultrasonic")
        for case, key, what, unit, bound, aim in (
            ("tones", "error", "friction tones, 20-400 Hz, three fingers, rms", "%", 1.0, 0.5),
            ("comb", "error", "20 bands, 20-400 Hz, amplitudes", "dB", -33.0, -39.0),
            ("swipe", "swipe", "ridges under swipes of 3 Hz, rms where judged", "%", 2.5, 1.1),
            ("swipe", "fro", "ridges under a finger that goes to and fro", "%", 1.0, 0.5),
        )
    ),
    *(
        Target(f"ultrasonic: {case}", key, f"{what} (independent of the method)", unit, bound, aim)
        for case, key, what, unit, bound, aim in (
            ("step", "response", "amplitude's response to 5 %", "ms", 2.5, 1.25),
            ("modulation", "gain", "AM at 400 Hz, off by", "dB", 1.0, 0.5),
            ("heat", "error", "amplitude while warming by 10 K", "%", 2.0, 1.0),
            ("touch", "unlocked", "unlocked after a touch or lift", "ms", 20.0, 5.0),
            ("press", "peak", "load within 1 ms, peak of amplitude", "%", 2.0, 1.0),
            ("touch", "back", "amplitude back within 2 %", "ms", 8.0, 2.5),
        )
    ),
    *(
        Target("every device: velocity", device, f"one texture, skin velocity on {device}", "%", 5.0, 1.0)
        for device in ("vt-plate", "electroadhesion", "ultrasonic")
    ),
)
CASES: dict[str, Callable[[str], dict[str, float]]] = {**plate.CASES, **friction.CASES}
METHOD_FREE = frozenset(("identified", *friction.WITHOUT_METHOD))  # cases that do not depend on the method


def run_suite(
    methods: Iterable[str], cases: Iterable[str] | None = None, progress: Callable[[str], None] | None = None
) -> list[Figure]:
    """Run the suite and return every figure, target by target, method by method.

    What diverges, or refuses a case, counts as infinite.  `cases` (of `CASES`) are all by default; one of `METHOD_FREE`
    is run once for all methods.  `progress` is called with a line before each.
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


def as_rows(figures: Iterable[Figure], methods: Iterable[str]) -> list[list[str]]:
    """Rows of a table: target, unit, bound, aim, then a column a method."""
    names = list(methods)
    rows: dict[Target, list[str]] = {}
    for each in figures:
        target = each.target
        row = rows.setdefault(target, [target.case, target.what, target.unit, f"{target.bound:g}", f"{target.aim:g}"])
        row.append(f"{each.value:.3g}{'' if each.passed else ' MISSED'}{' *' if each.reached else ''}")
    head, foot = ["case", "figure", "unit", "bound", "aim", *names], ["", "* reaches its aim", "", "", ""]
    return [head, *rows.values(), foot + [""] * len(names)]


def write_json(path: Path, figures: Iterable[Figure]) -> None:
    """Write every figure with its target, unit, bound and aim; one that is not finite is null."""
    rows = [
        {**each.target._asdict(), "method": each.method, "value": each.value}
        | {"passed": each.passed, "reached": each.reached}
        for each in figures
    ]
    write_report(path, as_json({"suite": "accuracy", "figures": rows}).encode("utf-8"))
