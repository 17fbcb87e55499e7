"""Write what the analysis of recordings found: tables as CSV, the rest as JSON, a summary as text, and a page."""

from collections.abc import Sequence
from html import escape
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.analysis.models import UNITS, FingerFit, weighted_mean
from hapticrender.analysis.records import KINDS, LOADED, FingerRecord, Series
from hapticrender.formatting import as_json, table
from hapticrender.protocols import Array
from hapticrender.report.page import NO_PICTURE, html_page, html_row, html_table

FILES = ("finger.csv", "impedance.csv", "finger.json")
ROWS = 100.0  # a second, in finger.csv
SERIES = {"normal_load": "N", "position": "m", "velocity": "m/s"}
Fits = dict[str, dict[int, FingerFit]]  # by load class and order
LABELS = {
    "mass": "mass at the surface (g)",
    "damping": "its damping (N s/m)",
    "stiffness": "its stiffness (N/mm)",
    "phalanx_mass": "mass of the phalanx (g)",
    "phalanx_damping": "its damping (N s/m)",
    "phalanx_stiffness": "its stiffness (N/mm)",
    "load_exponent": "exponent n of the load",
}
ONE_LOAD = "no windows under loads that differ by 1&nbsp;% or more; record several loads, or one that grows"
SURE = 1.96  # standard errors: 95 %
NAMES = {2: "2nd order", 4: "4th order"}


def write(record: FingerRecord, folder: Path) -> list[Path]:
    """Write `FILES` into a folder, which is made where it is not there, and return their paths.

    ``finger.csv`` has 100 rows a second of load, position, velocity, their standard errors and contact (0 unloaded, 1
    doubtful, 2 loaded); ``impedance.csv`` a row a window and band; ``finger.json`` segments, plate, bandwidths, notes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in FILES]
    step = max(round(1 / (ROWS * (record.time[1] - record.time[0]))), 1) if len(record.time) > 1 else 1
    columns, names = [record.time], ["time (s)"]
    for name, unit in SERIES.items():
        each = getattr(record, name)
        columns += [each.value, each.standard_error]
        names += [f"{name} ({unit})", f"its standard error ({unit})"]
    _write_csv(paths[0], [*names, "contact"], np.column_stack([*columns, record.contact])[::step])
    z = record.impedance
    bands = z.frequency.shape[1]
    of_window = [np.repeat(each, bands) for each in (z.time, z.normal_load, z.position)]
    of_band = [each.ravel() for each in (z.frequency, z.value.real, z.value.imag, z.standard_error)]
    names = ["time (s)", "normal load (N)", "position (m)", "frequency (Hz)", "real part (N s/m)"]
    names += ["imaginary part (N s/m)", "standard error of each (N s/m)"]
    _write_csv(paths[1], names, np.column_stack([*of_window, *of_band]))
    figures = {
        "name": record.name,
        "bandwidth": {name: getattr(record, name).bandwidth for name in SERIES},
        "least_load": record.least_load,
        "segments": [{"kind": KINDS[each.kind], "start": each.start, "stop": each.stop} for each in record.segments],
        "plate": vars(record.plate),
        "notes": record.notes,
    }
    paths[2].write_text(as_json(figures), encoding="utf-8")
    return paths


def _write_csv(path: Path, names: list[str], rows: np.ndarray[Any, Any]) -> None:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="", encoding="utf-8")


def text(record: FingerRecord) -> str:
    """Summary for the terminal: a line a touch, a band and a parameter, each number with its standard error."""
    blocks = [_touches(record), _bands(record), _plate(record), "\n".join(f"note: {note}" for note in record.notes)]
    least = f"position is good to 1 mm from {record.least_load:.3f} N on"
    return "\n\n".join([each for each in blocks if each] + [least])


def _touches(record: FingerRecord) -> str:
    """Mean load and range of the position of each touch, with the standard error of one sample."""
    rows = [["touch", "from (s)", "to (s)", "load (N)", "se", "position (mm)", "se"]]
    for number, each in enumerate(record.of_kind(LOADED), 1):
        at = slice(*record.at(np.array([each.start, each.stop])))
        load, load_error = _finite(record.normal_load, at)
        place, place_error = (1e3 * part for part in _finite(record.position, at))
        cells = [f"{load.mean():.3f}", f"{np.median(load_error):.3f}"] if load.size else ["undefined", ""]
        span = f"{place.min():.1f} to {place.max():.1f}" if place.size else "undefined"
        cells += [span, f"{np.median(place_error):.2f}" if place.size else ""]
        rows.append([f"{number}", f"{each.start:.3f}", f"{each.stop:.3f}", *cells])
    return table(rows) + "\n(se: standard error of one sample, median of the touch)" if len(rows) > 1 else ""


def _finite(series: Series, at: slice) -> tuple[Array, Array]:
    """Values of a span, and their standard errors, where they are defined."""
    value, error = series.value[at], series.standard_error[at]
    good = np.isfinite(value) & np.isfinite(error)
    return value[good], error[good]


def _bands(record: FingerRecord) -> str:
    """Mean impedance of each band over the windows, with its own standard error."""
    z = record.impedance
    rows = [["band (Hz)", "|Z| (N s/m)", "se", "phase (deg)", "se", "windows"]]
    for k in range(z.frequency.shape[1]):
        good = np.isfinite(z.value[:, k])
        if good.any():
            mean, error = weighted_mean(z.value[good, k], z.standard_error[good, k])
            size = [f"{abs(mean):.3g}", f"{error:.2g}"]
            phase = [f"{np.degrees(np.angle(mean)):.1f}", f"{np.degrees(error / abs(mean)):.1f}"]
            rows.append([f"{np.median(z.frequency[good, k]):.1f}", *size, *phase, f"{good.sum()}"])
    note = "(se: standard error of the mean over the windows, whose errors are taken as independent)"
    return f"{table(rows)}\n{note}" if len(rows) > 1 else ""


def _plate(record: FingerRecord) -> str:
    plate = record.plate
    rows = [["plate" if plate.measured else "plate (profile)", "at the start", "at the end", "standard errors"]]
    for name, values in plate.values.items():
        errors = plate.standard_errors[name]
        rows.append([name, f"{values[0]:.5g}", f"{values[-1]:.5g}", f"{errors[0]:.2g}, {errors[-1]:.2g}"])
    return table(rows)


def page_of(records: Sequence[FingerRecord], fits: Fits, pictures: list[str]) -> str:
    """HTML of the page about `records`, with the `pictures` (names of files) that were drawn."""
    title = escape(records[0].name) if len(records) == 1 else f"{len(records)} recordings"
    times = "\n".join(_record(record, f"time-{i + 1}.png", pictures) for i, record in enumerate(records))
    body = f"""<h1>The finger, measured: {title}</h1>
