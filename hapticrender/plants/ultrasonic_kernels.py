"""Compiled ultrasonic mode, and the surface that it makes: an amplitude loop inside, sliding friction outside.

``m q'' + b q' + m w^2 q = N u`` with the drive u, the damping b and the resonance w held over a sample, integrated in
closed form: with s = b/2m, w_d = sqrt(w^2 - s^2), and e the distance to where the drive's force would hold the mode::

    e(T)  = E [(c + s/w_d S) e + S/w_d e']        E = exp(-s T)
    e'(T) = E [(c - s/w_d S) e' - w^2/w_d S e]    c, S = cos, sin(w_d T)

Velocities are scaled by the sample period, so that all states are in m.

A sample of the surface is a few samples of the carrier: the amplitude's controller follows, along a straight line, the
reference that the inverse of the friction law makes of that of friction.  That law, and the one by which the sensed
amplitude is read as friction, are those that the controller assumes; the friction is by the surface's own.
"""

import math

import numba
import numpy as np

from hapticrender.control.kernel import observed_envelope
from hapticrender.jit import F8, I8, SIGNALS, SIGNALS_T, call, kernel, pointer, step
from hapticrender.plants.compiled import HUGE, LOAD, SATURATED, SENSOR_CLIPPED, SPEED, quantise, queue_drive
from hapticrender.plants.friction_laws import LAW, friction_ratio, reference_amplitude
from hapticrender.plants.sliding_contact import SLIDING, sliding_step

DAMPING, RESONANCE, INPUTS = 4, 5, 6  # columns of the inputs beside the finger's (N s/m, rad/s), and their number
FRICTION, AMPLITUDE = range(2)  # columns of the surface's `motion`
LEAST_SLEW = 0.05  # of the drive's slew: an amplitude beyond what it can hold is still approached, and flagged

ELECTRONICS = ("mass", "force_constant", "drive_limit", "drive_step", "sensor_step", "sensor_noise")
MODE = np.dtype(
    [(name, "f8") for name in ELECTRONICS]  # as in `UltrasonicParameters`
    + [
        ("sensor_limit", "f8"),  # m
        ("period", "f8"),  # s
        ("queue", "i8"),  # address of the drive on its way, (latency, 1)
        ("latency", "i8"),  # samples
        ("oldest", "i8"),  # state: row of the queue
        ("due", "f8", (1,)),  # V that acts now
        ("z", "f8", (2,)),  # state: displacement (m) and velocity times the period (m)
        ("propagator", "f8", (4,)),  # of e, row by row
        ("compliance", "f8"),  # m/N
        ("damping", "f8"),  # N s/m for which the propagator holds
        ("resonance", "f8"),  # rad/s, alike
    ],
    align=True,
)
MODE_T = numba.from_dtype(MODE)

SURFACE = np.dtype(
    [
        ("substeps", "i8"),  # samples of the carrier in one of the surface
        ("friction_coefficient", "f8"),  # mu0, of the surface at rest; it and all down to `least_speed` as assumed
        ("bias", "f8"),  # mu/mu0 without drive
        ("least_ratio", "f8"),  # least mu/mu0 of the reference
        ("least_speed", "f8"),  # m/s: a slower finger counts as one at this speed
        ("true_coefficient", "f8"),  # mu0 of the surface itself
        ("load", "f8"),  # N that the amplitude is held for while no finger is there
        ("speed", "f8"),  # m/s, alike
        ("slew", "f8"),  # m by which the drive can change a zero amplitude in a sample of the carrier
        ("free_damping", "f8"),  # N s/m of the mode without a finger
        ("estimating", "i8"),  # the sensor is the friction that the sensed amplitude leaves; else the tribometer
        ("controller", "i8"),  # address of the amplitude controller's step
        ("controller_state", "i8"),
        ("finger_damping", "i8"),  # address of what the controller estimates of it (N s/m); 0: it does not
        ("signals", SIGNALS),  # of the amplitude loop: addresses of the six fields below
        ("signals_at", "i8"),  # its own address
        ("drive", "f8", (1,)),  # V
        ("sensed", "f8"),  # m
        ("position", "f8"),  # NaN
        ("waveform", "f8"),  # m: amplitude within reach; the last one is what the drive could reach
        ("target", "c16"),  # m
        ("flags", "i8"),
        *((name, "f8") for name in ("reference", "goal")),  # state: amplitude (m) before a sample of friction and after
        ("starting", "i8"),  # state: it starts from rest, where the loop's own ramp is slower
        ("reading", "f8"),  # state: friction (N) by the sensed amplitude, output at the next sample
        ("law", LAW),  # as assumed
        ("true_law", LAW),  # of the surface itself
        ("mode", MODE),
        ("sliding", SLIDING),
    ],
    align=True,
)
SURFACE_T = numba.from_dtype(SURFACE)


