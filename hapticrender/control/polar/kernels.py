"""Compiled tick of the paper's controller (Grigorii et al. 2021): polar loops on the STDFT*, or on the boxcar STDFT.

Symbols: psi carrier phase, X envelope of a coordinate, R wanted envelope, A and Theta commanded amplitude and phase.  A
carrier that runs backwards (the finger reverses) is followed as its mirror image: x = Re X e^{j phi} =
Re conj(X) e^{-j phi}, so that psi always runs forward and every complex state is conjugated at the reversal.

Everything that a band owns is a column of rows that are named here, W columns to a tile (`compiled.lanes`).  What
all tiles share is written down before; blocks are in `passes`.  A tile's columns are bands of one scenario, or one band
of as many scenarios, of which each has its own share (`batch`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, high, low, root, select, size
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs, read, taken, write
from hapticrender.compiled.polynomials import polar, unit
from hapticrender.control.bank.carriers import advance_of, turns_of
from hapticrender.control.kernels import (
    DOUBT_TIME,
    FAR,
    FASTEST,
    QUIET,
    TURN,
    Section,
)
from hapticrender.protocols import Array

VELOCITY_POLE = 40.0  # Hz: smoothing of the finger's velocity, used only to look up gains and to fade
GATE_TIME = 0.02  # s: finger-locked targets fade in and out with contact
REFRESH = 64  # samples between two looks at the tones; a block is cut there, too

# rows of PolarState.band: what was asked for; fixed part of the carrier (turns) and its turn a sample; its direction
# (+1, -1); the wanted envelope, its amplitude and direction (that of the last target that was not silence); the frame,
# a direction that the carrier (COS, SIN) has been turned by, see `turn_frame`; phase of a fixed carrier turned by it at
# the last refresh (turns); low-pass states of the wanted waveform; frequency of a carrier that follows the finger (Hz);
# 1 where something is wanted, else 0, and four times that, as of a fixed carrier's last refresh
LIVE, FREQUENCY, WAVENUMBER, PHASE, WANTED_RE, WANTED_IM = range(6)
TURNS, COS, SIN, TURN_COS, TURN_SIN, FORWARD = range(6, 12)
TARGET_RE, TARGET_IM, AMOUNT, HEADING_RE, HEADING_IM, FRAME_RE, FRAME_IM, FRAME, START = range(12, 21)
REF_RE1, REF_RE2, REF_IM1, REF_IM2, HERTZ, SOUNDS, FOUR_SOUNDS = range(21, 28)
BAND_ROWS = 28
# rows of PolarState.loop, LOOP_ROWS for each coordinate: low-pass states, states of amplitude and phase loop, X over
# the frame; drive per metre from the look-up table, and the device's lag (rad); amplitude and phase of X on their way;
# drive per command where the carrier is fixed, b0 of the law times that per metre
RE1, RE2, IM1, IM2, AMPLITUDE1, AMPLITUDE2, THETA1, THETA2, X_RE, X_IM, DRIVE, LAG, FOUND, BEHIND, VOICE = range(15)
LOOP_ROWS = 15
# entries of PolarState.finger
HELD, VELOCITY, GATE, SEEN = range(4)
# rows of PolarState.shared, one column a sample of a block: what all tiles are told; then one row a coordinate
WANTED, TRUST, PLACE, SPEED, OPENING = range(5)
SHARED_ROWS = 5


class PolarNumbers(NamedTuple):
    """What all bands share."""

    rate: float
    feedback: bool  # False: nothing is sensed, drive straight from the look-up table
    analysed: bool  # True: targets come from the wanted waveform
    drive_limit: float
    sensed_limit: float  # beyond it a sensor is not believed
    lowest: float  # Hz
    highest: float  # Hz
    floor: float  # m: least command amplitude, 0; naive: -inf
    subtract: bool  # naive: phase of X minus phase of R, each with its own seam
    filter: Section  # low pass of the STDFT*, both zeros at half the rate
    law: Section  # loop controller, both zeros at half the rate, a pole at 1
    table_step: float  # Hz
    lead: float  # s: known delay and half the hold


class PolarTables(NamedTuple):
    """Parameters of the polar controller."""

    numbers: PolarNumbers
    tone: Array  # (5, bands)
    listen: Array  # (coordinates, sensors)
    speak: Array  # (channels, coordinates)
    gain: Array  # (coordinates, table), m per drive unit; scenario by scenario where they are side by side
    lag: Array  # the same, rad: phase of the free device


class PolarState(NamedTuple):
    """State of the polar controller; changed in place.  Side by side `finger`, `doubt` and `shared` end in W."""

    band: Array  # (tiles, BAND_ROWS, W)
    loop: Array  # (tiles, coordinates * LOOP_ROWS, W)
    phase: Array  # (bands,) uint64: fixed part of each carrier at the next refresh, 2^64 a turn
    advance: Array  # (bands,) uint64: how far it goes until then
    counted: Array  # (bands,) Hz: the frequency that `advance` is made of
    locked: Array  # (tiles,) integer: 1 where a carrier of the tile follows the finger
    finger: Array  # (4,) held position (m), velocity (m/s), gate 0..1, seen before (0 or 1)
    doubt: Array  # (1,) 0: the sensors are believed, 1: they are not
    sample: Array  # (1,) integer: samples so far
    shared: Array  # (SHARED_ROWS + coordinates, REFRESH) scratch
    told: Array  # (1 + 2 coordinates, REFRESH) scratch of a block's passes, in the precision of the bands
    scratch: Array  # (1 + 2 coordinates, REFRESH, W) scratch of theirs, see `passes`
    sum: Array  # (coordinates, REFRESH, W) scratch, 0: drive of each coordinate, not yet summed over the lanes
    window: Array  # (length, tiles * 2 * coordinates, W) boxcar: what was heard; of length 0 with the STDFT*
    heap: Array  # (2, tiles * 2 * coordinates, W) its running sum, and one summed afresh


@kernel
def section_step(section, state1, state2, gain, four, x):
    """Low pass with both zeros at half the rate, b0 (1 + z^-1)^2; `gain` is b0 and what else x is to be multiplied by.

    In powers of z - 1, where poles near 1 keep their place in single precision.  `four` is 4 gain.  Returns output and
    new states.
    """
    y, slow = gain * x + state1, four * x + state2
    return y, state1 + slow - (2.0 + section[3]) * y, slow - (1.0 + section[3] + section[4]) * y


@kernel
def law_step(law, state1, state2, weight, four, x):
    """The same with a pole at 1 and, for want of b0, an output of 1/b0; x counts by its weight, 1 or 0."""
    y, slow = weight * x + state1, four * x + state2
    return y, state1 + slow - (2.0 + law[3]) * y, slow


@kernel
def clamped_step(law, state1, state2, x, floor):
    """`law_step` whose output stops at `floor`, and whose states know it; what waits for the output comes last."""
    free, slow = x + state1, 4.0 * x + state2
    y = high(free, floor)
    held = y - free
    return y, 2.0 * held + (state1 + slow - (2.0 + law[3]) * y), slow + held


@kernel
def lookup(table, row, step, frequency):
    """Linear interpolation in a table over frequency."""
    at = min(frequency / step, table.shape[1] - 1.000001)
    i = int(at)
    return table[row, i] + (at - i) * (table[row, i + 1] - table[row, i])


@kernel
def look_up(tables, state, t, i, frequency):
    """What the table says of band i of a tile at `frequency`; scenarios have tables of their own."""
    coordinates, step = tables.listen.shape[0], tables.numbers.table_step
    many = tables.gain.shape[0] // coordinates
    for c in range(coordinates):
        at, row = c * LOOP_ROWS, i % many * coordinates + c
        state.loop[t, at + DRIVE, i] = 1.0 / lookup(tables.gain, row, step, frequency)
        state.loop[t, at + LAG, i] = lookup(tables.lag, row, step, frequency)


@kernel
def aim(band, t, re, im):
    """Take up a wanted envelope: its amplitude, and its direction where it is no silence."""
    amount = root(re * re + im * im)
    sounds = amount > QUIET
    safe = select(sounds, amount, 1.0)
    put(band, t, TARGET_RE, re)
    put(band, t, TARGET_IM, im)
    put(band, t, AMOUNT, amount)
    put(band, t, HEADING_RE, select(sounds, re / safe, lanes(band, t, HEADING_RE)))
    put(band, t, HEADING_IM, select(sounds, im / safe, lanes(band, t, HEADING_IM)))


@kernel
def in_frames(numbers, state):
    """Whether fixed carriers may be counted from what is wanted: it is constant, and the STDFT* listens."""
    return numbers.feedback and not numbers.analysed and not numbers.subtract and state.window.shape[0] == 0


@kernel
def turn_frame(state, t, aimed):
    """Count a tile from the direction of what is wanted, which then is 1, or from 1; its low passes turn with it.

    X/R then is the low pass's own output, and no sample has to turn it.
    """
    band, loop = state.band, state.loop
    old_re, old_im = lanes(band, t, FRAME_RE), lanes(band, t, FRAME_IM)
    h_re, h_im = lanes(band, t, HEADING_RE), lanes(band, t, HEADING_IM)
    one = 1.0 + 0.0 * h_re
    re, im = (h_re, h_im) if aimed else (one, 0.0 * one)
    if any_of(size(re - old_re) + size(im - old_im) > 0.0):
        by_re, by_im = old_re * re + old_im * im, old_im * re - old_re * im
        for base in range(0, loop.shape[1], LOOP_ROWS):
            for r in (0, 1):
                x, y = lanes(loop, t, base + RE1 + r), lanes(loop, t, base + IM1 + r)
                put(loop, t, base + RE1 + r, x * by_re - y * by_im)
                put(loop, t, base + IM1 + r, x * by_im + y * by_re)
        put(band, t, FRAME_RE, re)
        put(band, t, FRAME_IM, im)
        put(band, t, FRAME, (1.0 / TURN) * polar(im, re)[1])


@kernel
def count_on(tables, state, t, count):
    """Phases of a tile's carriers, now, as `count_turns` counts them; how far they go changes with the tones only."""
    band, start = state.band, t * state.band.shape[2]
    own = slice(start, start + count)
    phase, advance, counted, frequency = state.phase[own], state.advance[own], state.counted[own], tables.tone[0, own]
    for i in range(count):
        if frequency[i] != counted[i]:  # in double precision, unlike the bands
            counted[i] = frequency[i]
            advance[i] = advance_of(frequency[i] / tables.numbers.rate)
    for i in range(count):
        band[t, TURNS, i] = turns_of(phase[i])
        phase[i] += advance[i]


