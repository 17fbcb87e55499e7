"""Compiled law of the default controller: dynamic stiffness, finger included, turned ahead by delay and hold.

    F = rho (D V + D' dV/dt + j dw/dt M V),   rho = e^(j w lead) (w T/2)/sin(w T/2)

with D(s) = M s^2 + C s + K + z(s) h h^T, h = [1, g] the finger's lever arm and z its three numbers and what a band
leaves over.  An error of the law for changes of Omega rad/s is bounded by m Omega^2/|D|.
"""

from __future__ import annotations

import math

from hapticrender.control.carriers import SLOWEST
from hapticrender.control.records import CONTROLLER_T, LOCKED, TILE_T
from hapticrender.jit import kernel, record
from hapticrender.mathx import TURN, unit
from hapticrender.vectors import get, imag, magnitude, pair, put, real, total, where, zeros


@kernel
def contact_damping(controller):
    """Damping of a sliding contact that renews itself over a length, beyond that at the typical speed."""
    c = record(controller, CONTROLLER_T, 0)
    p = c.p
    if p.contact_damping == 0.0:
        return 0.0
    return p.contact_damping * (1.0 / max(c.speed, SLOWEST * p.typical_speed) - 1.0 / p.typical_speed)


@kernel
def turn_ahead(controller, t):
    """Set rho of a tile: by the delay and half the hold, and up by what the hold takes."""
    c = record(controller, CONTROLLER_T, 0)
    b, lead = record(c.tiles_at, TILE_T, t), c.p.lead
    omega = get(b, "omega")
    x = (0.5 / c.p.rate) * omega
    chord = imag(unit(x * (1.0 / TURN)))
    turn = unit((lead / TURN) * (omega + 0.5 * lead * get(b, "sweep")))
    put(b, "ahead", where(magnitude(x) > 1e-9, x / chord, 1.0) * turn)


@kernel
def law_entry(mass, damping, stiffness, b):
    """D and D' of one pair of coordinates, turned ahead by rho."""
    omega, ahead = get(b, "omega"), get(b, "ahead")
    d = pair(stiffness - omega * omega * mass, omega * damping + get(b, "sweep") * mass)
    return d * ahead, pair(damping, 2.0 * mass * omega) * ahead


@kernel
def set_law(controller, t):
    """Set D and D' of a tile, with the finger as the law holds it."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p, on, g = c.p, c.law_contact, c.law_lever
    mass, spring = on * c.finger_mass, on * get(b, "remainder")
    damping = on * c.finger_damping + contact_damping(controller)
    k = on * c.finger_stiffness
    d, s = law_entry(p.mass[0, 0] + mass, p.damping[0, 0] + damping, p.stiffness[0, 0] + k, b)
    more = spring * get(b, "ahead")
    put(b, "d00", d + more)
    put(b, "s00", s)
    mass, damping, k, more = g * mass, g * damping, g * k, g * more
    d, s = law_entry(p.mass[0, 1] + mass, p.damping[0, 1] + damping, p.stiffness[0, 1] + k, b)
    put(b, "d01", d + more)
    put(b, "s01", s)
    d, s = law_entry(p.mass[1, 0] + mass, p.damping[1, 0] + damping, p.stiffness[1, 0] + k, b)
    put(b, "d10", d + more)
    put(b, "s10", s)
    mass, damping, k, more = g * mass, g * damping, g * k, g * more
    d, s = law_entry(p.mass[1, 1] + mass, p.damping[1, 1] + damping, p.stiffness[1, 1] + k, b)
    put(b, "d11", d + more)
    put(b, "s11", s)


@kernel
def follow_resonance(controller):
    """Move the shift of the carriers towards the resonance, where Re D = 0: force and motion a quarter turn apart.

    Near a resonance w0 of the mass m, D is 2 m w (w0 - w) + j Im D.  The lock is lost while they are more than an
    eighth of a turn from a quarter turn.
    """
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, 0)
    p, w = c.p, b.omega[0]
    if w == 0.0:
        return
    mass = p.mass[0, 0] + c.finger_mass
    along = p.stiffness[0, 0] + c.finger_stiffness - w * w * mass
    across = w * (p.damping[0, 0] + c.finger_damping)
    c.shift += min(p.lock * 64.0 / p.rate, 1.0) * along / (2.0 * TURN * mass * w)
    size = math.sqrt(b.r_re[0] * b.r_re[0] + b.r_im[0] * b.r_im[0])
    c.unlocked = 0.0 if size > p.least_motion and abs(along) <= across else 1.0


@kernel
def update_law(controller, touching, adapt_now):
    """Update the law with the finger estimate: where contact changed or it is adapted, and where carriers move."""
    c = record(controller, CONTROLLER_T, 0)
    contact = 1.0 if touching else 0.0
    due = contact != c.law_contact or (adapt_now and touching) or c.stale > 0
    if due:
        c.law_contact, c.law_lever = contact, c.lever
    if not (due or c.moving > 0):
        return
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        locked = b.mode[0] == LOCKED
        if locked:
            put(b, "omega", get(b, "omega") + c.p.extrapolation * get(b, "sweep"))
        if locked or c.stale > 0:
            turn_ahead(controller, t)
        if locked or due:
            set_law(controller, t)
    c.stale = 0


@kernel
def apply_law(controller):
    """Force envelopes rho (D V + D' dV/dt) of all bands; returns their sums now and a quarter turn ahead."""
    c = record(controller, CONTROLLER_T, 0)
    ahead, shape0, shape1 = c.p.extrapolation, c.p.shape[0], c.p.shape[1]
    sum0 = sum1 = pair(zeros(), zeros())
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        reference, carrier = get(b, "r") + ahead * get(b, "slope"), get(b, "carrier")
        v0, v1 = get(b, "v0") + shape0 * reference, get(b, "v1") + shape1 * reference
        slope0, slope1 = get(b, "slope0"), get(b, "slope1")
        force = get(b, "d00") * v0 + get(b, "s00") * slope0 + get(b, "d01") * v1 + get(b, "s01") * slope1
        put(b, "force0", force)
        sum0 = sum0 + force * carrier
        force = get(b, "d10") * v0 + get(b, "s10") * slope0 + get(b, "d11") * v1 + get(b, "s11") * slope1
        put(b, "force1", force)
        sum1 = sum1 + force * carrier
    return total(real(sum0)), total(real(sum1)), total(imag(sum0)), total(imag(sum1))
