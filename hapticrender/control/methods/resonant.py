"""Adaptive feed-forward cancellation, also known as proportional-resonant control: an integrator a band, no low pass.

The deviation from the wanted waveform, turned back by each carrier, is
integrated at once, v' = -ki 2 (y - Re sum R e^{j phi}) e^{-j phi}, and the
command is inverted with D + D' d/dt of the free device.  The cheapest of the
complex methods, for one or two bands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.cartesian.loops import ComplexController, ComplexRules, design_complex
from hapticrender.control.envelope_loop import EnvelopeLoop, section
from hapticrender.control.loopshape import Bounds, integrator, margins
from hapticrender.control.transfer import TransferFunction
from hapticrender.errors import DesignError

ALL_PASS = (1.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Resonant:
    """One integrator a band and coordinate.

    Parameters
    ----------
    gain : float, 1/s
        Sum of ki over the bands, > 0, below the decay rate of the device's least damped mode.
    feed_forward : bool
        Command the reference plus what the loop adds; by default the loop alone commands.
    checked : bool
        Refuse a gain or a delay beyond its bound; naive without.

    Notes
    -----
    From motion to force an integrator is ``-ki [D(jw)/(s - jw) + D'(jw) + conj. at -jw]``.  At a mode w1 of mass m and
    stiffness m w1^2 that is ``+j w1 2 ki m``: negative damping of 2 ki m from every band.  All together must stay below
    the mode's own m w1/Q, that is, sum ki < w1/2Q, its decay rate: 16.1 1/s for the rocking of the paper's plate.
    Delay and hold leave 3 % more for low carriers and take the limit away for those above the modes.
    """

    gain: float = 15.0
    feed_forward: bool = False
    checked: bool = True
    name = "resonant"

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> ComplexController:
        """Integrators on heave and rocking; refuses a gain that drives a mode and a delay that they cannot bear."""
        controller = integrator(self.gain / max(len(bands), 1))
        if feedback and self.checked:
            least = least_decay(model)
            if self.gain >= least:
                raise DesignError(
                    f"gain={self.gain:g} 1/s must be below {least:.3g} 1/s, the decay rate of the least damped mode, "
                    f"which it takes away: lower gain"
                )
            found = margins(controller, TransferFunction((1.0,), (1.0,)), delay=model.delay / model.rate)
            Bounds(ripple=math.inf).check(found, f"lower gain={self.gain:g} 1/s or the loop's delay")
        rules = ComplexRules(dynamic=True, feed_forward=self.feed_forward, deviation=True)
        loop = EnvelopeLoop(ALL_PASS, section(controller.tustin(model.rate)), 0, self.gain / (2 * math.pi))
        return design_complex(self.name, model, bands, rules, loop, feedback=feedback)


def least_decay(model: BandModel) -> float:
    """Decay rate of the least damped mode of the free device, 1/s."""
    n = len(model.mass)
    inverse = np.linalg.inv(model.mass)
    rates = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ model.stiffness, -inverse @ model.damping]])
    return float(-np.linalg.eigvals(rates).real.max())
