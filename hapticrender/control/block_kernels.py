"""Compiled block of the band bank, for devices that take blocks of M samples: the per-sample observer, M at a time.

Over a block the envelopes are held; the residuals e_h that follow from them and those of the per-sample observer are
related by a unit lower-triangular Toeplitz matrix, e = Q e_h, whatever the number of bands (FACTS section 10):

    e[m] + sum_(j<m) r[m-j] e[j] = e_h[m],  r[d] = g_dc + (d - 1) g_drift + sum_k g_k cos(w_k d)

Then every envelope is updated once, the law is taken at the block's end for the moment its drive will act, and the
drive runs linearly from one block's envelope to the next.  Samples are taken in groups of eight about the group's
middle, where a carrier's cosine is even and its sine odd: what a pair of samples has in common and what it differs by
cost half of what the samples would.  An envelope is turned from group to group, and its phase at the block's start is
counted in double precision.  Carriers that follow the finger have tables over the whole block, made anew.  Everything
that knows of finger, touch and trust is the per-sample bank's own, called once a block.
"""

from __future__ import annotations

from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender._lanes import (
    any_of,
    floor,
    high,
    lanes,
    put,
    put_pairs,
    put_stretch,
    root,
    size,
    stretch,
    totals,
)
from hapticrender._polynomials import unit, whole
from hapticrender.control import bank_rows as row
from hapticrender.control.bank_finger import adapt_pass, feel, forget_finger, track_finger
from hapticrender.control.bank_kernels import FORGET, believe, grow_pass, law_tune, look_ahead, motion_pass, wake
from hapticrender.control.bank_state import BankNumbers, BankState, BankTables
from hapticrender.control.kernels import FAR, TURN
from hapticrender.protocols import Array

EIGHT = 8  # samples of a group, and lanes of double precision: phases are always double
PAIRS = 4  # of samples in a group, at +-0.5, 1.5, 2.5 and 3.5 samples about its middle
# rows of BlockState.table where a tile's carriers stay: PAIR_ROWS a pair, then the turn from group to group
PAIR_COS, PAIR_SIN, FAR_COS, FAR_SIN = range(4)  # at the pair's later sample; the same times its distance over M
PAIR_ROWS = 4
TURN_COS, TURN_SIN = PAIRS * PAIR_ROWS, PAIRS * PAIR_ROWS + 1
NEAR_LIMIT = 0.5  # share of the drive's limit, from which on its envelope is watched and not its samples alone
# rows of BlockState.phase: turns of the fixed part of each carrier at the block's start, its cosine and sine where the
# tables begin, turns a block, and turns from the block's start to there: the middle of the first group, if it stays
TURNS, COSINE, SINE, TURNED, TO_MIDDLE = range(5)
PHASE_ROWS = 5
# rows of BlockState.held, CHANNEL_ROWS a channel after two for each coordinate: the drive's envelope at the end of the
# last block and of this one, and both as this block's tables want them
LAST_RE, LAST_IM, NOW_RE, NOW_IM, FROM_RE, FROM_IM, STEP_RE, STEP_IM = range(8)
CHANNEL_ROWS = 8


class BlockTables(NamedTuple):
    """Parameters of the bank in blocks."""

    bank: BankTables  # its rates are those of a block
    sample: BankNumbers  # the same of a sample


