"""The finger as the bank in blocks learns it: from the force that acted, as late and as smooth as the motion it meets.

A block's residuals meet the drive of one or more blocks ago, and the observer shows them behind its pole.  The heave
row of the force balance holds for envelopes that are all delayed and low-passed alike (FACTS section 3, point 5), with
f = z y + z' dy/dt the finger's share of the command at the law's own z, and a = X - V what the command did not do:

    z_found y_p = <z y_V> - D a - (D' + z' h) da/dt

What the law knew when it commanded is so told apart from what it has learnt since: neither the delay nor the observer's
pole closes a loop through the adaptation, and it does not swing.
"""

from __future__ import annotations

from hapticrender._jit import kernel
from hapticrender._lanes import high, low, select, total
from hapticrender._lanes_memory import lanes, put
from hapticrender.control import bank_rows as row
from hapticrender.control.bank_finger import finger_stiffness
from hapticrender.control.block_state import FORCE_IM, FORCE_RE, SENT_ROWS


@kernel
def smooth_pass(tables, state, t, slot, before, share, pole, coordinates):
    """Integral parts and the finger's force of a tile, as they acted in this block and as the observer shows them."""
    sent, loop = state.sent, state.bank.loop
    first, second = slot * SENT_ROWS, before * SENT_ROWS
    for c in range(coordinates):
        for r in range(2):
            acted = (1.0 - share) * lanes(sent, t, first + 2 * c + r) + share * lanes(sent, t, second + 2 * c + r)
            at = c * row.LOOP_ROWS + row.L_RE + r
            slow = lanes(loop, t, at)
            put(loop, t, at, slow + pole * (acted - slow))
    last = sent.shape[1] - 3
    for r in range(2):
        acted = (1.0 - share) * lanes(sent, t, first + FORCE_RE + r) + share * lanes(sent, t, second + FORCE_RE + r)
        slow = lanes(sent, t, last + r)
        put(sent, t, last + r, slow + pole * (acted - slow))
    omega = lanes(state.bank.band, t, row.OMEGA) - 0.5 / tables.bank.numbers.rate * lanes(state.bank.band, t, row.SWEEP)
    slow = lanes(sent, t, last + 2)
    put(sent, t, last + 2, slow + pole * (omega - slow))


@kernel
def send_pass(tables, state, t, slot):
    """Note what is commanded of a tile: integral parts, and the finger's share of the force."""
    bank, sent, touch = state.bank, state.sent, state.bank.touch
    re = im = 0.0 * lanes(sent, t, 0)
    for c in range(len(tables.bank.shape)):
        base, place = c * row.LOOP_ROWS, 1.0 if c == 0 else touch[row.KNOWN_PLACE]
        put(sent, t, slot * SENT_ROWS + 2 * c, lanes(bank.loop, t, base + row.V_RE))
        put(sent, t, slot * SENT_ROWS + 2 * c + 1, lanes(bank.loop, t, base + row.V_IM))
        w_re, w_im = tables.bank.shape[c] * lanes(bank.band, t, row.R_RE), tables.bank.shape[c] * lanes(bank.band, t, row.R_IM)
        re, im = re + place * (w_re + lanes(bank.loop, t, base + row.V_RE)), im + place * (w_im + lanes(bank.loop, t, base + row.V_IM))
    z_re, z_im = finger_stiffness(touch, bank.band, t)
    put(sent, t, slot * SENT_ROWS + FORCE_RE, touch[row.KNOWN] * (z_re * re - z_im * im))
    put(sent, t, slot * SENT_ROWS + FORCE_IM, touch[row.KNOWN] * (z_re * im + z_im * re))


@kernel
def begin(state, coordinates):
    """A touch: what was sent before knew of no finger."""
    sent, loop = state.sent, state.bank.loop
    slots = (sent.shape[1] - 3) // SENT_ROWS
    for t in range(sent.shape[0]):
        for r in range(sent.shape[1]):
            put(sent, t, r, 0.0 * lanes(sent, t, r))
        put(sent, t, sent.shape[1] - 1, lanes(state.bank.band, t, row.OMEGA))
        for c in range(coordinates):
            base = c * row.LOOP_ROWS
            for r in range(2):
                v = lanes(loop, t, base + row.V_RE + r)
                put(loop, t, base + row.L_RE + r, v)
                put(loop, t, base + row.LAST_RE + r, lanes(loop, t, base + row.E_RE + r) - v)
                for slot in range(slots):
                    put(sent, t, slot * SENT_ROWS + 2 * c + r, v)


