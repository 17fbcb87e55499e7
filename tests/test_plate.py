"""The plate: its matrices and modes, the compiled step against their exponential, electronics, refusals."""

import functools

import numpy as np
import pytest
from strangers_plate import bar

import hapticrender as hr
from hapticrender.plants.plate import Plate, PlateParameters, structure
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, NONE

IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}
RATE = 5000.0


def eigenfrequencies(plate):
    """Frequencies (Hz, ascending) and damping ratios of a structure's oscillating modes."""
    poles = RATE * np.log(np.linalg.eigvals(plate.zero_order_hold(RATE)[0]).astype(complex))
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(abs(poles))]
    return abs(poles) / (2 * np.pi), -poles.real / abs(poles)


def test_modes_of_the_free_plate():
    """Grigorii et al. 2021, from the printed numbers: 147.27 and 189.38 Hz."""
    for frequency, damping in (PlateParameters().modes(), eigenfrequencies(structure(PlateParameters()))):
        np.testing.assert_allclose(frequency, [147.27, 189.38], atol=0.005)
        np.testing.assert_allclose(damping, [0.01737, 0.02232], atol=5e-6)


@pytest.mark.parametrize(("finger", "expected"), [(LIGHT, (147.6, 189.2)), (HEAVY, (142.5, 180.0))])
def test_finger_at_the_coil_moves_the_modes(finger, expected):
    frequency, _ = eigenfrequencies(structure(PlateParameters(), finger, position=27.5e-3))
    np.testing.assert_allclose(frequency[frequency > 120.0][:2], expected, atol=0.05)


@pytest.mark.parametrize("mechanics", [NONE, LIGHT, HEAVY, HEAVY_SECOND], ids=["none", "light", "heavy", "2nd"])
def test_structure_has_the_dynamic_stiffness_of_plate_and_finger(mechanics):
    """The phalanx eliminated, M s^2 + C s + K is the closed form of the impedance, strength a factor on it."""
    parameters, frequency, position = PlateParameters(), np.array([20.0, 147.0, 400.0]), 12e-3
    plate = structure(parameters, mechanics, position, 1.3)
    s = 2j * np.pi * frequency[:, None, None]
    inverse = np.linalg.inv(plate.mass * s**2 + plate.damping * s + plate.stiffness)
    expected = parameters.dynamic_stiffness(frequency, 1.3 * mechanics.impedance(frequency), position)
    np.testing.assert_allclose(np.linalg.inv(inverse[:, :2, :2]), expected, rtol=1e-9)
    lifted = structure(parameters, mechanics, position, 0.0)
    np.testing.assert_array_equal(lifted.mass, parameters.mass_matrix)


@functools.cache
def held(parameters, finger, position, strength):
    """Step of [q, q'] over a sample with the inputs held, and what the centre and the ends show of q."""
    plate = structure(parameters, finger, position, strength)
    return *plate.zero_order_hold(RATE), plate.outputs[:3]


def simulate(parameters, drive, finger, position, load, strength):
    """Centre and ends (m) at the start of each held sample; a phalanx, the last coordinate, touches anew at rest."""
    state, motion = np.zeros((2, 4)), np.zeros((len(drive), 3))
    for i, row in enumerate(drive):
        phi, gamma, outputs = held(parameters, finger, np.nan_to_num(position[i]), strength[i])
        n = outputs.shape[1]
        state[:, n:] = 0.0
        motion[i] = outputs @ state[0, :n]
        state[:, :n] = (phi @ state[:, :n].ravel() + gamma @ [*row, load[i]]).reshape(2, n)
    return motion


def stop_and_go():
    """A finger (m) that slides, rests, turns and jumps, also beyond the glass."""
    time = np.arange(1500) / RATE
    at = 0.01 * np.sin(4 * np.pi * np.clip(time, 0.0, 0.1)) + np.where((0.15 < time) & (time < 0.2), 0.05, 0.0)
    return hr.Finger.sampled(at, rate=RATE, normal_load=0.8, mechanics=HEAVY)


