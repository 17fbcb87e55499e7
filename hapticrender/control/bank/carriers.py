"""Carriers of the band bank: their tones, phases and weights, and the law that holds at their frequencies.

A tile's lanes are bands of one scenario, or one band of as many scenarios; only taking up the tones differs.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import by_types, kernel
from hapticrender.compiled.lanes import floor, high, low, select, size, total
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import finger_stiffness
from hapticrender.control.kernels import TURN

FORGET = 50.0  # 1/s: a carrier near 0 Hz is forgotten, not followed
SLOWEST = 0.1  # of the typical speed: a slower contact hardly modulates at all
REFRESH = 64  # samples between two looks at the tones that are asked for


@kernel
def count_turns(phase, k, step):
    """Phase of carrier k in turns, now; in whole 2^-64 turns, so that it never drifts; then counts on."""
    turns = turns_of(phase[k])
    phase[k] += advance_of(step)
    return turns


@kernel
def turns_of(phase):
    """Phase in turns, of one in whole 2^-64 turns."""
    return np.float64(phase >> np.uint64(11)) * 2.0**-53


@kernel
def advance_of(step):
    """What a carrier that turns by `step` a sample goes on by until the next look, in whole 2^-64 turns."""
    advance = REFRESH * (step - floor(step))
    return np.uint64((advance - floor(advance)) * 2.0**63) << np.uint64(1)


@kernel
def follow_resonance(tables, state):
    """Move the shift of the carriers towards the resonance, where Re D = 0: force and motion are a quarter turn apart.

    D is that of the device with what was learnt of force and motion; near a resonance w0 of the mass m it is
    2 m w (w0 - w) + j Im D.  The lock is lost while they are more than an eighth of a turn from a quarter turn.
    """
    numbers, touch, band = tables.numbers, state.touch, state.band
    omega = band[0, row.OMEGA, 0]
    if omega == 0.0:
        return
    mass = tables.mass[0, 0] + touch[row.MASS]
    along = tables.stiffness[0, 0] + touch[row.STIFFNESS] - omega * omega * mass
    across = omega * (tables.damping[0, 0] + touch[row.DAMPING])
    hertz = along / (2.0 * TURN * mass * omega)
    state.shift[0] += low(numbers.lock * REFRESH / numbers.rate, 1.0) * hertz
    re, im = band[0, row.R_RE, 0], band[0, row.R_IM, 0]
    heard = re * re + im * im > numbers.least_motion * numbers.least_motion
    state.shift[1] = 0.0 if heard and size(along) <= across else 1.0


@kernel
def take_bands(tables, state, t):
    """Tones of a tile whose lanes are bands; returns whether a target still grows, and whether one follows a finger."""
    tone, band, width = tables.tone, state.band, state.band.shape[2]
    grows = follows = False
    if tables.numbers.lock > 0.0 and t == 0:
        follow_resonance(tables, state)
    left = tone.shape[1] - t * width
    for i in range(width if left > width else left):
        k = t * width + i
        band[t, row.LIVE, i] = 1.0
        for r in range(row.TONE_ROWS):
            band[t, row.FREQUENCY + r, i] = tone[r, k]
        band[t, row.FREQUENCY, i] += state.shift[0]
        band[t, row.TURNS, i] = count_turns(state.phase, k, (tone[0, k] + state.shift[0]) / tables.numbers.rate)
        if band[t, row.RAMP, i] < 1.0 or band[t, row.R_RE, i] != tone[3, k] or band[t, row.R_IM, i] != tone[4, k]:
            grows = True
        follows = follows or tone[1, k] > 0.0 or tables.numbers.presence
    return grows, follows


@kernel
def take_scenarios(tables, state, t):
    """The same where lanes are scenarios and a tile is a band of each; `tone` is (bands, TONE_ROWS, W)."""
    tone, band, width = tables.tone, state.band, state.band.shape[2]
    grows = follows = False
    for i in range(width):
        band[t, row.LIVE, i] = 1.0
        for r in range(row.TONE_ROWS):
            band[t, row.FREQUENCY + r, i] = tone[t, r, i]
        band[t, row.TURNS, i] = count_turns(state.phase, t * width + i, tone[t, 0, i] / tables.numbers.rate)
        if band[t, row.RAMP, i] < 1.0 or band[t, row.R_RE, i] != tone[t, 3, i] or band[t, row.R_IM, i] != tone[t, 4, i]:
            grows = True
        follows = follows or tone[t, 1, i] > 0.0 or tables.numbers.presence
    return grows, follows


@by_types
def take(tables, state, t):
    """Which of the two fits the shape of `tables.tone`."""
    return take_bands if tables[tables.fields.index("tone")].ndim == 2 else take_scenarios


@kernel
def refresh(tables, state):
    """Take up the tones that are asked for, and what stays for the next samples: law, turn, settled targets."""
    numbers, band = tables.numbers, state.band
    state.follows[0] = state.follows[1] = 0
    for t in range(band.shape[0]):
        grows, follows = take(tables, state, t)
        if follows:
            state.pace[t] = row.LOCKED
            state.follows[0] += 1
            state.follows[1] += 1
            continue
        still = not (grows or numbers.analysed or numbers.modulated) and numbers.error_observer
        state.pace[t] = row.STEADY if still else row.GROWING
        frequency = lanes(band, t, row.FREQUENCY)
        cos, sin = unit(1.0 / numbers.rate * frequency)
        put(band, t, row.TURN_COS, cos)
        put(band, t, row.TURN_SIN, sin)
        put(band, t, row.OMEGA, TURN * frequency)
        look_ahead(numbers, band, state.law, t)
        law_tune(tables, state, t)
        cos, sin = unit(lanes(band, t, row.TURNS) + lanes(band, t, row.PHASE))
        put(band, t, row.COS, lanes(band, t, row.LIVE) * cos)
        put(band, t, row.SIN, lanes(band, t, row.LIVE) * sin)
        if still:
            put(band, t, row.DR_RE, 0.0 * lanes(band, t, row.DR_RE))
            put(band, t, row.DR_IM, 0.0 * lanes(band, t, row.DR_IM))
            law_settled(tables, state, t)
        else:
            state.follows[1] += 1
    if state.follows[1] == 0:
        answer_settled(tables, state)


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
    band, law, coordinates, period = state.band, state.law, len(tables.shape), 1.0 / tables.numbers.rate
    r_re, r_im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
    for c in range(coordinates):
        re = im = 0.0 * r_re
        at = row.FIRST_LAW + row.LAW_ROWS * coordinates * coordinates + c * (2 + 2 * coordinates)
        for i in range(coordinates):
            base = row.FIRST_LAW + row.LAW_ROWS * (c * coordinates + i)
            d_re, d_im = lanes(law, t, base + row.LAW_RE), lanes(law, t, base + row.LAW_IM)
            re += tables.shape[i] * d_re
            im += tables.shape[i] * d_im
            put(law, t, at + 2 + 2 * i, lanes(law, t, base + row.SLOPE_RE) + period * d_re)
            put(law, t, at + 3 + 2 * i, lanes(law, t, base + row.SLOPE_IM) + period * d_im)
        put(law, t, at, re * r_re - im * r_im)
        put(law, t, at + 1, re * r_im + im * r_re)


@kernel
def answer_settled(tables, state):
    """What the force of all settled tiles answers to a residual, for every pair of coordinates."""
    band, law, coordinates = state.band, state.law, len(tables.shape)
    for c in range(coordinates):
        at = row.FIRST_LAW + row.LAW_ROWS * coordinates * coordinates + c * (2 + 2 * coordinates)
        for i in range(coordinates):
            found = 0.0
            for t in range(band.shape[0]):
                found += lanes(band, t, row.LIVE) * lanes(law, t, at + 2 + 2 * i)
            write(total(read(state.touch, row.TRUST), found), state.answer, c, i)


@kernel
def derivative(band, t, re, im):
    """Envelope of the time derivative: j w times that of a tile's carriers."""
    omega = lanes(band, t, row.OMEGA)
    return -omega * im, omega * re


