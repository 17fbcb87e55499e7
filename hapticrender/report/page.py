"""Write one page about many rendered scenes: plain HTML that opens from a file, without script, server or network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hapticrender import __version__
from hapticrender.formatting import as_json, band_label, bands_label, degrees, percent, quantity, short
from hapticrender.report.devices_page import devices_section
from hapticrender.report.outputs import Outputs
from hapticrender.report.text import amplitudes, brief, columns_of, flags, titles, verdict, worst_at
from hapticrender.touch.scene import distinct_names

_MANY_BANDS = 10
_AXIS = (1e-3, 10.0)  # relative errors at the ends of the little charts, logarithmic
_CHART = (150, 22)  # px
GENERATOR = '<meta name="generator" content="hapticrender">'
CLASSES = {"passed": "good", "failed": "bad", "not judged": "note"}

STYLE = """
:root { color-scheme: light dark; --ink: #22303c; --soft: #5f6d78; --line: #dfe4e8; --wash: #f6f8f9; --paper: #fff;
  --good: #2b6f77; --bad: #b3432b; }
@media (prefers-color-scheme: dark) { :root { --ink: #dde4ea; --soft: #98a5b0; --line: #37424c; --wash: #1e262d;
  --paper: #14191e; --good: #6fc3cc; --bad: #f08a6e; } section img { filter: invert(1) hue-rotate(180deg); } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 70rem; padding: 3rem 1.5rem 5rem; color: var(--ink); background: var(--paper);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", "Noto Sans", sans-serif; }
h1, h2 { font-family: Charter, "Iowan Old Style", Georgia, "Noto Serif", serif; font-weight: 600; line-height: 1.2; }
h1 { font-size: 2.4rem; margin: 0 0 1rem; }
h2 { font-size: 1.6rem; margin: 0; }
p { max-width: 46rem; }
a { color: var(--good); text-underline-offset: 0.15em; }
nav { columns: 14rem; margin: 1.5rem 0; font-size: 0.9rem; }
nav a { display: block; }
.scroll { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); }
th { text-align: right; font-weight: 600; color: var(--soft); padding: 0.3rem 0.7rem; vertical-align: bottom; }
td { text-align: right; padding: 0.45rem 0.7rem; border-top: 1px solid var(--line); white-space: nowrap; }
th.text, td.text { text-align: left; }
td.wide { white-space: normal; min-width: 9rem; line-height: 1.35; }
th.group { text-align: center; border-bottom: 1px solid var(--line); }
tbody tr:hover { background: var(--wash); }
.good { color: var(--good); }
.bad { color: var(--bad); }
.note { color: var(--soft); font-size: 0.9rem; }
svg { display: block; fill: var(--soft); stroke: none; }
svg .axis { stroke: var(--line); } svg .bound { stroke: var(--soft); }
svg .disc.good { fill: var(--good); } svg .disc.bad { fill: var(--bad); }
svg .ring { fill: none; stroke-width: 1.5; }
svg .ring.good { stroke: var(--good); } svg .ring.bad { stroke: var(--bad); }
section { border-top: 2px solid var(--ink); margin-top: 3.5rem; padding-top: 1.2rem; }
section > p { margin: 0.3rem 0 1.2rem; max-width: none; }
section img { display: block; width: 100%; height: auto; }
.halves { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); gap: 0.5rem 3rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.35rem 1.2rem; margin: 1rem 0; font-size: 0.9rem; }
dt { color: var(--soft); }
dd { margin: 0; }
audio { width: 100%; height: 2.2rem; display: block; margin-top: 0.25rem; }
pre { margin: 1rem 0; padding: 1rem 1.2rem; background: var(--wash); border-radius: 4px; overflow: auto;
  max-height: 34rem; align-self: start; font: 0.8rem/1.5 ui-monospace, "DejaVu Sans Mono", monospace; }
summary { cursor: pointer; color: var(--good); font-size: 0.9rem; }
footer { margin-top: 4rem; }
@media (max-width: 45rem) { body { padding: 1.5rem 0.8rem; } .overview .more { display: none; }
  th, td { padding: 0.35rem 0.4rem; } }
@media print { body { max-width: none; padding: 0; font-size: 10pt; background: #fff; }
  audio, nav, .chart { display: none; } td.wide { min-width: 0; }
  .scroll { overflow: visible; } table { font-size: 7.5pt; } th, td { padding: 0.15rem 0.3rem; }
  tr, img { break-inside: avoid; } h2, h2 + p { break-after: avoid; } section { break-before: page; }
  pre { max-height: none; white-space: pre-wrap; } }
"""


def refuse_foreign_page(folder: Path) -> None:
    """Refuse a folder whose ``index.html`` this package has not written."""
    path = folder / "index.html"
    if path.exists() and GENERATOR not in path.read_text(encoding="utf-8", errors="replace"):
        raise ValueError(f"{str(path)!r}: is there and from no earlier run: choose another folder, or add --force")


def write_page(folder: Path, scenes: Sequence[Outputs]) -> Path:
    """Write ``index.html`` and ``summary.json`` into `folder`, with relative links to the scenes' folders below it.

    Returns
    -------
    Path
        The page.
    """
    labels = distinct_names(scene.name for scene in scenes)
    scenes = [
        replace(scene, name=label, summary={**scene.summary, "scene": label})
        for scene, label in zip(scenes, labels, strict=True)
    ]
    report = {"hapticrender": __version__, "scenes": [scene.summary for scene in scenes]}
    (folder / "summary.json").write_text(as_json(report), encoding="utf-8")
    path = folder / "index.html"
    path.write_text(page(folder, scenes, devices_section(folder, scenes)), encoding="utf-8")
    return path


def page(folder: Path, scenes: Sequence[Outputs], devices: str = "") -> str:
    """HTML of the page: introduction, contents, table of all scenes, the `devices` section, and a section a scene."""
    sections = "\n".join(_section(scene, quote(scene.folder.relative_to(folder).as_posix())) for scene in scenes)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
{GENERATOR}
<title>hapticrender: {_scenes(len(scenes))} in closed loop</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Textures, rendered in closed loop</h1>
{_introduction(scenes)}
{_overview(scenes)}
{_contents(scenes, bool(devices))}
{devices}
{sections}
<footer class="note">Made by hapticrender {escape(__version__)}.</footer>
</body>
</html>
"""


def _introduction(scenes: Sequence[Outputs]) -> str:
    """Three sentences for a reader who is new to the subject."""
    counts = {kind: sum(scene.summary["verdict"] == kind for scene in scenes) for kind in CLASSES}
    methods = " and ".join(sorted({f"“{scene.summary['method']}”" for scene in scenes}))
    apart = f", {counts['not judged']} cannot be judged" if counts["not judged"] else ""
    return f"""<p>hapticrender makes a finger feel a texture on a surface: it vibrates a glass plate, or changes the
friction of a screen, measures the motion, and corrects the drive until the motion follows its target. Here
{_scenes(len(scenes))} ran in closed loop on models of the devices with the method {escape(methods)}; each shows the
target, the motion or friction achieved (on a plate at its centre and at both ends), and the drive. A scene misses its
tolerance where the worst rms error of any band, at any of its places, is larger: {counts["passed"]} of {len(scenes)}
are within their tolerance, {counts["failed"]} miss it{apart}.</p>"""


def _contents(scenes: Sequence[Outputs], devices: bool) -> str:
    """List of links to the sections."""
    links = ['<a href="#devices">One texture on several devices</a>'] if devices else []
    links += [f'<a href="#{quote(scene.name)}">{escape(scene.name)}</a>' for scene in scenes]
    return f"<nav>{''.join(links)}</nav>"


def _scenes(count: int) -> str:
    return f"{count} scene" if count == 1 else f"{count} scenes"


def _overview(scenes: Sequence[Outputs]) -> str:
    """Table of all scenes, a row each, with a little chart of the errors."""
    pairs = amplitudes([scene.summary for scene in scenes])
    rows = "\n".join(_row(scene, pair) for scene, pair in zip(scenes, pairs, strict=True))
    heads = "".join(f'<th class="more">{title}</th>' for title in titles([scene.summary for scene in scenes]))
    return f"""<div class="scroll"><table class="overview">
<thead>
<tr><th class="text" rowspan="2">Scene</th><th class="text" rowspan="2">Verdict</th>
<th rowspan="2">Target</th><th rowspan="2">Achieved</th>
<th class="group more" colspan="3">rms error</th><th class="text more chart" rowspan="2">{_axis()}</th></tr>
<tr>{heads}</tr>
</thead>
<tbody>
{rows}
</tbody>
</table></div>
<p class="note">Amplitudes are peak values, achieved ones at the centre. A scene of several bands shows the root of the
sum of their squares, and the largest error of any. In the charts the disc is the centre, the rings are the ends, and
the line is the tolerance.</p>"""


def _row(scene: Outputs, pair: tuple[str, str]) -> str:
    """One scene in the table of all, with its target and achieved amplitude."""
    summary = scene.summary
    errors = [worst_at(summary["bands"], place) for place in columns_of(summary)]
    cells = "".join(_error_cell(error, summary["tolerance"], " more") for error in errors)
    return f"""<tr><td class="text"><a href="#{quote(scene.name)}">{escape(scene.name)}</a></td>
<td class="text wide {CLASSES[summary["verdict"]]}">{_whole(brief(summary))}</td>
<td>{pair[0]}</td><td>{pair[1]}</td>{cells}
<td class="text more chart">{_chart(errors, summary["tolerance"])}</td></tr>"""


def _whole(text: str) -> str:
    """Escape text for HTML, with values and their units kept together."""
    return escape(text).replace(" %", "&nbsp;%").replace(" Hz", "&nbsp;Hz")


def _error_cell(error: float | None, tolerance: float, kind: str = "") -> str:
    """Format a relative error, marked where it is beyond the tolerance."""
    mark = "bad" if error is not None and abs(error) > tolerance else ""
    return f'<td class="{mark}{kind}">{percent(error)}</td>'


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
        f'<circle cx="{_along(error):.1f}" cy="{middle}" r="{5.5 if i else 4}" '
        f'class="{"ring" if i else "disc"} {"bad" if error > tolerance else "good"}"/>'
        for i, error in known
    )
    line = _along(tolerance)
    return f"""<svg width="{width}" height="{height}" role="img" aria-label="errors against the tolerance">
<path class="axis" d="M8 {middle}H{width - 8}"/><path class="bound" d="M{line:.1f} 2V{height - 2}"/>
{marks}</svg>"""


def _axis() -> str:
    """Labels of the charts' axis, for the head of their column."""
    width, _ = _CHART
    labels = "".join(
        f'<text x="{_along(error):.1f}" y="12" text-anchor="middle">{100 * error:g}</text>'
        for error in (1e-3, 1e-2, 1e-1, 1.0)
    )
    return f'<svg width="{width}" height="16" font-size="10">{labels}<text x="{width}" y="12" \
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
<p class="{CLASSES[summary["verdict"]]}">{_capital(_whole(verdict(summary)))}.</p>
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
    places = [place for place in columns_of(summary) if f"error_{place}" in (bands or [{}])[0]]
    largest = max((band["target"] for band in bands if band["target"] is not None), default=1.0)
    rows = "\n".join(_band_row(band, places, summary, largest) for band in bands)
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
    return f"<details><summary>{escape(bands_label(bands))}</summary>{table}</details>"


def _band_row(band: Mapping[str, Any], places: Sequence[str], summary: Mapping[str, Any], largest: float) -> str:
    """One band of a scene; amplitudes with the prefix that fits the `largest` target (SI)."""
    means = "".join(f"<td>{percent(band.get(f'error_{place}'))}</td>" for place in places)
    spreads = "".join(_error_cell(band.get(f"rms_error_{place}"), summary["tolerance"]) for place in places)
    sizes = "".join(f"<td>{quantity(band[key], summary['unit'], like=largest)}</td>" for key in ("target", "achieved"))
    settled = "–" if band["settling_time"] is None else f"{band['settling_time']:.3f} s"
    return f"""<tr><td class="text">{band_label(band)}</td>{sizes}{means}{spreads}
<td>{degrees(band["phase_error"])}</td><td>{settled}</td></tr>"""


def _figures(summary: Mapping[str, Any]) -> str:
    """List what concerns the whole scene."""
    entries = {
        "Duration": short(summary["duration"], "s"),
        "Judged from": short(summary["judged_from"], "s"),
        "Sampling rate": short(summary["rate"], "Hz"),
        "Method": f"{summary['method']}, seed {summary['seed']}",
        "Wobble of the bands": quantity(summary["wobble"], summary["unit"]),
        "Beside the bands": f"{quantity(summary['residual_rms'], summary['unit'])} rms",
        "Drive at its limit": f"{percent(summary['saturated_share'])} of the time",
        "Flagged samples": flags(summary),
    }
    rows = "".join(f"<dt>{key}</dt><dd>{escape(value)}</dd>" for key, value in entries.items())
    notes = "".join(f"<dt>Note</dt><dd>{escape(note)}</dd>" for note in summary["notes"])
    return f"<dl>{rows}{notes}</dl>"


def _sounds(summary: Mapping[str, Any], folder: str) -> str:
    """Make a player for each WAV, with its full scale."""
    return "".join(
        f'<p class="note">{name.removesuffix(".wav").capitalize()}, '
        f"full scale {short(sound['full_scale'], sound['unit'])}"
        f'<audio controls preload="none" src="{folder}/{name}"></audio></p>'
        for name, sound in summary["sound"].items()
    )


def _links(scene: Outputs, folder: str) -> str:
    """Links to the scene's files."""
    names = ["scene.toml", "summary.json", "recording.au", *scene.summary["sound"]]
    return " · ".join(f'<a href="{folder}/{name}">{name}</a>' for name in names)
