"""Compiled electroadhesive screen with a finger on it: the circuit at the carrier, or its envelope, and friction.

Charges q_k of the insulator, the stratum corneum and the gap obey q' = i - q/tau with tau = R C, which does not depend
on the contact area.  Over a substep h the current is I cos(theta + w u), and exactly::

    q+ = a q + I Re(e^{j theta} (e^{j w h} - a)/(j w + 1/tau)),  a = e^{-h/tau}

The carrier turns a whole number of times in a sample, so every sample starts at theta = 0.
"""

import math

import numba
import numpy as np

from hapticrender.jit import F8, I8, SIGNALS_T, kernel, pointer, step
from hapticrender.plants.compiled import HUGE, LOAD, SATURATED, SENSOR_CLIPPED, SPEED
from hapticrender.plants.gap_estimator import GAP, VACUUM, gap_step
from hapticrender.plants.sliding_contact import SLIDING, sliding_step
from hapticrender.protocols import Flag

OPEN_LOOP = int(Flag.OPEN_LOOP)
FRICTION, ATTRACTION = range(2)  # columns of `motion`
INPUTS = 4  # columns of the inputs

FLAGS = ("carrier", "voltage", "sensing", "straight")  # level, kind of drive, sensor, no square root
NUMBERS = (  # named as in `ElectroadhesionParameters` and `SquareRoot`
    *("bias", "floor", "gain", "omega", "current_limit", "voltage_limit"),
    *("stray_capacitance", "body_resistance", "gap_resistance", "gap_short", "unevenness"),
    *("area_exponent", "voltage_noise", "current_noise", "friction_coefficient"),
)
SCREEN = np.dtype(
    [(name, "i8") for name in (*FLAGS, "oversampling")]
    + [(name, "f8") for name in NUMBERS]
    + [
        ("series_impedance", "c16"),  # ohm m2
        ("area", "f8"),  # m2 at 1 N
        ("goal", "f8"),  # N: bias of the compensation, to which the present one rises; 0: there is none
        ("rise", "f8"),  # N a sample
        ("substep", "f8"),  # h, s
        ("turn", "c16"),  # e^{j w h}
        ("capacitance", "f8", (3,)),  # F/m2 of insulator, stratum corneum, gap
        ("retention", "f8", (3,)),  # a of their charges in a substep
        ("alternating", "c16", (3,)),  # (e^{j w h} - a)/(j w + 1/tau), s
        ("charge", "f8", (3,)),  # state: C
        ("envelopes", "c16", (2,)),  # state: V and A of the last sample
        ("reading", "f8"),  # state: estimated attraction (N), output at the next sample
        ("open_loop", "i8"),  # state: whether it is the nominal one
        ("gap", GAP),
        ("sliding", SLIDING),
    ],
    align=True,
)
SCREEN_T = numba.from_dtype(SCREEN)


@kernel
def element(tau, substep, omega, turn):
    """Share of its charge that an element with the time constant `tau` (s) keeps in a substep, and its gain (s).

    The gain is that of a current at the carrier, whose phase is e^{j theta} at the start.
    """
    a, lag = math.exp(-substep / tau), omega * tau
    return a, (turn - a) * complex(1.0, -lag) * (tau / (1.0 + lag * lag))


@kernel
def within(start, change, current, limit):
    """Largest part of `current` that keeps the voltage start + current change inside +-limit."""
    rise = current * change
    if rise > 0.0 and start + rise > limit:
        return current * max(limit - start, 0.0) / rise
    if rise < 0.0 and start + rise < -limit:
        return current * max(limit + start, 0.0) / -rise
    return current


@kernel
def substep_pass(s, area, peak, phasor):
    """Advance the charges by a substep under a current of `peak` (A), from e^{j theta} = `phasor`.

    Returns the voltage (V) at its end and the peak that the source's compliance leaves.
    """
    q, start, end = s.charge, 0.0, 0.0
    at_start, at_end = s.body_resistance * phasor.real, s.body_resistance * (phasor * s.turn).real
    for k in range(3):
        inverse = 1.0 / (area * s.capacitance[k])
        start += q[k] * inverse
        end += s.retention[k] * q[k] * inverse
        at_end += (s.alternating[k] * phasor).real * inverse
    peak = within(start, at_start, peak, s.voltage_limit)
    peak = within(end, at_end, peak, s.voltage_limit)
    for k in range(3):
        q[k] = s.retention[k] * q[k] + (s.alternating[k] * phasor).real * peak
    return end + at_end * peak, peak


