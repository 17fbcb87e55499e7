"""The sampled plate fitted to spectra: first the equation error, which is linear, then the output error.

Bin by bin the sensors show

    Y = G S (z - Phi)^-1 ((Gamma_0 + Gamma_1/z) z^-d U + z x)

U is the drive that was sent; Phi, Gamma the plate discretised exactly for a
held drive that comes d + e samples late, so that the images of the hold and
any fraction of a sample are in it.  S takes states to the glass ends, G =
diag(1 - g/2, 1 + g/2) holds the gain difference g of the sensors, and x, four
numbers, is the free motion that the record began with less the one it ended
with.  Where the glass is believed to bend, its bending mode is in it as it is
believed, a fixed part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hapticrender.plants.multisine import PATTERNS, Multisine
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array

MECHANICAL = ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2")
DELAY, GAIN, FREE = 6, 7, 8  # places of the unknowns behind the logarithms of the six; free motion comes last
LEAST_RATIO = 0.1  # of what a parameter is believed to be: where the search for it starts at the latest
LEAST_DAMPING = 1e-3  # of the critical one
TURNS = 30  # of the search
LONGEST_STEP = 0.5  # of a logarithm or a sample, in one turn
NUDGE = 1e-7  # for slopes
DONE = 1e-9  # share of the error that a turn still takes away
SERIES_ROUNDING = 1e-17
ROUNDING = 1e-9  # of the motion: what no sensor resolves, and the least noise that is believed
CHANCE = 5.0  # sigmas of the spread of a ratio of variances, beyond which it is not chance


@dataclass(frozen=True, kw_only=True)
class Record:
    """Spectra of drive and motion (amplitudes), at bin 0 and from below the first line to above the last.

    Parameters
    ----------
    rate : float, Hz
        Sampling rate.
    samples : int
        Length of the record.
    turn : ndarray, shape (n,)
        Frequency of each bin over rate; the first is 0, which no fit looks at.
    drive : ndarray of complex, shape (n, 2), A
        Of each coil.
    sensed : ndarray of complex, shape (n, 2), m
        Of each end of the glass.
    on_line : ndarray of bool, shape (n,)
        Bins that were driven on purpose.
    """

    rate: float
    samples: int
    turn: Array
    drive: Array
    sensed: Array
    on_line: Array

    @property
    def between(self) -> Array:
        """Bins between the lines, which show the noise."""
        return ~self.on_line & (self.turn > 0)


class Fit(NamedTuple):
    """Where a search ended.

    `plate` as found; `unknown` (8,): logarithms of the six over where they began, delay (samples), gain difference;
    `covariance` (8, 8) of `unknown` at a variance of 1 m2 of every real number of the spectra; `left` (n, 2), m: sensed
    less predicted at all bins, the static one included.
    """

    plate: PlateParameters
    unknown: Array
    covariance: Array
    left: Array


def spectra(rate: float, sine: Multisine, sensed: Array) -> Record:
    """Take the spectra of one period of a multi-sine and of what was `sensed` (m, shape (samples, 2))."""
    samples = len(sensed)
    margin = max(int(sine.bins[0]) // 2, 1)
    bins = np.r_[0, sine.bins[0] - margin : sine.bins[-1] + margin + 1]
    return Record(
        rate=rate,
        samples=samples,
        turn=bins / samples,
        drive=np.fft.rfft(sine.drive, axis=0)[bins] * (2 / samples),
        sensed=np.fft.rfft(sensed, axis=0)[bins] * (2 / samples),
        on_line=np.isin(bins, sine.bins),
    )


def gains(difference: float) -> Array:
    """Gains of the two sensors, mean 1."""
    return np.array([1 - difference / 2, 1 + difference / 2])


def ends_from_coordinate(plate: PlateParameters) -> Array:
    """Ends of the glass from heave and rocking, shape (2, 2)."""
    reach = plate.glass_length / plate.coil_spacing
    return np.array([[1.0, -reach], [1.0, reach]])


def _exponential(matrix: Array) -> Array:
    """Exponential of a small matrix of norm below a few, by its series."""
    total: Array = np.eye(len(matrix))
    term, n = total, 0
    while abs(term).max() > SERIES_ROUNDING:
        n += 1
        term = matrix @ term / n
        total = total + term
    return total


def _generator(plate: PlateParameters, period: float) -> Array:
    """Rates of change in a period, shape (n, n + 2): of positions, of period times their rates, by both coils.

    Positions are heave, rocking and, where the glass bends, the bending that the sensors show, which no free plate
    couples to the others.
    """
    inverse = np.linalg.inv(plate.mass_matrix)
    hold, drag, push = (
        inverse @ each for each in (plate.stiffness_matrix, plate.damping_matrix, plate.force_from_drive)
    )
    if plate.bending_frequency:
        turning = 2 * np.pi * plate.bending_frequency
        hold = _beside(hold, turning**2)
        drag = _beside(drag, 2 * plate.bending_damping * turning)
        push = np.vstack([push, np.full(2, plate.bending_coil / plate.bending_mass * plate.force_constant)])
    none, one = np.zeros_like(hold), np.eye(len(hold))
    return np.block([[none, one, np.zeros_like(push)], [-(period**2) * hold, -period * drag, period**2 * push]])


def _beside(matrix: Array, value: float) -> Array:
    """Block-diagonal matrix of `matrix` and one number more."""
    grown = np.zeros(np.array(matrix.shape) + 1)
    grown[:-1, :-1] = matrix
    grown[-1, -1] = value
    return grown


def _held(generator: Array, share: float) -> tuple[Array, Array]:
    """State and input matrix over `share` of a period of held drive."""
    states = len(generator)
    moved = _exponential(share * np.vstack([generator, np.zeros((2, states + 2))]))
    return moved[:states, :states], moved[:states, states:]


def sampled_response(plate: PlateParameters, rate: float, late: float, turn: Array) -> tuple[Array, Array]:
    """Ends of the free plate's glass in discrete time, per drive and per free motion.

    Parameters
    ----------
    plate : PlateParameters
        The plate.
    rate : float, Hz
        Sampling rate.
    late : float, samples
        Delay of the held drive, any fraction.
    turn : ndarray, shape (n,)
        Frequency over rate.

    Returns
    -------
    driven : ndarray of complex, shape (n, 2, 2), m/A
        Both ends per coil current, all images of the hold in it.
    free : ndarray of complex, shape (n, 2, states)
        The same per state (m) that the record began with less the one it ended with.
    """
    whole = math.floor(late)
    generator = _generator(plate, 1 / rate)
    first, push_first = _held(generator, late - whole)
    second, push_second = _held(generator, 1 - (late - whole))
    ends = np.hstack([ends_from_coordinate(plate), np.ones((2, len(first) // 2 - 2)), np.zeros((2, len(first) // 2))])
    z = np.exp(2j * np.pi * turn)[:, None, None]
    free = ends @ np.linalg.inv(z * np.eye(len(first)) - second @ first)
    return (free @ (push_second + second @ push_first / z)) * z**-whole, free * z


def equation_error(believed: PlateParameters, record: Record, latest: int) -> tuple[PlateParameters, int]:
    """First idea of a rigid plate and of the whole samples, up to `latest`, by which its drive comes late.

    With the motion known, the force balance of heave and rocking at the lines is linear in the six numbers, and a
    delay only turns its forces: the one that leaves least is taken.
    """
    line = record.on_line
    s = 2j * np.pi * record.rate * record.turn[line]
    mass, stiffness = believed.mass_matrix.diagonal(), believed.stiffness_matrix.diagonal()
    weight = 1 / (mass[:, None] * abs(s) ** 2 + stiffness[:, None])
    columns = _balance(s, *np.linalg.solve(ends_from_coordinate(believed), record.sensed[line].T))
    force = believed.force_from_drive @ record.drive[line].T * np.sinc(record.turn[line])
    turned = np.exp(-2j * np.pi * np.outer(record.turn[line], np.arange(latest + 1) + 0.5))
    unknown = _stacked((columns * weight[:, None]).transpose(0, 2, 1).reshape(-1, 6))
    forces = _stacked(((force * weight)[:, :, None] * turned).reshape(-1, latest + 1))
    basis, triangle = np.linalg.qr(unknown)
    shares = basis.T @ forces
    late = int((shares**2).sum(axis=0).argmax())
    return _plausible(believed, np.linalg.solve(triangle, shares[:, late])), late


def _balance(s: Array, heave: Array, rocking: Array) -> Array:
    """Forces on heave and rocking per m, I/a^2, b2 + b1, b2 - b1, k2 + k1, k2 - k1; shape (2, 6, n)."""
    none = np.zeros_like(heave)
    return np.array(
        [
            [s * s * heave, none, s * heave, s * rocking, heave, rocking],
            [none, s * s * rocking, s * rocking, s * heave, rocking, heave],
        ]
    )


def _plausible(believed: PlateParameters, solved: Array) -> PlateParameters:
    """Plate of the six solved numbers, none of them below a tenth of what is believed."""
    mass, turning, damping, tilt, hold, skew = solved
    found = (
        mass,
        turning * believed.half_spacing**2,
        (hold - skew) / 2,
        (hold + skew) / 2,
        (damping - tilt) / 2,
        (damping + tilt) / 2,
    )
    critical = 2 * math.sqrt(believed.mass * (believed.stiffness_1 + believed.stiffness_2))
    floor = {name: LEAST_DAMPING * critical for name in ("damping_1", "damping_2")}
    changes: dict[str, Any] = {
        name: max(float(value), LEAST_RATIO * max(getattr(believed, name), floor.get(name, 0.0)))
        for name, value in zip(MECHANICAL, found, strict=True)
    }
    return replace(believed, **changes)


def _stacked(values: Array) -> Array:
    """Complex rows as twice as many real ones."""
    return np.concatenate([values.real, values.imag])


def _plate_at(plate: PlateParameters, unknown: Array) -> PlateParameters:
    changes: dict[str, Any] = {
        name: float(getattr(plate, name) * math.exp(unknown[place])) for place, name in enumerate(MECHANICAL)
    }
    return replace(plate, **changes)


def _predicted(plate: PlateParameters, record: Record, unknown: Array) -> Array:
    """Motion of the ends (m, shape (n, 2)) at all bins."""
    driven, free = sampled_response(_plate_at(plate, unknown), record.rate, unknown[DELAY], record.turn)
    moved = (driven @ record.drive[:, :, None])[..., 0] + free @ unknown[FREE:]
    return moved * gains(unknown[GAIN])


def output_error(plate: PlateParameters, late: float, record: Record, *, find_gains: bool) -> Fit:
    """Gauss-Newton with step halving, from `plate` and `late` (samples).

    Raises
    ------
    numpy.linalg.LinAlgError
        The record does not tell all unknowns.
    """
    states = len(_generator(plate, 1 / record.rate))
    scale = np.r_[np.ones(FREE), np.full(states, abs(record.sensed[1:]).max())]
    searched = np.array([place for place in range(len(scale)) if find_gains or place != GAIN])

    def error(at: Array) -> Array:
        return _stacked((record.sensed - _predicted(plate, record, at))[1:].ravel())

    def slopes(at: Array, here: Array) -> Array:
        nudges = (NUDGE * scale * unit for unit in np.eye(len(scale))[searched])
        return np.stack([(here - error(at + nudge)) / NUDGE for nudge in nudges], axis=1)

    unknown = np.r_[np.zeros(DELAY), late, np.zeros(1 + states)]
    here = error(unknown)
    for _ in range(TURNS):
        jacobian = slopes(unknown, here)
        step = np.zeros(len(scale))
        step[searched] = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ here) * scale[searched]
        step *= LONGEST_STEP / max(abs(step[:FREE]).max(), LONGEST_STEP)
        there = error(unknown + step)
        while there @ there > here @ here and abs(step[:FREE]).max() > NUDGE:
            step /= 2
            there = error(unknown + step)
        gained = here @ here - there @ there
        if gained > 0:
            unknown, here = unknown + step, there
        if not gained > DONE * (here @ here):
            break
    jacobian = slopes(unknown, here)
    covariance = np.zeros((len(scale), len(scale)))
    covariance[np.ix_(searched, searched)] = np.linalg.inv(jacobian.T @ jacobian)
    return Fit(
        _plate_at(plate, unknown),
        unknown[:FREE],
        covariance[:FREE, :FREE],
        record.sensed - _predicted(plate, record, unknown),
    )


def static_load(fit: Fit) -> float:
    """Load (N) that the found plate sags under."""
    sag = np.linalg.solve(ends_from_coordinate(fit.plate), fit.left[0].real / 2)
    return -float((fit.plate.stiffness_matrix @ sag)[0])


def variances(fit: Fit, record: Record) -> tuple[float, float, float]:
    """Variance (m2) of what is left in every real number on the lines and between, and the most that their misfit is.

    The ratio of the two variances has about the variance 2/n_1 + 2/n_2, n the numbers in each less those found.
    """
    power = abs(fit.left) ** 2
    found = np.count_nonzero(np.diagonal(fit.covariance))
    counts = 4 * record.on_line.sum() - found, 4 * record.between.sum()
    floor = (ROUNDING * abs(record.sensed[record.on_line]).max()) ** 2
    on_lines, between = (
        max(float(power[bins].sum() / count), floor)
        for bins, count in zip((record.on_line, record.between), counts, strict=True)
    )
    return on_lines, between, math.sqrt(1 + CHANCE * math.sqrt(2 / counts[0] + 2 / counts[1]))


def measured_lines(fit: Fit, record: Record, sine: Multisine) -> Array:
    """Heave and rocking per coil current at the lines: the found plate's, and what was measured besides."""
    lines, each = record.on_line, np.arange(len(sine.bins))
    turn = record.turn[lines]
    besides = np.linalg.solve(ends_from_coordinate(fit.plate), (fit.left[lines] / gains(fit.unknown[GAIN])).T).T
    current = (record.drive[lines] @ PATTERNS / 2)[each, sine.coordinate]
    hold = np.sinc(turn) * np.exp(-2j * np.pi * turn * (fit.unknown[DELAY] + 0.5))
    model = fit.plate.band_model(record.rate, 1).response(turn * record.rate) @ PATTERNS
    return model[each, :, sine.coordinate] + besides / (current * hold)[:, None]
