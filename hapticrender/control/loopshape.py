"""Loop shaping: from the wanted closed loop T and the estimator's low pass L to a controller C and its margins.

The loop is the paper's: the error between the reference and L times the
amplitude (or phase) drives C, and C drives the plant, whose look-up table
makes it 1.  So ``T = C/(1 + L C)`` and ``C = T/(1 - L T)``; the sensitivity is
``S = 1/(1 + L C) = 1 - L T``.  (The paper calls T the sensitivity function; it
is the response from reference to output.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, inf, radians, sqrt
from typing import Any, Literal

import numpy as np

from hapticrender.control.transfer import TransferFunction, butterworth, require_positive
from hapticrender.errors import DesignError
from hapticrender.protocols import Array

FORMS = ("exact", "reduced", "integrator")


def exact_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Solve for the controller that makes the closed loop exactly T, in its least order, four.

    Parameters
    ----------
    loop_bandwidth, filter_bandwidth : float
        Bandwidths of the Butterworth T and L, Hz.

    Returns
    -------
    TransferFunction
        ``C = l/(l t - 1)`` with l and t the denominators of L and T scaled to
        1 at s = 0.  One pole lies at 0.

    Notes
    -----
    The paper's sixth order comes from polynomial arithmetic on T/(1 - L T),
    which carries the poles of T along as an uncancelled pair.
    """
    low_pass, wanted = (
        np.divide(block.denominator, block.denominator[-1])
        for block in (butterworth(filter_bandwidth), butterworth(loop_bandwidth))
    )
    return TransferFunction(tuple(low_pass), tuple(np.polysub(np.polymul(low_pass, wanted), [1.0])))


def reduced_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Reduce `exact_controller` to second order, ``C2 = ki p/(s (s + p))``.

    Parameters
    ----------
    loop_bandwidth, filter_bandwidth : float
        Bandwidths of the Butterworth T and L, Hz; the loop's must be the smaller.

    Returns
    -------
    TransferFunction
        With ``ki = wT wL/(sqrt2 (wT + wL))`` and ``p = sqrt2 wT wL/(wL - wT)``.

    Raises
    ------
    DesignError
        Where the filter is not faster than the loop: p would not be a stable pole.

    Notes
    -----
    It matches three moments of s C at s = 0; for any Butterworth pair that
    reduction has no zero, hence the closed form.
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
class Margins:
    """What a loop can bear and how it answers a step; `margins` computes it.

    Attributes
    ----------
    stable : bool
        Whether the closed loop is stable (Nyquist count).
    phase_margin : float, rad
        Smallest phase left to -180 degrees where |L C| = 1.
    gain_margin : float
        Smallest factor on the gain that makes the loop unstable.
    peak_sensitivity : float
        Ms, the largest |S|: the inverse distance of L C from -1.
    delay_margin : float, s
        Smallest further delay that makes the loop unstable.
    overshoot : float
        Of a unit step, relative.
    settling_time : float, s
        After which a unit step stays within 2 %.  Both are inf where the loop
        is unstable or still rings after 30 periods of its crossover.
    bandwidth : float, Hz
        -3 dB frequency of the closed loop T.
    ripple : float
        ``|C L/(1 + C L P)|`` at twice the lowest carrier frequency, P plant and
        delay: the demodulator's image that reaches the drive amplitude,
        relative to it.  With P = 1 this is |T L|.
    """

    stable: bool
    phase_margin: float
    gain_margin: float
    peak_sensitivity: float
    delay_margin: float
    overshoot: float
    settling_time: float
    bandwidth: float
    ripple: float

    def __str__(self) -> str:
        return (
            f"{'stable' if self.stable else 'unstable'}: phase margin {degrees(self.phase_margin):.1f} deg, "
            f"gain margin {self.gain_margin:.2f}, Ms {self.peak_sensitivity:.3f}, "
            f"delay margin {1e3 * self.delay_margin:.1f} ms, overshoot {100 * self.overshoot:.1f} %, "
            f"settling {self.settling_time:.3f} s, bandwidth {self.bandwidth:.2f} Hz, ripple {100 * self.ripple:.3f} %"
        )


