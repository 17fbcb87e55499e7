"""Write one page about many rendered scenes: plain HTML that opens from a file, without script, server or network."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hapticrender import __version__
from hapticrender.formatting import as_json, bands_label, short
from hapticrender.report.outputs import GENERATOR, JOURNAL, text_of
from hapticrender.report.text import band_rows, conditions, overview, remarks, verdict, waveform_rows

_MANY_BANDS = 10  # beyond so many their table is folded
NO_PICTURE = '<p class="note">No picture: matplotlib is not installed.</p>'
CLASSES = {"passed": "good", "passed in band": "good", "failed": "bad", "not judged": "note"}

STYLE = "\n" + (Path(__file__).parent / "page.css").read_text(encoding="utf-8")


def write_page(folder: Path, scenes: Mapping[Path, Mapping[str, Any]]) -> Path:
    """Write ``index.html`` and ``summary.json`` into `folder`: introduction, table of all scenes, a section a scene.

    `scenes` has, by their folders below it, what `outputs.write_outputs` returned of each.
    """
    summaries = list(scenes.values())
    report = {"hapticrender": __version__, "scenes": summaries}
    (folder / "summary.json").write_text(as_json(report), encoding="utf-8")
    counts = {kind: sum(summary["verdict"] == kind for summary in summaries) for kind in CLASSES}
    methods = " and ".join(sorted({f"“{summary['method']}”" for summary in summaries}))
    number = f"{len(scenes)} scene{'' if len(scenes) == 1 else 's'}"
    apart = f", {counts['not judged']} cannot be judged" if counts["not judged"] else ""
    links = [f'<a href="#{quote(each["scene"])}">{escape(each["scene"])}</a>' for each in summaries]
    places = (quote(place.relative_to(folder).as_posix()) for place in scenes)
    sections = "\n".join(_section(*each) for each in zip(scenes, summaries, places, strict=True))
    html = html_page(
        f"hapticrender: {number}",
        f"""<h1>Textures, rendered in closed loop</h1>
<p>hapticrender renders a texture for a bare finger: it vibrates a glass plate, or changes the friction of a screen,
measures the motion, and corrects the drive until the motion follows its target. Here {number} ran with the method
{escape(methods)}. A scene misses its tolerance where the motion differs from the texture by more than that at any of
its places, or by more than twice that in any third octave or in the worst of the windows of 100 ms:
{counts["passed"] + counts["passed in band"]} of {len(scenes)} are within their tolerance,
{counts["failed"]} miss it{apart}.</p>
{_overview(summaries)}
<nav>{"".join(links)}</nav>
{sections}""",
    )
    (folder / "index.html").write_text(html, encoding="utf-8")
    return folder / "index.html"


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


def html_row(tag: str, cells: Sequence[str], verdict: str = "") -> str:
    """Row of a table from its cells, HTML; the first is a text, and so is the last, of class `verdict` where given."""
    classes = [' class="text"', *[""] * (len(cells) - 1)]
    if verdict:
        classes[-1] = f' class="text {verdict}"'
    return f"<tr>{''.join(f'<{tag}{kind}>{cell}</{tag}>' for kind, cell in zip(classes, cells, strict=True))}</tr>"


def _table(rows: Sequence[Sequence[str]]) -> str:
    """HTML of a table of texts whose first row is its head; nothing where there is no other."""
    head, *body = ([_whole(cell) for cell in row] for row in rows)
    return html_table(html_row("th", head), [html_row("td", row) for row in body]) if body else ""


def _overview(summaries: Sequence[Mapping[str, Any]]) -> str:
    head, *rows = overview(summaries)
    body = [
        html_row("td", [f'<a href="#{quote(name)}">{escape(name)}</a>', *map(_whole, cells)], f"wide {CLASSES[kind]}")
        for (name, *cells), kind in zip(rows, (summary["verdict"] for summary in summaries), strict=True)
    ]
    return f"""{html_table(html_row("th", head, "wide"), body)}
<p class="note">Amplitudes are peak values, achieved ones at the centre; a scene of several bands shows the root of the
sum of their squares. The error is that of the whole waveform from 20 to 500 Hz, at the worst place.</p>"""


def _whole(text: str) -> str:
    """Escape text for HTML, with values and their units kept together."""
    return escape(text).replace(" %", "&nbsp;%").replace(" Hz", "&nbsp;Hz")


def _section(place: Path, summary: Mapping[str, Any], folder: str) -> str:
    """Everything about one scene, whose files are in `place`; `folder` is its address relative to the page."""
    name, sentence = escape(summary["scene"]), _whole(verdict(summary))
    picture = NO_PICTURE
    if (place / "picture.png").exists():
        alt = f"Target, achieved motion, drive and finger over time: {name}"
        picture = f'<a href="{folder}/picture.png"><img src="{folder}/picture.png" alt="{alt}"></a>'
    files = ["scene.toml", "summary.json", JOURNAL, *summary["sound"]]
    links = " · ".join(f'<a href="{folder}/{file}">{file}</a>' for file in files)
    bands = _table(band_rows(summary))
    if len(summary["bands"]) > _MANY_BANDS:
        bands = f"<details><summary>{escape(bands_label(summary['bands']))}</summary>{bands}</details>"
    notes = "".join(f'<p class="note">{_whole(line)}</p>' for line in (conditions(summary), *remarks(summary)))
    sounds = "".join(  # a player for each WAV, with its full scale
        f'<p class="note">{name.removesuffix(".wav").capitalize()}, '
        f"full scale {short(sound['full_scale'], sound['unit'])}"
        f'<audio controls preload="none" src="{folder}/{name}"></audio></p>'
        for name, sound in summary["sound"].items()
    )
    return f"""<section id="{name}">
<h2>{name}</h2>
<p class="{CLASSES[summary["verdict"]]}">{sentence[:1].upper()}{sentence[1:]}.</p>
{picture}
{_table(waveform_rows(summary))}
{bands}
<div class="halves">
<div>{notes}{sounds}
<p class="note">{links}</p></div>
<pre>{escape(text_of(place / "scene.toml").strip())}</pre>
</div>
</section>"""
