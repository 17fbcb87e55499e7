"""What friction devices refuse, and what a finger that leaves in one way or another leaves behind."""

import numpy as np
import pytest
from held import amplitude
from tables import scene_on

import hapticrender as hr

SLIDE = hr.Finger.sliding(speed=0.05, normal_load=0.4, mechanics="light")
TONE = hr.Grating(frequency=100.0, velocity=10e-3)


def scene(device, texture=TONE, finger=SLIDE, duration=1.0, **plant):
    return scene_on(device, texture, finger, duration, **plant)


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_the_fingers_own_admittance_is_not_for_recordings_nor_for_no_finger(device):
    recorded = hr.Recorded(samples=0.5 * np.sin(np.arange(20000) * 0.1), rate=1e4, amplitude=1e-5, carriers=8)
    with pytest.raises(ValueError, match="velocity_per_force = 0.0: must be > 0 .* for a recording"):
        hr.render(scene(device, recorded, velocity_per_force=0.0))
    with pytest.raises(ValueError, match="finger.mechanics"):
        hr.render(scene(device, finger=hr.Finger.sliding(speed=0.05), velocity_per_force=0.0))
    hr.render(scene(device, duration=0.1, velocity_per_force=0.0))


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_a_finger_without_load_counts_as_lifted(device):
    """Nothing is wanted of it, nothing is driven for it, and what follows is what was wanted."""
    loads = ([0.0, 1.0, 1.01, 2.0, 2.01, 3.0], [0.4, 0.4, 0.0, 0.0, 0.4, 0.4])
    finger = hr.Finger.sliding(speed=0.05, normal_load=loads, mechanics="light")
    recording = hr.render(scene(device, finger=finger, duration=3.0))
    away = (recording.time > 1.2) & (recording.time < 2.0)
    assert not recording.target[away].any()
    assert np.isnan(recording.position[away]).all()
    assert abs(recording.drive[away]).max() < 1e-3 * abs(recording.drive).max()
    assert amplitude(recording.motion, 100.0, 0.5, recording.rate)[0] == pytest.approx(10e-3 / 0.64, rel=0.01)


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_a_skin_faster_than_the_finger_is_refused(device):
    """10.1 mm/s of skin velocity under a finger of 10 mm/s, against 10 mm/s."""
    finger = hr.Finger.sliding(speed=0.01, normal_load=0.4, mechanics="light")
    with pytest.raises(ValueError, match=r"skin velocity of 0.0101 m/s: must be <= 0.01 m/s, the median speed"):
        hr.prepare(scene(device, hr.Grating(velocity=1.01e-2, frequency=100.0), finger))
    hr.prepare(scene(device, hr.Grating(velocity=10e-3, frequency=100.0), finger))
