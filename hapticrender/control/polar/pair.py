"""Two samples of the paper's controller in a row, for a loop whose device leaves a sample's time to answer.

What the plate shows at sample n + 1 it owes to the drive of sample n - 1, at the latest: both samples are sensed before
either drive is worked out.  A sample is a chain of instructions each of which waits for the one before it, a few
hundred cycles long; those of two samples and two sides go on side by side.  It is the arithmetic of
`control.polar.steps.polar_step`, twice.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import select, size, totals
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs
from hapticrender.compiled.polynomials import polar
from hapticrender.control.polar.kernels import (
    COS,
    FORWARD,
    FREQUENCY,
    LIVE,
    LOOP_ROWS,
    REFRESH,
    SIN,
    START,
    TARGET_IM,
    TARGET_RE,
    TURN_COS,
    TURN_SIN,
    in_frames,
    recall,
    refresh,
    remember,
    share,
    tile_step,
)
from hapticrender.control.polar.steps import answered, gather, heard, hearing, speak


@kernel
def in_pairs(tables, state):
    """Whether samples may be taken in pairs: the controller has two sides, and can be in its usual way."""
    return tables.listen.shape[0] == 2 and in_frames(tables.numbers, state)


@kernel
def carriers(state, t, number, rate):
    """Carriers of a tile and phases of what is wanted (turns), `number` samples after they were set and one later."""
    band = state.band
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
    if number > 0:
        cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
    next_cos, next_sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
    put(band, t, COS, next_cos)
    put(band, t, SIN, next_sin)
    start, frequency = lanes(band, t, START), lanes(band, t, FREQUENCY)
    now, later = start + (number / rate) * frequency, start + ((number + 1) / rate) * frequency
    return (cos, sin, now), (next_cos, next_sin, later)


@kernel
def compared(numbers, loop, t, base, gain, cos, sin):
    """Amplitude and phase of what is `heard` (eq. 5)."""
    im, re = heard(numbers, loop, t, base, gain, cos, sin)
    return polar(im, re)


@kernel
def tiles_pair(tables, state, sensed, n, target):
    """Drives of two sides in samples n and n + 1 where all is usual and no carrier follows the finger."""
    band, loop, numbers, listen = state.band, state.loop, tables.numbers, tables.listen
    one = other = early = late = 0.0 * lanes(band, 0, LIVE)
    twice, other_side = 2.0 * numbers.filter[0], LOOP_ROWS
    g0, g1, h0, h1 = twice * listen[0, 0], twice * listen[0, 1], twice * listen[1, 0], twice * listen[1, 1]
    x0, x1, y0, y1 = sensed[n, 0], sensed[n, 1], sensed[n + 1, 0], sensed[n + 1, 1]
    for t in range(band.shape[0]):
        re, im = lanes(band, t, TARGET_RE), lanes(band, t, FORWARD) * lanes(band, t, TARGET_IM)
        put_pairs(target[n], t, re, im)
        put_pairs(target[n + 1], t, re, im)
        (cos, sin, wish), (next_cos, next_sin, hope) = carriers(state, t, state.sample[0] % REFRESH, numbers.rate)
        a, a_lag = compared(numbers, loop, t, 0, g0 * x0 + g1 * x1, cos, sin)
        b, b_lag = compared(numbers, loop, t, other_side, h0 * x0 + h1 * x1, cos, sin)
        c, c_lag = compared(numbers, loop, t, 0, g0 * y0 + g1 * y1, next_cos, next_sin)
        d, d_lag = compared(numbers, loop, t, other_side, h0 * y0 + h1 * y1, next_cos, next_sin)
        one += answered(numbers, band, loop, t, 0, a, a_lag, wish)
        other += answered(numbers, band, loop, t, other_side, b, b_lag, wish)
        early += answered(numbers, band, loop, t, 0, c, c_lag, hope)
        late += answered(numbers, band, loop, t, other_side, d, d_lag, hope)
    return totals(1.0, one, other), totals(1.0, early, late)


@kernel
def speak_both(tables, sums, drive):
    """`speak` of two sides by two channels."""
    limit, by, (one, other) = tables.numbers.drive_limit, tables.speak, sums
    first, second = by[0, 0] * one + by[0, 1] * other, by[1, 0] * one + by[1, 1] * other
    drive[0], drive[1] = min(max(first, -limit), limit), min(max(second, -limit), limit)
    return 1 if (drive[0] != first) | (drive[1] != second) else 0


@kernel
def polar_pair(tables, state, n, sensed, finger, wanted, drive, last, target, flags):
    """Samples n and n + 1, the first at an even count, of a controller that may be paired (`in_pairs`).

    Fills row n + 1 of `drive` with the drive of sample n, which the plate is handed then, and `last` with that of
    sample n + 1; rows n and n + 1 of `target`; adds to those of `flags`.
    """
    if state.sample[0] % REFRESH == 0:
        refresh(tables, state)
    known, limit, plain = recall(state), tables.numbers.sensed_limit, state.doubt[0] == 0.0
    for m in range(2):
        fits = (size(sensed[n + m, 0]) <= limit) & (size(sensed[n + m, 1]) <= limit)  # NaN does not
        odd, known = share(tables, state, m, select(fits, 0.0, 2.0), finger[n + m, 0], wanted[n + m], known)
        flags[n + m] |= np.int64(odd)
        plain = plain and fits
    remember(state, known)
    for t in range(state.band.shape[0]):
        plain = plain and state.locked[t] == 0
    if plain:
        first, second = tiles_pair(tables, state, sensed, n, target)
        flags[n] |= speak_both(tables, first, drive[n + 1])
        flags[n + 1] |= speak_both(tables, second, last)
    else:
        for m in range(2):
            hearing(tables, state.shared, m, sensed[n + m])
        for t in range(state.band.shape[0]):
            for m in range(2):
                tile_step(tables, state, t, m, target[n + m])
        first, second = gather(tables, state, 0), gather(tables, state, 1)
        flags[n] |= np.int64(speak(tables, state, 0, first[0], first[1], drive[n + 1]))
        flags[n + 1] |= np.int64(speak(tables, state, 1, second[0], second[1], last))
    state.sample[0] += 2
