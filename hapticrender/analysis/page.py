"""Write the page about a measured finger: its pictures, the fitted parameters, the exponents, what is missing."""

from collections.abc import Mapping, Sequence
from html import escape
from math import isfinite

import numpy as np

from hapticrender.analysis.load_law import load_exponent, mean_exponent
from hapticrender.analysis.models import FingerFit
from hapticrender.analysis.records import LOADED, FingerRecord
from hapticrender.report.page import NO_PICTURE, html_page, html_row, html_table

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
{_picture("load.png", pictures, "Impedance over load, share explained by the load, exponent over frequency", ONE_LOAD)}
{_laws(records)}</section>
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
    rows += [
        ("loads", *(f"{fit.loads[0]:.2f} to {fit.loads[1]:.2f} N" for _, fit in flat)),
        ("χ² / degrees of freedom", *(f"{fit.chi_square:.0f} / {fit.degrees_of_freedom}" for _, fit in flat)),
        ("probability p of a larger χ²", *p_values),
        ("supported by the data", *(_supported(fits[name], fit) for name, fit in flat)),
    ]  # fmt: skip
    body = [html_row("td", cells) for cells in rows]
    heads = (f"{name}, {NAMES[fit.order]}<br>at {fit.mechanics.reference_load:.2f} N" for name, fit in flat)
    return f"""{html_table(html_row("th", ["Finger", *heads]), body)}
<p class="note">With half of the 95&nbsp;% interval. The supported order has the smaller Bayesian information
criterion; a difference of 10 is strong.
With p below 0.01 the model, with one exponent for all loads, does not explain the data within their stated errors:
intervals are enlarged by the scatter, and the parameters describe the data without being the finger’s.</p>"""


def _supported(of_class: Mapping[int, FingerFit], fit: FingerFit) -> str:
    if len(of_class) == 1:
        return "too few frequencies to compare"
    return f"yes, by {fit.bic_margin:.3g}" if isfinite(fit.bic_margin) else "no"


def _value(fit: FingerFit, name: str) -> str:
    """A parameter and half of its 95 % interval, in g, N s/m, N/mm or 1; a dash where the model has none."""
    if name not in fit.names:
        return "–"
    scale = 1e3 if name.endswith("mass") else 1e-3 if name.endswith("stiffness") else 1.0
    half = SURE * fit.standard_errors[name] * scale
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 4)) if half > 0 else 3
    return f"{fit.values[name] * scale:.{digits}f} ± {half:.{digits}f}"


def _laws(records: Sequence[FingerRecord]) -> str:
    """Table of exponents, of all recordings together, and the mean of each where there are several."""
    law, several = load_exponent(records), len(records) > 1
    columns = law.frequency, law.exponent, law.standard_error, law.magnitude, law.reference_load, law.count
    rows = [
        [f"{frequency:.0f} Hz", _exponent(n, error), f"{size:.2f} N s/m at {load:.2f} N", f"{count}"]
        for frequency, n, error, size, load, count in zip(*columns, strict=True)
    ]
    head, note = ["Frequency", "exponent n", "|Z<sub>f</sub>|", "windows"], ""
    if several and rows:
        head.insert(1, "n within a recording")
        note = " Within a recording: the mean, weighted by errors; beside it, differences between fingers count too."
        means = mean_exponent([load_exponent(each) for each in records], law.frequency)
        for row, n, error in zip(rows, *means[:2], strict=True):
            row.insert(1, _exponent(n, error))
    return f"""{html_table(html_row("th", head), [html_row("td", row) for row in rows])}
<p class="note">|Z<sub>f</sub>| ~ W<sup>n</sup>; contact of an elastic sphere suggests n = 1/3.{note}</p>"""


def _exponent(n: float, error: float) -> str:
    return f"{n:.3f} ± {SURE * error:.3f}" if np.isfinite(n) else "–"


def _record(record: FingerRecord, name: str, pictures: list[str]) -> str:
    """Section of one recording."""
    touched = sum(each.stop - each.start for each in record.of_kind(LOADED))
    plate = "measured in its unloaded spans" if record.plate.measured else "as in the profile"
    count, length = len(record.of_kind(LOADED)), record.time[-1] - record.time[0]
    bandwidths = f"{record.normal_load.bandwidth:.3g} and {record.position.bandwidth:.3g} Hz"
    entries = [
        ("Loaded", f"{touched:.2f} of {length:.2f} s, {count} touch{'es' * (count != 1)}"),
        ("Position good to 1 mm", f"from {record.least_load:.2f} N on" if isfinite(record.least_load) else "nowhere"),
        ("Bandwidth of load and position", bandwidths),
        ("The plate's own stiffness and damping", plate),
        *(("Note", note) for note in record.notes),
    ]
    return f"""<section><h2>{escape(record.name)}</h2>
{_picture(name, pictures, f"Load, impedance, position and velocity over time: {record.name}")}
<dl>{"".join(f"<dt>{key}</dt><dd>{escape(value)}</dd>" for key, value in entries)}</dl></section>"""
