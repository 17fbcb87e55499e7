"""Any plant with a compiled step: a third party's in 25 lines, closed with a controller, and in pieces."""

import numba
import numpy as np
import pytest
from numba import carray
from proportional import Proportional

import hapticrender as hr
from hapticrender.jit import F8, SIGNALS_T, pointer, record_of, step
from hapticrender.plants.compiled import CompiledPlant
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen, SquareRoot
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.plants.ultrasonic import UltrasonicParameters, UltrasonicPlate
from hapticrender.plants.ultrasonic_surface import SurfaceParameters, UltrasonicSurface
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
        self.state = record_of(MASS, stiffness=4e3, mass=0.01, period=1 / self.rate)


def plates(**parameters):
    finger = hr.Finger.sliding(speed=0.1, normal_load=0.6, mechanics=HEAVY)
    return [Plate(PlateParameters(**parameters), finger, seed=4) for _ in range(2)]


@pytest.mark.parametrize("pair", [plates(), plates(coils=1), plates(delay=4), [MassOnSpring(), MassOnSpring()]])
def test_closed_loop_is_the_open_one_sample_by_sample(pair, rng):
    closed, ring = pair
    gain, wanted = 300.0, 1e-5 * rng.standard_normal(600)
    controller = Proportional(gain, flag=16, channels=closed.drive_channels, sensors=closed.sensed_channels)
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


TOUCHES = [(0.0, 0.01), (0.014, 0.06)]  # s
SWIPE = hr.Finger.swiping(frequency=20.0, speed=0.1, normal_load=0.7, touches=TOUCHES)
PRESS = hr.Finger.still(normal_load=((0.0, 0.01), (0.2, 0.9)), touches=[(0.001, 0.002), (0.0025, 0.02)])
SURFACE = SurfaceParameters(level="envelope", sensor="tribometer")


def screen(seed, **parameters):
    root = SquareRoot(bias=0.45, floor=0.02, gain=2.2e4)
    return ElectroadhesionScreen(ElectroadhesionParameters(**parameters), SWIPE, seed, root)


PLANTS = {  # by seed, and the size of a drive
    "plate": (lambda seed: Plate(PlateParameters(bending_frequency=1150.0, delay=3), SWIPE, seed), 2.0),
    "mode": (lambda seed: UltrasonicPlate(UltrasonicParameters(temperature_rise=5.0, delay=4), PRESS, seed), 10.0),
    "screen": (screen, 0.4),
    "gap": (lambda seed: screen(seed, level="carrier", sensor="impedance"), 0.4),
    "surface": (lambda seed: UltrasonicSurface(SURFACE, Proportional(2e5, pulse=0.125), SWIPE, seed), 0.06),
}


@pytest.mark.parametrize("name", PLANTS)
def test_a_run_equals_its_pieces_and_noise_its_seed(name, rng):
    """Under a finger that comes and goes."""
    make, size = PLANTS[name]
    whole, cut, other = (make(seed) for seed in (3, 3, 4))
    assert isinstance(whole, hr.Plant)
    drive = size * rng.uniform(-1.0, 1.0, (600, whole.drive_channels))
    once, again = whole.run(drive), other.run(drive)
    pieces = [cut.run(part) for part in np.split(drive, [1, 7, 191, 192, 501])]
    for column in ("sensed", "motion", "flags", "position", "normal_load"):
        joined = np.concatenate([getattr(piece, column) for piece in pieces])
        np.testing.assert_array_equal(joined, getattr(once, column), err_msg=column)
    assert not np.array_equal(again.sensed, once.sensed)
    assert len(set(once.normal_load > 0.0)) == 2


def test_noise_is_not_what_a_user_draws_from_the_seed_of_the_scene():
    """One stream for both would be taken for motion: a texture of 5 um was played with an error of 17 %."""
    noise = Plate(PlateParameters(), hr.Finger.absent(), seed=0).noise(5000).ravel()
    drawn = np.random.default_rng(0).standard_normal(len(noise))
    assert abs(np.corrcoef(noise, drawn)[0, 1]) < 5 / np.sqrt(len(noise))


FREE, IDEAL = hr.Finger.absent(), {"sensor_noise": 0.0, "sensor_bits": 0}
DELAYED = {
    "plate": lambda delay, block: Plate(PlateParameters(current_bits=0, delay=delay, **IDEAL), FREE, block=block),
    "mode": lambda delay, block: UltrasonicPlate(UltrasonicParameters(drive_bits=0, delay=delay), FREE, block=block),
}


@pytest.mark.parametrize("name", DELAYED)
@pytest.mark.parametrize(("delay", "block"), [(1, 1), (5, 1), (5, 5), (8, 4), (4, 3)])
def test_a_drive_acts_after_the_stated_number_of_samples(name, delay, block):
    """It is held during its interval, and seen at the end of it."""
    plant = DELAYED[name](delay, block)
    drive = np.zeros((60, plant.drive_channels))
    drive[10] = 1.0
    assert np.flatnonzero(plant.run(drive).motion[:, 0])[0] == 10 + (delay - block) + 1
