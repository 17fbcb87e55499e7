"""A fast lock-in at fixed carriers: the STDFT* of many bands at once, for those who only want to listen.

The controllers have estimators of their own, part of their loops; `StarSTDFT` follows carriers of any phase.  Here the
carriers stay, so that each is a phasor that is turned on from sample to sample, and set anew every 64 from a phase that
is counted in whole numbers.
"""

from __future__ import annotations

import numpy as np

from hapticrender._jit import kernel
from hapticrender._lanes import WIDTH, aligned, lanes, padded, put, put_pairs
from hapticrender._polynomials import unit
from hapticrender.control.bank_kernels import REFRESH, count_turns
from hapticrender.control.bank_state import PRECISIONS
from hapticrender.control.polar_kernels import section_step
from hapticrender.control.stdft import StarSTDFT
from hapticrender.control.transfer import require_positive
from hapticrender.protocols import Array

# rows of a tile: frequency, turns and phasor at the last refresh, the phasor of now, its turn a sample; then four
# states of the low pass a channel
FREQUENCY, TURNS, COS, SIN, TURN_COS, TURN_SIN = range(6)
CHANNEL = 6
STATES = 4
GROUP = 8  # samples that every tile takes in turn: their envelopes lie together


@kernel
def seed(rate, band, phase, frequency, t):
    """Set the phasors of a tile where they belong, and count their phases on to the next time."""
    width = band.shape[2]
    for i in range(min(width, frequency.shape[0] - t * width)):
        k = t * width + i
        band[t, FREQUENCY, i] = frequency[k] / rate
        band[t, TURNS, i] = count_turns(phase, k, frequency[k] / rate)
    cos, sin = unit(lanes(band, t, TURNS))
    put(band, t, COS, cos)
    put(band, t, SIN, sin)
    cos, sin = unit(lanes(band, t, FREQUENCY))
    put(band, t, TURN_COS, cos)
    put(band, t, TURN_SIN, sin)


@kernel
def listen(section, band, t, c, signal, start, stop, envelopes):
    """Envelopes of a tile in channel c, samples start to stop; returns the phasor after them."""
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
    at = CHANNEL + STATES * c
    re1, re2, im1, im2 = lanes(band, t, at), lanes(band, t, at + 1), lanes(band, t, at + 2), lanes(band, t, at + 3)
    for n in range(start, stop):
        twice = 2.0 * signal[n, c]
        re, re1, re2 = section_step(section, re1, re2, twice * cos)
        im, im1, im2 = section_step(section, im1, im2, -twice * sin)
        put_pairs(envelopes[n, c], t, re, im)
        cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
    put(band, t, at, re1)
    put(band, t, at + 1, re2)
    put(band, t, at + 2, im1)
    put(band, t, at + 3, im2)
    return cos, sin


@kernel
def analyse_run(section, rate, band, phase, frequency, sample, signal, envelopes):
    """Envelopes (n, channels, bands) of a signal (n, channels)."""
    start = 0
    while start < signal.shape[0]:
        into = sample[0] % REFRESH
        stop = min(signal.shape[0], start + GROUP - into % GROUP)
        for t in range(band.shape[0]):
            if into == 0:
                seed(rate, band, phase, frequency, t)
            cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
            for c in range(signal.shape[1]):
                cos, sin = listen(section, band, t, c, signal, start, stop, envelopes)
            put(band, t, COS, cos)
            put(band, t, SIN, sin)
        sample[0] += stop - start
        start = stop


class Analyser:
    """The STDFT* of fixed carriers.

    Parameters
    ----------
    frequency : array_like, shape (bands,), Hz
        Carriers, between 0 and rate/2; their phase at the first sample is zero.
    bandwidth : float, Hz
        -3 dB frequency of the second-order Butterworth low pass, between 0 and rate/2.
    rate : float, Hz, > 0
        Sampling rate.
    channels : int, >= 1
        Signals listened to.
    precision : {"double", "single"}
        Of phasors and low passes; phases are counted in whole numbers.

    Raises
    ------
    ValueError
        A number is out of its bound.

    Notes
    -----
    ``X_k = 2 L(x e^(-j 2 pi f_k n / rate))``: eqs. 1, 3 and 4 of Grigorii et al. 2021.

    Examples
    --------
    >>> analyser = Analyser([50.0, 120.0], bandwidth=5.0, rate=5000.0)
    >>> time = np.arange(5000) / 5000.0
    >>> envelope = analyser.run(3.0 * np.cos(2 * np.pi * 50.0 * time)[:, None])
    >>> [f"{abs(value):.1f}" for value in envelope[-1, 0]]
    ['3.0', '0.0']
    """

    def __init__(
        self, frequency: Array, bandwidth: float, rate: float, *, channels: int = 1, precision: str = "double"
    ) -> None:
        require_positive(rate=rate)
        if precision not in PRECISIONS:
            raise ValueError(f"{precision=}: must be one of {', '.join(PRECISIONS)}")
        if channels < 1:
            raise ValueError(f"{channels=}: must be >= 1")
        self.frequency = np.atleast_1d(np.asarray(frequency, float))
        outside = ~((self.frequency >= 0) & (self.frequency <= rate / 2))
        if self.frequency.ndim != 1 or not self.frequency.size or outside.any():
            worst = self.frequency[outside][:1].tolist()
            raise ValueError(f"frequency: {worst or 'none'}: must be one or more of 0 to {rate / 2:g} Hz")
        b, a = StarSTDFT(bandwidth=bandwidth, rate=rate).coefficients
        self.rate, self.channels = float(rate), channels
        self._section = tuple(float(value) for value in (*b, *a[1:]))
        dtype = PRECISIONS[precision]
        shape = padded(self.frequency.size, dtype), CHANNEL + STATES * channels, WIDTH[np.dtype(dtype)]
        self._band = aligned(shape, dtype)
        self._phase = np.zeros(self.frequency.size, np.uint64)
        self._sample = np.zeros(1, np.int64)

    def run(self, signal: Array, out: Array | None = None) -> Array:
        """Demodulate a block; any split of a run into blocks gives the same envelopes.

        Parameters
        ----------
        signal : ndarray, shape (n, channels)
        out : ndarray of complex, shape (n, channels, bands), optional
            Where to put them.

        Returns
        -------
        ndarray of complex, shape (n, channels, bands)
            Envelopes in the unit of the signal; amplitude is the modulus.

        Raises
        ------
        ValueError
            An array has another shape or type.
        """
        signal = np.ascontiguousarray(signal, float)
        if signal.ndim != 2 or signal.shape[1] != self.channels:
            raise ValueError(f"{signal.shape=}: must be (n, {self.channels})")
        shape = (len(signal), self.channels, self.frequency.size)
        out = np.empty(shape, complex) if out is None else out
        if out.shape != shape or out.dtype != complex or not out.flags.c_contiguous:
            raise ValueError(f"{out.shape=}, {out.dtype=}: must be {shape}, complex128, in C order")
        state = (self._band, self._phase, self.frequency, self._sample)
        analyse_run(self._section, self.rate, *state, signal, out)
        return out
