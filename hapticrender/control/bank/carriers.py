"""Carriers of the band bank: their tones, phases and weights.

A tile's lanes are bands of one scenario, or one band of as many scenarios; only taking up the tones differs.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import by_types, kernel, late
from hapticrender.compiled.lanes import floor, high, low, select, size
from hapticrender.compiled.lanes_memory import lanes, put, read
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.finger import track_finger
from hapticrender.control.bank.law import law_tune, look_ahead, settle_law
from hapticrender.control.kernels import TURN

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


@late
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
def still_grows(band, t, i):
    """Whether a band's target is not yet what is asked for."""
    apart = band[t, row.R_RE, i] != band[t, row.WANTED_RE, i] or band[t, row.R_IM, i] != band[t, row.WANTED_IM, i]
    return apart or band[t, row.RAMP, i] < 1.0


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
        grows = grows or still_grows(band, t, i)
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
        grows = grows or still_grows(band, t, i)
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
        else:
            state.follows[1] += 1
    if state.follows[1] == 0:
        settle_law(tables, state)


@kernel
def ease(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = low(high(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def turn_pass(band, t):
    """Turn the fixed carriers of a tile on to this sample and return them; `refresh` keeps them exact."""
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    turn_cos, turn_sin = lanes(band, t, row.TURN_COS), lanes(band, t, row.TURN_SIN)
    cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
    put(band, t, row.COS, cos)
    put(band, t, row.SIN, sin)
    return cos, sin


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


@late
def follow_finger(tables, state, position):
    """The finger's motion, and the carriers that follow it."""
    track_finger(state.track, tables.numbers.rate, position)
    for t in range(state.band.shape[0]):
        if state.pace[t] == row.LOCKED:
            locked_pass(tables, state, t)


@kernel
def carrier_pass(tables, state, fresh):
    """Phase and weight of every fixed carrier; carriers that are `fresh` stand where they belong."""
    for t in range(state.band.shape[0]):
        if state.pace[t] != row.LOCKED and not fresh:
            turn_pass(state.band, t)
        if state.pace[t] == row.GROWING:
            grow_pass(tables, state, t)
