"""Compiled end of every controller: the drive inside its limits, rounded to the steps of a converter."""

import math

import numpy as np

from hapticrender.control.records import SUM, Y
from hapticrender.jit import kernel

NEAR_LIMIT = 0.25  # of the limit, squared: from here on the envelope of the drive counts, not its samples alone
SATURATED, NONFINITE, SENSOR_CLIPPED, UNLOCKED = 1, 2, 4, 32  # Flag bits


@kernel
def shape_noise(c, exact, i):
    """Round a drive to the converter's steps, the rounding noise shaped by (1 - 1/z)^2."""
    step, last = c.p.drive_step, c.shaper[0, i]
    shaped = exact + (2.0 * last - c.shaper[1, i])
    rounded = step * np.rint(shaped / step)
    c.shaper[1, i] = last
    c.shaper[0, i] = min(max(shaped - rounded, -step), step)
    return rounded


@kernel
def drive_of(c, samples, row, m, i):
    """Drive of channel i for the forces in two rows of a column m."""
    return c.p.drive_from_force[i, 0] * samples[row, m] + c.p.drive_from_force[i, 1] * samples[row + 1, m]


@kernel
def largest_drive(c, samples, with_quadrature, block):
    """Largest drive of a block over its limit, squared: of the samples, or of the analytic signal's envelope."""
    peak, scale = 0.0, c.confidence / c.p.drive_limit
    for i in range(c.p.channels):
        for m in range(block):
            along = drive_of(c, samples, Y, m, i)
            across = drive_of(c, samples, SUM, m, i) if with_quadrature else 0.0
            peak = max(peak, along * along + across * across)
    return scale * scale * peak


@kernel
def limit_drive(c, samples, peak, drive, flags, first, block):
    """Scale the whole envelope into the limit, round, and write the drive of a block."""
    confidence, limit = c.confidence, c.p.drive_limit
    before, after = c.scale, 1.0 / math.sqrt(peak) if peak > 1.0 else 1.0
    c.peak_squared, c.scale = peak, after
    for m in range(block):
        scale = confidence * (before + (after - before) * (m + 1.0) / block)
        for i in range(c.p.channels):
            exact = scale * drive_of(c, samples, Y, m, i)
            if confidence == 0.0:
                c.shaper[0, i] = c.shaper[1, i] = exact = 0.0
            elif c.p.drive_step > 0.0:
                exact = shape_noise(c, exact, i)
            drive[first + m, i] = min(max(exact, -limit), limit)
        if after < 1.0:
            flags[first + m] |= SATURATED
