"""Amplitudes of carriers in windows, all carriers and a slow drift at once, with known noise."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects, label

from hapticrender.protocols import Array

DRIFT_ORDER = 2  # of the polynomial that takes what is slower than the carriers
SHORTEST, LONGEST = 0.2, 0.4  # s: of a window
PERIODS = 4.0  # of the least spacing, in a window


@dataclass(frozen=True)
class Lines:
    """Amplitudes of carriers: a signal is ``Re sum_k amplitude_k exp(j w_k t)``, t from each window's middle.

    Variances are those of the real and of the imaginary part of an amplitude, and of a mean, for white noise of
    variance 1.
    """

    time: Array  # s, of each window's middle, shape (n,)
    frequency: Array  # Hz, of the carriers, shape (n, bands)
    amplitude: Array  # complex, shape (n, bands, signals)
    mean: Array  # what is slower than the carriers, in the middle of each window, shape (n, signals)
    variance: Array  # shape (n, bands)
    mean_variance: Array  # shape (n,)


def window_length(frequency: Array, rate: float) -> int:
    """Samples of a window in which carriers (Hz) are separated from each other and from a drift."""
    spacing = np.diff(np.sort(np.r_[0.0, frequency])).min(initial=np.inf)
    return round(float(np.clip(PERIODS / max(spacing, 1e-9), SHORTEST, LONGEST)) * rate)


def demodulate(signals: Array, starts: Array, length: int, frequency: Array, rate: float) -> Lines:
    """Fit carriers (Hz, (n, bands)) and a parabola to signals (m, signals) in windows from `starts` (n,) on.

    Weighted least squares with a Hann window; far sidelobes of it suppress what is neither carrier nor parabola.
    """
    count, bands = frequency.shape
    time = (np.arange(length) - (length - 1) / 2) / rate
    amplitude = np.empty((count, bands, signals.shape[1]), complex)
    mean, variance, of_mean = np.empty((count, signals.shape[1])), np.empty((count, bands)), np.empty(count)
    last = None
    for n, start in enumerate(starts):
        if last is None or not np.array_equal(frequency[n], last):
            inverse, last = _inverse(time, frequency[n]), frequency[n]
            shares = (inverse**2).sum(axis=1)
        found = inverse @ signals[start : start + length]
        amplitude[n], mean[n] = found[:bands] - 1j * found[bands : 2 * bands], found[2 * bands]
        variance[n], of_mean[n] = (shares[:bands] + shares[bands : 2 * bands]) / 2, shares[2 * bands]
    return Lines((np.asarray(starts) + (length - 1) / 2) / rate, frequency, amplitude, mean, variance, of_mean)


def _inverse(time: Array, frequency: Array) -> Array:
    """Matrix from samples to cosine, sine and polynomial coefficients."""
    turn = 2 * np.pi * np.multiply.outer(time, frequency)
    slow = (time[:, None] / time[-1]) ** np.arange(DRIFT_ORDER + 1)
    columns = np.hstack([np.cos(turn), np.sin(turn), slow])
    weight = np.sqrt(np.hanning(len(time) + 2)[1:-1])[:, None]
    return np.linalg.pinv(columns * weight) * weight.T


def tile(inside: Array, length: int, before: int, after: int) -> Array:
    """First samples of windows that lie one after the other in each span where `inside` (bool, (n,)) holds.

    `before` and `after` samples are left out at the beginning and at the end of a span.
    """
    spans = (span for (span,) in find_objects(label(inside)[0]))
    starts = [np.arange(span.start + before, span.stop - after - length + 1, length) for span in spans]
    return np.concatenate([np.empty(0, int), *starts]).astype(int)