@kernel
def mode_step(m, drive, damping, resonance, noise):
    """Advance the mode by a sample under `drive` (1,); return sensed and true displacement (m) at its start, and flags.

    The step is exact for a `damping` (N s/m) and `resonance` (rad/s) that hold over the sample.
    """
    z, phi = m.z, m.propagator
    m.oldest = queue_drive(numba.carray(pointer(m.queue, F8), (m.latency, 1)), m.oldest, drive, m.due)
    displacement = z[0]
    value = displacement + m.sensor_noise * noise
    if damping != m.damping or resonance != m.resonance:
        m.damping, m.resonance = damping, resonance
        s = 0.5 * damping / m.mass
        turn = math.sqrt(resonance * resonance - s * s)
        decay = math.exp(-s * m.period)
        cosine, sine = decay * math.cos(turn * m.period), decay * math.sin(turn * m.period) / turn
        phi[0], phi[1] = cosine + s * sine, sine / m.period
        phi[2], phi[3] = -resonance * resonance * sine * m.period, cosine - s * sine
        m.compliance = 1.0 / (m.mass * resonance * resonance)
    rest = m.compliance * m.force_constant * quantise(m.due[0], m.drive_step, m.drive_limit)
    e, rate = z[0] - rest, z[1]
    z[0] = rest + phi[0] * e + phi[1] * rate
    z[1] = phi[2] * e + phi[3] * rate
    flags = SENSOR_CLIPPED if abs(value) > m.sensor_limit else 0
    return quantise(value, m.sensor_step, m.sensor_limit), displacement, flags


@step
def ultrasonic_step(state, signals, start, count):
    """Advance the mode by `count` samples; see `hapticrender.jit`."""
    m = numba.carray(pointer(state, MODE_T), 1)[0]
    io = numba.carray(pointer(signals, SIGNALS_T), 1)[0]
    end = start + count
    drive, inputs = numba.carray(pointer(io.drive, F8), (end, 1)), numba.carray(pointer(io.inputs, F8), (end, INPUTS))
    noise, sensed = numba.carray(pointer(io.noise, F8), end), numba.carray(pointer(io.sensed, F8), end)
    motion, flags = numba.carray(pointer(io.motion, F8), end), numba.carray(pointer(io.flags, I8), end)
    for n in range(start, end):
        x = inputs[n]
        sensed[n], motion[n], flags[n] = mode_step(m, drive[n], x[DAMPING], x[RESONANCE], noise[n])
    return 0


@kernel
def amplitude_decay(damping, finger, mass, period):
    """Part of its amplitude that the mode loses in a sample, by its free `damping` and that estimated of the finger."""
    return 0.5 * period * (damping + max(finger, 0.0)) / mass


