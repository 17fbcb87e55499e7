"""Measured impedances as rows without what is masked, and their growth with the load: a power at each frequency."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan, sqrt
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.optimize import curve_fit

from hapticrender.analysis.records import FingerRecord, Impedance
from hapticrender.checks import require
from hapticrender.protocols import Array

APART = 0.01  # two carriers, or two loads, count as different if they differ by more than this, relatively
BAND = 0.05  # relative width of a bin of frequencies
Source = FingerRecord | Impedance


def parts_of(impedance: Source | Sequence[Source]) -> list[Source]:
    """List of the recordings, of which one may stand alone."""
    parts = [impedance] if isinstance(impedance, FingerRecord | Impedance) else impedance
    good = isinstance(parts, Sequence) and all(isinstance(each, FingerRecord | Impedance) for each in parts)
    require(good, "impedance", impedance, "what analyse_finger returns, an Impedance, or a list of them", TypeError)
    return list(parts)


class Samples(NamedTuple):
    """Unmasked entries of impedances, one row each."""

    frequency: Array  # Hz
    value: Array  # N s/m, complex
    standard_error: Array  # N s/m
    load: Array  # N
    source: Array  # which of the recordings

    @classmethod
    def of(cls, impedance: Source | Sequence[Source], loads: tuple[float, float] = (0.0, inf)) -> Self:
        """Unmasked entries with a load (N) from the first of `loads` to below the second, and above 0."""
        rising = np.shape(loads) == (2,) and loads[0] < loads[1]
        require(rising, "loads", loads, "two loads in N, the least and a larger one")
        parts = [each.impedance if isinstance(each, FingerRecord) else each for each in parts_of(impedance)]
        rows = [
            np.broadcast_arrays(each.frequency, each.value, each.standard_error, each.normal_load[:, None], number)
            for number, each in enumerate(parts)
        ]
        columns = [np.concatenate([np.ravel(column) for column in same]) for same in zip(*rows, strict=True)]
        found = cls(*(columns or [np.empty(0)] * 5))
        good = np.isfinite(found.frequency) & np.isfinite(found.value) & np.isfinite(found.standard_error)
        with np.errstate(invalid="ignore"):
            good &= (found.frequency > 0) & (found.load > 0) & (found.load >= loads[0]) & (found.load < loads[1])
        found = cls(*(column[good] for column in found))
        least = found.standard_error.min(initial=inf)
        require(bool(least > 0), "standard_error", float(least), "> 0 N s/m: mask (NaN) what was not measured")
        return found

    def by_frequency(self) -> list[Self]:
        """Split into bins of 5 % of frequency, by rising frequency."""
        bins = np.rint(np.log(self.frequency) / BAND).astype(int)
        return [type(self)(*(column[bins == at] for column in self)) for at in np.unique(bins)]

    @property
    def loads_differ(self) -> bool:
        """Whether growth with the load is in the data."""
        return bool(self.load.size and np.ptp(np.log(self.load)) >= APART)


def weighted_mean(value: Array, standard_error: Array) -> tuple[complex, float]:
    """Mean of complex values weighted by their standard errors, and its own, enlarged where the values scatter more."""
    weight = standard_error**-2.0
    mean = complex(np.average(value, weights=weight))
    scatter = float(np.sum(np.abs(value - mean) ** 2 * weight)) / max(2 * len(value) - 2, 1)
    return mean, (max(1.0, scatter) / float(weight.sum())) ** 0.5


@dataclass(frozen=True)
class LoadLaw:
    """Growth of the impedance with the load, ``|Z_f| = magnitude (W/reference_load)**exponent``, per frequency.

    All are arrays of shape (bands,).  The exponent and its standard error are NaN where fewer than 3 windows are above
    their noise, or the loads differ by less than 1 %.
    """

    frequency: Array  # Hz: median of each band, rising
    exponent: Array
    standard_error: Array
    magnitude: Array  # N s/m: |Z_f| at the reference load
    reference_load: Array  # N: geometric mean of the loads
    determination: Array  # squared correlation of |Z_f| and W
    count: Array  # windows in each band


def load_exponent(impedance: Source | Sequence[Source]) -> LoadLaw:
    """Fit ``|Z_f| ~ W**n`` at every frequency (bins of 5 %), weighted by the standard errors.

    The standard error of n is enlarged by ``sqrt(chi^2/degrees of freedom)`` where the windows scatter by more than
    they state.  |Z| is corrected for its noise, ``sqrt(|Z|^2 - sigma^2)``, good to 1 % of |Z| from |Z| = 3 sigma on.
    Hertz contact suggests n = 1/3 (Grigorii et al. 2021, from 111 Hz on).
    """
    rows = [_power(each) for each in Samples.of(impedance).by_frequency()]
    columns: Any = zip(*rows, strict=True) if rows else [()] * 7
    return LoadLaw(*(np.array(column) for column in columns))


def _power(samples: Samples) -> tuple[float, ...]:
    """One row of `LoadLaw` from the samples of a bin."""
    logs, sigma = np.log(samples.load), samples.standard_error
    middle, count = float(logs.mean()), len(logs)
    size = np.sqrt(np.maximum(np.abs(samples.value) ** 2 - sigma**2, 0.0))
    frequency, mean = float(np.median(samples.frequency)), float(np.average(size, weights=sigma**-2))
    if np.count_nonzero(size) < 3 or not samples.loads_differ:
        return frequency, nan, nan, mean, float(np.exp(middle)), nan, count

    def power(at: Array, magnitude: float, exponent: float) -> Array:
        return magnitude * np.exp(np.clip(exponent * at, -50, 50))

    found = curve_fit(power, logs - middle, size, p0=(mean, 0.3), sigma=sigma, absolute_sigma=True)
    (magnitude, exponent), covariance = found
    chi_square = float(np.sum(((power(logs - middle, magnitude, exponent) - size) / sigma) ** 2))
    error = sqrt(covariance[1, 1] * max(1.0, chi_square / (count - 2)))
    together = float(np.corrcoef(samples.load, size)[0, 1] ** 2) if np.ptp(size) else 0.0
    return frequency, float(exponent), error, float(magnitude), float(np.exp(middle)), together, count
