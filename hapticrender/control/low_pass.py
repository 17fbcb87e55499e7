"""The step of the methods that estimate by a low pass: polar loops, and complex loops with the free device's inverse.

With a carrier e^(j phi) and y a coordinate, a band's envelope is X = L[2 y e^(-j phi)], L a second-order low pass or
the mean over a window (Grigorii et al. 2021, eqs. 1-4).  C is the loop controller, R the reference envelope.

Polar (their eqs. 3 and 5), with s = +-1 the sign of the carrier's frequency and g, theta_D gain and phase of the free
device from a table over frequency::

    A = max(C[|R| - |X|], 0),   theta = -C[s arg(X conj R)],   u = sum A/g cos(phi + arg R + s theta)

so that a carrier that runs backwards is followed as its mirror image.  Without feedback A = |R| and theta makes up for
theta_D, delay and hold.

Complex, in the device's coordinates: V = C[shape R - X], or V = shape R + C[-X] of the deviation from the reference,
and F = rho D(jw) V, or rho (D V + D' dV/dt + j dw/dt M V), of the free device; see `laws` for rho.
"""

from __future__ import annotations

import math

from numba import carray

from hapticrender.control.carriers import advance_carriers, update_targets
from hapticrender.control.kernel import FORGET, analyse_sample, sense_block, update_confidence
from hapticrender.control.laws import turn_ahead
from hapticrender.control.limiter import SATURATED, drive_of
from hapticrender.control.records import CONTROLLER_T, FIXED, LOCKED, LOW_PASS_T, SUM, TILE_T, W, Y, samples_of
from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, record, step
from hapticrender.mathx import TURN, polar, sincos_turns

SILENCE = 1e-12  # m: the phase of a smaller target means nothing
TABLE_POLE = (
    TURN * 40.0
)  # rad/s: of the velocity at which the table is looked up; the tracker's overshoots at a reversal


@kernel
def low_pass(controller, t, i, y):
    """Update the envelopes of a tile in coordinate i: a second-order section, transposed direct form II."""
    c = record(controller, CONTROLLER_T, 0)
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    b0, b1, b2 = 2.0 * y * c.p.low_pass[0], 2.0 * y * c.p.low_pass[1], 2.0 * y * c.p.low_pass[2]
    a1, a2 = c.p.low_pass[3], c.p.low_pass[4]
    for k in range(W):
        cos, sin = b.carrier_re[k], -b.carrier_im[k]
        re, im = b0 * cos + x.low1_re[k], b0 * sin + x.low1_im[k]
        x.low1_re[k] = b1 * cos - a1 * re + x.low2_re[k]
        x.low1_im[k] = b1 * sin - a1 * im + x.low2_im[k]
        x.low2_re[k], x.low2_im[k] = b2 * cos - a2 * re, b2 * sin - a2 * im
        x.x_re[k], x.x_im[k] = re, im


@kernel
def window_mean(controller, t, i, y):
    """Update the envelopes of a tile in coordinate i: the mean over a window, its sum renewed against rounding.

    `low1` is the running sum, `low2` one from the window's first place on, which replaces it once a window.
    """
    c = record(controller, CONTROLLER_T, 0)
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    length, place = c.p.window, c.sample % c.p.window
    window = carray(pointer(c.window_at, F8), (length, c.p.coordinates * c.tiles, 2, W))[place, i * c.tiles + t]
    last, share, twice = place == length - 1, 1.0 / length, 2.0 * y
    for k in range(W):
        re, im = twice * b.carrier_re[k], -twice * b.carrier_im[k]
        fresh_re, fresh_im = x.low2_re[k] + re, x.low2_im[k] + im
        sum_re = fresh_re if last else x.low1_re[k] + (re - window[0, k])
        sum_im = fresh_im if last else x.low1_im[k] + (im - window[1, k])
        window[0, k], window[1, k] = re, im
        x.low1_re[k], x.low1_im[k] = sum_re, sum_im
        x.low2_re[k], x.low2_im[k] = (0.0 if last else fresh_re), (0.0 if last else fresh_im)
        x.x_re[k], x.x_im[k] = share * sum_re, share * sum_im


