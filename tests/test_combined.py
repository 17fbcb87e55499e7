"""The controller of a device of two parts: each part's own controller, side by side, targets of one skin velocity."""

import numpy as np
from test_kernel import RATE, friction_controller, plate_controller, tones

from hapticrender.control.combined import CombinedBands, CombinedController
from hapticrender.control.controller_design import ONE_SPEED
from hapticrender.control.state_transfer import drive_limits

VELOCITY_PER_FORCE = 0.64  # m/(N s)
PLATE, FRICTION = tones([0.0, 0.0], wavenumber=[500.0, 900.0]), tones([0.0, 0.0], 1e-6, wavenumber=[900.0, 2000.0])
PLATE_INDEX, FRICTION_INDEX = np.array([0, 1]), np.array([1, 2])


def combined_bands():
    zero = np.zeros(3)
    return CombinedBands(
        frequency=zero,
        wavenumber=np.array([500.0, 900.0, 2000.0]),
        phase=zero,
        envelope=zero + 1e-5,
        plate=PLATE,
        friction=FRICTION,
        plate_index=PLATE_INDEX,
        friction_index=FRICTION_INDEX,
    )


def combined(parts):
    return CombinedController(parts, combined_bands(), VELOCITY_PER_FORCE, (2, 2), (2, parts[1].channels), "h")


def parts():
    return plate_controller(PLATE, rules=ONE_SPEED), friction_controller(FRICTION)


def samples(rng, n=2000):
    position = 0.05 * np.arange(n) / RATE
    return 1e-6 * rng.standard_normal((n, 4)), position, np.zeros(n)


def test_each_part_is_driven_as_on_its_own(rng):
    """Drives bit for bit; the target of the skin is j w X + 0.64 F, at the frequency that the speed makes."""
    sensed, position, wanted = samples(rng)
    drive, target, flags = combined(parts()).run(sensed, position, wanted)
    plate, friction = parts()
    moved, x, _ = plate.run(sensed[:, :2], position, wanted)
    rubbed, force, _ = friction.run(sensed[:, 2:], position, wanted)
    np.testing.assert_array_equal(drive, np.hstack([moved, rubbed]))
    assert (abs(drive).max(axis=0) > 0).all()
    assert not flags.any()
    w = 2 * np.pi * PLATE.wavenumber * 0.05
    expected = np.zeros(3, complex)
    expected[PLATE_INDEX] += 1j * w * x[-1]
    expected[FRICTION_INDEX] += VELOCITY_PER_FORCE * force[-1]
    np.testing.assert_allclose(target[-1], expected, rtol=1e-9)  # the tracker's speed, after 0.4 s at 60 Hz


def test_a_part_that_does_not_play_leaves_the_other_limits():
    """A limit that is infinite would stay so in every exchange after it, for the larger of both counts."""
    plate, friction = parts()
    limits = [float(each.settings["drive_limit"]) for each in (plate, friction)]
    np.testing.assert_array_equal(drive_limits(combined((plate, friction))), np.repeat(limits, (2, friction.channels)))
    np.testing.assert_array_equal(
        drive_limits(combined((None, friction))), np.repeat([0.0, limits[1]], (2, friction.channels))
    )
