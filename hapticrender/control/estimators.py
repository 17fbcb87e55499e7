"""Estimators of the complex envelopes of a signal's bands: parameters and closed-form frequency responses.

A real signal ``x = Re sum_k X_k exp(j phi_k)`` has an envelope X_k for every carrier phi_k.  The short-time Fourier
transforms multiply by ``exp(-j phi_k)`` and low-pass twice the result; what is left of the image at twice the carrier
is their ripple.  The residual observer estimates all bands and the DC level together, from the part of the signal that
none of them explains (docs/theory.md, "Error observer").  The compiled controllers run these recursions.

References
----------
Grigorii, Li, Peshkin and Colgate, IEEE Transactions on Haptics, 2021, eqs. 1-5.
Peceli, A common structure for recursive discrete transforms, IEEE Transactions on Circuits and Systems 33, 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.transfer import butterworth, require_positive
from hapticrender.protocols import Array

LEAST_DISTANCE = 1e-100  # stands for a distance of zero on the unit circle, so that a limit 0/0 comes out as a number
DC_DAMPING = 1.6  # gain of a type-2 DC estimate over its bandwidth: twice the damping ratio, 0.8


class ToneResponse(NamedTuple):
    """Complex gains of a demodulator from a tone to the two lines of its estimate."""

    direct: Any  # at f_in - f0
    image: Any  # at -(f_in + f0), driven by the conjugate of the tone's envelope


class _STDFT:
    """Interface of both transforms; each adds its low pass as `coefficients` and `frequency_response`."""

    @property
    def coefficients(self) -> tuple[Array, Array]:
        raise NotImplementedError

    def frequency_response(self, offset: Any) -> Any:
        raise NotImplementedError

    def tone_response(self, frequency: Any, carrier: Any) -> ToneResponse:
        """Response to a tone ``Re A exp(j 2 pi frequency t)`` demodulated at another carrier.

        Parameters
        ----------
        frequency, carrier : float or ndarray, Hz

        Returns
        -------
        ToneResponse
            The estimated envelope is ``direct A exp(j 2 pi (f_in - f0) t) + image conj(A) exp(-j 2 pi (f_in + f0) t)``,
            the carrier's phase being 2 pi f0 t.
        """
        return ToneResponse(
            self.frequency_response(np.subtract(frequency, carrier)),
            self.frequency_response(-np.add(frequency, carrier)),
        )

    def demodulate(self, signal: Array, carrier_phase: Array) -> Array:
        """Estimate the envelopes of a whole record, from rest.

        Parameters
        ----------
        signal : ndarray, shape (n, channels)
        carrier_phase : ndarray, shape (n, bands), rad

        Returns
        -------
        ndarray of complex, shape (n, channels, bands)
            In the unit of the signal; amplitude is the modulus.
        """
        from scipy.signal import lfilter  # analysis only; designs do without

        b, a = self.coefficients
        return np.asarray(lfilter(b, a, 2 * signal[:, :, None] * np.exp(-1j * carrier_phase)[:, None, :], axis=0))


@dataclass(frozen=True, kw_only=True)
class BoxcarSTDFT(_STDFT):
    """Short-time Fourier transform by the mean over the last M samples (eqs. 1-3).

    Parameters
    ----------
    length : int
        M, samples, >= 1.
    rate : float
        Sampling rate, Hz.

    Notes
    -----
    It removes the image of every carrier with a whole number of half periods in M.
    """

    length: int
    rate: float

    def __post_init__(self) -> None:
        if self.length != int(self.length) or self.length < 1:
            raise ValueError(f"length={self.length!r} must be a whole number of samples >= 1")
        require_positive(rate=self.rate)

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Filter coefficients b and a."""
        return np.full(self.length, 1 / self.length), np.ones(1)

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


