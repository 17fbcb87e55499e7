"""Compiled tick of the paper's controller (Grigorii et al. 2021): polar loops on the STDFT*.

Estimator, law and synthesis of one sample, over all coordinates and bands.
Symbols: psi carrier phase, X envelope of a coordinate, R wanted envelope,
A and Theta commanded amplitude and phase.  A carrier that runs backwards (the
finger reverses) is followed as its mirror image: x = Re X e^{j phi} =
Re conj(X) e^{-j phi}, so that psi always runs forward and every complex state
is conjugated at the reversal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender.protocols import Array

TURN = 2.0 * math.pi
QUIET = 1e-12  # m: below this a target counts as silence and its phase means nothing
VELOCITY_POLE = 40.0  # Hz: smoothing of the finger's velocity, used only to look up gains and to fade
GATE_TIME = 0.02  # s: finger-locked targets fade in and out with contact


class PolarTables(NamedTuple):
    """Parameters of the polar controller; arrays are (coordinates, bands) or (bands,) unless said."""

    rate: float
    feedback: bool  # False: nothing is sensed, drive straight from the look-up table
    analysed: bool  # True: targets come from the wanted waveform
    drive_limit: float
    sensed_limit: float  # beyond it a sensor is not believed
    lowest: float  # Hz
    highest: float  # Hz
    frequency: Array
    wavenumber: Array
    phase: Array  # turns
    envelope: Array  # complex
    coordinate_from_sensed: Array  # (coordinates, sensors)
    drive_from_coordinate: Array  # (channels, coordinates)
    filter: Array  # b0 b1 b2 a1 a2 of the STDFT* low pass
    law: Array  # the same of the loop controller
    gain: Array  # (coordinates, table), m per drive unit
    lag: Array  # (coordinates, table), rad: phase of the free device, hold and delay included
    table_step: float  # Hz


class PolarState(NamedTuple):
    """State of the polar controller; changed in place."""

    turns: Array  # (bands,) fixed part of the carrier, turns, in [0, 1)
    forward: Array  # (bands,) +1 or -1: direction of each carrier
    motion: Array  # held position (m), velocity (m/s), gate 0..1, finger seen before (0/1)
    estimate: Array  # (4, coordinates, bands): low-pass states re1 re2 im1 im2
    reference: Array  # (4, bands): the same for the wanted waveform
    heading: Array  # (2, bands): unit vector of the last target that was not silence
    amplitude: Array  # (2, coordinates, bands): states of the amplitude loop
    angle: Array  # (2, coordinates, bands): states of the phase loop
    coordinate: Array  # (coordinates,) scratch
    command: Array  # (coordinates,) scratch


@kernel
def biquad_step(coefficients, state1, state2, x):
    """Second-order section, transposed direct form II; returns output and new states."""
    y = coefficients[0] * x + state1
    return y, coefficients[1] * x - coefficients[3] * y + state2, coefficients[2] * x - coefficients[4] * y


@kernel
def angle_cut_at_90(im, re):
    """Angle in (-270, 90] deg: the discontinuity lies far from the phases of a passive plate."""
    angle = math.atan2(im, re)
    return angle - TURN if angle > 0.5 * math.pi else angle


@kernel
def fade(frequency, lowest, highest):
    """Weight of a finger-locked carrier: 0 below half the lowest frequency, 1 inside the range, 0 at 1.25 highest."""
    low = min(max(2.0 * frequency / lowest - 1.0, 0.0), 1.0)
    high = min(max(5.0 - 4.0 * frequency / highest, 0.0), 1.0)
    return low * low * (3.0 - 2.0 * low) * high * high * (3.0 - 2.0 * high)


@kernel
def lookup(table, row, step, frequency):
    """Linear interpolation in a table over frequency."""
    at = min(frequency / step, table.shape[1] - 1.000001)
    i = int(at)
    return table[row, i] + (at - i) * (table[row, i + 1] - table[row, i])


@kernel
def follow_finger(state, rate, position):
    """Hold the position while the finger is away, smooth its velocity, open the gate with contact."""
    motion = state.motion
    seen = math.isfinite(position)
    velocity = 0.0
    if seen:
        if motion[3] > 0.0:
            velocity = (position - motion[0]) * rate
        motion[0] = position
    motion[3] = 1.0 if seen else 0.0
    motion[1] += (1.0 - math.exp(-TURN * VELOCITY_POLE / rate)) * (velocity - motion[1])
    ramp = 1.0 / (GATE_TIME * rate)
    motion[2] = min(motion[2] + ramp, 1.0) if seen else max(motion[2] - ramp, 0.0)


@kernel
def mirror(state, k):
    """Conjugate every complex state of band k: its carrier has turned round."""
    state.forward[k] = -state.forward[k]
    state.reference[2, k] = -state.reference[2, k]
    state.reference[3, k] = -state.reference[3, k]
    state.heading[1, k] = -state.heading[1, k]
    for c in range(state.estimate.shape[1]):
        state.estimate[2, c, k] = -state.estimate[2, c, k]
        state.estimate[3, c, k] = -state.estimate[3, c, k]
        state.angle[0, c, k] = -state.angle[0, c, k]
        state.angle[1, c, k] = -state.angle[1, c, k]


@kernel
def reference_step(tables, state, k, wanted, cos, sin, weight):
    """Wanted envelope of band k: constant, or the wanted waveform through the same STDFT*."""
    if tables.analysed:
        reference = state.reference
        re, reference[0, k], reference[1, k] = biquad_step(
            tables.filter, reference[0, k], reference[1, k], 2.0 * wanted * cos
        )
        im, reference[2, k], reference[3, k] = biquad_step(
            tables.filter, reference[2, k], reference[3, k], -2.0 * wanted * sin
        )
    else:
        re = tables.envelope[k].real
        im = tables.envelope[k].imag * state.forward[k]
    return weight * re, weight * im


@kernel
def polar_law(tables, state, c, k, x_re, x_im, r_re, r_im):
    """Amplitude and phase loop of one coordinate and band; returns commanded amplitude (m) and phase (rad)."""
    wanted = math.hypot(r_re, r_im)
    lag = 0.0
    if wanted > QUIET:  # phase of X against R, eq. 5 with the cut moved
        lag = angle_cut_at_90(x_im * r_re - x_re * r_im, x_re * r_re + x_im * r_im)
    theta, state.angle[0, c, k], state.angle[1, c, k] = biquad_step(
        tables.law, state.angle[0, c, k], state.angle[1, c, k], -lag
    )
    error = wanted - math.hypot(x_re, x_im)  # eq. 3
    command = max(tables.law[0] * error + state.amplitude[0, c, k], 0.0)  # never negative: feedback would turn positive
    state.amplitude[0, c, k] = tables.law[1] * error - tables.law[3] * command + state.amplitude[1, c, k]
    state.amplitude[1, c, k] = tables.law[2] * error - tables.law[4] * command
    return command, theta


@kernel
def polar_band(tables, state, k, wanted, target):
    """One band of one sample: estimate, law, synthesis into `state.command`."""
    locked = tables.wavenumber[k] > 0.0
    frequency = tables.frequency[k] + tables.wavenumber[k] * state.motion[1]
    if frequency * state.forward[k] < 0.0:
        mirror(state, k)
    forward = state.forward[k]
    frequency = abs(frequency)
    turns = state.turns[k] + tables.wavenumber[k] * state.motion[0] + tables.phase[k]
    psi = forward * TURN * (turns - math.floor(turns))
    cos = math.cos(psi)
    sin = math.sin(psi)
    weight = state.motion[2] * fade(frequency, tables.lowest, tables.highest) if locked else 1.0
    r_re, r_im = reference_step(tables, state, k, wanted, cos, sin, weight)
    target[k] = complex(r_re, forward * r_im)
    size = math.hypot(r_re, r_im)
    if size > QUIET:
        state.heading[0, k] = r_re / size
        state.heading[1, k] = r_im / size
    for c in range(state.coordinate.shape[0]):
        gain = lookup(tables.gain, c, tables.table_step, frequency)
        if tables.feedback:
            y = 2.0 * state.coordinate[c]
            x_re, state.estimate[0, c, k], state.estimate[1, c, k] = biquad_step(
                tables.filter, state.estimate[0, c, k], state.estimate[1, c, k], y * cos
            )
            x_im, state.estimate[2, c, k], state.estimate[3, c, k] = biquad_step(
                tables.filter, state.estimate[2, c, k], state.estimate[3, c, k], -y * sin
            )
            amplitude, theta = polar_law(tables, state, c, k, x_re, x_im, r_re, r_im)
        else:
            amplitude = size
            theta = -lookup(tables.lag, c, tables.table_step, frequency)
        unit_re = state.heading[0, k] * math.cos(theta) - state.heading[1, k] * math.sin(theta)
        unit_im = state.heading[0, k] * math.sin(theta) + state.heading[1, k] * math.cos(theta)
        state.command[c] += amplitude / gain * (unit_re * cos - unit_im * sin)
    turns = state.turns[k] + tables.frequency[k] / tables.rate
    state.turns[k] = turns - math.floor(turns)


@kernel
def polar_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags."""
    flags = 0
    for c in range(state.coordinate.shape[0]):
        total = 0.0
        for s in range(sensed.shape[0]):
            value = sensed[s]
            if not abs(value) <= tables.sensed_limit:  # NaN included
                value = 0.0
                flags |= 2
            total += tables.coordinate_from_sensed[c, s] * value
        state.coordinate[c] = total
        state.command[c] = 0.0
    follow_finger(state, tables.rate, position)
    for k in range(state.turns.shape[0]):
        polar_band(tables, state, k, wanted, target)
    for i in range(drive.shape[0]):
        total = 0.0
        for c in range(state.command.shape[0]):
            total += tables.drive_from_coordinate[i, c] * state.command[c]
        drive[i] = min(max(total, -tables.drive_limit), tables.drive_limit)
        if drive[i] != total:
            flags |= 1
    return flags


@kernel
def polar_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `polar_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = polar_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
