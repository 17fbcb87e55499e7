"""The controller of Grigorii et al. 2021: amplitude and phase loops on the STDFT*, per transducer or in common mode.

A look-up table of the free plate over frequency turns the commanded amplitude
into a current; the phase loop needs none.  The command amplitude never goes
negative, and the phase is cut at -270/90 degrees.  It is the baseline that the
other methods are measured against: two sides controlled apart are unstable on
this very plate between 129 and 189 Hz.
"""

from __future__ import annotations

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.kernels import (
    BAND_ROWS,
    FORWARD,
    HEADING_RE,
    LOOP_ROWS,
    PolarNumbers,
    PolarState,
    PolarTables,
    Section,
    polar_run,
)
from hapticrender.control.loopshape import design
from hapticrender.protocols import Array

TABLE_STEP = 0.5  # Hz, resolution of the look-up table


class PolarController:
    """Polar controller of any number of coordinates and bands behind the `Controller` protocol.

    Parameters
    ----------
    method : str
        Name of the method that designed it.
    tables : PolarTables
        Parameters of the compiled step.
    """

    def __init__(self, method: str, tables: PolarTables) -> None:
        coordinates, bands = len(tables.listen), tables.tone.shape[1]
        self.method = method
        self.n_bands = bands
        self.tables = tables
        band = np.zeros((BAND_ROWS, bands))
        band[[FORWARD, HEADING_RE]] = 1.0
        self.state = PolarState(
            band=band,
            loop=np.zeros((coordinates * LOOP_ROWS, bands)),
            finger=np.zeros(4),
            coordinate=np.zeros(coordinates),
        )

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        drive = np.zeros((n, len(self.tables.speak)))
        target = np.zeros((n, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        polar_run(self.tables, self.state, np.ascontiguousarray(sensed, float), position, wanted, drive, target, flags)
        return drive, target, flags


class PerSide:
    """The paper's controller: each transducer with its own amplitude and phase loops."""

    name = "paper"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> PolarController:
        """Loops on the displacements at the transducers, interpolated from the sensors at the ends."""
        sides = model.side_from_coordinate
        return _design(self.name, model, bands, sides, np.eye(len(sides)), feedback)


class CommonMode:
    """The same loops on the mean displacement only; all transducers get the same drive."""

    name = "paper-common"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> PolarController:
        """One pair of loops on heave."""
        sides = model.side_from_coordinate
        return _design(self.name, model, bands, sides.mean(axis=0, keepdims=True), np.ones((len(sides), 1)), feedback)


def _design(
    name: str,
    model: BandModel,
    bands: Bands,
    watched: Array,
    spread: Array,
    feedback: bool,
) -> PolarController:
    """Tables of the compiled step: `watched` rows are the controlled displacements, `spread` their drive channels."""
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = min(model.lowest_frequency, fixed.min(initial=np.inf))
    loop = design(
        loop_bandwidth=lowest / 4,
        filter_bandwidth=lowest / 2,
        form="reduced",
        lowest_frequency=lowest,
        delay=model.delay / model.rate if feedback else 0.0,
    )
    frequency = np.arange(0.0, model.rate / 2 + TABLE_STEP, TABLE_STEP)
    common = model.response(frequency) @ np.ones(model.force_from_drive.shape[1])
    table = (common @ watched.T).T * model.hold_and_delay(frequency)
    numbers = PolarNumbers(
        rate=float(model.rate),
        feedback=feedback,
        analysed=bands.envelope is None,
        drive_limit=float(model.drive_limit),
        sensed_limit=float(model.sensed_limit),
        lowest=float(model.lowest_frequency),
        highest=min(model.highest_frequency, 0.4 * model.rate),
        filter=_section(loop.low_pass.tustin(model.rate, prewarp=lowest / 2)),
        law=_section(loop.controller.tustin(model.rate)),
        table_step=TABLE_STEP,
    )
    tables = PolarTables(
        numbers=numbers,
        tone=bands.tone(),
        listen=np.ascontiguousarray(watched @ model.coordinate_from_sensed),
        speak=spread,
        gain=np.ascontiguousarray(abs(table)),
        lag=np.ascontiguousarray(np.unwrap(np.angle(table), axis=1)),
    )
    return PolarController(name, tables)


def _section(coefficients: tuple[Array, Array]) -> Section:
    """Second-order section with a0 = 1 as five numbers."""
    b, a = coefficients
    b0, b1, b2, a1, a2 = (float(value) for value in (*b, *a[1:]))
    return b0, b1, b2, a1, a2