@kernel
def interpolate(table, row, at):
    """Value of a row of a table at a fractional place."""
    at = min(at, table.shape[1] - 1.000001)
    i = int(at)
    return table[row, i] + (at - i) * (table[row, i + 1] - table[row, i])


@kernel
def look_up(controller, t):
    """Set drive per metre and lag of the free device for a tile, from the table over frequency."""
    c = record(controller, CONTROLLER_T, 0)
    b, n = record(c.tiles_at, TILE_T, t), c.p.coordinates
    table = carray(pointer(c.gains_at, F8), (2 * n, c.p.table))
    for i in range(n):
        x = record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
        for k in range(min(W, c.bands - W * t)):
            at = abs(b.frequency[k] + b.wavenumber[k] * c.table_velocity) / c.p.table_step
            x.drive[k] = 1.0 / interpolate(table, i, at)
            x.lag[k] = interpolate(table, n + i, at)


@kernel
def smooth_velocity(controller, seen, held):
    """Low-pass the finger's velocity for the table, from whether and where it was a sample ago."""
    c = record(controller, CONTROLLER_T, 0)
    velocity = (c.held_position - held) * c.p.rate if seen > 0.0 else 0.0
    c.table_velocity += (1.0 - math.exp(-TABLE_POLE / c.p.rate)) * (velocity - c.table_velocity)


@kernel
def aim(controller, t):
    """Set amplitude and direction of the reference of a tile; in silence the last direction stays."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    for k in range(W):
        re, im, w = b.r_re[k], b.r_im[k], b.omega[k]
        amount = math.sqrt(re * re + im * im)
        sounds = amount > SILENCE
        per = 1.0 / (amount if sounds else 1.0)
        b.amount[k], b.sounds[k] = amount, (1.0 if sounds else 0.0)
        b.heading_re[k] = re * per if sounds else b.heading_re[k]
        b.heading_im[k] = im * per if sounds else b.heading_im[k]
        b.direction[k] = math.copysign(1.0, w) if w != 0.0 else b.direction[k]


@kernel
def compare(controller, t, i):
    """Set amplitude and phase error of the envelopes of a tile, in `amplitude` and `theta`."""
    c = record(controller, CONTROLLER_T, 0)
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    if c.p.subtracted > 0.0:  # each angle with a seam of its own
        for k in range(W):
            size, angle = polar(x.x_re[k], b.direction[k] * x.x_im[k])
            _, aimed = polar(b.heading_re[k], b.direction[k] * b.heading_im[k])
            x.amplitude[k], x.theta[k] = size, angle - aimed
        return
    for k in range(W):
        re, im, hr, hi = x.x_re[k], x.x_im[k], b.heading_re[k], b.heading_im[k]
        x.amplitude[k], x.theta[k] = polar(re * hr + im * hi, b.direction[k] * (im * hr - re * hi))


@kernel
def polar_loops(controller, t, i):
    """Update commanded amplitude and phase of a tile in coordinate i from their errors."""
    c = record(controller, CONTROLLER_T, 0)
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    b0, b1, b2, a1, a2 = c.p.loop[0], c.p.loop[1], c.p.loop[2], c.p.loop[3], c.p.loop[4]
    floor = 0.0 if c.p.clamped > 0.0 else -math.inf
    for k in range(W):
        error, lag = b.amount[k] - x.amplitude[k], b.sounds[k] * x.theta[k]
        command = b0 * error + x.law1_re[k]
        command = command if command > floor else floor  # a negative one would be positive feedback
        phase = b0 * lag + x.law1_im[k]
        x.law1_re[k] = b1 * error - a1 * command + x.law2_re[k]
        x.law1_im[k] = b1 * lag - a1 * phase + x.law2_im[k]
        x.law2_re[k], x.law2_im[k] = b2 * error - a2 * command, b2 * lag - a2 * phase
        x.amplitude[k], x.theta[k] = command, -phase


@kernel
def open_loop(controller, t, i):
    """Set commanded amplitude and phase of a tile without feedback: the device's lag, delay and hold made up for."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    x, lead = record(c.loops_at, LOW_PASS_T, i * c.tiles + t), c.p.lead
    for k in range(W):
        x.amplitude[k], x.theta[k] = b.amount[k], lead * abs(b.omega[k]) - x.lag[k]


