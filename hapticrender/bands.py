"""Bands: carriers with their phases, and the complex envelopes that ride on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hapticrender.protocols import Array


def hold_last(position: Array) -> Array:
    """Position (m, shape (n,)) with every NaN replaced by the last finite value before it (0 where there is none)."""
    finite = np.isfinite(position)
    index = np.maximum.accumulate(np.where(finite, np.arange(position.size), -1))
    return np.where(index >= 0, position[np.maximum(index, 0)], 0.0)


_COLUMNS: dict[str, tuple[str, type, float | None]] = {  # unit, type, least value
    "frequency": ("Hz", float, 0.0),
    "wavenumber": ("1/m", float, 0.0),
    "phase": ("rad", float, None),
    "envelope": ("m", complex, None),
}


def _check(name: str, column: Array, shape: tuple[int, ...], unit: str, least: float | None) -> None:
    if column.ndim != 1 or column.shape != shape:
        raise ValueError(f"{name} has shape {column.shape}: must be one number a band, as many as frequency has")
    good = np.isfinite(column) if least is None else np.isfinite(column) & (column >= least)
    if not good.all():
        first = int(np.argmin(good))
        bound = "finite" if least is None else f"finite and >= {least:g}"
        raise ValueError(f"{name}[{first}] = {column[first]}: must be {bound} ({unit})")


@dataclass(frozen=True, kw_only=True)
class Bands:
    """Carriers of a texture, one entry a band, and what is wanted on each.

    The wanted displacement is ``Re sum_k envelope_k exp(j phi_k)`` with
    ``phi_k = 2 pi (frequency_k t + wavenumber_k x) + phase_k``: a fixed carrier
    has wavenumber 0, a carrier locked to the finger has frequency 0.

    Parameters
    ----------
    frequency : ndarray, shape (n,), Hz
        Fixed part of each carrier, finite and >= 0.
    wavenumber : ndarray, shape (n,), 1/m
        Finger-locked part, 1/wavelength, finite and >= 0.
    phase : ndarray, shape (n,), rad
        Carrier phase at t = 0, x = 0; finite.
    envelope : ndarray of complex, shape (n,), m, or None
        Constant wanted envelopes, finite; None where the wanted waveform has
        to be analysed by the bank that listens to the device (recordings).
    modulated : bool
        The wanted waveform is a factor of every envelope, which is then constant but for it.
    differentiated : bool
        Wanted is the time derivative of what the envelopes say, whatever the carriers' frequencies come to be.
    shown : ndarray of complex, shape (n,), or None
        What the device's sensor shows of each band, as a multiple of it, > 0; None: all of it.  The controller is asked
        for what will be shown.
    unfelt : tuple of str
        Which bands were left out because no one could feel them, and why, one sentence each.

    Raises
    ------
    ValueError
        A number is out of its bound, or a length differs from that of `frequency`.

    Examples
    --------
    >>> Bands(frequency=[50.0], wavenumber=[0.0], phase=[np.nan])
    Traceback (most recent call last):
    ValueError: phase[0] = nan: must be finite (rad)
    """

    frequency: Array
    wavenumber: Array
    phase: Array
    envelope: Array | None = None
    modulated: bool = False
    differentiated: bool = False
    shown: Array | None = None
    unfelt: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, (unit, kind, least) in _COLUMNS.items():
            if getattr(self, name) is not None:
                column: Array = np.asarray(getattr(self, name), kind)
                object.__setattr__(self, name, column)
                _check(name, column, self.frequency.shape, unit, least)

    def __len__(self) -> int:
        return len(self.frequency)

    def tone(self) -> Array:
        """Rows of a compiled controller: frequency, wavenumber, phase (turns), wanted real and imaginary part (m)."""
        wanted = np.zeros(len(self), complex) if self.envelope is None else self.envelope
        wanted = wanted if self.shown is None else wanted * self.shown
        return np.array([self.frequency, self.wavenumber, self.phase / (2 * np.pi), wanted.real, wanted.imag], float)

    def carrier_phase(self, time: Array, position: Array) -> Array:
        """Phase of every carrier (rad, in [0, 2 pi), shape (n_samples, n_bands)); `position` NaN holds the phase."""
        turns = np.multiply.outer(np.asarray(time, float), self.frequency)
        turns += np.multiply.outer(hold_last(np.asarray(position, float)), self.wavenumber)
        turns += self.phase / (2 * np.pi)
        return 2 * np.pi * (turns - np.floor(turns))

    def instantaneous_frequency(self, velocity: Array) -> Array:
        """Signed frequency of every carrier (Hz, shape (n_samples, n_bands)) at finger `velocity` (m/s)."""
        return self.frequency + np.multiply.outer(np.asarray(velocity, float), self.wavenumber)
