"""Predicted skin velocity: closed forms for every unit."""

import math

import pytest

import hapticrender as hr
from hapticrender.skin import skin_bands, velocity_per_unit

FINGER = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")


@pytest.fixture(scope="module")
def recordings():
    texture = hr.Grating(velocity=8e-3, frequency=60.0, partials=((1.0, 1.0, 0.0), (2.0, 0.5, 0.7)))
    return {
        device: hr.render(hr.Scene(texture=texture, finger=FINGER, device=device, duration=2.0))
        for device in ("vt-plate", "electroadhesion")
    }


def test_a_displacement_moves_the_skin_by_its_derivative(recordings):
    assert velocity_per_unit(recordings["vt-plate"], 60.0) == pytest.approx(2j * math.pi * 60.0)


def test_a_friction_moves_it_by_the_matched_ratio(recordings):
    assert velocity_per_unit(recordings["electroadhesion"], 60.0) == pytest.approx(0.64)


def test_a_friction_moves_it_by_the_fingers_admittance_where_the_scene_says_so():
    scene = hr.Scene(
        texture=hr.Grating(velocity=8e-3, frequency=111.0),
        finger=FINGER,
        device="electroadhesion",
        duration=1.5,
        rendering={"velocity_per_force": 0.0},
    )
    recording = hr.render(scene)
    share = velocity_per_unit(recording, 111.0)
    assert abs(share) == pytest.approx(0.484, abs=5e-4)  # of the light finger of 4th order, see test_finger
    [band] = skin_bands(recording)
    assert band.target == pytest.approx(8e-3, rel=1e-6)
    assert band.achieved == pytest.approx(8e-3, rel=0.02)


def test_skin_bands_say_velocity_level_and_error(recordings):
    for recording in recordings.values():
        bands = skin_bands(recording)
        assert [band.target for band in bands] == pytest.approx([8e-3, 8e-3], rel=1e-6)
        assert [band.error for band in bands] == pytest.approx([0.0, 0.0], abs=0.02)
        amplitude = 8e-3 / (2 * math.pi * 60.0)
        assert bands[0].level == pytest.approx(hr.sensation_level(amplitude, 60.0), abs=0.2)
