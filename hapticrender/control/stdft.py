"""Short-time discrete Fourier transforms: the complex envelope of every band, sample by sample.

A real signal ``x = Re sum_k X_k exp(j phi_k)`` is multiplied by
``exp(-j phi_k)`` (eq. 1) and low-passed; twice the result is the envelope X_k,
so that |X_k| is the amplitude (eq. 3).  The low pass is a running mean of M
samples (eq. 2, `BoxcarSTDFT`) or a second-order Butterworth recursion (eq. 4,
the STDFT*, `StarSTDFT`).  What remains of the signal's other half, the image
at twice the carrier, is the methods' own ripple.

References
----------
Grigorii, Li, Peshkin and Colgate, IEEE Transactions on Haptics, 2021, eqs. 1-5.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, isfinite, pi, sin, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.control.transfer import butterworth, require_positive
from hapticrender.protocols import Array


@kernel
def _carrier(phase, table):
    """Cosine and sine of every band's carrier (eq. 1)."""
    for k in range(phase.shape[0]):
        table[0, k] = cos(phase[k])
        table[1, k] = sin(phase[k])


@kernel
def _boxcar_run(signal, carrier_phase, envelopes, table, history, total, lap, cursor):
    """Eq. 1-3; the running sum is replaced once a window by one summed afresh, so that rounding never piles up."""
    replaced = 0
    length, bands = history.shape[0], table.shape[1]
    gain = 2.0 / length
    for n in range(signal.shape[0]):
        _carrier(carrier_phase[n], table)
        i = cursor[0]
        for c in range(signal.shape[1]):
            x = signal[n, c]
            if not isfinite(x):
                x = 0.0
                replaced += 1
            old, t, s, X = history[i, c], total[c], lap[c], envelopes[n, c]
            for k in range(bands):
                y_re, y_im = x * table[0, k], -x * table[1, k]
                s[0, k] += y_re
                s[1, k] += y_im
                t[0, k] += y_re - old[0, k]
                t[1, k] += y_im - old[1, k]
                old[0, k] = y_re
                old[1, k] = y_im
                X[k] = complex(gain * t[0, k], gain * t[1, k])
        cursor[0] = (i + 1) % length
        if cursor[0] == 0:
            for c in range(lap.shape[0]):
                for part in range(2):
                    for k in range(bands):
                        total[c, part, k], lap[c, part, k] = lap[c, part, k], 0.0
    return replaced


@kernel
def _star_run(signal, carrier_phase, envelopes, table, coefficients, state):
    """Eq. 1, 3 and 4, the recursion in transposed direct form II."""
    replaced = 0
    bands = table.shape[1]
    b0, b1, b2, a1, a2 = coefficients
    for n in range(signal.shape[0]):
        _carrier(carrier_phase[n], table)
        for c in range(signal.shape[1]):
            x = 2.0 * signal[n, c]
            if not isfinite(x):
                x = 0.0
                replaced += 1
            w, X = state[c], envelopes[n, c]
            for k in range(bands):
                y_re, y_im = x * table[0, k], -x * table[1, k]
                X_re, X_im = b0 * y_re + w[0, k], b0 * y_im + w[1, k]
                w[0, k] = b1 * y_re - a1 * X_re + w[2, k]
                w[1, k] = b1 * y_im - a1 * X_im + w[3, k]
                w[2, k] = b2 * y_re - a2 * X_re
                w[3, k] = b2 * y_im - a2 * X_im
                X[k] = complex(X_re, X_im)
    return replaced


class Estimator:
    """A running STDFT over channels and bands; `BoxcarSTDFT.start` and `StarSTDFT.start` make one.

    Attributes
    ----------
    channels, bands : int
        Signals listened to, and carriers on each.
    replaced : int
        Samples so far that were NaN or infinite and counted as zero.
    """

    def __init__(self, run: Any, channels: int, bands: int, arrays: tuple[Any, ...]) -> None:
        self.channels, self.bands, self.replaced = channels, bands, 0
        self._run, self._arrays = run, (np.zeros((2, bands)), *arrays)

    def run(self, signal: Array, carrier_phase: Array) -> Array:
        """Demodulate a block; any split of a run into blocks gives the same envelopes.

        Parameters
        ----------
        signal : ndarray of float, shape (n, channels)
            Sensed samples.
        carrier_phase : ndarray of float, shape (n, bands), rad
            Phase of every carrier at each of them.

        Returns
        -------
        ndarray of complex, shape (n, channels, bands)
            Envelopes in the unit of the signal; amplitude is the modulus.

        Raises
        ------
        ValueError
            For arrays of other shapes.
        """
        signal, carrier_phase = np.ascontiguousarray(signal, float), np.ascontiguousarray(carrier_phase, float)
        if signal.ndim != 2 or signal.shape[1] != self.channels:
            raise ValueError(f"{signal.shape=} must be (n, {self.channels})")
        if carrier_phase.shape != (len(signal), self.bands):
            raise ValueError(f"{carrier_phase.shape=} must be ({len(signal)}, {self.bands})")
        envelopes = np.empty((len(signal), self.channels, self.bands), complex)
        self.replaced += self._run(signal, carrier_phase, envelopes, *self._arrays)
        return envelopes


class ToneResponse(NamedTuple):
    """What a demodulator makes of a tone: complex gains of its two lines."""

    direct: Any  # at f_in - f0
    image: Any  # at -(f_in + f0), driven by the conjugate of the tone's envelope


