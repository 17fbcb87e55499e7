"""Impedances of known truth, made without any recording."""

from typing import Any

import numpy as np

from hapticrender.analysis.records import Impedance
from hapticrender.touch.mechanics import FingerMechanics

FREQUENCIES = np.array([20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0])  # of the paper


def make_impedance(
    rng: np.random.Generator,
    finger: FingerMechanics,
    windows: int,
    loads: Any,
    *,
    noise: float = 0.05,
    exponent: float = 1 / 3,
    masked: float = 0.0,
    frequency: Any = FREQUENCIES,
) -> Impedance:
    """Windows under loads (N) spread evenly over their logarithm; errors of `noise`/2 to 2 `noise` of |Z|."""
    frequency, load = np.asarray(frequency), np.exp(rng.uniform(*np.log(loads), windows))
    growth = np.exp(exponent * np.log(load / finger.reference_load))
    truth = finger.impedance(frequency) * growth[:, None]
    error = noise * np.abs(truth) * 2 ** rng.uniform(-1, 1, truth.shape)
    value = truth + error * (rng.standard_normal(truth.shape) + 1j * rng.standard_normal(truth.shape))
    hidden = rng.random(truth.shape) < masked
    value[hidden], error[hidden] = np.nan, np.nan
    time = 0.2 * np.arange(windows)
    return Impedance(time, np.broadcast_to(frequency, truth.shape), value, error, load, 0 * load)
