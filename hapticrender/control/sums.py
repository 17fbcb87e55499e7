"""Sums over bands and samples in blocks, in groups of samples about whose middle carriers turn symmetrically.

In a group of g samples with its middle at s, the carriers of samples s - d and s + d are z_s conj(z_d) and z_s z_d, so
that with y = x z_s::

    Re(x z[s +- d]) = Re y cos(w d) -+ Im y sin(w d)

and one pair of products serves two samples, also of envelopes that rise linearly.  `table` holds z_d for the pairs,
`phasors` z_s for the groups; where a carrier follows the finger, z_s has the finger's mean position in the group, and
z_d, filled anew for each group, its mean velocity.
"""

from hapticrender.control.carriers import FASTEST
from hapticrender.control.records import (
    ANALYSIS,
    FOLDED,
    LOCKED,
    PAIR_T,
    POSITION,
    RESPONSE,
    SOLVED,
    SUM,
    TILE_T,
    TOEPLITZ,
    WORK_T,
    samples_of,
)
from hapticrender.jit import kernel, record
from hapticrender.mathx import unit
from hapticrender.vectors import conj, fused, get, imag, pair, put, real, total, zeros


@kernel
def turn_pairs(c, t, q):
    """Fill table and phasor of a tile for a group, relative to the block's start, by the finger's mean motion."""
    b, samples, group = record(c.tiles_at, TILE_T, t), samples_of(c), c.p.group
    middle, pairs, first = 0.5 * (group - 1), (group + 1) // 2, q * group
    last = min(first + group, c.p.block) - 1
    speed = (samples[POSITION, last] - samples[POSITION, first]) / max(last - first, 1)
    speed = speed if abs(speed) * c.p.rate <= FASTEST else 0.0
    turn = get(b, "frequency") / c.p.rate + speed * get(b, "wavenumber")
    for i in range(pairs):
        put(record(c.table_at, PAIR_T, i * c.tiles + t), "z", unit((middle - (pairs - 1 - i)) * turn))
    place = 0.0
    for m in range(first, last + 1):
        place += samples[POSITION, m] / (last + 1 - first)
    place += speed * (first + middle - 0.5 * (first + last))  # the last group may be filled in part
    turns = get(b, "frequency") / c.p.rate * (first + middle) + place * get(b, "wavenumber")
    put(record(c.phasors_at, PAIR_T, q * c.tiles + t), "z", unit(turns))


@kernel
def turn_tables(c):
    """Fill the tables where carriers follow the finger or are other ones, the first group last."""
    for t in range(c.tiles):
        if record(c.tiles_at, TILE_T, t).mode[0] == LOCKED or c.stale > 0:
            for q in range(c.p.groups - 1, -1, -1):
                turn_pairs(c, t, q)


