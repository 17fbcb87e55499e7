"""Margins of a feedback loop from its frequency response, and the least margins that each design has to keep.

L is the loop's frequency response, a number or a matrix (c, c) over the coordinates at which it is broken, and
S = (I + L)^-1 its sensitivity.  The same functions serve sampled loops (z = e^(j 2 pi f/rate)) and continuous ones
(s = j 2 pi f): they see frequencies only.

References
----------
Astrom and Murray, Feedback Systems, 2nd ed., 2021, chapters 10 and 13.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hapticrender.mathx import zero_crossings
from hapticrender.protocols import Array

SLOWEST = 0.02  # 1/s: a pole that grows more slowly than this counts as stable
NARROWEST = 2e-3  # Hz: closest that a grid comes to a carrier
PER_DECADE = 12  # points of a grid on either side of a carrier
UNIFORM = 400  # points of a grid over the whole spectrum
ZOOMS, NEARLY = 3, 0.7  # refinements of a peak search, and which peaks are refined: above this share of the highest
CONTINUOUS = 2.0  # rad: a locus that turns by more between two points has passed through infinity, at a carrier
BISECTIONS = 24  # of a grid where the return difference turns by more than a radian


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Distances of a loop from instability; every margin of an unstable loop is 0, and its gain margin 1."""

    stable: bool  # all closed-loop poles decay, or grow by less than 0.02 1/s
    modulus: float  # 1/Ms, 0..1, Ms being the maximum over frequency of the largest singular value of S
    worst_frequency: float  # Hz, where S peaks
    delay: float  # s: largest extra delay, the same in every coordinate
    phase: float  # rad: largest error of the plant's phase, the same in every coordinate and at every frequency
    gain: float  # >= 1: the loop bears the plant times this factor and divided by it

    @classmethod
    def unstable(cls) -> "Margins":
        """Return the margins of a loop with a growing pole."""
        return cls(stable=False, modulus=0.0, worst_frequency=math.nan, delay=0.0, phase=0.0, gain=1.0)


@dataclass(frozen=True, kw_only=True)
class LeastMargins:
    """Least margins of a design.

    The delay is at most the time in which the highest carrier turns by `phase`: above 400 Hz a sample at 5 kHz is a
    larger angle than any loop that follows a carrier bears.
    """

    modulus: float = 0.5  # 1/Ms, 0..1; 0.5 is Ms = 2
    delay: float = 1.0  # samples
    phase: float = math.radians(30.0)  # rad
    gain: float = 2.0  # factor, >= 1

    def complaint(self, found: Margins, rate: float = 1.0, highest: float = 0.0) -> str:
        """Name the first margin that falls short, with value, bound and unit; empty where all hold.

        `rate` and the `highest` carrier are in Hz.
        """
        delay = min(self.delay, self.phase * rate / (2 * math.pi * max(highest, 1.0)))
        checks = (
            (found.stable, "the loop is unstable"),
            (
                found.modulus >= self.modulus,
                f"modulus margin {found.modulus:.2f} at {found.worst_frequency:.4g} Hz is below {self.modulus:.2f}",
            ),
            (found.delay * rate >= delay, f"delay margin {found.delay * rate:.2f} samples is below {delay:.2f}"),
            (
                found.phase >= self.phase,
                f"phase margin {math.degrees(found.phase):.1f} deg is below {math.degrees(self.phase):.1f} deg",
            ),
            (found.gain >= self.gain, f"gain margin {found.gain:.2f} is below {self.gain:.2f}"),
        )
        return next((text for kept, text in checks if not kept), "")


LEAST = {
    "bands": LeastMargins(modulus=0.29, gain=1.4),  # bands share one residual: 20 Hz apart they leave 0.30 and 1.42
    "damper": LeastMargins(modulus=1 / 1.7, gain=2.5, phase=math.radians(60.0)),
    "spread": LeastMargins(modulus=0.2, delay=0.0, phase=0.0, gain=1.0),
}
"""Least margins by use: the error observer's law; the inner damper, and with a bending mode at an end of its range."""


def carrier_grid(carriers: Array, widths: Array, rate: float) -> Array:
    """Frequencies (Hz) from 0 to half the `rate` (Hz), denser towards the carriers, none of them on one.

    The loop or the plant changes fast at `carriers` (Hz, at least one); points crowd around these plus and minus
    `widths` (Hz), which the loop is known to have.
    """
    carriers = np.unique(carriers)
    count = math.ceil(PER_DECADE * math.log10(rate / NARROWEST))
    away = np.concatenate([np.geomspace(NARROWEST, rate / 2, count), widths])
    points = [np.linspace(0.0, rate / 2, UNIFORM)]
    middles = 0.5 * (carriers[1:] + carriers[:-1])
    for carrier, below, above in zip(carriers, [0.0, *middles], [*middles, rate / 2], strict=True):
        beside = np.concatenate([carrier - away, carrier + away])
        points.append(beside[(beside >= below) & (beside <= above)])
    grid = np.unique(np.concatenate(points))
    at = np.clip(np.searchsorted(carriers, grid), 1, max(len(carriers) - 1, 1))
    apart = np.minimum(np.abs(grid - carriers[at - 1]), np.abs(grid - carriers[np.minimum(at, len(carriers) - 1)]))
    return grid[apart > 0.5 * NARROWEST]


