"""Write one page about many rendered scenes: plain HTML that opens from a file, without script, server or network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hapticrender import __version__
from hapticrender.formatting import as_json, band_label, bands_label, degrees, percent, quantity, short
from hapticrender.recordings.recording import Recording
from hapticrender.report.devices_picture import plot_devices
from hapticrender.report.outputs import JOURNAL, Outputs
from hapticrender.report.text import amplitudes, beside, brief, flags, places_of, verdict, waveform_error, waveform_rows
from hapticrender.skin import skin_bands
from hapticrender.touch.scene import distinct_names

_MANY_BANDS = 10
DEVICES = "devices.png"
NO_PICTURE = '<p class="note">No picture: matplotlib is not installed.</p>'
GENERATOR = '<meta name="generator" content="hapticrender">'
CLASSES = {"passed": "good", "passed in band": "good", "failed": "bad", "not judged": "note"}

STYLE = """
:root { color-scheme: light dark; --soft: #6d7c87; --line: #8884; --good: #2b8f97; --bad: #c8553b; }
@media (prefers-color-scheme: dark) { section img { filter: invert(1) hue-rotate(180deg); } }
body { margin: 0 auto; max-width: 70rem; padding: 3rem 1.5rem 5rem; font: 16px/1.55 system-ui, sans-serif; }
h1, h2 { font-family: Georgia, serif; line-height: 1.2; }
a { color: var(--good); }
nav { columns: 14rem; }
nav a { display: block; }
.scroll { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 0.4rem 0.7rem; white-space: nowrap; }
th { color: var(--soft); vertical-align: bottom; }
td { border-top: 1px solid var(--line); }
th.text, td.text { text-align: left; }
td.wide { white-space: normal; min-width: 9rem; }
th.group { text-align: center; border-bottom: 1px solid var(--line); }
.good { color: var(--good); }
.bad { color: var(--bad); }
.note, dt { color: var(--soft); }
section { border-top: 2px solid; margin-top: 3.5rem; }
section img, audio { display: block; width: 100%; height: auto; }
audio { height: 2.2rem; }
.halves { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); gap: 0.5rem 3rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.35rem 1.2rem; font-size: 0.9rem; }
dd { margin: 0; }
pre { padding: 1rem; background: var(--line); overflow: auto; max-height: 34rem; font-size: 0.8rem; }
@media print { audio, nav { display: none; } .scroll { overflow: visible; } section { break-before: page; } }
"""


def refuse_foreign_page(folder: Path) -> None:
    """Refuse a folder whose ``index.html`` this package has not written."""
    path = folder / "index.html"
    if path.exists() and GENERATOR not in path.read_text(encoding="utf-8", errors="replace"):
        raise ValueError(f"{str(path)!r}: is there and from no earlier run: choose another folder, or add --force")


def write_page(folder: Path, scenes: Sequence[Outputs]) -> Path:
    """Write ``index.html`` and ``summary.json`` into `folder`, with links to the scenes' folders below it."""
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
    """HTML of the page: introduction, table of all scenes, contents, the `devices` section, and a section a scene."""
    counts = {kind: sum(scene.summary["verdict"] == kind for scene in scenes) for kind in CLASSES}
    methods = " and ".join(sorted({f"“{scene.summary['method']}”" for scene in scenes}))
    number = f"{len(scenes)} scene{'' if len(scenes) == 1 else 's'}"
    apart = f", {counts['not judged']} cannot be judged" if counts["not judged"] else ""
    links = ['<a href="#devices">One texture on several devices</a>'] if devices else []
    links += [f'<a href="#{quote(scene.name)}">{escape(scene.name)}</a>' for scene in scenes]
    sections = "\n".join(_section(scene, quote(scene.folder.relative_to(folder).as_posix())) for scene in scenes)
    return html_page(
        f"hapticrender: {number} in closed loop",
        f"""<h1>Textures, rendered in closed loop</h1>
<p>hapticrender renders a texture for a bare finger: it vibrates a glass plate, or changes the friction of a screen,
measures the motion, and corrects the drive until the motion follows its target. Here {number} ran in closed loop on
models of the devices with the method {escape(methods)}. A scene misses its tolerance where the motion differs from the
texture by more than that at any of its places, or by more than twice that in any third octave or in the worst of the
windows of 100 ms: {counts["passed"] + counts["passed in band"]} of {len(scenes)} are within their tolerance,
{counts["failed"]} miss it{apart}.</p>
{_overview(scenes)}
<nav>{"".join(links)}</nav>
{devices}
{sections}""",
    )


