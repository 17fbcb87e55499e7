"""The finger as the band bank knows it: its motion, its touch, and three numbers that stand for its mechanics."""

from __future__ import annotations

from hapticrender._jit import kernel
from hapticrender._lanes import any_of, high, low, select, size, total
from hapticrender._lanes_memory import lanes, put, read, write
from hapticrender.control import bank_rows as row
from hapticrender.control.kernels import FAR, FASTEST, TURN

TRACKER_POLE = TURN * 60.0  # rad/s: triple pole of the finger's tracker; no lag under constant acceleration
FRESH_TIME = 0.03  # s: for so long after a touch a friction is told from its step
LEAST_LOAD = 0.03  # N: a place is not told by less


@kernel
def track_finger(track, rate, position):
    """Velocity and acceleration of the finger by a tracker with a triple pole; a new touch starts it at rest."""
    period = 1.0 / rate
    pole = TRACKER_POLE * period
    seen, held = read(track, row.SEEN), read(track, row.HELD)
    leapt = (seen > 0.0) & (size(position - held) * rate > FASTEST)
    here = select(leapt, 0.0, select(size(position) <= FAR, 1.0, 0.0))
    present = here > 0.0  # else lifted, or put down elsewhere
    position = select(present, position, held)
    smooth, velocity, acceleration = read(track, row.SMOOTH), read(track, row.VELOCITY), read(track, row.ACCELERATION)
    predicted = select(seen > 0.0, smooth, position) + period * velocity
    innovation = position - predicted
    write(select(present, predicted + 3.0 * pole * innovation, smooth), track, row.SMOOTH)
    faster = velocity + period * acceleration + 3.0 * pole * TRACKER_POLE * innovation
    write(select(present, faster, 0.0), track, row.VELOCITY)
    steeper = acceleration + pole * TRACKER_POLE * TRACKER_POLE * innovation
    write(select(present, steeper, 0.0), track, row.ACCELERATION)
    write(position, track, row.HELD)
    write(here, track, row.SEEN)
    moved = select(present & (seen > 0.0), size(position - held) * rate, 0.0)
    speed = read(track, row.SPEED)
    write(select(leapt, 0.0, speed + pole * (moved - speed)), track, row.SPEED)
    came = present & ((seen <= 0.0) | leapt)
    write(select(came, FRESH_TIME * rate, high(read(track, row.FRESH) - 1.0, 0.0)), track, row.FRESH)


@kernel
def feel(numbers, coordinates, stiffness, level, touch):
    """Load and place of the finger from the sag (the DC band); true where contact has just begun or ended."""
    load = moment = 0.0 * read(level, 0, 0)
    for c in range(coordinates):
        load -= read(stiffness, 0, c) * read(level, 0, c)
        if coordinates > 1:
            moment -= read(stiffness, 1, c) * read(level, 0, c)
    was, place = read(touch, row.CONTACT), read(touch, row.PLACE)
    on = select(load > select(was > 0.0, numbers.contact_off, numbers.contact_on), 1.0, 0.0)
    write(load, touch, row.LOAD)
    write(on, touch, row.CONTACT)
    if any_of(on > 0.0):
        write(select(on > 0.0, low(high(moment / high(load, LEAST_LOAD), -2.0), 2.0), place), touch, row.PLACE)
    return size(on - was) > 0.5


@kernel
def forget_finger(changed, touch, band, loop):
    """Touch or lift-off: what was learnt of one finger does not hold for the next."""
    for i in (row.MASS, row.DAMPING, row.STIFFNESS):
        write(select(changed, 0.0, read(touch, i)), touch, i)
    for t in range(band.shape[0]):
        for r in (row.REST_RE, row.REST_IM):
            put(band, t, r, select(changed, 0.0, lanes(band, t, r)))
        for base in range(0, loop.shape[1], row.LOOP_ROWS):
            for r in range(2):
                apart = lanes(loop, t, base + row.E_RE + r) - lanes(loop, t, base + row.L_RE + r)
                put(loop, t, base + row.LAST_RE + r, select(changed, apart, lanes(loop, t, base + row.LAST_RE + r)))


