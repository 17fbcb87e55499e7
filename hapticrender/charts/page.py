"""One page about many rendered scenes: plain HTML that opens from a file, without script, server or network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hapticrender import __version__, wording
from hapticrender.charts.page_devices import devices_section
from hapticrender.outputs import Outputs

_MANY_BANDS = 10
_AXIS = (1e-3, 10.0)  # relative errors at the ends of the little charts, logarithmic
_CHART = (150, 22)  # px

STYLE = """
:root { --ink: #22303c; --soft: #6b7883; --line: #dfe4e8; --wash: #f6f8f9; --good: #2b6f77; --bad: #b3432b; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 70rem; padding: 3rem 1.5rem 5rem; color: var(--ink); background: #fff;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", "Noto Sans", sans-serif; }
h1, h2 { font-family: Charter, "Iowan Old Style", Georgia, "Noto Serif", serif; font-weight: 600; line-height: 1.2; }
h1 { font-size: 2.4rem; margin: 0 0 1rem; }
h2 { font-size: 1.6rem; margin: 0; }
p { max-width: 46rem; }
a { color: var(--good); text-underline-offset: 0.15em; }
.scroll { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th { text-align: right; font-weight: 600; color: var(--soft); padding: 0.3rem 0.7rem; vertical-align: bottom; }
td { text-align: right; padding: 0.45rem 0.7rem; border-top: 1px solid var(--line); white-space: nowrap; }
th.text, td.text { text-align: left; }
td.wide { white-space: normal; min-width: 17rem; line-height: 1.35; }
th.group { text-align: center; border-bottom: 1px solid var(--line); }
tbody tr:hover { background: var(--wash); }
.good { color: var(--good); }
.bad { color: var(--bad); }
.note { color: var(--soft); font-size: 0.9rem; }
svg { display: block; }
section { border-top: 2px solid var(--ink); margin-top: 3.5rem; padding-top: 1.2rem; }
section > p { margin: 0.3rem 0 1.2rem; max-width: none; }
section img { display: block; width: 100%; height: auto; }
.halves { display: grid; grid-template-columns: repeat(auto-fit, minmax(22rem, 1fr)); gap: 0.5rem 3rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.35rem 1.2rem; margin: 1rem 0; font-size: 0.9rem; }
dt { color: var(--soft); }
dd { margin: 0; }
audio { width: 100%; height: 2.2rem; display: block; margin-top: 0.25rem; }
pre { margin: 1rem 0; padding: 1rem 1.2rem; background: var(--wash); border-radius: 4px; overflow: auto;
  max-height: 34rem; align-self: start; font: 0.8rem/1.5 ui-monospace, "DejaVu Sans Mono", monospace; }
summary { cursor: pointer; color: var(--good); font-size: 0.9rem; }
footer { margin-top: 4rem; }
"""


def write_page(folder: Path, scenes: Sequence[Outputs]) -> Path:
    """Write ``index.html`` into `folder`, with relative links to the scenes' folders below it.

    Returns
    -------
    Path
        The page.
    """
    path = folder / "index.html"
    path.write_text(page(folder, scenes, devices_section(folder, scenes)), encoding="utf-8")
    return path


def page(folder: Path, scenes: Sequence[Outputs], devices: str = "") -> str:
    """HTML of the page: an introduction, what `devices` share, a table of all scenes, and a section for each."""
    sections = "\n".join(_section(scene, quote(scene.folder.relative_to(folder).as_posix())) for scene in scenes)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>hapticrender: {_scenes(len(scenes))} in closed loop</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Textures, rendered in closed loop</h1>
{_introduction(scenes)}
{devices}
{_overview(scenes)}
{sections}
<footer class="note">Made by hapticrender {escape(__version__)}.</footer>
</body>
</html>
"""


def _introduction(scenes: Sequence[Outputs]) -> str:
    """Three sentences for someone who has never heard of all this."""
    missed = sum(not scene.summary["passed"] for scene in scenes)
    methods = " and ".join(sorted({f"“{scene.summary['method']}”" for scene in scenes}))
    count = f"{missed or 'none'} of {len(scenes)} here {'does' if missed == 1 else 'do'}."
    return f"""<p>hapticrender makes a finger feel a texture on a surface: it shakes a glass plate, or changes the
friction of a screen, listens to what happens, and corrects the drive until it is what was wanted. Below,
{_scenes(len(scenes))} ran in closed loop on models of the devices with the method {escape(methods)}; each shows what
was wanted, what the device did (a plate at its centre and at both ends), and the drive that it took. A scene misses its
tolerance where the worst rms error of any band, at any of its places, is larger; {count}</p>"""


def _scenes(count: int) -> str:
    return f"{count} scene" if count == 1 else f"{count} scenes"


def _overview(scenes: Sequence[Outputs]) -> str:
    """Table of all scenes, a row each, with a little chart of the errors."""
    rows = "\n".join(_row(scene) for scene in scenes)
    heads = "".join(f"<th>{title}</th>" for title in wording.titles([scene.summary for scene in scenes]))
    return f"""<div class="scroll"><table>
<thead>
<tr><th class="text" rowspan="2">Scene</th><th rowspan="2">Target</th><th rowspan="2">Achieved</th>
<th class="group" colspan="3">rms error</th><th class="text" rowspan="2">{_axis()}</th>
<th class="text" rowspan="2">Verdict</th></tr>
<tr>{heads}</tr>
</thead>
<tbody>
{rows}
</tbody>
</table></div>
<p class="note">Amplitudes are peak values, achieved ones at the centre. A scene of several bands shows the root of the
sum of their squares, and the largest error of any. In the charts the disc is the centre, the rings are the ends, and
the line is the tolerance.</p>"""


def _row(scene: Outputs) -> str:
    """One scene in the table of all."""
    summary = scene.summary
    bands = summary["bands"]
    errors = [wording.worst_at(bands, place) for place in wording.columns_of(summary)]
    cells = "".join(_error_cell(error, summary["tolerance"]) for error in errors)
    return f"""<tr><td class="text"><a href="#{quote(scene.name)}">{escape(scene.name)}</a></td>
<td>{wording.quantity(wording.total(bands, "target"), summary["unit"])}</td>
<td>{wording.quantity(wording.total(bands, "achieved"), summary["unit"])}</td>{cells}
<td class="text">{_chart(errors, summary["tolerance"])}</td>{_verdict_cell(summary)}</tr>"""


def _verdict_cell(summary: Mapping[str, Any]) -> str:
    """Short where all is well, the whole sentence where it is not."""
    if summary["passed"]:
        return f'<td class="text wide good">within {100 * summary["tolerance"]:.4g} %</td>'
    return f'<td class="text wide bad">{_sentence(summary)}</td>'


def _sentence(summary: Mapping[str, Any]) -> str:
    """Put the verdict into HTML, with values and their units kept together."""
    return escape(wording.verdict(summary)).replace(" %", "&nbsp;%").replace(" Hz", "&nbsp;Hz")


def _error_cell(error: float | None, tolerance: float) -> str:
    """Show a relative error, marked where it is beyond the tolerance."""
    mark = ' class="bad"' if error is not None and abs(error) > tolerance else ""
    return f"<td{mark}>{wording.percent(error)}</td>"


def _along(error: float) -> float:
    """Where a relative error stands on a chart's logarithmic axis (px)."""
    low, high = (math.log10(end) for end in _AXIS)
    share = (math.log10(max(abs(error), _AXIS[0])) - low) / (high - low)
    return 8 + (_CHART[0] - 16) * min(share, 1.0)


def _chart(errors: Sequence[float | None], tolerance: float) -> str:
    """Errors at the centre (disc) and the ends (rings) beside the tolerance (line)."""
    width, height = _CHART
    middle = height / 2
    known = [(i, error) for i, error in enumerate(errors) if error is not None]
    marks = "".join(
        f'<circle cx="{_along(error):.1f}" cy="{middle}" r="{4 if i == 0 else 5.5}" {_paint(i, error, tolerance)}/>'
        for i, error in known
    )
    line = _along(tolerance)
    return f"""<svg width="{width}" height="{height}" role="img" aria-label="errors against the tolerance">
<path d="M8 {middle}H{width - 8}" stroke="#dfe4e8"/><path d="M{line:.1f} 2V{height - 2}" stroke="#6b7883"/>
{marks}</svg>"""


def _paint(index: int, error: float, tolerance: float) -> str:
    """Choose a disc for the centre and rings for the ends; rust beyond the tolerance."""
    colour = "#b3432b" if error > tolerance else "#2b6f77"
    return f'fill="{colour}"' if index == 0 else f'fill="none" stroke="{colour}" stroke-width="1.5"'


def _axis() -> str:
    """Labels of the charts' axis, for the head of their column."""
    width, _ = _CHART
    labels = "".join(
        f'<text x="{_along(error):.1f}" y="12" text-anchor="middle">{100 * error:g}</text>'
        for error in (1e-3, 1e-2, 1e-1, 1.0)
    )
    return f'<svg width="{width}" height="16" font-size="10" fill="#6b7883">{labels}<text x="{width}" y="12" \
text-anchor="end">%</text></svg>'


def _section(scene: Outputs, folder: str) -> str:
    """Everything about one scene; `folder` is its address relative to the page."""
    summary = scene.summary
    name = escape(scene.name)
    picture = (
        f'<a href="{folder}/picture.png"><img src="{folder}/picture.png" '
        f'alt="Target, achieved motion, drive and finger over time: {name}"></a>'
        if scene.picture
        else '<p class="note">No picture: matplotlib is not installed.</p>'
    )
    return f"""<section id="{name}">
<h2>{name}</h2>
<p class="{"good" if summary["passed"] else "bad"}">{_capital(_sentence(summary))}.</p>
{picture}
{_bands(summary)}
<div class="halves">
<div>{_figures(summary)}{_sounds(summary, folder)}
<p class="note">{_links(scene, folder)}</p></div>
<pre>{escape(scene.toml.strip())}</pre>
</div>
</section>"""


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _bands(summary: Mapping[str, Any]) -> str:
    """Table of a scene's bands; folded where there are many."""
    bands = summary["bands"]
    places = [place for place in wording.columns_of(summary) if f"error_{place}" in (bands or [{}])[0]]
    rows = "\n".join(_band_row(band, places, summary) for band in bands)
    heads = "".join(f"<th>{place.replace('_', ' ')}</th>" for place in places)
    table = f"""<div class="scroll"><table>
<thead>
<tr><th class="text" rowspan="2">Band</th><th rowspan="2">Target</th><th rowspan="2">Achieved</th>
<th class="group" colspan="{len(places)}">error of the mean</th>
<th class="group" colspan="{len(places)}">rms error</th>
<th rowspan="2">Phase error</th><th rowspan="2">Settles in</th></tr>
<tr>{heads}{heads}</tr>
</thead>
<tbody>
{rows}
</tbody>
</table></div>"""
    if len(bands) <= _MANY_BANDS:
        return table
    return f"<details><summary>{escape(wording.bands_label(bands))}</summary>{table}</details>"


def _band_row(band: Mapping[str, Any], places: Sequence[str], summary: Mapping[str, Any]) -> str:
    """One band of a scene."""
    unit, tolerance = summary["unit"], summary["tolerance"]
    means = "".join(f"<td>{wording.percent(band.get(f'error_{place}'))}</td>" for place in places)
    spreads = "".join(_error_cell(band.get(f"rms_error_{place}"), tolerance) for place in places)
    return f"""<tr><td class="text">{wording.band_label(band)}</td><td>{wording.quantity(band["target"], unit)}</td>
<td>{wording.quantity(band["achieved"], unit)}</td>{means}{spreads}
<td>{wording.degrees(band["phase_error"])}</td>
<td>{wording.quantity(band["settling_time"], "s")}</td></tr>"""


def _figures(summary: Mapping[str, Any]) -> str:
    """List what concerns the whole scene."""
    entries = {
        "Duration": wording.short(summary["duration"], "s"),
        "Judged from": wording.short(summary["judged_from"], "s"),
        "Sampling rate": wording.short(summary["rate"], "Hz"),
        "Method": f"{summary['method']}, seed {summary['seed']}",
        "Wobble of the bands": wording.quantity(summary["wobble"], summary["unit"]),
        "Beside the bands": f"{wording.quantity(summary['residual_rms'], summary['unit'])} rms",
        "Drive at its limit": f"{wording.percent(summary['saturated_share'])} of the time",
        "Flagged samples": wording.flags(summary),
    }
    rows = "".join(f"<dt>{key}</dt><dd>{escape(value)}</dd>" for key, value in entries.items())
    notes = "".join(f"<dt>Note</dt><dd>{escape(note)}</dd>" for note in summary["notes"])
    return f"<dl>{rows}{notes}</dl>"


def _sounds(summary: Mapping[str, Any], folder: str) -> str:
    """Make a player for each WAV, with what its full scale stands for."""
    return "".join(
        f'<p class="note">{name.removesuffix(".wav").capitalize()}, '
        f"full scale {wording.short(sound['full_scale'], sound['unit'])}"
        f'<audio controls preload="none" src="{folder}/{name}"></audio></p>'
        for name, sound in summary["sound"].items()
    )


def _links(scene: Outputs, folder: str) -> str:
    """Links to the scene's files."""
    names = ["scene.toml", "summary.json", "recording.au", *scene.summary["sound"]]
    return " · ".join(f'<a href="{folder}/{name}">{name}</a>' for name in names)