@kernel
def approach(s, k, count, decay):
    """Take the waveform on a straight line to sample k of `count` to the goal, no faster than the drive can; flags.

    With a faster reference the drive would saturate, and the loop would be open.  `s` is a record with these fields.
    """
    line = s.reference + (s.goal - s.reference) * (k + 1) / count
    lost = decay * s.waveform
    rise = max(s.slew - lost, LEAST_SLEW * s.slew)
    s.waveform = line if s.starting > 0 else s.waveform + min(max(line - s.waveform, -s.slew - lost), rise)
    if k == count - 1:
        s.reference, s.starting = s.goal, 0
    return SATURATED if s.waveform != line else 0


@kernel
def sliding_reference(s, drive, load, speed):
    """Reference (m) of the amplitude for a friction `drive` (N) under a finger (N, m/s; NaN while lifted).

    Before it whole friction (N, 0 where no finger slides), load (N) and speed (m/s) for which it holds; then flags.
    Friction coefficient and law are those that the controller assumes.
    """
    touching = not math.isnan(speed) and load > 0.0
    whole = s.friction_coefficient * load if touching else 0.0
    pace = max(abs(speed), s.least_speed) if touching else s.speed
    ratio = s.bias + (drive / whole if touching and abs(drive) < HUGE else 0.0)
    inside, load = min(max(ratio, s.least_ratio), 1.0), load if touching else s.load
    return whole, load, pace, reference_amplitude(s.law, inside, load, pace), 0 if inside == ratio else SATURATED


@kernel
def amplitude_pass(s, x, noise):
    """Carry the amplitude on a straight line to the goal; return the mean true amplitude (m) and flags.

    The controller is called by address, with the signals of one sample, which are fields of the record.
    """
    m, flags, squares = s.mode, 0, 0.0
    scale, z, drive = 1.0 / (x[RESONANCE] * m.period), m.z, s.drive
    finger_damping = pointer(s.finger_damping, F8)[0] if s.finger_damping > 0 else 0.0
    decay = amplitude_decay(s.free_damping, finger_damping, m.mass, m.period)
    for k in range(s.substeps):
        flags |= approach(s, k, s.substeps, decay)
        s.sensed, _, s.flags = mode_step(m, drive, x[DAMPING], x[RESONANCE], noise[1 + k])
        call(s.controller, (s.controller_state, s.signals_at, 0, 1))
        flags |= s.flags
        squares += z[0] * z[0] + scale * scale * z[1] * z[1]
    return math.sqrt(squares / s.substeps), flags


@step
def surface_step(state, signals, start, count):
    """Advance the surface by `count` samples; see `hapticrender.jit`.  Noise: of tribometer, then carrier."""
    s = numba.carray(pointer(state, SURFACE_T), 1)[0]
    io = numba.carray(pointer(signals, SIGNALS_T), 1)[0]
    end = start + count
    drive, inputs = numba.carray(pointer(io.drive, F8), end), numba.carray(pointer(io.inputs, F8), (end, INPUTS))
    noise = numba.carray(pointer(io.noise, F8), (end, 1 + s.substeps))
    sensed = numba.carray(pointer(io.sensed, F8), end)
    motion, flags = numba.carray(pointer(io.motion, F8), (end, 2)), numba.carray(pointer(io.flags, I8), end)
    for n in range(start, end):
        x = inputs[n]
        speed = x[SPEED]
        whole, load, pace, s.goal, delayed = sliding_reference(s, drive[n], x[LOAD], speed)
        amplitude, raised = amplitude_pass(s, x, noise[n])
        steady = s.true_coefficient * x[LOAD] * friction_ratio(s.true_law, amplitude, load, speed)
        friction, reading = sliding_step(s.sliding, steady, speed, noise[n, 0])
        if s.estimating:
            reading, (re, im) = s.reading, observed_envelope(s.controller_state)
            s.reading = whole * friction_ratio(s.law, math.hypot(re, im), load, pace)
        elif abs(reading) >= s.sliding.force_range:
            raised |= SENSOR_CLIPPED
        sensed[n], flags[n] = reading, raised | delayed
        motion[n, FRICTION], motion[n, AMPLITUDE] = friction, amplitude
    return 0
