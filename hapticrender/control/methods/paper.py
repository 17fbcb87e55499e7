"""The controller of Grigorii et al. 2021: amplitude and phase loops on the STDFT*, per transducer or in common mode.

A look-up table of the free plate over frequency turns the commanded amplitude
into a current; the phase loop needs none.  The command amplitude never goes
negative, and the phase is cut at -270/90 degrees.  It is the baseline that the
other methods are measured against: two sides controlled apart are unstable on
this very plate between 129 and 189 Hz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticrender.bands import Bands
from hapticrender.compiled.lanes import WIDTH, aligned, padded
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.state import PRECISIONS
from hapticrender.control.envelope_loop import Bandwidths, EnvelopeLoop, envelope_loop
from hapticrender.control.kernels import WAVENUMBER
from hapticrender.control.polar.kernels import (
    BAND_ROWS,
    FORWARD,
    FRAME_RE,
    HEADING_RE,
    LOOP_ROWS,
    REFRESH,
    SHARED_ROWS,
    PolarNumbers,
    PolarState,
    PolarTables,
)
from hapticrender.control.polar.passes import NUMBER, SCRATCH_ROWS, TOLD_ROWS, polar_run
from hapticrender.errors import DesignError
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
    window : int, samples
        Length of the boxcar; 0: the STDFT* listens.
    precision : {"double", "single"}
        Of everything that a band owns.
    """

    def __init__(self, method: str, tables: PolarTables, window: int = 0, precision: str = "double") -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"{precision=}: must be one of {', '.join(PRECISIONS)}")
        self.method = method
        self.n_bands = tables.tone.shape[1]
        self.tables = tables
        self.state = polar_state(tables, window, PRECISIONS[precision])

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        drive = np.zeros((n, len(self.tables.speak)))
        flags = np.zeros(n, np.int64)
        columns = (np.ascontiguousarray(sensed, float), position, wanted, drive)
        follows = self.tables.numbers.analysed or (self.tables.tone[WAVENUMBER] > 0.0).any()
        # constant targets change only where the tones are looked at anew
        cuts = [0, n] if follows else [0, min(-int(self.state.sample[0]) % REFRESH, n), n]
        parts = []
        for start, stop in zip(cuts, cuts[1:], strict=False):
            target = np.zeros((stop - start if follows else 1, self.n_bands), complex)
            if stop > start:
                part = [column[start:stop] for column in columns]
                polar_run(self.tables, self.state, *part, target, flags[start:stop])
                parts.append(np.broadcast_to(target, (stop - start, self.n_bands)))
        if not parts:
            return drive, np.zeros((0, self.n_bands), complex), flags
        return drive, parts[0] if len(parts) == 1 else np.concatenate(parts), flags


def polar_state(tables: PolarTables, window: int, dtype: type) -> PolarState:
    """State of a polar controller at rest, its bands in `dtype`."""
    coordinates, bands = len(tables.listen), tables.tone.shape[1]
    tiles, width = padded(bands, dtype), WIDTH[np.dtype(dtype)]
    band = aligned((tiles, BAND_ROWS, width), dtype)
    band[:, [FORWARD, HEADING_RE, FRAME_RE]] = 1.0
    rows = 2 * tiles * coordinates
    told: Array = np.zeros((TOLD_ROWS + 2 * coordinates, REFRESH), dtype)
    told[NUMBER] = np.arange(REFRESH)
    return PolarState(
        band=band,
        loop=aligned((tiles, coordinates * LOOP_ROWS, width), dtype),
        phase=np.zeros(bands, np.uint64),
        advance=np.zeros(bands, np.uint64),
        counted=np.zeros(bands),
        locked=np.zeros(tiles, np.int64),
        finger=np.zeros(4),
        doubt=np.zeros(1),
        sample=np.zeros(1, np.int64),
        shared=np.zeros((SHARED_ROWS + coordinates, REFRESH)),
        told=told,
        scratch=aligned((SCRATCH_ROWS + 2 * coordinates, REFRESH, width), dtype),
        sum=aligned((coordinates, REFRESH, width), dtype),
        window=aligned((window, rows, width), dtype),
        heap=aligned((2, rows, width), dtype),
    )


