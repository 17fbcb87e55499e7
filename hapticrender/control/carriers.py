"""Compiled carriers and targets of every controller: phases, the finger's motion, fades, reference envelopes.

A carrier has the phase ``phi = 2 pi (frequency t + wavenumber x) + phase``.  Fixed ones (wavenumber 0) are set from a
phase counted in turns at every refresh, and turned on by one product a sample between; position-locked ones are set
from the finger's position in every sample.  With M samples a block the carrier is that at the block's start.
"""

from __future__ import annotations

from numba import carray

from hapticrender.control.records import CONTROLLER_T, FADING, FIXED, LOCKED, SETPOINT_ROWS, TILE_T, W
from hapticrender.jit import F8, kernel, pointer, record
from hapticrender.mathx import TURN, frac, sincos_turns, smoothstep_kernel

REFRESH = 64  # samples between two looks at the setpoints, sample by sample
TRACKER_POLE = TURN * 60.0  # rad/s: triple pole of the finger's tracker; no lag under constant acceleration
FRESH_TIME = 0.03  # s: for so long after contact the onset of a friction is no part of the texture
SLOWEST = 0.1  # of the typical speed: a slower contact hardly modulates at all
FARTHEST = 1e3  # m: a position, or a target, beyond it is no number to work with
FASTEST = 10.0  # m/s: a finger that moves faster has been put down elsewhere


@kernel
def track_finger(controller, position):
    """Update the finger's position, velocity and acceleration: an observer with a triple pole; NaN means lifted."""
    c = record(controller, CONTROLLER_T, 0)
    period = 1.0 / c.p.rate
    pole = TRACKER_POLE * period
    leapt = c.finger_seen > 0.0 and abs(position - c.held_position) * c.p.rate > FASTEST
    if leapt or not abs(position) <= FARTHEST:
        c.velocity = c.acceleration = c.finger_seen = 0.0
        c.speed = 0.0 if leapt else c.speed - pole * c.speed
        c.fresh = max(c.fresh - 1.0, 0.0)
        return
    came = c.finger_seen <= 0.0
    moved = 0.0 if came else abs(position - c.held_position) * c.p.rate
    predicted = (position if came else c.smooth_position) + period * c.velocity
    innovation = position - predicted
    c.smooth_position = predicted + 3.0 * pole * innovation
    c.velocity += period * c.acceleration + 3.0 * pole * TRACKER_POLE * innovation
    c.acceleration += pole * TRACKER_POLE * TRACKER_POLE * innovation
    c.speed += pole * (moved - c.speed)
    c.fresh = FRESH_TIME * c.p.rate if came else max(c.fresh - 1.0, 0.0)
    c.held_position, c.finger_seen = position, 1.0


@kernel
def take_setpoints(controller):
    """Read the setpoints into the tiles; tables and law are marked stale where a carrier is another one."""
    c = record(controller, CONTROLLER_T, 0)
    setpoints = carray(pointer(c.setpoints_at, F8), (SETPOINT_ROWS, c.bands))
    c.moving = 0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        locked = c.p.needs_contact > 0.0
        changed = growing = False
        for k in range(min(W, c.bands - W * t)):
            i = W * t + k
            frequency = setpoints[0, i] + c.shift
            changed = changed or b.frequency[k] != frequency or b.wavenumber[k] != setpoints[1, i] or b.active[k] == 0.0
            if b.active[k] == 0.0:
                b.turns[k] = 0.0
            b.active[k], b.frequency[k], b.wavenumber[k], b.phase[k] = 1.0, frequency, setpoints[1, i], setpoints[2, i]
            b.setpoint_re[k], b.setpoint_im[k] = setpoints[3, i], setpoints[4, i]
            b.response_re[k], b.response_im[k] = setpoints[5, i], setpoints[6, i]
            growing = (
                growing or b.fade[k] < 1.0 or b.target_re[k] != b.setpoint_re[k] or b.target_im[k] != b.setpoint_im[k]
            )
            locked = locked or b.wavenumber[k] > 0.0
        steady = not (growing or changed or c.p.analysed > 0.0 or c.p.modulated > 0.0)
        b.mode[0] = LOCKED if locked else (FIXED if steady else FADING)
        if b.mode[0] == LOCKED:
            c.moving += 1
        if changed:
            c.stale = 1
            for k in range(W):
                sin, cos = sincos_turns(b.frequency[k] / c.p.rate)
                b.turn_cos[k], b.turn_sin[k] = cos, sin
                b.omega[k] = TURN * b.frequency[k]