@kernel
def shown_pass(numbers, band, track, t, re, im):
    """What the sensor shows of a wanted envelope of a tile: before the contact's lag, and late."""
    omega = lanes(band, t, row.OMEGA)
    lag = numbers.foresight / high(read(track, row.SPEED), SLOWEST * numbers.typical_speed) * omega
    cos, sin = unit(-numbers.late / TURN * omega)
    re, im = re - lag * im, im + lag * re
    return re * cos - im * sin, re * sin + im * cos


@kernel
def told_pass(numbers, band, track, t, re, im):
    """What is wanted of a tile where the sensor shows re + j im: the inverse of `shown_pass`."""
    omega = lanes(band, t, row.OMEGA)
    lag = numbers.foresight / high(read(track, row.SPEED), SLOWEST * numbers.typical_speed) * omega
    cos, sin = unit(numbers.late / TURN * omega)
    re, im = re * cos - im * sin, re * sin + im * cos
    share = 1.0 / (1.0 + lag * lag)
    return share * (re + lag * im), share * (im - lag * re)


@kernel
def ease(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = low(high(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def turn_pass(tables, state, t):
    """Turn the fixed carriers of a tile on to this sample; `refresh` keeps them exact."""
    band = state.band
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    turn_cos, turn_sin = lanes(band, t, row.TURN_COS), lanes(band, t, row.TURN_SIN)
    put(band, t, row.COS, cos * turn_cos - sin * turn_sin)
    put(band, t, row.SIN, sin * turn_cos + cos * turn_sin)


@kernel
def grow_pass(tables, state, t):
    """Weight of the fixed carriers of a tile while their targets grow."""
    band = state.band
    ramp = low(lanes(band, t, row.RAMP) + tables.numbers.ramp, 1.0)
    weight = lanes(band, t, row.LIVE) * ease(ramp)
    put(band, t, row.RAMP, ramp)
    put(band, t, row.WEIGHT, weight)
    put(band, t, row.SHARE, low(weight / high(ramp, 1e-9), 1.0))


@kernel
def motion_pass(numbers, band, track, t):
    """Frequency, sweep and weight of a tile whose carriers follow the finger."""
    wavenumber = lanes(band, t, row.WAVENUMBER)
    hertz = lanes(band, t, row.FREQUENCY) + wavenumber * read(track, row.VELOCITY)
    put(band, t, row.OMEGA, TURN * hertz)
    put(band, t, row.SWEEP, TURN * wavenumber * read(track, row.ACCELERATION))
    felt = read(track, row.SEEN) > 0.0
    if numbers.presence:
        felt = felt & (read(track, row.SPEED) >= numbers.least_speed)
    else:
        felt = (wavenumber == 0.0) | felt
    ramp = lanes(band, t, row.RAMP)
    ramp = select(felt, low(ramp + numbers.ramp, 1.0), high(ramp - numbers.ramp, 0.0))
    steep = 1.0 / (numbers.highest_edge - 1.0)
    below = ease(steep * numbers.highest_edge - steep / numbers.highest * size(hertz))
    heard = ease(4.0 * numbers.highest_edge - 4.0 / numbers.highest * size(hertz))  # to a wide fade's end, or nearly
    above = select(wavenumber > 0.0, ease(2.0 / numbers.lowest * size(hertz) - 1.0), 1.0)
    grown = lanes(band, t, row.LIVE) * ease(ramp) * above
    put(band, t, row.RAMP, ramp)
    put(band, t, row.WEIGHT, grown * select(wavenumber > 0.0, below, 1.0))
    put(band, t, row.SHARE, low(grown * select(wavenumber > 0.0, heard, 1.0) / high(ramp, 1e-9), 1.0))


@kernel
def locked_pass(tables, state, t):
    """Carriers, weights and law of a tile that follows the finger."""
    numbers, band, track = tables.numbers, state.band, state.track
    wavenumber = lanes(band, t, row.WAVENUMBER)
    turns = lanes(band, t, row.TURNS)
    cos, sin = unit(turns + wavenumber * read(track, row.HELD) + lanes(band, t, row.PHASE))
    put(band, t, row.TURNS, turns + 1.0 / numbers.rate * lanes(band, t, row.FREQUENCY))
    put(band, t, row.COS, lanes(band, t, row.LIVE) * cos)
    put(band, t, row.SIN, lanes(band, t, row.LIVE) * sin)
    motion_pass(numbers, band, track, t)


@kernel
def carrier_pass(tables, state, fresh):
    """Phase, frequency, sweep and weight of every carrier; carriers that are `fresh` stand where they belong."""
    for t in range(state.band.shape[0]):
        if state.pace[t] == row.LOCKED:
            locked_pass(tables, state, t)
        else:
            if not fresh:
                turn_pass(tables, state, t)
            if state.pace[t] == row.GROWING:
                grow_pass(tables, state, t)
