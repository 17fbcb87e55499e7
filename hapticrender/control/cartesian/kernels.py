"""Compiled tick of the plain complex methods: low pass, loop controller, inverse of the free device; no finger.

Symbols: R wanted, X estimated and V commanded envelope, v what the loop adds,
L low pass, C loop controller, D dynamic stiffness.  V = v, or R + v with
feed-forward; F = D(jw) V, or D(jw) V + D'(jw) dV/dt + j dw/dt M V.  The loop
compares R with L y, or listens to the deviation y - sum Re R e^{j phi}: then
the reference passes the same L as the signal, and the 2f image of R is gone.

Carriers are those of the band bank; rows have the band index innermost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender.compiled.jit import kernel
from hapticrender.control.bank.finger import track_finger
from hapticrender.control.bank.rows import ACCELERATION, HELD, SEEN, SPEED, VELOCITY
from hapticrender.control.kernels import (
    FAR,
    FREQUENCY,
    PHASE,
    TURN,
    WANTED_IM,
    WANTED_RE,
    WAVENUMBER,
    Section,
    biquad_step,
    doubt_pass,
    fade,
    listen_pass,
    speak_pass,
)
from hapticrender.protocols import Array

# rows of ComplexState.band: the carriers
TURNS, RAMP, WEIGHT, COS, SIN, OMEGA, SWEEP = range(7)
CARRIER_ROWS = 7
# rows of ComplexState.wanted: R, its slope, low-pass states of the wanted waveform
R, DR, RAW1, RAW2 = range(4)
WANTED_ROWS = 4
# rows of ComplexState.loop, LOOP_ROWS for each coordinate: low-pass states, controller states, V, its slope
LOW1, LOW2, LAW1, LAW2, V, DV = range(6)
LOOP_ROWS = 6
FORGET = 50.0  # 1/s: a finger-locked loop lets go where its carrier has faded


class ComplexNumbers(NamedTuple):
    """What all bands share."""

    rate: float
    feedback: bool
    analysed: bool
    presence: bool  # targets are wanted only while a finger is there
    least_speed: float  # m/s: and slides at least so fast
    modulated: bool  # the wanted waveform is a factor of every target
    differentiated: bool  # what is wanted is the time derivative of what the tones say
    forward: bool  # V = R + v
    deviation: bool  # listen to the deviation
    dynamic: bool  # D and D', not D alone
    lead: float  # s: delay and half the hold
    ramp: float  # per sample
    lowest: float  # Hz
    highest: float
    drive_limit: float
    sensed_limit: float
    analysis: Section  # low pass of the wanted waveform
    filter: Section  # L
    law: Section  # C


class ComplexTables(NamedTuple):
    """Parameters of the complex controller."""

    numbers: ComplexNumbers
    tone: Array  # (5, bands)
    listen: Array  # (coordinates, sensors)
    speak: Array  # (channels, coordinates): drive per force
    mass: Array  # (coordinates, coordinates)
    damping: Array
    stiffness: Array
    shape: Array  # (coordinates,) pattern of the target


class ComplexState(NamedTuple):
    """State of the complex controller; changed in place."""

    band: Array  # (CARRIER_ROWS, bands)
    wanted: Array  # (WANTED_ROWS, bands), complex
    loop: Array  # (coordinates * LOOP_ROWS, bands), complex
    track: Array  # the finger's motion
    coordinate: Array  # (2, coordinates) scratch: displacement, force
    doubt: Array  # (1,) 0: the sensors are believed, 1: they are not


@kernel
def carrier_pass(numbers, tone, band, track):
    """Phase, frequency, sweep and weight of every carrier."""
    for k in range(tone.shape[1]):
        wavenumber = tone[WAVENUMBER, k]
        band[OMEGA, k] = TURN * (tone[FREQUENCY, k] + wavenumber * track[VELOCITY])
        band[SWEEP, k] = TURN * wavenumber * track[ACCELERATION]
        turns = band[TURNS, k] + wavenumber * track[HELD] + tone[PHASE, k]
        psi = TURN * (turns - math.floor(turns))
        band[COS, k], band[SIN, k] = math.cos(psi), math.sin(psi)
        felt = track[SEEN] > 0.0
        if numbers.presence:
            felt = felt and track[SPEED] >= numbers.least_speed
        else:
            felt = felt or wavenumber == 0.0
        ramp = min(band[RAMP, k] + numbers.ramp, 1.0) if felt else max(band[RAMP, k] - numbers.ramp, 0.0)
        band[RAMP, k] = ramp
        weight = ramp * ramp * (3.0 - 2.0 * ramp)
        if wavenumber > 0.0:
            weight *= fade(abs(band[OMEGA, k]) / TURN, numbers.lowest, numbers.highest)
        band[WEIGHT, k] = weight
        turns = band[TURNS, k] + tone[FREQUENCY, k] / numbers.rate
        band[TURNS, k] = turns - math.floor(turns)


@kernel
def wanted_pass(numbers, tone, band, envelope, waveform, target):
    """Wanted envelope R and its slope: constant, or the wanted waveform through the STDFT*; returns what R sums to."""
    total = 0.0
    for k in range(tone.shape[1]):
        carrier = complex(band[COS, k], band[SIN, k])
        raw = complex(tone[WANTED_RE, k], tone[WANTED_IM, k])
        if numbers.analysed:
            raw, envelope[RAW1, k], envelope[RAW2, k] = biquad_step(
                numbers.analysis, envelope[RAW1, k], envelope[RAW2, k], 2.0 * waveform * carrier.conjugate()
            )
        if numbers.modulated:
            raw *= waveform
        if numbers.differentiated:
            raw *= complex(0.0, band[OMEGA, k])
        now = band[WEIGHT, k] * raw
        envelope[DR, k] = (now - envelope[R, k]) * numbers.rate
        envelope[R, k] = target[k] = now
        total += (now * carrier).real
    return total


@kernel
def loop_pass(numbers, band, envelope, loop, c, shape, heard):
    """V and its slope in coordinate c over all bands, from what is `heard` there."""
    base = c * LOOP_ROWS
    for k in range(band.shape[1]):
        v = 0j
        if numbers.feedback:
            weight = band[WEIGHT, k]
            x, loop[base + LOW1, k], loop[base + LOW2, k] = biquad_step(
                numbers.filter,
                loop[base + LOW1, k],
                loop[base + LOW2, k],
                2.0 * heard * complex(band[COS, k], -band[SIN, k]),
            )
            error = -x if numbers.deviation else shape * envelope[R, k] - x
            keep = 1.0 - FORGET * (1.0 - weight) / numbers.rate
            v, law1, law2 = biquad_step(numbers.law, loop[base + LAW1, k], loop[base + LAW2, k], weight * error)
            loop[base + LAW1, k], loop[base + LAW2, k] = keep * law1, keep * law2
        if numbers.forward:
            v += shape * envelope[R, k]
        loop[base + DV, k] = (v - loop[base + V, k]) * numbers.rate
        loop[base + V, k] = v


@kernel
def force_pass(numbers, mass, damping, stiffness, band, loop, force):
    """F = D V, or D V + D' dV/dt + j dw/dt M V, turned ahead by delay and hold."""
    coordinates = force.shape[0]
    for k in range(band.shape[1]):
        omega, sweep = band[OMEGA, k], band[SWEEP, k]
        angle = numbers.lead * (omega + 0.5 * sweep * numbers.lead)
        x = 0.5 * omega / numbers.rate
        grow = x / math.sin(x) if abs(x) > 1e-9 else 1.0
        ahead = grow * complex(math.cos(angle), math.sin(angle)) * complex(band[COS, k], band[SIN, k])
        for c in range(coordinates):
            total = 0j
            for i in range(coordinates):
                m, b, value = mass[c, i], damping[c, i], loop[i * LOOP_ROWS + V, k]
                total += complex(stiffness[c, i] - omega * omega * m, omega * b) * value
                if numbers.dynamic:
                    total += complex(b, 2.0 * omega * m) * loop[i * LOOP_ROWS + DV, k]
                    total += complex(0.0, sweep * m) * value
            force[c] += (total * ahead).real


@kernel
def complex_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags."""
    numbers, shape, band, loop = tables.numbers, tables.shape, state.band, state.loop
    heard, force = state.coordinate[0], state.coordinate[1]
    flags = listen_pass(numbers, tables.listen, sensed, heard)
    trust = doubt_pass(numbers, state.doubt, loop, flags)
    if not abs(wanted) <= FAR:
        wanted = 0.0
        flags |= 2
    if abs(position) > FAR:
        position = math.nan
        flags |= 2
    track_finger(state.track, numbers.rate, position)
    carrier_pass(numbers, tables.tone, band, state.track)
    total = wanted_pass(numbers, tables.tone, band, state.wanted, wanted, target)
    for c in range(shape.shape[0]):
        if numbers.deviation:
            heard[c] -= shape[c] * total
        loop_pass(numbers, band, state.wanted, loop, c, shape[c], heard[c])
        force[c] = 0.0
    force_pass(numbers, tables.mass, tables.damping, tables.stiffness, band, loop, force)
    return flags | speak_pass(numbers, tables.speak, force, trust, drive)


@kernel
def complex_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `complex_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = complex_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