@kernel
def adapt_block(tables, state, gain, rest):
    """The finger's three numbers, pooled over bands, and what is left of each band's stiffness."""
    bank, numbers = state.bank, tables.bank.numbers
    touch, band, loop, sent = bank.touch, bank.band, bank.loop, state.sent
    step = 1.0 / numbers.rate
    stiff2, mass2 = numbers.typical_stiffness * numbers.typical_stiffness, numbers.typical_mass * numbers.typical_mass
    sum_k = sum_m = sum_b = weights = 0.0
    last = sent.shape[1] - 3
    for t in range(band.shape[0]):
        omega, sweep = lanes(sent, t, last + 2), lanes(band, t, row.SWEEP)
        felt_re = felt_im = away_re = away_im = 0.0 * omega
        for c in range(len(tables.bank.shape)):
            base, shape = c * row.LOOP_ROWS, tables.bank.shape[c]
            mass, damping = tables.bank.mass[0, c], tables.bank.damping[0, c]
            place = 1.0 if c == 0 else touch[row.PLACE]
            e_re, e_im = lanes(loop, t, base + row.E_RE), lanes(loop, t, base + row.E_IM)
            felt_re += place * (shape * lanes(band, t, row.SEEN_RE) + e_re)
            felt_im += place * (shape * lanes(band, t, row.SEEN_IM) + e_im)
            a_re, a_im = e_re - lanes(loop, t, base + row.L_RE), e_im - lanes(loop, t, base + row.L_IM)
            da_re = numbers.rate * (a_re - lanes(loop, t, base + row.LAST_RE))
            da_im = numbers.rate * (a_im - lanes(loop, t, base + row.LAST_IM))
            put(loop, t, base + row.LAST_RE, a_re)
            put(loop, t, base + row.LAST_IM, a_im)
            d_re, d_im = tables.bank.stiffness[0, c] - omega * omega * mass, omega * damping + sweep * (mass + place * touch[row.MASS])
            drag, turn = damping + place * touch[row.DAMPING], 2.0 * omega * (mass + place * touch[row.MASS])
            away_re += d_re * a_re - d_im * a_im + drag * da_re - turn * da_im
            away_im += d_re * a_im + d_im * a_re + drag * da_im + turn * da_re
        size2 = felt_re * felt_re + felt_im * felt_im
        whole = (lanes(band, t, row.RAMP) >= 1.0) & (lanes(band, t, row.SHARE) >= 1.0)
        counts = (size2 >= numbers.least_motion * numbers.least_motion) & whole
        re, im = lanes(sent, t, last) - away_re, lanes(sent, t, last + 1) - away_im
        safe = select(counts, size2, 1.0)
        found_re, found_im = (re * felt_re + im * felt_im) / safe, (im * felt_re - re * felt_im) / safe
        omega2 = omega * omega
        free_re, free_im = tables.bank.stiffness[0, 0] - omega2 * tables.bank.mass[0, 0], tables.bank.damping[0, 0]
        weight = select(counts, size2 / (free_re * free_re + omega2 * free_im * free_im), 0.0)
        miss = found_re - touch[row.STIFFNESS] + omega2 * touch[row.MASS]
        drag = found_im - omega * touch[row.DAMPING]
        scale = weight / (stiff2 + omega2 * omega2 * mass2)
        sum_k += scale * stiff2 * miss
        sum_m += scale * omega2 * mass2 * miss
        sum_b += weight * drag / select(counts, omega, 1.0)
        weights += weight
        for r, value in ((row.REST_RE, miss), (row.REST_IM, drag)):
            old = lanes(band, t, r)
            put(band, t, r, select(counts, old + step * rest * (value - old), old))
    pooled = total(1.0, weights)
    step = step * gain / (pooled if pooled > 0.0 else 1.0)
    found = touch[row.STIFFNESS] + step * total(1.0, sum_k)
    touch[row.STIFFNESS] = low(high(found, numbers.least_stiffness), numbers.most_stiffness)
    found = touch[row.MASS] - step * total(1.0, sum_m)
    touch[row.MASS] = low(high(found, numbers.least_mass), numbers.most_mass)
    found = touch[row.DAMPING] + step * total(1.0, sum_b)
    touch[row.DAMPING] = low(high(found, numbers.least_damping), numbers.most_damping)
