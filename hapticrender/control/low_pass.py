"""The step of the methods that estimate by a low pass: polar loops, and complex loops with the free device's inverse.

With a carrier e^(j phi) and y a coordinate, a band's envelope is X = L[2 y e^(-j phi)], L a second-order low pass or
the mean over a window; C is the loop controller, R the reference envelope.  The laws are those of docs/theory.md, "Loop
shaping of the paper" (Grigorii et al. 2021, eqs. 1-5).  In the polar one the sign of a carrier's frequency turns the
phase, so that a carrier that runs backwards is followed as its mirror image; without feedback the amplitude is |R| and
the phase makes up for that of the device, delay and hold.  The complex ones hand V to `laws`, static without D'.
"""

import math

from numba import carray

from hapticrender.control.carriers import advance_carriers, update_targets
from hapticrender.control.kernel import LEAK, analyse_sample, sense_block, update_confidence
from hapticrender.control.laws import apply_law, update_law
from hapticrender.control.peak_limit import SATURATED, drive_of
from hapticrender.control.records import (
    CONTROLLER_T,
    COORDINATE_T,
    FIXED,
    LOCKED,
    LOW_PASS_T,
    PAIR_T,
    TILE_T,
    W,
    Y,
    coordinates_of,
    samples_of,
)
from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, record, step
from hapticrender.mathx import TURN, polar, unit
from hapticrender.vectors import conj, get, imag, magnitude, maximum, pair, put, real, sqrt, square, total, where, zeros

SILENCE = 1e-12  # m: the phase of a smaller target means nothing
TABLE_POLE = TURN * 40.0  # rad/s: of the velocity by which the table is read; the tracker's overshoots at a reversal


@kernel
def estimate(c, t, i, y):
    """Update the envelopes X of a tile in coordinate i; returns them.

    The low pass is a second-order section in transposed direct form II.  The mean over a window has a running sum,
    `low1`, which one from the window's first place on, `low2`, replaces once a window against rounding.
    """
    x, p = record(c.loops_at, LOW_PASS_T, i * c.tiles + t), c.p
    found, low2 = 2.0 * y * conj(get(record(c.tiles_at, TILE_T, t), "carrier")), get(x, "low2")
    if p.window > 0:
        place = c.sample % p.window
        entry = record(c.window_at, PAIR_T, (place * p.coordinates + i) * c.tiles + t)
        renewed, running = low2 + found, get(x, "low1") + (found - get(entry, "z"))
        put(entry, "z", found)
        if place == p.window - 1:
            running, renewed = renewed, 0.0 * renewed
        put(x, "low1", running)
        put(x, "low2", renewed)
        return (1.0 / p.window) * running
    envelope = p.low_pass[0] * found + get(x, "low1")
    put(x, "low1", p.low_pass[1] * found - p.low_pass[3] * envelope + low2)
    put(x, "low2", p.low_pass[2] * found - p.low_pass[4] * envelope)
    return envelope


@kernel
def look_up(c, t):
    """Set drive per metre and lag of the free device for a tile, from the table over frequency."""
    b, n = record(c.tiles_at, TILE_T, t), c.p.coordinates
    table = carray(pointer(c.gains_at, F8), (2 * n, c.p.table))
    for i in range(n):
        x = record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
        for k in range(min(W, c.bands - W * t)):
            at = abs(b.frequency[k] + b.wavenumber[k] * c.table_velocity) / c.p.table_step
            at = min(at, c.p.table - 1.000001)
            low = int(at)
            share = at - low
            x.drive[k] = 1.0 / (table[i, low] + share * (table[i, low + 1] - table[i, low]))
            x.lag[k] = table[n + i, low] + share * (table[n + i, low + 1] - table[n + i, low])


@kernel
def set_reference_phasor(c, t):
    """Set amplitude and direction of the reference of a tile; in silence the last direction stays."""
    b = record(c.tiles_at, TILE_T, t)
    reference, omega = get(b, "r"), get(b, "omega")
    r_magnitude = sqrt(square(reference))
    r_nonzero = r_magnitude > SILENCE
    put(b, "r_magnitude", r_magnitude)
    put(b, "r_nonzero", where(r_nonzero, 1.0, 0.0))
    put(b, "r_phasor", where(r_nonzero, reference / maximum(r_magnitude, SILENCE), get(b, "r_phasor")))
    put(b, "omega_sign", where(omega > 0.0, 1.0, where(omega < 0.0, -1.0, get(b, "omega_sign"))))


@kernel
def loop_controller(c, x, error, floor):
    """Output of the loop controller C, a second-order section; its real part is kept above a floor."""
    p = c.p
    out = p.loop[0] * error + get(x, "law1")
    out = pair(maximum(real(out), floor), imag(out))
    put(x, "law1", p.loop[1] * error - p.loop[3] * out + get(x, "law2"))
    put(x, "law2", p.loop[2] * error - p.loop[4] * out)
    return out


