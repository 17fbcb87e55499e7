"""Complex envelopes in heave and rocking, inverted through the free device: statically, or with the slope of D.

Both listen through the low pass of the STDFT* and share the loop controller of
the paper.  The static inverse D(jw) takes every envelope for constant, which
fails within a few Hz of a mode, where the device's own envelope is slower than
the loop; dynamic stiffness, D V + D' dV/dt, is exact up to m W^2/|D| for
changes of W rad/s.  Neither knows a finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.cartesian.loops import ComplexController, ComplexRules, design_complex
from hapticrender.control.envelope_loop import Bandwidths, envelope_loop


@dataclass(frozen=True, kw_only=True)
class Inverse:
    """What the two inverses have in common; the options show what each precaution is good for.

    Parameters
    ----------
    form : {"reduced", "integrator"}
        C2 of loop shaping, or the plain integrator of 17 1/s at 5 Hz.
    feed_forward : bool
        Command the reference plus what the loop adds; by default the loop alone commands.
    filtered : bool
        With feed-forward, pass the reference through the estimator's low pass before it is compared; naive without.
    bandwidths : (float, float), Hz, optional
        Of loop and low pass, unchecked; by default the paper's rule.
    """

    form: Literal["reduced", "integrator"] = "reduced"
    feed_forward: bool = False
    filtered: bool = True
    bandwidths: Bandwidths | None = None

    def _design(self, name: str, dynamic: bool, model: BandModel, bands: Bands, feedback: bool) -> ComplexController:
        rules = ComplexRules(
            dynamic=dynamic, feed_forward=self.feed_forward, deviation=self.feed_forward and self.filtered
        )
        loop = envelope_loop(model, bands, form=self.form, bandwidths=self.bandwidths, feedback=feedback)
        return design_complex(name, model, bands, rules, loop, feedback=feedback)


class StaticInverse(Inverse):
    """Loop controller, then the static inverse D(jw) of the free device."""

    name = "static"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> ComplexController:
        """Two by two loops on heave and rocking."""
        return self._design(self.name, False, model, bands, feedback)


class DynamicStiffness(Inverse):
    """Loop controller, then D V + D' dV/dt of the free device."""

    name = "stiffness"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> ComplexController:
        """Two by two loops on heave and rocking."""
        return self._design(self.name, True, model, bands, feedback)
