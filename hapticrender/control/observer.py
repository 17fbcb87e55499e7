"""The band bank's ear: one observer for all bands and the slow level below them, coupled through their residual.

Every band is a resonator, the level an integrator, and all of them are driven
by what none of them explains yet (Peceli 1986)::

    e[n] = y[n] - l[n] - sum_k Re(X_k[n] exp(j phi_k[n]))
    X_k[n+1] = X_k[n] + g e[n] exp(-j phi_k[n])
    l[n+1] = l[n] + g_dc e[n] + r[n],    r[n+1] = r[n] + h e[n]

One residual for all of them means that a settled band leaves nothing for the
others to mistake for their own: no image at twice the carrier, no crosstalk,
no load seen as vibration.  The compiled controller carries the same lines
inside its step; here they stand alone, to be measured, drawn and reused.

References
----------
Peceli, A common structure for recursive discrete transforms, IEEE Transactions on Circuits and Systems 33, 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, isfinite, pi, sin
from typing import Any, NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.control.transfer import require_positive
from hapticrender.protocols import Array

ZERO = 1e-100  # stands for a distance of zero on the unit circle, so that a limit 0/0 comes out as a number
DAMPED = 1.6  # g_dc of a type-2 level over its bandwidth: twice the damping ratio, 0.8


@kernel
def _observer_run(signal, carrier_phase, gains, table, state, slow, envelopes, levels, residuals):
    """Observe a block; envelopes and levels are those after each sample, residuals those before it."""
    g, dc, drift = gains
    skipped = 0
    bands = table.shape[1]
    for n in range(signal.shape[0]):
        for k in range(bands):
            table[0, k] = cos(carrier_phase[n, k])
            table[1, k] = sin(carrier_phase[n, k])
        for c in range(signal.shape[1]):
            e = signal[n, c] - slow[c, 0]
            X = state[c]
            for k in range(bands):
                e -= X[0, k] * table[0, k] - X[1, k] * table[1, k]
            if not isfinite(signal[n, c]):  # nothing was heard: nothing is learnt
                e = 0.0
                skipped += 1
            slow[c, 0] += dc * e + slow[c, 1]
            slow[c, 1] += drift * e
            for k in range(bands):
                X[0, k] += g * e * table[0, k]
                X[1, k] -= g * e * table[1, k]
                envelopes[n, c, k] = complex(X[0, k], X[1, k])
            levels[n, c], residuals[n, c] = slow[c, 0], e
    return skipped


class Observed(NamedTuple):
    """What an observer made of n samples of its channels, in the unit of the signal."""

    envelope: Array  # complex, (n, channels, bands): X after each sample
    level: Array  # (n, channels): l after each sample
    residual: Array  # (n, channels): e of each sample, what nothing explained before it


class ObserverResponse(NamedTuple):
    """What an observer makes of a tone ``Re A exp(j w n)``, w = 2 pi f/rate: complex gains, `frequency`'s shape first.

    Envelope k, its carrier's phase being w_k n, is ``direct A exp(j (w - w_k) n) + image conj(A) exp(-j (w + w_k) n)``;
    level and residual are ``Re(level A exp(j w n))`` and ``Re(residual A exp(j w n))``.
    """

    direct: Array  # (..., bands)
    image: Array  # (..., bands), driven by the conjugate of the tone
    level: Array
    residual: Array


@dataclass(frozen=True, kw_only=True)
class ResidualObserver:
    """Residual-coupled observer of any number of bands, with the slow level below them.

    Parameters
    ----------
    bandwidth : float
        wL/(2 pi) of every band, Hz, > 0: far from its neighbours an envelope has the single pole wL.
    rate : float
        Sampling rate, Hz, > 0.
    level_bandwidth : float
        The same of the level, Hz, >= 0; 0 leaves the level out.
    level_type : int
        1: the level follows steps; 2: ramps as well, without a lag.

    Notes
    -----
    The pole rule is g = 2 wL/rate, for the level g_dc = w/rate (type 1), or g_dc = 1.6 w/rate and h = (w/rate)^2
    (type 2, damping ratio 0.8).

    With z = exp(j w) and the resonators' open loop ::

        H(z) = sum_k (g/2) [p_k/(z - p_k) + p_k*/(z - p_k*)] + g_dc/(z - 1) + h/(z - 1)^2,    p_k = exp(j w_k)

    the residual is E = Y/(1 + H), from which all that `frequency_response` tells follows.  At its own carrier a
    band's gain is exactly 1 and every other band's, the level's and the residual's are exactly 0.

    Stability for a level of type 1 or none: on the unit circle Re H = -(g K + g_dc)/2, and the product of all poles
    is 1 - (g K + g_dc) in magnitude, so that K bands are stable if and only if g K + g_dc < 2.  The energy
    sum |X_k|^2/g + l^2/g_dc of the error never grows below that limit *whatever the carriers do*: chirps, crossings
    and reversals included.  With N = rate/spacing odd, carriers at every multiple of the spacing below rate/2 and
    g = 2 spacing/rate, g_dc = g/2, all poles lie at 0: the observer is dead-beat, a discrete Fourier transform that
    settles in N samples.  Faster than that it overshoots.  FACTS section 3: 1, C and F.

    Examples
    --------
    >>> observer = ResidualObserver(bandwidth=10.0, rate=5000.0, level_bandwidth=2.5)
    >>> round(observer.gain, 5), observer.most_bands
    (0.02513, 79)
    >>> abs(observer.frequency_response(40.0, [20.0, 40.0]).direct).round(9).tolist()
    [0.0, 1.0]
    """

    bandwidth: float
    rate: float
    level_bandwidth: float = 0.0
    level_type: int = 2

    def __post_init__(self) -> None:
        require_positive(rate=self.rate, bandwidth=self.bandwidth)
        if not 0 <= self.level_bandwidth < self.rate / (2 * pi):
            raise ValueError(
                f"level_bandwidth={self.level_bandwidth!r} Hz must be >= 0 and below {self.rate / (2 * pi):g} Hz, "
                "rate/(2 pi)"
            )
        if self.level_type not in (1, 2):
            raise ValueError(f"level_type={self.level_type!r} must be 1 or 2")
        if self.most_bands < 1:
            raise ValueError(
                f"bandwidth={self.bandwidth!r} Hz must be below "
                f"{(2 - self.level_gains[0]) * self.rate / (4 * pi):g} Hz, where a single band is unstable"
            )

    @classmethod
    def deadbeat(cls, *, spacing: float, rate: float, level_type: int = 1) -> ResidualObserver:
        """Fastest observer of carriers at multiples of a spacing: g = 2 spacing/rate, the level's gain half of it.

        Parameters
        ----------
        spacing : float
            Distance between carriers, Hz, > 0.
        rate : float
            Sampling rate, Hz.
        level_type : int
            As of the class; dead-beat is exact for type 1.
        """
        require_positive(spacing=spacing)
        return cls(bandwidth=spacing / (2 * pi), rate=rate, level_bandwidth=spacing / (2 * pi), level_type=level_type)

    @property
    def gain(self) -> float:
        """Gain g of every band, per sample."""
        return 4 * pi * self.bandwidth / self.rate

    @property
    def level_gains(self) -> tuple[float, float]:
        """Gains g_dc and h of the level, per sample."""
        turn = 2 * pi * self.level_bandwidth / self.rate
        return (turn, 0.0) if self.level_type == 1 else (DAMPED * turn, turn**2)

    @property
    def most_bands(self) -> int:
        """Largest number K of bands with g K + g_dc < 2: exact for a level of type 1; for type 2 see `poles`."""
        return max(int(np.ceil((2 - self.level_gains[0]) / self.gain - 1e-12)) - 1, 0)

    @property
    def delay(self) -> float:
        """Delay of a slow envelope far from all other carriers, s: 1/wL less one sample."""
        return 1 / (2 * pi * self.bandwidth) - 1 / self.rate

    def poles(self, carriers: Any) -> Array:
        """Poles of the whole observer in the z plane; the magnitude of the largest says how fast it settles.

        Parameters
        ----------
        carriers : array_like, shape (bands,), Hz
            Distinct, between 0 and rate/2.

        Returns
        -------
        ndarray of complex, shape (2 bands + level_type,)
            Two for each band, and those of the level where there is one.
        """
        spin = np.exp(2j * pi * self._distinct(carriers) / self.rate)
        poles = np.concatenate([spin, spin.conj()])
        push, hear = self.gain * poles, np.full(poles.size, 0.5)
        system = np.diag(poles)
        if self.level_bandwidth:
            dc, drift = self.level_gains
            slow = np.array([[1.0, 1.0], [0.0, 1.0]])[: self.level_type, : self.level_type]
            system = np.block([[system, np.zeros((poles.size, len(slow)))], [np.zeros((len(slow), poles.size)), slow]])
            push = np.append(push, [dc, drift][: self.level_type])
            hear = np.append(hear, [1.0, 0.0][: self.level_type])
        return np.linalg.eigvals(system - np.outer(push, hear))

    def frequency_response(self, frequency: Any, carriers: Any) -> ObserverResponse:
        """Gains from a tone to every envelope, the level and the residual: coupling, image and delay included.

        Parameters
        ----------
        frequency : float or ndarray, Hz
            Of the tone, below rate/2 in magnitude.
        carriers : array_like, shape (bands,), Hz
            Fixed, distinct, between 0 and rate/2.

        Returns
        -------
        ObserverResponse
            Of what `RunningObserver.run` returns, once settled.
        """
        z = np.exp(2j * pi * np.asarray(frequency, float) / self.rate)
        spin = np.exp(2j * pi * self._distinct(carriers) / self.rate)
        ahead, behind = _apart(z[..., None], spin), _apart(z[..., None], spin.conj())
        level = self._level(z)
        loop = 1 + self.gain / 2 * (spin / ahead + spin.conj() / behind).sum(axis=-1) + level
        residual = 1 / loop
        scale = self.gain / 2 * (residual * z)[..., None]
        return ObserverResponse(
            direct=scale / ahead, image=(scale / behind).conj(), level=z * level * residual, residual=residual
        )

    def start(self, *, channels: int, bands: int) -> RunningObserver:
        """Make an observer at rest; more bands than `most_bands` are refused."""
        if bands > self.most_bands:
            raise ValueError(
                f"{bands=} must be <= {self.most_bands} at a bandwidth of {self.bandwidth:g} Hz: "
                "g K + g_dc reaches 2, where the observer is unstable"
            )
        return RunningObserver((self.gain, *self.level_gains), channels, bands)

    def _level(self, z: Array) -> Array:
        """Open loop of the level, H's last two terms."""
        dc, drift = self.level_gains
        away = _apart(z, 1.0)
        return dc / away + drift / away**2

    def _distinct(self, carriers: Any) -> Array:
        carriers = np.atleast_1d(np.asarray(carriers, float))
        if carriers.ndim != 1 or not ((carriers > 0) & (carriers < self.rate / 2)).all():
            raise ValueError(f"{carriers=} Hz must be a list of frequencies between 0 and {self.rate / 2:g} Hz")
        if np.unique(carriers).size < carriers.size:
            raise ValueError(f"{carriers=} Hz must be distinct: equal ones cannot be told apart and never settle")
        return carriers


