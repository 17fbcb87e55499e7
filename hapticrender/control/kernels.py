"""Compiled tick of the paper's controller (Grigorii et al. 2021): polar loops on the STDFT*.

Estimator, law and synthesis of one sample, over all coordinates and bands.
Symbols: psi carrier phase, X envelope of a coordinate, R wanted envelope,
A and Theta commanded amplitude and phase.  A carrier that runs backwards (the
finger reverses) is followed as its mirror image: x = Re X e^{j phi} =
Re conj(X) e^{-j phi}, so that psi always runs forward and every complex state
is conjugated at the reversal.

Everything a band owns is a column of a 2-D array, the band index innermost;
rows are named below.  Numbers shared by all bands travel in a tuple without
arrays, which costs nothing to pass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender.protocols import Array

TURN = 2.0 * math.pi
QUIET = 1e-12  # m: below this a target counts as silence and its phase means nothing
FAR = 1e3  # m: no finger is farther away and no texture wants more; beyond it a value is not believed
FASTEST = 10.0  # m/s: no finger is faster; a longer way within a sample is a new touch elsewhere
DOUBT_TIME = 0.02  # s: within this the drive fades out where a sensor cannot be believed
VELOCITY_POLE = 40.0  # Hz: smoothing of the finger's velocity, used only to look up gains and to fade
GATE_TIME = 0.02  # s: finger-locked targets fade in and out with contact

# rows of PolarTables.tone
FREQUENCY, WAVENUMBER, PHASE, WANTED_RE, WANTED_IM = range(5)
TONE_ROWS = 5
# rows of PolarState.band: fixed part of the carrier (turns), its direction (+1, -1), unit vector of the last target
# that was not silence, low-pass states of the wanted waveform; then what this sample's carrier and target are
TURNS, FORWARD, HEADING_RE, HEADING_IM, REF_RE1, REF_RE2, REF_IM1, REF_IM2 = range(8)
COS, SIN, TARGET_RE, TARGET_IM, NOW = range(8, 13)
BAND_ROWS = 13
# rows of PolarState.loop, LOOP_ROWS for each coordinate: low-pass states, states of amplitude and phase loop
RE1, RE2, IM1, IM2, AMPLITUDE1, AMPLITUDE2, THETA1, THETA2, X_RE, X_IM = range(10)
LOOP_ROWS = 10
# entries of PolarState.finger
HELD, VELOCITY, GATE, SEEN = range(4)

Section = tuple[float, float, float, float, float]  # b0 b1 b2 a1 a2, a0 = 1


class PolarNumbers(NamedTuple):
    """What all bands share."""

    rate: float
    feedback: bool  # False: nothing is sensed, drive straight from the look-up table
    analysed: bool  # True: targets come from the wanted waveform
    drive_limit: float
    sensed_limit: float  # beyond it a sensor is not believed
    lowest: float  # Hz
    highest: float  # Hz
    floor: float  # m: least command amplitude, 0; naive: -inf
    subtract: bool  # naive: phase of X minus phase of R, each with its own seam
    filter: Section  # low pass of the STDFT*
    law: Section  # loop controller
    table_step: float  # Hz
    lead: float  # s: known delay and half the hold


class PolarTables(NamedTuple):
    """Parameters of the polar controller."""

    numbers: PolarNumbers
    tone: Array  # (TONE_ROWS, bands)
    listen: Array  # (coordinates, sensors)
    speak: Array  # (channels, coordinates)
    gain: Array  # (coordinates, table), m per drive unit
    lag: Array  # (coordinates, table), rad: phase of the free device


class PolarState(NamedTuple):
    """State of the polar controller; changed in place."""

    band: Array  # (BAND_ROWS, bands)
    loop: Array  # (coordinates * LOOP_ROWS, bands)
    finger: Array  # (4,) held position (m), velocity (m/s), gate 0..1, seen before (0 or 1)
    coordinate: Array  # (coordinates,) scratch
    doubt: Array  # (1,) 0: the sensors are believed, 1: they are not


@kernel
def biquad_step(section, state1, state2, x):
    """Second-order section, transposed direct form II; returns output and new states."""
    y = section[0] * x + state1
    return y, section[1] * x - section[3] * y + state2, section[2] * x - section[4] * y


@kernel
def size(re, im):
    """Magnitude of a complex number; the amplitudes here neither overflow nor underflow."""
    return math.sqrt(re * re + im * im)


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
def follow_finger(finger, rate, position):
    """Hold the position while the finger is away, smooth its velocity, open the gate with contact."""
    seen = abs(position) <= FAR and not (finger[SEEN] > 0.0 and abs(position - finger[HELD]) * rate > FASTEST)
    velocity = 0.0
    if seen:
        if finger[SEEN] > 0.0:
            velocity = (position - finger[HELD]) * rate
        finger[HELD] = position
    finger[SEEN] = 1.0 if seen else 0.0
    finger[VELOCITY] += (1.0 - math.exp(-TURN * VELOCITY_POLE / rate)) * (velocity - finger[VELOCITY])
    ramp = 1.0 / (GATE_TIME * rate)
    finger[GATE] = min(finger[GATE] + ramp, 1.0) if seen else max(finger[GATE] - ramp, 0.0)


@kernel
def mirror(band, loop, k):
    """Conjugate every complex state of band k: its carrier has turned round.

    The commanded phase stays: it makes up for the plant's lag at |f|, which does not care about the direction.
    """
    for row in (FORWARD, HEADING_IM, REF_IM1, REF_IM2):
        band[row, k] = -band[row, k]
    for base in range(0, loop.shape[0], LOOP_ROWS):
        for row in (IM1, IM2):
            loop[base + row, k] = -loop[base + row, k]


@kernel
def carrier_pass(numbers, tone, band, loop, finger, wanted, target):
    """Carrier and wanted envelope of every band: constant, or the wanted waveform through the same STDFT*."""
    for k in range(tone.shape[1]):
        wavenumber = tone[WAVENUMBER, k]
        frequency = tone[FREQUENCY, k] + wavenumber * finger[VELOCITY]
        if frequency * band[FORWARD, k] < 0.0:
            mirror(band, loop, k)
        forward = band[FORWARD, k]
        band[NOW, k] = abs(frequency)
        turns = band[TURNS, k] + wavenumber * finger[HELD] + tone[PHASE, k]
        psi = forward * TURN * (turns - math.floor(turns))
        cos, sin = math.cos(psi), math.sin(psi)
        if numbers.analysed:
            re, band[REF_RE1, k], band[REF_RE2, k] = biquad_step(
                numbers.filter, band[REF_RE1, k], band[REF_RE2, k], 2.0 * wanted * cos
            )
            im, band[REF_IM1, k], band[REF_IM2, k] = biquad_step(
                numbers.filter, band[REF_IM1, k], band[REF_IM2, k], -2.0 * wanted * sin
            )
        else:
            re, im = tone[WANTED_RE, k], forward * tone[WANTED_IM, k]
        if wavenumber > 0.0:
            weight = finger[GATE] * fade(abs(frequency), numbers.lowest, numbers.highest)
            re, im = weight * re, weight * im
        band[COS, k], band[SIN, k], band[TARGET_RE, k], band[TARGET_IM, k] = cos, sin, re, im
        target[k] = complex(re, forward * im)
        amplitude = size(re, im)
        if amplitude > QUIET:
            band[HEADING_RE, k], band[HEADING_IM, k] = re / amplitude, im / amplitude
        turns = band[TURNS, k] + tone[FREQUENCY, k] / numbers.rate
        band[TURNS, k] = turns - math.floor(turns)


@kernel
def star_pass(numbers, band, loop, c, y):
    """STDFT* (eq. 1, 3, 4): envelopes X of coordinate c."""
    base = c * LOOP_ROWS
    for k in range(band.shape[1]):
        loop[base + X_RE, k], loop[base + RE1, k], loop[base + RE2, k] = biquad_step(
            numbers.filter, loop[base + RE1, k], loop[base + RE2, k], 2.0 * y * band[COS, k]
        )
        loop[base + X_IM, k], loop[base + IM1, k], loop[base + IM2, k] = biquad_step(
            numbers.filter, loop[base + IM1, k], loop[base + IM2, k], -2.0 * y * band[SIN, k]
        )


@kernel
def polar_pass(numbers, gain, band, loop, c):
    """Amplitude and phase loops of coordinate c over all bands; returns its drive."""
    base = c * LOOP_ROWS
    total = 0.0
    for k in range(band.shape[1]):
        r_re, r_im, x_re, x_im = band[TARGET_RE, k], band[TARGET_IM, k], loop[base + X_RE, k], loop[base + X_IM, k]
        wanted = size(r_re, r_im)
        lag = 0.0
        if wanted > QUIET:
            if numbers.subtract:
                lag = angle_cut_at_90(x_im, x_re) - angle_cut_at_90(r_im, r_re)
            else:  # phase of X against R, eq. 5 with the cut moved
                lag = angle_cut_at_90(x_im * r_re - x_re * r_im, x_re * r_re + x_im * r_im)
        theta, loop[base + THETA1, k], loop[base + THETA2, k] = biquad_step(
            numbers.law, loop[base + THETA1, k], loop[base + THETA2, k], -lag
        )
        law = numbers.law
        error = wanted - size(x_re, x_im)  # eq. 3
        command = max(law[0] * error + loop[base + AMPLITUDE1, k], numbers.floor)  # negative: positive feedback
        loop[base + AMPLITUDE1, k] = law[1] * error - law[3] * command + loop[base + AMPLITUDE2, k]
        loop[base + AMPLITUDE2, k] = law[2] * error - law[4] * command
        total += command / lookup(gain, c, numbers.table_step, band[NOW, k]) * synthesise(band, k, theta)
    return total


@kernel
def open_pass(numbers, gain, lag, band, c):
    """Drive of coordinate c straight from the look-up table, turned ahead by delay and hold."""
    total = 0.0
    for k in range(band.shape[1]):
        now = band[NOW, k]
        wanted = size(band[TARGET_RE, k], band[TARGET_IM, k])
        unit = synthesise(band, k, TURN * now * numbers.lead - lookup(lag, c, numbers.table_step, now))
        total += wanted / lookup(gain, c, numbers.table_step, now) * unit
    return total


@kernel
def synthesise(band, k, theta):
    """Carrier of band k, of unit amplitude, `theta` (rad) ahead of the direction of its target."""
    cos, sin = math.cos(theta), math.sin(theta)
    re = band[HEADING_RE, k] * cos - band[HEADING_IM, k] * sin
    im = band[HEADING_RE, k] * sin + band[HEADING_IM, k] * cos
    return re * band[COS, k] - im * band[SIN, k]


@kernel
def listen_pass(numbers, listen, sensed, coordinate):
    """Coordinates from sensors; what no sensor can show counts as zero.  Returns flags."""
    flags = 0
    for c in range(coordinate.shape[0]):
        coordinate[c] = 0.0
        for s in range(sensed.shape[0]):
            if abs(sensed[s]) <= numbers.sensed_limit:
                coordinate[c] += listen[c, s] * sensed[s]
            else:  # NaN included
                flags |= 2
    return flags


@kernel
def doubt_pass(numbers, doubt, loop, flags):
    """Trust in the sensors: falls to 0 within 20 ms while one cannot be believed; then the loops start anew."""
    step = 1.0 / (DOUBT_TIME * numbers.rate)
    doubt[0] = min(doubt[0] + step, 1.0) if flags & 2 else max(doubt[0] - step, 0.0)
    if doubt[0] == 1.0:
        for row in range(loop.shape[0]):  # a slice assignment would cost 100 ns even where it is not reached
            for k in range(loop.shape[1]):
                loop[row, k] = 0.0
    return 1.0 - doubt[0]


@kernel
def speak_pass(numbers, speak, coordinate, trust, drive):
    """Drive of the channels from that of the coordinates, each cut to its limit.  Returns flags."""
    flags = 0
    for i in range(drive.shape[0]):
        total = 0.0
        for c in range(coordinate.shape[0]):
            total += trust * speak[i, c] * coordinate[c]
        drive[i] = min(max(total, -numbers.drive_limit), numbers.drive_limit)
        if drive[i] != total:
            flags |= 1
    return flags


@kernel
def polar_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags."""
    numbers, gain, band, loop, coordinate = tables.numbers, tables.gain, state.band, state.loop, state.coordinate
    flags = listen_pass(numbers, tables.listen, sensed, coordinate)
    trust = doubt_pass(numbers, state.doubt, loop, flags)
    if not abs(wanted) <= FAR:
        wanted = 0.0
        flags |= 2
    if abs(position) > FAR:
        position = math.nan
        flags |= 2
    follow_finger(state.finger, numbers.rate, position)
    carrier_pass(numbers, tables.tone, band, loop, state.finger, wanted, target)
    for c in range(coordinate.shape[0]):
        if numbers.feedback:
            star_pass(numbers, band, loop, c, coordinate[c])
            coordinate[c] = polar_pass(numbers, gain, band, loop, c)
        else:
            coordinate[c] = open_pass(numbers, gain, tables.lag, band, c)
    return flags | speak_pass(numbers, tables.speak, coordinate, trust, drive)


@kernel
def polar_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `polar_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = polar_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
