"""Compiled screen with a finger on it: the circuit at the carrier, or its envelope, and friction behind it.

Charges q_k of the insulator, the stratum corneum and the gap obey q' = i - q/tau with tau = R C, which does not depend
on the contact area.  Over a substep h the current is I cos(theta + w u) plus a direct part, and exactly::

    q+ = a q + I Re(e^{j theta} (e^{j w h} - a)/(j w + 1/tau)) + i_dc tau (1 - a),  a = e^{-h/tau}
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender.compiled.jit import kernel, simulation
from hapticrender.control.gap import VACUUM, GapState, GapTables, gap_step
from hapticrender.control.square_root import SquareRootTables, square_root_step
from hapticrender.plants.closed import control_step
from hapticrender.plants.sliding import SlidingState, SlidingTables, sliding_step
from hapticrender.protocols import Array

SATURATED, SENSOR_CLIPPED, OPEN_LOOP = 1, 4, 16  # Flag
HUGE = 1e300  # a drive beyond it is no number
POSITION, LOAD, STRENGTH, SPEED = range(4)  # columns of the finger
SERVO, FORCE, UNSENSED = range(3)  # entries of ScreenState.held
Element = tuple[float, float, float, float]  # a; real and imaginary gain of the carrier; gain of a direct current (s)


class ScreenTables(NamedTuple):
    """Numbers of the compiled screen."""

    carrier: bool  # level: every substep of the carrier, else its envelope
    voltage: bool  # the drive is a voltage
    sensing: bool  # the sensor is the gap's impedance, else the tribometer
    compensated: bool
    compensation: SquareRootTables
    substeps: int
    substep: float  # h, s
    omega: float  # w, rad/s
    turn: tuple[float, float]  # cosine and sine of w h
    skew: tuple[float, float]  # cosine and sine of w times what the current's channel is late
    turns: float  # of the carrier in a sample
    current_limit: float  # A
    voltage_limit: float  # V
    offset: float  # A
    servo: float  # S
    insulator: Element
    corneum: Element
    capacitance: tuple[float, float]  # of insulator and stratum corneum, F/m2
    series: tuple[float, float]  # impedance of the two, ohm m2
    body: float  # ohm
    gap: float  # m
    gap_resistance: float  # ohm m2
    gap_short: float  # ohm m2
    ripple: float
    wavenumber: float  # of the ripple, rad/m
    kappa: float
    area: float  # m2 at 1 N
    exponent: float
    voltage_noise: float  # V rms
    current_noise: float  # A rms
    friction: float  # mu
    estimator: GapTables
    sliding: SlidingTables


class ScreenState(NamedTuple):
    """State of the screen; changed in place."""

    charge: Array  # (3,) C: insulator, stratum corneum, gap
    carrier: Array  # (1,) phase in turns
    held: Array  # (3,) current of the servo (A); attraction sensed (N) and whether it is a guess, for the next sample
    sums: Array  # (6,) over a sample: q^2, voltage, V re im, I re im
    estimator: GapState
    sliding: SlidingState


@kernel
def element(tau, substep, omega, turn):
    """What a substep does to the charge of a leaky capacitor."""
    kept = math.exp(-substep / tau)
    re, im = turn[0] - kept, turn[1]
    share = tau / (1.0 + (omega * tau) ** 2)
    lag = omega * tau
    return kept, share * (re + lag * im), share * (im - lag * re), -tau * math.expm1(-substep / tau)


@kernel
def within(start, swing, current, limit):
    """Share of `current` that keeps the voltage start + current swing inside +-limit."""
    rise = current * swing
    if rise > 0.0 and start + rise > limit:
        return current * max(limit - start, 0.0) / rise
    if rise < 0.0 and start + rise < -limit:
        return current * max(limit + start, 0.0) / -rise
    return current


@kernel
def gap_leak(tables, gap, resistance):
    """Leakage factor Lk and the gap's impedance (ohm m2)."""
    lag = tables.omega * resistance * VACUUM / gap
    small = 1.0 / (1.0 + lag * lag)
    return lag * lag * small, resistance * small, -resistance * lag * small