class RunningObserver:
    """An observer at work; `ResidualObserver.start` makes one.

    Attributes
    ----------
    channels, bands : int
        Signals listened to, each on its own, and carriers on each.
    skipped : int
        Samples so far that were NaN or infinite; the observer coasts over them.
    """

    def __init__(self, gains: tuple[float, float, float], channels: int, bands: int) -> None:
        self.channels, self.bands, self.skipped = channels, bands, 0
        self._gains = gains
        self._table = np.zeros((2, bands))
        self._state = np.zeros((channels, 2, bands))
        self._slow = np.zeros((channels, 2))

    def run(self, signal: Array, carrier_phase: Array, reference: Array | None = None) -> Observed:
        """Observe a block; any split of a run into blocks gives the same.

        Parameters
        ----------
        signal : ndarray of float, shape (n, channels)
            Sensed samples.
        carrier_phase : ndarray of float, shape (n, bands), rad
            Phase of every carrier at each of them: fixed, locked to the finger (`Bands.carrier_phase`), or any other.
        reference : ndarray of complex, shape (n, channels, bands) or (n, 1, bands), optional
            Wanted envelopes: then the envelopes of the *error* are observed, exactly, however fast these change.

        Returns
        -------
        Observed

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
        if reference is not None:
            signal = signal - (reference * np.exp(1j * carrier_phase)[:, None, :]).real.sum(axis=-1)
        envelopes = np.empty((len(signal), self.channels, self.bands), complex)
        levels, residuals = np.empty(signal.shape), np.empty(signal.shape)
        self.skipped += _observer_run(
            signal,
            carrier_phase,
            self._gains,
            self._table,
            self._state,
            self._slow,
            envelopes,
            levels,
            residuals,
        )
        return Observed(envelopes, levels, residuals)


def _apart(z: Any, pole: Any) -> Any:
    """Distance z - pole, never exactly zero."""
    distance = np.asarray(z - pole)
    return np.where(distance == 0, ZERO, distance)
