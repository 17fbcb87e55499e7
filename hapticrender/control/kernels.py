"""What every family of compiled steps shares: constants, rows of the tones, sections, and the scalar passes."""

from __future__ import annotations

import math

from hapticrender.compiled.jit import kernel

TURN = 2.0 * math.pi
QUIET = 1e-12  # m: below this a target counts as silence and its phase means nothing
FAR = 1e3  # m: no finger is farther away and no texture wants more; beyond it a value is not believed
FASTEST = 10.0  # m/s: no finger is faster; a longer way within a sample is a new touch elsewhere
DOUBT_TIME = 0.02  # s: within this the drive fades out where a sensor cannot be believed

# rows of a controller's tone
FREQUENCY, WAVENUMBER, PHASE, WANTED_RE, WANTED_IM = range(5)
TONE_ROWS = 5

Section = tuple[float, float, float, float, float]  # b0 b1 b2 a1 a2, a0 = 1


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
def fade(frequency, lowest, highest):
    """Weight of a finger-locked carrier: 0 below half the lowest frequency, 1 inside the range, 0 at 1.25 highest."""
    low = min(max(2.0 * frequency / lowest - 1.0, 0.0), 1.0)
    high = min(max(5.0 - 4.0 * frequency / highest, 0.0), 1.0)
    return low * low * (3.0 - 2.0 * low) * high * high * (3.0 - 2.0 * high)


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
    for i in range(speak.shape[0]):
        total = 0.0
        for c in range(coordinate.shape[0]):
            total += trust * speak[i, c] * coordinate[c]
        drive[i] = min(max(total, -numbers.drive_limit), numbers.drive_limit)
        if drive[i] != total:
            flags |= 1
    return flags
