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

from hapticrender._jit import kernel
from hapticrender._lanes import size
from hapticrender.plants.propagator import (
    GRIP,
    LEAST_STAY,
    MIDDLE,
    NARROWEST,
    NODES,
    PLACES,
    TRIAL,
    WIDTH,
    agree,
    interpolate,
    propagate,
    sum_series,
    to_powers,
)
from hapticrender.protocols import Array

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
    phalanx: Three  # m b k behind it
    coupled: bool  # the phalanx moves (4th order)
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
    """State of the plate; changed in place."""

    z: Array  # (1, 1, 8) displacements (m) and rates, times the period (m)
    step: Array  # (1, COLUMNS, 8) what a sample does to z: columns of Phi and Gamma
    frozen: Array  # (2,) lever and strength for which `step` holds
    powers: Array  # (NODES, COLUMNS, 8) the same as polynomials in the place, over the window
    window: Array  # (3,) where and for which grip the nodes hold
    one: Array  # (1, 8, 8) identity
    nodes: Array  # (NODES, COLUMNS, 8) scratch
    trial: Array  # (1, COLUMNS, 8) scratch
    system: Array  # (8, 8) A
    push: Array  # (3, 3) inverse mass in heave, rocking and bending, times the period squared, s2/kg
    pending: Array  # (latency, 2) drive on its way
    cursor: Array  # (1,) integer: oldest row of `pending`
    current: Array  # (2,) scratch


@kernel
def quantise(value, step, limit):
    """Nearest step inside the limit; a step of 0 leaves the resolution ideal."""
    value = min(max(value, -limit), limit)
    return value if step == 0.0 else step * math.floor(value * (1.0 / step) + 0.5)


@kernel
def bent(tables, lever):
    """Shape of the bending mode at `lever` (p/a): 1 at the sensors, 0 where the glass is rigid."""
    if not tables.flexible:
        return 0.0
    angle = tables.shape[0] * lever
    return tables.shape[1] * math.cosh(angle) + tables.shape[2] * math.cos(angle)


@kernel
def surface_row(tables, i, row, at, hold, drag, system, push):
    """Row of A for the rate of heave (0), rocking (1) or bending (2) of the glass."""
    period, k, c = tables.period, tables.stiffness, tables.damping
    heave, rock, bend = push[i, 0], push[i, 1], push[i, 2]
    contact = heave + rock * at[1] + bend * at[2]
    system[row, 0] = -(heave * k[0] + rock * k[1] + contact * hold)
    system[row, 1] = -(heave * k[1] + rock * k[2] + contact * hold * at[1])
    system[row, 3] = -(heave * c[0] + rock * c[1] + contact * drag) / period
    system[row, 4] = -(heave * c[1] + rock * c[2] + contact * drag * at[1]) / period
    system[row, 2] = contact * hold if tables.coupled else 0.0
    system[row, 5] = contact * drag / period if tables.coupled else 0.0
    if tables.flexible:
        system[row, 6] = -(bend * tables.flexure[0] + contact * hold * at[2])
        system[row, 7] = -(bend * tables.flexure[1] + contact * drag * at[2]) / period


@kernel
def plate_system(tables, lever, strength, system, push):
    """Fill A and the inverse mass for a finger at `lever` (p/a) of `strength` times its nominal impedance."""
    period, skin, phalanx, inverse = tables.period, tables.skin, tables.phalanx, tables.inverse_mass
    at = (1.0, lever, bent(tables, lever))  # how heave, rocking and bending move the contact
    give = inverse[0] + lever * lever * inverse[1] + at[2] * at[2] * inverse[2]
    shared = strength * skin[0] / (1.0 + strength * skin[0] * give)
    scale = period * period  # inverse of M + m_skin h h^T, h = `at`: Sherman-Morrison
    push[0, 0] = scale * (inverse[0] - shared * inverse[0] * inverse[0])
    push[0, 1] = push[1, 0] = -scale * shared * inverse[0] * inverse[1] * lever
    push[1, 1] = scale * (inverse[1] - shared * inverse[1] * inverse[1] * lever * lever)
    hold, drag = strength * skin[2], strength * skin[1]
    if tables.flexible:
        push[0, 2] = push[2, 0] = -scale * shared * inverse[0] * inverse[2] * at[2]
        push[1, 2] = push[2, 1] = -scale * shared * inverse[1] * inverse[2] * lever * at[2]
        push[2, 2] = scale * (inverse[2] - shared * inverse[2] * inverse[2] * at[2] * at[2])
        system[6, 7] = 1.0
        surface_row(tables, 2, 7, at, hold, drag, system, push)
    for i in range(2):
        system[i, i + 3] = 1.0
        surface_row(tables, i, i + 3, at, hold, drag, system, push)
    free = tables.coupled and strength > 0.0
    system[2, 5] = 1.0 if free else 0.0
    share = scale / phalanx[0] if free else 0.0
    system[5, 0] = share * skin[2]
    system[5, 1] = share * skin[2] * lever
    system[5, 2] = -share * (skin[2] + phalanx[2])
    system[5, 3] = share * skin[1] / period
    system[5, 4] = share * skin[1] * lever / period
    system[5, 5] = -share * (skin[1] + phalanx[1]) / period
    system[5, 6] = share * skin[2] * at[2]
    system[5, 7] = share * skin[1] * at[2] / period