class BlockState(NamedTuple):
    """State of the bank in blocks; changed in place.  M is the block, rounded up to a multiple of eight in scratch."""

    bank: BankState
    phase: Array  # (tiles of 8, PHASE_ROWS, 8) float64
    table: (
        Array  # (tiles, max(2 M, TURN_SIN + 1), W): see PAIR_COS; where a tile follows, cosine and sine at each sample
    )
    held: Array  # (tiles, 2 coordinates + CHANNEL_ROWS channels, W)
    response: Array  # (M,) r: what a residual of 1 adds to the ones after it
    inverse: Array  # (2, 2 M) first column of Q, and of its like for the wanted waveform, behind M zeros
    error: Array  # (coordinates + 1, M) scratch: residuals; the last row that of the wanted waveform
    heard: Array  # the same in the precision of the bands, folded: sums of a group's pairs, then differences
    raw: Array  # (coordinates + 1, M) scratch: residuals as the held envelopes would leave them
    place: Array  # (M,) scratch: position of the finger
    sum: Array  # (2, M) scratch: sums over the bands
    lane_sum: Array  # (2, M, W) scratch: the same a lane, and folded
    stale: Array  # (1,) integer: 1 where tables and `response` have to be found anew
    news: Array  # (1,) integer: 1 where all tones are to be looked at; otherwise it is one tile a block
    gain: Array  # (1,) gain of the observer that `inverse` holds for


@kernel
def count_phases(tables, state):
    """Phasors of the carriers where their tables begin; then their phases at the next block's start."""
    bank, phase = state.bank, state.phase
    for i in range(phase.shape[0]):
        turns = lanes(phase, i, TURNS)
        cos, sin = unit(turns + lanes(phase, i, TO_MIDDLE))
        put(phase, i, COSINE, cos)
        put(phase, i, SINE, sin)
        turns += lanes(phase, i, TURNED)
        put(phase, i, TURNS, turns - floor(turns))
    band, parts = bank.band, bank.band.shape[2] // EIGHT
    for t in range(band.shape[0]):
        for part in range(parts):
            for i in range(EIGHT):
                band[t, row.COS, part * EIGHT + i] = phase[t * parts + part, COSINE, i]
                band[t, row.SIN, part * EIGHT + i] = phase[t * parts + part, SINE, i]
        put(band, t, row.COS, lanes(band, t, row.LIVE) * lanes(band, t, row.COS))
        put(band, t, row.SIN, lanes(band, t, row.LIVE) * lanes(band, t, row.SIN))


@kernel
def follow_pass(tables, state, t):
    """Tables, weights and frequencies of a tile whose carriers follow the finger."""
    bank, block = state.bank, state.place.shape[0]
    band = bank.band
    wavenumber, frequency = lanes(band, t, row.WAVENUMBER), lanes(band, t, row.FREQUENCY)
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    step = 1.0 / tables.sample.rate * frequency
    for m in range(block):
        u, v = unit(step * m + wavenumber * state.place[m])
        put(state.table, t, 2 * m, cos * u - sin * v)
        put(state.table, t, 2 * m + 1, cos * v + sin * u)
    put(band, t, row.COS, lanes(band, t, row.LIVE))
    put(band, t, row.SIN, 0.0 * sin)
    motion_pass(tables.bank.numbers, band, bank.track, t)


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
        state.response[d] = state.sum[0, d]
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


@kernel
def turn_held(band, held, t, r, re, im):
    """Envelope of a tile as this block's tables want it, into rows r and r + 1."""
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    put(held, t, r, re * cos - im * sin)
    put(held, t, r + 1, re * sin + im * cos)


@kernel
def turned(cos, sin, re, im):
    """An envelope turned ahead."""
    return re * cos - im * sin, re * sin + im * cos


@kernel
def clear(state):
    """Begin the sums over the bands."""
    nothing = 0.0 * lanes(state.table, 0, 0)
    for s in range(2):
        for m in range(state.lane_sum.shape[1]):
            put(state.lane_sum, s, m, nothing)


@kernel
def add(lane_sum, s, m, value):
    """Add to a sum."""
    put(lane_sum, s, m, lanes(lane_sum, s, m) + value)


