"""Compiled steps between a controller and its device: the square root of a screen, a carrier, a vibrating surface.

A step is that of `hapticrender.jit`, with a record of `CONVERSION` in place of signals: `act` converts the controller's
drive to what is played, `sense` what the device gives to what the controller senses.
"""

import math

import numba
import numpy as np
from numba import carray

from hapticrender.control.kernel import observed_envelope
from hapticrender.control.records import CONTROLLER_T
from hapticrender.jit import CONVERSION_T, F8, I8, SIGNALS, call, kernel, pointer, record, step
from hapticrender.plants.compiled import HUGE
from hapticrender.plants.friction_laws import LAW, friction_ratio
from hapticrender.plants.ultrasonic_kernels import amplitude_decay, approach, sliding_reference
from hapticrender.protocols import Flag

SIGMAS = 8.0  # of noise
QUIET = 64  # samples at the start, before the drive has risen, that show the noise of the sensor
STOPPED = int(Flag.STOPPED)

ROOT = np.dtype(
    [
        *((name, np.int64) for name in ("channels", "sensors", "hold", "straight")),
        *((name, np.float64) for name in ("bias", "goal", "rise", "floor", "gain", "turns", "turn", "crest")),
    ]
)
"""Square root for the last channel: its bias (state; N), the bias that it rises to, by how much of it a sample, its
floor (over the bias) and gain (N/A^2), whether there is no root; the carrier's phase (state) and turns a sample of the
device, 0 where only its peak is played, and its crest."""
ROOT_T = numba.from_dtype(ROOT)


@step
def root_act(state, signals, start, count):
    """Turn the last channel's drive (N) into a carrier's peak (A), or the carrier, by the square root around a bias.

    The bias never falls; while there is none the drive is zero.
    """
    r, io = record(state, ROOT_T, 0), record(signals, CONVERSION_T, 0)
    drive = carray(pointer(io.drive, F8), (start + count, r.channels))
    played = carray(pointer(io.played, F8), ((start + count) * r.hold, r.channels))
    for n in range(start, start + count):
        r.bias, peak = max(r.bias, min(r.bias + r.rise * r.goal, r.goal)), 0.0
        if r.bias > 0.0:
            attraction = max(r.bias + drive[n, r.channels - 1], r.floor * r.bias) / r.gain
            peak = attraction / np.sqrt(2 * r.bias / r.gain) if r.straight > 0 else np.sqrt(attraction)
        for k in range(r.hold):
            for i in range(r.channels - 1):
                played[n * r.hold + k, i] = drive[n, i]
            played[n * r.hold + k, r.channels - 1] = peak * r.crest * np.cos(2 * np.pi * (r.turns + k * r.turn))
        r.turns = (r.turns + r.hold * r.turn) % 1.0
    return 0


@step
def magnitude_sense(state, signals, start, count):
    """Take what is sensed as a magnitude."""
    r, io = record(state, ROOT_T, 0), record(signals, CONVERSION_T, 0)
    end = (start + count) * r.sensors
    raw, sensed = carray(pointer(io.raw, F8), end), carray(pointer(io.sensed, F8), end)
    for n in range(start * r.sensors, end):
        sensed[n] = abs(raw[n])
    return 0


RESONANT = np.dtype(
    [
        *(
            (name, "i8")
            for name in ("hold", "piece", "sensors", "controller", "controller_state", "observed", "signals_at")
        ),
        *((name, "f8") for name in ("friction_coefficient", "bias", "least_ratio", "least_speed", "load", "speed")),
        *((name, "f8") for name in ("slew", "free_damping", "mass", "period")),  # as in `SURFACE`
        *((name, "f8") for name in ("twice", "sine", "share", "stated", "driven")),  # of the test for jumps
        ("signals", SIGNALS),  # of the amplitude loop: addresses of the six fields below
        ("drive", "f8", (1,)),  # V
        ("sensed", "f8"),  # m
        ("position", "f8"),  # NaN
        ("waveform", "f8"),  # m: amplitude within reach; the last one is what the drive could reach
        ("target", "c16"),  # m
        ("flags", "i8"),
        *((name, "f8") for name in ("reference", "goal")),  # state: amplitude (m) before a sample of friction and after
        ("starting", "i8"),  # state: it starts from rest, where the loop's own ramp is slower
        # state, of that sample (N, N, m/s, N):
        *((name, "f8") for name in ("sliding_friction", "touch_load", "touch_speed", "friction")),
        *((name, "i8") for name in ("samples", "jumped")),  # state: samples of the device; at which it jumped, or -1
        *((name, "f8") for name in ("before", "last", "noise_sum")),  # state: the last two samples (m); sum of squares
        ("counted", "i8"),  # state: of so many differences
        ("peaks_at", "i8"),  # V: largest drives of the pieces that act, a ring
        *((name, "i8") for name in ("peaks", "peak")),  # their number; state: the next one
        ("law", LAW),
    ],
    align=True,
)
RESONANT_T = numba.from_dtype(RESONANT)


