"""The finger as the band bank learns it: from the force that acted, as late and as smooth as the motion it meets.

What the observer shows answers a drive that was commanded a delay ago, and it shows the motion behind its pole.  The
heave row of the force balance (FACTS section 3) holds as well for envelopes that are all late and smooth alike, <.>.
With z the finger's dynamic stiffness, h = [1, g] its place, y = h V, a = X - V what the command did not do, and
D_a = D + j w b_a with what the inner loop damps of that,

    z_found h X = <z_sent y> - D_a a - (D' + z' h) da/dt - j dw/dt (M + m_f h) a

so that what the law knew when it commanded is told apart from what has been learnt since: neither delay nor observer
closes a loop through the adaptation, which does not swing and need not be slow.  It goes in steps: a block, or some
samples.  A target R that moves is told apart alike: X = <R> + E where the observer watches the error.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import high, low, select, total
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import finger_stiffness
from hapticrender.control.bank.law import memory_damping

ADAPTATION = 8  # samples of a turn, in which the finger is learnt once
FORGOTTEN = 0.9  # of what was before a carrier was all there, until it teaches


@kernel
def in_a_turn(pole):
    """Pole of first order for a turn of samples, of that for one."""
    keep = left = 1.0 - pole
    for _ in range(ADAPTATION - 1):
        left = left * keep
    return 1.0 - left


@kernel
def begin_finger(tables, state, changed):
    """A touch, or a lift-off: what was learnt of one finger is not the next; what was commanded knew of none."""
    band, loop, sent, touch = state.band, state.loop, state.sent, state.touch
    for i in (row.MASS, row.DAMPING, row.STIFFNESS):
        write(select(changed, 0.0, read(touch, i)), touch, i)
    for t in range(band.shape[0]):
        for r in (row.REST_RE, row.REST_IM):
            put(band, t, r, select(changed, 0.0, lanes(band, t, r)))
        for r in range(sent.shape[1]):
            put(sent, t, r, select(changed, 0.0, lanes(sent, t, r)))
        put(sent, t, row.SHOWN_OMEGA, select(changed, lanes(band, t, row.OMEGA), lanes(sent, t, row.SHOWN_OMEGA)))
        put(sent, t, row.SHOWN_WHOLE, select(changed, 1.0, lanes(sent, t, row.SHOWN_WHOLE)))
        for r in range(2):
            wanted = lanes(band, t, row.R_RE + r)
            put(sent, t, row.SHOWN_R_RE + r, select(changed, wanted, lanes(sent, t, row.SHOWN_R_RE + r)))
        for c in range(len(tables.shape)):
            for r in range(2):
                base = c * row.LOOP_ROWS + r
                v = lanes(loop, t, base + row.V_RE)
                apart = lanes(loop, t, base + row.E_RE) - v
                v += tables.shape[c] * lanes(band, t, row.R_RE + r)
                put(loop, t, base + row.L_RE, select(changed, v, lanes(loop, t, base + row.L_RE)))
                put(loop, t, base + row.LAST_RE, select(changed, apart, lanes(loop, t, base + row.LAST_RE)))
                for at in range(row.SHOWN_ROWS + 2 * c + r, sent.shape[1], row.SENT_ROWS):
                    put(sent, t, at, select(changed, v, lanes(sent, t, at)))


@kernel
def slot_of(state, step):
    """First row of `sent` for a step."""
    return row.SHOWN_ROWS + step % ((state.sent.shape[1] - row.SHOWN_ROWS) // row.SENT_ROWS) * row.SENT_ROWS


@kernel
def send_finger(tables, state, t, step):
    """Note what is commanded of a tile in a step: the integral parts, and the finger's share of the force."""
    sent, touch, at = state.sent, state.touch, slot_of(state, step)
    re = im = 0.0 * lanes(sent, t, 0)
    for c in range(len(tables.shape)):
        base, place = c * row.LOOP_ROWS, 1.0 if c == 0 else read(touch, row.KNOWN_PLACE)
        v_re, v_im = lanes(state.loop, t, base + row.COMMAND_RE), lanes(state.loop, t, base + row.COMMAND_IM)
        put(sent, t, at + 2 * c, v_re)
        put(sent, t, at + 2 * c + 1, v_im)
        re += place * v_re
        im += place * v_im
    z_re, z_im = finger_stiffness(touch, state.band, t)
    put(sent, t, at + row.FORCE_RE, z_re * re - z_im * im)
    put(sent, t, at + row.FORCE_IM, z_re * im + z_im * re)


