"""Compiled plates and fingers of as many scenarios as there are lanes, each closed with a controller of its own.

What a sample does to a plate is kept as polynomials in the finger's place, a lane a scenario: those of the finger's
window while it slides, and constants while it rests.  A lane whose finger leaves them gets new ones from the kernels
of the single plate; that is rare, and the rest of the lanes do not notice.
"""

from __future__ import annotations

from typing import NamedTuple

from hapticrender.compiled.jit import by_types, kernel
from hapticrender.compiled.lanes import any_of, select, size
from hapticrender.compiled.lanes_memory import read, write
from hapticrender.control.bank.kernels import bank_advance
from hapticrender.control.bank.state import BankTables
from hapticrender.control.polar.kernels import PolarTables
from hapticrender.control.polar.steps import polar_advance
from hapticrender.plants.kernels import inside, open_window, plate_drive, sense, series_at
from hapticrender.plants.propagator import (
    COLUMNS,
    GRIP,
    LEAST_STAY,
    LEVER,
    MIDDLE,
    NODES,
    RIGID,
    STATES,
    STRENGTH,
    WIDTH,
    kept,
    polynomial,
)
from hapticrender.protocols import Array

# rows of BatchState.span: where a lane's polynomials hold (middle, 1/half the width, half the width, grip), the
# finger's lever and strength of the last sample and of this one, and how wide its windows are
CENTRE, SCALE, HALF, HOLD, SEEN_LEVER, SEEN_STRENGTH, LEVER_NOW, STRENGTH_NOW, WINDOW = range(9)
SPAN_ROWS = 9


class LaneNumbers(NamedTuple):
    """Numbers of the plates that every sample needs, a lane each; names are those of `PlateTables`."""

    lever: Array
    reach: Array
    amplifier: Array
    current_limit: Array
    current_step: Array
    sensor_limit: Array
    sensor_step: Array
    sensor_noise: Array
    sensor_gain: tuple[Array, Array]
    centre_shape: Array


NUMBERS = 11  # rows of BatchState.number


class BatchState(NamedTuple):
    """State of the plates; changed in place."""

    z: Array  # (1, STATES, W)
    after: Array  # (STATES, W) scratch
    powers: Array  # (NODES, COLUMNS * STATES, W): entry by entry, see `PlateState.powers`
    span: Array  # (SPAN_ROWS, W)
    number: Array  # (NUMBERS, W)
    pending: Array  # (latency, 2, W)
    cursor: Array  # (1,) integer
    current: Array  # (2, W)


@kernel
def numbers_of(number):
    """The plates' numbers as `LaneNumbers`."""
    return LaneNumbers(
        read(number, 0),
        read(number, 1),
        read(number, 2),
        read(number, 3),
        read(number, 4),
        read(number, 5),
        read(number, 6),
        read(number, 7),
        (read(number, 8), read(number, 9)),
        read(number, 10),
    )


@kernel
def scatter(source, m, powers, n, i):
    """Row block m of `source` (columns of 8 states) into power n of lane i; a negative m stands for zeros."""
    for j in range(COLUMNS):
        for s in range(STATES):
            powers[n, j * STATES + s, i] = source[m, j, s] if m >= 0 else 0.0


@kernel
def lay(tables, work, state, i, lever, strength):
    """New polynomials for lane i, whose finger has left its own."""
    span, seen, window = state.span, work.seen, work.window
    seen[LEVER], seen[STRENGTH] = span[SEEN_LEVER, i], span[SEEN_STRENGTH, i]
    window[WIDTH], window[GRIP] = span[WINDOW, i], -1.0
    moved = abs(lever - seen[LEVER])
    if moved > 0.0 and strength == seen[STRENGTH] and moved * LEAST_STAY < window[WIDTH]:
        open_window(tables, work, lever, strength)
        span[WINDOW, i] = window[WIDTH]
    if inside(window, lever, strength):
        for n in range(NODES):
            scatter(work.powers, n, state.powers, n, i)
        span[CENTRE, i], span[HALF, i], span[SCALE, i] = window[MIDDLE], window[WIDTH], 1.0 / window[WIDTH]
    else:
        series_at(tables, work, lever, strength, work.step, 0)
        for n in range(NODES):
            scatter(work.step, 0 if n == 0 else -1, state.powers, n, i)
        span[CENTRE, i], span[HALF, i], span[SCALE, i] = lever, 0.0, 0.0
    span[HOLD, i] = strength


