"""Sums over bands and samples in blocks: carriers in tables, several samples or bands for each load.

A block's carriers relative to its start lie in two tables, sample by sample (for sums over bands) and band by band
(for sums over samples), so that both are plain reductions along the last axis, which vectorise.
"""

from __future__ import annotations

from numba import carray

from hapticrender.control.records import CONTROLLER_T, LOCKED, TILE_T, W
from hapticrender.jit import F8, kernel, pointer, record
from hapticrender.mathx import sincos_turns

# rows of the samples' work array (rows, M): coordinates, then innovations; sums over the bands and their steps; finger
# position; waveform; response r, first columns of Q for the innovation and for the waveform; what was solved
Y, SUM, STEP, POSITION, WAVEFORM, RESPONSE, INVERSE, ANALYSIS, SOLVED = 0, 2, 4, 6, 7, 8, 9, 10, 11
SAMPLE_ROWS = 12


@kernel
def samples_of(controller):
    """Work array of the samples, shape (rows, M)."""
    c = record(controller, CONTROLLER_T, 0)
    return carray(pointer(c.samples_at, F8), (SAMPLE_ROWS, c.p.block))


@kernel
def envelopes_of(controller):
    """Work array of two envelopes of every band, re, im, re, im, and of their rises over the block; shape (8, K)."""
    c = record(controller, CONTROLLER_T, 0)
    return carray(pointer(c.work_at, F8), (8, c.tiles * W))


@kernel
def by_sample(controller):
    """Table of the carriers' cosines and sines for sums over bands, shape (M, 2, K)."""
    c = record(controller, CONTROLLER_T, 0)
    return carray(pointer(c.tables_at, F8), (c.p.block, 2, c.tiles * W))


@kernel
def by_band(controller):
    """Table of the carriers' cosines and sines for sums over samples, shape (K, 2, M)."""
    c = record(controller, CONTROLLER_T, 0)
    size = 8 * 2 * c.p.block * c.tiles * W
    return carray(pointer(c.tables_at + size, F8), (c.tiles * W, 2, c.p.block))


@kernel
def gather(controller, t):
    """Copy the held envelopes of a tile, and their rises over the block, into the rows of `w`."""
    c = record(controller, CONTROLLER_T, 0)
    w, b, at = envelopes_of(controller), record(c.tiles_at, TILE_T, t), t * W
    for k in range(W):
        w[0, at + k], w[1, at + k] = b.work0_re[k], b.work0_im[k]
        w[2, at + k], w[3, at + k] = b.work1_re[k], b.work1_im[k]
        w[4, at + k], w[5, at + k] = b.rise0_re[k], b.rise0_im[k]
        w[6, at + k], w[7, at + k] = b.rise1_re[k], b.rise1_im[k]


@kernel
def scatter(controller, t):
    """Copy four rows of `w` into the held envelopes of a tile."""
    c = record(controller, CONTROLLER_T, 0)
    w, b, at = envelopes_of(controller), record(c.tiles_at, TILE_T, t), t * W
    for k in range(W):
        b.work0_re[k], b.work0_im[k] = w[0, at + k], w[1, at + k]
        b.work1_re[k], b.work1_im[k] = w[2, at + k], w[3, at + k]


@kernel
def sum_bands(controller):
    """Sum Re(x e^(j w m)) over the bands for two envelopes x that rise linearly over the block; into the rows SUM."""
    c = record(controller, CONTROLLER_T, 0)
    w, tables, samples, last = envelopes_of(controller), by_sample(controller), samples_of(controller), c.p.block - 1
    re0, im0, re1, im1, up0, on0, up1, on1 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7]
    for m in range(0, c.p.block, 2):
        n = min(m + 1, last)
        cos, sin, cos_n, sin_n = tables[m, 0], tables[m, 1], tables[n, 0], tables[n, 1]
        a0 = a1 = b0 = b1 = 0.0
        share, share_n = (m + 1.0) / c.p.block, (n + 1.0) / c.p.block
        for k in range(c.tiles * W):
            x, y, u, v, dx, dy, du, dv = re0[k], im0[k], re1[k], im1[k], up0[k], on0[k], up1[k], on1[k]
            a0 += (x + share * dx) * cos[k] - (y + share * dy) * sin[k]
            b0 += (u + share * du) * cos[k] - (v + share * dv) * sin[k]
            a1 += (x + share_n * dx) * cos_n[k] - (y + share_n * dy) * sin_n[k]
            b1 += (u + share_n * du) * cos_n[k] - (v + share_n * dv) * sin_n[k]
        samples[SUM, m], samples[SUM, n], samples[SUM + 1, m], samples[SUM + 1, n] = a0, a1, b0, b1


