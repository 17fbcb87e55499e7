"""The paper's own tables and figures, as far as they need no participant: numbers, pictures, and a verdict for each.

References
----------
Grigorii, Li, Peshkin and Colgate: Comparison of wide-band vibrotactile and friction modulation surface gratings, 2021.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from hapticrender import __version__
from hapticrender.paper import finger, formulas, runs
from hapticrender.paper.claims import Claim, Item, Missing, Table
from hapticrender.paper.page import page
from hapticrender.recordings.formats import MissingExtra, replacing
from hapticrender.validate import as_json

ITEMS: dict[str, Callable[[], Item]] = {
    each.__name__: each
    for each in (
        formulas.controller,
        formulas.transform,
        runs.commanded,
        runs.frequencies,
        runs.press,
        formulas.plate,
        finger.loaded,
        runs.extraction,
        finger.impedance,
        finger.admittance,
        formulas.electroadhesion,
        formulas.stimuli,
        formulas.statistics,
    )
}
_SUBJECTS = "13 participants, on the plate and on the electroadhesion surface"
MISSING = (
    Missing(where="Fig. 1", title="Photographs of the two devices", needs="the hardware"),
    Missing(where="Fig. 5", title="Impedance and load of a participant's finger", needs="1 participant on the plate"),
    Missing(where="Fig. 6 A, B", title="v/F_a and beta = F_r/F_a at equal intensity", needs=_SUBJECTS),
    Missing(where="Fig. 7", title="Coefficients of variation of velocity and force", needs=_SUBJECTS),
    Missing(where="Fig. 8 A to D", title="Matches, impedance and load of every subject", needs=_SUBJECTS),
    Missing(where="Fig. 9 A", title="Measured impedances", needs="13 participants on the plate"),
    Missing(where="Fig. 10 A, grey", title="Normal velocity per shear force at equal intensity", needs=_SUBJECTS),
    Missing(where="Fig. 11 A, B", title="Similarity, and time of contact", needs=_SUBJECTS),
)


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """What `reproduce` wrote.

    Parameters
    ----------
    items : tuple of Item
        In the order of the page.
    pictures : bool
        Whether there are pictures; they take the ``plot`` extra.
    page : Path
        The page about all of it.
    """

    items: tuple[Item, ...]
    pictures: bool
    page: Path

    def rows(self) -> list[list[str]]:
        """Name or place in the paper, verdict and reason, of everything."""
        return [[each.name, each.verdict, each.reason] for each in self.items] + [
            [each.where, each.verdict, each.reason] for each in MISSING
        ]


def reproduce(
    folder: Path, *, names: Sequence[str] = tuple(ITEMS), progress: Callable[[str], None] | None = None
) -> Reproduction:
    """Compute the paper's figures and write numbers, pictures and a page with their verdicts.

    Parameters
    ----------
    folder : Path
        To write into; made where it is not there.
    names : sequence of str
        Which of `ITEMS`; by default all.
    progress : callable, optional
        Told the title of every item before it is computed.

    Returns
    -------
    Reproduction

    Raises
    ------
    ValueError
        For a name that is none of `ITEMS`.
    OSError
        Where the folder cannot be written.
    """
    for name in names:
        if name not in ITEMS:
            raise ValueError(f"{name!r}: must be one of {', '.join(ITEMS)}")
    folder.mkdir(parents=True, exist_ok=True)
    items, pictures = [], True
    for name in names:
        if progress is not None:
            progress(name)
        item = ITEMS[name]()
        for table, columns in item.tables.items():
            _write_table(folder / item.file(table), columns)
        pictures = _draw(folder / f"{name}.png", item) and pictures
        items.append(item)
    (folder / "paper.json").write_text(as_json(_report(items)), encoding="utf-8")
    where = folder / "index.html"
    where.write_text(page(items, MISSING, pictures), encoding="utf-8")
    return Reproduction(items=tuple(items), pictures=pictures, page=where)


def _draw(path: Path, item: Item) -> bool:
    """Draw an item where matplotlib is installed; an older picture never stays beside newer numbers."""
    from hapticrender.paper.pictures import draw

    path.unlink(missing_ok=True)
    try:
        draw(path, item)
    except MissingExtra:
        return False
    return True


def _write_table(path: Path, columns: Table) -> None:
    """Columns as CSV, numbers to nine digits."""
    with replacing(path) as scratch, open(scratch, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([each if isinstance(each, str) else f"{each:.9g}" for each in row])


def _report(items: Sequence[Item]) -> dict[str, object]:
    """Everything that was compared, for JSON."""
    return {
        "hapticrender": __version__,
        "items": [
            {
                "name": item.name,
                "where": item.where,
                "verdict": item.verdict,
                "reason": item.reason,
                "claims": [_entry(claim) for claim in item.claims],
                "tables": [item.file(table) for table in item.tables],
            }
            for item in items
        ],
        "missing": [asdict(each) | {"verdict": each.verdict, "reason": each.reason} for each in MISSING],
    }


def _entry(claim: Claim) -> dict[str, object]:
    """A claim as plain numbers."""
    plain: dict[str, object] = {
        key: float(value) if not isinstance(value, str | None) else value for key, value in asdict(claim).items()
    }
    return plain | {"verdict": claim.verdict}
