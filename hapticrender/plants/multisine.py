"""Multi-sine that excites a plate for identification: lines of equal motion, alternately heave and rocking.

Above them follow lines of equal current in heave, which excite a bending mode.
"""

import math
from typing import NamedTuple

import numpy as np

from hapticrender.checks import require
from hapticrender.plants.plate import SIDES, PlateParameters
from hapticrender.protocols import Array

GRID = 12.0  # Hz between lines
DENSE = 3.0  # Hz between lines within AROUND of a mode
AROUND = 12.0  # Hz
REACH_UP = 2.1  # highest line over highest mode
HIGHEST_SHARE = 0.4  # of the sampling rate: bound of the highest line of equal motion
BENDING_TOP, BENDING_SHARE = 2200.0, 0.44  # Hz, of the sampling rate: bounds of the lines for a bending mode
BENDING_GRID = 9.0  # Hz between these: a mode of 700 Hz and Q 50 is 14 Hz wide
CREST_ROUNDS = 200
CREST_CLIP = 0.6  # of the peak


class Multisine(NamedTuple):
    """One period of drive, and its lines."""

    bins: Array  # lines of equal motion, in periods a record, ascending
    above: Array  # bins of the lines of equal current in heave, ascending
    drive: Array  # one period, rounded to the steps of the command (A, (samples, 2))


def design_multisine(parameters: PlateParameters, rate: float, samples: int, amplitude: float) -> Multisine:
    """Design lines on a 12 Hz grid, and 3 Hz apart around both modes, that move the glass ends by `amplitude`.

    `amplitude` (m) is the largest displacement of an end of the expected plate; lines are whole multiples of
    `rate`/`samples` (Hz).  The lines above them, 9 Hz apart up to 2.2 kHz, add as much current again.

    A ValueError where the record is too short to resolve a mode (two lines within its half-power width 2 zeta f:
    samples/rate >= 1/(zeta f)), the motion leaves the sensors' range, the drive its limit, or a mode lies too near half
    the rate.
    """
    modes, ratios = parameters.modes()
    _check(parameters, rate, samples, amplitude, modes, ratios)
    bins = _lines(modes, rate, samples)
    coordinate = np.arange(len(bins)) % 2
    model = parameters.device_model(rate, parameters.delay)
    base = rate / samples
    frequency = bins * base
    moved = model.response(frequency) * model.hold_and_delay(frequency)[:, None, None]
    ends = model.place_from_coordinate[1:] @ moved
    own = np.diagonal(moved @ SIDES, axis1=1, axis2=2)[np.arange(len(bins)), coordinate]
    at_end = own * model.place_from_coordinate[2, coordinate]
    current = (np.exp(1j * _phases(bins, coordinate, samples)) / at_end)[:, None] * SIDES.T[coordinate]
    motion = amplitude / float(abs(_period(bins, (ends @ current[:, :, None])[..., 0], samples)).max())
    drive = motion * _period(bins, current, samples)
    above = _spaced(REACH_UP * modes.max(), min(BENDING_TOP, BENDING_SHARE * rate), BENDING_GRID, base)
    if len(above):
        heave = np.zeros(len(above), int)
        probe = _period(above, np.exp(1j * _phases(above, heave, samples))[:, None] * SIDES.T[heave], samples)
        drive += probe * (abs(drive).max() / abs(probe).max())
    if parameters.current_step:
        drive = parameters.current_step * np.round(drive / parameters.current_step)
    peak = float(abs(drive).max())
    if peak > parameters.current_limit:
        raise ValueError(
            f"amplitude = {amplitude:g} m: needs {peak:.3g} A, must be <= {parameters.current_limit:g} A; "
            f"the drive allows {amplitude * parameters.current_limit / peak:.3g} m"
        )
    return Multisine(bins, above, drive)


def _check(
    parameters: PlateParameters, rate: float, samples: int, amplitude: float, modes: Array, ratios: Array
) -> None:
    """Refuse an excitation that cannot be played, or that resolves too little."""
    bound = parameters.sensor_range / 2
    require(0.0 < amplitude <= bound, "amplitude", amplitude, f"> 0 and <= {bound:g} m, the sensors' range")
    least = REACH_UP * modes.max() / HIGHEST_SHARE
    if rate < least:
        raise ValueError(f"rate = {rate:g} Hz: must be >= {least:.4g} Hz for a mode at {modes.max():.4g} Hz")
    width = max(float((ratios * modes).min()), GRID / 6)
    if samples < rate / width:
        raise ValueError(f"seconds = {samples / rate:g}: must be >= {1 / width:.3g} s to resolve the narrowest mode")


def _lines(modes: Array, rate: float, samples: int) -> Array:
    """Bins of the lines, ascending."""
    base = rate / samples
    dense = np.concatenate([_spaced(mode - AROUND, mode + AROUND, DENSE, base) for mode in modes])
    grid = _spaced(GRID, REACH_UP * modes.max(), GRID, base)
    apart = abs(grid[:, None] - dense).min(axis=1) * base
    return np.unique(np.concatenate([grid[apart >= DENSE], dense]))


def _spaced(first: float, last: float, spacing: float, base: float) -> Array:
    """Bins (multiples of `base`, Hz) about `spacing` apart from `first` to `last` (Hz)."""
    return np.arange(math.ceil(first / base), math.floor(last / base) + 1, max(round(spacing / base), 1))


def _phases(bins: Array, coordinate: Array, samples: int) -> Array:
    """Phases (rad) of low crest at both ends: Schroeder's, then alternately clipped and set back to equal amplitudes.

    Van der Ouderaa, Schoukens & Renneboog 1988, IEEE Trans. Instrum. Meas. 37, 145.
    """
    count = np.arange(len(bins))
    phase = -math.pi * count * (count - 1) / len(bins)
    signs = SIDES.T[coordinate]
    for _ in range(CREST_ROUNDS):
        ends = _period(bins, np.exp(1j * phase)[:, None] * signs, samples)
        bound = CREST_CLIP * abs(ends).max()
        clipped = np.fft.rfft(np.clip(ends, -bound, bound), axis=0)[bins]
        phase = np.angle((clipped * signs).sum(axis=1))
    return phase


def _period(bins: Array, lines: Array, samples: int) -> Array:
    """One period, shape (samples, 2), of `lines` (n, 2)."""
    spectrum = np.zeros((samples // 2 + 1, 2), complex)
    spectrum[bins] = lines
    return np.fft.irfft(spectrum * (samples / 2), samples, axis=0)