@kernel
def take_tones(tables, state, t):
    """Tones of a tile, as they are asked for now; their phases, and look-ups where they are new.

    Returns whether what is wanted may have changed.
    """
    tone, band, width, start = tables.tone, state.band, state.band.shape[2], t * state.band.shape[2]
    count, known = min(width, tone.shape[1] - start), state.locked[t] == 0
    if known and count == width:  # at most of the refreshes nothing is new
        now = taken(tone, 0, start, lanes(band, t, FREQUENCY))
        known = not any_of((lanes(band, t, LIVE) <= 0.0) | (size(now - lanes(band, t, FREQUENCY)) > 0.0))
        re, im = taken(tone, 3, start, now), taken(tone, 4, start, now)
        off = size(re - lanes(band, t, WANTED_RE)) + size(im - lanes(band, t, WANTED_IM))
        changed = any_of(off + size(taken(tone, 1, start, now) - lanes(band, t, WAVENUMBER)) > 0.0)
        for r in range(1, tone.shape[0]):
            put(band, t, FREQUENCY + r, taken(tone, r, start, now))
        state.locked[t] = 1 if any_of(lanes(band, t, WAVENUMBER) > 0.0) else 0
    else:
        state.locked[t], changed = 0, True
        for i in range(count):
            frequency = band[t, FREQUENCY, i]
            for r in range(tone.shape[0]):
                band[t, FREQUENCY + r, i] = tone[r, start + i]
            known = known and band[t, LIVE, i] > 0.0 and band[t, FREQUENCY, i] == frequency
            if tone[1, start + i] > 0.0:
                state.locked[t] = 1
    count_on(tables, state, t, count)
    if not known:
        for i in range(count):
            band[t, LIVE, i], band[t, FREQUENCY, i] = 1.0, tone[0, start + i]
            look_up(tables, state, t, i, tone[0, start + i])
        cos, sin = unit(1.0 / tables.numbers.rate * lanes(band, t, FREQUENCY))
        put(band, t, TURN_COS, cos)
        put(band, t, TURN_SIN, sin)
    return changed or not known


