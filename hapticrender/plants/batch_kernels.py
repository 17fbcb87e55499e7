"""Compiled plates and fingers of as many scenarios as there are lanes, each closed with a controller of its own.

While a finger moves, what a sample does to its plate is a series anew, which side by side costs less than to fetch
eight plates' polynomials in the place (those of the single plate) from memory; while every finger rests, its matrices
are kept.  Both equal the single plate to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

from hapticrender.compiled.jit import by_types, kernel, simulation
from hapticrender.compiled.lanes import any_of, select, size
from hapticrender.compiled.lanes_memory import read, record, record_whole, write
from hapticrender.control.bank.kernels import bank_advance
from hapticrender.control.bank.state import BankTables
from hapticrender.control.polar.kernels import PolarTables
from hapticrender.control.polar.steps import polar_advance
from hapticrender.plants.kernels import PlateTables, plate_drive, plate_system, sense
from hapticrender.plants.propagator import COLUMNS, RIGID, STATES
from hapticrender.protocols import Array

LEAST_REST = 16  # samples that every finger must rest for before its matrices are kept
LEVER, STRENGTH = range(2)  # rows of BatchState.finger
SHARED = ("period", "terms", "flexible")  # entries of PlateTables that plates side by side have in common


class BatchState(NamedTuple):
    """State of the plates; changed in place."""

    z: Array  # (1, STATES, W)
    system: Array  # (STATES, STATES, W) A, column by column
    push: Array  # (3, 3, W) B, see `PlateState.push`
    step: Array  # (COLUMNS, STATES, W) Phi and Gamma while the fingers rest
    finger: Array  # (2, W) lever and strength for which A and B hold
    rest: Array  # (1,) integer: samples since a finger moved
    number: Array  # (numbers, W) the others of PlateTables, in their order
    pending: Array  # (latency, 2, W)
    cursor: Array  # (1,) integer
    current: Array  # (2, W)
    shown: Array  # (2, W) what the sensors show now


@kernel
def three(number, at):
    """A triple of numbers."""
    return read(number, at), read(number, at + 1), read(number, at + 2)


@kernel
def tables_of(shared, number):
    """The plates' tables, a lane each."""
    return PlateTables(
        shared.period,
        shared.terms,
        three(number, 0),
        three(number, 3),
        three(number, 6),
        read(number, 9),
        read(number, 10),
        read(number, 11),
        three(number, 12),
        three(number, 15),
        shared.flexible,
        (read(number, 18), read(number, 19)),
        read(number, 20),
        read(number, 21),
        three(number, 22),
        read(number, 25),
        read(number, 26),
        read(number, 27),
        read(number, 28),
        read(number, 29),
        read(number, 30),
        (read(number, 31), read(number, 32)),
    )


@kernel
def whole(array, j):
    """Column j of an array, its eight states."""
    return (
        read(array, j, 0),
        read(array, j, 1),
        read(array, j, 2),
        read(array, j, 3),
        read(array, j, 4),
        read(array, j, 5),
        read(array, j, 6),
        read(array, j, 7),
    )


@kernel
def keep(z, array, j):
    """Write eight states to column j of an array."""
    for s, value in enumerate(z):
        write(value, array, j, s)


@kernel
def plus(z, share, more):
    """State by state z + share * more."""
    return (
        z[0] + share * more[0],
        z[1] + share * more[1],
        z[2] + share * more[2],
        z[3] + share * more[3],
        z[4] + share * more[4],
        z[5] + share * more[5],
        z[6] + share * more[6],
        z[7] + share * more[7],
    )


@kernel
def row_times(flexible, system, row, z):
    """Row of A z; the rates come last, as in a series they are known last."""
    value = read(system, 0, row) * z[0] + read(system, 1, row) * z[1] + read(system, 2, row) * z[2]
    if flexible:
        value += read(system, 6, row) * z[6]
        value += read(system, 7, row) * z[7]
    value += read(system, 3, row) * z[3]
    value += read(system, 4, row) * z[4]
    return value + read(system, 5, row) * z[5]


@kernel
def changes(flexible, system, z):
    """A z."""
    bending = 0.0 * z[7]
    if flexible:
        bending = row_times(flexible, system, 7, z)
    heave, rocking = row_times(flexible, system, 3, z), row_times(flexible, system, 4, z)
    return z[3], z[4], z[5], heave, rocking, row_times(flexible, system, 5, z), z[7], bending


@kernel
def forced(push, row, common, opposed, weight):
    """What forces do to the rate of heave, rocking or bending: a row of B f."""
    return read(push, 0, row) * common + read(push, 1, row) * opposed + read(push, 2, row) * weight


