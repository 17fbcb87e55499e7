"""A block of the paper's controller: in the usual case four short passes over a tile, else sample by sample.

Where carriers and targets stay and sensors are believed, nothing of a sample waits for the one before it but two short
recursions.  In a pass of its own each of them runs beside the other coordinate's, and the rest is free of them, so that
the processor works on many samples at once.  The arithmetic is that of `polar_kernels.tile_step`, to rounding.
"""

from __future__ import annotations

from hapticrender._jit import kernel
from hapticrender._lanes import lanes, put, put_pairs, select
from hapticrender._polynomials import unit
from hapticrender.control.kernels import QUIET, TURN
from hapticrender.control.polar_kernels import (
    AMOUNT,
    AMPLITUDE1,
    COS,
    DRIVE,
    FORWARD,
    HEADING_IM,
    HEADING_RE,
    LOOP_ROWS,
    RE1,
    REFRESH,
    SHARED_ROWS,
    SIN,
    TARGET_IM,
    TARGET_RE,
    TRUST,
    TURN_COS,
    TURN_SIN,
    X_IM,
    X_RE,
    clamped_step,
    polar_cut_at_90,
    refresh,
    section_step,
    share,
    silence,
    speak,
    tile_step,
)

# rows of PolarState.scratch: carrier; then, two a coordinate, its envelope, which becomes what the loops compare, and
# then what they command: amplitude and phase
CARRIER_COS, CARRIER_SIN, FIRST = range(3)
SCRATCH_ROWS = 2  # and two a coordinate


@kernel
def hear(tables, state, t, count, c, d):
    """Carriers of a tile, and the STDFT* of coordinates c and d side by side."""
    band, loop, shared, scratch, section = state.band, state.loop, state.shared, state.scratch, tables.numbers.filter
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
    at, to = c * LOOP_ROWS + RE1, d * LOOP_ROWS + RE1
    a1, a2, b1, b2 = lanes(loop, t, at), lanes(loop, t, at + 1), lanes(loop, t, at + 2), lanes(loop, t, at + 3)
    e1, e2, f1, f2 = lanes(loop, t, to), lanes(loop, t, to + 1), lanes(loop, t, to + 2), lanes(loop, t, to + 3)
    re = im = x = y = cos
    for m in range(count):
        if (state.sample[0] + m) % REFRESH > 0:
            cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
        put(scratch, CARRIER_COS, m, cos)
        put(scratch, CARRIER_SIN, m, sin)
        one, other = 2.0 * shared[SHARED_ROWS + c, m], 2.0 * shared[SHARED_ROWS + d, m]
        re, a1, a2 = section_step(section, a1, a2, one * cos)
        im, b1, b2 = section_step(section, b1, b2, -one * sin)
        x, e1, e2 = section_step(section, e1, e2, other * cos)
        y, f1, f2 = section_step(section, f1, f2, -other * sin)
        put(scratch, FIRST + 2 * c, m, re)
        put(scratch, FIRST + 2 * c + 1, m, im)
        put(scratch, FIRST + 2 * d, m, x)
        put(scratch, FIRST + 2 * d + 1, m, y)
    put(band, t, COS, cos)
    put(band, t, SIN, sin)
    for r, value in enumerate((a1, a2, b1, b2)):
        put(loop, t, at + r, value)
    for r, value in enumerate((e1, e2, f1, f2)):
        put(loop, t, to + r, value)
    put(loop, t, c * LOOP_ROWS + X_RE, re)
    put(loop, t, c * LOOP_ROWS + X_IM, im)
    put(loop, t, d * LOOP_ROWS + X_RE, x)
    put(loop, t, d * LOOP_ROWS + X_IM, y)


@kernel
def compare(state, t, count, c):
    """Amplitude and phase of X against what is wanted (eq. 3, 5)."""
    band, scratch = state.band, state.scratch
    amount, h_re, h_im = lanes(band, t, AMOUNT), lanes(band, t, HEADING_RE), lanes(band, t, HEADING_IM)
    sounds = amount > QUIET
    for m in range(count):
        re, im = lanes(scratch, FIRST + 2 * c, m), lanes(scratch, FIRST + 2 * c + 1, m)
        found, lag = polar_cut_at_90(im * h_re - re * h_im, re * h_re + im * h_im)
        put(scratch, FIRST + 2 * c, m, amount - found)
        put(scratch, FIRST + 2 * c + 1, m, -select(sounds, lag, 0.0))