@kernel
def stay(law, band, loop, t):
    """What the law of a tile takes from a target that stays: whether it sounds, and drive per command."""
    sounds = select(lanes(band, t, AMOUNT) > QUIET, 1.0, 0.0 * lanes(band, t, AMOUNT))
    put(band, t, SOUNDS, sounds)
    put(band, t, FOUR_SOUNDS, 4.0 * sounds)
    for base in range(0, loop.shape[1], LOOP_ROWS):
        put(loop, t, base + VOICE, law[0] * lanes(loop, t, base + DRIVE))


@kernel
def refresh(tables, state):
    """Take up the tones that are asked for; phases and look-ups of fixed carriers, whose targets stay if constant."""
    numbers, band = tables.numbers, state.band
    for t in range(band.shape[0]):
        changed, fixed = take_tones(tables, state, t), state.locked[t] == 0
        if changed and fixed and not numbers.analysed:
            aim(band, t, lanes(band, t, WANTED_RE), lanes(band, t, WANTED_IM))
        if changed or not fixed or numbers.analysed:
            turn_frame(state, t, fixed and in_frames(numbers, state))
        if fixed:
            live, turns = lanes(band, t, LIVE), lanes(band, t, TURNS) + lanes(band, t, PHASE)
            re, im = lanes(band, t, FRAME_RE), lanes(band, t, FRAME_IM)
            cos, sin = unit(turns)
            put(band, t, COS, live * (cos * re - sin * im))
            put(band, t, SIN, live * (sin * re + cos * im))
            put(band, t, START, turns + lanes(band, t, FRAME))
            stay(numbers.law, band, state.loop, t)


