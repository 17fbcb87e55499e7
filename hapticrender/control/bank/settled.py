"""A sample of the band bank while little happens: carriers are fixed, targets stay, the drive is inside its limit.

Then no carrier fades and none leaves its band, and the target's part of the force is known until the law changes; so
is what the force answers to a residual.  What is left of the general step (`kernels`) is here, half of it.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, totals
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.observer import damp, level_pass


@kernel
def settled(state):
    """Whether every target stays, the limiter is idle and the sensors are believed."""
    stirs = (read(state.touch, row.SCALE) < 1.0) | (read(state.touch, row.TRUST) < 1.0)
    return state.follows[1] == 0 and not any_of(stirs)


@kernel
def settled_target(state):
    """What is wanted of all bands now."""
    band = state.band
    along = across = 0.0
    for t in range(band.shape[0]):
        along += lanes(band, t, row.R_RE) * lanes(band, t, row.COS)
        across += lanes(band, t, row.R_IM) * lanes(band, t, row.SIN)
    return along - across


@kernel
def settled_residual(tables, state, wanted, c, inner):
    """Residual of the observer and deviation from the command in coordinate c; see `residual_pass`."""
    band, loop, base = state.band, state.loop, c * row.LOOP_ROWS
    observed = commanded = tables.shape[c] * wanted
    e_across = v_across = 0.0 * wanted  # sums by themselves: none waits for another
    for t in range(band.shape[0]):
        cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
        observed += lanes(loop, t, base + row.E_RE) * cos
        e_across += lanes(loop, t, base + row.E_IM) * sin
        commanded += lanes(loop, t, base + row.V_RE) * cos
        v_across += lanes(loop, t, base + row.V_IM) * sin
    y = read(state.residual, row.HEARD, c)
    observed, commanded = totals(y, observed - e_across, commanded - v_across)
    damp(tables, state, c, inner, observed, commanded)


@kernel
def settled_observer(tables, state, t, c, g, integral):
    """Error envelopes and integral parts of a tile in coordinate c; see `observer_pass`."""
    band, loop, base = state.band, state.loop, c * row.LOOP_ROWS
    pull, fall = g * read(state.residual, row.ERROR, c), integral * (1.0 / tables.numbers.rate)
    re = lanes(loop, t, base + row.E_RE) + pull * lanes(band, t, row.COS)
    im = lanes(loop, t, base + row.E_IM) - pull * lanes(band, t, row.SIN)
    put(loop, t, base + row.E_RE, re)
    put(loop, t, base + row.E_IM, im)
    put(loop, t, base + row.V_RE, lanes(loop, t, base + row.V_RE) - fall * re)
    put(loop, t, base + row.V_IM, lanes(loop, t, base + row.V_IM) - fall * im)


@kernel
def settled_law(tables, state, integral):
    """Force before anything of this sample is heard, D (R + v) - ki (D' + T D) E, turned ahead.  See `law_pass`."""
    band, loop, law, ahead, coordinates = state.band, state.loop, state.law, state.ahead, len(tables.shape)
    for c in range(coordinates):
        force, across, first = 0.0, 0.0, c * (2 + 2 * coordinates)
        quarter = leaning = 0.0
        for t in range(band.shape[0]):
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
            cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
            re, im = re - integral * sloped_re, im - integral * sloped_im
            force += re * cos
            across += im * sin
            quarter += re * sin
            leaning += im * cos
        known, turned = totals(read(state.touch, row.TRUST), force - across, quarter + leaning)
        write(known, state.residual, row.KNOWN_FORCE, c)
        write(turned, state.residual, row.QUADRATURE, c)


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
def settled_sample(tables, state, g, integral, inner):
    """From what is heard to the force, while little happens; what needs no sensor comes first."""
    settled_law(tables, state, integral)
    wanted = settled_target(state)
    for c in range(len(tables.shape)):
        settled_residual(tables, state, wanted, c, inner)
        level_pass(tables.numbers, state, c, False)
        for t in range(state.band.shape[0]):
            settled_observer(tables, state, t, c, g, integral)
    settled_force(tables, state, g * integral)