def pressing(scaled):
    """A finger that slides, presses and lifts."""
    load, touches = ((0.0, 0.05, 0.1), (0.2, 1.4, 0.5)), ((0.0, 0.03), (0.05, 1.0))
    finger = hr.Finger(hr.TriangleMotion(0.5, 0.1), load, touches, mechanics=HEAVY, load_scaling=scaled)
    assert len(set(finger.touch(np.arange(500) / RATE)[:, 2])) > (100 if scaled else 1)
    return finger


RESTING = [
    (hr.Finger.still(position, normal_load=0.5, mechanics=mechanics), bending, 2000, 1e-6)
    for position, bending in ((15e-3, 1200.0), (-55e-3, 0.0))
    for mechanics in (NONE, LIGHT, HEAVY, HEAVY_SECOND)
]
MOVING = [(pressing(False), 0.0, 550, 1e-5), (pressing(True), 1200.0, 550, 1e-5), (stop_and_go(), 1150.0, 1500, 1e-5)]


@pytest.mark.parametrize(("finger", "bending", "samples", "within"), RESTING + MOVING)
def test_the_compiled_plate_is_its_structure(rng, finger, bending, samples, within):
    """Under a random drive, within a share of the motion's rms; a new touch starts at rest.

    A resting finger is exact but for the first samples of a touch; of a moving one the exponential is taken for every
    sample's place and strength.  The step's own matrices of a finger share no code with `structure`.
    """
    parameters, drive = PlateParameters(bending_frequency=bending, **IDEAL), rng.uniform(-2, 2, (samples, 2))
    touch = finger.touch(np.arange(samples) / RATE).T
    expected = simulate(parameters, drive, finger.mechanics, *touch)
    motion = Plate(parameters, finger).run(drive).motion
    np.testing.assert_allclose(motion, expected, rtol=0, atol=within * expected.std())


@pytest.mark.parametrize("frequency", [20.0, 189.0])
def test_measured_response_is_the_predicted_one(frequency):
    """Hold, its half-sample delay and its images k rate + f included.

    The transient has decayed by exp(-2 pi 2.56 * 6); images past the 50th hold less than (f/rate)^3/(2 50^2) < 1e-6.
    """
    parameters = PlateParameters(**IDEAL)
    model = parameters.device_model(RATE, 1)
    carrier = np.exp(2j * np.pi * frequency * np.arange(40_000) / RATE)
    plate = Plate(parameters, hr.Finger.absent())
    motion = plate.run(0.01 * np.stack([carrier.real, 0.5 * carrier.real], axis=1)).motion
    late = slice(30_000, 40_000)
    measured = 2 * (motion[late] * carrier[late, None].conj()).mean(axis=0) / 0.01
    images = frequency + RATE * np.arange(-50, 51)
    hold = np.sinc(images / RATE) * np.exp(-1j * np.pi * images / RATE)
    predicted = model.place_from_coordinate @ (hold[:, None] * (model.response(images) @ [1.0, 0.5])).sum(axis=0)
    np.testing.assert_allclose(measured, predicted, rtol=1e-6)


@pytest.mark.parametrize("bending", [0.0, 900.0], ids=["rigid", "bending"])
def test_velocity_under_the_finger(rng, bending):
    """Trapezoids of it give the displacement there: held forces ring, off by (w T)^2/12, 5e-5 and 1e-3 of the modes."""
    rate, position = 50_000.0, 20e-3
    parameters = PlateParameters(bending_frequency=bending, rate=rate, **IDEAL)
    plate = Plate(parameters, hr.Finger.still(position=position, normal_load=0.5, mechanics=HEAVY))
    plate.run(0.2 * np.sin(2 * np.pi * 80 * np.arange(10_000) / rate)[:, None] * [1.0, 0.4])
    centre, one, other, velocity = plate.motion.T
    at = parameters.displacement(position)[2]
    bend = ((one + other) / 2 - centre) / (1 - parameters.displacement(0.0)[2])
    glass = (one + other) / 2 - bend + (other - one) / 2 * position / 55e-3 + at * bend
    way = np.cumsum((velocity[1:] + velocity[:-1]) / 2) / rate
    np.testing.assert_allclose(way, glass[1:] - glass[0], rtol=0, atol=2e-4 * np.ptp(glass))


