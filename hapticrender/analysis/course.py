"""The plate's mechanical parameters over time, with their covariance, and its balance of forces.

In heave and rocking q = [x_c, a theta], with the finger at g = p/a (see `hapticrender.plants.plate`)::

    F_f [1, g] = K_f [[1, 1], [-1, 1]] i - (M q'' + C q' + K q)

The bracket is linear in the parameters theta = [m, I, k1, k2, b1, b2]: it is ``Phi theta`` with the regressors Phi.
Where the glass bends (frequency, damping and shape phi of the profile), the sensors add ``e = B(s) (phi_coil f_c -
phi(p) F_f)`` to x_c, B the compliance of the mode and f_c the drive's heave force.  The first part is subtracted from
the motion (`MotionFilter`), so that with D the heave row of ``M s^2 + C s + K`` and r the residual as for rigid glass
``F_f (1 + D phi(p) B) = r``.

The rows differ from those that Grigorii et al. 2021 print, (m/2) x'' -+ (I/2) theta'', whose units do not agree.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter, lfilter_zi
from scipy.special import chdtri

from hapticrender.analysis.lock_in import Lines
from hapticrender.analysis.records import Impedance, PlateTrack
from hapticrender.analysis.smoothing import History, convolve, derivative_kernels, half_width, held_kernel
from hapticrender.plants.fitting import MECHANICAL
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array

TRACKED = MECHANICAL[2:]  # stiffness and damping, first order in time
UNCERTAINTY = (0.02, 0.02, 0.02, 0.02, 0.1, 0.1)  # relative, of `MECHANICAL`, where a profile has none
DRIFT, DRIFT_TIME = (0.02, 0.02, 0.2, 0.2), 40.0  # relative, of `TRACKED`, and s: change over a recording, or over this
CHANCE = 1e-6  # of a plate that is as its model, to leave a `Course.misfit` above 1
INFORMED = 0.5  # of its uncertainty in the profile: below it the total stiffness counts as measured
DIFFERENCES = 6  # order of the differences that show a sensor's noise
FINEST = 1e-9  # m: least noise that is assumed
GAIN = 924.0  # of white noise through them: binomial(12, 6)
CLEAR = 5.0  # standard errors of the velocity at the finger: below it no impedance is formed


@dataclass(frozen=True)
class Signals:
    """Plate coordinates, their derivatives and the drive's forces, of one response; shapes (..., 2).

    As signals over time they are real; as amplitudes of carriers they are complex.
    """

    displacement: Array  # m, heave and rocking
    velocity: Array  # m/s
    acceleration: Array  # m/s^2
    force: Array  # N

    @classmethod
    def of(cls, columns: Array) -> Self:
        """Signals of the first eight columns (..., >= 8): displacement, velocity, acceleration, force."""
        return cls(*(columns[..., i : i + 2] for i in range(0, 8, 2)))

    def regressors(self, half_spacing: float) -> Array:
        """Phi, shape (..., 2, 6)."""
        x, v = self.displacement, self.velocity
        zero = np.zeros_like(x[..., 0])
        x1, x2, v1, v2 = (each[..., 0] + sign * each[..., 1] for each in (x, v) for sign in (-1, 1))
        heave = [self.acceleration[..., 0], zero, x1, x2, v1, v2]
        rocking = [zero, self.acceleration[..., 1] / half_spacing**2, -x1, x2, -v1, v2]
        return np.stack([np.stack(heave, axis=-1), np.stack(rocking, axis=-1)], axis=-2)

    def residual(self, theta: Array, half_spacing: float) -> Array:
        """Force of the finger on heave and rocking (N, shape (..., 2)) for parameters theta (..., 6)."""
        return self.force - np.einsum("...ij,...j->...i", self.regressors(half_spacing), theta)


def sensor_noise(sensed: Array) -> Array:
    """Standard deviation (m) of white noise, rounding included, of each sensor (n, channels).

    From the sixth differences, which pass 2e-3 of a motion at a tenth of the sampling rate, 1e-6 at a thirtieth.
    """
    differences = np.diff(sensed, DIFFERENCES, axis=0)
    return np.sqrt((differences**2).mean(axis=0) / GAIN)


def at_least(noise: Array, plate: PlateParameters) -> Array:
    """Noise (m rms) of the sensors, but no less than that of their rounding, or 1 nm."""
    return np.maximum(noise, max(plate.sensor_step / math.sqrt(12.0), FINEST))


def _bending(plate: PlateParameters, rate: float, late: int) -> tuple[Array, Array]:
    """Filter (b, a) from a heave force (N), held over each sample `late` samples later, to the bending of it (m)."""
    w = 2 * math.pi * plate.bending_frequency
    if not w:
        return np.zeros(2), np.array([1.0, 0.0])
    mode = [plate.bending_coil / plate.bending_mass], [1.0, 2 * plate.bending_damping * w, w**2]
    (b,), a, _ = cont2discrete(mode, 1 / rate, "zoh")
    return np.r_[np.zeros(late), b], a


class MotionFilter:
    """Smooth the sensed motion, differentiate it twice, and smooth the drive's force by one kernel, block by block.

    What the drive itself bends of the glass, by the plate's bending mode, is subtracted from the motion.

    Row n of the drive is held while row n to n + 1 are sensed, `late` samples later.  Results come `delay` samples
    after the sample that they belong to.  `rate` is in Hz, `spread` (s) that of the kernel in `smoothing`.
    """

    def __init__(self, plate: PlateParameters, rate: float, spread: float, late: int = 0) -> None:
        self._plate, self.spread, self.delay = plate, spread, half_width(spread, rate)
        pad = late + 1  # the kernels of the motion are as long as that of the force
        self._motion = np.pad(derivative_kernels(spread, rate), ((0, 0), (0, pad)))
        self._force = held_kernel(spread, rate, late)
        self._sensed, self._drive = (History(len(self._force) - 1) for _ in range(2))
        self._mode, self._bent = _bending(plate, rate, late), None
        gains = np.array([plate.sensor_gain_1, plate.sensor_gain_2])
        self.coordinate_from_sensed = np.linalg.inv(plate.displacement(plate.ends)[:, :2]) / gains

    def update(self, drive: Array, sensed: Array) -> Signals:
        """Signals (n, 2) of the samples `delay` before those of drive (A, (n, coils)) and measurement (m, (n, 2))."""
        force, coordinates, (b, a) = self.force(drive), sensed @ self.coordinate_from_sensed.T, self._mode
        before = lfilter_zi(b, a) * force[0, 0] if self._bent is None else self._bent
        bent, self._bent = lfilter(b, a, force[:, 0], zi=before)
        coordinates[:, 0] -= bent
        motion = self._sensed.before(coordinates)
        middle = motion[0]  # far from zero the taps' rounding would show
        x, v, a = (convolve(motion - middle, taps) for taps in self._motion)
        return Signals(x + middle, v, a, convolve(self._drive.before(force), self._force))

    def force(self, drive: Array) -> Array:
        """Force (N, (n, 2)) on heave and rocking of a drive (A, (n, coils)), rounded and limited as the plate does."""
        p = self._plate
        step, limit = p.current_step, p.current_limit
        current = step * np.floor(drive / step + 0.5) if step else drive
        return np.clip(current, -limit, limit) @ p.force_from_drive.T

    def coordinate_noise(self, noise: Array) -> Array:
        """Standard deviation (m, (2,)) of heave and rocking for that of the sensors (m, (2,))."""
        return np.sqrt(self.coordinate_from_sensed**2 @ np.asarray(noise) ** 2)

    def force_noise(self, noise: Array) -> Array:
        """Standard deviation (N, (2,)) of the residual forces of heave and rocking by that of the sensors (m, (2,))."""
        p = self._plate
        balance = np.stack([np.diagonal(each) for each in (p.stiffness_matrix, p.damping_matrix, p.mass_matrix)])
        taps = balance.T @ self._motion
        return self.coordinate_noise(noise) * np.sqrt((taps**2).sum(axis=1))


@dataclass(frozen=True)
class Rest:
    """Heave and rocking force (N) and displacement (m) of the plate at rest (n, 4) at `time` (s), joined by lines.

    `samples` is the number of samples of white noise whose mean is as certain as each of them.
    """

    time: Array
    values: Array
    samples: float

    def at(self, time: Array) -> Array:
        """Values (n, 4) at times (s); before the first and after the last they are held."""
        return np.stack([np.interp(time, self.time, column) for column in self.values.T], axis=1)


@dataclass(frozen=True)
class Course:
    """Parameters ``theta(t) = start + slope t`` with t from the recording's start, in the order of `MECHANICAL`.

    The covariance (10, 10) is that of start and slope.
    """

    plate: PlateParameters  # geometry, force constant and electronics, which are taken as exact
    start: Array  # (6,): m, I, k1, k2, b1, b2 in SI units
    slope: Array  # (4,), per second, of the last four
    covariance: Array
    measured: bool = False  # unloaded spans of a recording determine them
    misfit: float = 0.0  # mean square of what they leave there, over what noise passes once in a million recordings

    @classmethod
    def of(cls, plate: PlateParameters, uncertainty: Mapping[str, float] | None = None, duration: float = 0.0) -> Self:
        """Parameters of a profile; `uncertainty` is standard, in their units, and `UNCERTAINTY` where it has none.

        Over a recording of a `duration` (s) stiffness and damping may drift by `DRIFT`, one standard deviation.
        """
        start = np.array([getattr(plate, name) for name in MECHANICAL])
        defaults = dict(zip(MECHANICAL, start * UNCERTAINTY, strict=True))
        spread = [{**defaults, **(uncertainty or {})}[name] for name in MECHANICAL]
        drift = np.array(DRIFT) * start[2:] / max(duration, DRIFT_TIME) if duration else np.zeros(4)
        return cls(plate, start, np.zeros(4), np.diag(np.r_[spread, drift] ** 2))

    def at(self, time: Array | float) -> Array:
        """Parameters at `time` (s), shape (..., 6)."""
        return self.start + np.multiply.outer(np.asarray(time, float), np.r_[0.0, 0.0, self.slope])

    def covariance_at(self, time: float) -> Array:
        """Covariance (6, 6) of the parameters at a time (s)."""
        both = np.hstack([np.eye(6), np.vstack([np.zeros((2, 4)), time * np.eye(4)])])
        return both @ self.covariance @ both.T

    def bending(self, frequency: Array | float) -> Array:
        """Displacement of the sensors by bending per modal force (m/N, complex) at `frequency` (Hz); 0: rigid glass."""
        p, f = self.plate, np.asarray(frequency, float)
        f0 = p.bending_frequency
        if not f0:
            return np.zeros(f.shape, complex)
        return 1 / (4 * np.pi**2 * p.bending_mass * (f0**2 - f**2 + 2j * p.bending_damping * f0 * f))

    def dynamic_stiffness(self, frequency: Array, time: Array | float = 0.0) -> Array:
        """D (N/m, shape (..., 2, 2)) at frequencies (Hz) and times (s) of one shape."""
        s = 2j * np.pi * np.asarray(frequency, float)[..., None, None]
        unit = np.broadcast_to(np.eye(2), (*s.shape[:-2], 2, 2))
        columns = Signals(unit, s * unit, s**2 * unit, np.zeros_like(unit))
        theta = np.asarray(self.at(time))[..., None, :]
        return -np.swapaxes(columns.residual(theta, self.plate.half_spacing), -1, -2)

    def rest(self, lines: Lines) -> Rest:
        """Values at rest from windows without a finger."""
        slow = Signals.of(lines.mean)
        force = slow.residual(self.at(lines.time), self.plate.half_spacing)
        return Rest(lines.time, np.hstack([force, slow.displacement]), float(1.0 / lines.mean_variance.mean()))

    def regressed(self, lines: Lines, noise: Array) -> Self:
        """Estimate start and slope of a profile's parameters from windows without a finger (lines as of `Signals.of`).

        Minimises the output error ``x - D^-1 f`` of heave and rocking over the noise of the amplitudes, by the white
        `noise` (m rms) of both, together with the distance from the profile over its uncertainty.  Misfit beyond the
        noise widens the covariance.

        Notes
        -----
        The equation error, linear in the parameters, would be biased by the noise in its regressors: the plate hardly
        rocks, so that rocking is mostly noise.  Pintelon & Schoukens, System Identification, 2nd ed. 2012, 9.10.
        """
        measured = Signals.of(lines.amplitude)
        prior = np.r_[self.start, self.slope]
        spread = np.sqrt(np.diagonal(self.covariance))
        scale = np.where(spread > 0.0, spread, 1e-9 * np.maximum(np.abs(prior), 1e-9))
        times = np.broadcast_to(lines.time[:, None], lines.frequency.shape)

        def left(unknown: Array) -> Array:
            values = prior + scale * unknown
            stiffness = replace(self, start=values[:6], slope=values[6:]).dynamic_stiffness(lines.frequency, times)
            motion = np.linalg.solve(stiffness, measured.force[..., None])[..., 0]
            error = (measured.displacement - motion) / (noise * np.sqrt(lines.variance)[..., None])
            return np.r_[error.real.ravel(), error.imag.ravel(), unknown]

        search = least_squares(left, np.zeros(10), method="lm")
        square, count = float((search.fun[:-10] ** 2).sum()), len(search.fun) - 10
        data = search.jac[:-10].T @ search.jac[:-10] / max(1.0, square / count)
        covariance = np.linalg.inv(data + np.eye(10)) * np.outer(scale, scale)
        values = prior + scale * search.x
        total = np.r_[0.0, 0.0, 1.0, 1.0, np.zeros(6)]
        share = np.sqrt((total @ covariance @ total) / (total @ self.covariance @ total))
        course = replace(self, start=values[:6], slope=values[6:], covariance=covariance)
        return replace(course, measured=bool(share < INFORMED), misfit=square / float(chdtri(count, CHANCE)))

    def track(self, duration: float) -> PlateTrack:
        """Stiffness and damping over a recording (s), at its ends and each second between them."""
        time = np.unique(np.r_[np.arange(0.0, duration, 1.0), duration])
        values = self.at(time)[:, 2:].T
        errors = np.array([np.sqrt(np.diagonal(self.covariance_at(each)))[2:] for each in time]).T
        tracks, spreads = (dict(zip(TRACKED, each, strict=True)) for each in (values, errors))
        return PlateTrack(time, tracks, spreads, self.measured)

    def impedance(
        self, lines: Lines, noise: Array, load: Array, position: Array, position_error: Array, gain_error: float
    ) -> Impedance:
        """Impedance in windows under a mean `load` (N) at a mean `position` (m, both (n,)) with its standard error.

        `lines` are of nine signals: those of `Signals.of`, then (p/a) times the velocity of rocking; `noise` is the
        white noise of heave and rocking (m rms), `gain_error` the relative standard error of both sensors' gain.

        Notes
        -----
        In each window and band the heave row of the balance of forces gives F_f, and
        ``v = j w (x_c + (p/a) a theta)`` the velocity at the finger.  White noise n of the coordinates and the
        parameters' error e change the quotient by::

            dZ = -([D_cc, D_cr] + j w Z [1, g]) n/v - Phi_c e/v,   g = p/a

        so that it is the noise of the plate under the finger, over the velocity.  An error of g by dg adds
        ``Z v_r dg/v``, a gain error common to both sensors its share of Z.
        """
        amplitudes, a = Signals.of(lines.amplitude), self.plate.half_spacing
        times = np.broadcast_to(lines.time[:, None], lines.frequency.shape)
        phi = amplitudes.regressors(a)[..., 0, :]
        force = amplitudes.force[..., 0] - np.einsum("nbi,ni->nb", phi, self.at(lines.time))
        velocity = amplitudes.velocity[..., 0] + lines.amplitude[..., 8]
        s = 2j * np.pi * lines.frequency
        heave = self.dynamic_stiffness(lines.frequency, times)[..., 0, :]
        bending, shape = self.bending(lines.frequency), self.plate.displacement(position)[:, 2:]
        passed = 1 + heave[..., 0] * shape * bending
        force = force / passed
        by_coils = self.plate.bending_coil * amplitudes.force[..., 0]
        velocity = velocity + s * shape * bending * (by_coils + (1 - shape) * force)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = force / velocity
        at_finger = np.stack(np.broadcast_arrays(1.0, (position / a)[:, None] + 0.0 * value.real), axis=-1)
        by_noise = (np.abs(heave + (s * value)[..., None] * at_finger) ** 2 @ noise**2) * lines.variance
        covariance = np.array([self.covariance_at(each) for each in lines.time]).reshape(-1, 6, 6)
        by_plate = np.einsum("nbi,nij,nbj->nb", phi, covariance, phi.conj()).real / 2
        by_place = np.abs(value * amplitudes.velocity[..., 1] * (position_error / a)[:, None]) ** 2 / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            by_gain = np.abs(value * gain_error) ** 2 / 2
            variance = (by_noise + by_plate + by_place) / np.abs(passed * velocity) ** 2 + by_gain
            clear = np.abs(velocity) > CLEAR * np.abs(s) * noise[0] * np.sqrt(lines.variance)
        value, error = (np.where(clear, each, np.nan) for each in (value, np.sqrt(variance)))
        return Impedance(lines.time, lines.frequency, value, error, load, position, velocity)
