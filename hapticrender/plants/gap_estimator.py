"""Estimate the attraction on an electroadhesive finger from the impedance of its gap at the carrier.

The equations are those of docs/theory.md, "Gap estimation" (Shultz, Peshkin, Colgate 2018).  The force follows |I|^2
at once; only the impedance is averaged over a longer time, weighted by power, so that an envelope may pass through
zero.  While the finger is away or rests, before it has rested once, or when its gap leaks too much, the output is
F = g |I|^2, as of a nominal finger, so that no integrator winds up, and `Flag.OPEN_LOOP` is raised.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.jit import kernel, record_of
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.plants.electroadhesion import ElectroadhesionParameters

VACUUM = 8.8541878128e-12  # F/m
LIFTED, RESTING, MOVING = -1, 0, 1  # states of the finger
SETTLING = 5.0  # time constants of the low pass for which an impedance is not used after a change

GAP = np.dtype(
    [(name, "f8") for name in ("body_resistance", "least_speed", "least_leakage", "open_loop_gain")]
    + [
        ("b", "f8", (3,)),  # of the STDFT*
        ("a", "f8", (2,)),
        ("retention", "f8"),  # of the averages, a sample
        ("settling", "i8"),  # samples that the low pass needs
        ("series", "f8"),  # ohm m2: modulus of the impedance in series with the gap
        ("force", "f8"),  # kappa/(4 w^2 eps0), N m2/A^2
        ("filters", "c16", (2, 2)),  # state: of V and of I
        ("envelope", "c16", (2,)),  # state: V and I, low-passed
        ("cross", "c16"),  # state: average of V conj(I)
        ("power", "f8"),  # state: average of |I|^2
        ("static", "c16"),  # state: Z_stat, ohm
        ("area", "f8"),  # state: m2, 0: not measured yet
        ("share", "f8"),  # state: L, 0: not measured yet
        ("contact", "i8"),  # state: what the finger does
        ("waiting", "i8"),  # state: samples until the low pass has settled
    ],
    align=True,
)


def gap_record(parameters: ElectroadhesionParameters) -> Array:
    """Return the record (`GAP`, shape (1,)) of an estimator that has measured nothing, for a finger on this screen."""
    p = parameters
    b, a = p.estimator_filter.coefficients
    return record_of(
        GAP,
        p,
        b=b,
        a=a[1:],
        retention=math.exp(-1.0 / (p.estimator_smoothing * p.rate)),
        settling=math.ceil(SETTLING * p.rate / (2 * math.pi * p.estimator_bandwidth)),
        series=abs(p.series_impedance),
        force=p.unevenness / (4 * p.omega**2 * VACUUM),
        contact=LIFTED,
    )


def estimate_attraction(record: Array, voltage: Array, current: Array, speed: Array) -> tuple[Array, Array]:
    """Estimate the attraction (N) of n samples, and whether each is that of a nominal finger, both shape (n,).

    For a driver that measures both channels: `voltage` (V) and `current` (A) are complex envelopes at the carrier, the
    modulus the amplitude; what is not finite counts as zero.  `speed` (m/s) is that of the finger, NaN while it is
    lifted; `record`, from `gap_record`, is changed in place, so that a run continues the one before.
    """
    force, open_loop = np.zeros(len(speed)), np.zeros(len(speed), bool)
    _gap_run(record, voltage.astype(complex), current.astype(complex), np.asarray(speed, float), force, open_loop)
    return force, open_loop


@kernel
def gap_step(g, voltage, current, speed):
    """Attraction (N) from a sample of both envelopes (V, A), and whether the gap could not be measured.

    `g` is a record of `GAP`; `speed` (m/s) is NaN while the finger is lifted.
    """
    x, w = g.envelope, g.filters
    x[0], x[1] = voltage, current
    for i in range(2):  # transposed direct form II
        u = x[i]
        if not (math.isfinite(u.real) and math.isfinite(u.imag)):
            u = 0j
        x[i] = g.b[0] * u + w[i, 0]
        w[i, 0] = g.b[1] * u - g.a[0] * x[i] + w[i, 1]
        w[i, 1] = g.b[2] * u - g.a[1] * x[i]
    power = x[1].real * x[1].real + x[1].imag * x[1].imag
    if math.isnan(speed):
        g.contact = LIFTED
        g.area = g.share = 0.0
        return g.open_loop_gain * power, True
    contact = MOVING if abs(speed) >= g.least_speed else RESTING
    if contact != g.contact:
        g.contact, g.waiting, g.cross, g.power = contact, g.settling, 0j, 0.0
    if g.waiting > 0:
        g.waiting -= 1
    else:
        g.cross = g.retention * g.cross + x[0] * x[1].conjugate()
        g.power = g.retention * g.power + power
        if g.power > 0.0:
            impedance = g.cross * (1.0 / g.power)
            gap = impedance - g.static
            if contact == RESTING:
                g.static, g.area = impedance, g.series / abs(impedance - g.body_resistance)
            elif g.area > 0.0:
                g.share = gap.imag * gap.imag / (gap.real * gap.real + gap.imag * gap.imag) if gap.imag < 0.0 else 0.0
    if contact == MOVING and g.area > 0.0 and g.share > g.least_leakage:
        return g.force * power * g.share / g.area, False
    return g.open_loop_gain * power, True


@kernel
def _gap_run(record, voltage, current, speed, force, open_loop):
    for n in range(speed.shape[0]):
        force[n], open_loop[n] = gap_step(record[0], voltage[n], current[n], speed[n])
