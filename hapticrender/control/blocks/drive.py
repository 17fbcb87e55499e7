"""Drive of a block: by the law at its end, linear from the last one, scaled into its limit, its rounding shaped."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import root
from hapticrender.compiled.lanes_memory import lanes, put
from hapticrender.compiled.polynomials import whole
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.learning import send_finger
from hapticrender.control.blocks.state import (
    CHANNEL_ROWS,
    FROM_RE,
    NOW_IM,
    NOW_RE,
    STEP_RE,
)
from hapticrender.control.blocks.sums import sum_drives, turn_held

NEAR_LIMIT = 0.5  # share of the drive's limit, from which on its envelope is watched and not its samples alone


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
                drive[m, channel + i] = trust * sums[m, i]
                peak = max(peak, (unit_drive * drive[m, channel + i]) ** 2)
        if max(peak, state.bank.touch[row.PEAK]) > NEAR_LIMIT * NEAR_LIMIT:
            for i in range(pair):
                quarter_ahead(state.held, at + CHANNEL_ROWS * i)
            sum_drives(state, at)
            for i in range(pair):
                for m in range(block):
                    across = unit_drive * trust * sums[m, i]
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
                shaped = (exact - shaper[1, channel]) + 2.0 * shaper[0, channel]
                exact = step * whole(shaped, per_step)
                shaper[1, channel] = shaper[0, channel]
                shaper[0, channel] = min(max(shaped - exact, -step), step)
            drive[m, channel] = min(max(exact, -limit), limit)


@kernel
def answer(tables, state, touching, drive, flags):
    """Drive of the block from what is commanded, inside its limit."""
    bank, numbers, touch = state.bank, tables.bank.numbers, state.bank.touch
    peak = numbers.peak_decay * numbers.peak_decay * touch[row.PEAK]
    for t in range(bank.band.shape[0]):
        command(tables, state, t)
        if touching:
            send_finger(tables.bank, bank, t, bank.sample[0])
    peak = max(peak, speak(tables, state, drive))
    touch[row.PEAK] = peak
    scale = 1.0 / root(peak) if peak > 1.0 else 1.0
    shape_drive(tables, state, scale, drive)
    touch[row.SCALE] = scale
    if scale < 1.0:
        for m in range(drive.shape[0]):
            flags[m] |= 1
