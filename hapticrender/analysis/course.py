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

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hapticrender.plants.fitting import MECHANICAL
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array

TRACKED = MECHANICAL[2:]  # stiffness and damping, first order in time
UNCERTAINTY = (0.02, 0.02, 0.02, 0.02, 0.1, 0.1)  # relative, of `MECHANICAL`, where a profile has none
DRIFT, DRIFT_TIME = (0.02, 0.02, 0.2, 0.2), 40.0  # relative, of `TRACKED`, and s: change over a recording, or over this


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
    def of(cls, columns: Array) -> Signals:
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
    def of(
        cls, plate: PlateParameters, uncertainty: Mapping[str, float] | None = None, duration: float = 0.0
    ) -> Course:
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
