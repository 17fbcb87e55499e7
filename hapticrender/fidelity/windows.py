"""The judge's windows over what two models of a device differ by, for the bounds of either kind of device."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.protocols import Array
from hapticrender.recordings.judge import LARGEST_INFLATION, LOWEST_FREQUENCY, QUARTERS, RIDGE, window_length

HOPS = 16  # window starts in a window's length: the worst window is sought, not a mean
BETWEEN = 1.03  # of the error in the windows that are looked at: in those between
TURNS = 12.0  # window starts in a turn of the fastest carrier
RINGING = 400.0  # Hz: and of what else rings, as a plate does where its finger turns round
CHUNK_VALUES = 2**22  # numbers in one batch of sums
FASTEST = 0.4  # of the rate: a carrier that moves with the finger has begun to fade there, whatever the device can do


class Windows(NamedTuple):
    """What the judge would read in its windows of two models' difference, and what it would compare that with."""

    lengths: float  # of windows in what was looked at
    apart: Array  # (w, places, bands) magnitude of the envelope, 0 where the judge reads none
    read: Array  # (w, bands)
    target: Array  # (bands,) rms of the wanted envelope


def look(
    bands: Bands, rates: tuple[float, float], position: Array, phase: Array, signals: tuple[Array, Array], asked: Array
) -> Windows:
    """Fit the judge's windows.

    Parameters
    ----------
    bands : Bands
    rates : (float, float), Hz
        Rate of what follows, n instants of the judged time; and of the device, by which the judge counts.
    position : ndarray, shape (n,), m
        Of the finger, NaN while it is up.
    phase : ndarray, shape (n, bands), rad
        Of the carriers.
    signals : ndarray, shape (n, places), and ndarray, shape (n,)
        What the models differ by, and the wanted waveform.
    asked : ndarray of bool, shape (n, bands)
        Where something is wanted of a band.
    """
    both, many, (rate, counted) = np.column_stack(signals), len(position), rates
    samples = round(window_length(bands, rate, position, many / rate / 2) * counted)
    size = min(many, max(2, round((samples + samples % 2) / counted * rate)))
    starts = np.arange(0, many - size + 1, _hop(bands, rate, position, size))
    apart, wanted, read = [], [], []
    for part in np.array_split(starts, 1 + len(starts) * (2 * len(bands) + 6) ** 2 // CHUNK_VALUES):
        here = slice(int(part[0]), int(part[-1]) + size)
        envelope, inflation = fits(phase[here], both[here], size, part - part[0])
        told = (inflation <= LARGEST_INFLATION) & _fast(bands, rate, position, part, size)
        told &= _sums(asked[here].astype(float), size, part - part[0]) > size - 0.5
        found = np.where(told[:, None, :], abs(envelope), 0.0)
        read.append(told)
        apart.append(found[:, :-1])
        wanted.append(found[:, -1])
    told = np.concatenate(read)
    target = np.sqrt((np.concatenate(wanted) ** 2).sum(axis=0) / np.maximum(told.sum(axis=0), 1))
    return Windows(many / size, np.concatenate(apart), told, target)


def _hop(bands: Bands, rate: float, position: Array, size: int) -> int:
    """Samples between window starts: what is at the windows' ends turns with the carriers, and rings where it will."""
    velocity = np.nan_to_num(np.diff(position)) * rate
    top = float(abs(bands.instantaneous_frequency(velocity)).max(initial=RINGING))
    return max(1, min(size // HOPS, math.floor(rate / (TURNS * top))))


def fits(phase: Array, signals: Array, size: int, starts: Array) -> tuple[Array, Array]:
    """Envelopes (w, s, bands) and inflation (w, bands) as of `judge.fit` in all windows of `size` from `starts` on.

    Windows overlap, so the sums of their normal equations are differences of running ones.
    """
    many, n_bands = phase.shape
    place = np.arange(many) - many / 2
    regressors = np.empty((many, 2 * n_bands + 2))
    regressors[:, :n_bands], regressors[:, n_bands:-2] = np.cos(phase), -np.sin(phase)
    regressors[:, -2], regressors[:, -1] = math.sqrt(0.5), place
    right = np.column_stack([regressors, signals])
    sums = _sums((regressors[:, :, None] * right[:, None, :]).reshape(many, -1), size, starts)
    sums = sums.reshape(len(starts), regressors.shape[1], right.shape[1])
    steep, middle = math.sqrt(1.5) * 2 / max(size - 1, 1), (place[starts] + (size - 1) / 2) / math.sqrt(0.5)
    sums[:, -1] = steep * (sums[:, -1] - middle[:, None] * sums[:, -2])  # each window's slope is about its own middle
    normal, right = sums[:, :, : regressors.shape[1]], sums[:, :, regressors.shape[1] :]
    normal[:, :, -1] = steep * (normal[:, :, -1] - middle[:, None] * normal[:, :, -2])
    inverse = np.linalg.inv(normal + RIDGE * size * np.eye(regressors.shape[1]))
    parts = (inverse @ right).transpose(0, 2, 1)
    variance = np.diagonal(inverse, axis1=1, axis2=2)[:, :-2].reshape(len(starts), 2, n_bands).max(axis=1)
    return parts[..., :n_bands] + 1j * parts[..., n_bands:-2], variance * (size / 2)


def _sums(values: Array, size: int, starts: Array) -> Array:
    """Sum of `values` (n, c) in windows of `size` from `starts` on."""
    running = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=running[1:])
    return running[starts + size] - running[starts]


def _fast(bands: Bands, rate: float, position: Array, starts: Array, size: int) -> Array:
    """Whether each carrier is fast enough in every quarter of the windows, shape (w, bands)."""
    edges = np.linspace(0, size - 1, QUARTERS + 1).round().astype(int)
    moved = np.diff(np.nan_to_num(position[starts[:, None] + edges]), axis=1)
    velocity = moved * rate / np.maximum(np.diff(edges), 1)
    return np.all(abs(bands.instantaneous_frequency(velocity)) >= LOWEST_FREQUENCY * (1 - 1e-6), axis=1)


def compared_with(target: Array, tolerance: float) -> Array:
    """Amplitude that an error of each band is compared with, as the verdict does; infinite where nothing is wanted."""
    least = np.maximum(target, tolerance * target.max(initial=0.0))
    return np.where(target > 0.0, least, np.inf)


def fade(bands: Bands, frequency: Array, highest: float, rate: float) -> Array:
    """Weight of every target (n, bands): a carrier that the finger makes too slow or too fast fades."""
    highest = min(highest, FASTEST * rate)
    slow, fast = 2 / LOWEST_FREQUENCY * abs(frequency) - 1, 5 - 4 / highest * abs(frequency)
    return np.where(bands.wavenumber > 0.0, ease(slow) * ease(fast), 1.0)


def ease(x: Array) -> Array:
    """Third-order step from 0 to 1 over 0..1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
