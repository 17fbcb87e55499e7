"""A sample of the paper's controller by itself, as a loop that is closed sample by sample needs it.

What is usual (see `usual`) is done in as few instructions as the passes of a block need: a processor looks ahead by
some hundreds of them only, and what a sample waits for is then hidden behind the next one and the device.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, high, low, select, size, totals
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs, read, write
from hapticrender.compiled.polynomials import cosine, polar
from hapticrender.control.kernels import TURN
from hapticrender.control.polar.kernels import (
    AMOUNT,
    AMPLITUDE1,
    BEHIND,
    COS,
    FORWARD,
    FOUND,
    FOUR_SOUNDS,
    FREQUENCY,
    LIVE,
    LOOP_ROWS,
    RE1,
    REFRESH,
    SHARED_ROWS,
    SIN,
    SOUNDS,
    START,
    TARGET_IM,
    TARGET_RE,
    THETA1,
    TRUST,
    TURN_COS,
    TURN_SIN,
    VOICE,
    X_IM,
    X_RE,
    believed,
    clamped_step,
    in_frames,
    law_step,
    recall,
    refresh,
    remember,
    share,
    tile_step,
)


@kernel
def hearing(tables, shared, m, sensed):
    """What the coordinates hear; a sensor beyond its limit counts as zero.  Returns 0, or 2 where one is.

    Two sensors are the usual case, and a loop over them costs more than what it does.
    """
    listen, limit, last = tables.listen, tables.numbers.sensed_limit, sensed.shape[0] - 1
    first, second = read(sensed, 0), read(sensed, last)
    fits = (size(first) <= limit) & (size(second) <= limit)  # NaN does not
    first, second = believed(first, limit), select(last > 0, believed(second, limit), 0.0)
    for s in range(1, last):
        fits = fits & (size(read(sensed, s)) <= limit)
    for c in range(listen.shape[0]):
        y = read(listen, c, 0) * first + read(listen, c, last) * second
        for s in range(1, last):
            y += read(listen, c, s) * believed(read(sensed, s), limit)
        write(y, shared, SHARED_ROWS + c, m)
    return select(fits, 0.0, 2.0)


@kernel
def usual(tables, state):
    """Whether the short ways can do it where sensors are believed: two coordinates at most, constant targets."""
    return in_frames(tables.numbers, state) and tables.listen.shape[0] <= 2


@kernel
def carry_on(state, t, number):
    """Fixed carriers of a tile, `number` samples after they were set."""
    band = state.band
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    if number > 0:
        turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
        cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
        put(band, t, COS, cos)
        put(band, t, SIN, sin)
    return cos, sin


@kernel
def heard(numbers, loop, t, base, gain, cos, sin):
    """Imaginary and real part of X of a tile, counted from what is wanted: `listen` to a coordinate.

    `gain` is 2 b0 times what it hears.  X has a minus in its sine, which is taken away rather than turned round: of one
    number less to repeat in every lane.
    """
    section, at, four = numbers.filter, base + RE1, 4.0 * gain
    s1, s2, c1, c2 = lanes(loop, t, at), lanes(loop, t, at + 1), lanes(loop, t, at + 2), lanes(loop, t, at + 3)
    re, slow = gain * cos + s1, four * cos + s2
    put(loop, t, at, s1 + slow - (2.0 + section[3]) * re)
    put(loop, t, at + 1, slow - (1.0 + section[3] + section[4]) * re)
    im, slow = c1 - gain * sin, c2 - four * sin
    put(loop, t, at + 2, c1 + slow - (2.0 + section[3]) * im)
    put(loop, t, at + 3, slow - (1.0 + section[3] + section[4]) * im)
    put(loop, t, base + X_RE, re)
    put(loop, t, base + X_IM, im)
    return im, re


@kernel
def compare(loop, t, base):
    """Amplitude and phase of X of a tile, which is counted from what is wanted (eq. 5)."""
    found, lag = polar(lanes(loop, t, base + X_IM), lanes(loop, t, base + X_RE))
    put(loop, t, base + FOUND, found)
    put(loop, t, base + BEHIND, lag)


@kernel
def answered(numbers, band, loop, t, base, found, lag, wish):
    """Drive of a tile in a coordinate: `answer` to an amplitude and a phase."""
    law, at, to = numbers.law, base + AMPLITUDE1, base + THETA1
    error, sounds, four = lanes(band, t, AMOUNT) - found, lanes(band, t, SOUNDS), lanes(band, t, FOUR_SOUNDS)
    amount, s1, s2 = clamped_step(law, lanes(loop, t, at), lanes(loop, t, at + 1), error, numbers.floor)
    put(loop, t, at, s1)
    put(loop, t, at + 1, s2)
    theta, s1, s2 = law_step(law, lanes(loop, t, to), lanes(loop, t, to + 1), sounds, four, lag)
    put(loop, t, to, s1)
    put(loop, t, to + 1, s2)
    return lanes(loop, t, base + VOICE) * amount * cosine(wish - (law[0] / TURN) * theta)


@kernel
def tiles_step(tables, state, target):
    """Drive of one or two coordinates where all is usual and no carrier follows the finger.

    In three passes: of short ones a processor works on several tiles at once.
    """
    numbers, band, loop, last = tables.numbers, state.band, state.loop, tables.listen.shape[0] - 1
    number, twice = state.sample[0] % REFRESH, 2.0 * numbers.filter[0]
    gain, other_gain = twice * read(state.shared, SHARED_ROWS, 0), twice * read(state.shared, SHARED_ROWS + last, 0)
    for t in range(band.shape[0]):
        put_pairs(target, t, lanes(band, t, TARGET_RE), lanes(band, t, FORWARD) * lanes(band, t, TARGET_IM))
        cos, sin = carry_on(state, t, number)
        heard(numbers, loop, t, 0, gain, cos, sin)
        if last > 0:
            heard(numbers, loop, t, LOOP_ROWS, other_gain, cos, sin)
    for t in range(band.shape[0]):
        compare(loop, t, 0)
        if last > 0:
            compare(loop, t, LOOP_ROWS)
    one = other = 0.0 * lanes(band, 0, LIVE)
    elapsed = number / numbers.rate
    for t in range(band.shape[0]):
        wish = lanes(band, t, START) + elapsed * lanes(band, t, FREQUENCY)
        one += answered(numbers, band, loop, t, 0, lanes(loop, t, FOUND), lanes(loop, t, BEHIND), wish)
        if last > 0:
            found, lag = lanes(loop, t, LOOP_ROWS + FOUND), lanes(loop, t, LOOP_ROWS + BEHIND)
            other += answered(numbers, band, loop, t, LOOP_ROWS, found, lag, wish)
    return totals(read(state.shared, TRUST, 0), one, other)


@kernel
def gather(tables, state, m):
    """Sum the drive of each coordinate over the lanes, as far as it is trusted, and clear the sums for the next.

    Returns that of the first two.
    """
    shared, coordinates = state.shared, state.sum.shape[0]
    for c in range(0, coordinates, 2):
        d = min(c + 1, coordinates - 1)
        trust = read(shared, TRUST, m)
        one, other = totals(trust, lanes(state.sum, c, m), lanes(state.sum, d, m))
        write(trust * one, shared, SHARED_ROWS + c, m)
        write(trust * other, shared, SHARED_ROWS + d, m)
        put(state.sum, c, m, 0.0 * lanes(state.band, 0, LIVE))
        put(state.sum, d, m, 0.0 * lanes(state.band, 0, LIVE))
    return read(shared, SHARED_ROWS, m), read(shared, SHARED_ROWS + min(coordinates - 1, 1), m)


@kernel
def speak(tables, state, m, one, other, drive):
    """Drive of the channels from that of the coordinates, each cut to its limit.  Returns flags, as a float."""
    limit, flags, coordinates = tables.numbers.drive_limit, 0.0 * one, tables.listen.shape[0]
    for i in range(tables.speak.shape[0]):
        asked = tables.speak[i, 0] * one
        if coordinates > 1:
            asked += tables.speak[i, 1] * other
        for c in range(2, coordinates):
            asked += tables.speak[i, c] * read(state.shared, SHARED_ROWS + c, m)
        cut = low(high(asked, -limit), limit)
        write(cut, drive, i)
        flags = select(cut == asked, flags, 1.0)
    return flags


@kernel
def polar_advance(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags as a float."""
    if state.sample[0] % REFRESH == 0:
        refresh(tables, state)
    odd = hearing(tables, state.shared, 0, sensed)
    flags, known = share(tables, state, 0, odd, position, wanted, recall(state))
    remember(state, known)
    plain = usual(tables, state) and not any_of(read(state.shared, TRUST, 0) < 1.0)
    for t in range(state.band.shape[0]):
        plain = plain and state.locked[t] == 0
    if plain:
        one, other = tiles_step(tables, state, target)
    else:
        for t in range(state.band.shape[0]):
            tile_step(tables, state, t, 0, target)
        one, other = gather(tables, state, 0)
    state.sample[0] += 1
    return flags + speak(tables, state, 0, one, other, drive)


@kernel
def polar_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of a single scenario; see `polar_advance`.  Returns flags."""
    return np.int64(polar_advance(tables, state, sensed, position, wanted, drive, target))