@kernel
def sum_pairs(c, k, other, i, rising):
    """Sums over the bands for pairs k and `other` of a group in coordinate i: Re y cos and Im y sin of either."""
    even0, odd0, slope_even0, slope_odd0 = zeros(), zeros(), zeros(), zeros()
    even1, odd1, slope_even1, slope_odd1 = zeros(), zeros(), zeros(), zeros()
    for t in range(c.tiles):
        w, z0 = record(c.work_at, WORK_T, 2 * t + i), get(record(c.table_at, PAIR_T, k * c.tiles + t), "z")
        y, z1 = get(w, "y"), get(record(c.table_at, PAIR_T, other * c.tiles + t), "z")
        even0, odd0 = fused(real(y), real(z0), even0), fused(imag(y), imag(z0), odd0)
        even1, odd1 = fused(real(y), real(z1), even1), fused(imag(y), imag(z1), odd1)
        if rising:
            up = get(w, "up")
            slope_even0, slope_odd0 = fused(imag(up), imag(z0), slope_even0), fused(real(up), real(z0), slope_odd0)
            slope_even1, slope_odd1 = fused(imag(up), imag(z1), slope_even1), fused(real(up), real(z1), slope_odd1)
    first = 0.5 * (c.p.group - 1) - ((c.p.group + 1) // 2 - 1)  # distance of pair 0 from the middle
    even0, odd0 = even0 - (first + k) * slope_even0, odd0 - (first + k) * slope_odd0
    return even0, odd0, even1 - (first + other) * slope_even1, odd1 - (first + other) * slope_odd1


@kernel
def sum_bands(c, count, rising):
    """Sum Re(x z[m]) over the bands for `count` envelopes x, which may rise linearly over the block; rows SUM."""
    samples, group, block, tiles = samples_of(c), c.p.group, c.p.block, c.tiles
    middle, pairs = 0.5 * (group - 1), (group + 1) // 2
    for q in range(c.p.groups):
        share = (q * group + middle + 1.0) / block
        for t in range(tiles):
            if record(c.tiles_at, TILE_T, t).mode[0] == LOCKED:
                turn_pairs(c, t, q)
            z = get(record(c.phasors_at, PAIR_T, q * tiles + t), "z")
            for i in range(count):
                w = record(c.work_at, WORK_T, 2 * t + i)
                x = get(w, "x")
                if rising:
                    x = x + share * get(w, "rise")
                    put(w, "up", get(w, "rise") * z * (1.0 / block))
                put(w, "y", x * z)
        for k in range(0, pairs, 2):  # two pairs at a time: a sum waits for the one before it
            other = min(k + 1, pairs - 1)
            for i in range(count):
                even0, odd0, even1, odd1 = sum_pairs(c, k, other, i, rising)
                early, late = q * group + pairs - 1, q * group + group - pairs
                samples[SUM + i, early - k] = total(even0 + odd0)
                samples[SUM + i, late + k] = total(even0 - odd0)
                samples[SUM + i, early - other] = total(even1 + odd1)
                samples[SUM + i, late + other] = total(even1 - odd1)


@kernel
def correlate(c, row, count):
    """Sums over the block of `count` rows of `samples` times z[m] of every band, into the envelopes x."""
    samples, group, tiles = samples_of(c), c.p.group, c.tiles
    pairs = (group + 1) // 2
    for i in range(count):
        for start in range(0, c.p.groups * group, group):
            for k in range(pairs):
                early, late = start + pairs - 1 - k, start + group - pairs + k
                twice = 0.5 if early == late else 1.0  # the middle of an odd group
                one, other = samples[row + i, early], samples[row + i, late]
                samples[FOLDED, start + k], samples[FOLDED + 1, start + k] = (
                    twice * (other + one),
                    twice * (other - one),
                )
        for t in range(tiles):
            x = pair(zeros(), zeros())
            for q in range(c.p.groups):
                if record(c.tiles_at, TILE_T, t).mode[0] == LOCKED:
                    turn_pairs(c, t, q)
                even, odd = zeros(), zeros()
                for k in range(pairs):
                    z, m = get(record(c.table_at, PAIR_T, k * tiles + t), "z"), q * group + k
                    even, odd = fused(samples[FOLDED, m], real(z), even), fused(samples[FOLDED + 1, m], imag(z), odd)
                x = x + pair(even, odd) * get(record(c.phasors_at, PAIR_T, q * tiles + t), "z")
            put(record(c.work_at, WORK_T, 2 * t + i), "x", x)


@kernel
def invert(c, g):
    """Set the response r of the observer, and the first columns of (1 + L)^-1 for innovation and waveform.

    L[m, j] = g_dc + (m - j - 1) g_drift + g r[m - j] for m > j.
    """
    samples, block, p = samples_of(c), c.p.block, c.p
    last = (p.group + 1) // 2 - 1
    for t in range(c.tiles):
        w, b = record(c.work_at, WORK_T, 2 * t), record(c.tiles_at, TILE_T, t)
        first = get(record(c.phasors_at, PAIR_T, t), "z") * conj(
            get(record(c.table_at, PAIR_T, last * c.tiles + t), "z")
        )
        put(w, "x", get(b, "feedback") * conj(first))  # relative to the block's first sample
    sum_bands(c, 1, False)
    for m in range(block):
        samples[RESPONSE, m] = samples[SUM, m]
    for row in range(TOEPLITZ, ANALYSIS + 1):
        gain, dc, drift = (g, p.dc, p.dc_drift) if row == TOEPLITZ else (p.waveform_gain, 0.0, 0.0)
        for m in range(block):
            samples[row, m] = 1.0 if m == 0 else 0.0
        for j in range(block):
            value = samples[row, j]
            for m in range(j + 1, block):
                samples[row, m] -= (dc + (m - j - 1) * drift + gain * samples[RESPONSE, m - j]) * value
    c.response_gain = g


@kernel
def solve(c, row, inverse):
    """Replace a row of residuals by Q times it: from what held envelopes leave to the sample-by-sample observer's."""
    samples, block = samples_of(c), c.p.block
    x, q, found = samples[row], samples[inverse], samples[SOLVED]
    for m in range(block):
        found[m] = 0.0
    for j in range(block):
        value, rest = x[j], found[j:]
        for m in range(block - j):
            rest[m] += value * q[m]
    for m in range(block):
        x[m] = found[m]
