"""Compiled hybrid: plate and screen under one finger, and closed with two banks."""

from __future__ import annotations

from typing import NamedTuple

from hapticrender.compiled.jit import kernel, simulation
from hapticrender.control.together import together_step
from hapticrender.plants.electroadhesion_kernels import POSITION, ScreenState, ScreenTables, screen_step
from hapticrender.plants.kernels import PlateState, PlateTables, bent, plate_advance, plate_drive, plate_sense
from hapticrender.protocols import Array

MOVED, RUBBED = range(2)  # columns of what is felt
COILS = SENSORS = 2  # channels of the plate


class HybridTables(NamedTuple):
    """Numbers of the compiled hybrid."""

    plate: PlateTables
    screen: ScreenTables
    velocity_per_force: float  # m/(N s)


class HybridState(NamedTuple):
    """State of the hybrid; changed in place."""

    plate: PlateState
    screen: ScreenState
    places: Array  # (3,) scratch: displacement at the plate's own places
    friction: Array  # (1,) scratch, N
    skin: Array  # (1,) scratch: velocity of the skin under friction, m/s


@kernel
def glass_velocity(tables, state, position):
    """Velocity (m/s) of the glass under a finger at `position` (m, NaN: its middle), at the start of a sample."""
    lever = position * tables.lever if position == position else 0.0
    z = state.z
    return (z[0, 3] + lever * z[0, 4] + bent(tables, lever) * z[0, 7]) / tables.period


@kernel
def hybrid_step(tables, state, drive, finger, noise, sensed, motion, felt):
    """What is sensed and felt at the start of a sample, which then passes under `drive`; returns flags.

    `noise` is that of the plate's sensors, then of the screen's.
    """
    plate, own = tables.plate, state.plate
    plate_drive(plate, own, drive[:COILS])
    flags = plate_sense(plate, own, noise[:SENSORS], sensed[:SENSORS], state.places)
    felt[MOVED] = glass_velocity(plate, own, finger[POSITION])
    plate_advance(plate, own, finger[0], finger[1], finger[2])
    flags |= screen_step(
        tables.screen,
        state.screen,
        drive[COILS],
        finger,
        noise[SENSORS:],
        sensed[SENSORS:],
        state.friction,
        state.skin,
    )
    felt[RUBBED] = tables.velocity_per_force * state.friction[0]
    motion[0] = felt[MOVED] + felt[RUBBED]
    return flags


@simulation
def hybrid_run(tables, state, drive, finger, noise, sensed, motion, felt, flags):
    """A block of the hybrid alone; columns of `finger` are position, load, strength, speed."""
    for n in range(drive.shape[0]):
        flags[n] = hybrid_step(tables, state, drive[n], finger[n], noise[n], sensed[n], motion[n], felt[n])


@simulation
def closed_hybrid_run(
    tables, state, control, control_state, last, finger, noise, wanted, sensed, motion, felt, drive, target, flags
):
    """Hybrid and two banks closed sample by sample; `last` (3,) is the drive computed one sample ago."""
    for n in range(sensed.shape[0]):
        for i in range(last.shape[0]):
            drive[n, i] = last[i]
        flags[n] = hybrid_step(tables, state, last, finger[n], noise[n], sensed[n], motion[n], felt[n])
        flags[n] |= together_step(control, control_state, sensed[n], finger[n, POSITION], wanted[n], last, target[n])