@kernel
def magnitude(tables, area, gap_re, gap_im):
    """Modulus of the whole impedance at the carrier (ohm)."""
    return math.hypot(tables.body + (tables.series[0] + gap_re) / area, (tables.series[1] + gap_im) / area)


@kernel
def substep_pass(tables, state, gap, area, envelope, direct, cosine, sine):
    """One substep of the circuit; returns the voltage at its end and the envelope that the compliance let through."""
    q, next_cosine = state.charge, cosine * tables.turn[0] - sine * tables.turn[1]
    elements = (tables.insulator, tables.corneum, gap[0])
    capacitance = (area * tables.capacitance[0], area * tables.capacitance[1], area * gap[1])
    present = later = tables.body * direct
    swing = tables.body * next_cosine
    for k in range(3):
        kept, re, im, rise = elements[k]
        present += q[k] / capacitance[k]
        later += (kept * q[k] + direct * rise) / capacitance[k]
        swing += (re * cosine - im * sine) / capacitance[k]
    envelope = within(present, tables.body * cosine, envelope, tables.voltage_limit)
    envelope = within(later, swing, envelope, tables.voltage_limit)
    for k in range(3):
        kept, re, im, rise = elements[k]
        q[k] = kept * q[k] + envelope * (re * cosine - im * sine) + direct * rise
    return later + envelope * swing, envelope


@kernel
def listen(tables, sums, voltage, envelope, direct, carrier, noise, k):
    """Add a substep's voltage and current, as their channels show them, to their envelopes."""
    cosine, sine = carrier
    late = cosine * tables.skew[0] + sine * tables.skew[1]
    current = envelope * late + direct + tables.current_noise * noise[2 + 2 * k]
    voltage += tables.voltage_noise * noise[1 + 2 * k]
    sums[2] += voltage * cosine
    sums[3] -= voltage * sine
    sums[4] += current * cosine
    sums[5] -= current * sine


@kernel
def carrier_pass(tables, state, gap, area, envelope, speed, noise):
    """A sample of the carrier: mean attraction (N) and flags; the servo and the estimator learn from it."""
    sums, held = state.sums, state.held
    flags, direct = 0, tables.offset + held[SERVO]
    angle = 2.0 * math.pi * state.carrier[0]
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(6):
        sums[i] = 0.0
    for k in range(tables.substeps):
        voltage, passed = substep_pass(tables, state, gap, area, envelope, direct, cosine, sine)
        if passed != envelope:
            flags = SATURATED
        cosine, sine = (
            cosine * tables.turn[0] - sine * tables.turn[1],
            sine * tables.turn[0] + cosine * tables.turn[1],
        )
        sums[0] += state.charge[2] * state.charge[2]
        sums[1] += voltage
        if tables.sensing:
            listen(tables, sums, voltage, passed, direct, (cosine, sine), noise, k)
    turns = state.carrier[0] + tables.turns
    state.carrier[0] = turns - math.floor(turns)
    held[SERVO] = -tables.servo * sums[1] / tables.substeps
    if tables.sensing:
        share = 2.0 / tables.substeps
        held[FORCE], guessed = gap_step(
            tables.estimator, state.estimator, share * sums[2], share * sums[3], share * sums[4], share * sums[5], speed
        )
        held[UNSENSED] = 1.0 if guessed else 0.0
    return tables.kappa * sums[0] / (tables.substeps * 2.0 * VACUUM * area), flags


@kernel
def lift(tables, state, envelope):
    """Let a finger go: no charge, no voltage; the source's own word for the current is all that there is to sense."""
    held = state.held
    for k in range(3):
        state.charge[k] = 0.0
    held[SERVO] = 0.0
    turns = state.carrier[0] + tables.turns
    state.carrier[0] = turns - math.floor(turns)
    if tables.sensing:
        current = 0.0 if tables.voltage else envelope
        held[FORCE], _ = gap_step(tables.estimator, state.estimator, 0.0, 0.0, current, 0.0, math.nan)
        held[UNSENSED] = 1.0