@kernel
def polar_loops(c, t, i, envelope):
    """Command (amplitude, phase) of a tile in coordinate i from the errors of amplitude and phase."""
    b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
    r_phasor, omega_sign = get(b, "r_phasor"), get(b, "omega_sign")
    if c.p.subtracted > 0.0:  # each angle with a seam of its own
        size, angle = polar(pair(real(envelope), omega_sign * imag(envelope)))
        _, aimed = polar(pair(real(r_phasor), omega_sign * imag(r_phasor)))
        angle = angle - aimed
    else:
        turned = envelope * conj(r_phasor)
        size, angle = polar(pair(real(turned), omega_sign * imag(turned)))
    # a negative amplitude would be positive feedback
    floor = 0.0 if c.p.clamped > 0.0 else -math.inf
    out = loop_controller(c, x, pair(get(b, "r_magnitude") - size, get(b, "r_nonzero") * angle), floor)
    return real(out), -1.0 * imag(out)


@kernel
def polar_law(c):
    """Drive of every coordinate by the polar law, into the rows Y of `samples`.

    Without feedback the device's lag, delay and hold are made up for.
    """
    samples = samples_of(c)
    for i in range(c.p.coordinates):
        drive = zeros()
        for t in range(c.tiles):
            b, x = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t)
            if i == 0 and (c.stale > 0 or b.mode[0] == LOCKED):
                look_up(c, t)
            if i == 0 and (c.stale > 0 or b.mode[0] != FIXED):
                set_reference_phasor(c, t)
            if c.p.feedback > 0.0:
                amplitude, angle = polar_loops(c, t, i, estimate(c, t, i, samples[Y + i, 0]))
            else:
                amplitude, angle = get(b, "r_magnitude"), c.p.lead * magnitude(get(b, "omega")) - get(x, "lag")
            turn, wave = unit((1.0 / TURN) * angle), get(b, "r_phasor") * get(b, "carrier")
            wave = real(wave) * real(turn) - get(b, "omega_sign") * imag(wave) * imag(turn)
            drive = drive + get(x, "drive") * amplitude * wave
        samples[Y + i, 0] = total(drive)
    c.stale = 0


@kernel
def complex_loops(c, t, i, envelope):
    """Update V and dV/dt of a tile in coordinate i; without feedback V is the reference."""
    b, x, p = record(c.tiles_at, TILE_T, t), record(c.loops_at, LOW_PASS_T, i * c.tiles + t), c.p
    own = record(coordinates_of(c, t), COORDINATE_T, i)
    reference, weight = p.pattern[i] * get(b, "r"), get(b, "weight")
    against = 0.0 if p.deviation > 0.0 else 1.0
    out = loop_controller(c, x, p.feedback * weight * (against * reference - envelope), -math.inf)
    keep = 1.0 - LEAK / p.rate * (1.0 - weight)
    put(x, "law1", keep * get(x, "law1"))
    put(x, "law2", keep * get(x, "law2"))
    v = out + p.forward * reference
    put(own, "slope", p.rate * (v - get(x, "v")))
    put(own, "v", v - reference)  # the law adds it
    put(x, "v", v)


@kernel
def complex_law(c):
    """Force of every coordinate by the complex law and the free device's D, into the rows Y of `samples`."""
    samples, p, reference = samples_of(c), c.p, zeros()
    if p.deviation > 0.0:
        for t in range(c.tiles):
            b = record(c.tiles_at, TILE_T, t)
            reference = reference + real(get(b, "r") * get(b, "carrier"))
    expected = total(reference)
    for t in range(c.tiles):
        for i in range(p.coordinates):
            envelope = pair(zeros(), zeros())
            if p.feedback > 0.0:
                envelope = estimate(c, t, i, samples[Y + i, 0] - p.pattern[i] * expected)
            complex_loops(c, t, i, envelope)
    update_law(c, False, False)
    apply_law(c)


@kernel
def reset_loops(c):
    """Reset the loops: no confidence in the sensors is left.  A window keeps its samples, which leave it in time."""
    for i in range(c.p.coordinates * c.tiles):
        x = record(c.loops_at, LOW_PASS_T, i)
        if c.p.window == 0:
            put(x, "low1", 0.0)
            put(x, "low2", 0.0)
        put(x, "law1", 0.0)
        put(x, "law2", 0.0)
        put(x, "v", 0.0)


@step
def low_pass_step(state, signals, start, count):
    """Advance a controller with low passes by `count` samples, every channel cut to its limit; see `jit`."""
    c, io, stop = record(state, CONTROLLER_T, 0), record(signals, SIGNALS_T, 0), start + count
    p, samples, limit, follow = c.p, samples_of(c), c.p.drive_limit, 1.0 - math.exp(-TABLE_POLE / c.p.rate)
    drive, flags = carray(pointer(io.drive, F8), (stop, p.channels)), carray(pointer(io.flags, I8), stop)
    for n in range(start, stop):
        seen, held = c.finger_seen, c.held_position
        implausible = sense_block(c, io, n, 1)
        if implausible > 0:  # these methods predict nothing
            samples[Y, 0], samples[Y + 1, 0] = 0.0, 0.0
        if c.locked > 0:
            velocity = (c.held_position - held) * p.rate if seen > 0.0 else 0.0
            c.table_velocity += follow * (velocity - c.table_velocity)
        advance_carriers(c)
        if p.reads_waveform > 0.0:
            analyse_sample(c)
        update_targets(c, io, n, 1)
        if update_confidence(c, implausible):
            reset_loops(c)
        if p.polar > 0.0:
            polar_law(c)
        else:
            complex_law(c)
        for i in range(p.channels):
            exact = c.confidence * drive_of(c, samples, Y, 0, i)
            drive[n, i] = min(max(exact, -limit), limit)
            if abs(exact) > limit:
                flags[n] |= SATURATED
    return 0