@kernel
def unfold(state):
    """Sums over the lanes, sample by sample."""
    out, lane_sum = state.sum, state.lane_sum
    for q in range(0, out.shape[1], EIGHT):
        for i in range(PAIRS):
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            even, even2 = totals(1.0, lanes(lane_sum, 0, early), lanes(lane_sum, 1, early))
            odd, odd2 = totals(1.0, lanes(lane_sum, 0, late), lanes(lane_sum, 1, late))
            out[0, early], out[0, late] = even - odd, even + odd
            out[1, early], out[1, late] = even2 - odd2, even2 + odd2


@kernel
def add_following(state, t, s, re, im, step_re, step_im):
    """Add a tile that follows the finger to sum s: Re (x + (m + 1) step) e^(j phase of m)."""
    table, sums = state.table, state.lane_sum
    for q in range(0, state.place.shape[0], EIGHT):
        for i in range(PAIRS):
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            cos, sin = lanes(table, t, 2 * early), lanes(table, t, 2 * early + 1)
            u, v = lanes(table, t, 2 * late), lanes(table, t, 2 * late + 1)
            before = (re + (early + 1.0) * step_re) * cos - (im + (early + 1.0) * step_im) * sin
            after = (re + (late + 1.0) * step_re) * u - (im + (late + 1.0) * step_im) * v
            add(sums, s, early, 0.5 * (after + before))
            add(sums, s, late, 0.5 * (after - before))


@kernel
def sum_bands(state, r, s):
    """Two sums over the bands at every sample: of Re x e^(j w m), x in rows r, r + 1 and in rows s, s + 1 of `held`."""
    table, held, sums = state.table, state.held, state.lane_sum
    clear(state)
    for t in range(table.shape[0]):
        re, im, at, up = lanes(held, t, r), lanes(held, t, r + 1), lanes(held, t, s), lanes(held, t, s + 1)
        if state.bank.pace[t] == row.LOCKED:
            nothing = 0.0 * re
            add_following(state, t, 0, re, im, nothing, nothing)
            add_following(state, t, 1, at, up, nothing, nothing)
            continue
        turn, on = lanes(table, t, TURN_COS), lanes(table, t, TURN_SIN)
        for q in range(0, sums.shape[1], EIGHT):
            for i in range(PAIRS):
                cos, sin = lanes(table, t, PAIR_ROWS * i + PAIR_COS), lanes(table, t, PAIR_ROWS * i + PAIR_SIN)
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                add(sums, 0, early, re * cos)
                add(sums, 0, late, -im * sin)
                add(sums, 1, early, at * cos)
                add(sums, 1, late, -up * sin)
            re, im = turned(turn, on, re, im)
            at, up = turned(turn, on, at, up)
    unfold(state)


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
        for q in range(0, sums.shape[1], EIGHT):
            re, im = re + ahead * step_re, im + ahead * step_im
            up_re, up_im = up_re + ahead * rise_re, up_im + ahead * rise_im
            for i in range(PAIRS):
                cos, sin, far_cos, far_sin = four(table, t, PAIR_ROWS * i)
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                add(sums, 0, early, re * cos - step_im * far_sin)
                add(sums, 0, late, step_re * far_cos - im * sin)
                add(sums, 1, early, up_re * cos - rise_im * far_sin)
                add(sums, 1, late, rise_re * far_cos - up_im * sin)
            re, im = turned(turn, on, re, im)
            step_re, step_im = turned(turn, on, step_re, step_im)
            up_re, up_im = turned(turn, on, up_re, up_im)
            rise_re, rise_im = turned(turn, on, rise_re, rise_im)
            ahead = share * EIGHT
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
    for q in range(0, whole, EIGHT):
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
        for q in range(0, state.place.shape[0], EIGHT):
            for i in range(PAIRS):
                early, late = q + PAIRS - 1 - i, q + PAIRS + i
                cos, sin = lanes(table, t, 2 * early), lanes(table, t, 2 * early + 1)
                u, v = lanes(table, t, 2 * late), lanes(table, t, 2 * late + 1)
                even, odd = 0.5 * heard[c, early], 0.5 * heard[c, late]
                re, im = re + even * (u + cos) + odd * (u - cos), im - even * (v + sin) - odd * (v - sin)
                even, odd = 0.5 * heard[d, early], 0.5 * heard[d, late]
                at, up = at + even * (u + cos) + odd * (u - cos), up - even * (v + sin) - odd * (v - sin)
        return re, im, at, up
    turn, back = lanes(table, t, TURN_COS), -lanes(table, t, TURN_SIN)
    for q in range(heard.shape[1] - EIGHT, -1, -EIGHT):
        re, im = turned(turn, back, re, im)
        at, up = turned(turn, back, at, up)
        for i in range(PAIRS):
            cos, sin = lanes(table, t, PAIR_ROWS * i + PAIR_COS), lanes(table, t, PAIR_ROWS * i + PAIR_SIN)
            early, late = q + PAIRS - 1 - i, q + PAIRS + i
            re, im = re + heard[c, early] * cos, im - heard[c, late] * sin
            at, up = at + heard[d, early] * cos, up - heard[d, late] * sin
    return re, im, at, up


