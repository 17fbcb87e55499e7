"""Sums over the bands and over the samples of a block, and the exact solve between residuals.

Samples are taken in groups of sixteen about the group's middle, where a carrier's cosine is even and its sine odd:
what a pair of samples has in common and what it differs by cost half of what the samples would.  An envelope is turned
from group to group.  Carriers that follow the finger have tables over the whole block instead.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes_memory import lanes, put, put_stretch, read, row_totals, stretch
from hapticrender.control.bank import rows as row
from hapticrender.control.blocks.state import (
    CHANNEL_ROWS,
    EIGHT,
    FROM_RE,
    GROUP,
    PAIR_COS,
    PAIR_ROWS,
    PAIR_SIN,
    PAIRS,
    TURN_COS,
    TURN_SIN,
)


@kernel
def turned(cos, sin, re, im):
    """An envelope turned ahead."""
    return re * cos - im * sin, re * sin + im * cos


@kernel
def turn_held(band, held, t, r, re, im):
    """Envelope of a tile as this block's tables want it, into rows r and r + 1."""
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    put(held, t, r, re * cos - im * sin)
    put(held, t, r + 1, re * sin + im * cos)


@kernel
def clear(state):
    """Begin the sums over the bands."""
    nothing = 0.0 * lanes(state.table, 0, 0)
    for m in range(state.lane_sum.shape[0]):
        for s in range(2):
            put(state.lane_sum, m, s, nothing)


@kernel
def add(lane_sum, s, m, value):
    """Add to a sum."""
    put(lane_sum, m, s, lanes(lane_sum, m, s) + value)