def html_page(title: str, body: str) -> str:
    """HTML of a page from the HTML of its title and of its body."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
{GENERATOR}
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body>
{body}
<footer class="note">Made by hapticrender {escape(__version__)}.</footer>
</body>
</html>
"""


def html_table(head: str, rows: Sequence[str]) -> str:
    """HTML of a table from the rows of its head and of its body."""
    body = "\n".join(rows)
    return f'<div class="scroll"><table>\n<thead>\n{head}\n</thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def _overview(scenes: Sequence[Outputs]) -> str:
    """Table of all scenes, a row each."""
    rows = []
    for scene, (target, achieved) in zip(scenes, amplitudes([scene.summary for scene in scenes]), strict=True):
        summary = scene.summary
        rows.append(
            f'<tr><td class="text"><a href="#{quote(scene.name)}">{escape(scene.name)}</a></td>'
            f'<td class="text wide {CLASSES[summary["verdict"]]}">{_whole(brief(summary))}</td>'
            f"<td>{target}</td><td>{achieved}</td>{_error_cell(waveform_error(summary), summary['tolerance'])}</tr>"
        )
    heads = "".join(f"<th>{title}</th>" for title in ("Target", "Achieved", "Error"))
    return f"""{html_table(f'<tr><th class="text">Scene</th><th class="text">Verdict</th>{heads}</tr>', rows)}
<p class="note">Amplitudes are peak values, achieved ones at the centre; a scene of several bands shows the root of the
sum of their squares. The error is that of the whole waveform from 20 to 500 Hz, at the worst place.</p>"""


def _alike(scenes: Sequence[Outputs]) -> dict[str, Recording]:
    """Recordings of the texture that most devices share, by the device's name; empty where no two share one."""
    groups: dict[str, dict[str, Recording]] = {}
    for scene in scenes:
        if scene.summary["bands"] and (scene.folder / JOURNAL).exists():
            recording = Recording.load(scene.folder / JOURNAL)
            key = f"{recording.scene.texture!r}; {recording.scene.finger!r}"
            groups.setdefault(key, {}).setdefault(scene.summary["device"], recording)
    best = max(groups.values(), key=len, default={})
    return best if len(best) > 1 else {}


def devices_section(folder: Path, scenes: Sequence[Outputs]) -> str:
    """HTML about one texture on several devices, its picture drawn into `folder`; empty where no two share one."""
    recordings = _alike(scenes)
    if not recordings:
        return ""
    try:
        plot_devices(recordings, folder / DEVICES)
        picture = f'<a href="{DEVICES}"><img src="{DEVICES}" alt="Skin velocity of one texture on every device"></a>'
    except ImportError:
        picture = NO_PICTURE
    rows = []
    for each in zip(*(skin_bands(recording) for recording in recordings.values()), strict=True):
        cells = "".join(f"<td>{1e3 * band.achieved:.3f}</td><td>{100 * band.error:+.2f} %</td>" for band in each)
        name, target = short(each[0].frequency, "Hz"), f"{1e3 * each[0].target:.3f}"
        rows.append(f'<tr><td class="text">{name}</td><td>{target}</td><td>{each[0].level:.0f} dB</td>{cells}</tr>')
    heads = "".join(f"<th>{escape(device)}</th><th>error</th>" for device in recordings)
    head = f'<tr><th class="text">Band (mm/s peak)</th><th>Target</th><th>Above threshold</th>{heads}</tr>'
    return f"""<section id="devices">
<h2>One texture, {len(recordings)} devices</h2>
<p>A plate moves the skin, friction pulls at it. The velocity of the skin is predicted from each recording; it should be
the same on all devices.</p>
{picture}
{html_table(head, rows)}
</section>"""


def _whole(text: str) -> str:
    """Escape text for HTML, with values and their units kept together."""
    return escape(text).replace(" %", "&nbsp;%").replace(" Hz", "&nbsp;Hz")


def _error_cell(error: float | None, tolerance: float) -> str:
    """Format a relative error, marked where it is beyond the tolerance."""
    mark = ' class="bad"' if error is not None and abs(error) > tolerance else ""
    return f"<td{mark}>{percent(error)}</td>"


