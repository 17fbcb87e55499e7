"""Compiled ultrasonic surface: an amplitude loop on the resonant carrier inside, sliding friction outside.

A sample of the surface is a few samples of the carrier.  The wanted friction becomes a wanted amplitude by the inverse
of the friction law; the amplitude's own controller follows it along a straight line; and what amplitude there is
leaves a friction by the law itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender.compiled.jit import kernel, simulation
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.kernels import bank_step
from hapticrender.control.bank.state import BankState, BankTables
from hapticrender.plants.closed import control_step
from hapticrender.plants.friction_laws import LawNumbers, friction_ratio, wanted_amplitude
from hapticrender.plants.kernels import HUGE, SENSOR_CLIPPED
from hapticrender.plants.sliding import SlidingState, SlidingTables, sliding_step
from hapticrender.plants.ultrasonic_kernels import (
    UltrasonicState,
    UltrasonicTables,
    mode_advance,
    mode_drive,
    mode_sense,
)
from hapticrender.protocols import Array

SATURATED = 1  # the flag
LEAST_SLEW = 0.05  # of the drive's slew: an amplitude beyond what it can hold is asked for, and flagged
POSITION, LOAD, STRENGTH, SPEED = range(4)  # columns of the finger


class SurfaceTables(NamedTuple):
    """Parameters of the surface."""

    substeps: int  # samples of the carrier in one of the surface
    friction: float  # mu0, of the surface at rest
    bias: float  # mu/mu0 without drive
    least: float  # least mu/mu0 that is asked for
    load: float  # N: what the amplitude is held for while no finger is there
    speed: float  # m/s, alike
    slew: float  # m: by which the drive can change an amplitude of nothing in a sample of the carrier
    estimating: bool  # what is sensed is the friction that the sensed amplitude leaves; else the tribometer's
    law: LawNumbers
    mode: UltrasonicTables
    control: BankTables  # of the amplitude loop
    sliding: SlidingTables


class SurfaceState(NamedTuple):
    """State of the surface; changed in place."""

    mode: UltrasonicState
    control: BankState
    sliding: SlidingState
    wanted: Array  # (1,) amplitude (m) at the end of the last sample
    asked: Array  # (1,) amplitude (m) that the drive could reach by then; negative: it starts from rest
    estimate: Array  # (1,) friction (N) by the sensed amplitude
    heard: Array  # (1,) sensor of the carrier (m)
    motion: Array  # (1,) the mode's displacement (m)
    drive: Array  # (1,) of the carrier (V)
    target: Array  # (1,) complex, m


@kernel
def wanted_ratio(tables, drive, whole):
    """mu/mu0 that is asked for by a drive (N) on a finger whose `whole` friction (N) is known, and flags."""
    drive = drive if abs(drive) < HUGE else 0.0
    ratio = tables.bias + drive / whole if whole > 0.0 else tables.bias
    inside = min(max(ratio, tables.least), 1.0)
    return inside, SATURATED if inside != ratio else 0


@kernel
def amplitude_fade(control, touch, period):
    """Share of its amplitude that the mode loses in a sample of the carrier, by what is known of its finger."""
    return 0.5 * period * (control.damping[0, 0] + max(touch[row.DAMPING], 0.0)) / control.mass[0, 0]


@kernel
def within_reach(asked, wanted, slew, fade):
    """Amplitude (m) on the way from `asked` to `wanted` to which the drive can take it within a sample.

    Asked for more, the drive would end up at its limit, with the loop open.  From rest the loop's own ramp is slower.
    """
    lost = fade * asked
    rise = max(slew - lost, LEAST_SLEW * slew)
    return asked + min(max(wanted - asked, -slew - lost), rise)


@kernel
def amplitude_pass(tables, state, wanted, mode, noise):
    """Carry the amplitude on a straight line to `wanted` (m); mean true amplitude (m) and flags."""
    flags, energy = 0, 0.0
    scale, z = 1.0 / (mode[1] * tables.mode.period), state.mode.z
    before, asked = state.wanted[0], state.asked[0]
    state.wanted[0] = wanted
    fade = amplitude_fade(tables.control, state.control.touch, tables.mode.period)
    for k in range(tables.substeps):
        line = before + (wanted - before) * (k + 1) / tables.substeps
        asked = within_reach(asked, line, tables.slew, fade) if state.asked[0] >= 0.0 else line
        if asked != line:
            flags |= SATURATED
        mode_drive(tables.mode, state.mode, state.drive)
        flags |= mode_sense(tables.mode, state.mode, noise[1 + k : 2 + k], state.heard, state.motion)
        mode_advance(tables.mode, state.mode, mode)
        flags |= bank_step(tables.control, state.control, state.heard, math.nan, asked, state.drive, state.target)
        energy += z[0] * z[0] + scale * scale * z[1] * z[1]
    state.asked[0] = asked
    return math.sqrt(energy / tables.substeps), flags


@kernel
def ask_within_reach(wanted, before, slew, fade, asked, flags):
    """The same for every element of `wanted` (m), after `before`; what had to wait is flagged."""
    for n in range(wanted.shape[0]):
        before = within_reach(before, wanted[n], slew, fade)
        if before != wanted[n]:
            flags[n] |= SATURATED
        asked[n] = before


@kernel
def sensed_amplitude(band, loop):
    """Amplitude (m) as the observer of an amplitude loop has it, by its state."""
    re = band[0, row.SEEN_RE, 0] + loop[0, row.E_RE, 0]
    im = band[0, row.SEEN_IM, 0] + loop[0, row.E_IM, 0]
    return math.hypot(re, im)


@kernel
def surface_step(tables, state, drive, finger, mode, noise, sensed, motion, skin, amplitude):
    """What is sensed at the start of a sample, which then passes under `drive` (N); returns flags.

    `noise` is that of the tribometer, then of the carrier's sensor.
    """
    load, speed = finger[LOAD], finger[SPEED]
    there = not math.isnan(speed) and load > 0.0
    whole = tables.friction * load if there else 0.0
    ratio, flags = wanted_ratio(tables, drive, whole)
    pace = max(abs(speed), tables.sliding.least_speed) if there else tables.speed
    wanted = wanted_amplitude(tables.law, ratio, load if there else tables.load, pace)
    amplitude[0], trouble = amplitude_pass(tables, state, wanted, mode, noise)
    steady = whole * friction_ratio(tables.law, amplitude[0], load, pace) if there else 0.0
    friction, shown, velocity = sliding_step(tables.sliding, state.sliding, steady, speed, noise[0])
    motion[0] = friction
    skin[0] = velocity / finger[STRENGTH] if finger[STRENGTH] > 0.0 else 0.0
    flags |= trouble
    if tables.estimating:
        sensed[0] = state.estimate[0]
        heard = sensed_amplitude(state.control.band, state.control.loop)
        state.estimate[0] = whole * friction_ratio(tables.law, heard, load, pace) if there else 0.0
        return flags
    sensed[0] = shown
    return flags | (SENSOR_CLIPPED if abs(shown) >= tables.sliding.force_range else 0)


@simulation
def surface_run(tables, state, drive, finger, mode, noise, sensed, motion, skin, amplitude, flags):
    """A block of the surface alone."""
    for n in range(drive.shape[0]):
        flags[n] = surface_step(
            tables, state, drive[n, 0], finger[n], mode[n], noise[n], sensed[n], motion[n], skin[n], amplitude[n]
        )


@simulation
def closed_surface_run(
    tables, state, control, control_state, last, finger, mode, noise, wanted, outputs, drive, target, flags
):
    """Surface and controller closed sample by sample; `last` (1,) is the drive computed one sample ago.

    `outputs` are the columns sensed, motion, skin velocity and amplitude.
    """
    sensed, motion, skin, amplitude = outputs
    for n in range(sensed.shape[0]):
        drive[n, 0] = last[0]
        flags[n] = surface_step(
            tables, state, last[0], finger[n], mode[n], noise[n], sensed[n], motion[n], skin[n], amplitude[n]
        )
        flags[n] |= control_step(control, control_state, sensed[n], finger[n, POSITION], wanted[n], last, target[n])