@kernel
def grown(tables, state, z, common, opposed, weight):
    """What a sample makes of z: z + (1 + A/2! + A^2/3! ...) (A z + B f)."""
    flexible, system, push = tables.flexible, state.system, state.push
    heave, rocking = forced(push, 0, common, opposed, weight), forced(push, 1, common, opposed, weight)
    bending, nothing = 0.0 * heave, 0.0 * heave
    if flexible:
        bending = forced(push, 2, common, opposed, weight)
    forces = (nothing, nothing, nothing, heave, rocking, nothing, nothing, bending)
    term = plus(forces, 1.0, changes(flexible, system, z))
    value, share = plus(z, 1.0, term), 1.0
    for k in range(2, tables.terms + 1):
        term = changes(flexible, system, term)
        share *= 1.0 / k
        value = plus(value, share, term)
    return value


@kernel
def rest(tables, state):
    """Keep what a sample makes of each state and of each force."""
    for j in range(COLUMNS):
        for s in range(STATES):
            write(1.0 if s == j else 0.0, state.step, j, s)
        common, opposed, weight = 1.0 * (j == STATES), 1.0 * (j == STATES + 1), 1.0 * (j == STATES + 2)
        keep(grown(tables, state, whole(state.step, j), common, opposed, weight), state.step, j)


@kernel
def propagate(flexible, step, z, common, opposed, weight):
    """Replace z by Phi z + Gamma f."""
    old = whole(z, 0)
    for s in range(STATES if flexible else RIGID):
        first = read(step, 0, s) * old[0] + read(step, 4, s) * old[4]
        second = read(step, 1, s) * old[1] + read(step, 5, s) * old[5]
        third = read(step, 8, s) * common + read(step, 2, s) * old[2]
        fourth = read(step, 9, s) * opposed + read(step, 10, s) * weight + read(step, 3, s) * old[3]
        if flexible:
            third += read(step, 6, s) * old[6]
            fourth += read(step, 7, s) * old[7]
        write((first + second) + (third + fourth), z, 0, s)


@kernel
def advance(tables, state, position, load, strength):
    """One sample of motion of every plate under its current."""
    z, finger, current = state.z, state.finger, state.current
    touching = strength > 0.0
    lever, strength = select(touching, position * tables.lever, 0.0), select(touching, strength, 0.0)
    weight = select(touching, load, 0.0)
    if any_of(strength == 0.0):
        for s in (2, 5):
            write(select(touching, read(z, 0, s), 0.0), z, 0, s)
    state.rest[0] += 1
    if any_of(size(lever - read(finger, LEVER)) + size(strength - read(finger, STRENGTH)) > 0.0):
        write(lever, finger, LEVER)
        write(strength, finger, STRENGTH)
        plate_system(tables, lever, strength, state.system, state.push)
        state.rest[0] = 0
    common, opposed = read(current, 0) + read(current, 1), read(current, 1) - read(current, 0)
    if state.rest[0] == LEAST_REST:
        rest(tables, state)
    if state.rest[0] < LEAST_REST:
        keep(grown(tables, state, whole(z, 0), common, opposed, weight), z, 0)
    else:
        propagate(tables.flexible, state.step, z, common, opposed, weight)


ADVANCES = {PolarTables: polar_advance, BankTables: bank_advance}


@by_types
def control_advance(tables, *rest):
    """Step of the controllers that `tables` belong to."""
    return ADVANCES[tables.instance_class]


@kernel
def finger_of(finger, n, r, like):
    """Entry r of the fingers in sample n: of each lane, or of the one that all share."""
    if finger.shape[2] == 1:
        return 0.0 * like + finger[n, r, 0]
    return read(finger, n, r)


@simulation
def closed_batch_run(
    shared, state, control, control_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """Plates and controllers closed sample by sample; see `closed_plate_run`.  Every array ends in a lane a scenario.

    `shared` are the tables of any of the plates, with as many terms as any needs; `finger` is (n, 3, W): position,
    load, strength, or (n, 3, 1) where all share one; `noise` and `wanted` may have one row, which then is every
    sample's; `target` has three axes, by which it is known that none is wanted; `flags` are integers.
    """
    tables = tables_of(shared, state.number)
    for n in range(sensed.shape[0]):
        plate_drive(tables, state, last)
        heard, asked = min(n, noise.shape[0] - 1), min(n, wanted.shape[0] - 1)
        raised = sense(tables, state, noise[heard], state.shown, motion[n])
        record(read(state.shown, 0), sensed, n, 0)
        record(read(state.shown, 1), sensed, n, 1)
        position = finger_of(finger, n, 0, raised)
        advance(tables, state, position, finger_of(finger, n, 1, raised), finger_of(finger, n, 2, raised))
        record(read(last, 0), drive, n, 0)
        record(read(last, 1), drive, n, 1)
        raised += control_advance(control, control_state, state.shown, position, read(wanted, asked), last, target)
        record_whole(raised, flags, n)
