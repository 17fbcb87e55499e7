"""The envelope loop that every method with a low pass shares: bandwidths by the paper's rule, as compiled sections."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.kernels import Section
from hapticrender.control.loopshape import design, integrator, reduced_controller
from hapticrender.control.stdft import StarSTDFT
from hapticrender.protocols import Array

Bandwidths = tuple[float, float]


class EnvelopeLoop(NamedTuple):
    """Estimator's low pass and loop controller as second-order sections; boxcar length in samples, 0 for none."""

    filter: Section
    law: Section
    boxcar: int


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
        A margin is too small, most often because the delay is too long.
    """
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = float(min(model.lowest_frequency, fixed.min(initial=np.inf)))
    length = round(model.rate / lowest) if boxcar else 0
    width = bandwidths[1] if bandwidths else lowest / 2
    listener = StarSTDFT(bandwidth=width, rate=model.rate)
    if bandwidths:
        law = integrator(3.4 * bandwidths[0]) if form == "integrator" else reduced_controller(*bandwidths)
    else:
        late = max((length - 1) / (2 * model.rate) - listener.delay, 0.0) if boxcar else 0.0
        law = design(
            loop_bandwidth=lowest / 4,
            filter_bandwidth=width,
            form=form,
            lowest_frequency=lowest,
            delay=model.delay / model.rate + late if feedback else 0.0,
        ).controller
    return EnvelopeLoop(filter=section(listener.coefficients), law=section(law.tustin(model.rate)), boxcar=length)


def section(coefficients: tuple[Array, Array]) -> Section:
    """At most second-order (b, a) with a0 = 1 as five numbers."""
    b, a = (np.pad(part, (0, 3 - len(part))) for part in coefficients)
    b0, b1, b2, a1, a2 = (float(value) for value in (*b, *a[1:]))
    return b0, b1, b2, a1, a2