@kernel
def finger_stiffness(touch, band, t):
    """Dynamic stiffness z (N/m) of the finger at a tile's bands: its three numbers and what is left over."""
    omega = lanes(band, t, row.OMEGA)
    re = read(touch, row.STIFFNESS) - omega * omega * read(touch, row.MASS) + lanes(band, t, row.REST_RE)
    return re, omega * read(touch, row.DAMPING) + lanes(band, t, row.REST_IM)


@kernel
def adapt_pass(tables, state, step, inner, gain, rest, touching):
    """The finger's three numbers, pooled over bands, and what is left of each band's stiffness, from the heave row.

    `step` is the time since the last adaptation, s.
    """
    touch, band, loop, coordinates = state.touch, state.band, state.loop, len(tables.shape)
    numbers = tables.numbers
    stiff2, mass2 = numbers.typical_stiffness * numbers.typical_stiffness, numbers.typical_mass * numbers.typical_mass
    sum_k = sum_m = sum_b = weights = 0.0
    for t in range(band.shape[0]):
        omega = lanes(band, t, row.OMEGA)
        felt_re = felt_im = own_re = own_im = away_re = away_im = 0.0 * omega
        for c in range(coordinates):
            base = c * row.LOOP_ROWS
            mass, damping = read(tables.mass, 0, c), read(tables.damping, 0, c)
            place = 1.0 if c == 0 else read(touch, row.PLACE)
            e_re, e_im = lanes(loop, t, base + row.E_RE), lanes(loop, t, base + row.E_IM)
            l_re, l_im = lanes(loop, t, base + row.L_RE), lanes(loop, t, base + row.L_IM)
            w_re, w_im = tables.shape[c] * lanes(band, t, row.SEEN_RE), tables.shape[c] * lanes(band, t, row.SEEN_IM)
            felt_re, felt_im = felt_re + place * (w_re + e_re), felt_im + place * (w_im + e_im)
            own_re, own_im = own_re + place * (w_re + l_re), own_im + place * (w_im + l_im)
            a_re, a_im = e_re - l_re, e_im - l_im
            da_re = (a_re - lanes(loop, t, base + row.LAST_RE)) / step
            da_im = (a_im - lanes(loop, t, base + row.LAST_IM)) / step
            put(loop, t, base + row.LAST_RE, select(touching, a_re, lanes(loop, t, base + row.LAST_RE)))
            put(loop, t, base + row.LAST_IM, select(touching, a_im, lanes(loop, t, base + row.LAST_IM)))
            d_re, d_im = read(tables.stiffness, 0, c) - omega * omega * mass, omega * damping
            if c == 0:
                d_im += inner * omega * read(tables.grip, 0)
            turn = 2.0 * omega * mass
            away_re += d_re * a_re - d_im * a_im + damping * da_re - turn * da_im
            away_im += d_re * a_im + d_im * a_re + damping * da_im + turn * da_re
        size2 = felt_re * felt_re + felt_im * felt_im
        whole = (lanes(band, t, row.RAMP) >= 1.0) & (lanes(band, t, row.SHARE) >= 1.0)
        counts = (size2 >= numbers.least_motion * numbers.least_motion) & whole & touching
        z_re, z_im = finger_stiffness(touch, band, t)
        re, im = z_re * own_re - z_im * own_im - away_re, z_re * own_im + z_im * own_re - away_im
        safe = select(counts, size2, 1.0)
        found_re, found_im = (re * felt_re + im * felt_im) / safe, (im * felt_re - re * felt_im) / safe
        omega2 = omega * omega
        free_re, free_im = read(tables.stiffness, 0, 0) - omega2 * read(tables.mass, 0, 0), read(tables.damping, 0, 0)
        weight = select(counts, size2 / (free_re * free_re + omega2 * free_im * free_im), 0.0)
        miss = found_re - read(touch, row.STIFFNESS) + omega2 * read(touch, row.MASS)
        drag = found_im - omega * read(touch, row.DAMPING)
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
