"""Finger records of known truth, made without any recording."""

from typing import Any

import numpy as np

from hapticrender.analysis.records import (
    DOUBTFUL,
    LOADED,
    UNLOADED,
    FingerRecord,
    Impedance,
    PlateTrack,
    Segment,
    Series,
)
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


def make_record(
    rng: np.random.Generator,
    finger: FingerMechanics,
    name: str = "subject",
    heaviest: float = 1.2,
    *,
    plate_errors: Any = (0.0, 0.0),
) -> Any:
    """Six seconds: unloaded, a touch from 0.15 N to `heaviest` and back, with swipes, unloaded.

    `plate_errors` are stated of the plate's damping (N s/m) and stiffness (N/m).
    """
    time, step = np.arange(0, 6, 0.01), 0.15
    contact = np.select([(time > 1) & (time < 5), (time > 0.95) & (time < 5.05)], [LOADED, DOUBTFUL], UNLOADED)
    load = np.where(contact == LOADED, 0.15 + (heaviest - 0.15) * np.sin(np.pi * (time - 1) / 4) ** 2, 0.0)
    middle = np.arange(step / 2, 6, step)
    at = np.rint(middle / 0.01).astype(int)
    touching = contact[at] == LOADED
    z = make_impedance(rng, finger, len(middle), (0.5, 0.6), masked=0.05)
    scale = np.where(touching, np.cbrt(load[at] / z.normal_load), np.nan)[:, None]
    position = np.where(contact == LOADED, 0.012 * np.sin(2 * np.pi * 0.5 * time), np.nan)
    speed = np.where(contact == LOADED, 0.0377 * np.cos(2 * np.pi * 0.5 * time), np.nan)
    error = np.where(contact == LOADED, 1e-4 / np.maximum(load, 0.1), np.nan)
    edges = [0, 0.95, 1, 5, 5.05, 6]
    sides = zip(("damping", "stiffness"), plate_errors, strict=True)
    stated = {f"{key}_{side}": np.full(len(middle), each / np.sqrt(2)) for key, each in sides for side in (1, 2)}
    kinds = (UNLOADED, DOUBTFUL, LOADED, DOUBTFUL, UNLOADED)
    return FingerRecord(
        name=name, time=time, contact=contact, least_load=0.15, notes=("400 Hz: too light a finger",),
        normal_load=Series(load + 0.005 * rng.standard_normal(len(time)), np.full(len(time), 0.005), 10.0),
        position=Series(position, error, 10.0), velocity=Series(speed, 10 * error, 10.0),
        segments=tuple(Segment(*each) for each in zip(kinds, edges, edges[1:], strict=False)),
        plate=PlateTrack(middle, {}, stated, True),
        impedance=Impedance(middle, z.frequency, z.value * scale, z.standard_error * scale, load[at], 0 * middle),
    )  # fmt: skip
