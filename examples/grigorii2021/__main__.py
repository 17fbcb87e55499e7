"""Recompute the paper's tables and figures, as far as they need no participant: numbers, pictures, a verdict for each.

Run: python -m examples.grigorii2021 [--out out/paper] [--only NAME ...]

References
----------
Grigorii, Li, Peshkin and Colgate: Comparison of wide-band vibrotactile and friction modulation surface gratings, 2021.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from html import escape
from pathlib import Path

from examples.grigorii2021 import finger, formulas, runs, subjects
from examples.grigorii2021.claims import VERDICTS, Claim, Item
from hapticrender import __version__

ITEMS: dict[str, Callable[[], Item]] = {
    each.__name__: each
    for each in (
        formulas.controller, formulas.transform, runs.commanded, runs.frequencies, runs.press, formulas.plate,
        finger.loaded, runs.extraction, finger.impedance, finger.admittance, formulas.electroadhesion,
        formulas.stimuli, formulas.statistics, subjects.touch, subjects.loads, subjects.measured,
    )
}  # fmt: skip
SUBJECTS = "13 participants, on the plate and on the electroadhesion surface"
MISSING = (  # where, title, what it needs
    ("Fig. 1", "Photographs of the two devices", "the hardware"),
    ("Fig. 6 A, B", "v/F_a and beta = F_r/F_a at equal intensity", SUBJECTS),
    ("Fig. 7", "Coefficients of variation of velocity and force", SUBJECTS),
    ("Fig. 8 A, B", "Matches of every subject", SUBJECTS),
    ("Fig. 10 A, grey", "Normal velocity per shear force at equal intensity", SUBJECTS),
    ("Fig. 11 A, B", "Similarity, and time of contact", SUBJECTS),
)
STYLE = """body { font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; } td, th { padding: 0.3rem 0.7rem; text-align: left; vertical-align: top;
border-bottom: 1px solid #8884; } img { max-width: 100%; background: white; } .scroll { overflow-x: auto; }
.reproduced { color: #00805c; } .corrected { color: #a06d00; } .not { color: #c04a00; }
@media (prefers-color-scheme: dark) { body { background: #161616; color: #ddd; } a { color: #7db8e8; } }"""
SIGNS = {"=": "", "<=": "≤ ", ">=": "≥ "}


def reproduce(folder: Path, names: Sequence[str] = tuple(ITEMS)) -> list[Item]:
    """Compute items and write their numbers (CSV, JSON), pictures (PNG) and a page into a folder.

    Raises
    ------
    ValueError
        For a name that is none of `ITEMS`.
    """
    for name in names:
        if name not in ITEMS:
            raise ValueError(f"{name!r}: must be one of {', '.join(ITEMS)}")
    folder.mkdir(parents=True, exist_ok=True)
    items = []
    for name in names:
        item = ITEMS[name]()
        _write_curves(folder / f"{name}.csv", item)
        (item.picture or partial(_draw, item=item))(folder / f"{name}.png")
        print(f"{name:<16} {item.verdict:<17} {item.reason}", flush=True)
        items.append(item)
    for where, _, needs in MISSING:
        print(f"{where:<16} {VERDICTS[-1]:<17} needs {needs}")
    report = {
        "hapticrender": __version__,
        "items": [
            {"name": item.name, "where": item.where, "verdict": item.verdict,
             "claims": [asdict(claim) | {"verdict": claim.verdict} for claim in item.claims]}
            for item in items
        ],
        "missing": [dict(zip(("where", "title", "needs"), each, strict=True)) for each in MISSING],
    }  # fmt: skip
    (folder / "paper.json").write_text(json.dumps(report, indent=2, default=float) + "\n", encoding="utf-8")
    (folder / "index.html").write_text(_page(items), encoding="utf-8")
    return items


def _write_curves(path: Path, item: Item) -> None:
    """Write every point of every curve, one row each."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["panel", "curve", "x", "y"])
        for panel in item.panels:
            for curve in panel.curves:
                for x, y in zip(curve.x, curve.y, strict=True):  # type: ignore[arg-type]
                    writer.writerow([panel.title, curve.name, f"{x:.9g}", f"{y:.9g}"])


def _draw(path: Path, item: Item) -> None:
    """Draw the panels of an item, up to three in a row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(3, len(item.panels))
    rows = -(-len(item.panels) // columns)
    figure = Figure(figsize=(4.2 * columns + 1.2, 3.9 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, panel in zip(figure.subplots(rows, columns, squeeze=False).flat, item.panels, strict=True):
        paired = any(curve.style == ":" for curve in panel.curves)  # dotted: another order of the same quantity
        keys = [curve.name.split()[0] if paired else curve.name for curve in panel.curves if curve.style != "printed"]
        colours = {key: f"C{at}" for at, key in enumerate(dict.fromkeys(keys))}
        for curve in panel.curves:
            style = {"color": "black", "ls": "--", "lw": 1.1}
            if curve.style != "printed":
                dots = {"marker": "o", "ls": "-", "lw": 0.7, "ms": 4} if curve.style == "o" else {"ls": curve.style}
                style = {"lw": 1.4, "color": colours[curve.name.split()[0] if paired else curve.name], **dots}
            first = curve.name not in axes.get_legend_handles_labels()[1]
            axes.plot(curve.x, curve.y, label=curve.name if first else None, **style)
        axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
        if panel.ylim is not None:
            axes.set_ylim(panel.ylim)
        for letter, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
            if letter in panel.log:
                axes.set(**{f"{letter}scale": "log"})
                axis.set_major_formatter(lambda value, _: f"{value:g}")
                low, high = axis.get_view_interval()
                if high < 300 * low:
                    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
                else:
                    axis.set_minor_formatter(lambda value, _: "")
        if panel.x == formulas.FREQUENCY and "x" in panel.log and min(panel.curves[0].x) >= 20:  # type: ignore[type-var]
            axes.set_xticks(formulas.FREQUENCIES, [f"{each:g}" for each in formulas.FREQUENCIES])
            axes.set_xticks([], minor=True)
        axes.grid(color="#e4e4e4", lw=0.6)
        axes.legend(fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")
    figure.savefig(path, dpi=110)


def _page(items: Sequence[Item]) -> str:
    """HTML page: a table of all verdicts, then a section for each item."""
    verdicts = [claim.verdict for item in items for claim in item.claims]
    counted = ", ".join(f"{verdicts.count(each)} {each}" for each in VERDICTS)
    rows = [
        _row("td", f'<a href="#{item.name}">{escape(item.title)}</a>', escape(item.where), _verdict(item.verdict),
             escape(item.reason))
        for item in items
    ] + [_row("td", escape(title), where, _verdict(VERDICTS[-1]), escape(f"needs {needs}"))
         for where, title, needs in MISSING]  # fmt: skip
    head = _row("th", "What", "In the paper", "Verdict", "Why")
    sections = "\n".join(_section(item) for item in items)
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>The paper's figures, recomputed</title><style>{STYLE}</style></head><body>
<h1>The paper’s figures, recomputed</h1>
<p>Grigorii, Li, Peshkin and Colgate, “Comparison of wide-band vibrotactile and friction modulation surface gratings”
(2021): every table and figure that needs no participant, from the equations and from a simulated plate and finger; and
those that simulated subjects can stand in for.
Of {len(verdicts)} numbers computed here: {counted}; {len(MISSING)} figures need participants or hardware.</p>
<p>Reproduced: as printed, to half of the last printed digit unless stated otherwise. Corrected: not as printed, and a
second calculation, the check, agrees with ours. Not reproducible: neither, or it needs data that no computation has.
</p>
<div class="scroll"><table>{head}{"".join(rows)}</table></div>
{sections}
<p>Made by hapticrender {escape(__version__)}.</p></body></html>
"""


def _section(item: Item) -> str:
    """One item: picture, numbers, verdict, file."""
    head = _row("th", "Quantity", "Paper", "Here", "Within", "Check", "Verdict", "Why")
    rows = "".join(_claim(claim) for claim in item.claims)
    return f"""<section id="{item.name}"><h2>{escape(item.title)}</h2>
<p>{escape(item.where)}. {_verdict(item.verdict)}.</p>
<img src="{item.name}.png" alt="{escape(item.title)}">
<div class="scroll"><table>{head}{rows}</table></div>
<p>{escape(item.note)}</p><p>Numbers: <a href="{item.name}.csv">{item.name}.csv</a></p></section>"""


def _claim(claim: Claim) -> str:
    """One claim as a row."""
    unit = escape(f" {claim.unit}".rstrip())
    check = "–" if claim.check is None else f"{_number(claim.check, claim.within)}{unit}"
    within = "–" if claim.relation != "=" and claim.check is None else f"{claim.within:.4g}{unit}"
    return _row("td", escape(claim.what), f"{SIGNS[claim.relation]}{claim.paper:.4g}{unit}",
                f"{_number(claim.ours, claim.within)}{unit}", within, check, _verdict(claim.verdict),
                escape(claim.why))  # fmt: skip


def _number(value: float, within: float) -> str:
    """Four digits, or 0 where the value is rounding beside `within`."""
    return "0" if abs(value) < 1e-3 * within else f"{value:.4g}"


def _verdict(verdict: str) -> str:
    return f'<span class="{verdict.split()[0]}">{verdict}</span>'


def _row(kind: str, *cells: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{each}</{kind}>" for each in cells) + "</tr>\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder to write into")
    parser.add_argument("--only", nargs="*", default=list(ITEMS), metavar="NAME", help="items to compute")
    chosen = parser.parse_args(arguments)
    try:
        reproduce(chosen.out, chosen.only)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"page: {chosen.out / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