@kernel
def show_finger(tables, state, t, step, rate, pole, middle):
    """What was sent of a tile, as it acted in this step (of `rate` a second) and as the observer shows it.

    So is the frequency.  Commands run on between the noted ones: in the middle of the step it was between two.
    """
    sent, loop = state.sent, state.loop
    back = int(tables.numbers.age + 0.5)
    late, new, old = tables.numbers.age + middle - back, slot_of(state, step - back), slot_of(state, step - back - 1)
    for r in range(2):
        for c in range(len(tables.shape)):
            acted, base = lanes(sent, t, new + 2 * c + r), c * row.LOOP_ROWS + row.L_RE + r
            acted += late * (lanes(sent, t, old + 2 * c + r) - acted)
            shown = lanes(loop, t, base)
            put(loop, t, base, shown + pole * (acted - shown))
        acted = lanes(sent, t, new + row.FORCE_RE + r)
        acted += late * (lanes(sent, t, old + row.FORCE_RE + r) - acted)
        shown = lanes(sent, t, row.SHOWN_RE + r)
        put(sent, t, row.SHOWN_RE + r, shown + pole * (acted - shown))
        wanted = lanes(state.band, t, row.SEEN_RE + r)  # where the signal is observed, behind its pole as it is
        if tables.numbers.error_observer:
            wanted = lanes(state.band, t, row.R_RE + r) - middle / rate * lanes(state.band, t, row.DR_RE + r)
            shown = lanes(sent, t, row.SHOWN_R_RE + r)
            wanted = shown + pole * (wanted - shown)
        put(sent, t, row.SHOWN_R_RE + r, wanted)
    omega = lanes(state.band, t, row.OMEGA) - middle / rate * lanes(state.band, t, row.SWEEP)
    whole = (lanes(state.band, t, row.RAMP) >= 1.0) & (lanes(state.band, t, row.SHARE) >= 1.0)
    shown = lanes(sent, t, row.SHOWN_OMEGA)
    put(sent, t, row.SHOWN_OMEGA, select(whole, shown + pole * (omega - shown), omega))
    shown = lanes(sent, t, row.SHOWN_WHOLE)
    put(sent, t, row.SHOWN_WHOLE, select(whole, shown + pole * (1.0 - shown), 0.0))


@kernel
def find_finger(tables, state, t, rate, inner):
    """The finger's motion h X of a tile, and its force z_found h X; steps are of `rate` a second."""
    band, loop, touch, sent = state.band, state.loop, state.touch, state.sent
    omega, sweep = lanes(sent, t, row.SHOWN_OMEGA), lanes(band, t, row.SWEEP)
    felt_re = felt_im = 0.0 * omega
    re, im = lanes(sent, t, row.SHOWN_RE), lanes(sent, t, row.SHOWN_IM)
    lag = 0.0 * read(touch, row.TRUST)
    if tables.numbers.memory > 0.0:
        lag = memory_damping(tables.numbers, state.track)
    for c in range(len(tables.shape)):
        base, shape, place = c * row.LOOP_ROWS, tables.shape[c], 1.0 if c == 0 else read(touch, row.PLACE)
        x_re = lanes(loop, t, base + row.E_RE) + shape * lanes(sent, t, row.SHOWN_R_RE)
        x_im = lanes(loop, t, base + row.E_IM) + shape * lanes(sent, t, row.SHOWN_R_IM)
        felt_re += place * x_re
        felt_im += place * x_im
        a_re, a_im = x_re - lanes(loop, t, base + row.L_RE), x_im - lanes(loop, t, base + row.L_IM)
        da_re = rate * (a_re - lanes(loop, t, base + row.LAST_RE))
        da_im = rate * (a_im - lanes(loop, t, base + row.LAST_IM))
        put(loop, t, base + row.LAST_RE, a_re)
        put(loop, t, base + row.LAST_IM, a_im)
        mass, damping = read(tables.mass, 0, c), read(tables.damping, 0, c) + place * lag
        drag, skin = damping + place * read(touch, row.DAMPING), mass + place * read(touch, row.MASS)
        d_re, d_im = read(tables.stiffness, 0, c) - omega * omega * mass, omega * damping + sweep * skin
        if c == 0:
            d_im += inner * omega * read(tables.grip, 0)
        turn = 2.0 * omega * skin
        re -= d_re * a_re - d_im * a_im + drag * da_re - turn * da_im
        im -= d_re * a_im + d_im * a_re + drag * da_im + turn * da_re
    return felt_re, felt_im, re, im


