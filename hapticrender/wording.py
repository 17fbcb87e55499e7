"""Numbers and verdicts in words, the same on the command line, in a report and on a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hapticrender.touch.scene import Scene

PLACES = ("centre", "end_1", "end_2")
MEASURED = {"friction": "friction", "skin": "skin velocity"}  # places that name what is measured, not where
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))


def quantity(value: float | None, unit: str) -> str:
    """Write a measured `value` (SI) with a prefix and three digits, a dash for none.

    Examples
    --------
    >>> quantity(1.0016e-5, "m"), quantity(None, "s")
    ('10.0 µm', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) < _PREFIXES[-1][0]:
        return f"0 {unit}"
    scale, prefix = _prefix(value)
    return f"{_digits(value / scale)} {prefix}{unit}"


def short(value: float, unit: str) -> str:
    """Write a chosen `value` (SI) with a prefix and no more digits than it needs, four at most.

    Examples
    --------
    >>> short(1e-3, "m"), short(62.5, "Hz")
    ('1 mm', '62.5 Hz')
    """
    scale, prefix = _prefix(value)
    return f"{value / scale:.4g} {prefix}{unit}"


def percent(ratio: float | None) -> str:
    """Write a relative error (1) in percent with three digits; a dash for none."""
    return "–" if ratio is None or not math.isfinite(ratio) else f"{_digits(100 * ratio)} %"


def band_label(band: Mapping[str, Any]) -> str:
    """Name a band: its frequency, or its wavelength and the median frequency at which it was judged.

    Examples
    --------
    >>> band_label({"frequency": 62.5, "wavelength": None}), band_label({"frequency": 171.2, "wavelength": 468.3e-6})
    ('62.5 Hz', '468.3 µm (171 Hz)')
    """
    frequency, wavelength = band.get("frequency"), band.get("wavelength")
    if not wavelength:
        return short(frequency, "Hz") if frequency else "0 Hz"
    return short(wavelength, "m") + (f" ({short(float(f'{frequency:.3g}'), 'Hz')})" if frequency else "")


def bands_label(bands: Sequence[Mapping[str, Any]]) -> str:
    """One band's name, or how many there are and from where to where."""
    labels = [band_label(band) for band in bands]
    return labels[0] if len(labels) == 1 else f"{len(labels)} bands, {labels[0]} to {labels[-1]}"


