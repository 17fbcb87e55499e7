"""Impedance of the finger, Z_f = F_f/v at the finger, from amplitudes in windows under load.

In each window and band the heave row of the balance of forces gives F_f, and ``v = j w (x_c + (p/a) a theta)`` the
velocity at the finger.  White noise n of the coordinates and the parameters' error e change the quotient by::

    dZ = -([D_cc, D_cr] + j w Z [1, g]) n/v - Phi_c e/v,   g = p/a

so that it is the noise of the plate under the finger, over the velocity.  An error of g by dg adds ``Z v_r dg/v``, a
gain error common to both sensors its share of Z.
"""

from __future__ import annotations

import numpy as np

from hapticrender.analysis.course import Course, Signals
from hapticrender.analysis.lock_in import Lines
from hapticrender.analysis.records import Impedance
from hapticrender.protocols import Array

CLEAR = 5.0  # standard errors of the velocity: below it the quotient is not formed


def impedance_of(
    course: Course, lines: Lines, noise: Array, load: Array, position: Array, position_error: Array, gain_error: float
) -> Impedance:
    """Impedance in windows under a mean `load` (N) at a mean `position` (m, both (n,)) with its standard error.

    `lines` are of nine signals: those of `Signals.of`, then (p/a) times the velocity of rocking; `noise` is the white
    noise of heave and rocking (m rms), `gain_error` the relative standard error of a gain common to both sensors.
    """
    amplitudes, a = Signals.of(lines.amplitude), course.plate.half_spacing
    times = np.broadcast_to(lines.time[:, None], lines.frequency.shape)
    phi = amplitudes.regressors(a)[..., 0, :]
    force = amplitudes.force[..., 0] - np.einsum("nbi,ni->nb", phi, course.at(lines.time))
    velocity = amplitudes.velocity[..., 0] + lines.amplitude[..., 8]
    s = 2j * np.pi * lines.frequency
    heave = course.dynamic_stiffness(lines.frequency, times)[..., 0, :]
    bending, shape = course.bending(lines.frequency), course.plate.displacement(position)[:, 2:]
    passed = 1 + heave[..., 0] * shape * bending
    force = force / passed
    by_coils = course.plate.bending_coil * amplitudes.force[..., 0]
    velocity = velocity + s * shape * bending * (by_coils + (1 - shape) * force)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = force / velocity
    at_finger = np.stack(np.broadcast_arrays(1.0, (position / a)[:, None] + 0.0 * value.real), axis=-1)
    by_noise = (np.abs(heave + (s * value)[..., None] * at_finger) ** 2 @ noise**2) * lines.variance
    covariance = np.array([course.covariance_at(each) for each in lines.time]).reshape(-1, 6, 6)
    by_plate = np.einsum("nbi,nij,nbj->nb", phi, covariance, phi.conj()).real / 2
    by_place = np.abs(value * amplitudes.velocity[..., 1] * (position_error / a)[:, None]) ** 2 / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        by_gain = np.abs(value * gain_error) ** 2 / 2
        variance = (by_noise + by_plate + by_place) / np.abs(passed * velocity) ** 2 + by_gain
        clear = np.abs(velocity) > CLEAR * np.abs(s) * noise[0] * np.sqrt(lines.variance)
    value, error = (np.where(clear, each, np.nan) for each in (value, np.sqrt(variance)))
    return Impedance(lines.time, lines.frequency, value, error, load, position, velocity)
