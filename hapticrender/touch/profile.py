"""A recorded curve made ready for playing: band-limited, folded at its ends, with its strongest peaks.

Everything here runs in *recorded* seconds.  A spatial recording is read at
``x / speed`` with the speed at which it was recorded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticrender.protocols import Array

ROLL_OFF = 1.5  # the passband falls to zero within this factor of its edges
POINTS = 32  # of the table in the shortest period that it holds
FAINTEST = 1e-4  # a peak below this share of the strongest one's power is no carrier


@dataclass(frozen=True)
class Profile:
    """Values at a constant step, continued past both ends by reflection, so that it never jumps.

    Parameters
    ----------
    values : ndarray, shape (n,), n >= 2
    step : float, s
        Recorded time between values.
    """

    values: Array
    step: float

    @property
    def length(self) -> float:
        """From the first to the last value, s."""
        return (self.values.size - 1) * self.step

    @classmethod
    def band_limited(cls, values: Array, step: float, low: float, high: float) -> Profile:
        """Keep `low` to `high` (Hz) of `values`, on a table fine enough for `at`.

        The cosine transform (DCT-I) sees exactly the reflected continuation, so
        the filter is zero-phase, has no seam at the ends, and re-tabulates without error.
        """
        from scipy.fft import dct, idct

        count = values.size - 1
        length = count * step
        spectrum = dct(values, type=1)
        spectrum *= _passband(np.arange(count + 1) / (2 * length), low, high)
        spectrum[-1] /= 2  # the last term of a DCT-I stands alone, the others for a pair
        fine = int(np.ceil(POINTS * ROLL_OFF * high * length)) + 2
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
        a, b, c, d = (self.values[last - np.abs(last - np.abs(index + k))] for k in (-1, 0, 1, 2))
        inner = (u + 1) * (2 - u) / 2 * ((1 - u) * b + u * c)
        return inner - u * (1 - u) / 6 * ((2 - u) * a + (u + 1) * d)

    def strongest(self, count: int, spacing: float, low: float, high: float) -> Array:
        """Frequencies (Hz, rising) of up to `count` peaks of the spectrum in [low, high], `spacing` (Hz) apart."""
        frequency, power = self._spectrum(spacing / 16)
        peak = np.zeros(power.size, bool)
        peak[1:-1] = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])
        inside = (frequency >= low) & (frequency <= high)
        candidates = np.flatnonzero(peak & inside)
        if not candidates.size:
            candidates = np.flatnonzero(inside)
        candidates = candidates[np.argsort(-power[candidates], kind="stable")]
        chosen: list[float] = []
        for index in candidates:
            middle = min(max(_refined(frequency, power, int(index)), low), high)
            clear = all(abs(middle - other) >= spacing for other in chosen)
            if clear and power[index] >= FAINTEST * power[candidates[0]]:
                chosen.append(middle)
            if len(chosen) == count:
                break
        return np.sort(np.array(chosen))

    def _spectrum(self, resolution: float) -> tuple[Array, Array]:
        """Power averaged over half-overlapping Hann windows of 1/resolution seconds (Welch's method)."""
        window_size = round(1 / (resolution * self.step))
        size = min(window_size, self.values.size)
        window = np.hanning(size)
        starts = range(0, self.values.size - size + 1, max(size // 2, 1))
        power = np.zeros(window_size // 2 + 1)
        for start in starts:
            power += np.abs(np.fft.rfft(self.values[start : start + size] * window, window_size)) ** 2
        return np.arange(power.size) / (window_size * self.step), power


def _passband(frequency: Array, low: float, high: float) -> Array:
    """Gain: 1 from `low` to `high`, half a cosine down to 0 a factor `ROLL_OFF` away."""
    rising = np.clip((frequency * ROLL_OFF / low - 1) / (ROLL_OFF - 1), 0, 1)
    falling = np.clip((ROLL_OFF - frequency / high) / (ROLL_OFF - 1), 0, 1)
    return np.sin(np.pi / 2 * rising) ** 2 * np.sin(np.pi / 2 * falling) ** 2


def _refined(frequency: Array, power: Array, index: int) -> float:
    """Top of the parabola through the logarithms of a peak and its neighbours."""
    if not 0 < index < power.size - 1:
        return float(frequency[index])
    left, top, right = np.log(np.maximum(power[index - 1 : index + 2], 1e-300))
    bend = left - 2 * top + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(frequency[index] + shift * frequency[1])
