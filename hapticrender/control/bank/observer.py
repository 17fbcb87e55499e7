"""The observer of the band bank: one residual for all bands, error envelopes and integral parts, the level below."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import select, totals
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.control.bank import rows as row

FORGET = 50.0  # 1/s: a carrier near 0 Hz is forgotten, not followed


@kernel
def residual_pass(tables, state, c, inner):
    """Residual of the observer and deviation from the command, as the limiter has scaled it, in coordinate c."""
    band, loop, shape, y = state.band, state.loop, tables.shape[c], read(state.residual, row.HEARD, c)
    base = c * row.LOOP_ROWS
    observed = commanded = 0.0
    for t in range(band.shape[0]):
        cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
        observed += (shape * lanes(band, t, row.SEEN_RE) + lanes(loop, t, base + row.E_RE)) * cos
        observed -= (shape * lanes(band, t, row.SEEN_IM) + lanes(loop, t, base + row.E_IM)) * sin
        commanded += (shape * lanes(band, t, row.R_RE) + lanes(loop, t, base + row.V_RE)) * cos
        commanded -= (shape * lanes(band, t, row.R_IM) + lanes(loop, t, base + row.V_IM)) * sin
    observed, commanded = totals(y, observed, commanded)
    damp(tables, state, c, inner, observed, read(state.touch, row.SCALE) * commanded)


@kernel
def damp(tables, state, c, inner, observed, commanded):
    """Residual and deviation in coordinate c, and the force of the inner loop."""
    past, dc, y = state.past, read(state.level, 0, c), read(state.residual, row.HEARD, c)
    deviation = y - commanded
    newer, force = deviation, 0.0 * deviation
    for i in range(len(state.lags)):  # each value is read before its place is taken
        older = read(past, c, i)
        write(newer, past, c, i)
        if i > 0:
            force -= read(tables.taps, c, i) * newer
        newer = older
    write(inner * (force - read(tables.taps, c, 0) * deviation), state.residual, row.FORCE, c)
    write(y - observed - dc, state.residual, row.ERROR, c)
    write(deviation - dc, state.residual, row.DEVIATION, c)


@kernel
def level_pass(numbers, state, c, quick):
    """DC band of type 2, faster where it is `quick`."""
    level, error = state.level, read(state.residual, row.ERROR, c)
    drift = read(level, 1, c)
    dc, bend = numbers.dc, numbers.dc_drift
    if numbers.presence:
        dc = select(quick, numbers.dc_quick, dc)
        bend = select(quick, numbers.dc_drift_quick, bend)
    write(read(level, 0, c) + dc * error + drift, level, 0, c)
    write(drift + bend * error, level, 1, c)


@kernel
def observer_pass(tables, state, t, c, g, integral, back):
    """Error envelopes and integral parts of a tile in coordinate c."""
    numbers, band, loop, shape = tables.numbers, state.band, state.loop, tables.shape[c]
    base, period, error = c * row.LOOP_ROWS, 1.0 / tables.numbers.rate, read(state.residual, row.ERROR, c)
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    weight = lanes(band, t, row.SHARE)
    fading = FORGET * (1.0 - weight)
    keep, pull = 1.0 - period * fading, weight * (g * error)
    e_re = keep * lanes(loop, t, base + row.E_RE) + pull * cos
    e_im = keep * lanes(loop, t, base + row.E_IM) - pull * sin
    if not numbers.error_observer:  # X goes on by itself; E is its distance to a target that has moved
        moved = shape * 0.5 * numbers.reference / (1.0 - 0.5 * numbers.reference)
        e_re -= moved * (lanes(band, t, row.R_RE) - lanes(band, t, row.SEEN_RE))
        e_im -= moved * (lanes(band, t, row.R_IM) - lanes(band, t, row.SEEN_IM))
    put(loop, t, base + row.E_RE, e_re)
    put(loop, t, base + row.E_IM, e_im)
    for r, e in ((0, e_re), (1, e_im)):
        v = lanes(loop, t, base + row.V_RE + r)
        wanted = shape * lanes(band, t, row.R_RE + r)
        slope = -integral * e - fading * v
        v += period * (slope - back * (v + wanted))  # no part of dV/dt: the law would answer the limiter by itself
        put(loop, t, base + row.V_RE + r, v)
        put(loop, t, base + row.COMMAND_RE + r, v + wanted)
        put(loop, t, base + row.SLOPED_RE + r, slope + shape * lanes(band, t, row.DR_RE + r))
