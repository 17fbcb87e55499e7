"""Margins of the inner loop, and the mode of the surface that it must not drive.

The loop of each coordinate is ``L(z) = P(z) z^-delay sum c_i z^-i`` with P the
mode behind a zero-order hold, and beside it what a bending mode of the surface
adds to what the sensors see.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.protocols import Array

LEAST_RATIO = 1e-4  # damping ratio that margins assume at least, so that an ideal mode has a finite peak


@dataclass(frozen=True, kw_only=True)
class BendingMode:
    """A mode of the surface beyond the controlled coordinates, as the loop sees it.

    Parameters
    ----------
    frequency : float, Hz
        Where it lies, > 0.
    damping : float
        Its damping ratio, >= 0.
    coupling : tuple of float, 1/kg
        For each coordinate, acceleration that the sensors show per force, short
        of the restoring force: shape at the sensors times shape at the drive
        over modal mass.  Negative where sensors and drive move apart.
    spread : float, Hz
        How far off `frequency` it may lie, >= 0.
    measured : bool
        False for an estimate: then the coupling may have either sign, and Q stays at 2 or above.
    """

    frequency: float
    damping: float
    coupling: tuple[float, ...]
    spread: float = 100.0
    measured: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.frequency) and self.frequency > 0):
            raise ValueError(f"frequency = {self.frequency!r}: must be > 0 Hz")
        if not (math.isfinite(self.damping) and self.damping >= 0):
            raise ValueError(f"damping = {self.damping!r}: must be >= 0")
        if not 0 <= self.spread < self.frequency:
            raise ValueError(f"spread = {self.spread!r}: must be between 0 and {self.frequency:g} Hz")

    def corners(self) -> tuple[BendingMode, ...]:
        """Return the mode at either end of its spread, and with either sign where it is an estimate."""
        return tuple(
            replace(self, frequency=self.frequency + shift, coupling=tuple(sign * each for each in self.coupling))
            for sign in ((1,) if self.measured else (1, -1))
            for shift in (-self.spread, self.spread)
        )


@dataclass(frozen=True, kw_only=True)
class DampingMargins:
    """What the inner loop of one coordinate can bear; `damping_margins` computes it.

    Attributes
    ----------
    stable : bool
        Whether the closed loop is stable (Nyquist count); where it is not, there are no margins.
    peak_sensitivity : float
        Ms, the largest 1/abs(1 + L).
    gain_margin : float
        Smallest factor above 1 on the gain that makes the loop unstable.
    phase_margin : float, rad
        Smallest turn, forwards or back, that brings L to -1 where abs(L) = 1.
    delay_margin : float, s
        Smallest further delay that makes the loop unstable.
    noise : float
        Motion that white noise of the sensors causes, rms of the coordinate per rms of each sensor.
    """

    stable: bool
    peak_sensitivity: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    noise: float

    def __str__(self) -> str:
        if not self.stable:
            return "unstable"
        return (
            f"Ms {self.peak_sensitivity:.2f}, gain margin {self.gain_margin:.1f}, "
            f"phase margin {math.degrees(self.phase_margin):.0f} deg, delay margin {1e3 * self.delay_margin:.2f} ms, "
            f"noise {self.noise:.2f} um per um of sensor noise"
        )


def modes_of(model: BandModel) -> tuple[Array, Array]:
    """Mode (rad/s) and damping ratio of each coordinate taken alone."""
    mass, damping, stiffness = model.mass.diagonal(), model.damping.diagonal(), model.stiffness.diagonal()
    mode = np.sqrt(stiffness / mass)
    return mode, damping / (2 * mass * mode)


def _held_mode(z: Array, rate: float, omega: float, ratio: float, push: float) -> Array:
    """Response at z (on the unit circle) of ``push/(s^2 + 2 ratio omega s + omega^2)`` behind a zero-order hold.

    By residues: each pole l gives r (e^(l T) - 1)/(l (z - e^(l T))) with r the residue of the continuous mode.
    """
    ratio = max(ratio, LEAST_RATIO)
    apart = np.sqrt(complex(ratio * ratio - 1.0)) or 1e-9  # a double pole is parted by a hair
    poles = omega * (-ratio + apart * np.array([1.0, -1.0]))
    residues = push / (poles - poles[::-1])
    grown = np.exp(poles / rate)
    return sum(r * (e - 1) / (pole * (z - e)) for r, e, pole in zip(residues, grown, poles, strict=True))


def _grid(model: BandModel, modes: Iterable[tuple[float, float]]) -> Array:
    """Frequencies (Hz) up to half the rate, dense at each mode (rad/s, damping ratio) and as fine as the delay asks."""
    half = model.rate / 2
    parts = [np.linspace(0.0, half, max(4096, 8 * (model.delay + 1)) + 1)]
    for omega, ratio in modes:
        hertz = omega / (2 * np.pi)
        near = hertz * (1 + max(ratio, LEAST_RATIO) * np.sinh(np.linspace(-9.0, 9.0, 1201)))
        parts.append(abs(near - model.rate * np.round(near / model.rate)))  # beyond half the rate it folds back
    frequency = np.unique(np.concatenate(parts))
    return frequency[frequency > 0]


def damping_margins(model: BandModel, taps: Array, *, bending: BendingMode | None = None) -> tuple[DampingMargins, ...]:
    """Margins of the inner loop, coordinate by coordinate.

    Parameters
    ----------
    model : BandModel
        The free device; the coupling between its coordinates is left out.
    taps : ndarray, shape (coordinates, n), N/m
        Of `damping_taps`.
    bending : BendingMode, optional
        A mode of the surface in the loop; its spread is not looked at.

    Returns
    -------
    tuple of DampingMargins
        One a coordinate.

    Notes
    -----
    L(z) = P(z) z^-delay sum c_i z^-i, exact in discrete time.  Frequencies are a grid that is dense at the modes;
    crossings are interpolated in it.  No Table 1 finger on the plate raises Ms (tested).
    """
    mode, ratio = modes_of(model)
    gain = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1))
    found = []
    for c in range(len(mode)):
        modes = [(float(mode[c]), float(ratio[c]), 1.0 / float(model.mass[c, c]))]
        if bending is not None and bending.coupling[c] != 0.0:
            modes.append((2 * np.pi * bending.frequency, bending.damping, bending.coupling[c]))
        frequency = _grid(model, [each[:2] for each in modes])
        z = np.exp(2j * np.pi * frequency / model.rate)
        plant = sum(_held_mode(z, model.rate, *each) for each in modes)
        loop = plant * z**-model.delay * np.polyval(taps[c, ::-1], 1 / z)
        found.append(_margins_of(frequency, loop, model.rate, float(gain[c])))
    return tuple(found)


def _margins_of(frequency: Array, loop: Array, rate: float, gain: float) -> DampingMargins:
    """Margins read off L on a grid from near 0 Hz to half the rate; `gain` takes sensor noise to the coordinate."""
    difference = 1 + loop
    peak = float((1 / abs(difference)).max())
    turns = np.angle(difference[1:] / difference[:-1]).sum() / np.pi
    if round(turns) != 0:  # the open loop is stable: any encirclement is an unstable pole
        return DampingMargins(
            stable=False, peak_sensitivity=peak, gain_margin=0.0, phase_margin=0.0, delay_margin=0.0, noise=math.inf
        )
    index = np.arange(frequency.size)
    at = _crossings(np.log(abs(loop)))
    crossover = np.interp(at, index, frequency)
    phase = np.angle(-np.interp(at, index, loop.real) - 1j * np.interp(at, index, loop.imag))
    reversal = _crossings(loop.imag)
    real = np.interp(reversal, index, loop.real)
    factors = -1 / real[real < 0]
    closed = abs(loop / difference) ** 2
    power = np.sum((closed[1:] + closed[:-1]) / 2 * np.diff(frequency)) / (rate / 2)
    return DampingMargins(
        stable=True,
        peak_sensitivity=peak,
        gain_margin=float(np.min(factors[factors > 1], initial=math.inf)),
        phase_margin=float(np.min(abs(phase), initial=math.inf)),
        delay_margin=float(np.min(np.mod(phase, 2 * np.pi) / (2 * np.pi * crossover), initial=math.inf)),
        noise=gain * math.sqrt(power),
    )


def _crossings(values: Array) -> Array:
    """Fractional indices at which `values` cross zero."""
    before = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return before + values[before] / (values[before] - values[before + 1])
