"""Loop shaping: from a given closed loop T and the estimator's low pass L to a controller C.

The loop is that of Grigorii et al. 2021: the error between the reference and L times the amplitude (or phase) drives C,
and C drives the plant, whose look-up table makes it 1 (docs/theory.md, "Loop shaping").  So ``T = C/(1 + L C)`` and
``C = T/(1 - L T)``; the sensitivity is ``S = 1/(1 + L C) = 1 - L T``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any, Literal

import numpy as np

from hapticrender.control.margins import LEAST, LeastMargins, Margins, margins_of, unstable_poles
from hapticrender.control.transfer import TransferFunction, butterworth, require_positive
from hapticrender.errors import DesignError
from hapticrender.mathx import zero_crossings
from hapticrender.protocols import Array

FORMS = ("exact", "reduced", "integrator")
BESIDE = 1e-6  # 1/s: distance of Nyquist's contour from the imaginary axis, right of the integrator
RIPPLE = 0.005  # largest ripple of the drive at the lowest carrier (Grigorii et al. 2021)


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


def reduced_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Reduce `exact_controller` to second order, ``C2 = ki p/(s (s + p))``.

    Parameters
    ----------
    loop_bandwidth, filter_bandwidth : float
        Bandwidths of the Butterworth T and L, Hz; the loop's must be the smaller.

    Raises
    ------
    DesignError
        Where the filter is not faster than the loop: p would not be a stable pole.

    Notes
    -----
    ``ki = wT wL/(sqrt2 (wT + wL))``, ``p = sqrt2 wT wL/(wL - wT)``: three moments of s C match at s = 0.
    """
    require_positive(loop_bandwidth=loop_bandwidth, filter_bandwidth=filter_bandwidth)
    if filter_bandwidth <= loop_bandwidth:
        raise DesignError(
            f"the second-order controller needs a filter faster than the loop: raise {filter_bandwidth=} Hz "
            f"above {loop_bandwidth=} Hz, or choose form='exact'"
        )
    wt, wl = 2 * np.pi * loop_bandwidth, 2 * np.pi * filter_bandwidth
    gain, pole = wt * wl / (sqrt(2) * (wt + wl)), sqrt(2) * wt * wl / (wl - wt)
    return TransferFunction((gain * pole,), (1.0, pole, 0.0))


