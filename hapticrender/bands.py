"""Bands: carriers with their phases, and the complex target envelopes on them."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from hapticrender.protocols import Array

NYQUIST_MARGIN = 0.45  # of the rate: above this the hold's image is too close to the carrier


def hold_last(position: Array) -> Array:
    """Position (m, shape (n,)) with every NaN replaced by the last finite value before it (0 where there is none)."""
    finite = np.isfinite(position)
    index = np.maximum.accumulate(np.where(finite, np.arange(position.size), -1))
    return np.where(index >= 0, position[np.maximum(index, 0)], 0.0)


_COLUMNS: dict[str, tuple[str, type]] = {  # unit, type
    "frequency": ("Hz", float),
    "wavenumber": ("1/m", float),
    "phase": ("rad", float),
    "envelope": ("m", complex),
}


@dataclass(frozen=True, kw_only=True)
class Bands:
    """Carriers of a texture, one entry a band, and the target envelope of each.

    Without any (`Bands.none`) the whole waveform is the target, which methods that work band by band refuse.

    The target displacement is ``Re sum_k envelope_k exp(j phi_k)`` with
    ``phi_k = 2 pi (frequency_k t + wavenumber_k x) + phase_k``: a fixed carrier
    has wavenumber 0, a carrier locked to the finger has frequency 0.

    Parameters
    ----------
    frequency, wavenumber : ndarray, shape (n,), Hz, 1/m
        Fixed and finger-locked (1/wavelength) part of each carrier, finite and >= 0.
    phase : ndarray, shape (n,), rad
        Carrier phase at t = 0, x = 0; finite.
    envelope : ndarray of complex, shape (n,), m, or None
        Constant target envelopes, finite; None where the controller estimates them from the waveform (recordings).
    modulated : bool
        The waveform is a factor of every envelope, which is otherwise constant.
    differentiated : bool
        The target is the time derivative of the envelopes' signal, at whatever frequency a carrier comes to be.
    spatial : bool
        The waveform follows the finger; stated where there are no carriers, which would show it.
    sensor_response : ndarray of complex, shape (n,), or None
        Response of the device's sensor to each band, not 0; None: 1.  `tone` refers the targets to the sensor.
    unfelt : tuple of str
        Bands left out below the detection threshold, and why, one sentence each.

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
    spatial: bool = False
    sensor_response: Array | None = None
    unfelt: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, (unit, kind) in _COLUMNS.items():
            if getattr(self, name) is None:
                continue
            column: Array = np.asarray(getattr(self, name), kind)
            object.__setattr__(self, name, column)
            if column.ndim != 1 or column.shape != self.frequency.shape:
                bound = "must be one number a band, as many as frequency has"
                raise ValueError(f"{name} has shape {column.shape}: {bound}")
            signed = name in ("phase", "envelope")
            for bad in np.flatnonzero(~(np.isfinite(column) & (signed | (column.real >= 0.0))))[:1]:
                bound = "finite" if signed else "finite and >= 0"
                raise ValueError(f"{name}[{bad}] = {column[bad]}: must be {bound} ({unit})")

    def __eq__(self, other: object) -> bool:
        """Whether it is of the same type, with the same numbers."""
        names = [entry.name for entry in fields(self)]
        return type(self) is type(other) and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in names)

    def __len__(self) -> int:
        return len(self.frequency)

    @classmethod
    def none(cls, *, spatial: bool) -> Self:
        """No carriers: the whole waveform is the target; it follows the finger if `spatial`."""
        return cls(frequency=np.zeros(0), wavenumber=np.zeros(0), phase=np.zeros(0), spatial=spatial)

    @property
    def whole(self) -> bool:
        """Whether the whole waveform is the target, as there are no carriers."""
        return self.envelope is None and not len(self)

    @property
    def follows_finger(self) -> bool:
        """Whether the whole target follows the finger."""
        return self.spatial or (len(self) > 0 and bool((self.wavenumber > 0.0).all()))

    def select(self, which: Array, **changes: Any) -> Self:
        """Bands at the indices, or where the mask, `which`, with `changes` of other fields."""
        columns = {name: column[which] for name in _COLUMNS if (column := getattr(self, name)) is not None}
        return replace(self, **{**columns, **changes})

    def checked(self, name: str, waveform: Callable[[Array, Array], Any], time: Array, position: Array) -> Array:
        """Target waveform at `time` (s) and `position` (m); the texture `name` must return finite numbers.

        0 while the finger is away, where it all follows it.  A ValueError names the first sample that is wrong, with
        its time and position.
        """
        values = waveform(np.array(time), np.array(position))  # which it may work in
        if np.shape(values) != np.shape(position) or np.asarray(values).dtype.kind not in "iuf":
            array = isinstance(values, np.ndarray)
            found = f"{values.dtype} of shape {values.shape}" if array else type(values).__name__
            raise ValueError(f"{name}.waveform returned {found}: must be {len(position)} numbers, one a sample")
        away = np.isnan(position) & self.follows_finger
        values = np.where(away, 0.0, np.asarray(values, float))
        for bad in np.flatnonzero(~np.isfinite(values))[:1]:
            at = f"t = {time[bad]:g} s, x = {position[bad]:g} m"
            raise ValueError(f"{name}.waveform returned {values[bad]} at {at}: must be finite")
        return values

    def set_points(self) -> Array:
        """Frequency (Hz), wavenumber (1/m), phase (turns, 0 to 1), real and imaginary envelope; shape (n, 5)."""
        envelope = np.zeros(len(self)) if self.envelope is None else self.envelope
        turns = np.remainder(self.phase / (2 * np.pi), 1.0)
        return np.column_stack([self.frequency, self.wavenumber, turns, envelope.real, envelope.imag])

    def carrier_phase(self, time: Array, position: Array) -> Array:
        """Phase of every carrier (rad, in [0, 2 pi), shape (n_samples, n_bands)); `position` NaN holds the phase."""
        turns = np.multiply.outer(np.asarray(time, float), self.frequency)
        turns += np.multiply.outer(hold_last(np.asarray(position, float)), self.wavenumber)
        turns += self.phase / (2 * np.pi)
        return 2 * np.pi * (turns - np.floor(turns))

    def instantaneous_frequency(self, velocity: Array) -> Array:
        """Signed frequency of every carrier (Hz, shape (n_samples, n_bands)) at finger `velocity` (m/s)."""
        return self.frequency + np.multiply.outer(np.asarray(velocity, float), self.wavenumber)
