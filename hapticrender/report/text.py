"""Verdicts, scenes, summaries and progress as text for the command line, reports and pages."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

from hapticrender.formatting import band_label, closed_pipes, degrees, percent, quantity, short, table
from hapticrender.touch.scene import Scene

MEASURED = {"friction": "friction", "skin": "skin velocity"}  # places that name a quantity, not a position


def at(places: Sequence[str]) -> str:
    """Name where errors are taken, or of which quantity.

    >>> at(["centre", "end_1", "end_2"]), at(["end_1"]), at(["skin"])
    ('at centre and ends', 'at end 1', 'of skin velocity')
    """
    names = [place.replace("_", " ") for place in places]
    if names and set(names) <= MEASURED.keys():
        return f"of {' and '.join(MEASURED[name] for name in names)}"
    ends = len(names) > 1
    return "at " + " and ".join(dict.fromkeys("ends" if ends and name.startswith("end ") else name for name in names))


def verdict(summary: Mapping[str, Any]) -> str:
    """State in one sentence whether a run (``Recording.summary()``) is within its tolerance, and by which figure."""
    if summary["verdict"] == "not judged":
        return f"not judged: {summary['reason']}"
    if summary["verdict"] == "failed" and summary["reason"]:
        return f"misses its tolerance: {summary['reason']}"
    start = "misses its tolerance" if summary["verdict"] == "failed" else "within its tolerance"
    start += f" in band ({summary['reason']})" if summary["verdict"] == "passed in band" else ""
    worst = summary["worst"]
    third = f"error of the third octave of {worst['band']}"
    figure = third if worst["figure"] == "third_octave_error" else str(worst["figure"]).replace("_", " ")
    value = f"{figure} {at([str(worst['place'])])} = {percent(worst['value'])}"
    return f"{start}: worst figure {value}, bound {100 * worst['bound']:.4g} %"


def overview(summaries: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Head and rows of a table of scenes: amplitudes, the waveform error at the worst place, the verdict.

    An amplitude is the root of the sum of squares over the judged bands.
    """
    rows = [["scene", "target", "achieved", "error", "verdict"]]
    for summary in summaries:
        pairs = [(band["target"], band["achieved"]) for band in summary["bands"]]
        judged = zip(*(pair for pair in pairs if None not in pair), strict=True)
        sizes = [quantity(math.hypot(*sizes), summary["unit"]) for sizes in judged] or [quantity(None, "")] * 2
        errors = [figures["waveform_error"] for figures in summary["waveform"]["places"].values() if figures]
        found = f"within {100 * summary['tolerance']:.4g} %" if summary["passed"] else verdict(summary)
        rows.append([summary["scene"], *sizes, percent(max(errors, default=None)), found])
    return rows


def band_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """Head and rows of a table of a run's bands, with rms errors at every place."""
    places = list(summary["waveform"]["places"])
    rows = [["band", "target", "achieved", *(place.replace("_", " ") for place in places), "phase", "settled"]]
    for band in summary["bands"]:
        sizes = [quantity(band[key], summary["unit"]) for key in ("target", "achieved")]
        errors = [percent(band[f"rms_error_{place}"]) for place in places]
        settled = quantity(band["settling_time"], "s")
        rows.append([band_label(band), *sizes, *errors, degrees(band["phase_error"]), settled])
    return rows


def waveform_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """Head and rows of a table of the figures that decide, a row a place."""
    rows = [["", "waveform", "worst windows", "worst third octave"]]
    for place, each in summary["waveform"]["places"].items():
        if each:
            third = f"{percent(each['third_octave_error'])} at {each['third_octave']}"
            errors = [percent(each[key]) for key in ("waveform_error", "window_error")]
            rows.append([place.replace("_", " "), *errors, third])
    return rows


def remarks(summary: Mapping[str, Any]) -> list[str]:
    """State what the tables of a run do not have and what decides nothing, and its notes, a line each."""
    wobble, saturated = quantity(summary["wobble"], summary["unit"]), percent(summary["saturated_share"])
    bands = f"rms errors {at(list(summary['waveform']['places']))}; wobble {wobble}, saturated {saturated}"
    return [beside(summary), bands, *summary["notes"]]


def figures(summary: Mapping[str, Any]) -> str:
    """Tabulate all figures of a run, with remarks and verdict."""
    tables = [table(band_rows(summary))] if summary["bands"] else []
    tables.append(table(waveform_rows(summary)))
    return "\n".join([*tables, *remarks(summary), f"{summary['scene']} {verdict(summary)}"])


def beside(summary: Mapping[str, Any]) -> str:
    """State what decides nothing: errors after contacts, and how the motion differs from the reference."""
    found = summary["waveform"]
    if found["delay"] is None:
        return "no waveform"
    delay, incoherent, contacts = quantity(found["delay"], "s"), percent(found["incoherent"]), found["contacts"]
    stated = f"delay {delay}, gain {found['gain']:.3f}, incoherent {incoherent}"
    if contacts["count"]:
        errors = " and ".join(percent(contacts[f"error_{span}_ms"]) for span in ("0_50", "50_200"))
        stated += f"; {contacts['count']} touches and lifts: error {errors} in 0-50 and 50-200 ms after them"
    return stated


def conditions(summary: Mapping[str, Any]) -> str:
    """State in a line what was rendered, how, for how long, and which flags were set."""
    flags = ", ".join(f"{name.lower()} {count}" for name, count in summary["flags"].items() if count) or "none"
    return (
        f"{summary['scene']} on {summary['device']}, method {summary['method']}, seed {summary['seed']}: "
        f"{short(summary['duration'], 's')}, judged from {short(summary['judged_from'], 's')}, flagged samples: {flags}"
    )


def describe(scene: Scene) -> str:
    """Describe a scene in a line: its texture, its finger, its length and its device."""
    texture, motion = (getattr(each, "kind", type(each).__name__) for each in (scene.texture, scene.finger.motion))
    sizes = ((getattr(scene.texture, key, None), unit) for key, unit in (("amplitude", "m"), ("frequency", "Hz")))
    what = " ".join([str(texture), *(short(size, unit) for size, unit in sizes if size is not None)])
    return f"{what}; finger: {motion}; {short(scene.duration, 's')} on {scene.device}"


@contextmanager
def progress(label: str, stream: TextIO) -> Iterator[Callable[[float, float], None]]:
    """Yield ``tick(done, total)`` (s), which shows the share that is done on a terminal; write `label` at the end.

    >>> import sys
    >>> with progress("1/2 first", sys.stdout) as tick:
    ...     tick(0.5, 1.0)
    1/2 first
    """
    terminal = stream.isatty()

    def tick(done: float, total: float) -> None:
        if terminal:
            print(f"\r{label} {100 * done / total:3.0f} %", end="", file=stream, flush=True)

    try:
        yield tick
    except BaseException:
        if terminal:
            print(file=stream)
        raise
    with closed_pipes():
        print(f"\r{label}\x1b[K" if terminal else label, file=stream, flush=True)
