"""A sample of the band bank while little happens: carriers are fixed, targets stay, the drive is inside its limit.

Then no carrier fades and none leaves its band, and the target's part of the force is known until the law changes; so
is what the force answers to a residual.  What is left of the general step (`kernels`) is here, half of it.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, total, totals
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.carriers import turn_pass
from hapticrender.control.bank.detectors import HUGE, fast_pass
from hapticrender.control.bank.observer import damp, level_pass


@kernel
def settled(state):
    """Whether every target stays, the limiter is idle and the sensors are believed."""
    stirs = (read(state.touch, row.SCALE) < 1.0) | (read(state.touch, row.TRUST) < 1.0)
    return state.follows[1] == 0 and not any_of(stirs)


@kernel
def settled_row(tables, state, t, c, integral):
    """Force of a tile in coordinate c before anything of this sample is heard: D (R + v) - ki (D' + T D) E.

    It is turned ahead; see `law_pass`.
    """
    loop, law, ahead, coordinates = state.loop, state.law, state.ahead, len(tables.shape)
    first = c * (2 + 2 * coordinates)
    re, im = lanes(ahead, t, first), lanes(ahead, t, first + 1)
    sloped_re = sloped_im = 0.0
    for i in range(coordinates):
        base, at = i * row.LOOP_ROWS, row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
        v_re, v_im = lanes(loop, t, base + row.V_RE), lanes(loop, t, base + row.V_IM)
        d_re, d_im = lanes(law, t, at + row.LAW_RE), lanes(law, t, at + row.LAW_IM)
        re += d_re * v_re  # term by term: each is one instruction
        re -= d_im * v_im
        im += d_re * v_im
        im += d_im * v_re
        e_re, e_im = lanes(loop, t, base + row.E_RE), lanes(loop, t, base + row.E_IM)
        d_re, d_im = lanes(ahead, t, first + 2 + 2 * i), lanes(ahead, t, first + 3 + 2 * i)
        sloped_re += d_re * e_re
        sloped_re -= d_im * e_im
        sloped_im += d_re * e_im
        sloped_im += d_im * e_re
    return re - integral * sloped_re, im - integral * sloped_im


@kernel
def along(re, im, cos, sin, before):
    """Add what an envelope is at its carrier."""
    before += re * cos
    before -= im * sin
    return before


@kernel
def across(re, im, cos, sin, before):
    """Add what an envelope is a quarter turn ahead of its carrier."""
    before += re * sin
    before += im * cos
    return before


@kernel
def settled_tile(tables, state, t, c, integral, cos, sin, before):
    """Add to the sums of coordinate c what a tile gives: force, the same a quarter turn ahead, error and command."""
    loop, base = state.loop, c * row.LOOP_ROWS
    force, quarter, error, command = before
    re, im = settled_row(tables, state, t, c, integral)
    force, quarter = along(re, im, cos, sin, force), across(re, im, cos, sin, quarter)
    error = along(lanes(loop, t, base + row.E_RE), lanes(loop, t, base + row.E_IM), cos, sin, error)
    command = along(lanes(loop, t, base + row.V_RE), lanes(loop, t, base + row.V_IM), cos, sin, command)
    return force, quarter, error, command


@kernel
def settled_sums(tables, state, c, d, integral, turn, target):
    """What is known of coordinates c and d before they are heard; the bands are looked at once for both.

    Carriers are to `turn` on to this sample unless they have been set for it.  Fills `target`.
    """
    band = state.band
    wanted = 0.0 * lanes(band, 0, row.COS)
    one = other = (wanted, wanted, wanted, wanted)
    for t in range(band.shape[0]):
        cos, sin = turn_pass(band, t) if turn else (lanes(band, t, row.COS), lanes(band, t, row.SIN))
        re, im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
        put_pairs(target, t, re, im)
        wanted = along(re, im, cos, sin, wanted)
        one = settled_tile(tables, state, t, c, integral, cos, sin, one)
        if d > c:
            other = settled_tile(tables, state, t, d, integral, cos, sin, other)
    know(tables, state, c, one, wanted)
    if d > c:
        know(tables, state, d, other, wanted)


@kernel
def know(tables, state, c, sums, wanted):
    """Write down what is known of coordinate c before it is heard, summed over the bands; see `settled_tile`."""
    residual, like, seen = state.residual, read(state.touch, row.TRUST), tables.shape[c] * wanted
    force, quarter = totals(like, sums[0], sums[1])
    observed, commanded = totals(like, seen + sums[2], seen + sums[3])
    write(force, residual, row.KNOWN_FORCE, c)
    write(quarter, residual, row.QUADRATURE, c)
    write(observed, residual, row.OBSERVED, c)
    write(commanded, residual, row.COMMANDED, c)


@kernel
def settled_follow(tables, state, g, integral):
    """Error envelopes, integral parts and fast detector after a sample; returns what that hears, see `fast_pass`."""
    band, loop, fall, heard = state.band, state.loop, integral * (1.0 / tables.numbers.rate), 0.0
    for t in range(band.shape[0]):
        cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
        for c in range(len(tables.shape)):
            base, pull = c * row.LOOP_ROWS, g * read(state.residual, row.ERROR, c)
            re = lanes(loop, t, base + row.E_RE) + pull * cos
            im = lanes(loop, t, base + row.E_IM) - pull * sin
            put(loop, t, base + row.E_RE, re)
            put(loop, t, base + row.E_IM, im)
            put(loop, t, base + row.V_RE, lanes(loop, t, base + row.V_RE) - fall * re)
            put(loop, t, base + row.V_IM, lanes(loop, t, base + row.V_IM) - fall * im)
            if tables.numbers.fast_level < HUGE:
                heard += fast_pass(tables.numbers, state, t, c)
    return total(read(state.touch, row.TRUST), heard)


@kernel
def settled_force(tables, state, gain):
    """Force of all bands, and a quarter turn ahead: what was known before, and what the residuals add."""
    residual, answer, coordinates = state.residual, state.answer, len(tables.shape)
    for c in range(coordinates):
        force = read(residual, row.FORCE, c) + read(residual, row.KNOWN_FORCE, c)
        quarter = read(residual, row.QUADRATURE, c)
        for i in range(coordinates):
            heard = gain * read(residual, row.ERROR, i)
            force -= heard * read(answer, c, i)
            quarter -= heard * read(answer, coordinates + c, i)
        write(force, residual, row.FORCE, c)
        write(quarter, residual, row.QUADRATURE, c)


@kernel
def settled_command(tables, state, t):
    """What is commanded of a tile, where learning looks for it."""
    band, loop = state.band, state.loop
    for c in range(len(tables.shape)):
        for r in range(2):
            v = lanes(loop, t, c * row.LOOP_ROWS + row.V_RE + r)
            put(loop, t, c * row.LOOP_ROWS + row.COMMAND_RE + r, v + tables.shape[c] * lanes(band, t, row.R_RE + r))


@kernel
def settled_loop(tables, state, fresh, g, integral, inner, target):
    """From what is heard to the force, while little happens; what needs no sensor comes first."""
    coordinates = len(tables.shape)
    for c in range(0, coordinates, 2):
        settled_sums(tables, state, c, min(c + 1, coordinates - 1), integral, c == 0 and not fresh, target)
    for c in range(coordinates):
        damp(tables, state, c, inner, read(state.residual, row.OBSERVED, c), read(state.residual, row.COMMANDED, c))
        level_pass(tables.numbers, state, c, False)
    settled_force(tables, state, g * integral)
