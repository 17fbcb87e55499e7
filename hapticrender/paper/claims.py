"""What the paper says beside what comes out, and the verdict that follows from the two."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from hapticrender.protocols import Array

Verdict = Literal["reproduced", "corrected", "not reproducible"]
Relation = Literal["=", "<=", ">="]
Table = Mapping[str, Array]  # columns of one length, named with their units


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One number of the paper, or one that its printed equation gives, beside ours.

    Parameters
    ----------
    what : str
        The quantity, in words.
    paper, ours : float
        As the paper has it, and as it comes out here; both in `unit`.
    within : float
        How far two numbers that agree may lie apart, >= 0: half of the last digit that the paper prints, unless
        `why` says otherwise.
    unit : str
        Of all the numbers.
    relation : {"=", "<=", ">="}
        What the paper says of `ours` against `paper`.
    check : float, optional
        The quantity by a second route that shares no equation with `ours`; without it nothing is called corrected.
    why : str
        Where the difference comes from, or what was compared.

    Examples
    --------
    >>> Claim(what="order", paper=6, ours=4, within=0.5, check=4).verdict
    'corrected'
    >>> Claim(what="order", paper=6, ours=5, within=0.5, check=4).verdict
    'not reproducible'
    """

    what: str
    paper: float
    ours: float
    within: float
    unit: str = ""
    relation: Relation = "="
    check: float | None = None
    why: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.within) and self.within >= 0):
            raise ValueError(f"within={self.within!r} {self.unit} must be finite and >= 0")
        if self.relation not in ("=", "<=", ">="):
            raise ValueError(f"relation={self.relation!r} must be one of =, <=, >=")

    @property
    def verdict(self) -> Verdict:
        """Reproduced where ours is as the paper says; corrected where two routes agree that it is not."""
        if self._holds():
            return "reproduced"
        if self.check is not None and abs(self.check - self.ours) <= self.within:
            return "corrected"
        return "not reproducible"

    def _holds(self) -> bool:
        if self.relation == "<=":
            return self.ours <= self.paper
        if self.relation == ">=":
            return self.ours >= self.paper
        return abs(self.ours - self.paper) <= self.within


@dataclass(frozen=True, kw_only=True)
class Item:
    """A figure, table or passage of the paper that needs no participant.

    Parameters
    ----------
    name : str
        Also names its files.
    title : str
        What it shows.
    where : str
        Where in the paper it stands.
    claims : tuple of Claim
        At least one.
    tables : mapping of str to table
        The numbers that its picture shows.
    note : str
        What a reader should know beside the numbers.
    """

    name: str
    title: str
    where: str
    claims: tuple[Claim, ...]
    tables: Mapping[str, Table] = field(repr=False)
    note: str = ""

    def __post_init__(self) -> None:
        if not self.claims:
            raise ValueError(f"{self.name}: claims must not be empty, or there is no verdict")
        for table, columns in self.tables.items():
            if len({len(values) for values in columns.values()}) != 1:
                raise ValueError(f"{self.name}: the columns of table {table!r} must be of one length")

    @property
    def verdict(self) -> Verdict:
        """The worst of its claims."""
        found = {claim.verdict for claim in self.claims}
        if "not reproducible" in found:
            return "not reproducible"
        return "corrected" if "corrected" in found else "reproduced"

    def file(self, table: str) -> str:
        """Name of the CSV file of one of its tables."""
        return f"{self.name}-{table.replace(' ', '-')}.csv"

    @property
    def reason(self) -> str:
        """The verdict in a line: which claims were not met as printed."""
        other = [claim for claim in self.claims if claim.verdict != "reproduced"]
        counted = f"{len(self.claims) - len(other)} of {len(self.claims)} as printed"
        return "; ".join([counted, *(f"{claim.verdict}: {claim.what}" for claim in other)])


@dataclass(frozen=True, kw_only=True)
class Missing:
    """A figure of the paper that no computation can give.

    Parameters
    ----------
    where, title : str
        Which, and what it shows.
    needs : str
        What it would take.
    """

    where: str
    title: str
    needs: str

    @property
    def verdict(self) -> Verdict:
        """Never anything else."""
        return "not reproducible"

    @property
    def reason(self) -> str:
        """The verdict in a line."""
        return f"needs {self.needs}"
