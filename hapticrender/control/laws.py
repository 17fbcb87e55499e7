"""Compiled law of the default controller: dynamic stiffness, finger included, turned ahead by delay and hold.

    F = rho (D V + D' dV/dt + j dw/dt M V),   rho = e^(j w lead) (w T/2)/sin(w T/2)

with D(s) = M s^2 + C s + K + z(s) h h^T, h = [1, g] the finger's lever arm and z its three numbers and what a band
leaves over.  An error of the law for changes of W rad/s is bounded by m W^2/|D|.
"""

from __future__ import annotations

import math

from hapticrender.control.carriers import SLOWEST
from hapticrender.control.records import CONTROLLER_T, LOCKED, TILE_T, W
from hapticrender.jit import kernel, record
from hapticrender.mathx import TURN, sincos_turns


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
    b = record(c.tiles_at, TILE_T, t)
    lead, half = c.p.lead, 0.5 / c.p.rate
    for k in range(W):
        sin, cos = sincos_turns(lead / TURN * (b.omega[k] + 0.5 * lead * b.sweep[k]))
        x = half * b.omega[k]
        chord, _ = sincos_turns(x / TURN)
        grow = x / chord if abs(x) > 1e-9 else 1.0
        b.ahead_re[k], b.ahead_im[k] = grow * cos, grow * sin


@kernel
def tune_entry(re, damping, mass, w, im, cos, sin):
    """Entries of D and D', turned ahead by rho, for one pair of coordinates at one frequency."""
    re, im, turn = re - w * w * mass, im + w * damping, 2.0 * w * mass
    return re * cos - im * sin, re * sin + im * cos, damping * cos - turn * sin, damping * sin + turn * cos


@kernel
def tune(controller, t):
    """Set D and D' of a tile, with the finger as the law holds it."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p, on, g = c.p, c.known_contact, c.known_lever
    mass, stiffness = on * c.finger_mass, on * c.finger_stiffness
    damping = on * c.finger_damping + contact_damping(controller)
    m00, m01 = p.mass[0, 0] + mass, p.mass[0, 1] + g * mass
    m10, m11 = p.mass[1, 0] + g * mass, p.mass[1, 1] + g * g * mass
    b00, b01 = p.damping[0, 0] + damping, p.damping[0, 1] + g * damping
    b10, b11 = p.damping[1, 0] + g * damping, p.damping[1, 1] + g * g * damping
    k00, k01 = p.stiffness[0, 0] + stiffness, p.stiffness[0, 1] + g * stiffness
    k10, k11 = p.stiffness[1, 0] + g * stiffness, p.stiffness[1, 1] + g * g * stiffness
    for k in range(W):
        w, cos, sin, sweep = b.omega[k], b.ahead_re[k], b.ahead_im[k], b.sweep[k]
        re, im = on * b.remainder_re[k], on * b.remainder_im[k]
        b.d00_re[k], b.d00_im[k], b.s00_re[k], b.s00_im[k] = tune_entry(
            k00 + re, b00, m00, w, im + sweep * m00, cos, sin
        )
        re, im = g * re, g * im
        b.d01_re[k], b.d01_im[k], b.s01_re[k], b.s01_im[k] = tune_entry(
            k01 + re, b01, m01, w, im + sweep * m01, cos, sin
        )
        b.d10_re[k], b.d10_im[k], b.s10_re[k], b.s10_im[k] = tune_entry(
            k10 + re, b10, m10, w, im + sweep * m10, cos, sin
        )
        re, im = g * re, g * im
        b.d11_re[k], b.d11_im[k], b.s11_re[k], b.s11_im[k] = tune_entry(
            k11 + re, b11, m11, w, im + sweep * m11, cos, sin
        )


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
def update_law(controller, touching, turn):
    """Update the law with the finger estimate: where contact changed, in its turn, and always where carriers move."""
    c = record(controller, CONTROLLER_T, 0)
    known = 1.0 if touching else 0.0
    due = known != c.known_contact or (turn and touching) or c.stale > 0
    if due:
        c.known_contact, c.known_lever = known, c.lever
    if not (due or c.moving > 0):
        return
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        locked, ahead = b.mode[0] == LOCKED, c.p.extrapolation
        if locked:
            for k in range(W):
                b.omega[k] += ahead * b.sweep[k]
        if locked or c.stale > 0:
            turn_ahead(controller, t)
        if locked or due:
            tune(controller, t)
    c.stale = 0


@kernel
def force_part(d_re, d_im, s_re, s_im, v_re, v_im, slope_re, slope_im):
    """Force envelope D V + D' dV/dt of one pair of coordinates."""
    re = d_re * v_re - d_im * v_im + s_re * slope_re - s_im * slope_im
    return re, d_re * v_im + d_im * v_re + s_re * slope_im + s_im * slope_re


@kernel
def apply_law(controller):
    """Force envelopes rho (D V + D' dV/dt) of all bands; returns their sums now and a quarter turn ahead."""
    c = record(controller, CONTROLLER_T, 0)
    ahead, shape0, shape1 = c.p.extrapolation, c.p.shape[0], c.p.shape[1]
    along0 = along1 = across0 = across1 = 0.0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            re, im = b.r_re[k] + ahead * b.slope_re[k], b.r_im[k] + ahead * b.slope_im[k]
            v0r, v0i, v1r, v1i = (
                b.v0_re[k] + shape0 * re,
                b.v0_im[k] + shape0 * im,
                b.v1_re[k] + shape1 * re,
                b.v1_im[k] + shape1 * im,
            )
            s0r, s0i, s1r, s1i = b.slope0_re[k], b.slope0_im[k], b.slope1_re[k], b.slope1_im[k]
            re, im = force_part(b.d00_re[k], b.d00_im[k], b.s00_re[k], b.s00_im[k], v0r, v0i, s0r, s0i)
            more, turn = force_part(b.d01_re[k], b.d01_im[k], b.s01_re[k], b.s01_im[k], v1r, v1i, s1r, s1i)
            re, im, cos, sin = re + more, im + turn, b.cos[k], b.sin[k]
            b.force0_re[k], b.force0_im[k] = re, im
            along0, across0 = along0 + re * cos - im * sin, across0 + re * sin + im * cos
            re, im = force_part(b.d10_re[k], b.d10_im[k], b.s10_re[k], b.s10_im[k], v0r, v0i, s0r, s0i)
            more, turn = force_part(b.d11_re[k], b.d11_im[k], b.s11_re[k], b.s11_im[k], v1r, v1i, s1r, s1i)
            re, im = re + more, im + turn
            b.force1_re[k], b.force1_im[k] = re, im
            along1, across1 = along1 + re * cos - im * sin, across1 + re * sin + im * cos
    return along0, along1, across0, across1