@kernel
def decide(tables, state, t, count, c, d):
    """Amplitude and phase loops of coordinates c and d side by side."""
    loop, scratch, law, floor = state.loop, state.scratch, tables.numbers.law, tables.numbers.floor
    at, to = c * LOOP_ROWS + AMPLITUDE1, d * LOOP_ROWS + AMPLITUDE1
    a1, a2, p1, p2 = lanes(loop, t, at), lanes(loop, t, at + 1), lanes(loop, t, at + 2), lanes(loop, t, at + 3)
    e1, e2, q1, q2 = lanes(loop, t, to), lanes(loop, t, to + 1), lanes(loop, t, to + 2), lanes(loop, t, to + 3)
    for m in range(count):
        amount, theta = lanes(scratch, FIRST + 2 * c, m), lanes(scratch, FIRST + 2 * c + 1, m)
        other, turned = lanes(scratch, FIRST + 2 * d, m), lanes(scratch, FIRST + 2 * d + 1, m)
        amount, a1, a2 = clamped_step(law, a1, a2, amount, floor)
        theta, p1, p2 = section_step(law, p1, p2, theta)
        other, e1, e2 = clamped_step(law, e1, e2, other, floor)
        turned, q1, q2 = section_step(law, q1, q2, turned)
        put(scratch, FIRST + 2 * c, m, amount)
        put(scratch, FIRST + 2 * c + 1, m, theta)
        put(scratch, FIRST + 2 * d, m, other)
        put(scratch, FIRST + 2 * d + 1, m, turned)
    for r, value in enumerate((a1, a2, p1, p2)):
        put(loop, t, at + r, value)
    for r, value in enumerate((e1, e2, q1, q2)):
        put(loop, t, to + r, value)


@kernel
def say(state, t, count, c):
    """Add the drive of a tile's bands to the sum of coordinate c."""
    band, scratch, gain = state.band, state.scratch, lanes(state.loop, t, c * LOOP_ROWS + DRIVE)
    h_re, h_im = gain * lanes(band, t, HEADING_RE), gain * lanes(band, t, HEADING_IM)
    for m in range(count):
        cos, sin = lanes(scratch, CARRIER_COS, m), lanes(scratch, CARRIER_SIN, m)
        u, v = unit((1.0 / TURN) * lanes(scratch, FIRST + 2 * c + 1, m))
        carried = (h_re * u - h_im * v) * cos - (h_re * v + h_im * u) * sin
        put(state.sum, c, m, lanes(state.sum, c, m) + lanes(scratch, FIRST + 2 * c, m) * carried)


@kernel
def tile_block(tables, state, t, count, n, target):
    """`count` samples of a tile, from row n of `target` on, in passes."""
    band, coordinates = state.band, tables.listen.shape[0]
    re, im = lanes(band, t, TARGET_RE), lanes(band, t, FORWARD) * lanes(band, t, TARGET_IM)
    for m in range(count if target.shape[0] > 1 else 1):
        put_pairs(target[n + m if target.shape[0] > 1 else 0], t, re, im)
    for c in range(0, coordinates, 2):
        hear(tables, state, t, count, c, min(c + 1, coordinates - 1))
    for c in range(coordinates):
        compare(state, t, count, c)
    for c in range(0, coordinates, 2):
        decide(tables, state, t, count, c, min(c + 1, coordinates - 1))
    for c in range(coordinates):
        say(state, t, count, c)


@kernel
def usual(tables, state, count):
    """Whether the passes can do a block: two coordinates at most, constant targets, and every sensor believed."""
    numbers = tables.numbers
    fit = numbers.feedback and not numbers.analysed and not numbers.subtract and state.window.shape[0] == 0
    for m in range(count):
        fit = fit and state.shared[TRUST, m] == 1.0
    return fit and tables.listen.shape[0] <= 2


@kernel
def polar_run(tables, state, sensed, position, wanted, drive, target, flags):
    """Samples one after another, tile by tile between two looks at the tones.

    `target` has a row a sample, or a single one, which is that of the last.
    """
    n = 0
    while n < sensed.shape[0]:
        if state.sample[0] % REFRESH == 0:
            refresh(tables, state)
        count = min(REFRESH - state.sample[0] % REFRESH, sensed.shape[0] - n)
        for m in range(count):
            flags[n + m] = share(tables, state, m, sensed[n + m], position[n + m], wanted[n + m])
            silence(state, m)
        passes = usual(tables, state, count)
        for t in range(state.band.shape[0]):
            if passes and state.locked[t] == 0:
                tile_block(tables, state, t, count, n, target)
            else:
                for m in range(count):
                    tile_step(tables, state, t, m, target[n + m if target.shape[0] > 1 else 0])
        state.sample[0] += count
        for m in range(count):
            flags[n + m] |= speak(tables, state, m, drive[n + m])
        n += count
