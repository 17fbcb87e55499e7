"""Compiled ultrasonic mode with a finger on it.

``m q'' + b q' + m w^2 q = N u`` with the drive u, the damping b and the resonance w held over a sample, integrated in
closed form: with s = b/2m, w_d = sqrt(w^2 - s^2), and e the distance to where the drive's force would hold the mode::

    e(T)  = E [(c + s/w_d S) e + S/w_d e']        E = exp(-s T)
    e'(T) = E [(c - s/w_d S) e' - w^2/w_d S e]    c, S = cos, sin(w_d T)

Velocities are scaled by the sample period, so that all states are in m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender.compiled.jit import kernel, simulation
from hapticrender.plants.closed import control_step
from hapticrender.plants.kernels import HUGE, SENSOR_CLIPPED, quantise
from hapticrender.protocols import Array

STEP = 5  # numbers of the propagator


class UltrasonicTables(NamedTuple):
    """Parameters of the mode and its electronics."""

    period: float  # s
    mass: float  # kg
    force_constant: float  # N/V
    drive_limit: float  # V
    drive_step: float  # V, 0: not quantised
    sensor_limit: float  # m
    sensor_step: float  # m, 0: not quantised
    sensor_noise: float  # m rms


class UltrasonicState(NamedTuple):
    """State of the mode; changed in place."""

    z: Array  # (2,) displacement (m) and velocity times the period (m)
    step: Array  # (STEP,) propagator of e, row by row, and the compliance (m/N)
    frozen: Array  # (2,) damping and resonance for which `step` holds
    pending: Array  # (latency,) drive on its way
    cursor: Array  # (1,) integer: oldest entry of `pending`
    force: Array  # (1,) N: on the mode


@kernel
def renew_mode(tables, state, damping, resonance):
    """Propagator of an underdamped mode of this `damping` (N s/m) and `resonance` (rad/s)."""
    period, step = tables.period, state.step
    s = 0.5 * damping / tables.mass
    turn = math.sqrt(resonance * resonance - s * s)
    fade = math.exp(-s * period)
    cosine, sine = fade * math.cos(turn * period), fade * math.sin(turn * period) / turn
    step[0] = cosine + s * sine
    step[1] = sine / period
    step[2] = -resonance * resonance * sine * period
    step[3] = cosine - s * sine
    step[4] = 1.0 / (tables.mass * resonance * resonance)
    state.frozen[0], state.frozen[1] = damping, resonance


@kernel
def mode_advance(tables, state, mode):
    """One sample of motion under the force, exact for the frozen `mode`: (2,) damping (N s/m), resonance (rad/s)."""
    z, step, frozen = state.z, state.step, state.frozen
    if mode[0] != frozen[0] or mode[1] != frozen[1]:
        renew_mode(tables, state, mode[0], mode[1])
    rest = step[4] * state.force[0]
    away, rate = z[0] - rest, z[1]
    z[0] = rest + step[0] * away + step[1] * rate
    z[1] = step[2] * away + step[3] * rate


@kernel
def mode_drive(tables, state, drive):
    """Queue a drive sample (V) and put the one now due on the mode, quantised and limited."""
    pending, cursor = state.pending, state.cursor
    latency, row, due = pending.shape[0], cursor[0], drive[0]
    if latency > 0:
        newest = due
        due = pending[row]
        pending[row] = newest
        cursor[0] = row + 1 if row + 1 < latency else 0
    asked = quantise(due, tables.drive_step, tables.drive_limit) if abs(due) < HUGE else 0.0
    state.force[0] = tables.force_constant * asked


@kernel
def mode_sense(tables, state, noise, sensed, motion):
    """Sensor and true displacement (m); returns flags."""
    motion[0] = state.z[0]
    value = state.z[0] + tables.sensor_noise * noise[0]
    sensed[0] = quantise(value, tables.sensor_step, tables.sensor_limit)
    return SENSOR_CLIPPED if abs(value) > tables.sensor_limit else 0


@simulation
def ultrasonic_run(tables, state, drive, mode, noise, sensed, motion, flags):
    """A block of the mode alone."""
    for n in range(drive.shape[0]):
        mode_drive(tables, state, drive[n])
        flags[n] = mode_sense(tables, state, noise[n], sensed[n], motion[n])
        mode_advance(tables, state, mode[n])


@simulation
def closed_ultrasonic_run(
    tables, state, control, control_state, last, position, mode, noise, wanted, sensed, motion, drive, target, flags
):
    """Mode and controller closed sample by sample; `last` (1,) is the drive computed one sample ago.

    Row n of `drive` is what the mode was handed for interval n, so it is computed from sample n - 1.
    """
    for n in range(sensed.shape[0]):
        mode_drive(tables, state, last)
        flags[n] = mode_sense(tables, state, noise[n], sensed[n], motion[n])
        mode_advance(tables, state, mode[n])
        drive[n, 0] = last[0]
        flags[n] |= control_step(control, control_state, sensed[n], position[n], wanted[n], last, target[n])
