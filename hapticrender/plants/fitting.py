"""Fit the sampled plate to spectra: first the equation error, which is linear, then the output error.

In every bin the measured spectrum is

    Y = G S (z - Phi)^-1 ((Gamma_0 + Gamma_1/z) z^-d U + z x)

U is the drive; Phi and Gamma are the plate discretised exactly for a held drive that is d + e samples late, so that
the images of the hold and any fraction e of a sample are included.  S takes states to the glass ends, G = c diag(1 -
g/2, 1 + g/2) holds the sensor gains, of known mean c and unknown difference g, and x is the free motion at the
beginning of the record less that at its end.  Where the glass bends, frequency, damping and shape at the coils of its
mode are fitted with the rest, from where a template of a mode explains most of what a rigid plate leaves.

Equation and output error: Pintelon & Schoukens, System Identification, 2nd ed. 2012, sections 9.8 and 9.10.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from hapticrender.control.probe import WIRINGS
from hapticrender.errors import DesignError
from hapticrender.plants.multisine import Multisine
from hapticrender.plants.plate import SIDES, PlateParameters, structure
from hapticrender.protocols import Array

MECHANICAL = ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2")
BENDING = ("bending_frequency", "bending_damping", "bending_coil")
DELAY, GAIN, FREE = 6, 7, 8  # columns of the unknowns behind the logarithms of the six; then mode and free motion
CLEAREST = 5.0  # standard deviations: least shape at the coils that is taken for a bending mode
TRIED_DAMPING = (0.01, 0.03)  # of the templates of a mode
LEAST_RATIO = 0.1  # of the expected value: lower bound of the starting point
LEAST_DAMPING = 1e-3  # of the critical one: the same for a plate that is expected to have none
ROUNDING = 1e-9  # of the motion: least noise that is assumed
CHANCE = 5.0  # standard deviations of a ratio of variances
EXPLAINED = 0.95  # least share of the drive force that the equation error must explain; 0.996 under a heavy finger


@dataclass(frozen=True, kw_only=True)
class Record:
    """Spectra of drive and measurement (amplitudes): at bin 0, all over the lines of equal motion, at lines above."""

    rate: float  # Hz
    samples: int  # of the record
    turn: Array  # frequency of each bin over rate (n,); the first is 0 and is not fitted
    drive: Array  # of each coil (complex A, (n, 2))
    sensed: Array  # of each sensor (complex m, (n, 2))
    on_line: Array  # bins of the multi-sine's lines (bool, (n,))
    above: Array  # of these, the lines of equal current above the rigid modes (bool, (n,))

    @property
    def lines(self) -> Array:
        """Lines of equal motion."""
        return self.on_line & ~self.above

    @property
    def between(self) -> Array:
        """Bins between the lines, which show the noise."""
        return ~self.on_line & (self.turn > 0)


class Fit(NamedTuple):
    """Result of a search."""

    plate: PlateParameters  # with the identified parameters, sensor gains included
    unknown: Array  # logarithms of the six over their start, delay (samples), gain difference, logarithms of `BENDING`
    covariance: Array  # of `unknown` at a variance of 1 m2 of every real number of the spectra (8, 8) or (11, 11)
    left: Array  # measured less predicted at all bins, the static one included (m, (n, 2))


def spectra(rate: float, sine: Multisine, sensed: Array) -> Record:
    """Compute the spectra of one period of a multi-sine and of the measurement (m, shape (samples, 2))."""
    samples = len(sensed)
    margin = max(int(sine.bins[0]) // 2, 1)
    bins = np.r_[0, sine.bins[0] - margin : sine.bins[-1] + 1, sine.above]
    return Record(
        rate=rate,
        samples=samples,
        turn=bins / samples,
        drive=np.fft.rfft(sine.drive, axis=0)[bins] * (2 / samples),
        sensed=np.fft.rfft(sensed, axis=0)[bins] * (2 / samples),
        on_line=np.isin(bins, [*sine.bins, *sine.above]),
        above=np.isin(bins, sine.above),
    )


def sensor_gains(plate: PlateParameters) -> tuple[float, float]:
    """Mean of the two sensor gains, and their difference (2 less 1) over the mean."""
    mean = (plate.sensor_gain_1 + plate.sensor_gain_2) / 2
    return mean, (plate.sensor_gain_2 - plate.sensor_gain_1) / mean


def sampled_response(plate: PlateParameters, rate: float, late: float, turn: Array) -> tuple[Array, Array]:
    """Compute the motion of the glass ends in discrete time at `turn` (frequency over rate, shape (n,)).

    Per coil current (m/A, (n, 2, 2)) held `late` samples late, any fraction, all images of the hold included; and per
    free motion (n, 2, states), whose states are coordinates (m) and their rates times the period (m).
    """
    body = structure(plate)
    count = len(body.mass)
    whole = math.floor(late)
    share = max(late - whole, 1e-12)  # of a period, in which the drive before is still held
    first, push_first = body.zero_order_hold(rate / share)
    second, push_second = body.zero_order_hold(rate / (1 - share))
    z = np.exp(2j * np.pi * turn)[:, None, None]
    ends = np.hstack([body.outputs[1:3], np.zeros((2, count))])
    free = ends @ np.linalg.inv(z * np.eye(2 * count) - second @ first)
    driven = free @ (push_second + second @ push_first / z)[..., :2] * z**-whole
    return driven, free * z * np.repeat([1.0, rate], count)


def equation_error(expected: PlateParameters, record: Record, latest: int) -> tuple[Array, int, float]:
    """Solve the force balance of heave and rocking at the lines for the six parameters, by linear least squares.

    Geometry, force constant, sensor gains and weights of the lines are those of `expected`.  A delay of up to `latest`
    samples turns the phase of the drive forces; the one that leaves least is taken.  Returns the values of
    `MECHANICAL`, the delay (samples), and the share of the drive force's mean square that the balance explains.
    """
    line, turn = record.lines, record.turn[record.lines]
    s = 2j * np.pi * record.rate * turn
    sensors = expected.device_model(record.rate, 1).coordinate_from_sensed
    motion = record.sensed[line] @ sensors.T
    masses, springs = expected.mass_matrix.diagonal(), expected.stiffness_matrix.diagonal()
    weight = 1 / (masses * abs(s[:, None]) ** 2 + springs)
    sides = [(motion @ shape)[:, None] * shape for shape in SIDES]
    inertial = [(s**2)[:, None] * motion * unit for unit in np.diag([1.0, expected.half_spacing**-2])]
    columns = np.stack([*inertial, *sides, *(s[:, None] * side for side in sides)], axis=-1)
    force = record.drive[line] @ expected.force_from_drive.T * np.sinc(turn)[:, None]
    delays = np.exp(-2j * np.pi * np.outer(turn, np.arange(latest + 1) + 0.5))
    forces = as_real((force * weight)[:, :, None] * delays[:, None])
    basis, triangle = np.linalg.qr(as_real(columns * weight[:, :, None]))
    shares = basis.T @ forces
    explained = (shares**2).sum(axis=0) / (forces**2).sum(axis=0)
    late = int(explained.argmax())
    return np.linalg.solve(triangle, shares[:, late]), late, float(explained[late])


def starting_plate(expected: PlateParameters, solved: Array) -> PlateParameters:
    """Return the plate of six solved parameters, none below a tenth of its expected value."""
    critical = 2 * math.sqrt(expected.mass * (expected.stiffness_1 + expected.stiffness_2))
    changes: dict[str, Any] = {}
    for name, value in zip(MECHANICAL, solved, strict=True):
        floor = LEAST_DAMPING * critical if name.startswith("damping") else 0.0
        changes[name] = max(float(value), LEAST_RATIO * max(getattr(expected, name), floor))
    return replace(expected, **changes)


def solve_checked(expected: PlateParameters, record: Record, latest: int) -> tuple[Array, int]:
    """Return the parameters and the delay of `equation_error`; refuse a record that does not fit the wiring.

    That is one that needs a negative mass or stiffness, or leaves the drive force unexplained.  The `DesignError` names
    the cause: sensors or coils that are swapped, inverted or without effect, or another device.
    """
    shares = {}
    for name, (sensors, coils) in WIRINGS.items():
        if np.linalg.det(sensors) == 0.0:  # what a dead sensor does not show is not found here
            continue
        trial = replace(record, sensed=record.sensed @ sensors, drive=record.drive @ coils)
        solved, late, explained = equation_error(expected, trial, latest)
        shares[name] = explained if (solved[:4] > 0).all() else 0.0
        if shares["nothing"] >= EXPLAINED:
            return solved, late
    fault = max(shares, key=lambda name: shares[name])
    cause = f"{fault}: rewire" if shares[fault] >= EXPLAINED else "check device and [device]"
    share, bound = 100 * shares["nothing"], 100 * EXPLAINED
    raise DesignError(f"motion of a plate explains {share:.3g} % of the drive force: must be >= {bound:g} %; {cause}")


def starting_bending(fit: Fit, record: Record, variance: float) -> tuple[float, float, float] | None:
    """Find the bending mode that explains most of the heave which a rigid plate leaves at the lines above.

    Returns `BENDING`; None where the shape at the coils is less than 5 standard deviations at a `variance` (m2) of
    every real number of the spectra.  The modes tried lie 2 Hz apart.
    """
    plate, above = fit.plate, record.above
    if not above.any():
        return None
    turn = record.turn[above]
    hertz, late = turn * record.rate, fit.unknown[DELAY] + 0.5
    left = (fit.left[above] / [plate.sensor_gain_1, plate.sensor_gain_2]).mean(axis=1)
    force = plate.force_constant * record.drive[above].sum(axis=1) * np.sinc(turn) * np.exp(-2j * np.pi * turn * late)
    modes = np.arange(hertz[0], hertz[-1], 2.0)[:, None]
    best = None
    for damping in TRIED_DAMPING:
        templates = force / (4 * np.pi**2 * plate.bending_mass * (modes**2 - hertz**2 + 2j * damping * modes * hertz))
        power = (abs(templates) ** 2).sum(axis=1)
        coil = (templates.conj() @ left).real / power
        clear = abs(coil) * np.sqrt(power / (variance / 2))
        at = int(clear.argmax())
        if best is None or clear[at] > best[0]:
            best = float(clear[at]), (float(modes[at, 0]), damping, float(coil[at]))
    return best[1] if best is not None and best[0] > CLEAREST else None


def fit_plate(expected: PlateParameters, record: Record, latest: int) -> Fit:
    """Fit the plate to a record, as rigid, then once more with a bending mode where one is clear.

    Its delay is at most `latest` samples.  A `DesignError` where wiring or device are not as expected, a
    `numpy.linalg.LinAlgError` where the record does not determine all unknowns.
    """
    solved, late = solve_checked(expected, record, latest)
    rigid = output_error(starting_plate(replace(expected, bending_frequency=0.0), solved), late, record)
    start = starting_bending(rigid, record, variances(rigid, record)[1])
    if start is None:
        return rigid
    frequency, damping, coil = start
    plate = replace(rigid.plate, bending_frequency=frequency, bending_damping=damping, bending_coil=coil)
    fit = output_error(plate, float(rigid.unknown[DELAY]), record)
    clear = 1 / math.sqrt(fit.covariance[-1, -1] * max(variances(fit, record)[:2]))
    return fit if clear > CLEAREST else rigid


def output_error(start: PlateParameters, late: float, record: Record) -> Fit:
    """Minimise the output error from the plate `start` and a delay of `late` samples.

    A `numpy.linalg.LinAlgError` where the record does not determine all unknowns.
    """
    scale = abs(record.sensed[1:]).max()
    mean, difference = sensor_gains(start)
    bending = BENDING if start.bending_frequency else ()
    count = FREE + len(bending)
    begin = np.r_[np.zeros(DELAY), late, difference, np.zeros(len(bending) + 2 * len(structure(start).mass))]

    def plate_at(unknown: Array) -> PlateParameters:
        values = [getattr(start, name) for name in MECHANICAL] * np.exp(unknown[:DELAY])
        gains = mean * (1 + unknown[GAIN] * np.array([-0.5, 0.5]))
        modal = [getattr(start, name) for name in bending] * np.exp(unknown[FREE:count])
        names = (*MECHANICAL, "sensor_gain_1", "sensor_gain_2", *bending)
        changes: dict[str, Any] = dict(zip(names, map(float, [*values, *gains, *modal]), strict=True))
        return replace(start, **changes)

    def left(unknown: Array) -> Array:
        plate = plate_at(unknown)
        driven, free = sampled_response(plate, record.rate, unknown[DELAY], record.turn)
        motion = (driven @ record.drive[:, :, None])[..., 0] + free @ (scale * unknown[count:])
        return record.sensed - motion * [plate.sensor_gain_1, plate.sensor_gain_2]

    search = least_squares(
        lambda unknown: as_real((left(unknown) / scale)[1:]).ravel(), begin, xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    covariance = np.linalg.inv(search.jac.T @ search.jac) / scale**2
    return Fit(plate_at(search.x), search.x[:count], covariance[:count, :count], left(search.x))


def as_real(values: Array) -> Array:
    """Complex numbers (n,) or (n, 2, ...) as twice as many real ones, shape (2n,) or (4n, ...)."""
    flat = values.reshape(-1, *values.shape[2:])
    return np.concatenate([flat.real, flat.imag])


def static_load(fit: Fit) -> float:
    """Compute the load (N) from the static displacement of the identified plate."""
    sensors = fit.plate.device_model(fit.plate.rate, 1).coordinate_from_sensed
    return -float((fit.plate.stiffness_matrix @ sensors @ fit.left[0].real)[0] / 2)


def variances(fit: Fit, record: Record) -> tuple[float, float, float]:
    """Estimate the variance (m2) of each real number that is left on the lines, and between; and the bound of misfit.

    The ratio of the two variances has about the variance 2/n_1 + 2/n_2, n the numbers in each less those found.
    """
    power = abs(fit.left) ** 2
    counts = 4 * record.on_line.sum() - len(fit.unknown), 4 * record.between.sum()
    floor = (ROUNDING * abs(record.sensed[record.on_line]).max()) ** 2
    on_lines, between = (
        max(float(power[bins].sum() / count), floor)
        for bins, count in zip((record.on_line, record.between), counts, strict=True)
    )
    return on_lines, between, math.sqrt(1 + CHANCE * math.sqrt(2 / counts[0] + 2 / counts[1]))