@kernel
def carrier_pass(s, area, peak, source, noise):
    """Advance the circuit by a sample of the carrier; return the mean attraction (N) and flags.

    `source` is the current of the source per current through the finger.
    """
    flags, phasor, share = 0, 1.0 + 0.0j, 1.0 / s.oversampling
    squares, voltages, currents = 0.0, 0j, 0j
    for k in range(s.oversampling):
        voltage, passed = substep_pass(s, area, peak, phasor)
        if passed != peak:
            flags = SATURATED
        phasor *= s.turn
        squares += s.charge[2] * s.charge[2]
        if s.sensing:
            voltages += (voltage + s.voltage_noise * noise[1 + 2 * k]) * phasor.conjugate()
            currents += (passed * (source * phasor).real + s.current_noise * noise[2 + 2 * k]) * phasor.conjugate()
    s.envelopes[0], s.envelopes[1] = 2.0 * share * voltages, 2.0 * share * currents
    return s.unevenness * squares * share / (2.0 * VACUUM * area), flags


@kernel
def attract(s, drive, x, noise):
    """Mean attraction (N) over a sample under `drive`, and flags; `x` is a row of inputs."""
    load, speed = x[LOAD], x[SPEED]
    peak = drive if abs(drive) < HUGE else 0.0
    if s.goal > 0.0:
        s.bias = max(s.bias, min(s.bias + s.rise, s.goal))
        force = max(s.bias + peak, s.floor * (s.bias / s.goal))
        peak = force / math.sqrt(2.0 * s.bias * s.gain) if s.straight else math.sqrt(force / s.gain)
    limit = s.voltage_limit if s.voltage else s.current_limit
    flags = SATURATED if abs(peak) > limit else 0
    peak = min(max(peak, -limit), limit)
    if math.isnan(speed):  # lifted: no charge is left, and only the source's current can be measured
        s.charge[0] = s.charge[1] = s.charge[2] = 0.0
        s.envelopes[0], s.envelopes[1] = 0j, complex(0.0 if s.voltage else peak, 0.0)
        return 0.0, 0
    area = s.area * load**s.area_exponent
    resistance = s.gap_short if abs(speed) < s.sliding.least_speed else s.gap_resistance
    tau = resistance * s.capacitance[2]
    lag = s.omega * tau
    gap = complex(1.0, -lag) * (resistance / (1.0 + lag * lag))  # ohm m2
    impedance = s.body_resistance + (s.series_impedance + gap) * (1.0 / area)
    source = 1.0 + complex(0.0, s.omega * s.stray_capacitance) * impedance  # its current per current of the finger
    peak /= abs(impedance) if s.voltage else abs(source)
    if s.carrier:
        s.retention[2], s.alternating[2] = element(tau, s.substep, s.omega, s.turn)
        force, cut = carrier_pass(s, area, peak, source, noise)
        return force, flags | cut
    passed = within(0.0, abs(impedance), peak, s.voltage_limit)
    force = s.unevenness * passed * passed * (lag * lag / (1.0 + lag * lag)) / (4.0 * s.omega * s.omega * VACUUM * area)
    return force, flags | (SATURATED if passed != peak else 0)


@step
def screen_step(state, signals, start, count):
    """Advance the screen by `count` samples; see `hapticrender.jit`."""
    s = numba.carray(pointer(state, SCREEN_T), 1)[0]
    io = numba.carray(pointer(signals, SIGNALS_T), 1)[0]
    end, channels = start + count, 1 + 2 * s.oversampling if s.sensing else 1
    drive, inputs = numba.carray(pointer(io.drive, F8), end), numba.carray(pointer(io.inputs, F8), (end, INPUTS))
    noise, sensed = numba.carray(pointer(io.noise, F8), (end, channels)), numba.carray(pointer(io.sensed, F8), end)
    motion, flags = numba.carray(pointer(io.motion, F8), (end, 2)), numba.carray(pointer(io.flags, I8), end)
    for n in range(start, end):
        x, reading, raised = inputs[n], s.reading, OPEN_LOOP if s.open_loop else 0
        attraction, cut = attract(s, drive[n], x, noise[n])
        if s.sensing:
            s.reading, s.open_loop = gap_step(s.gap, s.envelopes[0], s.envelopes[1], x[SPEED])
        steady = s.friction_coefficient * (x[LOAD] + attraction)
        friction, measured = sliding_step(s.sliding, steady, x[SPEED], noise[n, 0])
        if not s.sensing:
            reading, raised = measured, SENSOR_CLIPPED if abs(measured) >= s.sliding.force_range else 0
        sensed[n], flags[n] = reading, raised | cut
        motion[n, FRICTION], motion[n, ATTRACTION] = friction, attraction
    return 0