@kernel
def adapt_finger(tables, state, rate, inner, gain, rest, touching):
    """The finger's three numbers, pooled over bands, and what is left of each band's stiffness."""
    numbers, touch, band, step = tables.numbers, state.touch, state.band, 1.0 / rate
    stiff2, mass2 = numbers.typical_stiffness * numbers.typical_stiffness, numbers.typical_mass * numbers.typical_mass
    stiffness, mass, damping = read(tables.stiffness, 0, 0), read(tables.mass, 0, 0), read(tables.damping, 0, 0)
    sum_k = sum_m = sum_b = weights = 0.0
    for t in range(band.shape[0]):
        felt_re, felt_im, re, im = find_finger(tables, state, t, rate, inner)
        omega, size2 = lanes(state.sent, t, row.SHOWN_OMEGA), felt_re * felt_re + felt_im * felt_im
        omega2 = omega * omega
        counts = (size2 >= numbers.least_motion * numbers.least_motion) & touching
        counts = counts & (lanes(state.sent, t, row.SHOWN_WHOLE) >= FORGOTTEN)
        share = 1.0 / select(counts, size2, 1.0)
        miss = share * (re * felt_re + im * felt_im) - read(touch, row.STIFFNESS) + omega2 * read(touch, row.MASS)
        drag = share * (im * felt_re - re * felt_im) - omega * read(touch, row.DAMPING)
        along = stiffness - omega2 * mass
        weight = select(counts, size2 / (along * along + omega2 * damping * damping), 0.0)
        scale = weight / (stiff2 + omega2 * omega2 * mass2)
        sum_k += scale * stiff2 * miss
        sum_m += scale * omega2 * mass2 * miss
        sum_b += weight * drag / select(counts, omega, 1.0)
        weights += weight
        for r, value in ((row.REST_RE, miss), (row.REST_IM, drag)):
            old = lanes(band, t, r)
            put(band, t, r, select(counts, old + step * rest * (value - old), old))
    like = read(touch, row.TRUST)
    pooled = total(like, weights)
    step = step * gain / select(pooled > 0.0, pooled, 1.0)
    found = read(touch, row.STIFFNESS) + step * total(like, sum_k)
    write(low(high(found, numbers.least_stiffness), numbers.most_stiffness), touch, row.STIFFNESS)
    found = read(touch, row.MASS) - step * total(like, sum_m)
    write(low(high(found, numbers.least_mass), numbers.most_mass), touch, row.MASS)
    found = read(touch, row.DAMPING) + step * total(like, sum_b)
    write(low(high(found, numbers.least_damping), numbers.most_damping), touch, row.DAMPING)


@kernel
def learn_finger(tables, state, step, rate, pole, middle, inner, gain, rest, touching):
    """A step of learning: what was sent, as it shows, and what it tells of the finger."""
    for t in range(state.band.shape[0]):
        show_finger(tables, state, t, step, rate, pole, middle)
    adapt_finger(tables, state, rate, inner, gain, rest, touching)
