"""Verdicts, scenes and summaries as text for the command line, reports and pages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hapticrender.formatting import band_label, degrees, percent, quantity, short, table

if TYPE_CHECKING:
    from hapticrender.touch.scene import Scene

MEASURED = {"friction": "friction", "skin": "skin velocity"}  # places that name a quantity, not a position


def places_of(summary: Mapping[str, Any]) -> list[str]:
    """Evaluation points that a summary has errors of."""
    return list(summary["waveform"]["places"])


def waveform_error(summary: Mapping[str, Any]) -> float | None:
    """Waveform error at the worst place; None where nothing is judged."""
    found = [figures["waveform_error"] for figures in summary["waveform"]["places"].values() if figures]
    return max(found, default=None)


def at(places: Sequence[str]) -> str:
    """Name where errors are taken, or of which quantity.

    Examples
    --------
    >>> at(["centre", "end_1", "end_2"]), at(["end_1"]), at(["skin"])
    ('at centre and ends', 'at end 1', 'of skin velocity')
    """
    names = [place.replace("_", " ") for place in places]
    if names and set(names) <= MEASURED.keys():
        return f"of {' and '.join(MEASURED[name] for name in names)}"
    ends = len(names) > 1
    return "at " + " and ".join(dict.fromkeys("ends" if ends and name.startswith("end ") else name for name in names))


def total(bands: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Combine `key` ("target" or "achieved", SI) of the judged bands: the root of the sum of squares."""
    values = [band[key] for band in bands if band["target"] is not None and band["achieved"] is not None]
    return math.hypot(*values) if values else None


def verdict(summary: Mapping[str, Any]) -> str:
    """State in one sentence whether a run (``Recording.summary()``) is within its tolerance, and by which figure."""
    if summary["verdict"] == "not judged":
        return f"not judged: {summary['reason']}"
    if summary["verdict"] == "failed" and summary["reason"]:
        return f"misses its tolerance: {summary['reason']}"
    start = "misses its tolerance" if summary["verdict"] == "failed" else "within its tolerance"
    start += f" in band ({summary['reason']})" if summary["verdict"] == "passed in band" else ""
    return f"{start}: worst figure {worst_figure(summary)}, bound {100 * summary['worst']['bound']:.4g} %"


def brief(summary: Mapping[str, Any]) -> str:
    """Verdict of a run for a table's cell: short where it passed."""
    return f"within {100 * summary['tolerance']:.4g} %" if summary["passed"] else verdict(summary)


def worst_figure(summary: Mapping[str, Any]) -> str:
    """Name the figure that decides the verdict: its name, band, place or quantity, and value."""
    worst = summary["worst"]
    third = f"error of the third octave of {worst['band']}"
    figure = third if worst["figure"] == "third_octave_error" else str(worst["figure"]).replace("_", " ")
    return f"{figure} {at([str(worst['place'])])} = {percent(worst['value'])}"


