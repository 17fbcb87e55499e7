"""A recorded curve made ready for playing: band-limited, folded at its ends, with its strongest peaks.

Everything here runs in *recorded* seconds.  A spatial recording is read at
``x / speed`` with the speed at which it was recorded.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hapticrender import checks
from hapticrender.protocols import Array

ROLL_OFF = 1.5  # the passband falls to zero, by half a cosine, within this factor of its edges
POINTS = 32  # of the table in the shortest period that it holds
MOST_WINDOW = 1 << 23  # samples of a Welch window
FAINTEST = 1e-4  # a peak below this share of the strongest one's power is no carrier


@dataclass(frozen=True)
class Curve:
    """Values at a constant step, continued past both ends by reflection, so that it never jumps."""

    values: Array  # (n,), n >= 2
    step: float  # s, recorded time between values

    @property
    def length(self) -> float:
        """From the first to the last value, s."""
        return (self.values.size - 1) * self.step

    @staticmethod
    def size(count: int, step: float, high: float) -> int:
        """Points of the table that `band_limited` makes of `count` values: of a length that transforms fast."""
        from scipy.fft import next_fast_len

        return next_fast_len(int(np.ceil(POINTS * ROLL_OFF * high * (count - 1) * step)) + 2, real=True)

    @classmethod
    def band_limited(cls, values: Array, step: float, low: float, high: float) -> Self:
        """Keep `low` to `high` (Hz) of `values`, on a table fine enough for `at`.

        The cosine transform (DCT-I) sees exactly the reflected continuation, so
        the filter is zero-phase, has no seam at the ends, and re-tabulates without error.
        """
        from scipy.fft import dct, idct

        count = values.size - 1
        length = count * step
        spectrum = dct(values, type=1)
        frequency = np.arange(count + 1) / (2 * length)
        rising = np.clip((frequency * ROLL_OFF / low - 1) / (ROLL_OFF - 1), 0, 1)
        falling = np.clip((ROLL_OFF - frequency / high) / (ROLL_OFF - 1), 0, 1)
        spectrum *= np.sin(np.pi / 2 * rising) ** 2 * np.sin(np.pi / 2 * falling) ** 2
        spectrum[-1] /= 2  # the last term of a DCT-I stands alone, the others for a pair
        fine = cls.size(values.size, step, high)
        padded = np.zeros(fine + 1)
        kept = min(fine, count + 1)
        padded[:kept] = spectrum[:kept] * (fine / count)
        return cls(idct(padded, type=1), length / fine)

    def at(self, time: Array) -> Array:
        """Value at recorded `time` (s): cubic through four points, error < 1e-5 of a partial inside the passband."""
        last = self.values.size - 1
        place = np.mod(np.asarray(time, float) / self.step, 2 * last)
        place = np.minimum(place, 2 * last - place)
        index = np.minimum(place.astype(np.intp), last - 1)
        u = place - index
        a, b, c, d = self.values[last - np.abs(last - np.abs(np.add.outer(range(-1, 3), index)))]
        inner = (u + 1) * (2 - u) / 2 * ((1 - u) * b + u * c)
        return inner - u * (1 - u) / 6 * ((2 - u) * a + (u + 1) * d)


def strongest_carriers(
    signal: Any, rate: float, *, count: int = 8, spacing: float = 40.0, passband: tuple[float, float] = (20.0, 400.0)
) -> Array:
    """Choose carriers for a signal: the strongest peaks of its power spectrum, no two closer than `spacing`.

    Parameters
    ----------
    signal : array_like, shape (n,), n >= 2
        Waveform over time, or over position at the speed at which it was recorded.
    rate : float, Hz
        Of its samples, > 0.
    count : int
        Most carriers, >= 1; peaks below 1e-4 of the strongest one's power are left out.
    spacing : float, Hz
        Least distance of two carriers, > 0.  Below 40 Hz the bandwidth falls in proportion to it.
    passband : (float, float), Hz
        Where to look for them, 0 <= low < high.

    Examples
    --------
    >>> time = np.arange(0, 2, 1e-3)
    >>> signal = np.sin(2 * np.pi * 72 * time) + 0.5 * np.sin(2 * np.pi * 190 * time)
    >>> strongest_carriers(signal, 1000.0).round(1).tolist()
    [72.0, 190.0]
    """
    values = np.asarray(signal, float)
    if values.ndim != 1 or values.size < 2 or not np.isfinite(values).all():
        raise ValueError(f"signal has shape {values.shape}: must be a row of >= 2 finite numbers")
    rate = checks.number("rate", rate, "Hz", above=0)
    count = checks.integer("count", count, least=1)
    spacing = checks.number("spacing", spacing, "Hz", above=0)
    low, high = checks.numbers("passband", passband, "Hz", least=0, most=1e6, count=2)
    frequency, power = _spectrum(values, rate, spacing / 16)
    inside = (frequency >= low) & (frequency <= high)
    peak = np.diff(power, prepend=np.inf, append=np.inf)  # neither end is one
    candidates = np.flatnonzero((peak[:-1] >= 0) & (peak[1:] < 0) & inside)
    if not candidates.size:
        candidates = np.flatnonzero(inside)
    candidates = candidates[np.argsort(-power[candidates], kind="stable")]
    chosen: list[float] = []
    for index in candidates[power[candidates] >= FAINTEST * power[candidates].max(initial=0.0)]:
        middle = min(max(_refined(frequency, power, int(index)), low), high)
        if all(abs(middle - other) >= spacing for other in chosen):
            chosen.append(middle)
    return np.sort(np.array(chosen[:count]))


def _spectrum(values: Array, rate: float, resolution: float) -> tuple[Array, Array]:
    """Power averaged over half-overlapping Hann windows of 1/resolution seconds (Welch's method)."""
    from scipy.signal import welch

    size = max(round(rate / resolution), 2)
    least = f">= {16 * rate / MOST_WINDOW:.3g} Hz at {rate:g} samples/s"
    checks.require(size <= MOST_WINDOW, "spacing", 16 * resolution, least)
    window = np.hanning(min(size, values.size) + 2)[1:-1]
    return welch(values, rate, window, nfft=size, detrend=False)  # type: ignore[no-any-return]


def _refined(frequency: Array, power: Array, index: int) -> float:
    """Top of the parabola through the logarithms of a peak and its neighbours."""
    if not 0 < index < power.size - 1:
        return float(frequency[index])
    left, top, right = np.log(np.maximum(power[index - 1 : index + 2], 1e-300))
    bend = left - 2 * top + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(frequency[index] + shift * frequency[1])