@kernel
def propagate(entry, state, flexible, x, common, opposed, weight):
    """Replace z by Phi z + Gamma f, of which `entry(powers, column * STATES + row, x)` gives the entries."""
    z, powers, after = state.z, state.powers, state.after
    for s in range(STATES if flexible else RIGID):
        first = entry(powers, s, x) * read(z, 0, 0) + entry(powers, 4 * STATES + s, x) * read(z, 0, 4)
        second = entry(powers, STATES + s, x) * read(z, 0, 1) + entry(powers, 5 * STATES + s, x) * read(z, 0, 5)
        third = entry(powers, 8 * STATES + s, x) * common + entry(powers, 2 * STATES + s, x) * read(z, 0, 2)
        fourth = entry(powers, 9 * STATES + s, x) * opposed + entry(powers, 10 * STATES + s, x) * weight
        fourth += entry(powers, 3 * STATES + s, x) * read(z, 0, 3)
        if flexible:
            third += entry(powers, 6 * STATES + s, x) * read(z, 0, 6)
            fourth += entry(powers, 7 * STATES + s, x) * read(z, 0, 7)
        write((first + second) + (third + fourth), after, s)
    for s in range(STATES if flexible else RIGID):
        write(read(after, s), z, 0, s)


@kernel
def advance(each, work, numbers, state, position, load, strength):
    """One sample of motion of every plate under its current."""
    z, span, current = state.z, state.span, state.current
    touching = strength > 0.0
    lever, strength = select(touching, position * numbers.lever, 0.0), select(touching, strength, 0.0)
    weight = select(touching, load, 0.0)
    if any_of(strength == 0.0):
        for s in (2, 5):
            write(select(touching, read(z, 0, s), 0.0), z, 0, s)
    write(lever, span, LEVER_NOW)
    write(strength, span, STRENGTH_NOW)
    away = (size(lever - read(span, CENTRE)) > read(span, HALF)) | (size(strength - read(span, HOLD)) > 0.0)
    if any_of(away):
        for i in range(span.shape[1]):
            here, grip = span[LEVER_NOW, i], span[STRENGTH_NOW, i]
            if abs(here - span[CENTRE, i]) > span[HALF, i] or grip != span[HOLD, i]:
                lay(each[i], work, state, i, here, grip)
    write(lever, span, SEEN_LEVER)
    write(strength, span, SEEN_STRENGTH)
    common, opposed = read(current, 0) + read(current, 1), read(current, 1) - read(current, 0)
    x = (lever - read(span, CENTRE)) * read(span, SCALE)
    if any_of(read(span, HALF) > 0.0):
        propagate(polynomial, state, each[0].flexible, x, common, opposed, weight)
    else:
        propagate(kept, state, each[0].flexible, x, common, opposed, weight)


ADVANCES = {PolarTables: polar_advance, BankTables: bank_advance}


@by_types
def control_advance(tables, *rest):
    """Step of the controllers that `tables` belong to."""
    return ADVANCES[tables.instance_class]


@kernel
def closed_batch_run(
    each, work, state, control, control_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """Plates and controllers closed sample by sample; see `closed_plate_run`.  Every array ends in a lane a scenario.

    `finger` is (n, 3, W): position, load, strength; `target` holds the last sample's only, (bands, 2, W); `flags` are
    floats.
    """
    numbers = numbers_of(state.number)
    for n in range(sensed.shape[0]):
        plate_drive(numbers, state, last)
        raised = sense(numbers, state, noise[n], sensed[n], motion[n])
        position = read(finger, n, 0)
        advance(each, work, numbers, state, position, read(finger, n, 1), read(finger, n, 2))
        write(read(last, 0), drive, n, 0)
        write(read(last, 1), drive, n, 1)
        raised += control_advance(control, control_state, sensed[n], position, read(wanted, n), last, target)
        write(raised, flags, n)
