"""The paper's loop shaping: transfer functions, exact and reduced controller, margins, and what a loop does beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control import loopshape
from hapticrender.control.margins import Margins, margins_of, unstable_poles
from hapticrender.mathx import zero_crossings

Array = np.ndarray[Any, Any]
BESIDE = 1e-6  # 1/s: distance of Nyquist's contour from the imaginary axis, right of the integrator


@dataclass(frozen=True)
class TransferFunction:
    """A proper rational function of s, ``numerator(s)/denominator(s)``.

    Coefficients are in descending powers of s (rad/s), kept as tuples and scaled so that the denominator is monic;
    common factors stay.  A denominator that is zero, or of lower order than the numerator, is a ValueError.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def __post_init__(self) -> None:
        above, below = (np.trim_zeros(np.array(each, float), "f") for each in (self.numerator, self.denominator))
        if not below.size or above.size > below.size:
            raise ValueError(f"denominator of order {below.size - 1} must be >= the numerator's, {above.size - 1}")
        object.__setattr__(self, "numerator", tuple((above / below[0]).tolist()))
        object.__setattr__(self, "denominator", tuple((below / below[0]).tolist()))

    def __call__(self, s: Any) -> Any:
        """Value at complex `s` (rad/s)."""
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s)

    def __mul__(self, other: TransferFunction) -> TransferFunction:
        return TransferFunction(
            tuple(np.polymul(self.numerator, other.numerator)), tuple(np.polymul(self.denominator, other.denominator))
        )

    def poles(self) -> Array:
        """Poles (rad/s, complex)."""
        return np.roots(self.denominator)

    def frequency_response(self, frequency: Any) -> Any:
        """Complex response at `frequency` (Hz)."""
        return self(2j * np.pi * np.asarray(frequency, float))


def butterworth(bandwidth: float) -> TransferFunction:
    """Second-order Butterworth low pass, ``w^2/(s^2 + sqrt2 w s + w^2)``, -3 dB at `bandwidth` w/(2 pi) (Hz, > 0)."""
    w = 2 * np.pi * bandwidth
    return TransferFunction((w**2,), (1.0, sqrt(2) * w, w**2))


def second_order_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Return the second-order controller that makes the closed loop nearly a Butterworth T (bandwidths in Hz)."""
    gain, pole = loopshape.reduced_controller(loop_bandwidth, filter_bandwidth)
    return TransferFunction((gain * pole,), (1.0, pole, 0.0))


def loop_margins(rational: TransferFunction, delay: float = 0.0) -> Margins:
    """Compute the margins of the loop L C of one envelope: `rational`, stable but for integrators, and a `delay` (s).

    They come from a logarithmic grid of 20001 frequencies; linear interpolation between them errs by less than 1e-6.
    """

    def loop(s: Array) -> Any:
        return rational(s) * np.exp(-delay * s)

    polynomials = rational.numerator, rational.denominator, np.polyadd(rational.numerator, rational.denominator)
    corners = np.abs(np.concatenate([np.roots(polynomial) for polynomial in polynomials])) / (2 * np.pi)
    corners = corners[corners > 1e-9 * corners.max()]  # of the open and the closed loop
    frequency = np.geomspace(1e-3 * corners.min(), 1e3 * corners.max(), 20001)
    if unstable_poles(lambda f: 1 + loop(BESIDE + 2j * np.pi * f), np.append(0.0, frequency)):
        return Margins.unstable()
    return margins_of(lambda f: loop(2j * np.pi * f)[:, None, None], frequency)


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