@kernel
def set_carriers(controller, t, count):
    """Set the fixed carriers of a tile from their phases, which are then counted on by `count` samples."""
    c = record(controller, CONTROLLER_T, 0)
    b, rate = record(c.tiles_at, TILE_T, t), c.p.rate
    for k in range(W):
        sin, cos = sincos_turns(b.turns[k] + b.phase[k])
        b.cos[k], b.sin[k] = b.active[k] * cos, b.active[k] * sin
        b.turns[k] = frac(b.turns[k] + count * b.frequency[k] / rate)


@kernel
def turn_carriers(controller, t):
    """Turn the fixed carriers of a tile on by a sample."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    for k in range(W):
        cos, sin = b.cos[k], b.sin[k]
        b.cos[k] = cos * b.turn_cos[k] - sin * b.turn_sin[k]
        b.sin[k] = sin * b.turn_cos[k] + cos * b.turn_sin[k]


@kernel
def lock_carriers(controller, t, position):
    """Set the carriers of a tile from the finger's position."""
    c = record(controller, CONTROLLER_T, 0)
    b, rate = record(c.tiles_at, TILE_T, t), c.p.rate
    for k in range(W):
        sin, cos = sincos_turns(b.turns[k] + b.wavenumber[k] * position + b.phase[k])
        b.cos[k], b.sin[k] = b.active[k] * cos, b.active[k] * sin
        b.turns[k] = frac(b.turns[k] + b.frequency[k] / rate)


@kernel
def fade_fixed(controller, t):
    """Fade the targets of fixed carriers in."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    step, whole = c.p.fade_in * c.p.block, c.p.block > 1  # a block's response takes all of the feedback for granted
    for k in range(W):
        fade = min(b.fade[k] + step, 1.0)
        b.fade[k] = fade
        b.weight[k] = b.active[k] * fade * fade * (3.0 - 2.0 * fade)
        b.feedback[k] = b.active[k] * (1.0 if whole else min(fade * (3.0 - 2.0 * fade), 1.0))


@kernel
def fade_locked(controller, t):
    """Update frequency, sweep and weights of a tile whose carriers follow the finger.

    A target fades in with contact (and with speed, where friction needs it), and out towards the ends of the device's
    range; the feedback's share stays until the last quarter of it.
    """
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p, velocity, acceleration = c.p, c.velocity, c.acceleration
    step, edge, per_highest, per_lowest = p.fade_in * p.block, p.highest_edge, 1.0 / p.highest, 1.0 / p.lowest
    felt = c.finger_seen > 0.0 and (p.needs_contact == 0.0 or c.speed >= p.least_speed)
    always = p.needs_contact == 0.0
    for k in range(W):
        number = b.wavenumber[k]
        signed = b.frequency[k] + number * velocity
        hertz = abs(signed)
        b.omega[k], b.sweep[k] = TURN * signed, TURN * number * acceleration
        rises = felt or (always and number == 0.0)
        fade = min(max(b.fade[k] + (step if rises else -step), 0.0), 1.0)
        below = smoothstep_kernel((edge - hertz * per_highest) / (edge - 1.0))
        heard = smoothstep_kernel(4.0 * (edge - hertz * per_highest))
        above = smoothstep_kernel(2.0 * hertz * per_lowest - 1.0)
        locked = number > 0.0
        grown = b.active[k] * smoothstep_kernel(fade) * (above if locked else 1.0)
        b.fade[k] = fade
        b.weight[k] = grown * (below if locked else 1.0)
        b.feedback[k] = min(grown * (heard if locked else 1.0) / max(fade, 1e-9), 1.0)


@kernel
def sensor_response(controller, t):
    """Set what the sensor shows per target of a tile: before the contact's lag, and delayed."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    p = c.p
    lag, delay = p.contact_lag / max(c.speed, SLOWEST * p.typical_speed), p.sensor_delay / TURN
    for k in range(W):
        sin, cos = sincos_turns(-delay * b.omega[k])
        behind = lag * b.omega[k]
        b.response_re[k], b.response_im[k] = cos - behind * sin, sin + behind * cos


