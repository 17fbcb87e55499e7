"""Compiled tick of the band bank: residual-coupled observer, dynamic-stiffness law, inner damping, two speeds.

One step serves the methods that work in the device's coordinates (FACTS
section 3): the observer watches the error (H2) or the signal (H), the law
inverts D + D' d/dt, the inner loop damps the deviation at sample rate.  Symbols
and rows are those of `rows`.  The same source steps one scenario, whose
bands are the lanes, and as many scenarios as there are lanes, side by side.
"""

from __future__ import annotations

import numpy as np

from hapticrender.compiled.jit import kernel, late
from hapticrender.compiled.lanes import any_of, high, low, root, select, size
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.carriers import REFRESH, carrier_pass, follow_finger, refresh
from hapticrender.control.bank.detectors import HUGE, detect, fast_all
from hapticrender.control.bank.finger import feel
from hapticrender.control.bank.law import know_finger, law_pass
from hapticrender.control.bank.learning import ADAPTATION, begin_finger, in_a_turn, learn_finger, send_finger
from hapticrender.control.bank.observer import level_pass, observer_pass, residual_pass
from hapticrender.control.bank.settled import settled, settled_command, settled_follow, settled_loop
from hapticrender.control.bank.shaper import shape_pass
from hapticrender.control.bank.targets import target_all
from hapticrender.control.kernels import DOUBT_TIME, FAR


@kernel
def believe(numbers, touch, doubt):
    """Trust in the sensors: falls to 0 within 20 ms where a sample cannot be believed."""
    step = 1.0 / (DOUBT_TIME * numbers.rate)
    trust = read(touch, row.TRUST)
    if any_of((trust < 1.0) | (doubt > 0.0)):
        write(select(doubt > 0.0, high(trust - step, 0.0), low(trust + step, 1.0)), touch, row.TRUST)


@kernel
def forget(state):
    """Start the loop anew where no trust is left."""
    lost, loop = read(state.touch, row.TRUST) == 0.0, state.loop
    if not any_of(lost):
        return
    for t in range(loop.shape[0]):
        for r in range(loop.shape[1]):
            put(loop, t, r, select(lost, 0.0, lanes(loop, t, r)))
    for array in (state.level, state.past, state.shaper):
        for i in range(array.shape[0]):
            for j in range(array.shape[1]):
                write(select(lost, 0.0, read(array, i, j)), array, i, j)


@kernel
def speak_pass(tables, state, drive):
    """Drive from force: the whole envelope scaled to the limit, the rounding's noise shaped.

    The envelope is that of the analytic signal, force and its quadrature: steady for a steady tone, so that scaling it
    distorts nothing.
    """
    numbers, touch = tables.numbers, state.touch
    trust = read(touch, row.TRUST)
    share = trust * (1.0 / numbers.drive_limit)
    peak = numbers.peak_decay * numbers.peak_decay * read(touch, row.PEAK)
    for i in range(tables.speak.shape[0]):
        along = across = 0.0 * trust
        for c in range(len(tables.shape)):
            along += read(tables.speak, i, c) * read(state.residual, row.FORCE, c)
            across += read(tables.speak, i, c) * read(state.residual, row.QUADRATURE, c)
        write(trust * along, drive, i)
        along, across = share * along, share * across
        peak = high(peak, along * along + across * across)
    write(peak, touch, row.PEAK)
    scale = 1.0 + 0.0 * trust
    if any_of(peak > 1.0):
        scale = select(peak > 1.0, 1.0 / root(peak), 1.0)
    write(scale, touch, row.SCALE)
    for i in range(tables.speak.shape[0]):
        shape_pass(numbers, state.shaper, scale * read(drive, i), drive, i)
    write(select(scale < 1.0, 1.0, 0.0), touch, row.LIMITED)


@kernel
def listen_pass(tables, sensed, c):
    """Coordinate c from the sensors; what no sensor can show counts as zero, and raises doubt."""
    y = doubt = 0.0
    for s in range(tables.listen.shape[1]):
        value = read(sensed, s)
        believed = size(value) <= tables.numbers.sensed_limit
        y += read(tables.listen, c, s) * select(believed, value, 0.0)
        doubt = high(doubt, select(believed, 0.0, 1.0))
    return y, doubt


@kernel
def calmness(numbers, state):
    """Share of the observer's gain that is left to a slow finger, whose bands lie close together."""
    calm = 1.0 + 0.0 * read(state.touch, row.TRUST)
    if numbers.crowd_speed > 0.0:
        calm = low(size(read(state.track, row.VELOCITY)) * (1.0 / numbers.crowd_speed), 1.0)
    return calm


@kernel
def gains(numbers, state):
    """Gains of this sample: observer, integral, inner loop, back-calculation; whether the DC band is to be quick."""
    touch, track = state.touch, state.track
    fast, slow, scale = read(touch, row.FAST_OPEN), read(touch, row.SLOW_OPEN), read(touch, row.SCALE)
    integral = numbers.integral + slow * (numbers.integral_stirred - numbers.integral)
    integral += fast * (numbers.integral_awake - integral)
    inner = numbers.inner + fast * (numbers.inner_awake - numbers.inner)
    inner = select(scale < 1.0, 0.0, inner)  # no room for it
    g = calmness(numbers, state) * (numbers.observer + fast * (numbers.observer_awake - numbers.observer))
    quick = scale < 0.0
    if numbers.presence:  # the step of a friction is not what the texture does
        quick = (read(track, row.SEEN) <= 0.0) | (read(track, row.FRESH) > 0.0)
        idle = quick | (read(track, row.SPEED) < numbers.least_speed)  # a finger that rests feels no texture
        g, integral = select(idle, 0.0, g), select(idle, 0.0, integral)
    return g, integral, inner, numbers.back * (1.0 - scale), quick