@kernel
def jumps(r, raw, start, count, lost):
    """Whether the sensor has jumped: ``e = y_n - 2 cos(w T) y_n-1 + y_n-2`` is 0 in a steady vibration.

    A drive u adds N u T^2/m at most, and what decays w T/Q of the amplitude, 1/9 where a finger damps most.  A gain
    that changes by g makes (g - 1) y_n, then (1 - g) y_n-1, of which one is at least |g - 1| sin(w T/2) of it; half of
    that for 1/3 is the bound.  Noise is what is stated, or the first `QUIET` samples show.  Nothing is compared where a
    converter holds its values, or samples were lost.
    """
    unknown, found, bound = r.counted < QUIET, False, 0.0
    if not unknown:
        peaks = carray(pointer(r.peaks_at, F8), r.peaks)
        bound = SIGMAS * max(r.stated, math.sqrt(r.noise_sum / r.counted)) + r.driven * peaks.max()
    before, last = (math.nan, math.nan) if lost else (r.before, r.last)
    for n in range(start, start + count):
        y = raw[n]
        change = abs(y - r.twice * last + before)
        if not unknown:
            size = math.sqrt(max(last * last + before * before - r.twice * last * before, 0.0)) / r.sine
            found |= y != last and last != before and change > bound + r.share * size
        elif change < HUGE:
            r.noise_sum += change * change
            r.counted += 1
        before, last = last, y
    r.before, r.last = before, last
    return found


@kernel
def advance(r, io, start, count, lost):
    """Take the amplitude on by a piece of a block, whose samples are tested before any drive is computed from them."""
    end = start + count
    rows = (end - 1) // r.hold + 1
    raw, played = carray(pointer(io.raw, F8), end), carray(pointer(io.played, F8), end)
    drive, finger = carray(pointer(io.drive, F8), rows), carray(pointer(io.finger, F8), (rows, 2))
    sensed, flags = carray(pointer(io.sensed, F8), rows), carray(pointer(io.flags, I8), rows)
    r.samples += count
    if r.sensors > 0 and r.jumped < 0 and jumps(r, raw, start, count, lost):
        r.jumped = r.samples
    finger_damping = record(r.observed, CONTROLLER_T, 0).finger_damping
    decay, peak = amplitude_decay(r.free_damping, finger_damping, r.mass, r.period), 0.0
    for n in range(start, end):
        row, k = n // r.hold, n % r.hold
        if k == 0:
            touch = finger[row]
            found = sliding_reference(r, drive[row], touch[0], touch[1])
            r.sliding_friction, r.touch_load, r.touch_speed, r.goal, raised = found
            flags[row] |= raised
            if r.sensors > 0:
                sensed[row] = r.friction
        flags[row] |= approach(r, k, r.hold, decay)
        r.sensed, r.flags = raw[n] if r.sensors > 0 else 0.0, 0
        call(r.controller, (r.controller_state, r.signals_at, 0, 1))
        played[n] = r.drive[0] if r.jumped < 0 else 0.0
        flags[row] |= r.flags if r.jumped < 0 else STOPPED
        peak = max(peak, abs(played[n]))
        if k == r.hold - 1:
            re, im = observed_envelope(r.observed)
            r.friction = r.sliding_friction * friction_ratio(r.law, math.hypot(re, im), r.touch_load, r.touch_speed)
    carray(pointer(r.peaks_at, F8), r.peaks)[r.peak] = peak
    r.peak = (r.peak + 1) % r.peaks


@step
def resonant_sense(state, signals, start, count):
    """Take the amplitude on by a block of the device; its friction comes out once in `hold` samples.

    From a jump on nothing is played.
    """
    r, io = record(state, RESONANT_T, 0), record(signals, CONVERSION_T, 0)
    for first in range(start, start + count, r.piece):
        advance(r, io, first, r.piece, io.lost > 0 and first == start)
    return 0
