"""Gaussian smoothing, differentiation and local lines, with known response and known noise, also block by block.

The kernel is ``g(t) = exp(-t^2/(2 s^2))/(s sqrt(2 pi))`` with the spread s (s).  A signal smoothed by it is multiplied
by ``exp(-(w s)^2/2)`` at the angular frequency w; half of the power passes at ``sqrt(ln 2)/(2 pi s)``.  The derivatives
of a smoothed signal are the signal under g' and g'', exactly, so that motion and its derivatives have one response.
Kernels end `REACH` spreads from their middle, where g has fallen to 4e-6.
"""

import math

import numpy as np
from scipy.signal import oaconvolve

from hapticrender.protocols import Array

REACH = 5.0  # spreads on each side of a kernel
LEAST_SPREAD = 1.25  # samples: below it a sampled kernel aliases by more than 1e-11
WORST = 10.0  # of the interior's standard error: beyond it a local line is not defined


def spread_of(bandwidth: float) -> float:
    """Spread (s) of the kernel that passes half of the power at `bandwidth` (Hz)."""
    return math.sqrt(math.log(2.0)) / (2.0 * math.pi * bandwidth)


def half_width(spread: float, rate: float) -> int:
    """Samples on each side of a kernel."""
    return math.ceil(REACH * spread * rate)


def derivative_kernels(spread: float, rate: float) -> Array:
    """Taps of g, g' and g'' (1, 1/s, 1/s^2; shape (3, 2 n + 1)) for samples at `rate` (Hz), to be convolved."""
    n = half_width(spread, rate)
    time = np.arange(-n, n + 1) / rate
    g = np.exp(-0.5 * (time / spread) ** 2) / (math.sqrt(2 * math.pi) * spread * rate)
    return np.stack([g, -time / spread**2 * g, (time**2 / spread**4 - 1 / spread**2) * g])


def held_kernel(spread: float, rate: float, late: int) -> Array:
    """Taps (2 n + 1 + late + 1,) that smooth an input which is held over each sample, `late` samples after it was sent.

    Exact: tap j is the integral of g over the interval in which the input of j samples ago is held.
    """
    n = half_width(spread, rate)
    edges = (np.arange(-n - 1, n + late + 2) - late) / (rate * spread * math.sqrt(2.0))
    return np.diff([0.5 * math.erf(edge) for edge in edges])


class History:
    """The last samples of a signal before a block; what was before the first sample is taken to be equal to it."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._last: Array | None = None

    def before(self, block: Array) -> Array:
        """Block (n, ...) with the `length` samples before it, shape (length + n, ...)."""
        last = np.repeat(block[:1], self._length, axis=0) if self._last is None else self._last
        joined = np.concatenate([last, block])
        self._last = joined[len(joined) - self._length :]
        return joined


def convolve(signal: Array, taps: Array) -> Array:
    """Convolve a signal (n, ...) with taps (m,) over time, where they overlap wholly: shape (n - m + 1, ...)."""
    return oaconvolve(signal, taps.reshape(-1, *[1] * (signal.ndim - 1)), mode="valid", axes=0)


class LocalLine:
    """Fit a straight line to a signal around each sample, by least squares with the weights g, over some samples only.

    At the sample t the fit to the values y_i at times t + t_i that are inside is ``level + slope t_i``::

        level = sum w_i y_i,  w_i = g_i (S2 - S1 t_i)/(S0 S2 - S1^2),  S_k = sum g_i t_i^k
        slope = sum u_i y_i,  u_i = g_i (S0 t_i - S1)/(S0 S2 - S1^2)

    White noise of variance v per sample gives them the variances v sum w_i^2 and v sum u_i^2.  Far from the edges of
    the span, with samples on both sides, these are the convolutions with g and with g'.

    `spread` (s) is that of g, `rate` in Hz; `ahead` samples after each sample are used, at most `half_width`.  `noise`
    holds the sums of w_i^2 (1) and u_i^2 (1/s^2) inside a long span.
    """

    def __init__(self, spread: float, rate: float, ahead: int) -> None:
        self.behind, self.ahead = half_width(spread, rate), ahead
        self._times = -np.arange(-ahead, self.behind + 1) / rate  # of the samples, as a convolution takes them
        g = derivative_kernels(spread, rate)[0][self.behind - ahead :]
        self._taps = [g * self._times**k for k in range(3)]
        self._squares = [g**2 * self._times**k for k in range(3)]
        self.noise = tuple(float((weights**2).sum()) for weights in self.weights())

    def weights(self) -> tuple[Array, Array]:
        """Taps w and u inside a long span, for `convolve`."""
        s0, s1, s2 = (taps.sum() for taps in self._taps)
        g, det = self._taps[0], s0 * s2 - s1**2
        return g * (s2 - s1 * self._times) / det, g * (s0 * self._times - s1) / det

    def response(self, frequency: Array) -> tuple[Array, Array]:
        """Response at `frequency` (Hz) of the level (1) and of the slope over that of a derivative (1), complex."""
        w = 2 * np.pi * np.asarray(frequency, float)
        level, slope = (np.exp(1j * np.outer(w, self._times)) @ np.stack(self.weights(), axis=1)).T
        return level, slope / (1j * w)

    def bandwidths(self, smoothed: float = 0.0) -> tuple[float, float]:
        """Frequencies (Hz) at which level and slope pass half of the power of a signal smoothed by g before.

        `smoothed` is the spread (s) of that g.
        """
        found = [0.0, 0.0]
        for step, count in ((2.0, 250), (0.05, 40)):  # the first of less than half, in these steps
            for which, low in enumerate(found):
                f = low + step * np.arange(1, count + 1)
                passed = np.exp(-((2 * np.pi * f * smoothed) ** 2)) * np.abs(self.response(f)[which]) ** 2
                found[which] += step * int(np.argmax(passed < 0.5))
        return found[0] + step, found[1] + step

    def fit(self, signal: Array, inside: Array) -> tuple[Array, Array, Array, Array]:
        """Level and slope (n, k) of a signal (n + behind + ahead, k), and the sums of squares of w and u (n,).

        `inside` (bool, one a sample) selects the samples that count; all are NaN where too few do.
        """
        n, k = len(signal) - len(self._times) + 1, signal.shape[1]
        if not inside.any():
            return (*np.full((2, n, k), np.nan), *np.full((2, n), np.nan))
        if inside.all():
            return (*(convolve(signal, weights) for weights in self.weights()), *np.repeat([self.noise], n, axis=0).T)
        s0, s1, s2 = (convolve(inside.astype(float), taps) for taps in self._taps)
        q0, q1, q2 = (convolve(inside.astype(float), taps) for taps in self._squares)
        t0, t1 = (convolve(np.where(inside[:, None], signal, 0.0), taps) for taps in self._taps[:2])
        det = s0 * s2 - s1**2
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            of_level = (s2**2 * q0 - 2 * s1 * s2 * q1 + s1**2 * q2) / det**2
            of_slope = (s0**2 * q2 - 2 * s0 * s1 * q1 + s1**2 * q0) / det**2
            level = (s2[:, None] * t0 - s1[:, None] * t1) / det[:, None]
            slope = (s0[:, None] * t1 - s1[:, None] * t0) / det[:, None]
            good = (s0 > 1e-3) & (of_level > 0) & (of_level < WORST**2 * self.noise[0])
        level, slope = (np.where(good[:, None], each, np.nan) for each in (level, slope))
        return level, slope, np.where(good, of_level, np.nan), np.where(good, of_slope, np.nan)