@kernel
def smoothed(rate, velocity, speed):
    """Velocity (m/s) of a finger a sample later, behind its low pass."""
    return velocity + (1.0 - math.exp(-TURN * VELOCITY_POLE / rate)) * (speed - velocity)


@kernel
def follow_finger(rate, held, velocity, gate, seen, position):
    """Hold the position while the finger is away, smooth its velocity, open the gate with contact."""
    stays = (seen <= 0.0) | (size(position - held) * rate <= FASTEST)
    here = (size(position) <= FAR) & stays
    speed = select(here & (seen > 0.0), (position - held) * rate, 0.0)
    velocity = smoothed(rate, velocity, speed)
    ramp = 1.0 / (GATE_TIME * rate)
    gate = select(here, low(gate + ramp, 1.0), high(gate - ramp, 0.0))
    return select(here, position, held), velocity, gate, select(here, 1.0, 0.0)


@kernel
def believed(value, limit):
    """What a sensor tells, or zero where it cannot show that."""
    return select(size(value) <= limit, value, 0.0)


@kernel
def share(tables, state, m, odd, position, wanted, known):
    """Write down what else all tiles are told of a sample; `odd` is 2 where a sensor is beyond its limit, else 0.

    `known` is what is known of finger and sensors, see `recall`.  Returns flags, as a float, and what is known now.
    """
    numbers, shared = tables.numbers, state.shared
    held, velocity, gate, seen, doubt = known
    if any_of((odd > 0.0) | (doubt > 0.0)):
        step = 1.0 / (DOUBT_TIME * numbers.rate)
        doubt = select(odd > 0.0, low(doubt + step, 1.0), high(doubt - step, 0.0))
    sane = size(wanted) <= FAR
    held, velocity, gate, seen = follow_finger(numbers.rate, held, velocity, gate, seen, position)
    write(select(sane, wanted, 0.0), shared, WANTED, m)
    write(1.0 - doubt, shared, TRUST, m)
    write(held, shared, PLACE, m)
    write(velocity, shared, SPEED, m)
    write(gate, shared, OPENING, m)
    odd = select(size(position) > FAR, 2.0, select(sane, odd, 2.0))
    return odd, (held, velocity, gate, seen, doubt)


@kernel
def recall(state):
    """What is known of finger and sensors: held position (m), velocity (m/s), gate, whether it was seen; doubt."""
    finger = state.finger
    return read(finger, HELD), read(finger, VELOCITY), read(finger, GATE), read(finger, SEEN), read(state.doubt, 0)


@kernel
def remember(state, known):
    """Keep what is known until the next block."""
    held, velocity, gate, seen, doubt = known
    write(held, state.finger, HELD)
    write(velocity, state.finger, VELOCITY)
    write(gate, state.finger, GATE)
    write(seen, state.finger, SEEN)
    write(doubt, state.doubt, 0)


