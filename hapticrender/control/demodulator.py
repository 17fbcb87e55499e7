"""The STDFT*, an estimator of the complex envelopes of a signal's bands: its filter, and a compiled bank of lock-ins.

A real signal ``x = Re sum_k X_k exp(j phi_k)`` has an envelope X_k for every carrier phi_k.  A lock-in multiplies by
``exp(-j phi_k)`` and low-passes twice the result; what is left of the image at twice the carrier is its ripple.  The
filter serves `low_pass` (polar and complex methods) and `plants.electroadhesion`, too.

References
----------
Grigorii, Li, Peshkin and Colgate, IEEE Transactions on Haptics, 2021, eqs. 1-5.
"""

import math
from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import numpy as np

from hapticrender.checks import frequencies, integer, number
from hapticrender.control.records import W, aligned
from hapticrender.jit import entry, kernel, record
from hapticrender.mathx import unit
from hapticrender.protocols import Array
from hapticrender.vectors import conj, get, nearest, put, tile_type

REFRESH = 64  # samples between two settings of the carriers from their phases
COMPLEX = [f"{name}_{part}" for name in ("turn", "carrier", "x", "low1", "low2") for part in ("re", "im")]
TILE = np.dtype([(name, np.float64, (W,)) for name in ("turns", "step", *COMPLEX)])
TILE_T = tile_type(TILE)


@dataclass(frozen=True, kw_only=True)
class StarSTDFT:
    """The STDFT* of eq. 4: a second-order Butterworth low pass, discretised by Tustin's rule.

    The bilinear transform is prewarped at fL, so that the discrete filter is -3 dB there exactly.
    """

    bandwidth: float  # Hz, between 0 and rate/2: -3 dB frequency fL of the low pass
    rate: float  # Hz

    def __post_init__(self) -> None:
        if not 0 < self.bandwidth < self.rate / 2:
            raise ValueError(
                f"bandwidth={self.bandwidth!r} Hz must lie between 0 and half the rate, {self.rate / 2:g} Hz"
            )

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Filter coefficients b and a of eq. 4, with a[0] = 1."""
        k = np.tan(pi * self.bandwidth / self.rate)
        scale = 1 + sqrt(2) * k + k**2
        return k**2 * np.array([1, 2, 1]) / scale, np.array([scale, 2 * (k**2 - 1), 1 - sqrt(2) * k + k**2]) / scale

    @property
    def delay(self) -> float:
        """Group delay of a slow envelope, s: sqrt2/wL of the prewarped prototype."""
        return sqrt(2) / (2 * self.rate * np.tan(pi * self.bandwidth / self.rate))

    def frequency_response(self, offset: Any) -> Any:
        """Complex gain on an envelope that turns at `offset` (Hz), delay included: b(z)/a(z) on the unit circle."""
        z = np.exp(2j * pi * np.asarray(offset, float) / self.rate)
        b, a = self.coefficients
        return np.polyval(b, z) / np.polyval(a, z)


@kernel
def filter_tile(tiles, i, x, coefficients, refresh):
    """Update the envelopes L[2 x e^(-j phi)] of a tile, L a section in transposed direct form II; turn its carriers.

    At a refresh the carriers are set from their phases, counted in turns, which then go on to the next one.
    """
    b = record(tiles, TILE_T, i)
    carrier = get(b, "carrier")
    if refresh:
        turns = get(b, "turns")
        carrier = unit(turns)
        turns = turns + float(REFRESH) * get(b, "step")
        put(b, "turns", turns - nearest(turns))
    found = 2.0 * x * conj(carrier)
    envelope = coefficients[0] * found + get(b, "low1")
    put(b, "low1", coefficients[1] * found - coefficients[3] * envelope + get(b, "low2"))
    put(b, "low2", coefficients[2] * found - coefficients[4] * envelope)
    put(b, "x", envelope)
    put(b, "carrier", carrier * get(b, "turn"))


@entry
def demodulate(coefficients, tiles, first, samples, envelopes):
    """Write the envelopes of every sample, channel and band; each channel has carriers of its own beside its filters.

    Only the last tile of a channel may be filled in part; loops over whole ones vectorise.
    """
    channels, bands = samples.shape[1], envelopes.shape[2]
    count = -(-bands // W)
    for n in range(samples.shape[0]):
        for c in range(channels):
            x = samples[n, c] if math.isfinite(samples[n, c]) else 0.0
            for t in range(count):
                filter_tile(tiles, c * count + t, x, coefficients, (first + n) % REFRESH == 0)
                b = record(tiles, TILE_T, c * count + t)
                if W * t + W <= bands:
                    for k in range(W):
                        envelopes[n, c, W * t + k] = complex(b.x_re[k], b.x_im[k])
                else:
                    for k in range(bands - W * t):
                        envelopes[n, c, W * t + k] = complex(b.x_re[k], b.x_im[k])


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
    ValueError, TypeError
        For a value out of its bounds.

    Notes
    -----
    Delay and frequency response are those of `StarSTDFT`.  At 0 Hz and half the rate
    the envelope is doubled.

    Examples
    --------
    >>> demodulator = Demodulator(frequency=[100.0, 250.0], bandwidth=10.0, rate=5000.0)
    >>> tone = np.cos(2 * np.pi * 250.0 * np.arange(5000) / 5000.0)
    >>> abs(demodulator.run(tone[:, None]))[-1, 0].round(1)
    array([0., 1.])
    """

    def __init__(self, frequency: Any, bandwidth: float, rate: float, channels: int = 1) -> None:
        rate, bandwidth = number("rate", rate, "Hz", above=0.0), number("bandwidth", bandwidth, "Hz")
        b, a = StarSTDFT(bandwidth=bandwidth, rate=rate).coefficients
        frequency = np.atleast_1d(frequencies(frequency, zero=True))
        if frequency.ndim != 1 or not frequency.size or not ((frequency >= 0) & (frequency <= rate / 2)).all():
            raise ValueError(f"{frequency=} Hz must be at least one number from 0 to half the rate, {rate / 2:g} Hz")
        self.frequency, self.channels, self._sample = frequency, integer("channels", channels, least=1), 0
        self._coefficients = tuple(float(each) for each in (*b, *a[1:]))
        count = -(-frequency.size // W)
        step = np.zeros((count, W))
        step.reshape(-1)[: frequency.size] = frequency / rate
        self._tiles = aligned((self.channels, count), TILE)
        self._tiles["step"], turn = step, 2 * np.pi * step
        self._tiles["turn_re"], self._tiles["turn_im"] = np.cos(turn), np.sin(turn)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of the one that this is a copy of, in memory of its own that is aligned, too."""
        self.__dict__.update(state)
        self._tiles = aligned(state["_tiles"].shape, TILE)
        self._tiles[:] = state["_tiles"]

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