@dataclass(frozen=True, kw_only=True)
class StarSTDFT(_STDFT):
    """The STDFT* of eq. 4: a second-order Butterworth low pass, discretised by Tustin's rule.

    Parameters
    ----------
    bandwidth : float
        -3 dB frequency fL of the low pass, Hz, between 0 and rate/2.
    rate : float
        Sampling rate, Hz.

    Notes
    -----
    The bilinear transform is prewarped at fL, so that the discrete filter is -3 dB there exactly.
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
        """Filter coefficients b and a of eq. 4, with a[0] = 1."""
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


class ObserverResponse(NamedTuple):
    """Complex gains of an observer from a tone ``Re A exp(j w n)``, w = 2 pi f/rate; `frequency`'s shape first.

    Envelope k, its carrier's phase being w_k n, is ``direct A exp(j (w - w_k) n) + image conj(A) exp(-j (w + w_k) n)``;
    DC estimate and residual are ``Re(dc A exp(j w n))`` and ``Re(residual A exp(j w n))``.
    """

    direct: Array  # (..., bands)
    image: Array  # (..., bands), driven by the conjugate of the tone
    dc: Array
    residual: Array


@dataclass(frozen=True, kw_only=True)
class ResidualObserver:
    """Observer of any number of bands and the DC level below them, coupled through one residual.

    Parameters
    ----------
    bandwidth : float
        wL/(2 pi) of every band, Hz, > 0: far from its neighbours an envelope has the single pole wL.
    rate : float
        Sampling rate, Hz, > 0.
    dc_bandwidth : float
        The same of the DC estimate, Hz, >= 0; 0 leaves it out.
    dc_type : int
        1: the DC estimate follows steps; 2: ramps as well, without a lag.

    Notes
    -----
    ::

        e[n] = y[n] - l[n] - sum_k Re(X_k[n] exp(j phi_k[n]))
        X_k[n+1] = X_k[n] + g e[n] exp(-j phi_k[n])
        l[n+1] = l[n] + g_dc e[n] + r[n],    r[n+1] = r[n] + h e[n]

    The pole rule is g = 2 wL/rate; for the DC estimate g_dc = w/rate (type 1), or g_dc = 1.6 w/rate and h = (w/rate)^2
    (type 2, damping ratio 0.8).  With z = exp(j w) and the resonators' open loop ::

        H(z) = sum_k (g/2) [p_k/(z - p_k) + p_k*/(z - p_k*)]
               + g_dc/(z - 1) + h/(z - 1)^2

    where p_k = exp(j w_k), the residual is E = Y/(1 + H), from which `frequency_response` follows.  At its own
    carrier a band's gain is exactly 1 and that of every other band, of the DC estimate and of the residual exactly 0.
    With a DC estimate of type 1 the observer of K bands is stable exactly while g K + g_dc < 2; carriers at multiples
    of a spacing settle in one period of it (dead beat) at g = 2 spacing/rate and g_dc = g/2.
    """

    bandwidth: float
    rate: float
    dc_bandwidth: float = 0.0
    dc_type: int = 2

    def __post_init__(self) -> None:
        require_positive(bandwidth=self.bandwidth, rate=self.rate)
        if not 0 <= self.dc_bandwidth < self.rate / (2 * pi):
            raise ValueError(
                f"dc_bandwidth={self.dc_bandwidth!r} Hz must be >= 0 and below {self.rate / (2 * pi):g} Hz, rate/(2 pi)"
            )
        if self.dc_type not in (1, 2):
            raise ValueError(f"dc_type={self.dc_type!r} must be 1 or 2")

    @property
    def gain(self) -> float:
        """Gain g of every band, per sample."""
        return 4 * pi * self.bandwidth / self.rate

    @property
    def dc_gains(self) -> tuple[float, float]:
        """Gains g_dc and h of the DC estimate, per sample."""
        turn = 2 * pi * self.dc_bandwidth / self.rate
        return (turn, 0.0) if self.dc_type == 1 else (DC_DAMPING * turn, turn**2)

    def poles(self, carriers: Any) -> Array:
        """Poles of the whole observer in the z plane, shape (2 bands + those of the DC estimate,).

        `carriers` (Hz, shape (bands,)) are distinct, between 0 and rate/2.
        """
        spin = self._spin(carriers)
        resonators = np.concatenate([spin, spin.conj()])
        bands, dc = resonators.size, self.dc_type if self.dc_bandwidth else 0
        system = np.zeros((bands + dc, bands + dc), complex)
        system[:bands, :bands] = np.diag(resonators)
        system[bands:, bands:] = np.array([[1.0, 1.0], [0.0, 1.0]])[:dc, :dc]
        gains = np.append(self.gain * resonators, self.dc_gains[:dc])
        seen = np.append(np.full(bands, 0.5), [1.0, 0.0][:dc])
        return np.linalg.eigvals(system - np.outer(gains, seen))

    def frequency_response(self, frequency: Any, carriers: Any) -> ObserverResponse:
        """Gains from a tone to every envelope, the DC estimate and the residual: coupling, image and delay included.

        Parameters
        ----------
        frequency : float or ndarray, Hz
            Of the tone, below rate/2 in magnitude.
        carriers : array_like, shape (bands,), Hz
            Fixed, distinct, between 0 and rate/2.
        """
        z, spin = np.exp(2j * pi * np.asarray(frequency, float) / self.rate), self._spin(carriers)
        ahead, behind = _distance(z[..., None], spin), _distance(z[..., None], spin.conj())
        away, (dc, drift) = _distance(z, 1.0), self.dc_gains
        level = dc / away + drift / away**2
        residual = 1 / (1 + self.gain / 2 * (spin / ahead + spin.conj() / behind).sum(axis=-1) + level)
        scale = self.gain / 2 * (residual * z)[..., None]
        return ObserverResponse(
            direct=scale / ahead, image=(scale / behind).conj(), dc=z * level * residual, residual=residual
        )

    def _spin(self, carriers: Any) -> Array:
        """Turn of every carrier in a sample, exp(j w_k)."""
        carriers = np.atleast_1d(np.asarray(carriers, float))
        if carriers.ndim != 1 or not ((carriers > 0) & (carriers < self.rate / 2)).all():
            raise ValueError(f"{carriers=} Hz must be a list of frequencies between 0 and {self.rate / 2:g} Hz")
        if np.unique(carriers).size < carriers.size:
            raise ValueError(f"{carriers=} Hz must be distinct: equal carriers cannot be separated and never settle")
        return np.exp(2j * pi * carriers / self.rate)


def _distance(z: Any, pole: Any) -> Any:
    """Distance z - pole, never exactly zero."""
    distance = np.asarray(z - pole)
    return np.where(distance == 0, LEAST_DISTANCE, distance)