<p>Load, position and mechanical impedance Z<sub>f</sub> = F<sub>f</sub>/v of the finger, computed from the sensors of
the surface and from its drive. Intervals are of 95&nbsp;%. Contact is judged by the force alone: a touch is a span
above the threshold (loaded); grey spans are below it (unloaded), orange ones near it or beside lost samples
(doubtful).</p>
<section><h2>Impedance over frequency</h2>
{_picture("frequency.png", pictures, "Modulus and phase of the impedance over frequency, with fits", "too few bands")}
{_fits(fits)}</section>
<section><h2>Impedance over the load</h2>
{_picture("load.png", pictures, "Impedance over load", ONE_LOAD)}</section>
{times}"""
    return html_page(f"The finger, measured: {title}", body)


def _picture(name: str, pictures: list[str], alt: str, missing: str = "") -> str:
    """Picture, or why it is `missing`."""
    if name in pictures:
        return f'<a href="{name}"><img src="{name}" alt="{escape(alt)}"></a>'
    return NO_PICTURE if not pictures else f'<p class="note">No picture: {missing}.</p>'


def _fits(fits: Fits) -> str:
    """Table of all fits, one a column, the supported order marked."""
    if not fits:
        return '<p class="note">No fit: a finger takes at least two frequencies.</p>'
    flat = [(name, fit) for name, of_class in fits.items() for _, fit in sorted(of_class.items())]
    rows = [(escape(label), *(_value(fit, name) for _, fit in flat)) for name, label in LABELS.items()]
    p_values = ["&lt;0.001" if fit.p_value < 1e-3 else f"{fit.p_value:.3f}" for _, fit in flat]
    supported = []
    for name, fit in flat:
        found = f"yes, by {fit.bic_margin:.3g}" if isfinite(fit.bic_margin) else "no"
        supported.append(found if len(fits[name]) > 1 else "too few frequencies to compare")
    rows += [
        ("loads", *(f"{fit.loads[0]:.2f} to {fit.loads[1]:.2f} N" for _, fit in flat)),
        ("χ² / degrees of freedom", *(f"{fit.chi_square:.0f} / {fit.degrees_of_freedom}" for _, fit in flat)),
        ("probability p of a larger χ²", *p_values),
        ("supported by the data", *supported),
    ]  # fmt: skip
    body = [html_row("td", cells) for cells in rows]
    heads = (f"{name}, {NAMES[fit.order]}<br>at {fit.mechanics.reference_load:.2f} N" for name, fit in flat)
    return f"""{html_table(html_row("th", ["Finger", *heads]), body)}
<p class="note">With half of the 95&nbsp;% interval. The supported order has the smaller Bayesian information
criterion; a difference of 10 is strong.
With p below 0.01 the model, with one exponent for all loads, does not explain the data within their stated errors:
intervals are enlarged by the scatter, and the parameters describe the data without being the finger’s.</p>"""


def _value(fit: FingerFit, name: str) -> str:
    """A parameter and half of its 95 % interval, in g, N s/m, N/mm or 1; a dash where the model has none."""
    if name not in fit.names:
        return "–"
    value, half = fit.values[name] / UNITS[name], SURE * fit.standard_errors[name] / UNITS[name]
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 4)) if half > 0 else 3
    return f"{value:.{digits}f} ± {half:.{digits}f}"


def _record(record: FingerRecord, name: str, pictures: list[str]) -> str:
    """Picture and summary of a recording."""
    picture = _picture(name, pictures, f"Load, impedance, position and velocity over time: {record.name}")
    return f"<section><h2>{escape(record.name)}</h2>\n{picture}\n<pre>{escape(text(record))}</pre></section>"