def _section(scene: Outputs, folder: str) -> str:
    """Everything about one scene; `folder` is its address relative to the page."""
    summary, name, sentence = scene.summary, escape(scene.name), _whole(verdict(scene.summary))
    picture = NO_PICTURE
    if (scene.folder / "picture.png").exists():
        alt = f"Target, achieved motion, drive and finger over time: {name}"
        picture = f'<a href="{folder}/picture.png"><img src="{folder}/picture.png" alt="{alt}"></a>'
    files = ["scene.toml", "summary.json", "recording.au", *summary["sound"]]
    links = " · ".join(f'<a href="{folder}/{file}">{file}</a>' for file in files)
    return f"""<section id="{name}">
<h2>{name}</h2>
<p class="{CLASSES[summary["verdict"]]}">{sentence[:1].upper()}{sentence[1:]}.</p>
{picture}
{_waveform(summary)}
{_bands(summary) if summary["bands"] else ""}
<div class="halves">
<div>{_figures(summary)}{_sounds(summary, folder)}
<p class="note">{links}</p></div>
<pre>{escape(scene.toml.strip())}</pre>
</div>
</section>"""


def _waveform(summary: Mapping[str, Any]) -> str:
    """Table of the figures that decide, a row a place."""
    rows = ["".join(f"<td>{_whole(cell)}</td>" for cell in row) for row in waveform_rows(summary)]
    titles = ("Error", "whole waveform", "worst windows of 100 ms", "worst third octave")
    head = "".join(f"<th>{title}</th>" for title in titles)
    return html_table(f"<tr>{head}</tr>", [f"<tr>{row}</tr>" for row in rows]) if rows else ""


def _bands(summary: Mapping[str, Any]) -> str:
    """Table of a scene's bands, amplitudes with one prefix; folded where there are many."""
    bands, tolerance, places = summary["bands"], summary["tolerance"], places_of(summary)
    largest = max((band["target"] for band in bands if band["target"] is not None), default=1.0)
    rows = []
    for band in bands:
        cells = [f"<td>{quantity(band[key], summary['unit'], like=largest)}</td>" for key in ("target", "achieved")]
        cells += [f"<td>{percent(band[f'error_{place}'])}</td>" for place in places]
        cells += [_error_cell(band[f"rms_error_{place}"], tolerance) for place in places]
        cells += [f"<td>{degrees(band['phase_error'])}</td>", f"<td>{quantity(band['settling_time'], 's')}</td>"]
        rows.append(f'<tr><td class="text">{band_label(band)}</td>{"".join(cells)}</tr>')
    heads = "".join(f"<th>{place.replace('_', ' ')}</th>" for place in places)
    head = f"""<tr><th class="text" rowspan="2">Band</th><th rowspan="2">Target</th><th rowspan="2">Achieved</th>
<th class="group" colspan="{len(places)}">error of the mean</th>
<th class="group" colspan="{len(places)}">rms error</th>
<th rowspan="2">Phase error</th><th rowspan="2">Settles in</th></tr>
<tr>{heads}{heads}</tr>"""
    table = html_table(head, rows)
    if len(bands) <= _MANY_BANDS:
        return table
    return f"<details><summary>{escape(bands_label(bands))}</summary>{table}</details>"


def _figures(summary: Mapping[str, Any]) -> str:
    """List of the figures of the whole scene."""
    entries = [
        ("Duration", short(summary["duration"], "s")),
        ("Judged from", short(summary["judged_from"], "s")),
        ("Sampling rate", short(summary["rate"], "Hz")),
        ("Method", f"{summary['method']}, seed {summary['seed']}"),
        ("Waveform", beside(summary)),
        ("Wobble of the bands", quantity(summary["wobble"], summary["unit"])),
        ("Beside the bands", f"{quantity(summary['residual_rms'], summary['unit'])} rms"),
        ("Drive at its limit", f"{percent(summary['saturated_share'])} of the time"),
        ("Flagged samples", flags(summary)),
        *(("Note", note) for note in summary["notes"]),
    ]
    return f"<dl>{''.join(f'<dt>{key}</dt><dd>{escape(value)}</dd>' for key, value in entries)}</dl>"


def _sounds(summary: Mapping[str, Any], folder: str) -> str:
    """Make a player for each WAV, with its full scale."""
    return "".join(
        f'<p class="note">{name.removesuffix(".wav").capitalize()}, '
        f"full scale {short(sound['full_scale'], sound['unit'])}"
        f'<audio controls preload="none" src="{folder}/{name}"></audio></p>'
        for name, sound in summary["sound"].items()
    )
