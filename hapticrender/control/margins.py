"""Margins of a loop over several coordinates, read off its frequency response at sample rate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from hapticrender.protocols import Array

SLOWEST = 0.02  # 1/s: a loop that grows more slowly than this counts as stable in Nyquist's count
NARROWEST = 2e-3  # Hz: closest that a grid comes to a carrier
PER_DECADE = 12  # points of a grid on either side of a carrier
UNIFORM = 400  # points of a grid over the whole spectrum
ZOOMS, NEARLY = 3, 0.7  # how often peaks are looked at closer, and which: those above so much of the highest
CONTINUOUS = 2.0  # rad: a locus that turns by more between two points has passed through infinity, at a carrier
ROUNDS = 24  # bisections of a grid where the return difference turns too fast


@dataclass(frozen=True, kw_only=True)
class Margins:
    """How far a loop stands from its boundary; every margin of an unstable loop is 0.

    Parameters
    ----------
    stable : bool
        All closed-loop poles decay, or grow by less than 0.02 1/s.
    modulus : float
        1/max over frequency of the largest singular value of S, 0..1: the distance of I + L from being singular; Ms
        is its inverse.
    worst_frequency : float, Hz
        Where S peaks.
    delay : float, s
        Largest extra delay, the same in every coordinate.
    phase : float, rad
        Largest error of the plant's phase, the same in every coordinate and at every frequency, of either sign.
    gain : float
        Largest error of the plant's gain, as a factor >= 1: the loop bears the plant times it and divided by it.
    bandwidth : float, Hz
        Within this distance of the carrier every deviation is at least halved in power.
    """

    stable: bool
    modulus: float
    worst_frequency: float
    delay: float
    phase: float
    gain: float
    bandwidth: float

    def __str__(self) -> str:
        return (
            f"modulus margin {self.modulus:.2f} at {self.worst_frequency:.0f} Hz, gain margin {self.gain:.3g}, "
            f"phase margin {math.degrees(self.phase):.0f} deg, delay margin {1e3 * self.delay:.2f} ms, "
            f"bandwidth {self.bandwidth:.2f} Hz"
        )


def carrier_grid(carriers: Array, widths: Array, rate: float, narrowest: float = NARROWEST) -> Array:
    """Frequencies (Hz) from 0 to half the rate, ever denser towards the carriers, none of them on one.

    Parameters
    ----------
    carriers : ndarray, shape (n,), Hz
        Where the loop, or the plant, changes fast; at least one.
    widths : ndarray, shape (m,), Hz
        Widths that the loop is known to have; points crowd around carriers plus and minus these.
    rate : float, Hz
        Sampling rate.
    narrowest : float, Hz
        Distance of the closest point.
    """
    carriers = np.unique(carriers)
    count = math.ceil(PER_DECADE * math.log10(rate / narrowest))
    away = np.concatenate([np.geomspace(narrowest, rate / 2, count), widths])
    points = [np.linspace(0.0, rate / 2, UNIFORM)]
    middles = 0.5 * (carriers[1:] + carriers[:-1])
    for carrier, below, above in zip(carriers, [0.0, *middles], [*middles, rate / 2], strict=True):
        beside = np.concatenate([carrier - away, carrier + away])
        points.append(beside[(beside >= below) & (beside <= above)])
    grid = np.unique(np.concatenate(points))
    at = np.clip(np.searchsorted(carriers, grid), 1, max(len(carriers) - 1, 1))
    apart = np.minimum(np.abs(grid - carriers[at - 1]), np.abs(grid - carriers[np.minimum(at, len(carriers) - 1)]))
    return grid[apart > 0.5 * narrowest]


def unstable_poles(difference: Callable[[Array], Array], grid: Array, carriers: Array, rate: float) -> int:
    """Closed-loop poles that grow, by Nyquist's count on a circle just outside the unit circle.

    Parameters
    ----------
    difference : callable
        Closed-loop over open-loop characteristic polynomial at complex z (shape (n,)), 1 at infinity, with all its
        poles on or inside the unit circle.
    grid : ndarray, Hz
        Where to begin; halved wherever the difference turns by more than one radian.
    carriers : ndarray, shape (n,), Hz
        Where it turns within less than the grid resolves.
    rate : float, Hz
        Sampling rate.

    Notes
    -----
    On ``|z| = exp(SLOWEST/rate)`` every open-loop pole lies inside, carriers and integrators included, so no
    indentation is needed: the difference winds minus once for each closed-loop pole outside.
    """
    radius = math.exp(SLOWEST / rate)
    close = np.append(carriers, 0.0)[:, None] + np.linspace(-NARROWEST, NARROWEST, 9)
    grid = np.unique(np.concatenate([grid, close.ravel(), [0.0, rate / 2]]))
    grid = grid[(grid >= 0.0) & (grid <= rate / 2)]
    values = difference(radius * np.exp(2j * np.pi * grid / rate))
    for _ in range(ROUNDS):
        turn = np.angle(values[1:] / values[:-1])
        rough = np.flatnonzero(np.abs(turn) > 1.0)
        if not rough.size:
            break
        between = 0.5 * (grid[rough] + grid[rough + 1])
        grid = np.insert(grid, rough + 1, between)
        values = np.insert(values, rough + 1, difference(radius * np.exp(2j * np.pi * between / rate)))
    return round(-np.angle(values[1:] / values[:-1]).sum() / np.pi)


def sensitivity(loop: Array) -> Array:
    """Largest singular value of S = (I + L)^-1, shape (...), of `loop` (..., c, c)."""
    difference = np.eye(loop.shape[-1]) + loop
    if loop.shape[-1] != 2:
        return 1.0 / np.linalg.svd(difference, compute_uv=False)[..., -1]
    size = (np.abs(difference) ** 2).sum(axis=(-2, -1))
    volume = np.abs(np.linalg.det(difference))
    return np.sqrt(0.5 * (size + np.sqrt(np.maximum(size**2 - 4 * volume**2, 0.0)))) / volume


def highest_peak(height: Callable[[Array], Array], grid: Array, values: Array) -> tuple[float, float]:
    """Highest value of `height` (at Hz, shape (n,)), and where, looked for ever closer around what `grid` shows."""
    for _ in range(ZOOMS):
        inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
        inner = np.append(inner[values[inner] > NEARLY * values.max()], values.argmax())
        low, high = grid[np.maximum(inner - 1, 0)], grid[np.minimum(inner + 1, len(grid) - 1)]
        grid = np.unique(np.concatenate([grid[inner], *np.linspace(low, high, 9)]))
        values = height(grid)
    return float(values.max()), float(grid[values.argmax()])


def eigenloci(loop: Array) -> Array:
    """Eigenvalues of `loop` (n, c, c) along its first axis, shape (n, c), each column continuous."""
    loci = np.linalg.eigvals(loop)
    ways = np.array(list(permutations(range(loci.shape[1]))))
    moved = np.abs(loci[1:, ways] - loci[:-1, None, :]).sum(axis=2).argmin(axis=1)
    order = ways[0]
    for n, way in enumerate(ways[moved], start=1):
        order = way[order]
        loci[n] = loci[n, order]
    return loci


def crossings(values: Array) -> Array:
    """Fractional indices at which `values` (n,) change sign."""
    before = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return before + values[before] / (values[before] - values[before + 1])


def borne_errors(frequency: Array, loop: Array) -> tuple[float, float, float]:
    """Largest delay (s), phase error (rad) and gain error (factor) that a stable loop bears.

    Parameters
    ----------
    frequency : ndarray, shape (n,), Hz
        Ascending, >= 0.
    loop : ndarray of complex, shape (n, c, c)

    Notes
    -----
    The common factor q = exp(-j w tau), exp(-j theta) or kappa puts a pole on the circle where det(I + q L) = 0, that
    is where an eigenvalue of L equals -1/q: the first such q on the way from 1 is the boundary, exactly.
    """
    delay = phase = math.inf
    more, less = math.inf, 0.0
    index = np.arange(frequency.size)
    for locus in eigenloci(loop).T:
        size, angle = np.log(np.maximum(np.abs(locus), 1e-300)), np.unwrap(np.angle(-locus))
        at = crossings(size)
        lag = np.interp(at, index, angle)
        where = np.maximum(np.interp(at, index, frequency), 1e-12)
        phase = min(phase, np.abs(_wrapped(lag)).min(initial=np.inf))
        delay = min(delay, (np.mod(lag, 2 * np.pi) / (2 * np.pi * where)).min(initial=np.inf))
        at = crossings(np.sin(angle))
        jump = np.abs(np.diff(angle, append=angle[-1]))[at.astype(int)]
        at = at[(np.cos(np.interp(at, index, angle)) > 0) & (jump < CONTINUOUS)]
        factor = np.exp(-np.interp(at, index, size))
        more = min(more, factor[factor >= 1].min(initial=np.inf))
        less = max(less, factor[factor < 1].max(initial=0.0))
    return float(delay), float(min(phase, np.pi)), float(min(more, 1 / less if less else np.inf))


def _wrapped(angle: Any) -> Any:
    """Angle (rad) in [-pi, pi)."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def halved_within(offset: Array, peak: Array) -> float:
    """Smallest |offset| (Hz) at which `peak`, the largest singular value of S there, reaches 1/sqrt 2."""
    outside = np.abs(offset)[peak >= math.sqrt(0.5)]
    return float(outside.min(initial=np.inf))
