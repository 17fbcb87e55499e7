"""Compiled carriers and targets of every controller: phases, the finger's motion, fades, reference envelopes.

A carrier has the phase ``phi = 2 pi (frequency t + wavenumber x) + phase``.  Fixed ones (wavenumber 0) are set from a
phase counted in turns at every refresh, and turned on by one product a sample between; position-locked ones are set
from the finger's position in every sample.  With M samples a block the carrier is that at the block's start.
"""

from numba import carray

from hapticrender.control.records import CONTROLLER_T, FADING, FIXED, LOCKED, PAIR_T, TILE_T, WAVEFORM, W, samples_of
from hapticrender.jit import C16, entry, kernel, pointer, record
from hapticrender.mathx import TURN, smooth, unit
from hapticrender.vectors import (
    get,
    imag,
    load,
    magnitude,
    maximum,
    minimum,
    nearest,
    pair,
    put,
    real,
    some,
    square,
    where,
)

REFRESH = 64  # samples between two looks at the setpoints, sample by sample
TRACKER_POLE = TURN * 60.0  # rad/s: triple pole of the finger's tracker; no lag under constant acceleration
FRESH_TIME = 0.03  # s: for so long after contact the onset of a friction is no part of the texture
SLOWEST = 0.1  # of the typical speed: a slower contact hardly modulates at all
FARTHEST = 1e3  # m: a position, or a target, beyond it is no number to work with
FASTEST = 10.0  # m/s: a finger that moves faster has been put down elsewhere


@kernel
def track_finger(c, position):
    """Update the finger's position, velocity and acceleration: an observer with a triple pole; NaN means lifted.

    The last velocity is held until the next touch, so that a target along the surface fades out where it was.
    """
    period = 1.0 / c.p.rate
    pole = TRACKER_POLE * period
    leapt = c.finger_seen > 0.0 and abs(position - c.held_position) * c.p.rate > FASTEST
    if leapt or not abs(position) <= FARTHEST:
        c.acceleration = c.finger_seen = 0.0
        c.speed = 0.0 if leapt else c.speed - pole * c.speed
        c.smooth_speed = 0.0 if leapt else c.smooth_speed + pole * (c.speed - c.smooth_speed)
        c.fresh = max(c.fresh - 1.0, 0.0)
        return
    came = c.finger_seen <= 0.0
    if came:
        c.velocity = 0.0
    moved = 0.0 if came else abs(position - c.held_position) * c.p.rate
    predicted = (position if came else c.smooth_position) + period * c.velocity
    innovation = position - predicted
    c.smooth_position = predicted + 3.0 * pole * innovation
    c.velocity += period * c.acceleration + 3.0 * pole * TRACKER_POLE * innovation
    c.acceleration += pole * TRACKER_POLE * TRACKER_POLE * innovation
    c.speed += pole * (moved - c.speed)
    c.smooth_speed += pole * (c.speed - c.smooth_speed)
    c.fresh = FRESH_TIME * c.p.rate if came else max(c.fresh - 1.0, 0.0)
    c.held_position, c.finger_seen = position, 1.0


@entry
def predict_positions(tracker, positions, ahead, predicted):
    """Extrapolate positions (m, NaN while lifted, where the last prediction holds) by `ahead` samples, causally."""
    c = record(tracker, CONTROLLER_T, 0)
    for n in range(len(positions)):
        track_finger(c, positions[n])
        if c.finger_seen > 0.0:
            time = ahead / c.p.rate
            c.held_prediction = positions[n] + time * (c.velocity + 0.5 * time * c.acceleration)
        predicted[n] = c.held_prediction


@kernel
def take_setpoints(c):
    """Read the setpoints into the tiles; tables and law are marked stale where a carrier is another one."""
    p, row = c.p, 8 * W * c.tiles
    c.locked = 0
    for t in range(c.tiles):
        b, at = record(c.tiles_at, TILE_T, t), c.setpoints_at + 8 * W * t
        frequency, wavenumber = load(at) + c.shift, load(at + row)
        setpoint, target = pair(load(at + 3 * row), load(at + 4 * row)), get(b, "target")
        changed = some(frequency != get(b, "frequency")) or some(wavenumber != get(b, "wavenumber"))
        growing = some(get(b, "fade") < 1.0) or some(square(target - setpoint) > 0.0)
        put(b, "frequency", frequency)
        put(b, "wavenumber", wavenumber)
        put(b, "phase", load(at + 2 * row))
        put(b, "setpoint", setpoint)
        put(b, "response", pair(load(at + 5 * row), load(at + 6 * row)))
        steady = not (growing or changed or p.reads_waveform > 0.0 or p.modulated > 0.0)
        b.mode[0] = FIXED if steady else FADING
        if p.needs_contact > 0.0 or some(wavenumber > 0.0):
            b.mode[0] = LOCKED
            c.locked += 1
        if changed:
            c.stale = 1
            put(b, "turn", unit(frequency / p.rate))
            put(b, "omega", TURN * frequency)


@kernel
def fade_fixed(c, t):
    """Fade the targets of fixed carriers in."""
    b, active = record(c.tiles_at, TILE_T, t), get(record(c.tiles_at, TILE_T, t), "active")
    fade = minimum(get(b, "fade") + c.p.fade_in * c.p.block, 1.0)
    put(b, "fade", fade)
    put(b, "weight", active * fade * fade * (3.0 - 2.0 * fade))
    # a block's response takes all of the feedback for granted
    put(b, "feedback", active if c.p.block > 1 else active * minimum(fade * (3.0 - 2.0 * fade), 1.0))


