"""Compiled plate: electronics, sensors, and the exact step of plate and finger under a held drive.

States are the coordinates (0 heave, 1 rocking, 2 bending, 3 phalanx; m) and their velocities times the sampling
period T (4 to 7; m).  With u = [current 1, current 2, load] held over a sample, ``z' = A z + B u`` (time in samples)
becomes ``z[n + 1] = Phi z[n] + Gamma u[n]``, where ``[Phi Gamma]`` is the top of ``exp([[A, B], [0, 0]])``.

A and B depend on the finger's lever arm g = p/a and on the factor s on its impedance ("strength")::

    M(g, s) = M + s m h h',   K(g, s) = K + s (k f f' + k_p e e'),   C alike
    h = [1, g, phi(g), 0],    f = [1, g, phi(g), -1],    e = [0, 0, 0, 1]

While the finger slides at constant strength, ``[Phi Gamma]`` is interpolated quadratically between `NODES` lever arms,
computed as the finger comes near (error of the motion below 1e-5, falling with the third power of their distance);
while it rests it is exact: computed once after `REST` samples; until then, and wherever the strength changes, the
series of the exponential is summed for the state alone.

A vector of the states fills the lanes of `hapticrender.vectors`.  What is long or called from several places is called
by address, and so compiled once.
"""

import math
from functools import partial

import numpy as np
from numba import carray

from hapticrender.jit import F8, I8, SIGNALS_T, CFunction, call, kernel, pointer, record, step
from hapticrender.plants.compiled import SENSOR_CLIPPED, quantise, queue_drive
from hapticrender.vectors import get, load, put, tile_type

STATES, COLUMNS = 8, 11  # of [Phi Gamma], which is kept column by column
NODES = 101  # lever arms in the table, from one end of the glass to the other
EXACT = NODES  # entry of the table that holds for the finger at rest
REST = 16  # samples after which a finger rests
ROUNDING = 1e-15  # first term left out of the series, relative to the state

PLATE = np.dtype(
    [
        ("w", "f8", (16,)),  # states, currents (A), load (N)
        ("term", "f8", (16,)),  # of the series, the rest zeros
        ("total", "f8", (STATES,)),  # of the series so far
        ("system", "f8", (COLUMNS, STATES)),  # columns of [A B] where they were last assembled
        ("table", "f8", (NODES + 1, COLUMNS, STATES)),  # [Phi Gamma] at the nodes, then for the finger at rest
        ("held", "f8", (NODES + 1,)),  # strength for which each of them holds, NaN: none
        ("free", "f8", (COLUMNS, 4)),  # forces by states and inputs without finger: -T^2 K, -T C, T^2 [B 0]
        ("inverse_mass", "f8", (4,)),  # 1/kg; 0: that coordinate is locked
        ("glass", "f8", (4,)),  # h, f, and what a force along h does
        ("tissue", "f8", (4,)),
        ("moved", "f8", (4,)),
        ("force", "f8", (4,)),
        ("skin", "f8", (3,)),  # finger's T^2 k, T c, m
        ("phalanx", "f8", (2,)),  # T^2 k, T c behind it
        ("columns", "i8"),  # COLUMNS, not known to the compiler: a loop over it is not unrolled
        *((name, "i8") for name in ("assemble", "sum_series", "fill", "slide")),  # addresses
        ("lever", "f8"),  # lever arm of the last sample
        ("strength", "f8"),  # and strength
        ("rest", "i8"),  # samples for which both have been the same
        ("shape", "f8", (3,)),  # wavenumber times a, weights of cosh and cos: bending shape over the lever arm
        ("outputs", "f8", (3, 3)),  # displacement at centre, end 1, end 2 from heave, rocking, bending
        ("lever_per_metre", "f8"),  # 1/a
        ("period", "f8"),
        ("rate", "f8"),
        ("bent_at", "f8"),  # lever arm for which `bend` is the bending shape
        ("bend", "f8"),
        ("reach", "f8"),  # lever arm of the end of the glass
        ("nodes_per_lever", "f8"),
        ("current", "f8", (2,)),  # what the drive queue hands on (A)
        ("current_limit", "f8"),
        ("current_step", "f8"),
        ("sensor_limit", "f8"),
        ("sensor_step", "f8"),
        ("sensor_noise", "f8"),
        ("sensor_gain", "f8", (2,)),
        ("channels", "i8"),  # coils
        ("queue", "i8"),  # address of the drive on its way, (latency, channels)
        ("latency", "i8"),
        ("oldest", "i8"),
    ],
    align=True,
)
PLATE_T = tile_type(PLATE)  # of eight states
SYSTEM, TABLE = (PLATE.fields[name][1] for name in ("system", "table"))  # type: ignore[index]
ENTRY = 8 * COLUMNS * STATES  # bytes of an entry of the table


