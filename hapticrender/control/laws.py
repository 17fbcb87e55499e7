"""Compiled force of the laws that invert the device: dynamic stiffness with a finger, turned ahead by delay and hold.

    F = rho (D V + D' dV/dt + j dw/dt M V),   rho = e^(j w lead) (w T/2)/sin(w T/2)

with D(s) = M s^2 + C s + K + z(s) h h^T, h = [1, p/a] the finger's lever arms and z its three numbers and what a band
leaves over.  An error of the law for changes of Omega rad/s is bounded by m Omega^2/|D|.
"""

import math

from hapticrender.control.carriers import SLOWEST
from hapticrender.control.records import (
    COORDINATE_T,
    LOCKED,
    STEP,
    STIFFNESS_T,
    SUM,
    TILE_T,
    Y,
    coordinates_of,
    samples_of,
    stiffnesses_of,
)
from hapticrender.jit import kernel, record
from hapticrender.mathx import TURN, unit
from hapticrender.vectors import get, imag, magnitude, pair, put, real, total, where, zeros


@kernel
def contact_damping(c):
    """Damping of a sliding contact that renews itself over a length, beyond that at the typical speed."""
    p = c.p
    if p.contact_damping == 0.0:
        return 0.0
    return p.contact_damping * (1.0 / max(c.speed, SLOWEST * p.typical_speed) - 1.0 / p.typical_speed)


@kernel
def turn_ahead(c, t):
    """Set rho of a tile: by the delay and half the hold, and up by what the hold takes."""
    b, lead = record(c.tiles_at, TILE_T, t), c.p.lead
    omega = get(b, "omega")
    x = (0.5 / c.p.rate) * omega
    chord = imag(unit(x * (1.0 / TURN)))
    turn = unit((lead / TURN) * (omega + 0.5 * lead * get(b, "sweep")))
    put(b, "ahead", where(magnitude(x) > 1e-9, x / chord, 1.0) * turn)


@kernel
def set_law(c, t):
    """Set D and D' of a tile, turned ahead by rho, with the finger as the law holds it."""
    b = record(c.tiles_at, TILE_T, t)
    p, on, g, lag = c.p, c.law_contact, c.law_lever, contact_damping(c)
    omega, ahead, sweep = get(b, "omega"), get(b, "ahead"), get(b, "sweep")
    spring = on * get(b, "remainder") * ahead
    for i in range(p.coordinates):
        for j in range(p.coordinates):
            one, other = (g if i > 0 else 1.0), (g if j > 0 else 1.0)  # arms of the finger
            mass = p.mass[i, j] + other * (one * (on * c.finger_mass))
            damping = p.damping[i, j] + other * (one * (on * c.finger_damping + lag))
            stiffness = p.stiffness[i, j] + other * (one * (on * c.finger_stiffness))
            d = pair(stiffness - omega * omega * mass, omega * damping + p.dynamic * sweep * mass)
            law = record(stiffnesses_of(c, t), STIFFNESS_T, 2 * i + j)
            put(law, "d", d * ahead + other * (one * spring))
            put(law, "s", p.dynamic * pair(damping, 2.0 * mass * omega) * ahead)


@kernel
def follow_resonance(c):
    """Move the shift of the carriers towards the resonance, where Re D = 0: force and motion a quarter turn apart.

    Near a resonance w0 of the mass m, D is 2 m w (w0 - w) + j Im D.  The lock is lost while they are more than an
    eighth of a turn from a quarter turn.
    """
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
def update_law(c, touching, adapt_now):
    """Update the law with the finger estimate: where contact changed or it is adapted, and where carriers move."""
    contact = 1.0 if touching else 0.0
    due = contact != c.law_contact or (adapt_now and touching) or c.stale > 0
    if due:
        c.law_contact, c.law_lever = contact, c.lever
    if not (due or c.locked > 0):
        return
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        locked = b.mode[0] == LOCKED
        if locked:
            put(b, "omega", get(b, "omega") + c.p.extrapolation * get(b, "sweep"))
        if locked or c.stale > 0:
            turn_ahead(c, t)
        if locked or due:
            set_law(c, t)
    c.stale = 0


@kernel
def apply_law(c):
    """Force envelopes rho (D V + D' dV/dt) of all bands, and their sums in the first column of `samples`.

    The sums now and the inner damper's force go into the rows Y, those a quarter turn ahead into the rows SUM.
    """
    p, ahead, samples = c.p, c.p.extrapolation, samples_of(c)
    for i in range(p.coordinates):
        along = pair(zeros(), zeros())
        for t in range(c.tiles):
            b, first, laws = record(c.tiles_at, TILE_T, t), coordinates_of(c, t), stiffnesses_of(c, t)
            reference, force = get(b, "r") + ahead * get(b, "slope"), pair(zeros(), zeros())
            for j in range(p.coordinates):
                x, law = record(first, COORDINATE_T, j), record(laws, STIFFNESS_T, 2 * i + j)
                command = get(x, "v") + p.pattern[j] * reference
                force = force + get(law, "d") * command + get(law, "s") * get(x, "slope")
            put(record(first, COORDINATE_T, i), "force", force)
            along = along + force * get(b, "carrier")
        samples[Y + i, 0] = total(real(along)) + samples[STEP + i, 0]
        samples[SUM + i, 0] = total(imag(along))