def test_one_coil_in_the_middle_moves_the_plate_as_two_that_share_it(rng):
    drive = 0.3 * rng.standard_normal((500, 1))
    one = Plate(PlateParameters(coils=1, **IDEAL), hr.Finger.absent()).run(drive)
    two = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).run(np.repeat(0.5 * drive, 2, axis=1))
    np.testing.assert_allclose(one.motion, two.motion, rtol=0, atol=1e-12 * abs(two.motion).max())


def test_electronics_quantise_clip_and_flag():
    """12 bits command the current, 14 bits sense the motion (the paper swaps them)."""
    parameters = PlateParameters(sensor_noise=0.0)
    assert parameters.current_step == pytest.approx(1.46e-3, abs=5e-6)
    assert parameters.sensor_step == pytest.approx(2e-3 / 2**14)
    slow = np.repeat(np.linspace(0, 4 * parameters.current_step, 9), 2000)[:, None] * np.ones(2)
    plate = Plate(parameters, hr.Finger.absent())
    sensed = plate.run(slow)
    settled = sensed.motion[1999::2000, 0]  # to exp(-2 pi 2.56 * 0.4)
    assert len(np.unique(np.round(settled / settled[-1], 2))) == 5  # nine commands, five currents
    counts = sensed.sensed / parameters.sensor_step
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    loud, limit = (
        Plate(parameters, hr.Finger.absent()).run(np.full((4000, 2), amperes)).motion for amperes in (300.0, 3.0)
    )
    np.testing.assert_array_equal(loud, limit)
    small = PlateParameters(sensor_noise=0.0, sensor_range=2e-4)
    pressed = Plate(small, hr.Finger.still(normal_load=10.0)).run(np.zeros((4000, 2)))  # sags 220 um
    assert abs(pressed.sensed).max() <= 1e-4
    assert pressed.flags.max() == hr.Flag.SENSOR_CLIPPED
    mute = Plate(parameters, hr.Finger.absent()).run(np.full((50, 2), np.nan))
    np.testing.assert_array_equal(mute.motion, 0.0)


def test_sensor_noise_is_white_and_as_strong_as_stated():
    """1 um rms; the standard error of an rms over N samples is 1/sqrt(2N)."""
    sensed = Plate(PlateParameters(sensor_bits=0), hr.Finger.absent(), seed=1).run(np.zeros((50_000, 2))).sensed
    np.testing.assert_allclose(sensed.std(axis=0), 1e-6, rtol=4 / np.sqrt(2 * 50_000))
    correlation = (sensed[1:] * sensed[:-1]).mean(axis=0) / 1e-12
    assert np.all(abs(correlation) < 4 / np.sqrt(50_000))


def test_shape_is_that_of_a_free_bar():
    """Textbook numbers of the first free-free mode: middle -0.6078, nodes 0.2242 of the length from the ends."""
    plate = PlateParameters()
    np.testing.assert_allclose(plate.displacement([-55e-3, 0.0, 55e-3])[:, 2], [1.0, -0.6078, 1.0], atol=5e-5)
    assert bar(20e-3) == pytest.approx(plate.displacement(20e-3)[2], rel=1e-12)  # of the third party's plate
    half = np.linspace(0.0, 55e-3, 100_001)
    node = half[abs(plate.displacement(half)[:, 2]).argmin()]
    assert (55e-3 - node) / 110e-3 == pytest.approx(0.2242, abs=5e-5)
