"""The finger as the bank in blocks learns it: from the force that acted, as late and as smooth as the motion it meets.

A block's residuals meet a drive that was commanded one or more blocks ago, and the observer shows the motion behind its
pole.  The heave row of the force balance (FACTS section 3) holds as well for envelopes that are all late and smooth
alike, <.>.  With z the finger's dynamic stiffness, h = [1, g] its place, y = h V, and a = X - V what the command did
not do,

    z_found h X = <z_sent y> - D a - (D' + z' h) da/dt - j dw/dt (M + m_f h) a

so that what the law knew when it commanded is told apart from what has been learnt since: neither delay nor observer
closes a loop through the adaptation, which does not swing and need not be slow.
"""

from __future__ import annotations

from hapticrender._jit import kernel
from hapticrender._lanes import high, low, select, total
from hapticrender._lanes_memory import lanes, put
from hapticrender.control import bank_rows as row
from hapticrender.control.bank_finger import finger_stiffness
from hapticrender.control.block_state import FORCE_IM, FORCE_RE, SENT_ROWS, SHOWN_IM, SHOWN_OMEGA, SHOWN_RE, SHOWN_ROWS


@kernel
def begin_finger(coordinates, state):
    """A touch, or a lift-off: what was commanded so far knew of no finger."""
    sent, loop, slots = state.sent, state.bank.loop, past_blocks(state)
    for t in range(sent.shape[0]):
        for r in range(sent.shape[1]):
            put(sent, t, r, 0.0 * lanes(sent, t, r))
        put(sent, t, SHOWN_OMEGA, lanes(state.bank.band, t, row.OMEGA))
        for c in range(coordinates):
            for r in range(2):
                base = c * row.LOOP_ROWS + r
                v = lanes(loop, t, base + row.V_RE)
                put(loop, t, base + row.L_RE, v)
                put(loop, t, base + row.LAST_RE, lanes(loop, t, base + row.E_RE) - v)
                for slot in range(slots):
                    put(sent, t, SHOWN_ROWS + slot * SENT_ROWS + 2 * c + r, v)


@kernel
def past_blocks(state):
    """How many blocks of the past `sent` holds."""
    return (state.sent.shape[1] - SHOWN_ROWS) // SENT_ROWS


@kernel
def send_finger(tables, state, t):
    """Note what has been commanded of a tile: the integral parts, and the finger's share of the force."""
    bank, sent, touch, shape = state.bank, state.sent, state.bank.touch, tables.bank.shape
    at = SHOWN_ROWS + bank.sample[0] % past_blocks(state) * SENT_ROWS
    re = im = 0.0 * lanes(sent, t, 0)
    for c in range(len(shape)):
        base, place = c * row.LOOP_ROWS, 1.0 if c == 0 else touch[row.KNOWN_PLACE]
        v_re, v_im = lanes(bank.loop, t, base + row.V_RE), lanes(bank.loop, t, base + row.V_IM)
        put(sent, t, at + 2 * c, v_re)
        put(sent, t, at + 2 * c + 1, v_im)
        re += place * (shape[c] * lanes(bank.band, t, row.R_RE) + v_re)
        im += place * (shape[c] * lanes(bank.band, t, row.R_IM) + v_im)
    z_re, z_im = finger_stiffness(touch, bank.band, t)
    put(sent, t, at + FORCE_RE, z_re * re - z_im * im)
    put(sent, t, at + FORCE_IM, z_re * im + z_im * re)


@kernel
def show_finger(tables, state, t, pole):
    """What was sent of a tile, as it acted in this block and as the observer shows it; and the frequency of that.

    The drive ran linearly from one command to the next: in the middle of the block it was between the two.
    """
    sent, bank = state.sent, state.bank
    slots, whole = past_blocks(state), int(tables.age)
    late, slot = tables.age - whole, bank.sample[0] - whole
    new, old = SHOWN_ROWS + slot % slots * SENT_ROWS, SHOWN_ROWS + (slot - 1) % slots * SENT_ROWS
    for r in range(2):
        for c in range(len(tables.bank.shape)):
            acted = lanes(sent, t, new + 2 * c + r)
            acted += late * (lanes(sent, t, old + 2 * c + r) - acted)
            shown = lanes(bank.loop, t, c * row.LOOP_ROWS + row.L_RE + r)
            put(bank.loop, t, c * row.LOOP_ROWS + row.L_RE + r, shown + pole * (acted - shown))
        acted = lanes(sent, t, new + FORCE_RE + r)
        acted += late * (lanes(sent, t, old + FORCE_RE + r) - acted)
        shown = lanes(sent, t, SHOWN_RE + r)
        put(sent, t, SHOWN_RE + r, shown + pole * (acted - shown))
    omega = lanes(bank.band, t, row.OMEGA) - 0.5 / tables.bank.numbers.rate * lanes(bank.band, t, row.SWEEP)
    shown = lanes(sent, t, SHOWN_OMEGA)
    put(sent, t, SHOWN_OMEGA, shown + pole * (omega - shown))


