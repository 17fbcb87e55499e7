"""The envelope loop that every method with a low pass shares: bandwidths by the paper's rule, as compiled sections."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.kernels import Section
from hapticrender.control.loopshape import TransferFunction, design, integrator, reduced_controller
from hapticrender.control.stdft import StarSTDFT
from hapticrender.errors import DesignError
from hapticrender.protocols import Array

Bandwidths = tuple[float, float]
NARROWER, SLOWEST = 0.9, 0.05  # steps in which a loop is slowed down for its delay, and how far


class EnvelopeLoop(NamedTuple):
    """Estimator's low pass and loop controller as second-order sections.

    `boxcar` is its length in samples, 0 for none; `bandwidth` (Hz) that of the closed loop, lowered where the delay
    asks for it.
    """

    filter: Section
    law: Section
    boxcar: int
    bandwidth: float


def envelope_loop(
    model: BandModel,
    bands: Bands,
    *,
    form: Literal["reduced", "integrator"] = "reduced",
    boxcar: bool = False,
    bandwidths: Bandwidths | None = None,
    feedback: bool = True,
) -> EnvelopeLoop:
    """Design the loop of one envelope for the lowest carrier of `bands`, checked against its margins.

    Parameters
    ----------
    model : BandModel
        Gives the rate, the known delay and the lowest carrier that a moving finger may make.
    bands : Bands
        Gives the fixed carriers.
    form : {"reduced", "integrator"}
        C2 of loop shaping, or the plain integrator.
    boxcar : bool
        Listen through a running mean over one period of the lowest carrier, which is deaf to the image of that carrier
        and of its harmonics; its delay beyond the low pass's counts as the loop's.
    bandwidths : (float, float), Hz, optional
        Of loop and low pass.  Naive: no rule and no margin is checked.  By default a quarter and half of the lowest
        carrier, which is at most the model's lowest frequency.
    feedback : bool
        Without it no delay is in the loop.

    Returns
    -------
    EnvelopeLoop

    Raises
    ------
    DesignError
        Even a loop twenty times slower has too small a margin.
    """
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = float(min(model.lowest_frequency, fixed.min(initial=np.inf)))
    length = round(model.rate / lowest) if boxcar else 0
    if bandwidths:
        width = bandwidths[0]
        listener = StarSTDFT(bandwidth=bandwidths[1], rate=model.rate)
        law = integrator(3.4 * width) if form == "integrator" else reduced_controller(*bandwidths)
    else:
        listener = StarSTDFT(bandwidth=lowest / 2, rate=model.rate)
        late = max((length - 1) / (2 * model.rate) - listener.delay, 0.0) if boxcar else 0.0
        delay = model.delay / model.rate + late if feedback else 0.0
        width, listener, law = _within_margins(model, lowest, form, delay)
    return EnvelopeLoop(section(listener.coefficients), section(law.tustin(model.rate)), length, width)


def _within_margins(
    model: BandModel, lowest: float, form: Literal["reduced", "integrator"], delay: float
) -> tuple[float, StarSTDFT, TransferFunction]:
    """Widest loop, from a quarter of the lowest carrier down, whose margins bear the delay (s)."""
    width = lowest / 4
    while True:
        try:
            law = design(width, 2 * width, form, lowest, delay=delay).controller
        except DesignError:
            width *= NARROWER
            if width < SLOWEST * lowest / 4:
                raise
        else:
            return width, StarSTDFT(bandwidth=2 * width, rate=model.rate), law


def section(coefficients: tuple[Array, Array]) -> Section:
    """At most second-order (b, a) with a0 = 1 as five numbers."""
    b, a = (np.pad(part, (0, 3 - len(part))) for part in coefficients)
    b0, b1, b2, a1, a2 = (float(value) for value in (*b, *a[1:]))
    return b0, b1, b2, a1, a2