def columns_of(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """Places whose errors stand in the columns of a table: the first one that the device has, and the ends."""
    keys = [key.removeprefix("rms_error_") for key in (summary["bands"] or [{}])[0] if key.startswith("rms_error_")]
    return (keys[0] if keys else PLACES[0], *PLACES[1:])


def titles(summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Titles of those columns; the first is the place's own name where all devices agree on it."""
    first = {columns_of(summary)[0].replace("_", " ") for summary in summaries}
    return [first.pop() if len(first) == 1 else "at the finger", "end 1", "end 2"]


def at(places: Sequence[str]) -> str:
    """Say where errors are taken, or of which quantity.

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


def drawn(unit: str) -> tuple[float, str]:
    """Scale and unit in which a quantity of `unit` (SI) is drawn.

    Examples
    --------
    >>> drawn("m")
    (1000000.0, 'µm')
    """
    return (1e6, "µm") if unit == "m" else (1e3, f"m{unit}")


def worst_at(bands: Sequence[Mapping[str, Any]], place: str) -> float | None:
    """Find the largest abs(rms error) (1) of all bands at "centre", "end_1" or "end_2"; None without figures."""
    errors = [band.get(f"rms_error_{place}") for band in bands]
    known = [abs(error) for error in errors if error is not None and math.isfinite(error)]
    return max(known, default=None)


def total(bands: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Add up `key` ("target" or "achieved", m) over the judged bands: the root of the sum of squares."""
    values = [band[key] for band in bands if band["target"] is not None and band["achieved"] is not None]
    return math.hypot(*values) if values else None


def verdict(summary: Mapping[str, Any]) -> str:
    """One plain sentence: within its tolerance or not, and by which figure.

    Parameters
    ----------
    summary : mapping
        What ``Recording.summary()`` returns.
    """
    if summary["worst"]["value"] is None:
        return "misses its tolerance: it cannot be judged, there is no figure"
    start = "within its tolerance" if summary["passed"] else "misses its tolerance"
    return f"{start}: worst figure {worst_figure(summary)}, tolerance {100 * summary['tolerance']:.4g} %"


def worst_figure(summary: Mapping[str, Any]) -> str:
    """Say which figure decides the verdict: its name, band, place or quantity, and value."""
    worst = summary["worst"]
    place, figure = (str(worst[key]).replace("_", " ") for key in ("place", "figure"))
    name, where = figure.removesuffix(f" {place}"), at([place])
    band = f"the {worst['band']} band"
    said = f"{where} in {band}" if place in MEASURED else f"of {band} {where}"
    return f"{name} {said} = {percent(worst['value'])}"


def overview(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Tabulate scenes, a line each: amplitudes, the largest rms error at each place, the verdict."""
    rows = [["scene", "target", "achieved", *titles(summaries), "verdict"]]
    for summary in summaries:
        bands = summary["bands"]
        amplitudes = [quantity(total(bands, key), summary["unit"]) for key in ("target", "achieved")]
        errors = [percent(worst_at(bands, place)) for place in columns_of(summary)]
        within = f"within {100 * summary['tolerance']:.4g} %"
        rows.append([summary["scene"], *amplitudes, *errors, within if summary["passed"] else verdict(summary)])
    return table(rows)


def conditions(summary: Mapping[str, Any]) -> str:
    """Say in a line what was rendered, how, for how long, and which flags were up."""
    return (
        f"{summary['scene']} on {summary['device']}, method {summary['method']}, seed {summary['seed']}: "
        f"{short(summary['duration'], 's')}, judged from {short(summary['judged_from'], 's')}, "
        f"flagged samples: {flags(summary)}"
    )


def describe(scene: Scene) -> str:
    """Describe a scene in a few words: its texture, its finger, its length and its device."""
    texture, motion = scene.texture, scene.finger.motion
    sizes = [
        short(size, unit)
        for key, unit in (("amplitude", "m"), ("wavelength", "m"), ("frequency", "Hz"))
        if (size := getattr(texture, key, None)) is not None
    ]
    count = _partials(texture)
    what = f"{_kind(texture)} {' '.join(sizes)}{f', {count} partials' if count > 1 else ''}"
    speed = getattr(motion, "speed", None)
    finger = [f"{_kind(motion)} finger", *([] if speed is None else [short(speed, "m/s")])]
    return f"{what}; {' '.join(finger)}; {short(scene.duration, 's')} on {scene.device}"


def _partials(texture: Any) -> int:
    """How many partials a texture has by its own parameters; 1 where it does not say."""
    if partials := getattr(texture, "partials", None):
        return len(partials)
    return getattr(texture, "harmonics", 1) if getattr(texture, "shape", "sine") != "sine" else 1


def _kind(thing: Any) -> str:
    """Call a texture or a motion by its kind, or by its class where it is of the user's own."""
    kind = str(getattr(thing, "kind", type(thing).__name__))
    return "no" if kind == "none" else kind


def flags(summary: Mapping[str, Any]) -> str:
    """Say how many samples each status flag was up."""
    return ", ".join(f"{name.lower()} {count}" for name, count in summary["flags"].items() if count) or "none"


def degrees(angle: float | None) -> str:
    """Write an angle (rad) in degrees; a dash for none."""
    return "–" if angle is None or not math.isfinite(angle) else f"{round(math.degrees(angle), 1) + 0.0:.1f}°"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Lay out `rows` in columns, the first and the last to the left and figures to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    last = len(widths) - 1
    lines = (
        "  ".join(cell if i == last else f"{cell:{'>' if i else '<'}{widths[i]}}" for i, cell in enumerate(row))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def _prefix(value: float) -> tuple[float, str]:
    """Choose the SI prefix with which `value` has one to three digits before the point; none above 1."""
    return next((entry for entry in _PREFIXES if abs(value) >= 0.9995 * entry[0]), _PREFIXES[-1])


def _digits(value: float) -> str:
    """Three significant digits, never in exponent form below a million."""
    if abs(value) >= 99.95:
        return f"{value:.0f}" if abs(value) < 1e6 else f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 1e-3 else f"{value:.{2 - math.floor(math.log10(abs(value) * 1.0005))}f}"
