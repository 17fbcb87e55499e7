"""Analysis alone: the complex envelope of every fixed band, by the STDFT* of eqs. 1, 3 and 4 in explicit vectors.

With phi_k = 2 pi f_k n/rate, counted from the first sample, ``X_k = L[2 x exp(-j phi_k)]``, L the Butterworth low pass
of `StarSTDFT`.  It does what a lock-in amplifier does, on all bands and channels at once.  Carriers turn by one product
a sample and are set right every `REFRESH` samples from phases in whole 2^-64 turns, so that they never drift.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import ALIGNMENT, WIDTH, aligned, padded, select, size
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank.state import PRECISIONS
from hapticrender.control.stdft import StarSTDFT
from hapticrender.control.transfer import require_positive
from hapticrender.protocols import Array

REFRESH = 64  # samples between two settings of the carriers
GROUP = 16  # samples that every tile takes in turn, so that their envelopes lie together; a block is cut there
TINY = 1e-30  # an envelope's state below it is silence: numbers near the smallest cost twenty times as much
NEAR = 32768  # bytes: results beyond it leave the nearest cache, and cost twice the time where they straddle its lines
# rows of a tile: turns of the carrier at the last refresh, its conjugate now, the conjugate's turn a sample; then
# CHANNEL_ROWS for each channel: low-pass states
TURNS, COS, SIN, TURN_COS, TURN_SIN = range(5)
CARRIER_ROWS = 5
RE1, RE2, IM1, IM2 = range(4)
CHANNEL_ROWS = 4
# entries of counts
SAMPLE, REPLACED = range(2)


@kernel
def set_carriers(tiles, phase, advance):
    """Carriers at a refresh from their phases (2^64 a turn), which count on to the next; states fall silent."""
    width = tiles.shape[2]
    for k in range(phase.shape[0]):
        tiles[k // width, TURNS, k % width] = np.float64(phase[k] >> np.uint64(11)) * 2.0**-53
        phase[k] += advance[k]
    for t in range(tiles.shape[0]):
        cos, sin = unit(lanes(tiles, t, TURNS))
        put(tiles, t, COS, cos)
        put(tiles, t, SIN, -sin)
        for r in range(CARRIER_ROWS, tiles.shape[1]):
            state = lanes(tiles, t, r)
            put(tiles, t, r, select(size(state) < TINY, 0.0, state))


@kernel
def smooth(section, s1, s2, x):
    """Eq. 4 in powers of z - 1, where poles near 1 keep their place; returns output and new states."""
    k1, k2, d1, d2 = section[1:]
    return x + s1, s1 + ((k1 * x + s2) - d1 * s1), (k2 * x + s2) - d2 * s1


@kernel
def hear(gain, heard, samples, n, count):
    """Write down gain x for all tiles, the gain being 2 b0; 0 where that is no number.  Returns how often."""
    replaced = 0
    for c in range(samples.shape[1]):
        for m in range(count):
            heard[c, m] = gain * samples[n + m, c]
            if not math.isfinite(heard[c, m]):
                heard[c, m] = 0.0
                replaced += 1
    return replaced


@kernel
def listen(section, tiles, heard, envelopes, n, count, t, c):
    """Eqs. 1, 3 and 4 for a tile and a channel, all in registers; the last channel leaves the carriers behind."""
    base = CARRIER_ROWS + c * CHANNEL_ROWS
    cos, sin = lanes(tiles, t, COS), lanes(tiles, t, SIN)
    turn_cos, turn_sin = lanes(tiles, t, TURN_COS), lanes(tiles, t, TURN_SIN)
    re1, re2 = lanes(tiles, t, base + RE1), lanes(tiles, t, base + RE2)
    im1, im2 = lanes(tiles, t, base + IM1), lanes(tiles, t, base + IM2)
    for m in range(count):
        re, re1, re2 = smooth(section, re1, re2, heard[c, m] * cos)
        im, im1, im2 = smooth(section, im1, im2, heard[c, m] * sin)
        put_pairs(envelopes[n + m, c], t, re, im)
        cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
    put(tiles, t, base + RE1, re1)
    put(tiles, t, base + RE2, re2)
    put(tiles, t, base + IM1, im1)
    put(tiles, t, base + IM2, im2)
    if c == heard.shape[0] - 1:
        put(tiles, t, COS, cos)
        put(tiles, t, SIN, sin)


@kernel
def analyse_run(section, tiles, phase, advance, counts, heard, samples, envelopes):
    """Groups of samples one after another, each tile by tile."""
    n = 0
    while n < samples.shape[0]:
        at = counts[SAMPLE] % REFRESH
        if at == 0:
            set_carriers(tiles, phase, advance)
        count = min(GROUP - at % GROUP, samples.shape[0] - n)
        counts[REPLACED] += hear(section[0], heard, samples, n, count)
        for t in range(tiles.shape[0]):
            for c in range(samples.shape[1]):
                listen(section, tiles, heard, envelopes, n, count, t, c)
        counts[SAMPLE] += count
        n += count


class Analyser:
    """A bank of lock-ins at fixed frequencies: the STDFT* of every band and channel, block by block.

    Parameters
    ----------
    frequency : array_like, shape (bands,), Hz
        Carriers f_k, at least one, from 0 to half the rate.
    bandwidth : float
        -3 dB frequency of the low pass, Hz, between 0 and half the rate.
    rate : float
        Sampling rate, Hz, > 0.
    channels : int
        Signals listened to, >= 1.
    precision : {"double", "single"}
        Of states and envelopes; time is kept in whole numbers either way.

    Raises
    ------
    ValueError
        For a value out of its bounds.

    Notes
    -----
    Delay and response are those of `StarSTDFT`.  At 0 Hz and half the rate the envelope is doubled.  Rounding is at
    most eps (64 + rate/(2 pi bandwidth)) of the envelope, eps being 2e-16 in double and 6e-8 in single precision.  For
    carriers that move see `StarSTDFT.start`.

    Examples
    --------
    >>> analyser = Analyser(frequency=[100.0, 250.0], bandwidth=10.0, rate=5000.0)
    >>> tone = np.cos(2 * np.pi * 250.0 * np.arange(5000) / 5000.0)
    >>> abs(analyser.run(tone[:, None]))[-1, 0].round(1)
    array([0., 1.])
    """

    def __init__(
        self, frequency: Any, bandwidth: float, rate: float, channels: int = 1, precision: str = "double"
    ) -> None:
        frequency = np.atleast_1d(np.array(frequency, float))
        require_positive(rate=rate)
        _refuse(frequency, rate, channels, precision)
        b, a = StarSTDFT(bandwidth=bandwidth, rate=rate).coefficients
        kind, self._kind = PRECISIONS[precision], np.result_type(PRECISIONS[precision], np.complex64)
        bands, width = len(frequency), WIDTH[np.dtype(kind)]
        d1, d2 = 2 + a[1], 1 + a[1] + a[2]
        section = float(2 * b[0]), float(4 - d1), float(4 - d2), float(d1), float(d2)
        tiles = aligned((padded(bands, kind), CARRIER_ROWS + channels * CHANNEL_ROWS, width), kind)
        turn = np.zeros(len(tiles) * width)
        turn[:bands] = 2 * np.pi * frequency / rate
        tiles[:, TURN_COS], tiles[:, TURN_SIN] = np.cos(turn).reshape(-1, width), -np.sin(turn).reshape(-1, width)
        steps = [Fraction(f) / Fraction(float(rate)) * REFRESH for f in frequency.tolist()]
        advance = np.array([int(step % 1 * 2**64) for step in steps], np.uint64)
        heard, self._counts = np.zeros((channels, GROUP), kind), np.zeros(2, np.int64)
        self.frequency, self.bandwidth, self.rate, self.channels = frequency, bandwidth, rate, channels
        self._arrays = section, tiles, np.zeros(bands, np.uint64), advance, self._counts, heard

    @property
    def replaced(self) -> int:
        """Samples so far that were NaN or infinite and counted as zero."""
        return int(self._counts[REPLACED])

    def room(self, count: int) -> Array:
        """Make an array for the envelopes of `count` samples, from a cache line's boundary on; see `run`."""
        shape, each = (count, self.channels, len(self.frequency)), self._kind.itemsize
        numbers = math.prod(shape)
        if numbers * each <= NEAR:
            return np.empty(shape, self._kind)
        spare = np.empty(numbers + ALIGNMENT // each, self._kind)
        start = -spare.ctypes.data % ALIGNMENT // each
        return spare[start : start + numbers].reshape(shape)

    def run(self, samples: Array, out: Array | None = None) -> Array:
        """Analyse a block; any split of a run into blocks gives the same envelopes.

        Parameters
        ----------
        samples : ndarray of float, shape (n, channels)
        out : ndarray of complex, shape (n, channels, bands), optional
            Where to write, best made by `room`: memory that is new every block can cost more than the analysis.

        Returns
        -------
        ndarray of complex, shape (n, channels, bands)
            Envelopes in the unit of the samples, complex64 in single precision; amplitude is the modulus.

        Raises
        ------
        ValueError
            For arrays of another shape, or an `out` of another type or layout.
        """
        samples = np.ascontiguousarray(samples, float)
        if samples.ndim != 2 or samples.shape[1] != self.channels:
            raise ValueError(f"{samples.shape=} must be (n, {self.channels})")
        if out is None:
            out = self.room(len(samples))
        elif out.shape != (len(samples), self.channels, len(self.frequency)):
            raise ValueError(f"{out.shape=} must be {(len(samples), self.channels, len(self.frequency))}")
        elif out.dtype != self._kind or not out.flags.carray:
            raise ValueError(f"out, of {out.dtype}, must be a writeable C-contiguous array of {self._kind}")
        analyse_run(*self._arrays, samples, out)
        return out


def _refuse(frequency: Array, rate: float, channels: int, precision: str) -> None:
    """Raise ValueError for what the low pass does not refuse itself."""
    if frequency.ndim != 1 or len(frequency) == 0:
        raise ValueError(f"{frequency.shape=} must be (bands,), with at least one band")
    outside = frequency[~((frequency >= 0) & (frequency <= rate / 2))]
    if len(outside):
        raise ValueError(f"frequency={outside[0]} Hz must lie between 0 and half the rate, {rate / 2:g} Hz")
    if isinstance(channels, bool) or not isinstance(channels, (int, np.integer)) or channels < 1:
        raise ValueError(f"{channels=} must be a whole number >= 1")
    if precision not in PRECISIONS:
        raise ValueError(f"{precision=}: must be one of {', '.join(PRECISIONS)}")