def margins(
    controller: TransferFunction,
    low_pass: TransferFunction,
    *,
    delay: float = 0.0,
    amplitude_pole: float | None = None,
    lowest_frequency: float = 20.0,
) -> Margins:
    """Margins and step response of the amplitude (or phase) loop.

    Parameters
    ----------
    controller, low_pass : TransferFunction
        C, and the estimator's L.
    delay : float
        Known delay of the loop beside them, s, >= 0.
    amplitude_pole : float, optional
        Pole of the plant's amplitude, Hz: f0/2Q of a mode driven at its
        resonance f0.  By default the amplitude follows the drive at once.
    lowest_frequency : float
        Lowest carrier, Hz: where the ripple is largest.

    Returns
    -------
    Margins

    Raises
    ------
    ValueError
        For an argument out of bounds, and where |L C| never crosses 1 (a
        controller without integrator may have no margins).

    Notes
    -----
    Everything is read off one logarithmic grid of 20001 frequencies; linear
    interpolation between them errs by less than 1e-6.  The step is summed
    from harmonics: exact to 5e-5 where T falls off with one pole only.
    """
    require_positive(lowest_frequency=lowest_frequency)
    if not (np.isfinite(delay) and delay >= 0):
        raise ValueError(f"{delay=} s must be finite and >= 0")
    plant = TransferFunction((1.0,), (1.0,)) if amplitude_pole is None else _one_pole(amplitude_pole)
    rational = controller * low_pass * plant

    def closed(frequency: Any) -> Any:
        forward = (controller * plant).frequency_response(frequency) * np.exp(-2j * np.pi * delay * frequency)
        return forward / (1 + forward * low_pass.frequency_response(frequency))

    frequency = _grid(rational)
    loop = rational.frequency_response(frequency)
    phase = np.unwrap(np.angle(loop)) - 2 * np.pi * delay * frequency
    difference = 1 + np.abs(loop) * np.exp(1j * phase)
    index = np.arange(frequency.size)

    crossover = _crossings(np.log(np.abs(loop)))
    if crossover.size == 0:
        raise ValueError(f"the loop gain never crosses 1 (largest {np.abs(loop).max():.3g}): no margins to speak of")
    crossover_frequency = np.interp(crossover, index, frequency)
    phase_margin = np.pi + np.interp(crossover, index, phase)
    reversal = _crossings(np.sin(phase))
    reversal = reversal[np.cos(phase[reversal.astype(int)]) < 0]
    reversal_gain = np.exp(np.interp(reversal, index, np.log(np.abs(loop))))
    edge = _crossings(np.abs(closed(frequency)) - sqrt(0.5))

    stable = _unstable_poles(rational, difference) == 0
    overshoot, settling_time = _step_figures(closed, 40 / crossover_frequency.min()) if stable else (inf, inf)
    image = 2 * lowest_frequency
    return Margins(
        stable=stable,
        phase_margin=float(phase_margin.min()),
        gain_margin=float(np.min(1 / reversal_gain, initial=inf)),
        peak_sensitivity=float(np.max(1 / np.abs(difference))),
        delay_margin=float(np.min(phase_margin / (2 * np.pi * crossover_frequency))),
        overshoot=overshoot,
        settling_time=settling_time,
        bandwidth=float(np.min(np.interp(edge, index, frequency), initial=inf)),
        ripple=float(np.abs(closed(image) * low_pass.frequency_response(image) / plant.frequency_response(image))),
    )


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


def _crossings(values: Array) -> Array:
    """Fractional indices at which `values` cross zero."""
    before = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return before + values[before] / (values[before] - values[before + 1])


def _unstable_poles(loop: TransferFunction, difference: Array) -> int:
    """Closed-loop poles in the right half plane, by Nyquist's count on `difference` = 1 + L C over all frequencies."""
    poles = loop.poles()
    at_zero = np.abs(poles) <= 1e-9 * np.abs(poles).max()
    angle = np.unwrap(np.angle(difference))
    turned = angle[-1] - angle[0]
    return int(np.round(np.sum(poles[~at_zero].real > 0) + at_zero.sum() / 2 - turned / np.pi))