@kernel
def asked(tables, drive):
    """Drive inside its limit, as an envelope in its own unit, and flags."""
    drive = drive if abs(drive) < HUGE else 0.0
    envelope = square_root_step(tables.compensation, drive) if tables.compensated else drive
    limit = tables.voltage_limit if tables.voltage else tables.current_limit
    return min(max(envelope, -limit), limit), SATURATED if abs(envelope) > limit else 0


@kernel
def attract(tables, state, drive, finger, noise):
    """Mean attraction (N) over a sample, and flags."""
    load, speed = finger[LOAD], finger[SPEED]
    envelope, flags = asked(tables, drive)
    if math.isnan(speed) or load <= 0.0:
        lift(tables, state, envelope)
        return 0.0, 0
    area = tables.area * load**tables.exponent
    thickness = tables.gap * (1.0 + tables.ripple * math.cos(tables.wavenumber * finger[POSITION]))
    resistance = tables.gap_short if abs(speed) < tables.sliding.least_speed else tables.gap_resistance
    leak, gap_re, gap_im = gap_leak(tables, thickness, resistance)
    impedance = magnitude(tables, area, gap_re, gap_im)
    if tables.voltage:
        envelope /= impedance
    if tables.carrier:
        part = element(resistance * VACUUM / thickness, tables.substep, tables.omega, tables.turn)
        force, cut = carrier_pass(tables, state, (part, VACUUM / thickness), area, envelope, speed, noise)
        return force, flags | cut
    passed = within(0.0, impedance, envelope, tables.voltage_limit)
    force = tables.kappa * passed * passed * leak / (4.0 * tables.omega * tables.omega * VACUUM * area)
    return force, flags | (SATURATED if passed != envelope else 0)


@kernel
def screen_step(tables, state, drive, finger, noise, sensed, motion, felt):
    """What is sensed at the start of a sample, which then passes under `drive`; returns flags.

    `felt` is the skin velocity (m/s) at the start and the attraction (N) over the sample.
    """
    held = state.held
    reading, flags = held[FORCE], OPEN_LOOP if held[UNSENSED] > 0.0 else 0
    attraction, cut = attract(tables, state, drive, finger, noise)
    steady = tables.friction * (finger[LOAD] + attraction)
    friction, shown, skin_velocity = sliding_step(tables.sliding, state.sliding, steady, finger[SPEED], noise[0])
    motion[0] = friction
    felt[0] = skin_velocity / finger[STRENGTH] if finger[STRENGTH] > 0.0 else 0.0
    felt[1] = attraction
    if not tables.sensing:
        reading = shown
        if abs(shown) >= tables.sliding.force_range:
            flags |= SENSOR_CLIPPED
    sensed[0] = reading
    return flags | cut


@simulation
def screen_run(tables, state, drive, finger, noise, sensed, motion, felt, flags):
    """A block of the screen alone; columns of `finger` are position, load, strength, speed."""
    for n in range(drive.shape[0]):
        flags[n] = screen_step(tables, state, drive[n, 0], finger[n], noise[n], sensed[n], motion[n], felt[n])


@simulation
def closed_screen_run(
    tables, state, control, control_state, last, finger, noise, wanted, sensed, motion, felt, drive, target, flags
):
    """Screen and controller closed sample by sample; `last` (1,) is the drive computed one sample ago."""
    for n in range(sensed.shape[0]):
        drive[n, 0] = last[0]
        flags[n] = screen_step(tables, state, last[0], finger[n], noise[n], sensed[n], motion[n], felt[n])
        flags[n] |= control_step(control, control_state, sensed[n], finger[n, POSITION], wanted[n], last, target[n])
