"""One control core: one texture is rendered alike on every device."""

from dataclasses import replace
from importlib.metadata import entry_points

import numpy as np
import pytest

import hapticrender as hr
from examples.one_texture_three_devices import skin_bands, velocity_per_unit
from hapticrender.touch.builtin_scenes import one_texture

KINDS = ("vt-plate", "electroadhesion", "ultrasonic", "hybrid")


def test_every_installed_kind_is_rendered_here():
    assert {entry.name for entry in entry_points(group="hapticrender.renderers")} >= set(KINDS)
    assert set(one_texture()) == set(KINDS)


@pytest.fixture(scope="module")
def recordings():
    return {kind: hr.render(scene) for kind, scene in one_texture().items()}


def test_one_texture_is_felt_alike_on_every_device(recordings):
    """Rms error of each band within 5 %, the scenes' tolerance; a mean 1 % off would be a bias of the loop."""
    for kind, recording in recordings.items():
        bands, place = skin_bands(recording), recording.header.places[0]
        assert [band.frequency for band in bands] == pytest.approx([50.0, 120.0, 250.0])
        assert [band.achieved for band in bands] == pytest.approx([8e-3] * 3, rel=0.01), kind
        assert all(band[f"rms_error_{place}"] < 0.05 for band in recording.summary()["bands"]), kind


def test_a_skin_band_says_its_level(recordings):
    band = skin_bands(recordings["vt-plate"])[1]
    assert band.level == pytest.approx(hr.sensation_level(8e-3 / (2 * np.pi * 120.0), 120.0), abs=0.2)
    assert band.achieved == pytest.approx(band.target, rel=0.02)


def test_a_friction_moves_the_skin_by_the_fingers_admittance_where_the_scene_says_so():
    texture, finger = hr.Grating(velocity=8e-3, frequency=111.0), hr.Finger.sliding(0.08, 0.4, mechanics="light")
    scene = hr.Scene(texture=texture, finger=finger, device="electroadhesion", duration=1.5)
    recording = hr.render(replace(scene, rendering={"velocity_per_force": 0.0}))
    assert abs(velocity_per_unit(recording, 111.0)) == pytest.approx(0.484, abs=5e-4)  # of 4th order, see test_finger
    [band] = skin_bands(recording)
    assert band.target == pytest.approx(8e-3, rel=1e-6)
    assert band.achieved == pytest.approx(8e-3, rel=0.02)
