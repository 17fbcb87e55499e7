"""Regression of the plate's parameters on spans without a finger, first order in time, and the values at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hapticrender.analysis.course import TRACKED, Course, Signals
from hapticrender.analysis.lock_in import Lines
from hapticrender.analysis.records import PlateTrack
from hapticrender.protocols import Array

CHANCE = 1e-6  # of a plate that is as its model, to leave a `Course.misfit` above 1
INFORMED = 0.5  # of its uncertainty in the profile: below it the total stiffness counts as measured


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


def rest_of(course: Course, lines: Lines) -> Rest:
    """Values at rest from windows without a finger."""
    slow = Signals.of(lines.mean)
    force = slow.residual(course.at(lines.time), course.plate.half_spacing)
    return Rest(lines.time, np.hstack([force, slow.displacement]), float(1.0 / lines.mean_variance.mean()))


def regress(course: Course, lines: Lines, noise: Array) -> Course:
    """Estimate start and slope of a profile's parameters from windows without a finger (`lines`, as for `Signals.of`).

    Minimises the output error ``x - D^-1 f`` of heave and rocking over the noise of the amplitudes, by the white
    `noise` (m rms) of both, together with the distance from the profile over its uncertainty.  Misfit beyond the noise
    widens the covariance.

    Notes
    -----
    The equation error, linear in the parameters, would be biased by the noise in its regressors: the plate hardly
    rocks, so that rocking is mostly noise.  Pintelon & Schoukens, System Identification, 2nd ed. 2012, section 9.10.
    """
    from scipy.optimize import least_squares
    from scipy.special import chdtri

    measured = Signals.of(lines.amplitude)
    prior = np.r_[course.start, course.slope]
    spread = np.sqrt(np.diagonal(course.covariance))
    scale = np.where(spread > 0.0, spread, 1e-9 * np.maximum(np.abs(prior), 1e-9))
    times = np.broadcast_to(lines.time[:, None], lines.frequency.shape)

    def left(unknown: Array) -> Array:
        values = prior + scale * unknown
        stiffness = replace(course, start=values[:6], slope=values[6:]).dynamic_stiffness(lines.frequency, times)
        motion = np.linalg.solve(stiffness, measured.force[..., None])[..., 0]
        error = (measured.displacement - motion) / (noise * np.sqrt(lines.variance)[..., None])
        return np.r_[error.real.ravel(), error.imag.ravel(), unknown]

    search = least_squares(left, np.zeros(10), method="lm")
    square, count = float((search.fun[:-10] ** 2).sum()), len(search.fun) - 10
    data = search.jac[:-10].T @ search.jac[:-10] / max(1.0, square / count)
    covariance = np.linalg.inv(data + np.eye(10)) * np.outer(scale, scale)
    values = prior + scale * search.x
    total = np.r_[0.0, 0.0, 1.0, 1.0, np.zeros(6)]
    share = np.sqrt((total @ covariance @ total) / (total @ course.covariance @ total))
    return Course(
        course.plate, values[:6], values[6:], covariance, bool(share < INFORMED), square / float(chdtri(count, CHANCE))
    )


def track_of(course: Course, duration: float) -> PlateTrack:
    """Stiffness and damping over a recording (s), at its ends and each second between them."""
    time = np.unique(np.r_[np.arange(0.0, duration, 1.0), duration])
    values = course.at(time)[:, 2:].T
    errors = np.array([np.sqrt(np.diagonal(course.covariance_at(each)))[2:] for each in time]).T
    tracks, spreads = (dict(zip(TRACKED, each, strict=True)) for each in (values, errors))
    return PlateTrack(time, tracks, spreads, course.measured)