def amplitudes(summaries: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Target and achieved amplitude of every summary; one prefix for all that have the same unit."""
    pairs = [[total(summary["bands"], key) for key in ("target", "achieved")] for summary in summaries]
    units = [summary["unit"] for summary in summaries]
    largest = {
        unit: max(pair[0] or 0.0 for pair, own in zip(pairs, units, strict=True) if own == unit) for unit in units
    }
    return [
        (quantity(target, unit, like=largest[unit]), quantity(achieved, unit, like=largest[unit]))
        for (target, achieved), unit in zip(pairs, units, strict=True)
    ]


def overview(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Tabulate scenes, a line each: amplitudes, the waveform error at the worst place, the verdict."""
    rows = [["scene", "target", "achieved", "error", "verdict"]]
    for summary, pair in zip(summaries, amplitudes(summaries), strict=True):
        rows.append([summary["scene"], *pair, percent(waveform_error(summary)), brief(summary)])
    return table(rows)


def figures(summary: Mapping[str, Any]) -> str:
    """Tabulate all figures of a run, a line a band, with notes and verdict."""
    places, unit = places_of(summary), summary["unit"]
    rows = [["band", "target", "achieved", *(place.replace("_", " ") for place in places), "phase", "settled"]]
    for band in summary["bands"]:
        errors = [percent(band[f"rms_error_{place}"]) for place in places]
        sizes = [quantity(band[key], unit) for key in ("target", "achieved")]
        settled = quantity(band["settling_time"], "s")
        rows.append([band_label(band), *sizes, *errors, degrees(band["phase_error"]), settled])
    lines = [table(rows)] if len(rows) > 1 else []
    lines.append(table([["", "waveform", "worst windows", "worst third octave"], *waveform_rows(summary)]))
    wobble, residual = (quantity(summary[key], unit) for key in ("wobble", "residual_rms"))
    saturated = percent(summary["saturated_share"])
    lines.append(beside(summary))
    lines.append(f"rms errors {at(places)}; wobble {wobble}, beside the bands {residual}, saturated {saturated}")
    return "\n".join([*lines, *summary["notes"], f"{summary['scene']} {verdict(summary)}"])


def waveform_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """Figures of the waveform that decide, a row a place."""
    return [
        [
            place.replace("_", " "),
            percent(each["waveform_error"]),
            percent(each["window_error"]),
            f"{percent(each['third_octave_error'])} at {each['third_octave']}",
        ]
        for place, each in summary["waveform"]["places"].items()
        if each
    ]


def beside(summary: Mapping[str, Any]) -> str:
    """State what decides nothing: errors after contacts, and how the motion differs from the reference."""
    found = summary["waveform"]
    if found["delay"] is None:
        return "no waveform"
    said = [
        f"delay {quantity(found['delay'], 's')}, gain {found['gain']:.3f}, incoherent {percent(found['incoherent'])}"
    ]
    contacts = found["contacts"]
    if contacts["count"]:
        errors = " and ".join(percent(contacts[f"error_{span}_ms"]) for span in ("0_50", "50_200"))
        said.append(f"{contacts['count']} touches and lifts: error {errors} in 0-50 and 50-200 ms after them")
    return "; ".join(said)


def conditions(summary: Mapping[str, Any]) -> str:
    """State in a line what was rendered, how, for how long, and which flags were set."""
    return (
        f"{summary['scene']} on {summary['device']}, method {summary['method']}, seed {summary['seed']}: "
        f"{short(summary['duration'], 's')}, judged from {short(summary['judged_from'], 's')}, "
        f"flagged samples: {flags(summary)}"
    )


def flags(summary: Mapping[str, Any]) -> str:
    """State in how many samples each status flag was set."""
    return ", ".join(f"{name.lower()} {count}" for name, count in summary["flags"].items() if count) or "none"


def describe(scene: Scene) -> str:
    """Describe a scene in a few words: its texture, its finger, its length and its device."""
    texture, motion = scene.texture, scene.finger.motion
    sizes = [
        short(size, unit)
        for key, unit in (("amplitude", "m"), ("wavelength", "m"), ("frequency", "Hz"))
        if (size := getattr(texture, key, None)) is not None
    ]
    series = getattr(texture, "harmonics", 1) if getattr(texture, "shape", "sine") != "sine" else 1
    count = len(getattr(texture, "partials", None) or range(series))
    what = f"{_kind(texture)} {' '.join(sizes)}{f', {count} partials' if count > 1 else ''}"
    speed = getattr(motion, "speed", None)
    finger = [f"{_kind(motion)} finger", *([] if speed is None else [short(speed, "m/s")])]
    return f"{what}; {' '.join(finger)}; {short(scene.duration, 's')} on {scene.device}"


def _kind(thing: Any) -> str:
    """Name the kind of a texture or a motion, or its class where it has no kind."""
    kind = str(getattr(thing, "kind", type(thing).__name__))
    return "no" if kind == "none" else kind