@kernel
def listen_all(tables, state, sensed):
    """Every coordinate as the sensors show it; what raises doubt is told."""
    doubt = 0.0 * read(state.touch, row.TRUST)
    for c in range(len(tables.shape)):
        y, unbelieved = listen_pass(tables, sensed, c)
        write(y, state.residual, row.HEARD, c)
        doubt = high(doubt, unbelieved)
    return doubt


@late
def begin_anew(state):
    """What no trust is left in; see `forget`."""
    forget(state)


@late
def meet_finger(tables, state, changed):
    """What a touch or a lift-off changes; see `begin_finger`."""
    begin_finger(tables, state, changed)


@late
def learn(tables, state, g, inner, calmly, touching):
    """The finger's turn to be learnt, from what the observer shows; the next sample's law knows it."""
    numbers, touch = tables.numbers, state.touch
    lively = high(read(touch, row.FAST_OPEN), read(touch, row.SLOW_OPEN))
    gain = numbers.adapt + lively * (numbers.adapt_awake - numbers.adapt)
    rest = numbers.rest + lively * (numbers.rest_awake - numbers.rest)
    follow = high(0.5 * g, 1e-4)  # the observer's pole in a sample, then in a step
    step, pole = state.sample[0] // ADAPTATION, in_a_turn(follow)
    middle = (1.0 / follow - 1.0) / ADAPTATION - (1.0 / pole - 1.0)
    for t in range(state.band.shape[0]):
        if calmly:
            settled_command(tables, state, t)
        send_finger(tables, state, t, step)
    learn_finger(tables, state, step, numbers.rate / ADAPTATION, pole, middle, inner, gain, rest, touching)


@kernel
def meet(tables, state):
    """Whether a finger is on, and the law that knows it."""
    numbers, touch, learnt = tables.numbers, state.touch, state.sample[0] % ADAPTATION == 1
    changed = feel(numbers, len(tables.shape), tables.stiffness, state.level, touch, learnt)
    if any_of(changed):
        write(select(changed, numbers.fast_time, read(touch, row.FAST_TIME)), touch, row.FAST_TIME)
        meet_finger(tables, state, changed)
    touching = (read(touch, row.CONTACT) > 0.0) & (numbers.adapt >= 0.0)
    know_finger(tables, state, touching, learnt)
    return touching


@kernel
def conclude(tables, state, g, inner, calmly, touching, fast):
    """What is learnt in its turn, and what the detectors wake, once the drive is out."""
    turn = state.sample[0] % ADAPTATION == 0
    if turn and any_of(touching):
        learn(tables, state, g, inner, calmly, touching)
    detect(tables, state, fast, turn)


@kernel
def stirred_sample(tables, state, fresh, position, wanted, drive, target):
    """What `settled_sample` does, whatever happens."""
    numbers = tables.numbers
    if state.follows[0] > 0:
        follow_finger(tables, state, position)
    carrier_pass(tables, state, fresh)
    target_all(tables, state, calmness(numbers, state) * numbers.reference, wanted, target)
    touching = meet(tables, state)
    g, integral, inner, back, quick = gains(numbers, state)
    for c in range(len(tables.shape)):
        residual_pass(tables, state, c, inner)
        level_pass(numbers, state, c, quick)
        for t in range(state.band.shape[0]):
            observer_pass(tables, state, t, c, g, integral, back)
    if any_of(read(state.touch, row.TRUST) == 0.0):
        begin_anew(state)
    law_pass(tables, state)
    speak_pass(tables, state, drive)
    fast = 0.0 * g
    if numbers.fast_level < HUGE:
        fast = fast_all(tables, state)
    conclude(tables, state, g, inner, False, touching, fast)


@late
def settled_sample(tables, state, fresh, drive, target):
    """From what is heard to the drive, and what is learnt, while little happens; what needs no sensor comes first."""
    touching = meet(tables, state)
    g, integral, inner, _, _ = gains(tables.numbers, state)
    settled_loop(tables, state, fresh, g, integral, inner, target)
    speak_pass(tables, state, drive)
    fast = settled_follow(tables, state, g, integral)
    conclude(tables, state, g, inner, True, touching, fast)


@kernel
def bank_advance(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags as a float."""
    sane = size(wanted) <= FAR
    odd = high(select(sane, 0.0, 2.0), select(size(position) > FAR, 2.0, 0.0))
    fresh = state.sample[0] % REFRESH == 0
    if fresh:
        refresh(tables, state)
    state.sample[0] += 1
    doubt = listen_all(tables, state, sensed)
    believe(tables.numbers, state.touch, doubt)
    if settled(state):
        settled_sample(tables, state, fresh, drive, target)
    else:
        stirred_sample(tables, state, fresh, position, select(sane, wanted, 0.0), drive, target)
    return read(state.touch, row.LIMITED) + high(odd, 2.0 * doubt)


@kernel
def bank_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of a single scenario; see `bank_advance`.  Returns flags."""
    flags = np.int64(bank_advance(tables, state, sensed, position, wanted, drive, target))
    if tables.numbers.lock > 0.0 and state.shift[1] > 0.0:
        flags |= 32
    return flags


@kernel
def bank_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `bank_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = bank_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
