"""Numbers of the paper beside the recomputed ones, the verdict, and the curves to draw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
VERDICTS = ("reproduced", "corrected", "not reproducible")


@dataclass(frozen=True)
class Claim:
    """Compare one number of the paper with the recomputed one.

    Parameters
    ----------
    what : str
        Name of the quantity.
    paper, ours : float
        Printed and recomputed value, in `unit`.
    within : float
        Largest difference between equal values, >= 0: half of the last printed digit unless `why` says otherwise.
    unit : str
    relation : {"=", "<=", ">="}
        Relation of `ours` to `paper` that the paper states.
    check : float, optional
        The quantity by a second, independent calculation; only a claim with a check can be "corrected".
    why : str
        Cause of the difference, or what was compared.

    Examples
    --------
    >>> Claim("order", paper=6, ours=4, within=0.5, check=4).verdict
    'corrected'
    >>> Claim("order", paper=6, ours=5, within=0.5, check=4).verdict
    'not reproducible'
    """

    what: str
    paper: float
    ours: float
    within: float
    unit: str = ""
    relation: str = "="
    check: float | None = None
    why: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.within) and self.within >= 0):
            raise ValueError(f"within={self.within!r} {self.unit} must be finite and >= 0")
        if self.relation not in ("=", "<=", ">="):
            raise ValueError(f"relation={self.relation!r} must be one of =, <=, >=")

    @property
    def verdict(self) -> str:
        """Reproduced, corrected (a second calculation agrees with ours) or not reproducible."""
        apart = self.ours - self.paper
        holds = {"<=": apart <= 0, ">=": apart >= 0, "=": abs(apart) <= self.within}[self.relation]
        if holds:
            return "reproduced"
        agreed = self.check is not None and abs(self.check - self.ours) <= self.within
        return "corrected" if agreed else "not reproducible"


@dataclass(frozen=True)
class Curve:
    """One line of a panel: name, x, y, and style ("-", ":", "o", or "printed" for what the paper prints)."""

    name: str
    x: ArrayLike
    y: ArrayLike
    style: str = "-"


@dataclass(frozen=True)
class Panel:
    """One diagram: title, axis labels, curves, and which axes ("x", "y", "xy") are logarithmic."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log: str = ""
    ylim: tuple[float, float] | None = None


@dataclass(frozen=True)
class Item:
    """One figure, table or passage of the paper that needs no participant.

    Parameters
    ----------
    name : str
        Also the name of its files.
    title, where : str
        What it shows, and where the paper has it.
    claims : sequence of Claim
        At least one.
    panels : sequence of Panel
        What is drawn, and written as CSV.
    note : str
    picture : callable, optional
        Draws the picture into a file (.png), in place of the panels.
    """

    name: str
    title: str
    where: str
    claims: tuple[Claim, ...]
    panels: tuple[Panel, ...]
    note: str = ""
    picture: Callable[[Path], None] | None = None

    def __post_init__(self) -> None:
        if not self.claims:
            raise ValueError(f"{self.name}: claims must not be empty, or there is no verdict")

    @property
    def verdict(self) -> str:
        """The worst of its claims."""
        return max((claim.verdict for claim in self.claims), key=VERDICTS.index)

    @property
    def reason(self) -> str:
        """Which claims differ from the print."""
        other = [claim for claim in self.claims if claim.verdict != "reproduced"]
        counted = f"{len(self.claims) - len(other)} of {len(self.claims)} as printed"
        return "; ".join([counted, *(f"{claim.verdict}: {claim.what}" for claim in other)])