@kernel
def find_finger(tables, state, t):
    """The finger's motion h X of a tile, and its force z_found h X."""
    band, loop, touch = state.bank.band, state.bank.loop, state.bank.touch
    omega, sweep, rate = lanes(state.sent, t, SHOWN_OMEGA), lanes(band, t, row.SWEEP), tables.bank.numbers.rate
    felt_re = felt_im = 0.0 * omega
    re, im = lanes(state.sent, t, SHOWN_RE), lanes(state.sent, t, SHOWN_IM)
    for c in range(len(tables.bank.shape)):
        base, shape, place = c * row.LOOP_ROWS, tables.bank.shape[c], 1.0 if c == 0 else touch[row.PLACE]
        e_re, e_im = lanes(loop, t, base + row.E_RE), lanes(loop, t, base + row.E_IM)
        felt_re += place * (shape * lanes(band, t, row.SEEN_RE) + e_re)
        felt_im += place * (shape * lanes(band, t, row.SEEN_IM) + e_im)
        a_re, a_im = e_re - lanes(loop, t, base + row.L_RE), e_im - lanes(loop, t, base + row.L_IM)
        da_re = rate * (a_re - lanes(loop, t, base + row.LAST_RE))
        da_im = rate * (a_im - lanes(loop, t, base + row.LAST_IM))
        put(loop, t, base + row.LAST_RE, a_re)
        put(loop, t, base + row.LAST_IM, a_im)
        mass, damping = tables.bank.mass[0, c], tables.bank.damping[0, c]
        drag, skin = damping + place * touch[row.DAMPING], mass + place * touch[row.MASS]
        d_re, d_im = tables.bank.stiffness[0, c] - omega * omega * mass, omega * damping + sweep * skin
        turn = 2.0 * omega * skin
        re -= d_re * a_re - d_im * a_im + drag * da_re - turn * da_im
        im -= d_re * a_im + d_im * a_re + drag * da_im + turn * da_re
    return felt_re, felt_im, re, im


@kernel
def adapt_finger(tables, state, gain, rest):
    """The finger's three numbers, pooled over bands, and what is left of each band's stiffness."""
    numbers, touch, band = tables.bank.numbers, state.bank.touch, state.bank.band
    stiff2, mass2 = numbers.typical_stiffness * numbers.typical_stiffness, numbers.typical_mass * numbers.typical_mass
    stiffness, mass, damping = tables.bank.stiffness[0, 0], tables.bank.mass[0, 0], tables.bank.damping[0, 0]
    sum_k = sum_m = sum_b = weights = 0.0
    for t in range(band.shape[0]):
        felt_re, felt_im, re, im = find_finger(tables, state, t)
        omega, size2 = lanes(state.sent, t, SHOWN_OMEGA), felt_re * felt_re + felt_im * felt_im
        omega2 = omega * omega
        counts = (size2 >= numbers.least_motion * numbers.least_motion) & (lanes(band, t, row.RAMP) >= 1.0)
        counts = counts & (lanes(band, t, row.SHARE) >= 1.0)
        safe = select(counts, size2, 1.0)
        miss = (re * felt_re + im * felt_im) / safe - touch[row.STIFFNESS] + omega2 * touch[row.MASS]
        drag = (im * felt_re - re * felt_im) / safe - omega * touch[row.DAMPING]
        along = stiffness - omega2 * mass
        weight = select(counts, size2 / (along * along + omega2 * damping * damping), 0.0)
        scale = weight / (stiff2 + omega2 * omega2 * mass2)
        sum_k += scale * stiff2 * miss
        sum_m += scale * omega2 * mass2 * miss
        sum_b += weight * drag / select(counts, omega, 1.0)
        weights += weight
        for r, value in ((row.REST_RE, miss), (row.REST_IM, drag)):
            old = lanes(band, t, r)
            put(band, t, r, select(counts, old + rest / numbers.rate * (value - old), old))
    pooled = total(1.0, weights)
    step = gain / numbers.rate / (pooled if pooled > 0.0 else 1.0)
    found = touch[row.STIFFNESS] + step * total(1.0, sum_k)
    touch[row.STIFFNESS] = low(high(found, numbers.least_stiffness), numbers.most_stiffness)
    found = touch[row.MASS] - step * total(1.0, sum_m)
    touch[row.MASS] = low(high(found, numbers.least_mass), numbers.most_mass)
    found = touch[row.DAMPING] + step * total(1.0, sum_b)
    touch[row.DAMPING] = low(high(found, numbers.least_damping), numbers.most_damping)
