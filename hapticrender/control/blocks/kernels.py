"""Compiled block of the band bank, for devices that take blocks of M samples: the per-sample observer, M at a time.

Over a block the envelopes are held; the residuals e_h that follow from them and those of the per-sample observer are
related by a unit lower-triangular Toeplitz matrix, e = Q e_h, whatever the number of bands (FACTS section 10):

    e[m] + sum_(j<m) r[m-j] e[j] = e_h[m],  r[d] = g_dc + (d - 1) g_drift + sum_k g_k cos(w_k d)

Then every envelope is updated once, the law is taken at the block's end for the moment its drive will act, and the
drive runs linearly from one block's envelope to the next.  Phases at the block's start are counted in double
precision.  Sums over bands and samples are in `sums`; everything that knows of finger, touch and trust is the
per-sample bank's own, called once a block.
"""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import any_of, floor, high, size, totals
from hapticrender.compiled.lanes_memory import lanes, put, put_pairs, put_stretch, stretch
from hapticrender.compiled.polynomials import unit
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.carriers import grow_pass, motion_pass
from hapticrender.control.bank.detectors import wake
from hapticrender.control.bank.finger import feel, track_finger
from hapticrender.control.bank.kernels import believe, forget
from hapticrender.control.bank.law import law_tune, look_ahead
from hapticrender.control.bank.learning import begin_finger, learn_finger
from hapticrender.control.bank.observer import FORGET
from hapticrender.control.bank.targets import derivative
from hapticrender.control.blocks.drive import answer
from hapticrender.control.blocks.state import (
    EIGHT,
    FAR_COS,
    FAR_SIN,
    GROUP,
    PAIR_COS,
    PAIR_ROWS,
    PAIR_SIN,
    PAIRS,
    TO_MIDDLE,
    TURN_COS,
    TURN_SIN,
    TURNED,
    TURNS,
)
from hapticrender.control.blocks.sums import correlate, respond, solve, sum_bands, turn_held
from hapticrender.control.kernels import FAR, TURN


@kernel
def count_phases(tables, state):
    """Phasors of the carriers where their tables begin; then their phases at the next block's start."""
    band, phase, carrier = state.bank.band, state.phase, state.carrier
    for i in range(phase.shape[0]):
        turns = lanes(phase, i, TURNS)
        cos, sin = unit(turns + lanes(phase, i, TO_MIDDLE))
        put_stretch(carrier, 0, i * EIGHT, cos)
        put_stretch(carrier, 1, i * EIGHT, sin)
        turns += lanes(phase, i, TURNED)
        put(phase, i, TURNS, turns - floor(turns))
    for t in range(band.shape[0]):
        live, first = lanes(band, t, row.LIVE), t * band.shape[2]
        put(band, t, row.COS, live * stretch(carrier, 0, first))
        put(band, t, row.SIN, live * stretch(carrier, 1, first))


@kernel
def follow_pass(tables, state, t):
    """Tables, weights and frequencies of a tile whose carriers follow the finger."""
    bank, block = state.bank, state.place.shape[0]
    band = bank.band
    wavenumber, frequency = lanes(band, t, row.WAVENUMBER), lanes(band, t, row.FREQUENCY)
    cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
    step = 1.0 / tables.sample.rate * frequency
    for m in range(block):
        u, v = unit(step * m + wavenumber * state.place[m])
        put(state.table, t, 2 * m, cos * u - sin * v)
        put(state.table, t, 2 * m + 1, cos * v + sin * u)
    put(band, t, row.COS, lanes(band, t, row.LIVE))
    put(band, t, row.SIN, 0.0 * sin)
    motion_pass(tables.bank.numbers, band, bank.track, t)


@kernel
def analyse(state, wanted):
    """Residuals of the bank that listens to the wanted waveform, into the last row."""
    band, last = state.bank.band, state.error.shape[0] - 1
    for t in range(band.shape[0]):
        turn_held(band, state.held, t, 0, lanes(band, t, row.RAW_RE), lanes(band, t, row.RAW_IM))
    sum_bands(state, 0, 0)
    for m in range(wanted.shape[0]):
        state.raw[last, m] = (wanted[m] if size(wanted[m]) <= FAR else 0.0) - state.sum[m, 0]
    solve(state, 1, last)


@kernel
def know(tables, state, touching):
    """Take what is known of the finger into the law; carriers that follow it as they will be when the drive acts."""
    bank, known = state.bank, 1.0 if touching else 0.0
    due = touching or known != bank.touch[row.KNOWN] or state.stale[0] > 0
    bank.touch[row.KNOWN], bank.touch[row.KNOWN_PLACE] = known, bank.touch[row.PLACE]
    for t in range(bank.band.shape[0]):
        follows = bank.pace[t] == row.LOCKED
        if follows or state.stale[0] > 0:
            look_ahead(tables.sample, bank.band, bank.law, t)
        if follows:
            omega = lanes(bank.band, t, row.OMEGA)
            put(bank.band, t, row.OMEGA, omega + tables.sample.lead * lanes(bank.band, t, row.SWEEP))
        if follows or due:
            law_tune(tables.bank, bank, t)


