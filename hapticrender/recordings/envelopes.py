"""Estimate the envelopes of a recording window by window, alike of the reference waveform and of the motion.

The estimator's own smoothing so cancels from every error; pieces are of bounded size.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hapticrender.bands import Bands
from hapticrender.defaults import FADE_IN, LOWEST_FREQUENCY
from hapticrender.protocols import Array
from hapticrender.recordings.recording import Recording

SHORTEST_WINDOW = 20e-3  # s
PERIODS = 2.0  # of the lowest carrier and of the smallest spacing in a window
HOPS = 2  # window starts in a window's length
HOPS_LOCKED = 8  # the same where carriers are locked to the finger, which is seldom fast enough for long
MOST_WINDOWS = 2**16  # beyond so many, windows do not overlap: an hour of 20 ms windows is 180 000
LARGEST_INFLATION = 4.0  # of an envelope's variance, by neighbours that the window hardly separates from it
QUARTERS = 4  # parts of a window in each of which a carrier must be fast enough
RUNAWAY = 1e3  # m: no plate moves so far, and squares still fit into a float
CHUNK_VALUES = 2**21  # numbers in one batch of regressors
RIDGE = 1e-12  # keeps the normal equations of a standing carrier solvable; such windows are not read
DIVERGING: Any = {"over": "ignore", "invalid": "ignore", "under": "ignore"}  # a diverging motion is judged as such


@dataclass(frozen=True, kw_only=True)
class Envelopes:
    """Peak amplitudes with phase, of the waveform ``Re sum_k X_k exp(j phi_k)``, in w windows of n bands."""

    start: Array  # (w,), s
    window: float  # s
    target: Array  # complex (w, n), m: of the reference waveform
    achieved: Array  # complex (w, places, n), m
    readable: Array  # bool (w, n): the window separates the carrier from its neighbours and from the offset
    has_target: Array  # bool (w, n): the target is not zero all through the window
    frequency: Array  # (w, n), Hz: mean magnitude; 0 for a finger-locked carrier while the finger is up
    backward: Array  # bool (w, n): the carrier runs backwards, as a finger-locked one does on the way back

    @property
    def time(self) -> Array:
        """Middle of every window (s)."""
        return self.start + self.window / 2

    @property
    def finite(self) -> Array:
        """Windows in which the motion at every place is a number within `RUNAWAY`, shape (w,)."""
        with np.errstate(**DIVERGING):
            return np.all(np.abs(self.achieved) < RUNAWAY, axis=(1, 2))

    @property
    def judged(self) -> Array:
        """Windows and bands that can be compared with their target, shape (w, n_bands)."""
        return self.readable & self.has_target & self.finite[:, None]


def judged_from(recording: Recording) -> float:
    """Time (s) from which a run is judged: after the scene's settling time, or its second half where it is short.

    The fade-in of 50 ms at the start is never judged.
    """
    duration = len(recording) / recording.rate
    settle = max(recording.header.settle, FADE_IN)
    return settle if duration >= 2 * settle else duration / 2


def window_length(bands: Bands, rate: float, position: Array, longest: float) -> float:
    """Length of the analysis window (s): max(20 ms, 2/lowest frequency, 2/spacing), cut to `longest` (s).

    A finger-locked carrier counts with its lowest frequency while the finger (`position`, m, at `rate`, Hz) is down;
    frequencies below 20 Hz are not judged and do not count.
    """
    step = max(1, round(SHORTEST_WINDOW / QUARTERS * rate))
    frequency, coarse = bands.frequency[None, :], position[::step]
    if bands.wavenumber.any() and coarse.size > 1:
        velocity = np.diff(coarse) * rate / step
        frequency = np.abs(bands.instantaneous_frequency(velocity[np.isfinite(velocity)]))
    window = max(SHORTEST_WINDOW, PERIODS / max(LOWEST_FREQUENCY, frequency.min(initial=np.inf)))
    fast = np.sort(frequency[(frequency >= LOWEST_FREQUENCY).all(axis=1)], axis=1)
    if len(bands) > 1 and len(fast):
        spacing = np.quantile(np.diff(fast, axis=1).min(axis=1), 0.05)
        window = max(window, PERIODS / spacing if spacing > PERIODS / longest else longest)
    return min(window, longest)


@np.errstate(**DIVERGING)
def analyse(recording: Recording) -> Envelopes:
    """Envelopes of every band at every place, by joint least squares over overlapping windows.

    Each window fits all carriers of the scene, an offset and a slope to the motion, and the same to the reference
    waveform.  Windows start half a window apart, an eighth where a carrier is locked to the finger, and a whole one in
    runs of more than 65 536 windows.
    """
    bands, rate, count = recording.bands, recording.rate, len(recording)
    longest = max(SHORTEST_WINDOW, (count / rate - judged_from(recording)) / 2)
    step = max(1, round(SHORTEST_WINDOW / QUARTERS * rate))
    size = round(window_length(bands, rate / step, recording.read("position", step=step), longest) * rate)
    size = max(2, size + size % 2)
    hop = max(1, size // (HOPS_LOCKED if bands.wavenumber.any() else HOPS))
    hop = hop if count // hop <= MOST_WINDOWS else size
    first = np.arange(0, count - size + 1, hop)
    each = max(1, CHUNK_VALUES // (size * (2 * len(bands) + 2)))  # windows in a batch, whose regressors stay small
    parts = [_analyse_batch(recording, first[i : i + each], size) for i in range(0, max(len(first), 1), each)]
    fields = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Envelopes(start=first / rate, window=size / rate, **fields)


def _analyse_batch(recording: Recording, first: Array, size: int) -> dict[str, Array]:
    """Fields of `Envelopes` for the windows that begin at samples `first`."""
    bands, rate = recording.bands, recording.rate
    start, stop = (int(first[0]), int(first[-1]) + size) if len(first) else (0, 0)
    index = (first - start)[:, None] + np.arange(size)
    position, target = recording.read("position", start, stop), recording.read("target", start, stop)
    phase = bands.carrier_phase(np.arange(start, stop) / rate, position)
    signals = np.column_stack([recording.read("reference", start, stop), recording.read("motion", start, stop)])[index]
    envelope, inflation = fit(phase[index], signals)
    signed = _quarterly(bands, rate, position[index])
    frequency = abs(signed)
    fast = np.all(frequency >= LOWEST_FREQUENCY * (1 - 1e-6), axis=1)
    return {
        "target": envelope[:, 0],
        "achieved": envelope[:, 1:],
        "readable": fast & (inflation <= LARGEST_INFLATION),
        "has_target": (target != 0)[index].all(axis=1),
        "frequency": frequency.mean(axis=1),
        "backward": signed.mean(axis=1) < 0.0,
    }


def fit(phase: Array, signals: Array) -> tuple[Array, Array]:
    """Least-squares envelopes of all carriers at once, with an offset and a slope, in w windows of m samples.

    From the carriers' `phase` (w, m, n_bands), rad, and `signals` (w, m, s): envelopes (complex, (w, s, n_bands)), and
    the variance of an envelope's worse part over that of a lone carrier (w, n_bands).
    """
    windows, size, n_bands = phase.shape
    regressors = np.empty((windows, size, 2 * n_bands + 2))
    regressors[..., :n_bands] = np.cos(phase)
    regressors[..., n_bands:-2] = -np.sin(phase)
    regressors[..., -2] = math.sqrt(0.5)
    regressors[..., -1] = np.linspace(-1, 1, size) * math.sqrt(1.5)
    transposed = regressors.transpose(0, 2, 1)
    normal = transposed @ regressors
    normal += RIDGE * size * np.eye(2 * n_bands + 2)
    inverse = np.linalg.inv(normal)
    with np.errstate(**DIVERGING):
        parts = (inverse @ (transposed @ signals)).transpose(0, 2, 1)
    envelope = parts[..., :n_bands] + 1j * parts[..., n_bands:-2]
    variance = np.diagonal(inverse, axis1=1, axis2=2)[:, :-2].reshape(windows, 2, n_bands).max(axis=1)
    return envelope, variance * (size / 2)


def _quarterly(bands: Bands, rate: float, finger: Array) -> Array:
    """Signed frequency (Hz, shape (w, quarters, n_bands)) in each quarter of a window; 0 where its finger is up."""
    edges = np.linspace(0, finger.shape[1] - 1, QUARTERS + 1).round().astype(int)
    down = np.all(np.isfinite(finger), axis=1)[:, None]
    velocity = np.diff(np.where(down, finger[:, edges], 0.0), axis=1) * rate / np.diff(edges)
    free = bands.wavenumber == 0
    return np.where(down[:, :, None] | free, bands.instantaneous_frequency(velocity), 0.0)


def amplitude_error(achieved: ArrayLike, target: ArrayLike, axis: int | None = None) -> Array:
    """Relative error of amplitudes, phase left out.

    ``|X|/|target| - 1`` of every element; with an `axis` the rms of |X| - |target| along it over the rms of |target|.
    Envelopes (complex) or amplitudes in one unit, of shapes that broadcast; NaN where the target is zero.

    >>> float(amplitude_error(1.1j, 1.0)), float(amplitude_error([0.9, 1.1], [1.0, 1.0], axis=0))  # doctest: +ELLIPSIS
    (0.1..., 0.1...)
    """
    reference = np.abs(target)
    off = np.abs(achieved) - reference
    if axis is not None:
        off, reference = (np.sqrt(np.mean(values**2, axis=axis)) for values in np.broadcast_arrays(off, reference))
    return off / np.where(reference > 0, reference, np.nan)