class _STDFT:
    """What both transforms have in common; each adds its low pass as `frequency_response`."""

    def frequency_response(self, offset: Any) -> Any:
        raise NotImplementedError

    def tone_response(self, frequency: Any, carrier: Any) -> ToneResponse:
        """Response to a tone ``Re A exp(j 2 pi frequency t)`` heard at another carrier.

        Parameters
        ----------
        frequency, carrier : float or ndarray, Hz

        Returns
        -------
        ToneResponse
            The estimated envelope is ``direct A exp(j 2 pi (f_in - f0) t) +
            image conj(A) exp(-j 2 pi (f_in + f0) t)``, the carrier's phase
            being 2 pi f0 t.
        """
        return ToneResponse(
            self.frequency_response(np.subtract(frequency, carrier)),
            self.frequency_response(-np.add(frequency, carrier)),
        )


@dataclass(frozen=True, kw_only=True)
class BoxcarSTDFT(_STDFT):
    """The STDFT of eq. 1-3: the mean over the last M samples.

    Parameters
    ----------
    length : int
        M, samples, >= 1.
    rate : float
        Sampling rate, Hz.

    Notes
    -----
    Before M samples have come the window is filled up with zeros.  It is blind
    to the image of every carrier with a whole number of half periods in M.
    """

    length: int
    rate: float

    def __post_init__(self) -> None:
        if self.length != int(self.length) or self.length < 1:
            raise ValueError(f"length={self.length!r} must be a whole number of samples >= 1")
        require_positive(rate=self.rate)

    @property
    def delay(self) -> float:
        """Group delay, s: (M - 1)/2 samples."""
        return (self.length - 1) / (2 * self.rate)

    def frequency_response(self, offset: Any) -> Any:
        """Complex gain on an envelope that turns at `offset` (Hz), delay included.

        ``sin(pi M f/rate)/(M sin(pi f/rate)) exp(-j pi (M - 1) f/rate)``.
        """
        turn = np.asarray(offset, float) / self.rate
        turn = turn - np.round(turn)
        return np.sinc(self.length * turn) / np.sinc(turn) * np.exp(-1j * pi * (self.length - 1) * turn)

    def start(self, *, channels: int, bands: int) -> Estimator:
        """Make an estimator at rest."""
        arrays = (
            np.zeros((self.length, channels, 2, bands)),
            np.zeros((channels, 2, bands)),
            np.zeros((channels, 2, bands)),
            np.zeros(1, np.int64),
        )
        return Estimator(_boxcar_run, channels, bands, arrays)


@dataclass(frozen=True, kw_only=True)
class StarSTDFT(_STDFT):
    """The STDFT* of eq. 4: a second-order Butterworth low pass (M = 2), discretised by Tustin's rule.

    Parameters
    ----------
    bandwidth : float
        -3 dB frequency fL of the low pass, Hz, between 0 and rate/2.
    rate : float
        Sampling rate, Hz.

    Notes
    -----
    The bilinear transform is prewarped at fL, so that the discrete filter is
    -3 dB there exactly.  The recursion runs in float64: at 10 Hz and 48 kHz it
    loses some 6 of 16 digits.
    """

    bandwidth: float
    rate: float

    def __post_init__(self) -> None:
        require_positive(rate=self.rate)
        if not 0 < self.bandwidth < self.rate / 2:
            raise ValueError(
                f"bandwidth={self.bandwidth!r} Hz must lie between 0 and half the rate, {self.rate / 2:g} Hz"
            )

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Filter parameters b and a of eq. 4, with a[0] = 1."""
        return butterworth(self.bandwidth).tustin(self.rate, prewarp=self.bandwidth)

    @property
    def delay(self) -> float:
        """Group delay of a slow envelope, s: sqrt2/wL of the prewarped prototype."""
        return sqrt(2) / (2 * self.rate * np.tan(pi * self.bandwidth / self.rate))

    def frequency_response(self, offset: Any) -> Any:
        """Complex gain on an envelope that turns at `offset` (Hz), delay included: b(z)/a(z) on the unit circle."""
        z = np.exp(2j * pi * np.asarray(offset, float) / self.rate)
        b, a = self.coefficients
        return np.polyval(b, z) / np.polyval(a, z)

    def start(self, *, channels: int, bands: int) -> Estimator:
        """Make an estimator at rest."""
        b, a = self.coefficients
        arrays = (tuple(np.append(b, a[1:]).tolist()), np.zeros((channels, 4, bands)))
        return Estimator(_star_run, channels, bands, arrays)


def phase(envelope: Any, *, cut: float = pi) -> Any:
    """Phase of an envelope, with the branch cut where it does no harm (eq. 5).

    Parameters
    ----------
    envelope : complex or ndarray of complex
    cut : float
        Upper edge of the range, rad, in (-pi, pi]; by default the ordinary
        cut at +-180 degrees.

    Returns
    -------
    float or ndarray, rad
        In (cut - 2 pi, cut].

    Notes
    -----
    A displacement lags its current by 0 to 180 degrees, both of them edges or
    A displacement lags its current by 0 to 180 degrees, and the ordinary seam
    lies at one end of that range.  ``cut=pi/2`` moves it to -270/90 degrees,
    90 degrees from either end ("Additional practical considerations").
    """
    angle = np.angle(envelope)
    angle = np.where(angle > cut, angle - 2 * pi, angle)
    return np.where(angle <= cut - 2 * pi, angle + 2 * pi, angle)[()]


def phase_error(envelope: Any, reference: Any) -> Any:
    """Phase of `envelope` over that of `reference`, rad, in (-pi, pi]: no seam can lie between the two."""
    return phase(np.multiply(envelope, np.conj(reference)))
