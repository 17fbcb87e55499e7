"""The paper's polar loops on the boxcar STDFT (eq. 1-3) instead of the STDFT*: a window where that has a recursion."""

from __future__ import annotations

from dataclasses import dataclass

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.methods.paper import Polar, PolarController, per_side


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

    def design(
        self, model: BandModel, bands: Bands, *, feedback: bool = True, precision: str = "double"
    ) -> PolarController:
        """Loops on the displacements at the transducers."""
        return self._star(self.name, model, bands, *per_side(model), feedback, precision, boxcar=True)
