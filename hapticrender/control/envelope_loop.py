"""Design the envelope loop that every method with a low pass shares: bandwidths by the paper's rule, as sections."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.estimators import StarSTDFT
from hapticrender.control.loopshape import TransferFunction, design, integrator, reduced_controller
from hapticrender.errors import DesignError
from hapticrender.protocols import Array

Bandwidths = tuple[float, float]
Section = tuple[float, float, float, float, float]  # b0 b1 b2 a1 a2, a0 = 1
NARROWER, SLOWEST = 0.9, 0.05  # steps in which a loop is slowed down for its delay, and how far


class EnvelopeLoop(NamedTuple):
    """Low pass of an estimator and its loop controller as second-order sections.

    `boxcar` is the length of the running mean in samples, 0 for none; `bandwidth` (Hz) that of the closed loop, lowered
    where the delay requires it.
    """

    filter: Section
    law: Section
    boxcar: int
    bandwidth: float


def envelope_loop(
    model: DeviceModel,
    bands: Bands,
    *,
    form: Literal["reduced", "integrator"] = "reduced",
    boxcar: bool = False,
    bandwidths: Bandwidths | None = None,
    feedback: bool = True,
) -> EnvelopeLoop:
    """Design the loop of one envelope for the lowest carrier of `bands`, with the margins of a low-pass loop.

    Parameters
    ----------
    model : DeviceModel
        Gives the rate, the known delay and the lowest carrier that a moving finger may make.
    bands : Bands
        Gives the fixed carriers.
    form : {"reduced", "integrator"}
        Second-order controller of loop shaping, or a plain integrator.
    boxcar : bool
        Estimate by a running mean over one period of the lowest carrier, which removes the image of that carrier and of
        its harmonics; its delay beyond the low pass's counts as the loop's.
    bandwidths : (float, float), Hz, optional
        Of loop and low pass, unchecked.  By default a quarter and half of the lowest carrier, or less where the delay
        would leave too small a margin.
    feedback : bool
        Without it no delay is in the loop.

    Raises
    ------
    DesignError
        Even a loop twenty times slower has too small a margin.
    """
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = float(min(model.lowest_frequency, fixed.min(initial=np.inf)))
    length = round(model.rate / lowest) if boxcar else 0
    if bandwidths:
        width, low_pass = bandwidths[0], StarSTDFT(bandwidth=bandwidths[1], rate=model.rate)
        law = integrator(3.4 * width) if form == "integrator" else reduced_controller(*bandwidths)
    else:
        low_pass = StarSTDFT(bandwidth=lowest / 2, rate=model.rate)
        late = max((length - 1) / (2 * model.rate) - low_pass.delay, 0.0) if boxcar else 0.0
        width, law = _widest(lowest, form, model.delay / model.rate + late if feedback else 0.0)
        low_pass = StarSTDFT(bandwidth=2 * width, rate=model.rate)
    return EnvelopeLoop(section(low_pass.coefficients), section(law.tustin(model.rate)), length, width)


def _widest(lowest: float, form: Literal["reduced", "integrator"], delay: float) -> tuple[float, TransferFunction]:
    """Widest loop (Hz), from a quarter of the lowest carrier down, whose margins hold with the delay (s)."""
    width = lowest / 4
    while True:
        try:
            return width, design(width, 2 * width, form, lowest, delay=delay).controller
        except DesignError:
            width *= NARROWER
            if width < SLOWEST * lowest / 4:
                raise


def section(coefficients: tuple[Array, Array]) -> Section:
    """At most second-order (b, a) with a0 = 1 as five numbers."""
    b, a = (np.pad(part, (0, 3 - len(part))) for part in coefficients)
    b0, b1, b2, a1, a2 = (float(value) for value in (*b, *a[1:]))
    return b0, b1, b2, a1, a2