@kernel
def crowding(controller):
    """Factor on the observer's gain under a slow finger, whose carriers lie close together."""
    c = record(controller, CONTROLLER_T, 0)
    if c.p.crowd_speed > 0.0:
        return min(abs(c.velocity) / c.p.crowd_speed, 1.0)
    return 1.0


@kernel
def given_target(controller, t, factor):
    """Set the target of a tile: its setpoint times its weight (and `factor`), differentiated where that is asked."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    differentiated = c.p.differentiated > 0.0
    for k in range(W):
        re, im = factor * b.weight[k] * b.setpoint_re[k], factor * b.weight[k] * b.setpoint_im[k]
        b.target_re[k] = -b.omega[k] * im if differentiated else re
        b.target_im[k] = b.omega[k] * re if differentiated else im


@kernel
def analysed_target(controller, t):
    """Low-pass the envelope that the waveform was found to have, as the observer does, into the target of a tile."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    differentiated = c.p.differentiated > 0.0
    calm = crowding(controller) if c.p.block == 1 else 1.0
    follow = min(0.5 * calm * c.p.reference * c.p.block, 1.0)
    for k in range(W):
        re = -b.omega[k] * b.raw_im[k] if differentiated else b.raw_re[k]
        im = b.omega[k] * b.raw_re[k] if differentiated else b.raw_im[k]
        b.target_re[k] += follow * (b.weight[k] * re - b.target_re[k])
        b.target_im[k] += follow * (b.weight[k] * im - b.target_im[k])


@kernel
def set_reference(controller, t):
    """Reference envelope of a tile, its slope, and its value in the block's middle."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    rate, middle = c.p.rate / c.p.block, c.p.middle
    for k in range(W):
        re = b.response_re[k] * b.target_re[k] - b.response_im[k] * b.target_im[k]
        im = b.response_re[k] * b.target_im[k] + b.response_im[k] * b.target_re[k]
        b.slope_re[k], b.slope_im[k] = rate * (re - b.r_re[k]), rate * (im - b.r_im[k])
        b.expected_re[k] = b.r_re[k] + middle * (re - b.r_re[k])
        b.expected_im[k] = b.r_im[k] + middle * (im - b.r_im[k])
        b.r_re[k], b.r_im[k] = re, im


@kernel
def hold_reference(controller, t):
    """Reference of a tile whose targets no longer change."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    for k in range(W):
        b.slope_re[k] = b.slope_im[k] = 0.0
        b.expected_re[k], b.expected_im[k] = b.r_re[k], b.r_im[k]


@kernel
def advance_carriers(controller):
    """Carriers and weights of all tiles for a block: setpoints, finger, phases, fades."""
    c = record(controller, CONTROLLER_T, 0)
    block = c.p.block
    refresh = block > 1 or c.sample % REFRESH == 0
    if refresh:
        take_setpoints(controller)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if b.mode[0] == LOCKED:
            if block == 1:
                lock_carriers(controller, t, c.held_position)
            else:
                set_carriers(controller, t, block)
            fade_locked(controller, t)
            if c.p.corrected > 0.0:
                sensor_response(controller, t)
            continue
        if refresh:
            set_carriers(controller, t, block if block > 1 else REFRESH)
        else:
            turn_carriers(controller, t)
        if b.mode[0] == FADING:
            fade_fixed(controller, t)
        elif refresh:
            hold_reference(controller, t)
    c.sample += 1


@kernel
def put_targets(controller, target, row):
    """Write the targets of all bands into a row of the log."""
    c = record(controller, CONTROLLER_T, 0)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(min(W, c.bands - W * t)):
            target[row, W * t + k] = complex(b.target_re[k], b.target_im[k])