@kernel
def contact_lag(c):
    """Time (s) by which friction follows drive or sensors: the contact's length over the finger's speed.

    The speed is that of Brown's double smoothing, without lag under constant acceleration.
    """
    speed = max(2.0 * c.speed - c.smooth_speed, SLOWEST * c.p.typical_speed)
    return c.p.contact_length / speed if c.p.contact_length > 0.0 else 0.0


@kernel
def fade_locked(c, t):
    """Update frequency, sweep and weights of a tile whose carriers follow the finger, and what its sensor shows.

    A target fades in with contact (and with speed, where friction needs it), and out towards the ends of the device's
    range (the waveform law has no `lowest`, as a step of the target would be a kick); the feedback's weight stays until
    the last quadrature of it.
    """
    b, p = record(c.tiles_at, TILE_T, t), c.p
    step, always = p.fade_in * p.block, p.needs_contact == 0.0
    touching = c.finger_seen > 0.0 and (always or c.speed >= p.least_speed)
    number, active = get(b, "wavenumber"), get(b, "active")
    follows, signed = number > 0.0, get(b, "frequency") + number * c.velocity
    omega, hertz = TURN * signed, magnitude(signed)
    put(b, "omega", omega)
    put(b, "sweep", TURN * c.acceleration * number)
    fade = get(b, "fade") + where(follows, step if touching else -step, step if touching or always else -step)
    fade = minimum(maximum(fade, 0.0), 1.0)
    left = p.highest_edge - hertz * (1.0 / p.highest)
    weight = active * smooth(fade)
    if p.lowest > 0.0:
        weight = weight * where(follows, smooth(2.0 * hertz * (1.0 / p.lowest) - 1.0), 1.0)
    put(b, "fade", fade)
    put(b, "weight", weight * where(follows, smooth(left / (p.highest_edge - 1.0)), 1.0))
    put(b, "feedback", minimum(weight * where(follows, smooth(4.0 * left), 1.0) / maximum(fade, 1e-9), 1.0))
    if p.corrected > 0.0:  # before the contact's lag, and delayed
        put(b, "response", unit((-p.sensor_delay / TURN) * omega) * pair(1.0, contact_lag(c) * omega))


@kernel
def crowding(c):
    """Factor on the observer's gain under a slow finger, whose carriers lie close together."""
    return min(abs(c.velocity) / c.p.crowd_speed, 1.0) if c.p.crowd_speed > 0.0 else 1.0


@kernel
def advance_carriers(c):
    """Carriers and weights of all tiles for a block: setpoints, finger, phases, fades."""
    block, rate = c.p.block, c.p.rate
    refresh, ahead = block > 1 or c.sample % REFRESH == 0, float(block if block > 1 else REFRESH)
    if refresh:
        take_setpoints(c)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        mode = b.mode[0]
        if mode == LOCKED or refresh:
            one = mode == LOCKED and block == 1
            position = c.held_position if one else 0.0
            turns, frequency = get(b, "turns"), get(b, "frequency")
            put(b, "carrier", get(b, "active") * unit(turns + get(b, "wavenumber") * position + get(b, "phase")))
            turns = turns + (1.0 if one else ahead) * frequency / rate
            put(b, "turns", turns - nearest(turns))
        else:
            put(b, "carrier", get(b, "carrier") * get(b, "turn"))
        if mode == LOCKED:
            fade_locked(c, t)
        elif mode == FADING:
            fade_fixed(c, t)
        elif refresh:
            put(b, "slope", 0.0)
            put(b, "expected", get(b, "r"))
    c.sample += 1


@kernel
def update_targets(c, io, first, block):
    """Targets, references R and their slopes for a block, and a row of the log.

    A target is the setpoint times its weight, or follows the envelope that the waveform was found to have, at the
    observer's pace; both differentiated for a texture in velocity.
    """
    p = c.p
    rate, row, crowded_gain = p.rate / block, first // block, crowding(c) if block == 1 else 1.0
    follow = min(0.5 * crowded_gain * p.waveform_gain * block, 1.0)
    factor = samples_of(c)[WAVEFORM, block - 1] if p.modulated > 0.0 else 1.0
    log = carray(pointer(io.target, C16), (row + 1, c.bands))
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if b.mode[0] != FIXED:
            envelope = get(b, "raw") if p.reads_waveform > 0.0 else factor * get(b, "setpoint")
            if p.differentiated > 0.0:
                envelope = get(b, "omega") * pair(-1.0 * imag(envelope), real(envelope))
            target = get(b, "weight") * envelope
            if p.reads_waveform > 0.0:
                target = get(b, "target") + follow * (target - get(b, "target"))
            put(b, "target", target)
            last, reference = get(b, "r"), get(b, "response") * target
            put(b, "slope", rate * (reference - last))
            put(b, "expected", reference - (1.0 - p.middle) * (reference - last))
            if p.late > 0:
                kept = record(c.references_at, PAIR_T, c.sample % p.late * c.tiles + t)
                put(b, "expected", get(kept, "z"))
                put(kept, "z", reference)
            put(b, "r", reference)
        for k in range(min(W, c.bands - W * t)):
            log[row, W * t + k] = complex(b.target_re[k], b.target_im[k])
