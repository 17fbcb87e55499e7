"""Compiled plate with a finger on it, alone and closed with a controller.

The plate is frozen over one sample (finger position, load and current held)
and integrated exactly: z+ = exp(A) z + ..., by the Taylor series of the
exponential's action on the state, with as many terms as rounding asks for.
Velocities are scaled by the sample period, so that A has no units.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender.control.kernels import polar_step
from hapticrender.protocols import Array


class PlateTables(NamedTuple):
    """Parameters of the plate and of the finger on it."""

    period: float
    terms: int
    inverse_mass: Array  # (2,) heave and rocking, 1/kg; 0: that coordinate is locked
    stiffness: Array  # k11 k12 k22, N/m: row i of the matrix starts at i
    damping: Array  # c11 c12 c22, N s/m
    force_constant: float  # N/A
    lever: float  # 1/a, 1/m: rocking per metre of position
    reach: float  # l/a: sensor distance over a
    skin: Array  # m b k of the part of the finger that moves with the plate
    phalanx: Array  # m b k behind it
    coupled: bool  # the phalanx moves (4th order)
    current_limit: float  # A
    current_step: float  # A, 0: not quantised
    sensor_limit: float  # m
    sensor_step: float  # m, 0: not quantised
    sensor_noise: float  # m rms


class PlateState(NamedTuple):
    """State of the plate; changed in place."""

    z: Array  # (6,) heave, rocking, phalanx (m), and the same differentiated, times the period (m)
    term: Array  # (2, 6) scratch
    frozen: Array  # (2,) lever and strength for which `system` and `push` hold
    system: Array  # (6, 6)
    push: Array  # (6, 2)
    pending: Array  # (latency, 2) drive on its way
    cursor: Array  # (1,) integer: oldest row of `pending`
    current: Array  # (2,) scratch


@kernel
def quantise(value, step, limit):
    """Nearest step inside the limit; a step of 0 leaves the resolution ideal."""
    value = min(max(value, -limit), limit)
    return value if step == 0.0 else step * math.floor(value / step + 0.5)


@kernel
def plate_system(tables, lever, strength, system, push):
    """Fill z' = system z + push (F0, F1): `system` (6, 6), `push` (6, 2); `lever` is p/a, time in sample periods."""
    period = tables.period
    h = (1.0, lever)
    skin = tables.skin
    inverse = tables.inverse_mass
    shared = strength * skin[0] / (1.0 + strength * skin[0] * (inverse[0] + lever * lever * inverse[1]))
    for i in range(2):
        system[i, i + 3] = 1.0
        for j in range(2):
            # inverse of M + m_skin h h^T (Sherman-Morrison), times the period squared
            own = inverse[i] if i == j else 0.0
            push[i + 3, j] = period * period * (own - shared * inverse[i] * h[i] * inverse[j] * h[j])
    for i in range(2):
        contact = push[i + 3, 0] + push[i + 3, 1] * lever
        for j in range(2):
            k, c = tables.stiffness, tables.damping
            system[i + 3, j] = -(
                push[i + 3, 0] * k[j] + push[i + 3, 1] * k[1 + j] + contact * strength * skin[2] * h[j]
            )
            system[i + 3, j + 3] = (
                -(push[i + 3, 0] * c[j] + push[i + 3, 1] * c[1 + j] + contact * strength * skin[1] * h[j]) / period
            )
        system[i + 3, 2] = contact * strength * skin[2] if tables.coupled else 0.0
        system[i + 3, 5] = contact * strength * skin[1] / period if tables.coupled else 0.0
    if tables.coupled and strength > 0.0:
        p = tables.phalanx
        system[2, 5] = 1.0
        for j in range(2):
            system[5, j] = period * period * skin[2] * h[j] / p[0]
            system[5, j + 3] = period * skin[1] * h[j] / p[0]
        system[5, 2] = -period * period * (skin[2] + p[2]) / p[0]
        system[5, 5] = -period * (skin[1] + p[1]) / p[0]
    else:
        system[2, 5] = 0.0


@kernel
def plate_advance(tables, state, position, load, strength):
    """One sample of motion under `state.current`, exact for the frozen plate."""
    z = state.z
    touching = strength > 0.0
    lever = position * tables.lever if touching else 0.0
    if not touching:
        strength = 0.0
        z[2] = 0.0
        z[5] = 0.0
    if lever != state.frozen[0] or strength != state.frozen[1]:
        plate_system(tables, lever, strength, state.system, state.push)
        state.frozen[0] = lever
        state.frozen[1] = strength
    force = tables.force_constant
    weight = load if touching else 0.0
    push0 = force * (state.current[0] + state.current[1]) - weight
    push1 = force * (state.current[1] - state.current[0]) - weight * lever
    term, other = state.term[0], state.term[1]
    for i in range(6):
        term[i] = state.push[i, 0] * push0 + state.push[i, 1] * push1
        for j in range(6):
            term[i] += state.system[i, j] * z[j]
    for n in range(2, tables.terms + 2):
        for i in range(6):
            z[i] += term[i]
            total = 0.0
            for j in range(6):
                total += state.system[i, j] * term[j]
            other[i] = total / n
        term, other = other, term


@kernel
def plate_sense(tables, state, noise, sensed, motion):
    """Hall sensors at the glass ends and the true motion at centre, end 1, end 2; returns flags."""
    flags = 0
    for i in range(2):
        side = -tables.reach if i == 0 else tables.reach
        motion[1 + i] = state.z[0] + side * state.z[1]
        value = motion[1 + i] + tables.sensor_noise * noise[i]
        if abs(value) > tables.sensor_limit:
            flags |= 4
        sensed[i] = quantise(value, tables.sensor_step, tables.sensor_limit)
    motion[0] = state.z[0]
    return flags


@kernel
def plate_drive(tables, state, drive):
    """Queue a drive sample and put the one now due on the coils, quantised and limited."""
    latency = state.pending.shape[0]
    row = state.cursor[0]
    for i in range(2):
        due = drive[i]
        if latency > 0:
            due = state.pending[row, i]
            state.pending[row, i] = drive[i]
        state.current[i] = quantise(due, tables.current_step, tables.current_limit) if math.isfinite(due) else 0.0
    if latency > 0:
        state.cursor[0] = (row + 1) % latency


@kernel
def plate_run(tables, state, drive, finger, noise, sensed, motion, flags):
    """A block of the plate alone; `finger` rows are position, load, strength."""
    for n in range(drive.shape[0]):
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        plate_drive(tables, state, drive[n])
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])


@kernel
def polar_plate_run(
    tables, state, polar, polar_state, last, finger, noise, wanted, sensed, motion, drive, target, flags
):
    """Plate and polar controller closed sample by sample; `last` (2,) is the drive computed one sample ago."""
    for n in range(sensed.shape[0]):
        flags[n] = plate_sense(tables, state, noise[n], sensed[n], motion[n])
        plate_drive(tables, state, last)
        plate_advance(tables, state, finger[n, 0], finger[n, 1], finger[n, 2])
        flags[n] |= polar_step(polar, polar_state, sensed[n], finger[n, 0], wanted[n], drive[n], target[n])
        for i in range(2):
            last[i] = drive[n, i]
