"""The accuracy suite: cases of every kind of device, their targets, and their figures as a table and as JSON.

Bounds of friction devices that their goals do not give: tones and reversals a tenth of the least 10 % that is noticed
[Israr 2006]; the comb as if one of its 20 bands had the whole error, 10 %/sqrt(20); swipes the plate's bound for 1600
Hz/s, as 3 Hz and +-50 mm/s sweep by 1885 Hz/s over 0.5 mm; a touch the time constant of the 20 Hz lock.  Their aims are
half of the bound (6 dB), but 1 % of area and velocity, and 2.5 ms of a touch, the amplitude's response.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticrender import defaults
from hapticrender.accuracy import friction, plate
from hapticrender.errors import DesignError, DeviceFault
from hapticrender.formatting import as_json
from hapticrender.report.outputs import write_report

SCALE = {"%": 100.0, "ms": 1e3, "um": 1e6, "samples": 1.0, "Hz": 1.0, "fingers": 1.0}  # of a figure in SI


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


Rows = tuple[tuple[str, str, str, dict[str, tuple[float, float]]], ...]  # case, what, unit; bound and aim of each key
PLATES: Rows = (
    ("white", "white noise, heavy finger sliding", "%", {"free": (1, 0.4), "free, end": (2, 0.7)}),
    ("white", "white noise, heavy finger sliding", "%", {"slide": (1, 0.5), "slide, end": (2, 0.9)}),
    ("white wrong", "plate wrong in all but the delay", "%", {"free": (1.5, 0.8), "free, end": (4, 2.3)}),
    ("white wrong", "plate wrong in all but the delay", "%", {"slide": (1.5, 0.8), "slide, end": (4, 2.3)}),
    ("white 48 kHz", "white noise in blocks of 64", "%", {"free": (1, 0.5), "free, end": (2, 0.8)}),
    ("white 48 kHz", "white noise in blocks of 64", "%", {"slide": (1, 0.5), "slide, end": (2, 0.8)}),
    ("white modes", "mode at 1250 Hz, either sign, unknown", "%", {"free": (1, 0.4), "free, end": (2, 0.7)}),
    ("white modes", "mode at 1250 Hz, either sign, unknown", "%", {"slide": (1, 0.5), "slide, end": (2, 0.9)}),
    ("waves", "pink noise, clicks, chirp, worst of 4 fingers sliding", "%", {"finger": (2, 1.2), "end": (4, 2)}),
    ("random fingers", "white noise, 24 fingers", "%", {"median": (1, 0.7)}),
    ("random fingers", "white noise, 24 fingers", "fingers", {"above 5 %": (4, 2)}),
    ("free", "rigid plate, 11 tones, ends included, noise averaged", "%", {"error": (0.05, 0.03)}),
    ("free wrong", "the same, plate wrong in everything", "%", {"centre": (1, 0.6)}),
    ("tones", "rigid plate, 11 tones, heavy finger sliding, rms", "%", {"finger": (0.2, 0.1), "end": (0.5, 0.3)}),
    ("tones bent", "the same, glass that bends", "%", {"finger": (0.2, 0.1), "end": (0.5, 0.3)}),
    ("tones wrong", "the same, rigid, wrong in everything", "%", {"finger": (1, 0.5)}),
    ("comb", "rigid plate, 20 lines, heavy finger sliding", "dB", {"finger": (-52, -55), "end": (-45, -50)}),
    ("comb", "the same, first half second", "dB", {"first": (-35, -40)}),
    ("comb bent", "the same, glass that bends", "dB", {"finger": (-52, -55), "end": (-45, -50)}),
    ("comb bent", "the same, first half second", "dB", {"first": (-35, -40)}),
    ("sweeps", "rigid plate, sweep under a finger, rms", "%", {"200 Hz/s": (0.3, 0.15), "400 Hz/s": (0.3, 0.15)}),
    ("sweeps", "rigid plate, sweep under a finger, rms", "%", {"800 Hz/s": (0.5, 0.25), "1600 Hz/s": (1, 0.5)}),
    ("sweeps bent", "the same, glass that bends", "%", {"200 Hz/s": (0.3, 0.15), "400 Hz/s": (0.3, 0.15)}),
    ("sweeps bent", "the same, glass that bends", "%", {"800 Hz/s": (0.5, 0.25), "1600 Hz/s": (1, 0.5)}),
    ("touch", "touch in 1 ms, lift-off in a sample: peak", "%", {"centre": (9, 6), "end": (22, 12)}),
    ("touch", "the same, at 0, 15 and 27.5 mm", "%", {"finger": (22, 12)}),
    ("touch", "the same: centre back within 5 %", "ms", {"back": (50, 25)}),
    ("touch", "the same: left after 0.6 s (a limit cycle would show)", "%", {"left": (5, 1)}),
    ("touch modes", "the same, mode at 1250 Hz, either sign, unknown", "%", {"centre": (9, 6), "end": (22, 12)}),
    ("touch rigid", "the same, rigid plate", "%", {"centre": (9, 6), "end": (22, 12)}),
    ("touch wrong", "the same, rigid, wrong in everything, heavy fingers", "%", {"centre": (11, 11), "end": (22, 22)}),
    ("touch blocks", "rigid, heavy fingers, blocks of 25 at 5 kHz", "%", {"centre": (40, 40), "end": (80, 80)}),
    ("touch 48 kHz", "rigid, heavy fingers, blocks of 64 at 48 kHz", "%", {"centre": (40, 40), "end": (80, 80)}),
    ("touch 10 um", "touch, rigid plate, 10 um under 0.8 N", "%", {"centre": (30, 30), "end": (70, 70)}),
    ("small", "rigid plate, 1 um at 20 Hz under 0.5 N", "%", {"pressed": (0.5, 0.5)}),
    ("small", "rigid plate, mean of a target of 0.1 um", "%", {"0.1 um": (1, 1)}),
    ("wobble", "wobble of a held 1 um", "um", {"held": (0.015, 0.01)}),
    ("modulation", "rigid plate, 30 % AM at 5 Hz", "%", {"error": (0.5, 0.5)}),
    ("late", "rigid plate, known delay of 60 ms", "%", {"error": (1, 0.1)}),
    ("overload", "2 s of 1 mm at 400 Hz, then 100 um: back within 5 %", "ms", {"back": (250, 220)}),
    ("overload", "third harmonic while overloaded", "um", {"third": (0.01, 0.005)}),
    ("identified", "identification in 1 s at 100 um", "%", {"m, I, k": (0.05, 0.05), "b": (0.2, 0.2)}),
    ("identified", "the same", "samples", {"delay": (0.002, 0.001)}),
    ("identified", "the same, bending mode", "Hz", {"frequency": (0.5, 0.5)}),
    ("identified", "the same, bending mode", "%", {"coupling": (5, 5)}),
)
FRICTION: Rows = (  # of screens and ultrasonic plates alike
    ("tones", "friction tones, 20-400 Hz, three fingers, rms", "%", {"error": (1, 0.5)}),
    ("comb", "20 bands, 20-400 Hz, amplitudes", "dB", {"error": (-33, -39)}),
    ("swipe", "ridges under swipes of 3 Hz, rms where judged", "%", {"swipe": (2.5, 1.1)}),
    ("swipe", "ridges under a finger that goes to and fro", "%", {"fro": (1, 0.5)}),
)
SCREEN: Rows = (
    ("area", "area +-30 %, gap 0.5-3 um, rms of the force", "%", {"error": (3, 1)}),
    ("harmonic", "second harmonic of friction, with the square root", "%", {"second": (0.1, 0.05)}),
    *FRICTION,
)
ULTRASONIC: Rows = (
    *FRICTION,
    ("step", "amplitude's response to 5 % (independent of the method)", "ms", {"response": (2.5, 1.25)}),
    ("modulation", "AM at 400 Hz, off by (independent of the method)", "dB", {"gain": (1, 0.5)}),
    ("heat", "amplitude while warming by 10 K (independent of the method)", "%", {"error": (2, 1)}),
    ("touch", "unlocked after a touch or lift (independent of the method)", "ms", {"unlocked": (20, 5)}),
    ("press", "load within 1 ms, peak of amplitude (independent of the method)", "%", {"peak": (2, 1)}),
    ("touch", "amplitude back within 2 % (independent of the method)", "ms", {"back": (8, 2.5)}),
)
DEVICES = ("vt-plate", "electroadhesion", "ultrasonic")
EVERY: Rows = (("velocity", "one texture, skin velocity", "%", dict.fromkeys(DEVICES, (5, 1))),)
TARGETS = tuple(
    Target(f"{device}: {case}" if device else case, key, f"{what}: {key}", unit, *figures)
    for device, table in (
        ("", PLATES),
        ("electroadhesion", SCREEN),
        ("ultrasonic", ULTRASONIC),
        ("every device", EVERY),
    )
    for case, what, unit, rows in table
    for key, figures in rows.items()
)
CASES = (*plate.CASES, *friction.CASES)
METHOD_FREE = frozenset(("identified", *friction.WITHOUT_METHOD))  # cases that do not depend on the method


def run_suite(
    methods: Iterable[str], cases: Iterable[str] = CASES, progress: Callable[[str], None] | None = None, **bench: Any
) -> list[Figure]:
    """Run cases (of `CASES`) and return every figure, target by target, method by method.

    What diverges, is stopped, or refuses a case, counts as infinite.  One of `METHOD_FREE` is run once for all methods.
    `progress` is called with a line before each, and the reason of a refusal or stop.  `bench` holds arguments of
    `plate.Bench`, for the cases of plates.
    """
    found: dict[tuple[str, str], dict[str, float]] = {}
    chosen, methods = list(cases), list(methods)
    for case in chosen:
        for method in methods:
            if case in METHOD_FREE and method != methods[0]:
                found[case, method] = found[case, methods[0]]
                continue
            if progress is not None:
                progress(case if case in METHOD_FREE else f"{case}: {method}")
            refusals = () if method == defaults.METHOD else (ValueError,)  # laws by bands play no whole waveform
            try:
                if case in plate.CASES:
                    found[case, method] = plate.CASES[case](plate.Bench(method=method, **bench))
                else:
                    found[case, method] = friction.CASES[case](method)
            except (DesignError, DeviceFault, *refusals) as error:  # the method refuses the case, or is stopped
                found[case, method] = {}
                if progress is not None:
                    progress(f"{case}: {method}: {error}")
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
