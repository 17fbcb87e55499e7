"""The paper's polar loops on the boxcar STDFT (eq. 1-3) instead of the STDFT*: a window where that has a recursion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.boxcar_kernels import BoxcarState, BoxcarTables, boxcar_run
from hapticrender.control.envelope_loop import envelope_loop
from hapticrender.control.methods.paper import Polar, PolarController, per_side, polar_tables
from hapticrender.protocols import Array


class BoxcarController:
    """Polar controller that listens through a window, behind the `Controller` protocol.

    Parameters
    ----------
    polar : PolarController
        The same loops on the STDFT*.
    length : int
        M, samples in the window.
    """

    def __init__(self, polar: PolarController, length: int) -> None:
        self.method = polar.method
        self.n_bands = polar.n_bands
        self.tables = BoxcarTables(polar.tables)
        rows = 2 * len(polar.tables.listen)
        self.state = BoxcarState(
            polar=polar.state,
            window=np.zeros((length, rows, polar.n_bands)),
            total=np.zeros((2, rows, polar.n_bands)),
            oldest=np.zeros(1, np.int64),
        )

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; see `Controller`."""
        n = len(sensed)
        drive = np.zeros((n, len(self.tables.polar.speak)))
        target = np.zeros((n, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        boxcar_run(self.tables, self.state, np.ascontiguousarray(sensed, float), position, wanted, drive, target, flags)
        return drive, target, flags


@dataclass(frozen=True, kw_only=True)
class Boxcar(Polar):
    """The paper's loops, per transducer, on a running mean as long as a period of the lowest carrier.

    Parameters
    ----------
    clamp, subtract, bandwidths
        As those of `Polar`.

    Notes
    -----
    Targets of recorded textures still come through the STDFT*.
    """

    name = "boxcar"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> BoxcarController:
        """Loops on the displacements at the transducers."""
        loop = envelope_loop(model, bands, boxcar=True, bandwidths=self.bandwidths, feedback=feedback)
        polar = PolarController(self.name, polar_tables(self, model, bands, *per_side(model), loop, feedback))
        return BoxcarController(polar, loop.boxcar)