@kernel
def unfold(state):
    """Sums over the lanes, sample by sample."""
    out, lane_sum = state.sum, state.lane_sum
    for m in range(0, out.shape[0], lane_sum.shape[2] // 2):
        put_stretch(out, m, 0, row_totals(lane_sum, m, 0))
    for q in range(0, out.shape[0], GROUP):
        for i in range(PAIRS):
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            for s in range(2):
                even, odd = out[early, s], out[late, s]
                out[early, s], out[late, s] = even - odd, even + odd


@kernel
def add_following(state, t, s, re, im, step_re, step_im):
    """Add a tile that follows the finger to sum s: Re (x + (m + 1) step) e^(j phase of m)."""
    table, sums = state.table, state.lane_sum
    for q in range(0, state.place.shape[0], GROUP):
        for i in range(PAIRS):
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            cos, sin = lanes(table, t, 2 * early), lanes(table, t, 2 * early + 1)
            u, v = lanes(table, t, 2 * late), lanes(table, t, 2 * late + 1)
            before = (re + (early + 1.0) * step_re) * cos - (im + (early + 1.0) * step_im) * sin
            after = (re + (late + 1.0) * step_re) * u - (im + (late + 1.0) * step_im) * v
            add(sums, s, early, 0.5 * (after + before))
            add(sums, s, late, 0.5 * (after - before))


@kernel
def staying(state, t, r, s):
    """A tile, and what it holds in rows r, r + 1, s and s + 1: nothing where it follows the finger, or is none."""
    held, last = state.held, state.held.shape[0] - 1
    at = min(t, last)
    counts = 1.0 if t <= last and state.bank.pace[at] != row.LOCKED else 0.0
    re, im, up, on = lanes(held, at, r), lanes(held, at, r + 1), lanes(held, at, s), lanes(held, at, s + 1)
    return at, counts * re, counts * im, counts * up, counts * on


@kernel
def sum_bands(state, r, s):
    """Two sums over the bands at every sample: of Re x e^(j w m), x in rows r, r + 1 and in rows s, s + 1 of `held`.

    Tiles go in pairs: what limits this is how often a sum is written.
    """
    table, held, sums = state.table, state.held, state.lane_sum
    clear(state)
    for t in range(table.shape[0]):
        if state.bank.pace[t] == row.LOCKED:
            nothing = 0.0 * lanes(held, t, r)
            add_following(state, t, 0, lanes(held, t, r), lanes(held, t, r + 1), nothing, nothing)
            add_following(state, t, 1, lanes(held, t, s), lanes(held, t, s + 1), nothing, nothing)
    for pair in range(0, table.shape[0], 2):
        t, re, im, at, up = staying(state, pair, r, s)
        n, re2, im2, at2, up2 = staying(state, pair + 1, r, s)
        (turn, on), (turn2, on2) = both(table, t, TURN_COS), both(table, n, TURN_COS)
        for q in range(0, sums.shape[0], GROUP):
            for i in range(PAIRS):
                cos, sin = both(table, t, PAIR_ROWS * i + PAIR_COS)
                cos2, sin2 = both(table, n, PAIR_ROWS * i + PAIR_COS)
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                put(sums, early, 0, lanes(sums, early, 0) + re * cos + re2 * cos2)
                put(sums, late, 0, lanes(sums, late, 0) - im * sin - im2 * sin2)
                put(sums, early, 1, lanes(sums, early, 1) + at * cos + at2 * cos2)
                put(sums, late, 1, lanes(sums, late, 1) - up * sin - up2 * sin2)
            re, im = turned(turn, on, re, im)
            at, up = turned(turn, on, at, up)
            re2, im2 = turned(turn2, on2, re2, im2)
            at2, up2 = turned(turn2, on2, at2, up2)
    unfold(state)


@kernel
def both(array, t, r):
    """Rows r and r + 1 of a tile."""
    return lanes(array, t, r), lanes(array, t, r + 1)


@kernel
def sum_drives(state, at):
    """Sums over the bands of two channels' drives at every sample, linear from the last block's envelope to this one's.

    The first channel's rows start at `at`.
    """
    table, held, sums, share = state.table, state.held, state.lane_sum, 1.0 / state.place.shape[0]
    first, second = at + FROM_RE, at + CHANNEL_ROWS + FROM_RE
    clear(state)
    for t in range(table.shape[0]):
        re, im, step_re, step_im = four(held, t, first)
        up_re, up_im, rise_re, rise_im = four(held, t, second)
        if state.bank.pace[t] == row.LOCKED:
            add_following(state, t, 0, re, im, share * step_re, share * step_im)
            add_following(state, t, 1, up_re, up_im, share * rise_re, share * rise_im)
            continue
        turn, on, ahead = lanes(table, t, TURN_COS), lanes(table, t, TURN_SIN), share * (PAIRS + 0.5)
        for q in range(0, sums.shape[0], GROUP):
            re, im = re + ahead * step_re, im + ahead * step_im
            up_re, up_im = up_re + ahead * rise_re, up_im + ahead * rise_im
            for i in range(PAIRS):
                cos, sin, far_cos, far_sin = four(table, t, PAIR_ROWS * i)
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                put(sums, early, 0, lanes(sums, early, 0) + re * cos - step_im * far_sin)
                put(sums, late, 0, lanes(sums, late, 0) + step_re * far_cos - im * sin)
                put(sums, early, 1, lanes(sums, early, 1) + up_re * cos - rise_im * far_sin)
                put(sums, late, 1, lanes(sums, late, 1) + rise_re * far_cos - up_im * sin)
            re, im = turned(turn, on, re, im)
            step_re, step_im = turned(turn, on, step_re, step_im)
            up_re, up_im = turned(turn, on, up_re, up_im)
            rise_re, rise_im = turned(turn, on, rise_re, rise_im)
            ahead = share * GROUP
    unfold(state)


@kernel
def four(array, t, r):
    """Rows r to r + 3 of a tile."""
    return lanes(array, t, r), lanes(array, t, r + 1), lanes(array, t, r + 2), lanes(array, t, r + 3)


@kernel
def solve(state, which, c):
    """Residuals e = Q e_h of row c, and the same in the precision of the bands.

    `inverse` has as many zeros in front as a block has samples, so that what lies in the future adds nothing.
    """
    inverse, raw, whole = state.inverse, state.raw, state.raw.shape[1]
    for m in range(0, whole, EIGHT):
        first = second = third = fourth = 0.0 * stretch(inverse, which, 0)
        at = whole + m
        for j in range(0, m + EIGHT, 4):
            first += raw[c, j] * stretch(inverse, which, at - j)
            second += raw[c, j + 1] * stretch(inverse, which, at - j - 1)
            third += raw[c, j + 2] * stretch(inverse, which, at - j - 2)
            fourth += raw[c, j + 3] * stretch(inverse, which, at - j - 3)
        put_stretch(state.error, c, m, (first + second) + (third + fourth))
    for m in range(state.place.shape[0], whole):  # none is heard after the block's end
        state.error[c, m] = 0.0
    for q in range(0, whole, GROUP):
        for i in range(PAIRS):
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            state.heard[c, early] = state.error[c, late] + state.error[c, early]
            state.heard[c, late] = state.error[c, late] - state.error[c, early]


@kernel
def correlate(state, t, c, d):
    """Sums over the block of rows c and d of `heard` with the carriers of a tile, e^(-j w m)."""
    table, heard = state.table, state.heard
    re = im = at = up = 0.0 * lanes(table, t, 0)
    if state.bank.pace[t] == row.LOCKED:
        for q in range(0, state.place.shape[0], GROUP):
            for i in range(PAIRS):
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                cos, sin = lanes(table, t, 2 * early), lanes(table, t, 2 * early + 1)
                u, v = lanes(table, t, 2 * late), lanes(table, t, 2 * late + 1)
                even, odd = 0.5 * read(heard, c, early), 0.5 * read(heard, c, late)
                re, im = re + even * (u + cos) + odd * (u - cos), im - even * (v + sin) - odd * (v - sin)
                even, odd = 0.5 * read(heard, d, early), 0.5 * read(heard, d, late)
                at, up = at + even * (u + cos) + odd * (u - cos), up - even * (v + sin) - odd * (v - sin)
        return re, im, at, up
    turn, back = lanes(table, t, TURN_COS), -lanes(table, t, TURN_SIN)
    for q in range(heard.shape[1] - GROUP, -1, -GROUP):
        even = odd = even2 = odd2 = 0.0 * turn
        for i in range(PAIRS):  # of this group alone: no sum waits for that of another
            cos, sin = lanes(table, t, PAIR_ROWS * i + PAIR_COS), lanes(table, t, PAIR_ROWS * i + PAIR_SIN)
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            even, odd = even + read(heard, c, early) * cos, odd + read(heard, c, late) * sin
            even2, odd2 = even2 + read(heard, d, early) * cos, odd2 + read(heard, d, late) * sin
        re, im = turned(turn, back, re, im)
        at, up = turned(turn, back, at, up)
        re, im, at, up = re + even, im - odd, at + even2, up - odd2
    return re, im, at, up


@kernel
def respond(tables, state, g):
    """What a residual adds to the ones after it in the carriers; then the inverse of that, and of the wanted one."""
    band, held = state.bank.band, state.held
    for t in range(band.shape[0]):
        share, at = lanes(band, t, row.SHARE), PAIR_ROWS * (PAIRS - 1)
        if state.bank.pace[t] == row.LOCKED:
            put(held, t, 0, share * lanes(state.table, t, 0))
            put(held, t, 1, -share * lanes(state.table, t, 1))
        else:
            put(held, t, 0, share * lanes(state.table, t, at + PAIR_COS))
            put(held, t, 1, share * lanes(state.table, t, at + PAIR_SIN))
    sum_bands(state, 0, 0)
    for d in range(state.response.shape[0]):
        state.response[d] = state.sum[d, 0]
    invert(state.response, g, tables.sample.dc, tables.sample.dc_drift, state.inverse, 0)
    invert(state.response, tables.sample.reference, 0.0, 0.0, state.inverse, 1)


@kernel
def invert(response, g, dc, drift, inverse, which):
    """First column of the inverse of 1 + L, L[m, j] = r[m - j], behind as many zeros."""
    block = response.shape[0]
    for m in range(block):
        inverse[which, block + m] = 1.0 if m == 0 else 0.0
    for j in range(block):
        value = inverse[which, block + j]
        for m in range(j + 1, block):
            inverse[which, block + m] -= (dc + (m - j - 1) * drift + g * response[m - j]) * value