@dataclass(frozen=True, kw_only=True)
class Polar:
    """Options of the polar methods; they show what each precaution is good for.

    Parameters
    ----------
    clamp : bool
        Keep the command amplitude from going negative.
    subtract : bool
        Naive phase error arg X - arg R, with a seam at -270/90 degrees in each, instead of arg(X conj R).
    bandwidths : (float, float), Hz, optional
        Of loop and low pass, unchecked; by default the paper's rule.
    """

    clamp: bool = True
    subtract: bool = False
    bandwidths: Bandwidths | None = None

    def _star(
        self,
        name: str,
        model: BandModel,
        bands: Bands,
        watched: Array,
        spread: Array,
        feedback: bool,
        precision: str,
        boxcar: bool = False,
    ) -> PolarController:
        """Loops on the STDFT*, or on the boxcar STDFT."""
        loop = envelope_loop(model, bands, boxcar=boxcar, bandwidths=self.bandwidths, feedback=feedback)
        tables = polar_tables(self, model, bands, watched, spread, loop, feedback)
        return PolarController(name, tables, loop.boxcar if boxcar else 0, precision)


class PerSide(Polar):
    """The paper's controller: each transducer with its own amplitude and phase loops."""

    name = "paper"

    def design(
        self, model: BandModel, bands: Bands, *, feedback: bool = True, precision: str = "double"
    ) -> PolarController:
        """Loops on the displacements at the transducers, interpolated from the sensors at the ends."""
        return self._star(self.name, model, bands, *per_side(model), feedback, precision)


class CommonMode(Polar):
    """The same loops on the mean displacement only; all transducers get the same drive."""

    name = "paper-common"

    def design(
        self, model: BandModel, bands: Bands, *, feedback: bool = True, precision: str = "double"
    ) -> PolarController:
        """One pair of loops on heave."""
        sides = model.side_from_coordinate
        mean, alike = sides.mean(axis=0, keepdims=True), np.ones((len(sides), 1))
        return self._star(self.name, model, bands, mean, alike, feedback, precision)


def per_side(model: BandModel) -> tuple[Array, Array]:
    """Watched displacements and drive channels of loops at each transducer, in coordinates."""
    sides = model.side_from_coordinate
    return sides, np.eye(len(sides))


def polar_tables(
    options: Polar,
    model: BandModel,
    bands: Bands,
    watched: Array,
    spread: Array,
    loop: EnvelopeLoop,
    feedback: bool,
) -> PolarTables:
    """Tables of the compiled step: `watched` rows are the controlled displacements, `spread` their drive channels."""
    if bands.modulated or bands.differentiated:
        raise DesignError("targets that grow with a waveform or with the finger's speed: a polar method has none")
    frequency = np.arange(0.0, model.rate / 2 + TABLE_STEP, TABLE_STEP)
    response = watched @ model.response(frequency) @ spread  # (table, coordinates, coordinates)
    alike = np.ones(len(watched))
    if feedback:  # what each coordinate does while all are driven alike, as a sweep of the plate would show it
        table = response @ alike
    else:  # what makes all of them do the same
        table = 1.0 / np.linalg.solve(response, alike[:, None])[..., 0]
    table = table.T * np.sinc(frequency / model.rate)
    numbers = PolarNumbers(
        rate=float(model.rate),
        feedback=feedback,
        analysed=bands.envelope is None,
        drive_limit=float(model.drive_limit),
        sensed_limit=float(model.sensed_limit),
        lowest=float(model.lowest_frequency),
        highest=min(model.highest_frequency, 0.4 * model.rate),
        floor=0.0 if options.clamp else -math.inf,
        subtract=options.subtract,
        filter=loop.filter,
        law=loop.law,
        table_step=TABLE_STEP,
        lead=(model.delay + 0.5) / model.rate,
    )
    return PolarTables(
        numbers=numbers,
        tone=bands.tone(),
        listen=np.ascontiguousarray(watched @ model.coordinate_from_sensed),
        speak=spread,
        gain=np.ascontiguousarray(abs(table)),
        lag=np.ascontiguousarray(np.unwrap(np.angle(table), axis=1)),
    )