@kernel
def analyse(state, wanted):
    """Residuals of the bank that listens to the wanted waveform, into the last row."""
    band, last = state.bank.band, state.error.shape[0] - 1
    for t in range(band.shape[0]):
        turn_held(band, state.held, t, 0, lanes(band, t, row.RAW_RE), lanes(band, t, row.RAW_IM))
    sum_bands(state, 0, 0)
    for m in range(wanted.shape[0]):
        state.raw[last, m] = (wanted[m] if size(wanted[m]) <= FAR else 0.0) - state.sum[0, m]
    solve(state, 1, last)


@kernel
def know(tables, state, touching):
    """Take what is known of the finger into the law; carriers that follow it as they will be when the drive acts."""
    bank, known = state.bank, 1.0 if touching else 0.0
    due = touching or known != bank.touch[row.KNOWN] or state.stale[0] > 0
    bank.touch[row.KNOWN], bank.touch[row.KNOWN_PLACE] = known, bank.touch[row.PLACE]
    for t in range(bank.band.shape[0]):
        follows = bank.pace[t] == row.LOCKED
        if follows or state.stale[0] > 0:
            look_ahead(tables.sample, bank.band, bank.law, t)
        if follows:
            omega = lanes(bank.band, t, row.OMEGA)
            put(bank.band, t, row.OMEGA, omega + tables.sample.lead * lanes(bank.band, t, row.SWEEP))
        if follows or due:
            law_tune(tables.bank, bank, t)


