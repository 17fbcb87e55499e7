"""The glass bends: one more mode, exact in discrete time, felt by the finger and seen by the sensors."""

import numpy as np
import pytest
from scipy.linalg import expm

import hapticrender as hr
from hapticrender.plants.vibrotactile import EXPECTED_BENDING, Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, NONE

IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0}
FREQUENCY, RATIO, MASS = 1150.0, 0.01, 9.5e-3


def dense(finger, position, shape, coil):
    """A and B of x' = A x + B [i1, i2, W] with x = [x_c, theta, e, (x_p)] and its rates; numbers of FACTS section 1."""
    skin = np.array([finger.mass, finger.damping, finger.stiffness]) if finger.order else np.zeros(3)
    sides = np.array([[1.0, -27.5e-3, 0.0], [1.0, 27.5e-3, 0.0]])
    omega = 2 * np.pi * FREQUENCY
    mass = np.diag([32e-3, 4e-5, MASS])
    damping = sides.T @ np.diag([0.85, 0.85]) @ sides + np.diag([0, 0, 2 * RATIO * omega * MASS])
    stiffness = sides.T @ np.diag([22.4e3, 22.9e3]) @ sides + np.diag([0, 0, omega**2 * MASS])
    h = np.array([1.0, position, shape])
    n = 3
    if finger.order == 4:
        n, link = 4, np.append(h, -1.0)
        wide = [np.pad(matrix, (0, 1)) for matrix in (mass, damping, stiffness)]
        mass, damping, stiffness = wide
        mass[3, 3] = finger.phalanx_mass
        damping[3, 3], stiffness[3, 3] = finger.phalanx_damping, finger.phalanx_stiffness
        h = np.append(h, 0.0)
        mass = mass + skin[0] * np.outer(h, h)
    else:
        link = h
        mass = mass + skin[0] * np.outer(h, h)
    damping = damping + skin[1] * np.outer(link, link)
    stiffness = stiffness + skin[2] * np.outer(link, link)
    force = np.zeros((n, 3))
    force[:3, :2] = 7.4 * np.array([[1.0, 1.0], [-27.5e-3, 27.5e-3], [coil, coil]])
    force[:, 2] = -h
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    return a, np.vstack([np.zeros((n, 3)), inverse @ force])


def simulate(drive, load, a, b, centre):
    """Centre and ends (m) at the start of each held sample."""
    n = len(a)
    step = expm(np.block([[a, b], [np.zeros((3, n + 3))]]) / 5000.0)
    places = np.array([[1.0, 0.0, centre], [1.0, -55e-3, 1.0], [1.0, 55e-3, 1.0]])
    state, motion = np.zeros(n), np.zeros((len(drive), 3))
    for i, row in enumerate(drive):
        motion[i] = places @ state[:3]
        state = step[:n, :n] @ state + step[:n, n:] @ np.append(row, load)
    return motion


def mode_alone(drive, frequency, coil):
    """Displacement of the sensors (m) by the bending mode under both currents (A), nothing else moving."""
    omega = 2 * np.pi * frequency
    a = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * RATIO * omega, coil / MASS], [0.0, 0.0, 0.0]])
    step = expm(a / 5000.0)
    state, motion = np.zeros(3), np.zeros(len(drive))
    for n, row in enumerate(drive):
        motion[n] = state[0]
        state[2] = 7.4 * row.sum()
        state = step @ state
    return motion


@pytest.mark.parametrize("finger", [NONE, HEAVY_SECOND, LIGHT, HEAVY], ids=["none", "2nd order", "light", "heavy"])
@pytest.mark.parametrize(("position", "coil"), [(0.0, -0.1), (15e-3, 0.1), (-55e-3, 0.1)])
def test_the_bending_plate_is_integrated_exactly(rng, finger, position, coil):
    """Zero-order hold against scipy's matrix exponential: equal to the rounding of 3000 steps."""
    parameters = PlateParameters(bending_frequency=FREQUENCY, bending_coil=coil, **IDEAL)
    touch = hr.Finger.still(position=position, normal_load=0.5, mechanics=finger)
    drive = rng.uniform(-3, 3, (3000, 2))
    a, b = dense(finger, position, float(parameters.bending_shape(position)), coil)
    expected = simulate(drive, 0.5, a, b, float(parameters.bending_shape(0.0)))
    motion = Plate(parameters, touch).run(drive).motion
    np.testing.assert_allclose(motion, expected, rtol=0, atol=3000 * 2**-52 * abs(expected).max())
    rigid = Plate(PlateParameters(**IDEAL), touch).run(drive).motion
    assert abs(motion - rigid).max() > 1e-3 * abs(rigid).max()  # the mode is not lost in it


