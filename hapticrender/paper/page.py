"""The page about the paper's figures: each picture beside its numbers and its verdict, in plain HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from hapticrender import __version__
from hapticrender.charts.page import STYLE
from hapticrender.paper.claims import Claim, Item, Missing, Verdict

_CLASSES: dict[Verdict, str] = {"reproduced": "good", "corrected": "fixed", "not reproducible": "bad"}
_SIGNS = {"=": "", "<=": "≤ ", ">=": "≥ "}
_ADDED = """.fixed { color: #8a6414; }
td.what { white-space: normal; min-width: 11rem; max-width: 22rem; line-height: 1.35; }
h2 + p { margin-bottom: 0.4rem; }
"""


def page(items: Sequence[Item], missing: Sequence[Missing], pictures: bool) -> str:
    """HTML of the page: a table of all verdicts, then a section for each item.

    Parameters
    ----------
    items : sequence of Item
    missing : sequence of Missing
        What cannot be computed.
    pictures : bool
        Whether a PNG of every item's name lies beside the page.
    """
    sections = "\n".join(_section(item, pictures) for item in items)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>hapticrender: the paper's figures, computed again</title>
<style>{STYLE}{_ADDED}</style>
</head>
<body>
<h1>The paper’s figures, computed again</h1>
{_introduction(items)}
{_overview(items, missing)}
{sections}
<footer class="note">Made by hapticrender {escape(__version__)}.</footer>
</body>
</html>
"""


def _introduction(items: Sequence[Item]) -> str:
    """What is compared, and what the three verdicts mean."""
    claims = [claim.verdict for item in items for claim in item.claims]
    counted = ", ".join(f"{claims.count(verdict)} {verdict}" for verdict in _CLASSES)
    return f"""<p>Grigorii, Li, Peshkin and Colgate, “Comparison of wide-band vibrotactile and friction modulation
surface gratings” (2021): every table and figure that needs no participant, from the equations and from a simulated
plate and finger. Of {len(claims)} numbers: {counted}.</p>
<p><span class="good">Reproduced</span>: ours is as printed, to half of the last printed digit unless it says otherwise.
<span class="fixed">Corrected</span>: it is not, and a second route, the check, agrees with ours.
<span class="bad">Not reproducible</span>: neither, or it takes what no computation has.</p>"""


def _overview(items: Sequence[Item], missing: Sequence[Missing]) -> str:
    """Table of all items, and of what is missing."""
    rows = "\n".join(
        f'<tr><td class="text what"><a href="#{item.name}">{escape(item.title)}</a></td>'
        f'<td class="text what">{escape(item.where)}</td>{_verdict(item.verdict)}'
        f'<td class="text wide">{escape(item.reason)}</td></tr>'
        for item in items
    )
    lost = "\n".join(
        f'<tr><td class="text what">{escape(each.title)}</td><td class="text what">{escape(each.where)}</td>'
        f'{_verdict(each.verdict)}<td class="text wide">{escape(each.reason)}</td></tr>'
        for each in missing
    )
    return f"""<div class="scroll"><table>
<thead><tr><th class="text">What</th><th class="text">In the paper</th><th class="text">Verdict</th>
<th class="text">Why</th></tr></thead>
<tbody>
{rows}
{lost}
</tbody>
</table></div>"""


def _verdict(verdict: Verdict) -> str:
    return f'<td class="text {_CLASSES[verdict]}">{verdict}</td>'


def _section(item: Item, pictures: bool) -> str:
    """One item: picture, numbers, verdict, files."""
    picture = (
        f'<a href="{item.name}.png"><img src="{item.name}.png" alt="{escape(item.title)}"></a>'
        if pictures
        else '<p class="note">No picture: matplotlib is not installed.</p>'
    )
    rows = "\n".join(_row(claim) for claim in item.claims)
    links = " · ".join(f'<a href="{item.file(table)}">{item.file(table)}</a>' for table in item.tables)
    return f"""<section id="{item.name}">
<h2>{escape(item.title)}</h2>
<p>{escape(item.where)}. <span class="{_CLASSES[item.verdict]}">{item.verdict.capitalize()}</span>.</p>
{picture}
<div class="scroll"><table>
<thead><tr><th class="text">Quantity</th><th>Paper</th><th>Here</th><th>Agree within</th><th>Check</th>
<th class="text">Verdict</th><th class="text">Remark</th></tr></thead>
<tbody>
{rows}
</tbody>
</table></div>
<p class="note">{escape(item.note)}</p>
<p class="note">Numbers: {links}</p>
</section>"""


def _row(claim: Claim) -> str:
    """One claim in the table of its item."""
    unit = escape(f" {claim.unit}" if claim.unit else "")
    check = "–" if claim.check is None else f"{number(claim.check, claim.within)}{unit}"
    within = "–" if claim.relation != "=" and claim.check is None else f"{number(claim.within)}{unit}"
    return f"""<tr><td class="text what">{escape(claim.what)}</td>
<td>{_SIGNS[claim.relation]}{number(claim.paper)}{unit}</td><td>{number(claim.ours, claim.within)}{unit}</td>
<td>{within}</td><td>{check}</td>{_verdict(claim.verdict)}<td class="text wide">{escape(claim.why)}</td></tr>"""


def number(value: float, within: float = 0.0) -> str:
    """Write a number with four digits, or as 0 where it is rounding beside `within`.

    Examples
    --------
    >>> number(147.26687), number(2.3e-14, 0.05), number(0.000233)
    ('147.3', '0', '0.000233')
    """
    if abs(value) < 1e-3 * within:
        return "0"
    return f"{value:.4g}"