@kernel
def bending_shape(s, lever):
    """Shape of the bending mode at a lever arm, 0 where the glass is rigid."""
    if s.shape[0] == 0.0:
        return 0.0
    x = s.shape[0] * lever
    return s.shape[1] * math.cosh(x) + s.shape[2] * math.cos(x)


@kernel
def times(matrix, u):
    """Multiply a matrix (11 columns of 8) at an address by the first 11 numbers of `u`."""
    found = u[0] * load(matrix)
    for j in range(1, COLUMNS):
        found = found + u[j] * load(matrix + 8 * STATES * j)
    return found


@partial(CFunction, signature=I8(I8, F8, F8))
def assemble(state, lever, strength):
    """Fill [A B] for a finger at a lever arm; the mass matrix is inverted by the formula of Sherman and Morrison."""
    s = record(state, PLATE_T, 0)
    h, f, w, d, own = s.glass, s.tissue, s.moved, s.inverse_mass, s.force
    h[0], h[1], h[2], h[3] = 1.0, lever, bending_shape(s, lever), 0.0
    response = 0.0
    for i in range(4):
        f[i] = h[i] if i < 3 else -1.0
        w[i] = h[i] * d[i]
        response += h[i] * w[i]
    share = strength * s.skin[2] / (1.0 + strength * s.skin[2] * response)
    for j in range(s.columns):
        onto_tissue = -strength * s.skin[j // 4] * f[j % 4] if j < STATES else 0.0
        onto_glass = -s.period * s.period if j == COLUMNS - 1 else 0.0
        moved = 0.0
        for i in range(4):
            own[i] = s.free[j, i] + onto_tissue * f[i] + onto_glass * h[i]
            moved += w[i] * own[i]
        if j == 3 or j == 7:
            own[3] -= strength * s.phalanx[j // 4]
        for i in range(4):
            inverse = d[i] if i < 3 else d[i] / strength if strength > 0.0 else 0.0
            s.system[j, 4 + i] = inverse * own[i] - share * moved * w[i]
    return 0


@partial(CFunction, signature=I8(I8))
def sum_series(state):
    """Add (1 + A/2! + A^2/3! + ...) term to `total`, to rounding."""
    s = record(state, PLATE_T, 0)
    scale = 0.0
    for i in range(STATES):
        scale = max(scale, max(abs(s.total[i]), abs(s.term[i])))
    size, k = scale, 1.0
    while size > ROUNDING * scale:
        put(s, "total", get(s, "total") + get(s, "term"))
        k += 1.0
        put(s, "term", times(state + SYSTEM, s.term) / k)
        size = 0.0
        for i in range(STATES):
            size = max(size, abs(s.term[i]))
    return 0


@partial(CFunction, signature=I8(I8, I8, F8, F8))
def fill(state, node, lever, strength):
    """Compute [Phi Gamma] for a lever arm and a strength as entry `node` of the table."""
    s = record(state, PLATE_T, 0)
    call(s.assemble, (state, lever, strength))
    for j in range(s.columns):
        for i in range(STATES):
            s.total[i], s.term[i] = 1.0 if i == j else 0.0, s.system[j, i]
        call(s.sum_series, (state,))
        for i in range(STATES):
            s.table[node, j, i] = s.total[i]
    s.held[node] = strength
    return 0


@partial(CFunction, signature=I8(I8, F8, F8))
def slide(state, lever, strength):
    """Advance the states by the table, interpolated at a lever arm."""
    s = record(state, PLATE_T, 0)
    place = lever * s.nodes_per_lever
    node = min(max(int(place + 0.5 * NODES), 1), NODES - 2)
    for k in range(node - 1, node + 2):
        if s.held[k] != strength:
            call(s.fill, (state, k, (k - NODES // 2) / s.nodes_per_lever, strength))
    x, at = place - (node - NODES // 2), state + TABLE + node * ENTRY
    p, q, r = 0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0)
    put(s, "w", p * times(at - ENTRY, s.w) + q * times(at, s.w) + r * times(at + ENTRY, s.w))
    return 0


@kernel
def advance(state, lever, strength):
    """Advance the states by one sample under the inputs in `w`."""
    s = record(state, PLATE_T, 0)
    same = strength == s.strength
    s.rest = s.rest + 1 if same and lever == s.lever else 0
    s.lever, s.strength = lever, strength
    if s.rest >= REST:
        if s.rest == REST:
            call(s.fill, (state, EXACT, lever, strength))
        put(s, "w", times(state + TABLE + EXACT * ENTRY, s.w))
    elif same and s.rest == 0 and abs(lever) <= s.reach:
        call(s.slide, (state, lever, strength))
    else:
        call(s.assemble, (state, lever, strength))
        put(s, "term", times(state + SYSTEM, s.w))
        put(s, "total", get(s, "w"))
        call(s.sum_series, (state,))
        put(s, "w", get(s, "total"))


FUNCTIONS = {f.function.__name__: f for f in (assemble, sum_series, fill, slide)}
"""By their fields in `PLATE`."""


@step
def plate_step(state, signals, start, count):
    """Queue the drive, sense, and advance by `count` samples.

    Motion is the displacement (m) of centre, end 1 and end 2, then the velocity (m/s) of the glass under the finger,
    while lifted under its middle.
    """
    s = record(state, PLATE_T, 0)
    io = record(signals, SIGNALS_T, 0)
    stop, channels = start + count, s.channels
    drive = carray(pointer(io.drive, F8), (stop, channels))
    inputs = carray(pointer(io.inputs, F8), (stop, 3))
    noise = carray(pointer(io.noise, F8), (stop, 2))
    sensed = carray(pointer(io.sensed, F8), (stop, 2))
    motion = carray(pointer(io.motion, F8), (stop, 4))
    flags = carray(pointer(io.flags, I8), stop)
    queue = carray(pointer(s.queue, F8), (s.latency, channels))
    current_step, current_limit = s.current_step, s.current_limit
    sensor_step, sensor_limit, rms, gain = s.sensor_step, s.sensor_limit, s.sensor_noise, s.sensor_gain
    w, outputs, due, per_metre, rate = s.w, s.outputs, s.current, s.lever_per_metre, s.rate
    for n in range(start, stop):
        for i in range(channels):
            due[i] = drive[n, i]
        s.oldest = queue_drive(queue, s.oldest, due, due)
        for i in range(channels):
            w[8 + i] = quantise(due[i], current_step, current_limit)
        flags[n] = 0
        for i in range(3):
            motion[n, i] = outputs[i, 0] * w[0] + outputs[i, 1] * w[1] + outputs[i, 2] * w[2]
        for i in range(2):
            value = motion[n, 1 + i] * gain[i] + rms * noise[n, i]
            if abs(value) > sensor_limit:
                flags[n] = SENSOR_CLIPPED
            sensed[n, i] = quantise(value, sensor_step, sensor_limit)
        position, strength = inputs[n, 0], inputs[n, 2]
        touching = strength > 0.0 and position == position
        lever = per_metre * position if touching else 0.0
        if lever != s.bent_at:
            s.bent_at, s.bend = lever, bending_shape(s, lever)
        motion[n, 3] = rate * (w[4] + lever * w[5] + s.bend * w[6])
        w[10] = inputs[n, 1] if touching else 0.0
        if not touching:
            w[3] = w[7] = 0.0
        advance(state, lever, strength if touching else 0.0)
    return 0