@kernel
def take_up(tables, state, t):
    """Take up the tones that are asked for in a tile, where they are other than before."""
    bank, tone, width, block = state.bank, tables.bank.tone, state.bank.band.shape[2], state.place.shape[0]
    band, parts = bank.band, width // EIGHT
    changed = False
    for i in range(min(width, tone.shape[1] - t * width)):
        k = t * width + i
        frequency, wavenumber = band[t, row.FREQUENCY, i], band[t, row.WAVENUMBER, i]
        for r in range(row.TONE_ROWS):
            band[t, row.FREQUENCY + r, i] = tone[r, k]
        if band[t, row.FREQUENCY, i] != frequency or band[t, row.WAVENUMBER, i] != wavenumber:
            changed = True
        turned = tone[0, k] / tables.sample.rate * block
        state.phase[t * parts + i // EIGHT, TURNED, i % EIGHT] = turned - floor(turned)
    if not changed and state.stale[0] == 0:
        return
    state.stale[0] = 1
    carrier = lanes(band, t, row.FREQUENCY)
    put(band, t, row.OMEGA, TURN * carrier)
    bank.follows[0] -= 1 if bank.pace[t] == row.LOCKED else 0
    bank.pace[t] = row.LOCKED if any_of(lanes(band, t, row.WAVENUMBER) > 0.0) else row.GROWING
    follows, step = bank.pace[t] == row.LOCKED, 1.0 / tables.sample.rate * carrier
    for i in range(width):
        turns = 0.0 if follows else (PAIRS - 0.5) / tables.sample.rate * band[t, row.FREQUENCY, i]
        state.phase[t * parts + i // EIGHT, TO_MIDDLE, i % EIGHT] = turns
    if follows:
        bank.follows[0] += 1
        return
    for i in range(PAIRS):
        cos, sin = unit(step * (i + 0.5))
        put(state.table, t, PAIR_ROWS * i + PAIR_COS, cos)
        put(state.table, t, PAIR_ROWS * i + PAIR_SIN, sin)
        put(state.table, t, PAIR_ROWS * i + FAR_COS, (i + 0.5) / block * cos)
        put(state.table, t, PAIR_ROWS * i + FAR_SIN, (i + 0.5) / block * sin)
    cos, sin = unit(step * EIGHT)
    put(state.table, t, TURN_COS, cos)
    put(state.table, t, TURN_SIN, sin)


@kernel
def want(tables, state, t, g):
    """Wanted envelope R at the block's end, its slope, and R as the observer sees it, in the block's middle."""
    numbers, band = tables.bank.numbers, state.bank.band
    weight = lanes(band, t, row.WEIGHT)
    old_re, old_im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
    if numbers.analysed:
        cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
        last = state.heard.shape[0] - 1
        a, b, _, _ = correlate(state, t, last, last)
        raw_re = lanes(band, t, row.RAW_RE) + g * (a * cos + b * sin)
        raw_im = lanes(band, t, row.RAW_IM) + g * (b * cos - a * sin)
        put(band, t, row.RAW_RE, raw_re)
        put(band, t, row.RAW_IM, raw_im)
        follow = min(0.5 * g * state.place.shape[0], 1.0)
        re, im = old_re + follow * (weight * raw_re - old_re), old_im + follow * (weight * raw_im - old_im)
    else:
        re, im = weight * lanes(band, t, row.WANTED_RE), weight * lanes(band, t, row.WANTED_IM)
    put(band, t, row.R_RE, re)
    put(band, t, row.R_IM, im)
    put(band, t, row.DR_RE, numbers.rate * (re - old_re))
    put(band, t, row.DR_IM, numbers.rate * (im - old_im))
    put(band, t, row.SEEN_RE, 0.5 * (re + old_re))
    put(band, t, row.SEEN_IM, 0.5 * (im + old_im))


@kernel
def update(tables, state, t, c, a, b, g, integral, back):
    """Error envelopes, integral parts and commands of a tile in coordinate c; how much either detector hears.

    `a` and `b` are what the block's residuals have in common with the carriers.
    """
    numbers, band, loop, shape = tables.bank.numbers, state.bank.band, state.bank.loop, tables.bank.shape[c]
    base, period, block = c * row.LOOP_ROWS, 1.0 / numbers.rate, state.place.shape[0]
    cos, sin, weight = lanes(band, t, row.COS), lanes(band, t, row.SIN), lanes(band, t, row.SHARE)
    found_re, found_im = a * cos + b * sin, b * cos - a * sin
    fading = FORGET * (1.0 - weight)
    heard_fast = heard_slow = 0.0
    for r, found in ((0, found_re), (1, found_im)):
        e = lanes(loop, t, base + row.E_RE + r)
        v, wanted = lanes(loop, t, base + row.V_RE + r), shape * lanes(band, t, row.R_RE + r)
        heard = e - v + 2.0 / block * found
        e = (1.0 - period * fading) * e + weight * g * found
        slope = -integral * e - back * (v + wanted) - fading * v
        v += period * slope
        put(loop, t, base + row.E_RE + r, e)
        put(loop, t, base + row.V_RE + r, v)
        steeper = shape * lanes(band, t, row.DR_RE + r)
        put(loop, t, base + row.COMMAND_RE + r, v + wanted + tables.sample.lead * steeper)
        put(loop, t, base + row.SLOPED_RE + r, slope + steeper)
        slow = lanes(loop, t, base + row.L_RE + r)
        put(loop, t, base + row.L_RE + r, slow + min(0.5 * g * block, 1.0) * (v - slow))
        fast = lanes(loop, t, base + row.FAST_RE + r)
        fast += numbers.fast_pole * (heard - fast)
        put(loop, t, base + row.FAST_RE + r, fast)
        heard_fast += fast * fast
        slow = lanes(loop, t, base + row.SLOW_RE + r)
        slow += numbers.slow_pole * (heard - slow)
        put(loop, t, base + row.SLOW_RE + r, slow)
        heard_slow += slow * slow
    return high(heard_fast - numbers.fast_level, 0.0), high(heard_slow - numbers.slow_level, 0.0)


@kernel
def command(tables, state, t):
    """Drive envelope of every channel from the law, at the end of the last block and of this one."""
    bank, held, coordinates = state.bank, state.held, len(tables.bank.shape)
    law, loop = bank.law, bank.loop
    for channel in range(tables.bank.speak.shape[0]):
        re = im = 0.0 * lanes(law, t, 0)
        for c in range(coordinates):
            share = tables.bank.speak[channel, c]
            for i in range(coordinates):
                base, at = i * row.LOOP_ROWS, row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
                v_re, v_im = lanes(loop, t, base + row.COMMAND_RE), lanes(loop, t, base + row.COMMAND_IM)
                dv_re, dv_im = lanes(loop, t, base + row.SLOPED_RE), lanes(loop, t, base + row.SLOPED_IM)
                d_re, d_im = lanes(law, t, at + row.LAW_RE), lanes(law, t, at + row.LAW_IM)
                s_re, s_im = lanes(law, t, at + row.SLOPE_RE), lanes(law, t, at + row.SLOPE_IM)
                re += share * (d_re * v_re - d_im * v_im + s_re * dv_re - s_im * dv_im)
                im += share * (d_re * v_im + d_im * v_re + s_re * dv_im + s_im * dv_re)
        at = 2 * coordinates + CHANNEL_ROWS * channel
        last_re, last_im = lanes(held, t, at + NOW_RE), lanes(held, t, at + NOW_IM)
        put(held, t, at + NOW_RE, re)
        put(held, t, at + NOW_IM, im)
        turn_held(bank.band, held, t, at + FROM_RE, last_re, last_im)
        turn_held(bank.band, held, t, at + STEP_RE, re - last_re, im - last_im)


@kernel
def quarter_ahead(held, at):
    """Turn the drives' envelopes of all tiles a quarter ahead: x becomes -j x."""
    for t in range(held.shape[0]):
        for r in (at + FROM_RE, at + STEP_RE):
            re, im = lanes(held, t, r), lanes(held, t, r + 1)
            put(held, t, r, im)
            put(held, t, r + 1, -re)


@kernel
def speak(tables, state, drive):
    """Drive of every channel, linear from the last block's envelope to this one's; returns its largest envelope.

    Near the limit the envelope is that of the analytic signal, the drive and its quadrature; far from it the drive's
    own samples do.
    """
    sums, block, first = state.sum, drive.shape[0], 2 * len(tables.bank.shape)
    trust, unit_drive, peak = state.bank.touch[row.TRUST], 1.0 / tables.sample.drive_limit, 0.0
    for channel in range(0, drive.shape[1], 2):
        at, pair = first + CHANNEL_ROWS * channel, min(drive.shape[1] - channel, 2)
        sum_drives(state, at)
        for i in range(pair):
            for m in range(block):
                drive[m, channel + i] = trust * sums[i, m]
                peak = max(peak, (unit_drive * drive[m, channel + i]) ** 2)
        if max(peak, state.bank.touch[row.PEAK]) > NEAR_LIMIT * NEAR_LIMIT:
            for i in range(pair):
                quarter_ahead(state.held, at + CHANNEL_ROWS * i)
            sum_drives(state, at)
            for i in range(pair):
                for m in range(block):
                    across = unit_drive * trust * sums[i, m]
                    peak = max(peak, (unit_drive * drive[m, channel + i]) ** 2 + across * across)
    return peak


@kernel
def shape_drive(tables, state, scale, drive):
    """Scale every channel into its limit and shape the noise of its rounding (2nd order)."""
    numbers, shaper, touch = tables.sample, state.bank.shaper, state.bank.touch
    limit, step, block, before = numbers.drive_limit, numbers.drive_step, drive.shape[0], touch[row.SCALE]
    believed, per_step = touch[row.TRUST] > 0.0, 1.0 / step if step > 0.0 else 0.0
    for m in range(block):
        share = before + (scale - before) * (m + 1.0) / block
        for channel in range(tables.bank.speak.shape[0]):  # side by side: each waits for its own last sample
            exact = share * drive[m, channel]
            if not believed:
                exact = shaper[0, channel] = shaper[1, channel] = 0.0
            elif step > 0.0:
                shaped = exact + 2.0 * shaper[0, channel] - shaper[1, channel]
                exact = step * whole(shaped, per_step)
                shaper[1, channel] = shaper[0, channel]
                shaper[0, channel] = min(max(shaped - exact, -step), step)
            drive[m, channel] = min(max(exact, -limit), limit)


@kernel
def take_in(tables, state, sensed, flags):
    """Coordinates of every sample less the DC band as it would go on; returns whether a sensor was not believed."""
    listen, level, raw = tables.bank.listen, state.bank.level, state.raw
    doubt = 0.0
    for m in range(sensed.shape[0]):
        for c in range(len(tables.bank.shape)):
            y = -level[0, c] - m * level[1, c]
            for s in range(sensed.shape[1]):
                value = sensed[m, s]
                if size(value) <= tables.sample.sensed_limit:
                    y += listen[c, s] * value
                else:
                    doubt, flags[m] = 1.0, 2
            raw[c, m] = y
    return doubt


@kernel
def settle_level(tables, state, c):
    """DC band of type 2 after the block's residuals."""
    numbers, level, block = tables.sample, state.bank.level, state.place.shape[0]
    gained = steeper = 0.0
    for m in range(block):
        error = state.error[c, m]
        gained += (numbers.dc + (block - 1 - m) * numbers.dc_drift) * error
        steeper += numbers.dc_drift * error
    level[0, c] += block * level[1, c] + gained
    level[1, c] += steeper


@kernel
def block_step(tables, state, sensed, position, wanted, drive, target, flags):
    """One block of the whole controller: fills `drive` (M, channels), `target` (bands,) and `flags` (M,)."""
    bank, numbers, sample = state.bank, tables.bank.numbers, tables.sample
    band, loop, touch, track = bank.band, bank.loop, bank.touch, bank.track
    tiles, block, coordinates = band.shape[0], sensed.shape[0], len(tables.bank.shape)
    if state.stale[0] > 0 or state.news[0] > 0:
        state.news[0] = 0
        for t in range(tiles):
            take_up(tables, state, t)
    else:
        take_up(tables, state, bank.sample[0] % tiles)
    bank.sample[0] += 1
    for m in range(block):
        flags[m] = 0
        if size(position[m]) > FAR or not size(wanted[m]) <= FAR:
            flags[m] = 2
        if bank.follows[0] > 0:
            track_finger(track, sample.rate, position[m])
            state.place[m] = track[row.HELD]
    count_phases(tables, state)
    for t in range(tiles):
        if bank.pace[t] == row.LOCKED:
            follow_pass(tables, state, t)
        else:
            grow_pass(tables.bank, bank, t)
            put(band, t, row.SHARE, lanes(band, t, row.LIVE))
    calm = 1.0
    if numbers.crowd_speed > 0.0:
        calm = min(abs(track[row.VELOCITY]) / numbers.crowd_speed, 1.0)
    fast, slow = touch[row.FAST_OPEN], touch[row.SLOW_OPEN]
    g = calm * (sample.observer + fast * (sample.observer_awake - sample.observer))
    if state.stale[0] > 0 or bank.follows[0] > 0 or state.gain[0] != g:
        respond(tables, state, g)
        state.gain[0] = g
    if numbers.analysed:
        analyse(state, wanted)
    for t in range(tiles):
        want(tables, state, t, sample.reference)
        put_pairs(target, t, lanes(band, t, row.R_RE), lanes(band, t, row.R_IM))
    changed = feel(numbers, coordinates, tables.bank.stiffness, bank.level, touch)
    if changed:
        touch[row.FAST_TIME] = numbers.fast_time
        forget_finger(changed, touch, band, loop)
        fast = 1.0
    doubt = take_in(tables, state, sensed, flags)
    for t in range(tiles):
        for c in range(coordinates):
            shape, base = tables.bank.shape[c], c * row.LOOP_ROWS
            re = shape * lanes(band, t, row.SEEN_RE) + lanes(loop, t, base + row.E_RE)
            im = shape * lanes(band, t, row.SEEN_IM) + lanes(loop, t, base + row.E_IM)
            turn_held(band, state.held, t, 2 * c, re, im)
    sum_bands(state, 0, 2 * (coordinates - 1))
    integral = numbers.integral + slow * (numbers.integral_stirred - numbers.integral)
    integral += fast * (numbers.integral_awake - integral)
    back = numbers.back * (1.0 - touch[row.SCALE])
    hears_fast = hears_slow = 0.0 * lanes(band, 0, row.COS)
    for c in range(coordinates):
        for m in range(block):
            state.raw[c, m] -= state.sum[c, m]
        solve(state, 0, c)
        settle_level(tables, state, c)
    for t in range(tiles):
        a, b, a2, b2 = correlate(state, t, 0, coordinates - 1)
        for c in range(coordinates):
            heard_fast, heard_slow = update(tables, state, t, c, a, b, g, integral, back)
            hears_fast, hears_slow = hears_fast + heard_fast, hears_slow + heard_slow
            a, b = a2, b2
    believe(numbers, bank, doubt)
    heard_fast, heard_slow = totals(1.0, hears_fast, hears_slow)
    wake(numbers, touch, heard_fast, heard_slow)
    touching = touch[row.CONTACT] > 0.0 and numbers.adapt >= 0.0
    if touching:
        lively = max(fast, slow)
        gain = numbers.adapt + lively * (numbers.adapt_awake - numbers.adapt)
        rest = numbers.rest + lively * (numbers.rest_awake - numbers.rest)
        adapt_pass(tables.bank, bank, 1.0 / numbers.rate, 0.0, gain, rest, touching)
    know(tables, state, touching)
    state.stale[0] = 0
    peak = numbers.peak_decay * numbers.peak_decay * touch[row.PEAK]
    for t in range(tiles):
        command(tables, state, t)
    peak = max(peak, speak(tables, state, drive))
    touch[row.PEAK] = peak
    scale = 1.0 / root(peak) if peak > 1.0 else 1.0
    shape_drive(tables, state, scale, drive)
    touch[row.SCALE] = scale
    if scale < 1.0:
        for m in range(block):
            flags[m] |= 1


@kernel
def block_run(tables, state, sensed, position, wanted, drive, target, flags):
    """Blocks one after another: `target` has a row a block, everything else a row a sample."""
    block = state.place.shape[0]
    for b in range(sensed.shape[0] // block):
        n = slice(b * block, (b + 1) * block)
        block_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[b], flags[n])