def unstable_poles(difference: Callable[[Array], Array], grid: Array) -> int:
    """Count the closed-loop poles outside a contour, by Nyquist's criterion.

    `difference` is det(I + L) at frequencies (Hz, shape (n,)) along the contour, real at both its ends.  `grid` (Hz)
    goes from 0 to half the rate, or far beyond every corner; it is bisected wherever the difference turns by more than
    one radian.

    Notes
    -----
    L has no pole outside the contour.  Take it just outside the boundary, such as ``|z| = exp(SLOWEST/rate)``: carriers
    and integrators then lie inside and no indentation is needed.  Half the contour turns by -pi for each pole that is
    outside in closed loop.
    """
    values = difference(grid)
    for _ in range(BISECTIONS):
        rough = np.flatnonzero(np.abs(np.angle(values[1:] / values[:-1])) > 1.0)
        if not rough.size:
            break
        between = 0.5 * (grid[rough] + grid[rough + 1])
        grid = np.insert(grid, rough + 1, between)
        values = np.insert(values, rough + 1, difference(between))
    return round(-np.angle(values[1:] / values[:-1]).sum() / np.pi)


def margins_of(loop: Callable[[Array], Array], grid: Array) -> Margins:
    """Read every margin of a stable loop off its frequency response, complex (n, c, c) at frequencies (Hz, (n,)).

    `grid` (Hz) is ascending, > 0 and dense where L changes fast; S is searched more finely around its peaks.
    """
    values = loop(grid)
    peak = sensitivity(values)
    highest, where = highest_peak(lambda frequency: sensitivity(loop(frequency)), grid, peak)
    delay, phase, gain = borne_errors(grid, values)
    return Margins(stable=True, modulus=1.0 / highest, worst_frequency=where, delay=delay, phase=phase, gain=gain)


def sensitivity(loop: Array) -> Array:
    """Largest singular value of S = (I + L)^-1, shape (...), of `loop` (..., c, c)."""
    difference = np.eye(loop.shape[-1]) + loop
    if loop.shape[-1] == 1:
        return 1.0 / np.abs(difference[..., 0, 0])
    if loop.shape[-1] > 2:  # the real form of a polar loop in two coordinates has four
        return 1.0 / np.linalg.svd(difference, compute_uv=False)[..., -1]
    size = (np.abs(difference) ** 2).sum(axis=(-2, -1))
    volume = np.abs(np.linalg.det(difference))
    return np.sqrt(0.5 * (size + np.sqrt(np.maximum(size**2 - 4 * volume**2, 0.0)))) / volume


def highest_peak(height: Callable[[Array], Array], grid: Array, values: Array) -> tuple[float, float]:
    """Search for the highest value of `height` (at Hz, shape (n,)) and its place, around the peaks on `grid`."""
    for _ in range(ZOOMS):
        inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
        inner = np.append(inner[values[inner] > NEARLY * values.max()], values.argmax())
        low, high = grid[np.maximum(inner - 1, 0)], grid[np.minimum(inner + 1, len(grid) - 1)]
        grid = np.unique(np.concatenate([grid[inner], *np.linspace(low, high, 9)]))
        values = height(grid)
    return float(values.max()), float(grid[values.argmax()])


def eigenloci(loop: Array) -> Array:
    """Eigenvalues of `loop` (n, c, c), c 1 or 2, along its first axis, shape (n, c), each column continuous."""
    if loop.shape[-1] == 1:
        return loop[:, 0]
    loci = np.linalg.eigvals(loop)
    straight, crossed = (abs(each - loci[:-1]).sum(axis=1) for each in (loci[1:], loci[1:, ::-1]))
    swapped = np.append(False, np.cumsum(crossed < straight) % 2 == 1)
    return np.where(swapped[:, None], loci[:, ::-1], loci)


def borne_errors(frequency: Array, loop: Array) -> tuple[float, float, float]:
    """Largest delay (s), phase error (rad) and gain error (factor) that a stable `loop` (n, c, c) bears.

    `frequency` (Hz, shape (n,)) is ascending, >= 0.  A common factor q = exp(-j w tau), exp(-j theta) or kappa puts a
    pole on the boundary where det(I + q L) = 0, that is where an eigenvalue of L equals -1/q: the first such q on the
    way from 1 is the margin, exactly.
    """
    delay = phase = math.inf
    more, less = math.inf, 0.0
    index = np.arange(frequency.size)
    for locus in eigenloci(loop).T:
        size, angle = np.log(np.maximum(np.abs(locus), 1e-300)), np.unwrap(np.angle(-locus))
        at = zero_crossings(size)
        lag = np.interp(at, index, angle)
        where = np.maximum(np.interp(at, index, frequency), 1e-12)
        phase = min(phase, np.abs(np.mod(lag + np.pi, 2 * np.pi) - np.pi).min(initial=np.inf))
        delay = min(delay, (np.mod(lag, 2 * np.pi) / (2 * np.pi * where)).min(initial=np.inf))
        at = zero_crossings(np.sin(angle))
        jump = np.abs(np.diff(angle, append=angle[-1]))[at.astype(int)]
        at = at[(np.cos(np.interp(at, index, angle)) > 0) & (jump < CONTINUOUS)]
        factor = np.exp(-np.interp(at, index, size))
        more = min(more, factor[factor >= 1].min(initial=np.inf))
        less = max(less, factor[factor < 1].max(initial=0.0))
    return float(delay), float(min(phase, np.pi)), float(min(more, 1 / less if less else np.inf))
