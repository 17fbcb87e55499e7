"""Measured impedances of one or several recordings as rows, without what is masked."""

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from hapticrender.analysis.records import FingerRecord, Impedance
from hapticrender.checks import require
from hapticrender.protocols import Array

APART = 0.01  # two carriers, or two loads, count as different if they differ by more than this, relatively
BAND = 0.05  # relative width of a bin of frequencies
Source = FingerRecord | Impedance


class Samples(NamedTuple):
    """Unmasked entries of impedances, one row each."""

    frequency: Array  # Hz
    value: Array  # N s/m, complex
    standard_error: Array  # N s/m
    load: Array  # N
    source: Array  # which of the recordings


def parts_of(impedance: Source | Sequence[Source]) -> list[Source]:
    """List of the recordings, of which one may stand alone."""
    parts = [impedance] if isinstance(impedance, FingerRecord | Impedance) else impedance
    good = isinstance(parts, Sequence) and all(isinstance(each, FingerRecord | Impedance) for each in parts)
    require(good, "impedance", impedance, "what analyse_finger returns, an Impedance, or a list of them", TypeError)
    return list(parts)


def samples_of(impedance: Source | Sequence[Source], loads: tuple[float, float] = (0.0, inf)) -> Samples:
    """Unmasked entries with a load (N) from the first of `loads` to below the second, and above 0."""
    rising = np.shape(loads) == (2,) and loads[0] < loads[1]
    require(rising, "loads", loads, "two loads in N, the least and a larger one")
    parts = [each.impedance if isinstance(each, FingerRecord) else each for each in parts_of(impedance)]
    rows = [
        np.broadcast_arrays(each.frequency, each.value, each.standard_error, each.normal_load[:, None], number)
        for number, each in enumerate(parts)
    ]
    columns = [np.concatenate([np.ravel(column) for column in same]) for same in zip(*rows, strict=True)]
    found = Samples(*(columns or [np.empty(0)] * 5))
    good = np.isfinite(found.frequency) & np.isfinite(found.value) & np.isfinite(found.standard_error)
    with np.errstate(invalid="ignore"):
        good &= (found.frequency > 0) & (found.load > 0) & (found.load >= loads[0]) & (found.load < loads[1])
    found = Samples(*(column[good] for column in found))
    least = found.standard_error.min(initial=inf)
    require(bool(least > 0), "standard_error", float(least), "> 0 N s/m: mask (NaN) what was not measured")
    return found


def weighted_mean(value: Array, standard_error: Array) -> tuple[complex, float]:
    """Mean of complex values weighted by their standard errors, and its own, enlarged where the values scatter more."""
    weight = standard_error**-2.0
    mean = complex(np.average(value, weights=weight))
    scatter = float(np.sum(np.abs(value - mean) ** 2 * weight)) / max(2 * len(value) - 2, 1)
    return mean, (max(1.0, scatter) / float(weight.sum())) ** 0.5


def by_frequency(samples: Samples) -> list[Samples]:
    """Split samples into bins of 5 % of frequency, by rising frequency."""
    bins = np.rint(np.log(samples.frequency) / BAND).astype(int)
    return [Samples(*(column[bins == at] for column in samples)) for at in np.unique(bins)]