@kernel
def correlate(controller, row):
    """Sums over the block of two rows of `samples` times cosine and sine of every band, two bands a pass."""
    c = record(controller, CONTROLLER_T, 0)
    w, tables, samples = envelopes_of(controller), by_band(controller), samples_of(controller)
    x, y = samples[row], samples[row + 1]
    for k in range(0, c.tiles * W, 2):
        cos, sin, cos_n, sin_n = tables[k, 0], tables[k, 1], tables[k + 1, 0], tables[k + 1, 1]
        a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = 0.0
        for m in range(c.p.block):
            e, f = x[m], y[m]
            a0 += e * cos[m]
            a1 += e * sin[m]
            a2 += f * cos[m]
            a3 += f * sin[m]
            b0 += e * cos_n[m]
            b1 += e * sin_n[m]
            b2 += f * cos_n[m]
            b3 += f * sin_n[m]
        w[0, k], w[1, k], w[2, k], w[3, k] = a0, a1, a2, a3
        w[0, k + 1], w[1, k + 1], w[2, k + 1], w[3, k + 1] = b0, b1, b2, b3


@kernel
def turn_tables(controller):
    """Fill the tables of the carriers relative to the block's start, with the finger's positions in `samples`."""
    c = record(controller, CONTROLLER_T, 0)
    over_bands, over_samples, samples = by_sample(controller), by_band(controller), samples_of(controller)
    for t in range(c.tiles):
        b = record(c.tiles_at, TILE_T, t)
        if b.mode[0] != LOCKED and c.stale == 0:
            continue
        for m in range(c.p.block):
            place = samples[POSITION, m]
            for k in range(W):
                sin, cos = sincos_turns(b.frequency[k] / c.p.rate * m + b.wavenumber[k] * place)
                i = t * W + k
                over_bands[m, 0, i], over_bands[m, 1, i] = cos, sin
                over_samples[i, 0, m], over_samples[i, 1, m] = cos, sin


@kernel
def invert(controller, g):
    """Set the response r of the observer, and the first columns of (1 + L)^-1 for innovation and waveform.

    L[m, j] = g_dc + (m - j - 1) g_drift + g r[m - j] for m > j.
    """
    c = record(controller, CONTROLLER_T, 0)
    w, tables, samples = envelopes_of(controller), by_sample(controller), samples_of(controller)
    block, p = c.p.block, c.p
    for t in range(c.tiles):
        b, at = record(c.tiles_at, TILE_T, t), t * W
        for k in range(W):  # relative to the block's first sample
            w[0, at + k], w[1, at + k] = b.feedback[k] * tables[0, 0, at + k], -b.feedback[k] * tables[0, 1, at + k]
            for row in range(2, 8):
                w[row, at + k] = 0.0
    sum_bands(controller)
    for m in range(block):
        samples[RESPONSE, m] = samples[SUM, m]
    for row in range(INVERSE, ANALYSIS + 1):
        gain, dc, drift = (g, p.dc, p.dc_drift) if row == INVERSE else (p.reference, 0.0, 0.0)
        for m in range(block):
            samples[row, m] = 1.0 if m == 0 else 0.0
        for j in range(block):
            value = samples[row, j]
            for m in range(j + 1, block):
                samples[row, m] -= (dc + (m - j - 1) * drift + gain * samples[RESPONSE, m - j]) * value
    c.response_gain = g


@kernel
def solve(controller, row, inverse):
    """Replace a row of residuals by Q times it: from what held envelopes leave to the sample-by-sample observer's."""
    c = record(controller, CONTROLLER_T, 0)
    samples, block = samples_of(controller), c.p.block
    x, q, found = samples[row], samples[inverse], samples[SOLVED]
    for m in range(block):
        found[m] = 0.0
    for j in range(block):
        value, rest = x[j], found[j:]
        for m in range(block - j):
            rest[m] += value * q[m]
    for m in range(block):
        x[m] = found[m]
