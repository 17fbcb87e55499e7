"""Compiled plate with a finger on it.

The plate is frozen over one sample (finger position, load and current held)
and integrated exactly (see `propagator`).  Velocities are scaled by the sample
period, so that A has no units.

States: 0 heave, 1 rocking, 2 phalanx, 3-5 their rates, 6 bending of the glass
(its displacement at the sensors, m), 7 its rate.  A rigid plate leaves 6 and 7
at zero and never reads them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel, late, simulation
from hapticrender.compiled.lanes import high, low, select, size
from hapticrender.compiled.lanes_memory import read, record, write
from hapticrender.compiled.polynomials import whole
from hapticrender.plants.propagator import (
    GRIP,
    LEAST_STAY,
    LEVER,
    MIDDLE,
    NARROWER,
    NARROWEST,
    NODES,
    PLACES,
    STRENGTH,
    WIDTH,
    exact,
    interpolate,
    kept,
    polynomial,
    propagate,
    sum_series,
    to_powers,
)
from hapticrender.protocols import Array

SENSOR_CLIPPED = 4  # Flag.SENSOR_CLIPPED
HUGE = 1e300  # a drive beyond it is no number
Three = tuple[float, float, float]


class PlateTables(NamedTuple):
    """Parameters of the plate and of the finger on it: numbers only, so that passing them costs nothing."""

    period: float
    terms: int
    inverse_mass: Three  # heave, rocking, bending, 1/kg; 0: that coordinate is locked
    stiffness: Three  # k11 k12 k22, N/m: row i of the matrix starts at i
    damping: Three  # c11 c12 c22, N s/m
    force_constant: float  # N/A
    lever: float  # 1/a, 1/m: rocking per metre of position
    reach: float  # l/a: sensor distance over a
    skin: Three  # m b k of the part of the finger that moves with the plate
    phalanx: Three  # 1/m (0: it does not move) b k behind it
    flexible: bool  # the glass bends
    flexure: tuple[float, float]  # stiffness and damping of the bending mode, N/m, N s/m
    coil_shape: float  # of the bending mode at the coils, 1 at the sensors
    centre_shape: float
    shape: Three  # wavenumber times a, and the weights of cosh and cos: shape of the bending mode at p/a
    amplifier: float  # current that flows over current that is asked for
    current_limit: float  # A
    current_step: float  # A, 0: not quantised
    sensor_limit: float  # m
    sensor_step: float  # m, 0: not quantised
    sensor_noise: float  # m rms
    sensor_gain: tuple[float, float]


class PlateState(NamedTuple):
    """State of the plate; changed in place.  Matrices are kept column by column."""

    z: Array  # (1, 8) displacements (m) and rates, times the period (m)
    step: Array  # (1, COLUMNS, 8) what a sample does to z: columns of Phi and Gamma
    frozen: Array  # (2,) lever and strength for which `step` holds
    seen: Array  # (2,) lever and strength of the last sample
    powers: Array  # (NODES, COLUMNS, 8) the same as polynomials in the place, over the window
    window: Array  # (3,) where and for which grip the nodes hold
    nodes: Array  # (NODES + 1, COLUMNS, 8) scratch: the propagator at the nodes, and at a place between them
    one: Array  # (8, 8) identity
    system: Array  # (8, 8) A
    square: Array  # (8, 8) scratch: A^2
    cube: Array  # (8, 8) scratch: A^3
    series: Array  # (8, 8) scratch: the sum so far
    push: Array  # (3, 3) B: what common and opposed currents and the weight do to the rates of heave, rocking, bending
    pending: Array  # (latency, 2) drive on its way
    cursor: Array  # (1,) integer: oldest row of `pending`
    current: Array  # (2,) A: on the coils


@kernel
def quantise(value, step, limit):
    """Nearest step inside the limit; a step of 0 leaves the resolution ideal."""
    value = low(high(value, -limit), limit)
    return select(step > 0.0, step * whole(value, 1.0 / step), value)


@kernel
def bent(tables, lever):
    """Shape of the bending mode at `lever` (p/a): 1 at the sensors, 0 where the glass is rigid.

    g cosh x + w cos x = (g + w) (1 + x^4/4! + x^8/8! ...) + (g - w) (x^2/2! + x^6/6! ...), to rounding on the glass.
    """
    if not tables.flexible:
        return 0.0 * lever
    x = tables.shape[0] * lever
    x2 = x * x
    x4 = x2 * x2
    whole = part = 1.0 + 0.0 * x
    for n in range(24, 0, -4):
        whole = 1.0 + x4 * whole * (1.0 / (n * (n - 1) * (n - 2) * (n - 3)))
        part = 1.0 + x4 * part * (1.0 / ((n + 2) * (n + 1) * n * (n - 1)))
    return (tables.shape[1] + tables.shape[2]) * whole + (tables.shape[1] - tables.shape[2]) * (0.5 * x2) * part


@kernel
def surface_row(tables, row, own, contact, at, hold, drag, system):
    """Row of A for a rate of the glass, of which forces make `own` (3,), and one at the contact `contact`."""
    rate, k, c = 1.0 / tables.period, tables.stiffness, tables.damping
    lever, bend = at
    hold, drag = contact * hold, contact * drag
    write(-(own[0] * k[0] + own[1] * k[1] + hold), system, 0, row)
    write(-(own[0] * k[1] + own[1] * k[2] + hold * lever), system, 1, row)
    write(hold, system, 2, row)
    write(-rate * (own[0] * c[0] + own[1] * c[1] + drag), system, 3, row)
    write(-rate * (own[0] * c[1] + own[1] * c[2] + drag * lever), system, 4, row)
    write(rate * drag, system, 5, row)
    if tables.flexible:
        write(-(own[2] * tables.flexure[0] + hold * bend), system, 6, row)
        write(-rate * (own[2] * tables.flexure[1] + drag * bend), system, 7, row)


@kernel
def phalanx_row(tables, strength, at, system):
    """Row of A for the rate of the phalanx; a finger that is lifted leaves it alone."""
    rate, skin, phalanx = 1.0 / tables.period, tables.skin, tables.phalanx
    lever, bend = at
    share = select(strength > 0.0, tables.period * tables.period * phalanx[0], 0.0)
    hold, drag = share * skin[2], rate * share * skin[1]
    write(hold, system, 0, 5)
    write(hold * lever, system, 1, 5)
    write(-(hold + share * phalanx[2]), system, 2, 5)
    write(drag, system, 3, 5)
    write(drag * lever, system, 4, 5)
    write(-(drag + rate * share * phalanx[1]), system, 5, 5)
    if tables.flexible:
        write(hold * bend, system, 6, 5)
        write(drag * bend, system, 7, 5)


@kernel
def push_row(tables, row, own, contact, push):
    """Row of B: what common and opposed currents and the weight do to a rate of the glass."""
    write(tables.force_constant * (own[0] + tables.coil_shape * own[2]), push, 0, row)
    write(tables.force_constant * own[1], push, 1, row)
    write(-contact, push, 2, row)


@kernel
def plate_system(tables, lever, strength, system, push):
    """Fill A and B for a finger at `lever` (p/a) of `strength` times its nominal impedance; its shifts stay.

    Inverse mass by Sherman and Morrison: with h = [1, lever, bend] and w = h/M, (M + m h h^T)^-1 = 1/M - m c w^T and
    c = w/(1 + m h w) is what it makes of h, a force at the contact.  Times the period squared.
    """
    bend = bent(tables, lever)
    at = (lever, bend)
    scale, skin, inverse = tables.period * tables.period, tables.skin, tables.inverse_mass
    w0, w1, w2 = inverse[0], inverse[1] * lever, inverse[2] * bend
    mass, drag, hold = strength * skin[0], strength * skin[1], strength * skin[2]
    shared = scale / (1.0 + mass * (w0 + w1 * lever + w2 * bend))
    c0, c1, c2 = shared * w0, shared * w1, shared * w2
    heave = (scale * inverse[0] - mass * c0 * w0, -mass * c0 * w1, -mass * c0 * w2)
    rock = (heave[1], scale * inverse[1] - mass * c1 * w1, -mass * c1 * w2)
    surface_row(tables, 3, heave, c0, at, hold, drag, system)
    surface_row(tables, 4, rock, c1, at, hold, drag, system)
    phalanx_row(tables, strength, at, system)
    push_row(tables, 0, heave, c0, push)
    push_row(tables, 1, rock, c1, push)
    if tables.flexible:
        bending = (heave[2], rock[2], scale * inverse[2] - mass * c2 * w2)
        surface_row(tables, 7, bending, c2, at, hold, drag, system)
        push_row(tables, 2, bending, c2, push)


def plate_matrix(tables: PlateTables, lever: float, strength: float) -> Array:
    """A of `plate_system`, row by row over heave, rocking, bending, phalanx and their rates, without compiling it.

    Its own way to the same numbers: M^-1 K and M^-1 C of the plate with the finger as a fourth coordinate.
    """
    x, period = tables.shape[0] * lever, tables.period
    bend = tables.shape[1] * math.cosh(x) + tables.shape[2] * math.cos(x) if tables.flexible else 0.0
    felt = np.array([1.0, lever, bend, -1.0])
    glass = felt * (1.0, 1.0, 1.0, 0.0)
    mass, grip = strength * tables.skin[0], strength or 1.0
    inverse = np.diag([*tables.inverse_mass, tables.phalanx[0] / grip if strength > 0.0 else 0.0])
    moved = inverse @ glass
    inverse -= mass / (1.0 + mass * (glass @ moved)) * np.outer(moved, moved)  # Sherman and Morrison

    def forces(own: Three, bending: float, skin: float, phalanx: float) -> Array:
        alone = np.diag([own[0], own[2], bending, grip * phalanx])
        alone[0, 1] = alone[1, 0] = own[1]
        return -inverse @ (alone + strength * skin * np.outer(felt, felt))

    k = forces(tables.stiffness, tables.flexure[0], tables.skin[2], tables.phalanx[2])
    c = forces(tables.damping, tables.flexure[1], tables.skin[1], tables.phalanx[1])
    return np.block([[np.zeros((4, 4)), np.eye(4)], [period**2 * k, period * c]])


@kernel
def series_at(tables, state, lever, strength, out, at):
    """Exact propagator for a finger at `lever` with `strength`, into row block `at` of `out`."""
    plate_system(tables, lever, strength, state.system, state.push)
    sum_series(tables.terms, tables.flexible, state, out, at)


@late
def open_window(tables, state, lever, strength):
    """Lay nodes ahead of the finger, where it slides to; where its polynomial is not exact, a narrower one."""
    window, ahead = state.window, 1.0 if lever > state.seen[LEVER] else -1.0
    window[GRIP] = strength
    while window[WIDTH] > NARROWEST:
        width = window[WIDTH]
        window[MIDDLE] = lever + 0.9 * ahead * width
        for m in range(NODES + 1):
            series_at(tables, state, window[MIDDLE] + width * PLACES[m], strength, state.nodes, m)
        to_powers(tables.flexible, state.nodes, state.powers)
        if exact(tables.flexible, state.powers, state.nodes):
            return
        window[WIDTH] *= NARROWER
    window[GRIP] = -1.0


@kernel
def inside(window, lever, strength):
    """Whether a finger is inside the window."""
    return strength == window[GRIP] and size(lever - window[MIDDLE]) <= window[WIDTH]


@kernel
def slides(tables, state, lever, strength):
    """Whether the finger slides inside a window; one is opened for it where that pays."""
    window, moved = state.window, size(lever - state.seen[LEVER])
    if moved == 0.0 or strength != state.seen[STRENGTH]:
        return False
    if moved * LEAST_STAY < window[WIDTH] and not inside(window, lever, strength):
        open_window(tables, state, lever, strength)
    return inside(window, lever, strength)


@kernel
def renew(tables, state, lever, strength):
    """Propagator of a finger that rests, or comes or grips anew."""
    window, frozen = state.window, state.frozen
    if inside(window, lever, strength):
        interpolate(tables.flexible, state.powers, (lever - window[MIDDLE]) / window[WIDTH], state.step)
    else:
        series_at(tables, state, lever, strength, state.step, 0)
    frozen[LEVER], frozen[STRENGTH] = lever, strength


@kernel
def plate_advance(tables, state, position, load, strength):
    """One sample of motion under the current (A), exact for the frozen plate."""
    z, current, frozen, seen, window = state.z, state.current, state.frozen, state.seen, state.window
    touching = strength > 0.0
    lever = position * tables.lever if touching else 0.0
    weight = load if touching else 0.0
    if not touching:
        strength = z[0, 2] = z[0, 5] = 0.0
    common, opposed = current[0] + current[1], current[1] - current[0]
    if lever == frozen[LEVER] and strength == frozen[STRENGTH]:
        propagate(kept, tables.flexible, state.step, 0.0, z, common, opposed, weight)
    elif slides(tables, state, lever, strength):
        x = (lever - window[MIDDLE]) / window[WIDTH]
        propagate(polynomial, tables.flexible, state.powers, x, z, common, opposed, weight)
    else:
        renew(tables, state, lever, strength)
        propagate(kept, tables.flexible, state.step, 0.0, z, common, opposed, weight)
    seen[LEVER], seen[STRENGTH] = lever, strength


@kernel
def sense(tables, state, noise, sensed, motion):
    """Hall sensors at the glass ends and the true motion at centre, end 1, end 2; returns flags as a float."""
    z = state.z
    heave, tilt, bend = read(z, 0, 0), tables.reach * read(z, 0, 1), read(z, 0, 6)
    record(heave + tables.centre_shape * bend, motion, 0)
    clipped = 0.0 * heave
    for i in range(2):
        end = heave - tilt + bend if i == 0 else heave + tilt + bend
        record(end, motion, 1 + i)
        value = end * tables.sensor_gain[i] + tables.sensor_noise * read(noise, i)
        clipped = select(size(value) > tables.sensor_limit, 1.0 * SENSOR_CLIPPED, clipped)
        write(quantise(value, tables.sensor_step, tables.sensor_limit), sensed, i)
    return clipped


@kernel
def plate_sense(tables, state, noise, sensed, motion):
    """`sense` of a single plate; returns flags."""
    return np.int64(sense(tables, state, noise, sensed, motion))


@kernel
def plate_drive(tables, state, drive):
    """Queue a drive sample and put the one now due on the coils, quantised and limited."""
    pending, cursor = state.pending, state.cursor
    latency, row = pending.shape[0], cursor[0]
    for i in range(2):
        due = read(drive, i)
        if latency > 0:
            due, newest = read(pending, row, i), due
            write(newest, pending, row, i)
        asked = quantise(due, tables.current_step, tables.current_limit)
        write(tables.amplifier * select(size(due) < HUGE, asked, 0.0), state.current, i)
    if latency > 0:
        cursor[0] = row + 1 if row + 1 < latency else 0


@simulation
def plate_run(tables, state, drive, finger, noise, sensed, motion, flags):
    """A block of the plate alone; `finger` rows are position, load, strength."""
    for n in range(drive.shape[0]):
        plate_drive(tables, state, drive[n])
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])