@kernel
def mirror(band, loop, t, flip):
    """Conjugate every complex state of the bands whose carriers have turned round.

    The commanded phase stays: it makes up for the plant's lag at |f|, which does not care about the direction.
    """
    for r in (FORWARD, HEADING_IM, REF_IM1, REF_IM2):
        put(band, t, r, select(flip, -lanes(band, t, r), lanes(band, t, r)))
    for base in range(0, loop.shape[1], LOOP_ROWS):
        for r in (IM1, IM2):
            put(loop, t, base + r, select(flip, -lanes(loop, t, base + r), lanes(loop, t, base + r)))


@kernel
def follow(tables, state, t, m):
    """Carriers of a tile that follow the finger, their look-ups; returns the weight of their targets."""
    numbers, band, shared = tables.numbers, state.band, state.shared
    wavenumber, frequency = lanes(band, t, WAVENUMBER), lanes(band, t, FREQUENCY)
    hertz = frequency + wavenumber * read(shared, SPEED, m)
    flip = hertz * lanes(band, t, FORWARD) < 0.0
    if any_of(flip):
        mirror(band, state.loop, t, flip)
    turns, live = lanes(band, t, TURNS), lanes(band, t, LIVE)
    cos, sin = unit(turns + wavenumber * read(shared, PLACE, m) + lanes(band, t, PHASE))
    put(band, t, TURNS, turns + 1.0 / numbers.rate * frequency)
    put(band, t, COS, live * cos)
    put(band, t, SIN, live * lanes(band, t, FORWARD) * sin)
    put(band, t, HERTZ, size(hertz))
    for i in range(min(band.shape[2], tables.tone.shape[1] - t * band.shape[2])):
        look_up(tables, state, t, i, band[t, HERTZ, i])
    inside = low(high(2.0 / numbers.lowest * size(hertz) - 1.0, 0.0), 1.0)
    below = low(high(5.0 - 4.0 / numbers.highest * size(hertz), 0.0), 1.0)
    weight = inside * inside * (3.0 - 2.0 * inside) * below * below * (3.0 - 2.0 * below)
    return select(wavenumber > 0.0, weight * read(shared, OPENING, m), 1.0)


@kernel
def carry(tables, state, t, m, target):
    """Carriers and wanted envelopes of a tile: constant, or the wanted waveform through the same STDFT*."""
    numbers, band = tables.numbers, state.band
    weight = 1.0 + 0.0 * lanes(band, t, LIVE)
    if state.locked[t] > 0:
        weight = follow(tables, state, t, m)
    elif (state.sample[0] + m) % REFRESH > 0:
        cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
        turn_cos, turn_sin = lanes(band, t, TURN_COS), lanes(band, t, TURN_SIN)
        put(band, t, COS, cos * turn_cos - sin * turn_sin)
        put(band, t, SIN, sin * turn_cos + cos * turn_sin)
    forward = lanes(band, t, FORWARD)
    if numbers.analysed:
        twice = 2.0 * numbers.filter[0] * read(state.shared, WANTED, m)
        section, four = numbers.filter, 4.0 * twice
        re, s1, s2 = section_step(
            section, lanes(band, t, REF_RE1), lanes(band, t, REF_RE2), twice, four, lanes(band, t, COS)
        )
        put(band, t, REF_RE1, s1)
        put(band, t, REF_RE2, s2)
        im, s1, s2 = section_step(
            section, lanes(band, t, REF_IM1), lanes(band, t, REF_IM2), -twice, -four, lanes(band, t, SIN)
        )
        put(band, t, REF_IM1, s1)
        put(band, t, REF_IM2, s2)
        aim(band, t, weight * re, weight * im)
    elif state.locked[t] > 0:
        aim(band, t, weight * lanes(band, t, WANTED_RE), weight * forward * lanes(band, t, WANTED_IM))
    put_pairs(target, t, lanes(band, t, TARGET_RE), forward * lanes(band, t, TARGET_IM))


@kernel
def slide(window, heap, at, r, x):
    """Mean over the window (eq. 2); once a window its sum is replaced by one summed afresh, as rounding piles up."""
    running, afresh = lanes(heap, 0, r) + (x - lanes(window, at, r)), lanes(heap, 1, r) + x
    put(window, at, r, x)
    last = at == window.shape[0] - 1
    put(heap, 0, r, afresh if last else running)
    put(heap, 1, r, 0.0 * afresh if last else afresh)
    return (1.0 / window.shape[0]) * (afresh if last else running)


