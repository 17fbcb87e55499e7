"""Growth of a measured impedance with the load: a power at each frequency, as in Fig. 8 C and D of the paper."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt
from typing import Any

import numpy as np
from scipy.optimize import curve_fit

from examples.grigorii2021.claims import Array
from hapticrender.analysis.models import Samples, Source


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
