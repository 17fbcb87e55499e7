"""Active damping at sample rate: taps on the deviation that act like a damper at each mode, delay included.

Ideal mode by mode; the margins say what delay, rate and the surface's own
modes leave of it, and `choose_damping` designs by them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.damping_margins import LEAST_RATIO, BendingMode, DampingMargins, damping_margins, modes_of
from hapticrender.control.remembered import remembered
from hapticrender.protocols import Array

TAPS = 3
QUALITY, QUALITY_UNMEASURED = 1.4, 2.0  # the least Q, with the bending mode known and while it is not
QUALITY_STEP = 0.1
WORTH = 4.0  # the damper is switched off where it cannot add so many times the mode's own damping
REACHES = (0.6, 0.7, 0.8, 0.9, 1.0)  # of a bending period: how long notched taps may reach back


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
        How many taps, at least as many as there are equations, 3 or 5 with zeros; by default `model.taps` or 5.

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
    least in sum c_i^2, hence in noise; a coordinate without zeros uses `model.taps` and leaves others at zero.
    """
    least = TAPS if bending is None else TAPS + 2
    count = (model.taps if bending is None else least) if count is None else count
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
        reach = count if notched else min(model.taps, count)
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
        Without it Q stays at 2 or above, unless the model is known to be rigid.
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
    found = _chosen(model, bending, bounds or DampingBounds())
    return replace(found, taps=found.taps.copy(), grip=found.grip.copy())


@remembered
def _chosen(model: BandModel, bending: BendingMode | None, bounds: DampingBounds) -> Damping:
    """Design of `choose_damping`."""
    if not (model.mass.diagonal() > 0.0).all():
        return _off(model, "off: the device has no mode")
    mode, ratio = modes_of(model)
    known = model.rigid if bending is None else bending.measured
    least = QUALITY if known else QUALITY_UNMEASURED
    largest = 1 / (2 * WORTH * max(float(ratio.max()), LEAST_RATIO))
    lag = f"a delay of {model.delay} sample{'s' * (model.delay != 1)} at {model.rate:g} Hz"
    if largest < least:
        return _off(model, f"off: the modes damp themselves (Q {WORTH * largest:.1f})")
    if not within_a_turn(model):
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


def within_a_turn(model: BandModel) -> bool:
    """Whether delay and hold are no longer than a period of the fastest mode."""
    return bool((model.delay + 0.5) / model.rate * modes_of(model)[0].max() <= 2 * np.pi)


def _counts(model: BandModel, bending: BendingMode | None) -> list[int]:
    """Numbers of taps worth trying."""
    if bending is None or not any(bending.coupling):
        return [model.taps if bending is None else TAPS + 2]
    return sorted({max(TAPS + 2, 1 + round(span * model.rate / bending.frequency)) for span in REACHES})


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
