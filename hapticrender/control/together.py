"""Two controllers as one, for a device whose two parts are felt as one: one moves the skin, the other rubs it.

Each part has a controller of its own, of the same method, for its own bands; here their channels lie side by side and
their targets add up to what is wanted of the skin's velocity::

    V = j w X_moved + (v/F) F_rubbed

Nothing is estimated, filtered or closed here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.compiled.jit import kernel
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.controller import BankController
from hapticrender.control.bank.kernels import bank_step
from hapticrender.control.bank.state import BankState, BankTables
from hapticrender.errors import DesignError
from hapticrender.protocols import Array, Controller, Method


@dataclass(frozen=True, kw_only=True)
class TwoModels(BandModel):
    """Band model of a device of two parts, which the controllers never see: they are designed for the parts.

    Parameters
    ----------
    moved : BandModel
        Of the part that moves the skin; a displacement (m).
    rubbed : BandModel or None
        Of the part that rubs it; a friction (N).  None: nothing is wanted of it.
    velocity_per_force : float, m/(N s)
        Skin velocity that feels as strong as a newton of friction.
    """

    moved: BandModel
    rubbed: BandModel | None
    velocity_per_force: float


@dataclass(frozen=True, kw_only=True)
class TwoBands(Bands):
    """Bands of a device of two parts, their envelopes the wanted displacement (m), and the share of each part.

    Parameters
    ----------
    moved : Bands
        What is wanted of the part that moves the skin (m).
    rubbed : Bands
        What is wanted of the part that rubs it (N).
    of_moved, of_rubbed : ndarray of int
        Which of all bands each of those is.
    """

    moved: Bands
    rubbed: Bands
    of_moved: Array
    of_rubbed: Array


_NAMES = ("moved", "rubbed")


class TogetherTables(NamedTuple):
    """Parameters of two banks and of how they lie side by side."""

    moved: BankTables
    rubbed: BankTables
    of_moved: Array  # (bands of moved,) integer: which of all bands each is
    of_rubbed: Array
    felt: Array  # (bands of rubbed,) complex: skin velocity per target, m/(N s)
    wanted: float  # of rubbed, per wanted waveform
    sensors: int  # of moved; those of rubbed follow
    channels: int  # of moved


class TogetherState(NamedTuple):
    """State of two banks; changed in place."""

    moved: BankState
    rubbed: BankState
    displacement: Array  # (bands of moved,) complex: targets of the last sample, m
    friction: Array  # (bands of rubbed,) complex, N


@kernel
def together_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of both banks: fills `drive` and `target` (all bands, m/s), returns flags."""
    moved, rubbed, band = state.displacement, state.friction, state.moved.band
    s, c, width = tables.sensors, tables.channels, band.shape[2]
    flags = bank_step(tables.moved, state.moved, sensed[:s], position, wanted, drive[:c], moved)
    wanted *= tables.wanted
    flags |= bank_step(tables.rubbed, state.rubbed, sensed[s:], position, wanted, drive[c:], rubbed)
    for k in range(target.shape[0]):
        target[k] = 0.0
    for i in range(moved.shape[0]):
        target[tables.of_moved[i]] += 1j * band[i // width, row.OMEGA, i % width] * moved[i]
    for i in range(rubbed.shape[0]):
        target[tables.of_rubbed[i]] += tables.felt[i] * rubbed[i]
    return flags


@kernel
def together_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `together_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = together_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])


class Silent:
    """Controller of a part of which nothing is wanted: it is left alone.

    Parameters
    ----------
    method : str
        Name of the method that would have designed it.
    channels : int
        Of the part's drive.
    """

    tables = state = None
    n_bands = 0
    note = "silent: nothing is wanted of it"

    def __init__(self, method: str, channels: int) -> None:
        self.method, self.channels = method, channels

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        return np.zeros((n, self.channels)), np.zeros((n, 0), complex), np.zeros(n, np.int64)


class TogetherController:
    """Two controllers behind the `Controller` protocol; `design_together` makes one.

    Parameters
    ----------
    moved, rubbed : Controller
        Of the two parts.
    bands : TwoBands
        What they are to do.
    velocity_per_force : float, m/(N s)
        Skin velocity that feels as strong as a newton of friction.
    sensors, channels : (int, int)
        Of each part.
    listens : bool
        Whether anything is sensed.
    """

    tables: Any = None  # of two banks, which run together in compiled code
    state: Any = None

    def __init__(
        self,
        moved: Controller,
        rubbed: Controller,
        bands: TwoBands,
        velocity_per_force: float,
        sensors: tuple[int, int],
        channels: tuple[int, int],
        *,
        listens: bool = True,
    ) -> None:
        self.method, self.n_bands = moved.method, len(bands)
        self.parts, self.bands = (moved, rubbed), bands
        self.sensors, self.channels, self.listens = sensors, channels, listens
        shown = np.ones(len(bands.rubbed)) if bands.rubbed.shown is None else bands.rubbed.shown
        self.felt = velocity_per_force / np.asarray(shown, complex)
        if isinstance(moved, BankController) and isinstance(rubbed, BankController):
            self.tables = TogetherTables(
                moved.tables,
                rubbed.tables,
                bands.of_moved,
                bands.of_rubbed,
                self.felt,
                1.0 / velocity_per_force if bands.envelope is None else 1.0,
                sensors[0],
                channels[0],
            )
            envelopes = (np.zeros(each.n_bands, complex) for each in self.parts)
            self.state = TogetherState(moved.state, rubbed.state, *envelopes)

    @property
    def note(self) -> str:
        """What the two designs chose and why."""
        return "\n".join(f"{name}: {getattr(part, 'note', '')}" for name, part in zip(_NAMES, self.parts, strict=True))

    @property
    def mismatch(self) -> float:
        """Share of a target that the integral parts add on the untouched device; see `BankController.mismatch`."""
        return max(getattr(part, "mismatch", 0.0) for part in self.parts)

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        heard = np.ascontiguousarray(sensed, float) if self.listens else np.zeros((n, sum(self.sensors)))
        if self.tables is None:
            return self._apart(heard, position, wanted)
        drive, target = np.zeros((n, sum(self.channels))), np.zeros((n, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        together_run(self.tables, self.state, heard, position, wanted, drive, target, flags)
        return drive, target, flags

    def _apart(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Run the two one after the other; their carriers are fixed."""
        bands, target = self.bands, np.zeros((len(sensed), self.n_bands), complex)
        heard = np.split(sensed, [self.sensors[0]], axis=1)
        moved, rubbed = (each.run(y, position, wanted) for each, y in zip(self.parts, heard, strict=True))
        target[:, bands.of_moved] += 2j * np.pi * bands.moved.frequency * moved[1]
        target[:, bands.of_rubbed] += self.felt * rubbed[1]
        return np.hstack([moved[0], rubbed[0]]), target, moved[2] | rubbed[2]


def design_together(method: Method, model: TwoModels, bands: TwoBands, *, feedback: bool = True) -> TogetherController:
    """Design a controller of `method` for each part, with what is wanted of it.

    Raises
    ------
    DesignError
        Carriers follow the finger, and the method has no bank, whose fades make the crossover.
    """
    channels = model.moved.force_from_drive.shape[1], 1
    sensors = model.moved.coordinate_from_sensed.shape[1], 1
    moved, rubbed = (
        method.design(each, own, feedback=feedback) if each is not None and len(own) else Silent(method.name, count)
        for each, own, count in zip((model.moved, model.rubbed), (bands.moved, bands.rubbed), channels, strict=True)
    )
    if (bands.wavenumber > 0.0).any() and not all(isinstance(part, BankController) for part in (moved, rubbed)):
        raise DesignError(
            f"method = {method.name!r}: must be 'h' or 'h2' for a texture over position on two parts, whose crossover "
            "follows the finger, sample by sample"
        )
    return TogetherController(moved, rubbed, bands, model.velocity_per_force, sensors, channels, listens=feedback)
