"""Any plant with a compiled step: a third party's in 25 lines, and plants closed with a compiled controller."""

import numba
import numpy as np
import pytest
from numba import carray

import hapticrender as hr
from hapticrender.jit import F8, I8, SIGNALS_T, pointer, step
from hapticrender.plants.compiled import CompiledPlant, aligned_record, queue_drive
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY

MASS = np.dtype([("position", "f8"), ("velocity", "f8"), ("stiffness", "f8"), ("mass", "f8"), ("period", "f8")])
MASS_T = numba.from_dtype(MASS)


@step
def mass_step(state, signals, start, count):
    """Sense the position (m), then advance a mass on a spring under the drive (N), semi-implicitly."""
    s, io = carray(pointer(state, MASS_T), 1)[0], carray(pointer(signals, SIGNALS_T), 1)[0]
    drive, sensed, motion = (
        carray(pointer(io.drive, F8), start + count),
        carray(pointer(io.sensed, F8), start + count),
        carray(pointer(io.motion, F8), start + count),
    )
    for n in range(start, start + count):
        sensed[n] = motion[n] = s.position
        s.velocity += s.period * (drive[n] - s.stiffness * s.position) / s.mass
        s.position += s.period * s.velocity
    return 0


class MassOnSpring(CompiledPlant):
    """The whole of a third party's plant: its step, and a record with its numbers."""

    step = mass_step

    def __init__(self):
        super().__init__(hr.Finger.absent(), rate=5000.0)
        self.state = aligned_record(MASS)
        self.state["stiffness"], self.state["mass"], self.state["period"] = 4e3, 0.01, 1 / self.rate


CONTROL = np.dtype([("gain", "f8"), ("offset", "f8"), ("channels", "i8"), ("sensors", "i8")])
CONTROL_T = numba.from_dtype(CONTROL)


@step
def proportional_step(state, signals, start, count):
    """Drive every channel by gain (waveform - first sensor) + offset."""
    s, io = carray(pointer(state, CONTROL_T), 1)[0], carray(pointer(signals, SIGNALS_T), 1)[0]
    stop = start + count
    drive, sensed = carray(pointer(io.drive, F8), (stop, s.channels)), carray(pointer(io.sensed, F8), (stop, s.sensors))
    waveform, flags = carray(pointer(io.waveform, F8), stop), carray(pointer(io.flags, I8), stop)
    for n in range(start, stop):
        for i in range(s.channels):
            drive[n, i] = s.gain * (waveform[n] - sensed[n, 0]) + s.offset
        flags[n] |= 16
    return 0


class Proportional:
    """The least that a compiled controller has."""

    step, n_bands, block = proportional_step, 1, 1

    def __init__(self, plant, gain, offset=0.0):
        self.state = aligned_record(CONTROL)
        self.state[0] = gain, offset, plant.drive_channels, plant.sensed_channels


def plates(**parameters):
    finger = hr.Finger.sliding(speed=0.1, normal_load=0.6, mechanics=HEAVY)
    return [Plate(PlateParameters(**parameters), finger, seed=4) for _ in range(2)]


@pytest.mark.parametrize("pair", [plates(), plates(coils=1), plates(delay=4), [MassOnSpring(), MassOnSpring()]])
def test_closed_loop_is_the_open_one_sample_by_sample(pair, rng):
    closed, ring = pair
    gain, wanted = 300.0, 1e-5 * rng.standard_normal(600)
    controller = Proportional(closed, gain)
    assert closed.closes(controller)
    parts = [closed.closed_loop(controller, part) for part in np.split(wanted, [1, 200])]
    drive, flags = (np.concatenate([part[i] for part in parts]) for i in (0, 2))
    motion = np.concatenate([part[3].motion for part in parts])
    played, rows = np.zeros((1, ring.drive_channels)), []
    for n in range(600):
        sensed = ring.run(played)
        rows.append((played[0], sensed.motion[0]))
        played = np.full((1, ring.drive_channels), gain * (wanted[n] - sensed.sensed[0, 0]))
    for found, column in ((drive, 0), (motion, 1)):
        expected = np.array([row[column] for row in rows])
        np.testing.assert_allclose(found, expected, rtol=0, atol=600 * 2**-50 * abs(expected).max())
    assert (flags & 16 == 16).all()
    assert abs(motion).max() > 1e-6


def test_drive_queue_hands_on_after_its_latency():
    queue, due, oldest, seen = np.zeros((3, 2)), np.zeros(2), 0, []
    for n in range(8):
        oldest = queue_drive(queue, oldest, np.array([n, np.inf]), due)
        seen.append(due.copy())
    np.testing.assert_array_equal(seen, [[max(n - 3, 0), 0.0] for n in range(8)])
