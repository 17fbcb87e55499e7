"""Inner damper of the waveform law: taps that leave the least of a load's step, with the least margins kept.

With p the motion of a coordinate per force over its static one, hold and delay included, and k its stiffness, every
feedback of ``K = k q/(1 - p q)`` with a stable q leaves the loop stable, with the sensitivity ``S = 1 - p q`` (Youla's
parametrization).  So the best q, as an FIR filter, is found by least squares over frequency; the taps are those nearest
to its feedback.  Equations: docs/theory.md, "Inner damper"; why: docs/decisions/0014-damper-by-least-squares.md.
"""

import math
from bisect import bisect_left
from functools import lru_cache

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import solve_toeplitz

from hapticrender.control.damping import (
    QUALITY,
    WORTH,
    BendingMode,
    DamperLoop,
    Damping,
    Oscillator,
    no_damping,
    oscillators,
    turns,
)
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.margins import LEAST
from hapticrender.control.records import MOST_STRIDE
from hapticrender.protocols import Array

TAPS, SPACING = 40, 0.2e-3  # s, of the taps
LENGTH = 128  # of q
RESOLUTION = 0.5  # Hz, of the integrals over frequency
LOW_END = 40.0  # Hz: below it what a load moves counts less and less
NOISE = 3e-5  # nu: weight of |q|^2, white noise through the damper, over that of the load
RESERVE, RESERVE_FROM = 5e-4, 450.0  # n; Hz: further weight of |q|^2 above it, for modes that nothing states ...
NOTCH, WIDE = 0.1, 1.3  # ... and where a bending mode is stated, within so many of its spreads
RIDGE = 1e-12  # of the normal equations, against rounding
LEAST_EFFORT, EFFORT_STEP, STEPS = 0.5, 1.01, 1024  # rho, the weight of the load's force, that are tried ...
COARSE = 16  # ... first in steps of so many: on odd plates margins do not only grow with rho


class LeastSquares:
    """Least squares for the damper of coordinate `c`; the `bending` mode is kept free of it (None: not known)."""

    def __init__(self, part: Oscillator, bending: BendingMode | None, c: int, rigid: bool) -> None:
        self.stride = tap_stride(part.rate)
        self.size = next_fast_len(math.ceil(part.rate / RESOLUTION), real=True)
        self.k = part.mass * part.omega**2
        frequency = np.fft.rfftfreq(self.size, 1.0 / part.rate)
        resolved = part._replace(ratio=max(part.ratio, 2 * np.pi * RESOLUTION / part.omega))  # a peak of such a width
        self.p = self.k * DamperLoop(resolved, np.ones(1), None, c).response(frequency)[:, 0, 0]
        step = part.omega / (2 * np.pi) * frequency / np.maximum(frequency, LOW_END) ** 2
        self.load = np.abs(step * self.p) ** 2
        self.noise = np.full(len(frequency), NOISE)
        coupled = bending is not None and bending.coupling[c] != 0.0
        if coupled or not (rigid or bending):
            self.noise[frequency >= RESERVE_FROM] += RESERVE
        if bending is not None and coupled:
            folded = abs(bending.frequency - part.rate * round(bending.frequency / part.rate))
            self.noise[abs(frequency - folded) <= WIDE * bending.spread] += NOTCH

    def solved(self, weight: Array, linear: Array, count: int) -> Array:
        """FIR filter x (count,), of sum zero, with the least integral of ``weight |x|^2 - 2 Re(conj(x) linear)``."""
        rows, right = (np.fft.irfft(each, self.size)[: count * self.stride : self.stride] for each in (weight, linear))
        rows[0] *= 1.0 + RIDGE
        free, static = solve_toeplitz(rows, np.stack([right, np.ones(count)], axis=1)).T
        return np.asarray(free - free.sum() / static.sum() * static)

    def response(self, taps: Array) -> Array:
        """Response of a filter with `taps`."""
        spread = np.zeros(self.stride * len(taps))
        spread[:: self.stride] = taps
        return np.asarray(np.fft.rfft(spread, self.size))

    def taps(self, rho: float) -> Array:
        """Taps (N/m, shape (TAPS,)) with a weight rho of the force."""
        weight = self.load * (np.abs(self.p) ** 2 + rho) + self.noise
        q = self.response(self.solved(weight, self.load * np.conj(self.p), LENGTH))
        sensitivity = 1.0 - self.p * q
        weight *= np.abs(sensitivity) ** 4  # a change x of K/k is one of q by S^2 x
        return self.k * self.solved(weight, weight * q / sensitivity, TAPS)


def tap_stride(rate: float) -> int:
    """Samples at `rate` (Hz) from one tap to the next."""
    return min(max(round(SPACING * rate), 1), MOST_STRIDE)


def choose_load_damping(model: DeviceModel) -> Damping:
    """Design the inner damper of a device model: in each coordinate the strongest whose margins hold, or none.

    rho, the weight of the force, is the least, in steps of 1 %, with which the margins of `margins.LEAST` hold: those
    of the damper with the bending mode where it was measured, those of the spread at its ends, of a mode that is only
    expected also a sample later.  A coordinate has no damper where its own damping is a good part of what one would
    add, where the loop comes a period late, or where the margins fail with any rho.
    """
    if not (model.mass.diagonal() > 0.0).all():
        return no_damping(len(model.mass))
    taps = np.array([_chosen(part, model.bending, c, model.rigid) for c, part in enumerate(oscillators(model))])
    return Damping(taps, stride=tap_stride(model.rate)) if taps.any() else no_damping(len(taps))


@lru_cache(maxsize=256)
def _chosen(part: Oscillator, bending: BendingMode | None, c: int, rigid: bool) -> Array:
    """Taps of one coordinate; zeros where it has no damper."""
    if part.ratio > 1.0 / (2.0 * WORTH * QUALITY) or turns((part,)) > 1.0:
        return np.zeros(TAPS)
    design = LeastSquares(part, bending, c, rigid)
    efforts = LEAST_EFFORT * EFFORT_STEP ** np.arange(STEPS)

    def holds(rho: float) -> bool:
        return margins_hold(part, design.taps(rho), bending, c)

    coarse = next((n for n in range(0, STEPS, COARSE) if holds(efforts[n])), None)
    if coarse is None:
        return np.zeros(TAPS)
    first = bisect_left(efforts, True, max(coarse - COARSE + 1, 0), coarse, key=holds)
    return design.taps(efforts[first])


def margins_hold(part: Oscillator, taps: Array, bending: BendingMode | None, c: int) -> bool:
    """Whether all margins hold with the taps of coordinate `c`, with the bending mode at the ends of its spread."""
    cases = [(part, bending if bending is not None and bending.measured else None, LEAST["damper"])]
    if bending is not None and bending.coupling[c] != 0.0:
        delays = (0,) if bending.measured else (0, 1)  # the delay was measured with the mode
        parts = [part._replace(delay=part.delay + late) for late in delays]
        cases += [(each, corner, LEAST["spread"]) for corner in bending.corners() for each in parts]
    loops = ((DamperLoop(each, taps, mode, c, tap_stride(part.rate)), bound) for each, mode, bound in cases)
    return not any(bound.complaint(loop.margins(), part.rate) for loop, bound in loops)
