"""The paper's loop shaping: the exact controller, and what a loop does beside keeping its margins."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.loopshape import TransferFunction, butterworth, loop_margins
from hapticrender.control.margins import Margins
from hapticrender.mathx import zero_crossings

Array = np.ndarray[Any, Any]


def exact_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Solve for the controller that makes the closed loop exactly T, in its least order, four.

    Parameters
    ----------
    loop_bandwidth, filter_bandwidth : float
        Bandwidths of the Butterworth T and L, Hz.

    Notes
    -----
    ``C = l/(l t - 1)`` with l and t the denominators of L and T, 1 at s = 0; one pole lies at 0.  Polynomial arithmetic
    on T/(1 - L T) gives order six, of which the poles of T cancel.
    """
    low_pass, target = (
        np.divide(block.denominator, block.denominator[-1])
        for block in (butterworth(filter_bandwidth), butterworth(loop_bandwidth))
    )
    return TransferFunction(tuple(low_pass), tuple(np.polysub(np.polymul(low_pass, target), [1.0])))


class Analysis(NamedTuple):
    """What the loop of a controller and the low pass of its estimator does; `analyse` computes it.

    Attributes
    ----------
    margins : Margins
    overshoot : float
        Of a unit step, relative.
    settling_time : float, s
        After which a unit step stays within 2 %.  Both are inf where the loop is unstable or still rings after 30
        periods of its crossover.
    bandwidth : float, Hz
        -3 dB frequency of the closed loop T.
    ripple : float
        ``|C L/(1 + C L P)|`` at twice the lowest carrier frequency, P plant and delay: the demodulator's image that
        reaches the drive amplitude, relative to it.
    """

    margins: Margins
    overshoot: float
    settling_time: float
    bandwidth: float
    ripple: float


def analyse(
    controller: TransferFunction,
    low_pass: TransferFunction,
    *,
    delay: float = 0.0,
    amplitude_pole: float | None = None,
    lowest_frequency: float = 20.0,
) -> Analysis:
    """Compute margins and step response of the amplitude (or phase) loop.

    Parameters
    ----------
    controller, low_pass : TransferFunction
        C, and the estimator's L.
    delay : float
        Known delay of the loop beside them, s, >= 0.
    amplitude_pole : float, optional
        Pole of the plant's amplitude, Hz: f0/2Q of a mode driven at its resonance f0.  By default the amplitude follows
        the drive at once.
    lowest_frequency : float
        Lowest carrier, Hz: where the ripple is largest.

    Notes
    -----
    The step is summed from harmonics: exact to 5e-5 where T falls off with one pole only.
    """
    pole = 2 * np.pi * (amplitude_pole or inf)
    plant = TransferFunction((1.0,), (1.0,)) if amplitude_pole is None else TransferFunction((pole,), (1.0, pole))
    found = loop_margins(controller * low_pass * plant, delay)

    def closed(frequency: Any) -> Any:
        s = 2j * np.pi * np.asarray(frequency, float)
        forward = (controller * plant)(s) * np.exp(-delay * s)
        return forward / (1 + forward * low_pass(s))

    frequency = np.geomspace(1e-3, 1e3, 200_001)
    index = np.arange(frequency.size)
    gain = np.abs((controller * low_pass * plant).frequency_response(frequency))
    crossover = np.interp(zero_crossings(np.log(gain)).min(), index, frequency)
    overshoot, settling_time = _step_figures(closed, 40 / crossover) if found.stable else (inf, inf)
    edge = zero_crossings(np.abs(closed(frequency)) - sqrt(0.5))
    image = 2 * lowest_frequency
    return Analysis(
        found,
        overshoot,
        settling_time,
        bandwidth=float(np.min(np.interp(edge, index, frequency), initial=inf)),
        ripple=float(np.abs(closed(image) * low_pass.frequency_response(image) / plant.frequency_response(image))),
    )


def _step_figures(closed: Callable[[Array], Array], duration: float) -> tuple[float, float]:
    """Overshoot and 2 % settling time (s) of the unit step response of `closed` within `duration` (s).

    The step is half a period of a square wave from -1 to 1, summed from its harmonics, so that a delay costs nothing.
    Both figures are inf where the last quarter of that half period still leaves the 2 %.
    """
    samples = 2**17
    harmonic = np.arange(1, samples // 2, 2)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonic] = -2j * samples / (np.pi * harmonic) * closed(harmonic / (2 * duration))
    response = (1 + np.fft.irfft(spectrum)[: samples // 2]) / 2
    outside = np.abs(response - 1) - 0.02
    if outside[-samples // 8 :].max() > 0:
        return inf, inf
    last = np.max(zero_crossings(outside), initial=0.0)
    return float(max(0.0, response.max() - 1)), float(last * 2 * duration / samples)
