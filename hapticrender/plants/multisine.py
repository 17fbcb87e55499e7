"""The sound that a plate is known by: lines of equal motion, alternately heave and rocking, of low crest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array

GRID = 12.0  # Hz between lines
DENSE = 3.0  # Hz between lines around a mode
AROUND = 12.0  # Hz on either side of a mode that count as around it
REACH_UP = 2.1  # the highest line over the highest mode
HIGHEST_SHARE = 0.4  # of the sampling rate, where the highest line must lie below
PATTERNS = np.array([[1.0, -1.0], [1.0, 1.0]])  # coil currents (rows) that drive heave and rocking (columns)
CREST_ROUNDS = 200
CREST_CLIP = 0.6  # of the peak: deep clips, falling behind the peak as it falls


@dataclass(frozen=True, kw_only=True)
class Multisine:
    """One period of drive and the lines that are in it.

    Parameters
    ----------
    bins : ndarray of int, shape (n,)
        Lines, in periods a record, ascending.
    coordinate : ndarray of int, shape (n,)
        What each line drives: 0 heave, 1 rocking.
    drive : ndarray, shape (samples, 2), A
        One period, on the steps of the command.
    motion : float, m
        Amplitude of every line at the ends of the glass, on the plate that it was designed for.
    """

    bins: Array
    coordinate: Array
    drive: Array
    motion: float


def design_multisine(parameters: PlateParameters, rate: float, samples: int, amplitude: float) -> Multisine:
    """Lines on a 12 Hz grid and 3 Hz around both modes, every second one rocking, `amplitude` (m) at the worst end.

    Parameters
    ----------
    parameters : PlateParameters
        The plate as it is believed to be.
    rate : float, Hz
        Sampling rate.
    samples : int
        Length of a period; lines are whole multiples of rate/samples.
    amplitude : float, m, > 0
        Largest displacement of a glass end on that plate.

    Returns
    -------
    Multisine
        Its drive, one period, quantised as the command is.

    Raises
    ------
    ValueError
        The record is too short to resolve a mode, the motion leaves the sensors' range, the drive its limit, or a
        mode lies too near half the rate.

    Notes
    -----
    A mode of half-power width 2 zeta f is resolved by two lines within it: samples/rate >= 1/(zeta f).
    """
    modes, ratios = parameters.modes()
    _check(parameters, rate, samples, amplitude, modes, ratios)
    bins = _lines(modes, rate, samples)
    coordinate = np.arange(len(bins)) % 2
    drive, ends = _played(parameters, rate, samples, bins, coordinate)
    motion = amplitude / float(abs(ends).max())
    drive *= motion
    step = parameters.current_step
    if step:
        drive = step * np.round(drive / step)
    peak = float(abs(drive).max())
    if peak > parameters.current_limit:
        raise ValueError(
            f"amplitude = {amplitude:g} m: needs {peak:.3g} A, must be <= {parameters.current_limit:g} A; "
            f"the drive allows {amplitude * parameters.current_limit / peak:.3g} m"
        )
    return Multisine(bins=bins, coordinate=coordinate, drive=drive, motion=motion)


def _check(
    parameters: PlateParameters, rate: float, samples: int, amplitude: float, modes: Array, ratios: Array
) -> None:
    """Refuse what cannot be played or would not tell enough."""
    if not (math.isfinite(amplitude) and 0.0 < amplitude <= parameters.sensor_range / 2):
        bound = parameters.sensor_range / 2
        raise ValueError(f"amplitude = {amplitude!r}: must be > 0 and <= {bound:g} m, the sensors' range")
    if REACH_UP * modes.max() > HIGHEST_SHARE * rate:
        bound = REACH_UP * modes.max() / HIGHEST_SHARE
        raise ValueError(f"rate = {rate:g} Hz: must be >= {bound:.4g} Hz for a mode at {modes.max():.4g} Hz")
    width = max(float((ratios * modes).min()), GRID / 6)
    if samples < rate / width:
        raise ValueError(f"seconds = {samples / rate:g}: must be >= {1 / width:.3g} s to resolve the narrowest mode")


def _lines(modes: Array, rate: float, samples: int) -> Array:
    """Bins of the lines, ascending."""
    base = rate / samples

    def spaced(first: float, last: float, spacing: float) -> Array:
        stride = max(round(spacing / base), 1)
        return np.arange(math.ceil(first / base), math.floor(last / base) + 1, stride)

    dense = np.concatenate([spaced(mode - AROUND, mode + AROUND, DENSE) for mode in modes])
    grid = spaced(GRID, REACH_UP * modes.max(), GRID)
    apart = abs(grid[:, None] - dense).min(axis=1) * base
    return np.unique(np.concatenate([grid[apart >= DENSE], dense]))


def _phases(bins: Array, coordinate: Array, samples: int) -> Array:
    """Phases (rad) of low crest at both ends: Schroeder's, then clipped and given their amplitudes back in turn."""
    count = np.arange(len(bins))
    phase = -math.pi * count * (count - 1) / len(bins)
    for _ in range(CREST_ROUNDS):
        line = np.exp(1j * phase)
        ends = _period(bins, np.stack([np.where(coordinate == 0, line, -line), line], axis=1), samples)
        bound = CREST_CLIP * abs(ends).max()
        first, second = np.fft.rfft(np.clip(ends, -bound, bound), axis=0)[bins].T
        phase = np.angle(np.where(coordinate == 0, second + first, second - first))
    return phase


def _period(bins: Array, lines: Array, samples: int) -> Array:
    """One period, shape (samples, 2), of `lines` (n, 2)."""
    spectrum = np.zeros((samples // 2 + 1, 2), complex)
    spectrum[bins] = lines
    return np.fft.irfft(spectrum * (samples / 2), samples, axis=0)


def _played(
    parameters: PlateParameters, rate: float, samples: int, bins: Array, coordinate: Array
) -> tuple[Array, Array]:
    """Drive (A) that gives every line an amplitude of 1 m at the ends, and how both ends then move (m).

    Lines of heave rock the plate a little, and the other way round, where its two sides differ.
    """
    model = parameters.band_model(rate, parameters.delay)
    frequency = bins * (rate / samples)
    moved = model.response(frequency) * model.hold_and_delay(frequency)[:, None, None]
    reach = parameters.glass_length / parameters.coil_spacing
    of_pattern = moved @ PATTERNS
    at_end = np.where(coordinate == 0, of_pattern[:, 0, 0], reach * of_pattern[:, 1, 1])
    current = (np.exp(1j * _phases(bins, coordinate, samples)) / at_end)[:, None] * PATTERNS.T[coordinate]
    heave, rocking = (moved @ current[:, :, None])[..., 0].T
    ends = np.stack([heave - reach * rocking, heave + reach * rocking], axis=1)
    return _period(bins, current, samples), _period(bins, ends, samples)