@kernel
def sum_drives(controller, t, i):
    """Drive of a tile in coordinate i."""
    c = record(controller, CONTROLLER_T, 0)
    b = record(c.tiles_at, TILE_T, t)
    x, total = record(c.loops_at, LOW_PASS_T, i * c.tiles + t), 0.0
    for k in range(W):
        sin, cos = sincos_turns(x.theta[k] / TURN)
        along = b.heading_re[k] * b.carrier_re[k] - b.heading_im[k] * b.carrier_im[k]
        across = b.heading_re[k] * b.carrier_im[k] + b.heading_im[k] * b.carrier_re[k]
        total += x.drive[k] * x.amplitude[k] * (along * cos - b.direction[k] * across * sin)
    return total


@kernel
def estimate(controller, t, i, y):
    """Update the envelopes of a tile in coordinate i by the method's estimator."""
    c = record(controller, CONTROLLER_T, 0)
    if c.p.window > 0:
        window_mean(controller, t, i, y)
    else:
        low_pass(controller, t, i, y)


@kernel
def polar_law(controller):
    """Drive of every coordinate by the polar law, into the rows SUM of `samples`."""
    c = record(controller, CONTROLLER_T, 0)
    samples = samples_of(controller)
    for i in range(c.p.coordinates):
        samples[SUM + i, 0] = 0.0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if c.stale > 0 or b.mode[0] == LOCKED:
            look_up(controller, t)
        if c.stale > 0 or b.mode[0] != FIXED:
            aim(controller, t)
        for i in range(c.p.coordinates):
            if c.p.feedback > 0.0:
                estimate(controller, t, i, samples[Y + i, 0])
                compare(controller, t, i)
                polar_loops(controller, t, i)
            else:
                open_loop(controller, t, i)
            samples[SUM + i, 0] += sum_drives(controller, t, i)
    c.stale = 0


@kernel
def reference_motion(controller):
    """Sum of the reference waveforms of all bands."""
    c = record(controller, CONTROLLER_T, 0)
    total = 0.0
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        for k in range(W):
            total += b.r_re[k] * b.carrier_re[k] - b.r_im[k] * b.carrier_im[k]
    return total


@kernel
def complex_loops(controller, t, i):
    """Update V and dV/dt of a tile in coordinate i; without feedback V is the reference."""
    c = record(controller, CONTROLLER_T, 0)
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    b0, b1, b2, a1, a2 = c.p.loop[0], c.p.loop[1], c.p.loop[2], c.p.loop[3], c.p.loop[4]
    rate, forward = c.p.rate, c.p.shape[i] * c.p.forward
    against, on, fading = (0.0 if c.p.deviation > 0.0 else c.p.shape[i]), c.p.feedback, FORGET / c.p.rate
    for k in range(W):
        weight, rr, ri = b.weight[k], b.r_re[k], b.r_im[k]
        keep, pull = 1.0 - fading * (1.0 - weight), on * weight
        er, ei = pull * (against * rr - x.x_re[k]), pull * (against * ri - x.x_im[k])
        re, im = b0 * er + x.law1_re[k], b0 * ei + x.law1_im[k]
        x.law1_re[k] = keep * (b1 * er - a1 * re + x.law2_re[k])
        x.law1_im[k] = keep * (b1 * ei - a1 * im + x.law2_im[k])
        x.law2_re[k], x.law2_im[k] = keep * (b2 * er - a2 * re), keep * (b2 * ei - a2 * im)
        re, im = re + forward * rr, im + forward * ri
        x.slope_re[k], x.slope_im[k] = rate * (re - x.v_re[k]), rate * (im - x.v_im[k])
        x.v_re[k], x.v_im[k] = re, im


