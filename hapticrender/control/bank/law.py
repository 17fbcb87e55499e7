"""The law of the band bank: F = D V + D' dV/dt + j dw/dt M V, finger included, turned ahead by delay and hold.

D is tuned to the carriers when they are taken up or move, and to the finger in its turn; a sample multiplies.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel, late
from hapticrender.compiled.lanes import any_of, high, select, size, totals
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import SLOWEST, finger_stiffness
from hapticrender.control.kernels import TURN


@kernel
def look_ahead(numbers, band, law, t):
    """Turn of a tile's force by delay and hold."""
    omega, sweep = lanes(band, t, row.OMEGA), lanes(band, t, row.SWEEP)
    cos, sin = unit(numbers.lead / TURN * (omega + 0.5 * numbers.lead * sweep))
    half = 0.5 / numbers.rate * omega
    _, chord = unit(half / TURN)
    straight = size(half) < 1e-9
    grow = select(straight, 1.0, half / select(straight, 1.0, chord))
    put(law, t, row.AHEAD_RE, grow * cos)
    put(law, t, row.AHEAD_IM, grow * sin)


@kernel
def memory_damping(numbers, track):
    """Damping of a contact that remembers a length of its way, beyond what it is at the typical speed."""
    speed = read(track, row.SPEED)  # a finger that turns round at once does not slow down
    return numbers.memory * (1.0 / high(speed, SLOWEST * numbers.typical_speed) - 1.0 / numbers.typical_speed)


@kernel
def law_tune(tables, state, t):
    """Law of a tile: D + z h h^T and its slope for every pair of coordinates, turned ahead."""
    band, law, touch, coordinates = state.band, state.law, state.touch, len(tables.shape)
    omega, sweep = lanes(band, t, row.OMEGA), lanes(band, t, row.SWEEP)
    cos, sin = lanes(law, t, row.AHEAD_RE), lanes(law, t, row.AHEAD_IM)
    touching = read(touch, row.KNOWN)  # 1 where the finger is on, else 0
    place = read(touch, row.KNOWN_PLACE)
    skin, drag = touching * read(touch, row.MASS), touching * read(touch, row.DAMPING)
    z_re, z_im = finger_stiffness(touch, band, t)
    lag = 0.0 * drag
    if tables.numbers.memory > 0.0:
        lag = memory_damping(tables.numbers, state.track)
        drag = drag + lag
    for c in range(coordinates):
        for i in range(coordinates):
            arms = (1.0 if c == 0 else place) * (1.0 if i == 0 else place)
            mass, damping = read(tables.mass, c, i) + arms * skin, read(tables.damping, c, i) + arms * drag
            at = row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
            re = read(tables.stiffness, c, i) - omega * omega * read(tables.mass, c, i) + arms * touching * z_re
            im = omega * read(tables.damping, c, i) + arms * (touching * z_im + omega * lag) + sweep * mass
            put(law, t, at + row.LAW_RE, re * cos - im * sin)
            put(law, t, at + row.LAW_IM, re * sin + im * cos)
            turn = 2.0 * omega * mass
            put(law, t, at + row.SLOPE_RE, damping * cos - turn * sin)
            put(law, t, at + row.SLOPE_IM, damping * sin + turn * cos)


@kernel
def law_settled(tables, state, t):
    """What a target that stays makes known of a tile's force: D R, and D' + T D, for what a sample tells.

    With E and v of the last sample the force is D (R + v) - ki (D' + T D) E, and a residual e of this one adds
    -ki g Re (D' + T D) e, as the carriers are of length 1.
    """
    band, law, ahead = state.band, state.law, state.ahead
    coordinates, period = len(tables.shape), 1.0 / tables.numbers.rate
    r_re, r_im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
    for c in range(coordinates):
        re = im = 0.0 * r_re
        at = c * (2 + 2 * coordinates)
        for i in range(coordinates):
            base = row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
            d_re, d_im = lanes(law, t, base + row.LAW_RE), lanes(law, t, base + row.LAW_IM)
            re += tables.shape[i] * d_re
            im += tables.shape[i] * d_im
            put(ahead, t, at + 2 + 2 * i, lanes(law, t, base + row.SLOPE_RE) + period * d_re)
            put(ahead, t, at + 3 + 2 * i, lanes(law, t, base + row.SLOPE_IM) + period * d_im)
        put(ahead, t, at, re * r_re - im * r_im)
        put(ahead, t, at + 1, re * r_im + im * r_re)


@kernel
def answer_settled(tables, state):
    """What the force of all settled tiles answers to a residual, and a quarter turn ahead, for each two coordinates."""
    band, coordinates = state.band, len(tables.shape)
    for c in range(coordinates):
        for i in range(coordinates):
            force = quarter = 0.0
            for t in range(band.shape[0]):
                at, live = (2 + 2 * coordinates) * c + 2 + 2 * i, lanes(band, t, row.LIVE)
                force += live * lanes(state.ahead, t, at)
                quarter += live * lanes(state.ahead, t, at + 1)
            force, quarter = totals(read(state.touch, row.TRUST), force, quarter)
            write(force, state.answer, c, i)
            write(quarter, state.answer, coordinates + c, i)


@late
def settle_law(tables, state):
    """What settled samples need of the law; see `law_settled`."""
    for t in range(state.band.shape[0]):
        law_settled(tables, state, t)
    answer_settled(tables, state)


@kernel
def know_finger(tables, state, touching, turn):
    """Take what is known of the finger into the law: where contact changed, and in its turn; at once where it moves."""
    touch = state.touch
    known = select(touching, 1.0, 0.0)
    due = size(known - read(touch, row.KNOWN)) > 0.5
    if turn:
        due = due | touching
    write(known, touch, row.KNOWN)
    write(select(due, read(touch, row.PLACE), read(touch, row.KNOWN_PLACE)), touch, row.KNOWN_PLACE)
    if any_of(due) or state.follows[0] > 0:
        retune(tables, state, due)


@late
def retune(tables, state, due):
    """Law of the tiles that follow the finger, and of all where it is `due`."""
    for t in range(state.band.shape[0]):
        if state.pace[t] == row.LOCKED:
            look_ahead(tables.numbers, state.band, state.law, t)
        if any_of(due) or state.pace[t] == row.LOCKED:
            law_tune(tables, state, t)
    if state.follows[1] == 0:
        settle_law(tables, state)


@kernel
def law_pass(tables, state):
    """F = D V + D' dV/dt + j dw/dt M V, finger included, turned ahead by delay and hold; adds to the force."""
    band, loop, law, coordinates = state.band, state.loop, state.law, len(tables.shape)
    for c in range(coordinates):
        force = across = 0.0
        for t in range(band.shape[0]):
            re = im = 0.0
            for i in range(coordinates):
                base, at = i * row.LOOP_ROWS, row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
                for d, v in ((row.LAW_RE, row.COMMAND_RE), (row.SLOPE_RE, row.SLOPED_RE)):
                    d_re, d_im = lanes(law, t, at + d), lanes(law, t, at + d + 1)
                    v_re, v_im = lanes(loop, t, base + v), lanes(loop, t, base + v + 1)
                    re += d_re * v_re  # term by term: each is one instruction
                    re -= d_im * v_im
                    im += d_re * v_im
                    im += d_im * v_re
            cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
            force += re * cos
            force -= im * sin
            across += re * sin
            across += im * cos
        along, quarter = totals(read(state.touch, row.TRUST), force, across)
        write(read(state.residual, row.FORCE, c) + along, state.residual, row.FORCE, c)
        write(quarter, state.residual, row.QUADRATURE, c)