def test_shape_is_that_of_a_free_bar():
    """Textbook numbers of the first free-free mode: middle -0.6078, nodes 0.2242 of the length from the ends."""
    plate = PlateParameters()
    np.testing.assert_allclose(plate.bending_shape([-55e-3, 0.0, 55e-3]), [1.0, -0.6078, 1.0], atol=5e-5)
    half = np.linspace(0.0, 55e-3, 100_001)
    node = half[abs(plate.bending_shape(half)).argmin()]
    assert (55e-3 - node) / 110e-3 == pytest.approx(0.2242, abs=5e-5)
    step = 55e-6
    bend = np.diff(plate.bending_shape(55e-3 - step * np.arange(3)), 2)[0]
    most = np.diff(plate.bending_shape(step * np.arange(-1, 2)), 2)[0]
    assert abs(bend) < 5e-3 * abs(most)  # no moment at a free end; one step inside, step/l of the third derivative
    assert plate.bending_shape(27.5e-3) == pytest.approx(-0.0992, abs=5e-5)


def test_sensors_and_coils_see_the_mode_as_stated(rng):
    """Free plate, common drive: ends minus the rigid ones are phi_coil K (i1 + i2) through the mode alone."""
    drive = rng.uniform(-1, 1, (2000, 1)) * np.ones(2)
    bent = PlateParameters(bending_frequency=FREQUENCY, bending_coil=0.1, **IDEAL)
    apart = (
        Plate(bent, hr.Finger.absent()).run(drive).motion
        - Plate(PlateParameters(**IDEAL), hr.Finger.absent()).run(drive).motion
    )
    alone = mode_alone(drive, FREQUENCY, 0.1)
    atol = 2000 * 2**-52 * 1e-3  # rounding of motions below 1 mm
    np.testing.assert_allclose(apart[:, 1], alone, rtol=0, atol=atol)
    np.testing.assert_allclose(apart[:, 0], float(bent.bending_shape(0.0)) * alone, rtol=0, atol=atol)
    assert abs(alone).max() > 1e-6


def test_opposed_coils_do_not_bend_the_glass(rng):
    drive = rng.uniform(-1, 1, (500, 1)) * np.array([1.0, -1.0])
    bent = PlateParameters(bending_frequency=FREQUENCY, **IDEAL)
    flexible = Plate(bent, hr.Finger.absent()).run(drive).motion
    rigid = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).run(drive).motion
    np.testing.assert_allclose(flexible, rigid, rtol=0, atol=500 * 2**-52 * abs(rigid).max())


def test_a_bending_run_equals_its_pieces(rng):
    finger = hr.Finger.sliding(speed=0.1, normal_load=0.8, mechanics=HEAVY)
    drive = rng.standard_normal((1000, 2))
    parameters = PlateParameters(bending_frequency=FREQUENCY)
    whole = Plate(parameters, finger, seed=3).run(drive)
    pieces = Plate(parameters, finger, seed=3)
    parts = [pieces.run(part) for part in np.split(drive, [1, 7, 500, 501])]
    assert np.array_equal(whole.motion, np.concatenate([part.motion for part in parts]))


@pytest.mark.parametrize("frequency", [4999.0, 5000.0])
def test_the_series_converges_up_to_the_highest_frequency_allowed(frequency, rng):
    """w T = 2 pi: terms of the series grow to e^(2 pi) = 535 before they fall, which costs so many roundings."""
    parameters = PlateParameters(bending_frequency=frequency, **IDEAL)
    drive = rng.uniform(-1, 1, (200, 1)) * np.ones(2)
    motion = Plate(parameters, hr.Finger.absent()).run(drive).motion
    rigid = Plate(PlateParameters(**IDEAL), hr.Finger.absent()).run(drive).motion
    alone = mode_alone(drive, frequency, -0.1)
    np.testing.assert_allclose(motion[:, 1] - rigid[:, 1], alone, rtol=0, atol=200 * 535 * 2**-52 * abs(motion).max())


def test_the_mode_as_the_loop_sees_it():
    assert PlateParameters().bending is None
    bending = PlateParameters(bending_frequency=1200.0, bending_coil=0.08).bending
    assert bending.frequency == 1200.0
    assert bending.coupling == (pytest.approx(0.08 / 9.5e-3), 0.0)
    assert bending.measured
    assert not EXPECTED_BENDING.measured


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"bending_frequency": -1.0}, r"bending_frequency = -1.0: must be >= 0 Hz"),
        ({"bending_frequency": 6000.0}, r"bending_frequency = 6000.0: must be <= rate = 5000 Hz"),
        ({"bending_mass": 0.0}, r"bending_mass = 0.0: must be > 0 kg"),
        ({"bending_coil": 1.5}, r"bending_coil = 1.5: must be <= 1"),
        ({"bending_coil": -1.5}, r"bending_coil = -1.5: must be >= -1"),
        ({"bending_damping": float("nan")}, r"bending_damping = nan: must be >= 0"),
    ],
)
def test_bad_bending_is_refused(overrides, message):
    with pytest.raises(ValueError, match=message):
        PlateParameters.with_overrides(overrides)
