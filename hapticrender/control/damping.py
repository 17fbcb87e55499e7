"""Active damping at sample rate: taps on the deviation that act like a damper at each mode, delay included.

The loop of each coordinate is P z^-delay C, with P the mode behind a
zero-order hold (and what a bending mode of the surface adds to it), and
``C = sum c_i z^-i``.  Ideal mode by mode; the margins say what delay and rate
leave of it, and `choose_damping` designs by them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.protocols import Array

TAPS = 3
QUALITY, QUALITY_UNMEASURED = 1.4, 2.0  # the least Q, with the bending mode known and while it is not
QUALITY_STEP = 0.1
WORTH = 4.0  # the damper is switched off where it cannot add so many times the mode's own damping
LEAST_RATIO = 1e-4  # damping ratio that margins assume at least, so that an ideal mode has a finite peak
BAR_SPANS = (0.6, 0.7, 0.8, 0.9, 1.0)  # of a bending period: how long notched taps may reach back


@dataclass(frozen=True, kw_only=True)
class BendingMode:
    """A mode of the surface beyond the controlled coordinates, as the loop sees it.

    Parameters
    ----------
    frequency : float, Hz
        Where it lies, > 0.
    damping : float
        Its damping ratio, >= 0.
    coupling : tuple of float, 1/kg
        For each coordinate, acceleration that the sensors show per force, short
        of the restoring force: shape at the sensors times shape at the drive
        over modal mass.  Negative where sensors and drive move apart.
    spread : float, Hz
        How far off `frequency` it may lie, >= 0.
    measured : bool
        False for an estimate: then the coupling may have either sign, and Q stays at 2 or above.
    """

    frequency: float
    damping: float
    coupling: tuple[float, ...]
    spread: float = 100.0
    measured: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.frequency) and self.frequency > 0):
            raise ValueError(f"frequency = {self.frequency!r}: must be > 0 Hz")
        if not (math.isfinite(self.damping) and self.damping >= 0):
            raise ValueError(f"damping = {self.damping!r}: must be >= 0")
        if not 0 <= self.spread < self.frequency:
            raise ValueError(f"spread = {self.spread!r}: must be between 0 and {self.frequency:g} Hz")

    def corners(self) -> tuple[BendingMode, ...]:
        """Return the mode at either end of its spread, and with either sign where it is an estimate."""
        return tuple(
            replace(self, frequency=self.frequency + shift, coupling=tuple(sign * each for each in self.coupling))
            for sign in ((1,) if self.measured else (1, -1))
            for shift in (-self.spread, self.spread)
        )


@dataclass(frozen=True, kw_only=True)
class DampingMargins:
    """What the inner loop of one coordinate can bear; `damping_margins` computes it.

    Attributes
    ----------
    stable : bool
        Whether the closed loop is stable (Nyquist count); where it is not, there are no margins.
    peak_sensitivity : float
        Ms, the largest 1/abs(1 + L).
    gain_margin : float
        Smallest factor above 1 on the gain that makes the loop unstable.
    phase_margin : float, rad
        Smallest turn, forwards or back, that brings L to -1 where abs(L) = 1.
    delay_margin : float, s
        Smallest further delay that makes the loop unstable.
    noise : float
        Motion that white noise of the sensors causes, rms of the coordinate per rms of each sensor.
    """

    stable: bool
    peak_sensitivity: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    noise: float

    def __str__(self) -> str:
        if not self.stable:
            return "unstable"
        return (
            f"Ms {self.peak_sensitivity:.2f}, gain margin {self.gain_margin:.1f}, "
            f"phase margin {math.degrees(self.phase_margin):.0f} deg, delay margin {1e3 * self.delay_margin:.2f} ms, "
            f"noise {self.noise:.2f} um per um of sensor noise"
        )


@dataclass(frozen=True, kw_only=True)
class Damping:
    """An inner loop, or the reason why there is none; `choose_damping` makes it.

    Attributes
    ----------
    taps : ndarray, shape (coordinates, n), N/m
        Zero where the loop is off.
    grip : ndarray, shape (coordinates,), N s/m
        Damping that the taps add at each mode.
    quality : float
        Q of each mode with its damper; inf where the loop is off.
    margins : tuple of DampingMargins
        One a coordinate; none where the loop is off.
    note : str
        What was chosen, and why.
    """

    taps: Array
    grip: Array
    quality: float
    margins: tuple[DampingMargins, ...]
    note: str

    def text(self) -> str:
        """Return the note and a line of margins for each coordinate."""
        lines = [f"  coordinate {i + 1}: {margins}" for i, margins in enumerate(self.margins)]
        return "\n".join([f"inner loop {self.note}", *lines])


@dataclass(frozen=True, kw_only=True)
class DampingBounds:
    """Margins that `choose_damping` insists on in every coordinate.

    Parameters
    ----------
    peak_sensitivity : float
        Largest Ms.
    gain_margin : float
        Least gain margin.
    phase_margin : float, rad
        Least phase margin, by default 60 degrees.
    delay_margin : float, samples
        Least delay margin.
    astray : float
        Largest Ms with the bending mode at either end of its spread: the surface may ring there, not grow.
    """

    peak_sensitivity: float = 1.7
    gain_margin: float = 2.5
    phase_margin: float = math.radians(60)
    delay_margin: float = 1.0
    astray: float = 5.0

    def complaint(self, found: DampingMargins, rate: float) -> str:
        """Return the first bound that `found` breaks at `rate` (Hz), empty where it breaks none."""
        if not found.stable:
            return "the loop unstable"
        rules = (
            (
                found.gain_margin >= self.gain_margin,
                f"a gain margin of {found.gain_margin:.2f} (least {self.gain_margin:g})",
            ),
            (
                found.peak_sensitivity <= self.peak_sensitivity,
                f"Ms {found.peak_sensitivity:.2f} (largest {self.peak_sensitivity:g})",
            ),
            (
                found.phase_margin >= self.phase_margin,
                f"a phase margin of {math.degrees(found.phase_margin):.0f} deg "
                f"(least {math.degrees(self.phase_margin):.0f})",
            ),
            (
                found.delay_margin * rate >= self.delay_margin,
                f"a delay margin of {found.delay_margin * rate:.2f} samples (least {self.delay_margin:g})",
            ),
        )
        return next((text for kept, text in rules if not kept), "")


def modes_of(model: BandModel) -> tuple[Array, Array]:
    """Mode (rad/s) and damping ratio of each coordinate taken alone."""
    mass, damping, stiffness = model.mass.diagonal(), model.damping.diagonal(), model.stiffness.diagonal()
    mode = np.sqrt(stiffness / mass)
    return mode, damping / (2 * mass * mode)


def damping_taps(
    model: BandModel, quality: float, *, bending: BendingMode | None = None, count: int | None = None
) -> tuple[Array, Array]:
    """Taps of the inner loop and the damping that they add, coordinate by coordinate.

    Parameters
    ----------
    model : BandModel
        The free device; each coordinate's mode is sqrt(stiffness/mass) of its diagonal.
    quality : float
        Q of each mode with its damper, > 0.
    bending : BendingMode, optional
        The taps of the coordinates that it couples to carry a pair of zeros at it.
    count : int, optional
        How many taps, at least as many as there are equations: 3, or 5 with zeros, which is the default.

    Returns
    -------
    taps : ndarray, shape (coordinates, count), N/m
        F = -(c0 eps[n] + c1 eps[n-1] + ...).
    grip : ndarray, shape (coordinates,), N s/m
        Added damping m w1/Q at each mode w1.

    Raises
    ------
    ValueError
        Quality is not positive, or the taps are too few.

    Notes
    -----
    Three linear equations (FACTS section 3 A): sum c_i = 0, so that the sag is left alone, and
    sum c_i e^(-j w1 i T) = j w1 grip e^(j w1 (delay + 1/2) T)/sinc(w1 T/2), so that after delay and hold the force is
    that of a damper.  Two more with a bending mode w_b: sum c_i e^(-j w_b i T) = 0.  More taps than equations are the
    least in sum c_i^2, hence in noise; a coordinate without zeros uses three and leaves the others at zero.
    """
    least = TAPS if bending is None else TAPS + 2
    count = least if count is None else count
    if not quality > 0:
        raise ValueError(f"{quality=} must be > 0")
    if count < least:
        raise ValueError(f"{count=} taps: must be >= {least}, one an equation")
    mode, _ = modes_of(model)
    grip = model.mass.diagonal() * mode / quality
    wanted = 1j * mode * grip / model.hold_and_delay(mode / (2 * np.pi))
    taps = np.zeros((len(mode), count))
    for c, (omega, force) in enumerate(zip(mode, wanted, strict=True)):
        notched = bending is not None and bending.coupling[c] != 0.0
        equations = [(0.0, 0.0), (omega / model.rate, force)]
        if bending is not None and notched:
            equations.append((2 * np.pi * bending.frequency / model.rate, 0.0))
        reach = count if notched else TAPS
        taps[c, :reach] = _least_taps(equations, reach)
    return taps, grip


def _least_taps(equations: Iterable[tuple[float, complex]], count: int) -> Array:
    """Taps of least norm whose response at each angle (rad a sample) is the value given with it."""
    order = np.arange(count)
    rows, values = [], []
    for angle, value in equations:
        turn = np.exp(-1j * angle * order)
        rows += [turn.real, turn.imag]
        values += [np.real(value), np.imag(value)]
    return np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]


def _held_mode(z: Array, rate: float, omega: float, ratio: float, push: float) -> Array:
    """Response at z (on the unit circle) of ``push/(s^2 + 2 ratio omega s + omega^2)`` behind a zero-order hold.

    By residues: each pole l gives r (e^(l T) - 1)/(l (z - e^(l T))) with r the residue of the continuous mode.
    """
    ratio = max(ratio, LEAST_RATIO)
    apart = np.sqrt(complex(ratio * ratio - 1.0)) or 1e-9  # a double pole is parted by a hair
    poles = omega * (-ratio + apart * np.array([1.0, -1.0]))
    residues = push / (poles - poles[::-1])
    grown = np.exp(poles / rate)
    return sum(r * (e - 1) / (pole * (z - e)) for r, e, pole in zip(residues, grown, poles, strict=True))


def _grid(model: BandModel, modes: Iterable[tuple[float, float]]) -> Array:
    """Frequencies (Hz) up to half the rate, dense at each mode (rad/s, damping ratio) and as fine as the delay asks."""
    half = model.rate / 2
    parts = [np.linspace(0.0, half, max(4096, 8 * (model.delay + 1)) + 1)]
    for omega, ratio in modes:
        hertz = omega / (2 * np.pi)
        near = hertz * (1 + max(ratio, LEAST_RATIO) * np.sinh(np.linspace(-9.0, 9.0, 1201)))
        parts.append(abs(near - model.rate * np.round(near / model.rate)))  # beyond half the rate it folds back
    frequency = np.unique(np.concatenate(parts))
    return frequency[frequency > 0]


def damping_margins(model: BandModel, taps: Array, *, bending: BendingMode | None = None) -> tuple[DampingMargins, ...]:
    """Margins of the inner loop, coordinate by coordinate.

    Parameters
    ----------
    model : BandModel
        The free device; the coupling between its coordinates is left out.
    taps : ndarray, shape (coordinates, n), N/m
        Of `damping_taps`.
    bending : BendingMode, optional
        A mode of the surface in the loop; its spread is not looked at.

    Returns
    -------
    tuple of DampingMargins
        One a coordinate.

    Notes
    -----
    L(z) = P(z) z^-delay sum c_i z^-i, exact in discrete time.  Frequencies are a grid that is dense at the modes;
    crossings are interpolated in it.  A finger on the plate changes Ms by less than 3 % (tested).
    """
    mode, ratio = modes_of(model)
    gain = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1))
    found = []
    for c in range(len(mode)):
        modes = [(float(mode[c]), float(ratio[c]), 1.0 / float(model.mass[c, c]))]
        if bending is not None and bending.coupling[c] != 0.0:
            modes.append((2 * np.pi * bending.frequency, bending.damping, bending.coupling[c]))
        frequency = _grid(model, [each[:2] for each in modes])
        z = np.exp(2j * np.pi * frequency / model.rate)
        plant = sum(_held_mode(z, model.rate, *each) for each in modes)
        loop = plant * z**-model.delay * np.polyval(taps[c, ::-1], 1 / z)
        found.append(_margins_of(frequency, loop, model.rate, float(gain[c])))
    return tuple(found)


def _margins_of(frequency: Array, loop: Array, rate: float, gain: float) -> DampingMargins:
    """Margins read off L on a grid from near 0 Hz to half the rate; `gain` takes sensor noise to the coordinate."""
    difference = 1 + loop
    peak = float((1 / abs(difference)).max())
    turns = np.angle(difference[1:] / difference[:-1]).sum() / np.pi
    if round(turns) != 0:  # the open loop is stable: any encirclement is an unstable pole
        return DampingMargins(
            stable=False, peak_sensitivity=peak, gain_margin=0.0, phase_margin=0.0, delay_margin=0.0, noise=math.inf
        )
    index = np.arange(frequency.size)
    at = _crossings(np.log(abs(loop)))
    crossover = np.interp(at, index, frequency)
    phase = np.angle(-np.interp(at, index, loop.real) - 1j * np.interp(at, index, loop.imag))
    reversal = _crossings(loop.imag)
    real = np.interp(reversal, index, loop.real)
    factors = -1 / real[real < 0]
    closed = abs(loop / difference) ** 2
    power = np.sum((closed[1:] + closed[:-1]) / 2 * np.diff(frequency)) / (rate / 2)
    return DampingMargins(
        stable=True,
        peak_sensitivity=peak,
        gain_margin=float(np.min(factors[factors > 1], initial=math.inf)),
        phase_margin=float(np.min(abs(phase), initial=math.inf)),
        delay_margin=float(np.min(np.mod(phase, 2 * np.pi) / (2 * np.pi * crossover), initial=math.inf)),
        noise=gain * math.sqrt(power),
    )


def _crossings(values: Array) -> Array:
    """Fractional indices at which `values` cross zero."""
    before = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return before + values[before] / (values[before] - values[before + 1])


def choose_damping(
    model: BandModel, *, bending: BendingMode | None = None, bounds: DampingBounds | None = None
) -> Damping:
    """Design the inner loop: the most damping whose margins hold, or none, and why.

    Parameters
    ----------
    model : BandModel
        The free device with its rate and delay.
    bending : BendingMode, optional
        The bending mode of the surface, which the taps then spare; once it is measured Q may go down to 1.4.
        Without it Q stays at 2 or above, and nothing is known of the surface's own modes.
    bounds : DampingBounds, optional
        What margins to insist on.

    Returns
    -------
    Damping

    Notes
    -----
    Q rises in steps of 0.1 until every coordinate keeps the bounds, with the bending mode where it was measured and,
    more loosely, at both ends of its spread.  Where even a damper of four times the modes' own damping would break
    them, the loop is off.  Notched taps reach back 0.6 to 1 bending period; the reach with the least noise is taken.
    """
    bounds = bounds or DampingBounds()
    mode, ratio = modes_of(model)
    least = QUALITY if bending is not None and bending.measured else QUALITY_UNMEASURED
    largest = 1 / (2 * WORTH * max(float(ratio.max()), LEAST_RATIO))
    lag = f"a delay of {model.delay} sample{'s' * (model.delay != 1)} at {model.rate:g} Hz"
    if largest < least:
        return _off(model, f"off: the modes damp themselves (Q {WORTH * largest:.1f})")
    if (model.delay + 0.5) / model.rate * mode.max() > 2 * np.pi:
        return _off(model, f"off: {lag} is longer than a period of the mode at {mode.max() / (2 * np.pi):.0f} Hz")
    complaint = raised = ""
    for step in range(int((largest - least) / QUALITY_STEP) + 1):
        quality = round(least + step * QUALITY_STEP, 1)
        kept = []
        for count in _counts(model, bending):
            taps, grip = damping_taps(model, quality, bending=bending, count=count)
            margins = damping_margins(model, taps, bending=bending)
            complaint = _complaint(model, taps, margins, bending, bounds)
            if not complaint:
                kept.append((max(each.noise for each in margins), count, taps, grip, margins))
        if kept:
            _, count, taps, grip, margins = min(kept, key=lambda each: each[:2])
            note = f"on: Q {quality:g}{raised}; {_spared(count, bending)}"
            return Damping(taps=taps, grip=grip, quality=quality, margins=margins, note=note)
        raised = f" (at Q {quality:g} {lag} leaves {complaint})"
    return _off(model, f"off: {lag} leaves {complaint} even at Q {quality:g}")


def _counts(model: BandModel, bending: BendingMode | None) -> list[int]:
    """Numbers of taps worth trying."""
    if bending is None or not any(bending.coupling):
        return [TAPS if bending is None else TAPS + 2]
    return sorted({max(TAPS + 2, 1 + round(span * model.rate / bending.frequency)) for span in BAR_SPANS})


def _complaint(
    model: BandModel,
    taps: Array,
    margins: tuple[DampingMargins, ...],
    bending: BendingMode | None,
    bounds: DampingBounds,
) -> str:
    """Return what bound the loop breaks, with the bending mode where it was measured and at the ends of its spread."""
    for found in margins:
        if complaint := bounds.complaint(found, model.rate):
            return complaint
    if bending is None:
        return ""
    for corner in bending.corners():
        for found in damping_margins(model, taps, bending=corner):
            if not found.stable or found.peak_sensitivity > bounds.astray:
                return f"the bending mode loose at {corner.frequency:g} Hz"
    return ""


def _spared(count: int, bending: BendingMode | None) -> str:
    """Say what the taps know of the bending mode."""
    if bending is None:
        return "no bending mode is known"
    known = "measured" if bending.measured else "estimated"
    return f"{count} taps spare the bending mode {known} at {bending.frequency:.0f} +-{bending.spread:.0f} Hz"


def _off(model: BandModel, note: str) -> Damping:
    """No inner loop."""
    coordinates = len(model.mass)
    return Damping(
        taps=np.zeros((coordinates, TAPS)), grip=np.zeros(coordinates), quality=math.inf, margins=(), note=note
    )
