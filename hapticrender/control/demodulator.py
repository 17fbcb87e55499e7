"""Compiled lock-in: the complex envelopes of many fixed bands and channels of a signal, block by block."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from hapticrender.control.estimators import StarSTDFT
from hapticrender.control.records import W, aligned
from hapticrender.jit import kernel, record
from hapticrender.mathx import frac, sincos_turns
from hapticrender.protocols import Array

REFRESH = 64  # samples between two settings of the carriers from their phases
TILE = np.dtype(
    [
        (name, np.float64, (W,))
        for name in ("turns", "step", "turn_cos", "turn_sin", "cos", "sin", "re", "im", "re1", "re2", "im1", "im2")
    ]
)
TILE_T = numba.from_dtype(TILE)


@kernel
def set_carriers(tiles, i):
    """Set the carriers of a tile from their phases, counted in turns, which then go on to the next refresh."""
    b = record(tiles, TILE_T, i)
    for k in range(W):
        b.sin[k], b.cos[k] = sincos_turns(b.turns[k])
        b.turns[k] = frac(b.turns[k] + REFRESH * b.step[k])


@kernel
def filter_tile(tiles, i, x, coefficients):
    """Update the envelopes L[2 x e^(-j phi)] of a tile, L a section in transposed direct form II; turn its carriers."""
    b = record(tiles, TILE_T, i)
    x0, x1, x2 = 2.0 * x * coefficients[0], 2.0 * x * coefficients[1], 2.0 * x * coefficients[2]
    a1, a2 = coefficients[3], coefficients[4]
    for k in range(W):
        cos, sin = b.cos[k], b.sin[k]
        re, im = x0 * cos + b.re1[k], b.im1[k] - x0 * sin
        b.re1[k], b.im1[k] = x1 * cos - a1 * re + b.re2[k], b.im2[k] - x1 * sin - a1 * im
        b.re2[k], b.im2[k] = x2 * cos - a2 * re, -x2 * sin - a2 * im
        b.re[k], b.im[k] = re, im
        b.cos[k] = cos * b.turn_cos[k] - sin * b.turn_sin[k]
        b.sin[k] = sin * b.turn_cos[k] + cos * b.turn_sin[k]


@kernel
def demodulate(coefficients, tiles, first, samples, envelopes):
    """Write the envelopes of every sample, channel and band; each channel has carriers of its own beside its filters.

    The loops over all bands of a tile vectorise; only the last tile of a channel may be filled in part.
    """
    channels, bands = samples.shape[1], envelopes.shape[2]
    count = -(-bands // W)
    for n in range(samples.shape[0]):
        for c in range(channels):
            x = samples[n, c] if math.isfinite(samples[n, c]) else 0.0
            for t in range(count):
                if (first + n) % REFRESH == 0:
                    set_carriers(tiles, c * count + t)
                filter_tile(tiles, c * count + t, x, coefficients)
                b = record(tiles, TILE_T, c * count + t)
                if W * t + W <= bands:
                    for k in range(W):
                        envelopes[n, c, W * t + k] = complex(b.re[k], b.im[k])
                else:
                    for k in range(bands - W * t):
                        envelopes[n, c, W * t + k] = complex(b.re[k], b.im[k])


class Demodulator:
    """Estimate the complex envelopes of all bands and channels of a signal by the STDFT*, a bank of lock-ins.

    Parameters
    ----------
    frequency : array_like, shape (bands,), Hz
        Fixed carriers, at least one, from 0 to half the rate; their phases are zero at the first sample.
    bandwidth : float
        -3 dB frequency of the low pass, Hz, between 0 and half the rate.
    rate : float
        Sampling rate, Hz, > 0.
    channels : int
        Signals, >= 1.

    Raises
    ------
    ValueError
        For a value out of its bounds.

    Notes
    -----
    Delay and frequency response are those of `hapticrender.control.estimators.StarSTDFT`.  At 0 Hz and half the rate
    the envelope is doubled.

    Examples
    --------
    >>> demodulator = Demodulator(frequency=[100.0, 250.0], bandwidth=10.0, rate=5000.0)
    >>> tone = np.cos(2 * np.pi * 250.0 * np.arange(5000) / 5000.0)
    >>> abs(demodulator.run(tone[:, None]))[-1, 0].round(1)
    array([0., 1.])
    """

    def __init__(self, frequency: Any, bandwidth: float, rate: float, channels: int = 1) -> None:
        b, a = StarSTDFT(bandwidth=bandwidth, rate=rate).coefficients
        frequency = np.atleast_1d(np.asarray(frequency, float))
        if frequency.ndim != 1 or not frequency.size or not ((frequency >= 0) & (frequency <= rate / 2)).all():
            raise ValueError(f"{frequency=} Hz must be at least one number from 0 to half the rate, {rate / 2:g} Hz")
        if int(channels) != channels or channels < 1:
            raise ValueError(f"{channels=} must be a whole number >= 1")
        self.frequency, self.channels, self._sample = frequency, int(channels), 0
        self._coefficients = tuple(float(each) for each in (*b, *a[1:]))
        count = -(-frequency.size // W)
        step = np.zeros((count, W))
        step.reshape(-1)[: frequency.size] = frequency / rate
        self._tiles = aligned(self.channels * count, TILE)
        for name, value in (
            ("step", step),
            ("turn_cos", np.cos(2 * np.pi * step)),
            ("turn_sin", np.sin(2 * np.pi * step)),
        ):
            self._tiles[name] = np.tile(value, (self.channels, 1))

    def run(self, samples: Array, out: Array | None = None) -> Array:
        """Estimate the envelopes of the next n samples; any split into blocks gives the same.

        Parameters
        ----------
        samples : ndarray of float, shape (n, channels)
            A sample that is NaN or infinite counts as zero.
        out : ndarray of complex, shape (n, channels, bands), C-contiguous, optional
            Where to write: memory that is new in every block can cost more than the estimate.

        Returns
        -------
        ndarray of complex, shape (n, channels, bands)
            In the unit of the signal; amplitude is the modulus.
        """
        samples = np.ascontiguousarray(samples, float)
        if samples.ndim != 2 or samples.shape[1] != self.channels:
            raise ValueError(f"samples of shape {samples.shape}: must be (n, {self.channels})")
        shape = (len(samples), self.channels, self.frequency.size)
        out = np.empty(shape, complex) if out is None else out
        if out.shape != shape or out.dtype != complex or not out.flags.carray:
            raise ValueError(f"out of shape {out.shape}, {out.dtype}: must be {shape}, complex128, C-contiguous")
        demodulate(self._coefficients, self._tiles.ctypes.data, self._sample, samples, out)
        self._sample += len(samples)
        return out