@kernel
def device_force(controller, t, i, j):
    """Force of a tile in coordinate i for V in coordinate j, through the free device's dynamic stiffness."""
    c = record(controller, CONTROLLER_T, 0)
    b, x, total = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, j * c.tiles + t), 0.0
    m, d, s, dynamic = c.p.mass[i, j], c.p.damping[i, j], c.p.stiffness[i, j], c.p.dynamic
    for k in range(W):
        w, vr, vi = b.omega[k], x.v_re[k], x.v_im[k]
        sr, si = dynamic * x.slope_re[k], dynamic * x.slope_im[k]
        along, across, turn = s - w * w * m, w * d + dynamic * b.sweep[k] * m, 2.0 * w * m
        re = along * vr - across * vi + d * sr - turn * si
        im = along * vi + across * vr + d * si + turn * sr
        cos = b.ahead_re[k] * b.carrier_re[k] - b.ahead_im[k] * b.carrier_im[k]
        sin = b.ahead_re[k] * b.carrier_im[k] + b.ahead_im[k] * b.carrier_re[k]
        total += re * cos - im * sin
    return total


@kernel
def complex_law(controller):
    """Force of every coordinate by the complex law, into the rows SUM of `samples`."""
    c = record(controller, CONTROLLER_T, 0)
    samples, n = samples_of(controller), c.p.coordinates
    if c.p.deviation > 0.0:
        total = reference_motion(controller)
        for i in range(n):
            samples[Y + i, 0] -= c.p.shape[i] * total
    for i in range(n):
        samples[SUM + i, 0] = 0.0
    for t in range(c.tiles):
        if c.stale > 0 or record(c.tiles_at, TILE_T, t).mode[0] == LOCKED:
            turn_ahead(controller, t)
        for i in range(n):
            if c.p.feedback > 0.0:
                estimate(controller, t, i, samples[Y + i, 0])
            complex_loops(controller, t, i)
        for i in range(n):
            for j in range(n):
                samples[SUM + i, 0] += device_force(controller, t, i, j)
    c.stale = 0


@kernel
def reset_loops(controller):
    """Reset the loops: no confidence in the sensors is left.  A window keeps its samples, which leave it in time."""
    c = record(controller, CONTROLLER_T, 0)
    keep = 1.0 if c.p.window > 0 else 0.0
    for i in range(c.p.coordinates * c.tiles):
        x = record(c.loops_at, LOW_PASS_T, i)
        for k in range(W):
            x.low1_re[k], x.low1_im[k] = keep * x.low1_re[k], keep * x.low1_im[k]
            x.low2_re[k], x.low2_im[k] = keep * x.low2_re[k], keep * x.low2_im[k]
            x.law1_re[k] = x.law1_im[k] = x.law2_re[k] = x.law2_im[k] = 0.0
            x.v_re[k] = x.v_im[k] = 0.0


@kernel
def cut_drive(controller, drive, flags, n):
    """Write the drive of a sample, every channel cut to its limit."""
    c = record(controller, CONTROLLER_T, 0)
    samples, limit = samples_of(controller), c.p.drive_limit
    for i in range(c.p.channels):
        exact = c.confidence * drive_of(controller, samples, SUM, 0, i)
        drive[n, i] = min(max(exact, -limit), limit)
        if abs(exact) > limit:
            flags[n] |= SATURATED


@step
def low_pass_step(state, signals, start, count):
    """Advance a controller with low passes by `count` samples; see `hapticrender.jit`."""
    c, io, stop = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0), start + count
    drive, flags = carray(pointer(io.drive, F8), (stop, c.p.channels)), carray(pointer(io.flags, I8), stop)
    for n in range(start, stop):
        seen, held = c.finger_seen, c.held_position
        implausible = sense_block(state, signals, n)
        if c.moving > 0:
            smooth_velocity(state, seen, held)
        advance_carriers(state)
        if c.p.analysed > 0.0:
            analyse_sample(state)
        update_targets(state, signals, n)
        if update_confidence(state, implausible):
            reset_loops(state)
        if c.p.polar > 0.0:
            polar_law(state)
        else:
            complex_law(state)
        cut_drive(state, drive, flags, n)
    return 0