def _step_figures(closed: Callable[[Array], Array], duration: float) -> tuple[float, float]:
    """Overshoot and 2 % settling time (s) of the unit step response of `closed` within `duration` (s).

    The step is half a period of a square wave from -1 to 1, summed from its
    harmonics, so that a delay costs nothing.  Both figures are inf where the
    last quarter of that half period still leaves the 2 %.
    """
    samples = 2**17
    harmonic = np.arange(1, samples // 2, 2)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonic] = -2j * samples / (np.pi * harmonic) * closed(harmonic / (2 * duration))
    response = (1 + np.fft.irfft(spectrum)[: samples // 2]) / 2
    outside = np.abs(response - 1) - 0.02
    if outside[-samples // 8 :].max() > 0:
        return inf, inf
    return float(max(0.0, response.max() - 1)), float(np.max(_crossings(outside), initial=0.0) * 2 * duration / samples)


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Margins that `design` insists on.

    Parameters
    ----------
    phase_margin : float, rad
        Least phase margin, by default 45 degrees.
    gain_margin : float
        Least gain margin, by default 2.5.
    peak_sensitivity : float
        Largest Ms, by default 1.8.
    ripple : float
        Largest ripple of the drive at the lowest carrier; the paper's 0.5 %.
    """

    phase_margin: float = radians(45)
    gain_margin: float = 2.5
    peak_sensitivity: float = 1.8
    ripple: float = 0.005

    def check(self, found: Margins, remedy: str) -> None:
        """Raise `DesignError`, naming the margin and the `remedy`, at the first bound that `found` breaks."""
        image = "lower filter_bandwidth or loop_bandwidth, or raise lowest_frequency"
        rules = (
            (found.stable, "the closed loop is unstable", remedy),
            (
                found.phase_margin >= self.phase_margin,
                f"phase margin {degrees(found.phase_margin):.1f} deg is below {degrees(self.phase_margin):.1f} deg",
                remedy,
            ),
            (
                found.gain_margin >= self.gain_margin,
                f"gain margin {found.gain_margin:.2f} is below {self.gain_margin:.2f}",
                remedy,
            ),
            (
                found.peak_sensitivity <= self.peak_sensitivity,
                f"peak sensitivity Ms {found.peak_sensitivity:.2f} is above {self.peak_sensitivity:.2f}",
                remedy,
            ),
            (found.ripple <= self.ripple, f"ripple {found.ripple:.2%} is above {self.ripple:.2%}", image),
        )
        for kept, complaint, cure in rules:
            if not kept:
                raise DesignError(f"{complaint}: {cure}")


@dataclass(frozen=True, kw_only=True)
class Design:
    """A controller, the low pass that it was designed for, and the margins of the two."""

    controller: TransferFunction
    low_pass: TransferFunction
    margins: Margins


def design(
    loop_bandwidth: float = 5.0,
    filter_bandwidth: float = 10.0,
    form: Literal["exact", "reduced", "integrator"] = "exact",
    lowest_frequency: float = 20.0,
    *,
    delay: float = 0.0,
    amplitude_pole: float | None = None,
    bounds: Bounds | None = None,
) -> Design:
    """Design the amplitude (or phase) loop and refuse it where its margins are too small.

    Parameters
    ----------
    loop_bandwidth : float
        Bandwidth of the closed loop T, Hz, at most a quarter of `lowest_frequency`.
    filter_bandwidth : float
        Bandwidth of the estimator's low pass L, Hz, at most half of `lowest_frequency`.
    form : {"exact", "reduced", "integrator"}
        Fourth-order C, its second-order reduction, or a plain integrator of
        gain 3.4 loop_bandwidth (17 1/s at 5 Hz: with L at 10 Hz the largest
        whole gain whose step does not overshoot).
    lowest_frequency : float
        Lowest carrier of the scene, Hz.
    delay : float
        Known delay of the loop, s.
    amplitude_pole : float, optional
        Pole of the plant's amplitude, Hz (f0/2Q at a resonance f0); C then
        carries the zero that cancels it.
    bounds : Bounds, optional
        What margins to insist on.

    Returns
    -------
    Design

    Raises
    ------
    DesignError
        Where a bandwidth breaks the paper's rule or a margin its bound: names
        it, its value and bound, and what to change.
    ValueError
        For an argument that no design could accept.

    Notes
    -----
    The rules on the bandwidths ("Computing filter and control dynamics") keep
    the image of the demodulator at 2 f0 out of the drive: with both low
    passes far below it the ripple is ``(rL rT/4)^2``, rL = fL/f0, rT = fT/f0.
    The paper's 0.5 % alone would allow rL rT < 0.283; its rules allow 0.125.
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
    low_pass = butterworth(filter_bandwidth)
    found = margins(controller, low_pass, delay=delay, amplitude_pole=amplitude_pole, lowest_frequency=lowest_frequency)
    remedies = [f"lower {loop_bandwidth=} Hz"]
    remedies += [f"raise {filter_bandwidth=} Hz"] if form == "integrator" else []
    remedies += [f"lower {delay=} s"] if delay else []
    (bounds or Bounds()).check(found, " or ".join(remedies))
    return Design(controller=controller, low_pass=low_pass, margins=found)


def _check_share(name: str, bandwidth: float, lowest_frequency: float, share: int) -> None:
    """Refuse a bandwidth above 1/share of the lowest carrier, with room for rounding."""
    bound = lowest_frequency / share
    if bandwidth > bound * (1 + 1e-12):
        raise DesignError(
            f"{name} {bandwidth:g} Hz is above lowest_frequency/{share} = {bound:g} Hz: the demodulator's image at "
            f"twice the carrier would reach the drive; lower {name} or raise lowest_frequency"
        )