def integrator(gain: float) -> TransferFunction:
    """Make the plainest controller, ``C = gain/s`` with `gain` in 1/s."""
    require_positive(gain=gain)
    return TransferFunction((gain,), (1.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Design:
    """A controller with the low pass of its estimator, and what the loop of the two does; `analyse` computes it.

    Attributes
    ----------
    controller, low_pass : TransferFunction
        C and L.
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
        reaches the drive amplitude, relative to it.  With P = 1 this is |T L|.
    """

    controller: TransferFunction
    low_pass: TransferFunction
    margins: Margins
    overshoot: float
    settling_time: float
    bandwidth: float
    ripple: float

    def __str__(self) -> str:
        return (
            f"{self.margins}, overshoot {100 * self.overshoot:.1f} %, settling {self.settling_time:.3f} s, "
            f"bandwidth {self.bandwidth:.2f} Hz, ripple {100 * self.ripple:.3f} %"
        )


def analyse(
    controller: TransferFunction,
    low_pass: TransferFunction,
    *,
    delay: float = 0.0,
    amplitude_pole: float | None = None,
    lowest_frequency: float = 20.0,
) -> Design:
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

    Raises
    ------
    ValueError
        For an argument out of bounds, and where |L C| never crosses 1.

    Notes
    -----
    Margins come from a logarithmic grid of 20001 frequencies; linear interpolation between them errs by less than 1e-6.
    The step is summed from harmonics: exact to 5e-5 where T falls off with one pole only.
    """
    require_positive(lowest_frequency=lowest_frequency)
    if not (np.isfinite(delay) and delay >= 0):
        raise ValueError(f"{delay=} s must be finite and >= 0")
    plant = TransferFunction((1.0,), (1.0,)) if amplitude_pole is None else _one_pole(amplitude_pole)
    rational = controller * low_pass * plant

    def loop(s: Array) -> Any:
        return rational(s) * np.exp(-delay * s)

    def closed(frequency: Any) -> Any:
        s = 2j * np.pi * np.asarray(frequency, float)
        forward = (controller * plant)(s) * np.exp(-delay * s)
        return forward / (1 + forward * low_pass(s))

    frequency = _grid(rational)
    gain = np.abs(rational.frequency_response(frequency))
    crossover = zero_crossings(np.log(gain))
    if crossover.size == 0:
        raise ValueError(f"the loop gain never crosses 1 (largest {gain.max():.3g}): the loop has no margins")
    index = np.arange(frequency.size)
    outside = int(np.sum(rational.poles().real > BESIDE))
    if unstable_poles(lambda f: 1 + loop(BESIDE + 2j * np.pi * f), np.append(0.0, frequency), outside):
        found, overshoot, settling_time = Margins.unstable(), inf, inf
    else:
        found = margins_of(lambda f: loop(2j * np.pi * f)[:, None, None], frequency)
        overshoot, settling_time = _step_figures(closed, 40 / np.interp(crossover.min(), index, frequency))
    edge = zero_crossings(np.abs(closed(frequency)) - sqrt(0.5))
    image = 2 * lowest_frequency
    return Design(
        controller=controller,
        low_pass=low_pass,
        margins=found,
        overshoot=overshoot,
        settling_time=settling_time,
        bandwidth=float(np.min(np.interp(edge, index, frequency), initial=inf)),
        ripple=float(np.abs(closed(image) * low_pass.frequency_response(image) / plant.frequency_response(image))),
    )


margins = analyse  # removed with the old kernels


def _one_pole(frequency: float) -> TransferFunction:
    """``a/(s + a)`` with a = 2 pi `frequency` (Hz)."""
    require_positive(amplitude_pole=frequency)
    return TransferFunction((2 * np.pi * frequency,), (1.0, 2 * np.pi * frequency))


def _grid(loop: TransferFunction) -> Array:
    """Frequencies (Hz) from far below to far above every corner of the open and the closed loop."""
    polynomials = loop.numerator, loop.denominator, np.polyadd(loop.numerator, loop.denominator)
    corners = np.abs(np.concatenate([np.roots(polynomial) for polynomial in polynomials])) / (2 * np.pi)
    corners = corners[corners > 1e-9 * corners.max()]
    return np.geomspace(1e-3 * corners.min(), 1e3 * corners.max(), 20001)


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


def design(
    loop_bandwidth: float = 5.0,
    filter_bandwidth: float = 10.0,
    form: Literal["exact", "reduced", "integrator"] = "exact",
    lowest_frequency: float = 20.0,
    *,
    delay: float = 0.0,
    amplitude_pole: float | None = None,
    least: LeastMargins = LEAST["envelope"],
) -> Design:
    """Design the amplitude (or phase) loop and refuse it where its margins are too small.

    Parameters
    ----------
    loop_bandwidth : float
        Bandwidth of the closed loop T, Hz, at most a quarter of `lowest_frequency`.
    filter_bandwidth : float
        Bandwidth of the estimator's low pass L, Hz, at most half of `lowest_frequency`.
    form : {"exact", "reduced", "integrator"}
        Fourth-order C, its second-order reduction, or a plain integrator of gain 3.4 loop_bandwidth (17 1/s at 5 Hz:
        with L at 10 Hz the largest whole gain whose step does not overshoot).
    lowest_frequency : float
        Lowest carrier of the scene, Hz.
    delay : float
        Known delay of the loop, s.
    amplitude_pole : float, optional
        Pole of the plant's amplitude, Hz (f0/2Q at a resonance f0); C then carries the zero that cancels it.
    least : LeastMargins

    Raises
    ------
    DesignError
        Where a bandwidth breaks the paper's rule, or a margin or the ripple its bound: names it, its value and bound,
        and what to change.
    ValueError
        For an argument that no design could accept.
    """
    if form not in FORMS:
        raise ValueError(f"{form=} must be one of {', '.join(FORMS)}")
    require_positive(
        loop_bandwidth=loop_bandwidth, filter_bandwidth=filter_bandwidth, lowest_frequency=lowest_frequency
    )
    _check_share("loop_bandwidth", loop_bandwidth, lowest_frequency, 4)
    _check_share("filter_bandwidth", filter_bandwidth, lowest_frequency, 2)
    if form == "integrator":
        controller = integrator(3.4 * loop_bandwidth)
    else:
        controller = (exact_controller if form == "exact" else reduced_controller)(loop_bandwidth, filter_bandwidth)
    if amplitude_pole is not None:
        inverse = np.divide(_one_pole(amplitude_pole).denominator, 2 * np.pi * amplitude_pole)
        controller = TransferFunction(tuple(np.polymul(controller.numerator, inverse)), controller.denominator)
    found = analyse(
        controller,
        butterworth(filter_bandwidth),
        delay=delay,
        amplitude_pole=amplitude_pole,
        lowest_frequency=lowest_frequency,
    )
    remedies = [f"lower {loop_bandwidth=} Hz"]
    remedies += [f"raise {filter_bandwidth=} Hz"] if form == "integrator" else []
    remedies += [f"lower {delay=} s"] if delay else []
    if complaint := least.complaint(found.margins):
        raise DesignError(f"{complaint}: {' or '.join(remedies)}")
    if found.ripple > RIPPLE:
        raise DesignError(
            f"ripple {found.ripple:.2%} is above {RIPPLE:.2%}: lower filter_bandwidth or loop_bandwidth, or raise "
            "lowest_frequency"
        )
    return found


def _check_share(name: str, bandwidth: float, lowest_frequency: float, share: int) -> None:
    """Refuse a bandwidth above 1/share of the lowest carrier, with room for rounding."""
    bound = lowest_frequency / share
    if bandwidth > bound * (1 + 1e-12):
        raise DesignError(
            f"{name} {bandwidth:g} Hz is above lowest_frequency/{share} = {bound:g} Hz: the demodulator's image at "
            f"twice the carrier would reach the drive; lower {name} or raise lowest_frequency"
        )