@kernel
def series_at(tables, state, lever, strength, out, at):
    """Exact propagator for a finger at `lever` with `strength`, into row block `at` of `out`."""
    plate_system(tables, lever, strength, state.system, state.push)
    sum_series(tables.terms, tables.flexible, state.system, state.push, state.one, out, at)


@kernel
def open_window(tables, state, lever, strength):
    """Lay nodes ahead of the finger, where it slides to; a window whose polynomial is not exact is halved, thrice."""
    window, ahead = state.window, 1.0 if lever > state.frozen[0] else -1.0
    window[GRIP] = strength
    while window[WIDTH] > NARROWEST:
        width = window[WIDTH]
        window[MIDDLE] = lever + 0.9 * ahead * width
        for m in range(NODES):
            series_at(tables, state, window[MIDDLE] + width * PLACES[m], strength, state.nodes, m)
        to_powers(state.nodes, state.powers)
        series_at(tables, state, window[MIDDLE] + width * TRIAL, strength, state.trial, 0)
        interpolate(tables.flexible, state.powers, TRIAL, state.step)
        if agree(state.step, state.trial):
            return
        window[WIDTH] *= 0.5
    window[GRIP] = -1.0


@kernel
def renew(tables, state, lever, strength):
    """Propagator for a finger that has moved or changed its grip."""
    frozen, window = state.frozen, state.window
    if strength == frozen[1] and size(lever - frozen[0]) * LEAST_STAY < window[WIDTH]:
        if strength != window[GRIP] or size(lever - window[MIDDLE]) > window[WIDTH]:
            open_window(tables, state, lever, strength)
    if strength == window[GRIP] and size(lever - window[MIDDLE]) <= window[WIDTH]:
        interpolate(tables.flexible, state.powers, (lever - window[MIDDLE]) / window[WIDTH], state.step)
    else:
        series_at(tables, state, lever, strength, state.step, 0)
    frozen[0], frozen[1] = lever, strength


@kernel
def plate_advance(tables, state, position, load, strength):
    """One sample of motion under the current (A), exact for the frozen plate."""
    z, current = state.z, state.current
    touching = strength > 0.0
    lever = position * tables.lever if touching else 0.0
    weight = load if touching else 0.0
    if not touching:
        strength = z[0, 0, 2] = z[0, 0, 5] = 0.0
    if lever != state.frozen[0] or strength != state.frozen[1]:
        renew(tables, state, lever, strength)
    common = tables.force_constant * (current[0] + current[1])
    force1 = tables.force_constant * (current[1] - current[0]) - weight * lever
    force2 = 0.0
    if tables.flexible:
        force2 = tables.coil_shape * common - weight * bent(tables, lever)
    propagate(tables.flexible, state.step, z, common - weight, force1, force2)


@kernel
def plate_sense(tables, state, noise, sensed, motion):
    """Hall sensors at the glass ends and the true motion at centre, end 1, end 2; returns flags."""
    flags, z = 0, state.z[0, 0]
    for i in range(2):
        side = -tables.reach if i == 0 else tables.reach
        motion[1 + i] = z[0] + side * z[1] + z[6]
        value = motion[1 + i] * tables.sensor_gain[i] + tables.sensor_noise * noise[i]
        if abs(value) > tables.sensor_limit:
            flags |= 4
        sensed[i] = quantise(value, tables.sensor_step, tables.sensor_limit)
    motion[0] = z[0] + tables.centre_shape * z[6]
    return flags


@kernel
def plate_drive(tables, state, drive):
    """Queue a drive sample and put the one now due on the coils, quantised and limited."""
    pending, cursor, current = state.pending, state.cursor, state.current
    latency = pending.shape[0]
    row = cursor[0]
    for i in range(2):
        due = drive[i]
        if latency > 0:
            due = pending[row, i]
            pending[row, i] = drive[i]
        asked = quantise(due, tables.current_step, tables.current_limit) if math.isfinite(due) else 0.0
        current[i] = tables.amplifier * asked
    if latency > 0:
        cursor[0] = (row + 1) % latency


@kernel
def plate_run(tables, state, drive, finger, noise, sensed, motion, flags):
    """A block of the plate alone; `finger` rows are position, load, strength."""
    for n in range(drive.shape[0]):
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        plate_drive(tables, state, drive[n])
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])
