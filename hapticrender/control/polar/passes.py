"""A block of the paper's controller: in the usual case three short passes over a tile, else sample by sample.

Where carriers and targets stay and sensors are believed, nothing of a sample waits for the one before it but two short
recursions.  In a pass of its own each of them runs beside the other coordinate's, and the rest is free of them, so that
the processor works on many samples at once.  The arithmetic is that of `control.polar.kernels.tile_step`, to rounding.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import WIDTH, any_of, select, size
from hapticrender.compiled.lanes_memory import (
    column,
    lanes,
    put,
    put_column,
    put_pairs,
    put_stretch,
    row_totals,
    stretch,
    taken,
)
from hapticrender.compiled.polynomials import cosine, polar
from hapticrender.control.kernels import TURN
from hapticrender.control.polar.kernels import (
    AMOUNT,
    AMPLITUDE1,
    COS,
    FAR,
    FASTEST,
    FORWARD,
    FOUR_SOUNDS,
    FREQUENCY,
    LIVE,
    LOOP_ROWS,
    OPENING,
    PLACE,
    RE1,
    REFRESH,
    SHARED_ROWS,
    SIN,
    SOUNDS,
    SPEED,
    START,
    TARGET_IM,
    TARGET_RE,
    TRUST,
    TURN_COS,
    TURN_SIN,
    VOICE,
    WANTED,
    X_IM,
    X_RE,
    clamped_step,
    law_step,
    recall,
    refresh,
    remember,
    section_step,
    share,
    smoothed,
    tile_step,
)
from hapticrender.control.polar.steps import usual

EIGHT = WIDTH[np.dtype(float)]  # lanes of double precision
# rows of PolarState.told, one column a sample: whole numbers from 0; then, two a coordinate, b0 of the low pass times
# twice what it hears, and four times that
NUMBER, TOLD = range(2)
TOLD_ROWS = 1  # and two a coordinate
# rows of PolarState.scratch: phase of what is wanted (turns); then, two a coordinate, its envelope, which becomes what
# the loops compare: amplitude and phase
WISH, FIRST = range(2)
SCRATCH_ROWS = 1  # and two a coordinate


@kernel
def tell(tables, state, count):
    """What the passes are told of every sample, in the precision of the bands."""
    like, twice = lanes(state.band, 0, LIVE), 2.0 * tables.numbers.filter[0]
    for c in range(tables.listen.shape[0]):
        for m in range(0, count, state.band.shape[2]):
            gain = twice * taken(state.shared, SHARED_ROWS + c, m, like)
            put_stretch(state.told, TOLD + 2 * c, m, gain)
            put_stretch(state.told, TOLD + 2 * c + 1, m, 4.0 * gain)


@kernel
def hear(tables, state, t, count, c, d):
    """Carriers of a tile, and the STDFT* of coordinates c and d side by side."""
    band, loop, told, scratch, section = state.band, state.loop, state.told, state.scratch, tables.numbers.filter
    cos, sin, start = lanes(band, t, COS), lanes(band, t, SIN), lanes(band, t, START)
    turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
    step, begun = 1.0 / tables.numbers.rate * lanes(band, t, FREQUENCY), state.sample[0] % REFRESH
    at, to = c * LOOP_ROWS + RE1, d * LOOP_ROWS + RE1
    a1, a2, b1, b2 = lanes(loop, t, at), lanes(loop, t, at + 1), lanes(loop, t, at + 2), lanes(loop, t, at + 3)
    e1, e2, f1, f2 = lanes(loop, t, to), lanes(loop, t, to + 1), lanes(loop, t, to + 2), lanes(loop, t, to + 3)
    re = im = x = y = cos
    for m in range(count):
        if begun + m > 0:
            cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
        put(scratch, WISH, m, start + told[NUMBER, begun + m] * step)
        gain, four = told[TOLD + 2 * c, m], told[TOLD + 2 * c + 1, m]
        re, a1, a2 = section_step(section, a1, a2, gain, four, cos)
        im, b1, b2 = section_step(section, b1, b2, -gain, -four, sin)
        gain, four = told[TOLD + 2 * d, m], told[TOLD + 2 * d + 1, m]
        x, e1, e2 = section_step(section, e1, e2, gain, four, cos)
        y, f1, f2 = section_step(section, f1, f2, -gain, -four, sin)
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
def compare(state, t, count, c, d):
    """Amplitude and phase of X in coordinates c and d against what is wanted, from which it is counted (eq. 3, 5)."""
    scratch, amount = state.scratch, lanes(state.band, t, AMOUNT)
    for m in range(count):
        found, lag = polar(lanes(scratch, FIRST + 2 * c + 1, m), lanes(scratch, FIRST + 2 * c, m))
        other, delay = polar(lanes(scratch, FIRST + 2 * d + 1, m), lanes(scratch, FIRST + 2 * d, m))
        put(scratch, FIRST + 2 * c, m, amount - found)
        put(scratch, FIRST + 2 * c + 1, m, lag)
        put(scratch, FIRST + 2 * d, m, amount - other)
        put(scratch, FIRST + 2 * d + 1, m, delay)


@kernel
def decide(tables, state, t, count, c, d):
    """Amplitude and phase loops of coordinates c and d side by side; adds the drive of a tile's bands to their sums.

    A Re e^j(theta + psi + arg R) is one cosine, worked out while the loops wait for themselves.
    """
    loop, scratch, law, floor, sums = state.loop, state.scratch, tables.numbers.law, tables.numbers.floor, state.sum
    at, to = c * LOOP_ROWS + AMPLITUDE1, d * LOOP_ROWS + AMPLITUDE1
    a1, a2, p1, p2 = lanes(loop, t, at), lanes(loop, t, at + 1), lanes(loop, t, at + 2), lanes(loop, t, at + 3)
    e1, e2, q1, q2 = lanes(loop, t, to), lanes(loop, t, to + 1), lanes(loop, t, to + 2), lanes(loop, t, to + 3)
    gain, strength = lanes(loop, t, c * LOOP_ROWS + VOICE), lanes(loop, t, d * LOOP_ROWS + VOICE)
    sounds, four = lanes(state.band, t, SOUNDS), lanes(state.band, t, FOUR_SOUNDS)
    for m in range(count):
        wish, one, two = lanes(scratch, WISH, m), lanes(sums, c, m), lanes(sums, d, m)
        amount, a1, a2 = clamped_step(law, a1, a2, lanes(scratch, FIRST + 2 * c, m), floor)
        other, e1, e2 = clamped_step(law, e1, e2, lanes(scratch, FIRST + 2 * d, m), floor)
        theta, p1, p2 = law_step(law, p1, p2, sounds, four, lanes(scratch, FIRST + 2 * c + 1, m))
        turned, q1, q2 = law_step(law, q1, q2, sounds, four, lanes(scratch, FIRST + 2 * d + 1, m))
        put(sums, c, m, one + gain * amount * cosine(wish - (law[0] / TURN) * theta))
        put(sums, d, m, two + strength * other * cosine(wish - (law[0] / TURN) * turned))
    for r, value in enumerate((a1, a2, p1, p2)):
        put(loop, t, at + r, value)
    for r, value in enumerate((e1, e2, q1, q2)):
        put(loop, t, to + r, value)


@kernel
def tile_block(tables, state, t, count, target):
    """`count` samples of a tile in passes; `target` has a row for each of them, one or none."""
    band, coordinates = state.band, tables.listen.shape[0]
    re, im = lanes(band, t, TARGET_RE), lanes(band, t, FORWARD) * lanes(band, t, TARGET_IM)
    for m in range(target.shape[0]):
        put_pairs(target[m], t, re, im)
    for c in range(0, coordinates, 2):
        d = min(c + 1, coordinates - 1)
        hear(tables, state, t, count, c, d)
        compare(state, t, count, c, d)
        decide(tables, state, t, count, c, d)


@kernel
def sense_all(tables, state, sensed):
    """What the coordinates hear in every sample, and how many sensors are beyond their limit (NaN is), as `TRUST`."""
    listen, limit, shared = tables.listen, tables.numbers.sensed_limit, state.shared
    nothing = 0.0 * stretch(shared, TRUST, 0)
    for m in range(0, sensed.shape[0], EIGHT):
        lost = nothing
        for c in range(listen.shape[0]):
            put_stretch(shared, SHARED_ROWS + c, m, nothing)
        for s in range(sensed.shape[1]):
            value = column(sensed, m, s)
            fits = size(value) <= limit
            lost, heard = lost + select(fits, 0.0, 1.0), select(fits, value, 0.0)
            for c in range(listen.shape[0]):
                put_stretch(shared, SHARED_ROWS + c, m, stretch(shared, SHARED_ROWS + c, m) + listen[c, s] * heard)
        put_stretch(shared, TRUST, m, lost)


@kernel
def steady(tables, state, position, wanted):
    """Whether a finger that was there stays all through a block, and all sensors and targets can be believed.

    One that has just been lifted has left the gate ajar.
    """
    held, _, gate, _, doubt = recall(state)
    good, rate = (gate >= 1.0) & (doubt <= 0.0), tables.numbers.rate
    for m in range(position.shape[0]):
        there, sane = size(position[m]) <= FAR, size(wanted[m]) <= FAR
        good = good & there & sane & (size(position[m] - held) * rate <= FASTEST) & (state.shared[TRUST, m] <= 0.0)
        held = position[m]
    return good


@kernel
def share_steady(tables, state, position, wanted, flags):
    """What `share` writes down, sample after sample, of a finger that stays."""
    shared, rate = state.shared, tables.numbers.rate
    held, velocity, gate, seen, doubt = recall(state)
    for m in range(position.shape[0]):
        velocity = smoothed(rate, velocity, (position[m] - held) * rate)
        held = position[m]
        shared[WANTED, m], shared[TRUST, m], shared[OPENING, m] = wanted[m], 1.0, 1.0
        shared[PLACE, m], shared[SPEED, m], flags[m] = held, velocity, 0
    remember(state, (held, velocity, gate, seen, doubt))


@kernel
def share_all(tables, state, sensed, position, wanted, flags):
    """Write down what all tiles are told of every sample.  Returns whether sensors are believed all the time."""
    sense_all(tables, state, sensed)
    if steady(tables, state, position, wanted):
        share_steady(tables, state, position, wanted, flags)
        return True
    known, trusted = recall(state), True
    for m in range(sensed.shape[0]):
        odd = 2.0 if state.shared[TRUST, m] > 0.0 else 0.0
        odd, known = share(tables, state, m, odd, position[m], wanted[m], known)
        flags[m] = np.int64(odd)
        trusted = trusted and known[-1] <= 0.0
    remember(state, known)
    return trusted


@kernel
def gather_all(state, count):
    """Sum the drive of each coordinate over the lanes, as far as it is trusted, and clear the sums for the next."""
    sums, shared, nothing = state.sum, state.shared, 0.0 * lanes(state.band, 0, LIVE)
    for c in range(sums.shape[0]):
        for m in range(0, count, sums.shape[2]):
            put_stretch(shared, SHARED_ROWS + c, m, taken(shared, TRUST, m, nothing) * row_totals(sums, c, m))
        for m in range(count):
            put(sums, c, m, nothing)


@kernel
def speak_all(tables, state, drive, flags):
    """Drive of the channels from that of the coordinates, each cut to its limit."""
    shared, limit, count = state.shared, tables.numbers.drive_limit, drive.shape[0]
    for i in range(drive.shape[1]):
        for m in range(0, count, EIGHT):
            asked = tables.speak[i, 0] * stretch(shared, SHARED_ROWS, m)
            for c in range(1, tables.listen.shape[0]):
                asked += tables.speak[i, c] * stretch(shared, SHARED_ROWS + c, m)
            put_column(drive, m, i, asked)
            if any_of(select(size(asked) <= limit, 0.0, 1.0) > 0.0):
                for k in range(m, min(m + EIGHT, count)):
                    cut = min(max(drive[k, i], -limit), limit)
                    flags[k] |= 1 if cut != drive[k, i] else 0
                    drive[k, i] = cut


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
        now = slice(n, n + count)
        aims = target[now] if target.shape[0] > 1 else target[0 if n + count == sensed.shape[0] else 1 :]
        passes = share_all(tables, state, sensed[now], position[now], wanted[now], flags[now]) and usual(tables, state)
        if passes:
            tell(tables, state, count)
        for t in range(state.band.shape[0]):
            if passes and state.locked[t] == 0:
                tile_block(tables, state, t, count, aims)
            else:
                for m in range(count):
                    tile_step(tables, state, t, m, target[n + m if target.shape[0] > 1 else 0])
        state.sample[0] += count
        gather_all(state, count)
        speak_all(tables, state, drive[now], flags[now])
        n += count