@kernel
def take_up(tables, state, t):
    """Take up the tones that are asked for in a tile, where they are other than before."""
    bank, tone, width, block = state.bank, tables.bank.tone, state.bank.band.shape[2], state.place.shape[0]
    band, parts = bank.band, width // EIGHT
    changed = False
    for i in range(min(width, tone.shape[1] - t * width)):
        k = t * width + i
        frequency, wavenumber = band[t, row.FREQUENCY, i], band[t, row.WAVENUMBER, i]
        for r in range(row.TONE_ROWS):
            band[t, row.FREQUENCY + r, i] = tone[r, k]
        if band[t, row.FREQUENCY, i] != frequency or band[t, row.WAVENUMBER, i] != wavenumber:
            changed = True
        turned = tone[0, k] / tables.sample.rate * block
        state.phase[t * parts + i // EIGHT, TURNED, i % EIGHT] = turned - floor(turned)
    if not changed and state.stale[0] == 0:
        return
    state.stale[0] = 1
    carrier = lanes(band, t, row.FREQUENCY)
    put(band, t, row.OMEGA, TURN * carrier)
    bank.follows[0] -= 1 if bank.pace[t] == row.LOCKED else 0
    bank.pace[t] = row.LOCKED if any_of(lanes(band, t, row.WAVENUMBER) > 0.0) else row.GROWING
    follows, step = bank.pace[t] == row.LOCKED, 1.0 / tables.sample.rate * carrier
    for i in range(width):
        turns = 0.0 if follows else (PAIRS - 0.5) / tables.sample.rate * band[t, row.FREQUENCY, i]
        state.phase[t * parts + i // EIGHT, TO_MIDDLE, i % EIGHT] = turns
    if follows:
        bank.follows[0] += 1
        return
    for i in range(PAIRS):
        cos, sin = unit(step * (i + 0.5))
        put(state.table, t, PAIR_ROWS * i + PAIR_COS, cos)
        put(state.table, t, PAIR_ROWS * i + PAIR_SIN, sin)
        put(state.table, t, PAIR_ROWS * i + FAR_COS, (i + 0.5) / block * cos)
        put(state.table, t, PAIR_ROWS * i + FAR_SIN, (i + 0.5) / block * sin)
    cos, sin = unit(step * GROUP)
    put(state.table, t, TURN_COS, cos)
    put(state.table, t, TURN_SIN, sin)


@kernel
def want(tables, state, t, g, factor):
    """Wanted envelope R at the block's end, its slope, and R as the observer sees it, in the block's middle.

    `factor` is what the wanted waveform makes of a modulated target.
    """
    numbers, band = tables.bank.numbers, state.bank.band
    weight = lanes(band, t, row.WEIGHT)
    old_re, old_im = lanes(band, t, row.R_RE), lanes(band, t, row.R_IM)
    if numbers.analysed:
        cos, sin = lanes(band, t, row.COS), lanes(band, t, row.SIN)
        last = state.heard.shape[0] - 1
        a, b, _, _ = correlate(state, t, last, last)
        raw_re = lanes(band, t, row.RAW_RE) + g * (a * cos + b * sin)
        raw_im = lanes(band, t, row.RAW_IM) + g * (b * cos - a * sin)
        put(band, t, row.RAW_RE, raw_re)
        put(band, t, row.RAW_IM, raw_im)
        if numbers.differentiated:
            raw_re, raw_im = derivative(band, t, raw_re, raw_im)
        follow = min(0.5 * g * state.place.shape[0], 1.0)
        re, im = old_re + follow * (weight * raw_re - old_re), old_im + follow * (weight * raw_im - old_im)
    else:
        if numbers.modulated:
            weight = weight * factor
        re, im = weight * lanes(band, t, row.WANTED_RE), weight * lanes(band, t, row.WANTED_IM)
        if numbers.differentiated:
            re, im = derivative(band, t, re, im)
    put(band, t, row.R_RE, re)
    put(band, t, row.R_IM, im)
    put(band, t, row.DR_RE, numbers.rate * (re - old_re))
    put(band, t, row.DR_IM, numbers.rate * (im - old_im))
    put(band, t, row.SEEN_RE, 0.5 * (re + old_re))
    put(band, t, row.SEEN_IM, 0.5 * (im + old_im))


@kernel
def update(tables, state, t, c, a, b, g, integral, back):
    """Error envelopes, integral parts and commands of a tile in coordinate c; how much either detector hears.

    `a` and `b` are what the block's residuals have in common with the carriers.
    """
    numbers, band, loop, shape = tables.bank.numbers, state.bank.band, state.bank.loop, tables.bank.shape[c]
    base, period, block = c * row.LOOP_ROWS, 1.0 / numbers.rate, state.place.shape[0]
    cos, sin, weight = lanes(band, t, row.COS), lanes(band, t, row.SIN), lanes(band, t, row.SHARE)
    found_re, found_im = a * cos + b * sin, b * cos - a * sin
    fading = FORGET * (1.0 - weight)
    heard_fast = heard_slow = 0.0
    for r, found in ((0, found_re), (1, found_im)):
        e = lanes(loop, t, base + row.E_RE + r)
        v, wanted = lanes(loop, t, base + row.V_RE + r), shape * lanes(band, t, row.R_RE + r)
        heard = e - v + 2.0 / block * found
        e = (1.0 - period * fading) * e + weight * g * found
        slope = -integral * e - fading * v
        v += period * (slope - back * (v + wanted))
        put(loop, t, base + row.E_RE + r, e)
        put(loop, t, base + row.V_RE + r, v)
        steeper = shape * lanes(band, t, row.DR_RE + r)
        put(loop, t, base + row.COMMAND_RE + r, v + wanted + tables.sample.lead * steeper)
        put(loop, t, base + row.SLOPED_RE + r, slope + steeper)
        fast = lanes(loop, t, base + row.FAST_RE + r)
        fast += numbers.fast_pole * (heard - fast)
        put(loop, t, base + row.FAST_RE + r, fast)
        heard_fast += fast * fast
        slow = lanes(loop, t, base + row.SLOW_RE + r)
        slow += numbers.slow_pole * (heard - slow)
        put(loop, t, base + row.SLOW_RE + r, slow)
        heard_slow += slow * slow
    return high(heard_fast - numbers.fast_level, 0.0), high(heard_slow - numbers.slow_level, 0.0)


@kernel
def take_in(tables, state, sensed, flags):
    """Coordinates of every sample less the DC band as it would go on; returns whether a sensor was not believed."""
    listen, level, raw = tables.bank.listen, state.bank.level, state.raw
    doubt = 0.0
    for m in range(sensed.shape[0]):
        for c in range(len(tables.bank.shape)):
            y = -level[0, c] - m * level[1, c]
            for s in range(sensed.shape[1]):
                value = sensed[m, s]
                if size(value) <= tables.sample.sensed_limit:
                    y += listen[c, s] * value
                else:
                    doubt, flags[m] = 1.0, 2
            raw[c, m] = y
    return doubt


@kernel
def settle_level(tables, state, c):
    """DC band of type 2 after the block's residuals."""
    numbers, level, block = tables.sample, state.bank.level, state.place.shape[0]
    gained = steeper = 0.0
    for m in range(block):
        error = state.error[c, m]
        gained += (numbers.dc + (block - 1 - m) * numbers.dc_drift) * error
        steeper += numbers.dc_drift * error
    level[0, c] += block * level[1, c] + gained
    level[1, c] += steeper


@kernel
def look_at_finger(tables, state, position, wanted, flags):
    """Follow the finger through a block; say where it, or what is wanted, is beyond all sense."""
    track, follows = state.bank.track, state.bank.follows[0] > 0
    for m in range(position.shape[0]):
        flags[m] = 0
        if size(position[m]) > FAR or not size(wanted[m]) <= FAR:
            flags[m] = 2
        if follows:
            track_finger(track, tables.sample.rate, position[m])
            state.place[m] = track[row.HELD]


@kernel
def take_up_tones(tables, state):
    """Take up tones: all of them where there is news, else a tile's in its turn."""
    bank, tiles = state.bank, state.bank.band.shape[0]
    if state.stale[0] > 0 or state.news[0] > 0:
        state.news[0] = 0
        for t in range(tiles):
            take_up(tables, state, t)
    else:
        take_up(tables, state, bank.sample[0] % tiles)
    bank.sample[0] += 1


@kernel
def weigh_carriers(tables, state):
    """Phases and weights of all carriers."""
    bank = state.bank
    count_phases(tables, state)
    for t in range(bank.band.shape[0]):
        if bank.pace[t] == row.LOCKED:
            follow_pass(tables, state, t)
        else:
            grow_pass(tables.bank, bank, t)
            put(bank.band, t, row.SHARE, lanes(bank.band, t, row.LIVE))


@kernel
def aim(tables, state, wanted, target):
    """Targets at the block's end."""
    band, last = state.bank.band, wanted[wanted.shape[0] - 1]
    if tables.bank.numbers.analysed:
        analyse(state, wanted)
    factor = last if size(last) <= FAR else 0.0
    for t in range(band.shape[0]):
        want(tables, state, t, tables.sample.reference, factor)
        put_pairs(target, t, lanes(band, t, row.R_RE), lanes(band, t, row.R_IM))


@kernel
def find_residuals(tables, state):
    """Residuals of the observer in every sample, exact; the DC band after them."""
    bank, coordinates = state.bank, len(tables.bank.shape)
    band, loop = bank.band, bank.loop
    for t in range(band.shape[0]):
        for c in range(coordinates):
            shape, base = tables.bank.shape[c], c * row.LOOP_ROWS
            re = shape * lanes(band, t, row.SEEN_RE) + lanes(loop, t, base + row.E_RE)
            im = shape * lanes(band, t, row.SEEN_IM) + lanes(loop, t, base + row.E_IM)
            turn_held(band, state.held, t, 2 * c, re, im)
    sum_bands(state, 0, 2 * (coordinates - 1))
    for c in range(coordinates):
        for m in range(state.place.shape[0]):
            state.raw[c, m] -= state.sum[m, c]
        solve(state, 0, c)
        settle_level(tables, state, c)


@kernel
def observe(tables, state, g, integral, back):
    """Take the residuals into every band; returns how much either detector hears."""
    band, coordinates = state.bank.band, len(tables.bank.shape)
    hears_fast = hears_slow = 0.0 * lanes(band, 0, row.COS)
    for t in range(band.shape[0]):
        a, b, a2, b2 = correlate(state, t, 0, coordinates - 1)
        for c in range(coordinates):
            heard_fast, heard_slow = update(tables, state, t, c, a, b, g, integral, back)
            hears_fast, hears_slow = hears_fast + heard_fast, hears_slow + heard_slow
            a, b = a2, b2
    return totals(1.0, hears_fast, hears_slow)


@kernel
def learn(tables, state, g, lively):
    """The finger, from what the observer shows of this block."""
    bank, numbers = state.bank, tables.bank.numbers
    gain = numbers.adapt + lively * (numbers.adapt_awake - numbers.adapt)
    rest = numbers.rest + lively * (numbers.rest_awake - numbers.rest)
    pole = 1.0 - (1.0 - 0.5 * g) ** state.place.shape[0]
    learn_finger(tables.bank, bank, bank.sample[0], numbers.rate, pole, 0.5, 0.0, gain, rest, True)


@kernel
def block_step(tables, state, sensed, position, wanted, drive, target, flags):
    """One block of the whole controller: fills `drive` (M, channels), `target` (bands,) and `flags` (M,)."""
    bank, numbers, sample, touch = state.bank, tables.bank.numbers, tables.sample, state.bank.touch
    take_up_tones(tables, state)
    look_at_finger(tables, state, position, wanted, flags)
    weigh_carriers(tables, state)
    calm = 1.0
    if numbers.crowd_speed > 0.0:
        calm = min(abs(bank.track[row.VELOCITY]) / numbers.crowd_speed, 1.0)
    fast, slow = touch[row.FAST_OPEN], touch[row.SLOW_OPEN]
    g = calm * (sample.observer + fast * (sample.observer_awake - sample.observer))
    if state.stale[0] > 0 or bank.follows[0] > 0 or state.gain[0] != g:
        respond(tables, state, g)
        state.gain[0] = g
    aim(tables, state, wanted, target)
    changed = feel(numbers, len(tables.bank.shape), tables.bank.stiffness, bank.level, touch, True)
    if changed:
        touch[row.FAST_TIME] = numbers.fast_time
        begin_finger(tables.bank, bank, changed)
        fast = 1.0
    doubt = take_in(tables, state, sensed, flags)
    find_residuals(tables, state)
    integral = numbers.integral + slow * (numbers.integral_stirred - numbers.integral)
    integral += fast * (numbers.integral_awake - integral)
    heard_fast, heard_slow = observe(tables, state, g, integral, numbers.back * (1.0 - touch[row.SCALE]))
    believe(numbers, touch, doubt)
    forget(bank)
    wake(numbers, touch, heard_fast, heard_slow)
    touching = touch[row.CONTACT] > 0.0 and numbers.adapt >= 0.0
    if touching:
        learn(tables, state, g, max(fast, slow))
    know(tables, state, touching)
    state.stale[0] = 0
    answer(tables, state, touching, drive, flags)


@kernel
def block_run(tables, state, sensed, position, wanted, drive, target, flags):
    """Blocks one after another: `target` has a row a block, everything else a row a sample."""
    block = state.place.shape[0]
    for b in range(sensed.shape[0] // block):
        n = slice(b * block, (b + 1) * block)
        block_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[b], flags[n])