@kernel
def listen(tables, state, t, m, c):
    """STDFT* (eq. 1, 3, 4), or STDFT (eq. 1-3): envelopes X of coordinate c."""
    band, loop, base, window = state.band, state.loop, c * LOOP_ROWS, state.window
    twice, section = 2.0 * read(state.shared, SHARED_ROWS + c, m), tables.numbers.filter
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    if window.shape[0] > 0:  # it holds what it hears unmirrored, so that a carrier that turns round need not rewrite it
        at, r = (state.sample[0] + m) % window.shape[0], 2 * (t * tables.listen.shape[0] + c)
        forward = lanes(band, t, FORWARD)
        re = slide(window, state.heap, at, r, twice * cos)
        im = forward * slide(window, state.heap, at, r + 1, forward * (-twice * sin))
    else:
        gain = section[0] * twice
        re, s1, s2 = section_step(
            section, lanes(loop, t, base + RE1), lanes(loop, t, base + RE2), gain, 4.0 * gain, cos
        )
        put(loop, t, base + RE1, s1)
        put(loop, t, base + RE2, s2)
        im, s1, s2 = section_step(
            section, lanes(loop, t, base + IM1), lanes(loop, t, base + IM2), -gain, -4.0 * gain, sin
        )
        put(loop, t, base + IM1, s1)
        put(loop, t, base + IM2, s2)
    put(loop, t, base + X_RE, re)
    put(loop, t, base + X_IM, im)
    return re, im


@kernel
def answer(numbers, band, loop, t, base, x_re, x_im, h_re, h_im):
    """Amplitude and phase loops of a coordinate: commanded amplitude (m) and phase (rad)."""
    amount = lanes(band, t, AMOUNT)
    if numbers.subtract:
        found, phase = polar(x_im, x_re)
        lag = phase - polar(h_im, h_re)[1]
    else:  # phase of X against R, eq. 5 with the cut moved
        found, lag = polar(x_im * h_re - x_re * h_im, x_re * h_re + x_im * h_im)
    sounds = select(amount > QUIET, 1.0, 0.0 * amount)
    theta, s1, s2 = law_step(
        numbers.law, lanes(loop, t, base + THETA1), lanes(loop, t, base + THETA2), sounds, 4.0 * sounds, lag
    )
    put(loop, t, base + THETA1, s1)
    put(loop, t, base + THETA2, s2)
    error = amount - found  # eq. 3
    command, s1, s2 = clamped_step(
        numbers.law, lanes(loop, t, base + AMPLITUDE1), lanes(loop, t, base + AMPLITUDE2), error, numbers.floor
    )  # a negative one would be positive feedback
    put(loop, t, base + AMPLITUDE1, s1)
    put(loop, t, base + AMPLITUDE2, s2)
    return numbers.law[0] * command, -numbers.law[0] * theta


@kernel
def tile_step(tables, state, t, m, target):
    """One sample of a tile: adds the drive of its bands to each coordinate's sum."""
    numbers, band, loop = tables.numbers, state.band, state.loop
    carry(tables, state, t, m, target)
    lost = read(state.shared, TRUST, m) == 0.0
    if any_of(lost):  # the loops start anew
        for base in range(0, loop.shape[1], LOOP_ROWS):
            for r in range(DRIVE):
                put(loop, t, base + r, select(lost, 0.0, lanes(loop, t, base + r)))
    cos, sin = lanes(band, t, COS), lanes(band, t, SIN)
    f_re, f_im = lanes(band, t, FRAME_RE), lanes(band, t, FRAME_IM)
    re, im = lanes(band, t, HEADING_RE), lanes(band, t, HEADING_IM)
    h_re, h_im = re * f_re + im * f_im, im * f_re - re * f_im
    for c in range(tables.listen.shape[0]):
        base = c * LOOP_ROWS
        if numbers.feedback:
            x_re, x_im = listen(tables, state, t, m, c)
            command, theta = answer(numbers, band, loop, t, base, x_re, x_im, h_re, h_im)
        else:  # straight from the look-up table, turned ahead by delay and hold
            speed = lanes(band, t, WAVENUMBER) * read(state.shared, SPEED, m)
            now = size(lanes(band, t, FREQUENCY) + speed)
            command, theta = lanes(band, t, AMOUNT), TURN * numbers.lead * now - lanes(loop, t, base + LAG)
        u, v = unit((1.0 / TURN) * theta)
        carried = (h_re * u - h_im * v) * cos - (h_re * v + h_im * u) * sin
        put(state.sum, c, m, lanes(state.sum, c, m) + command * lanes(loop, t, base + DRIVE) * carried)
