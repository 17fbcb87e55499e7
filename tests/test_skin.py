"""Predicted skin velocity: closed forms for every unit, and the picture and page of several devices."""

import math

import numpy as np
import pytest
from synthetic import RATE, make_bands, make_scene, make_signals, times

import hapticrender as hr
from hapticrender.formatting import quantity
from hapticrender.recordings.recording import Recorder
from hapticrender.skin import residual_velocity, skin_bands, skin_waveform, velocity_per_unit

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
    assert abs(share) == pytest.approx(0.484, abs=5e-4)  # FACTS 4, light finger, 4th order
    [band] = skin_bands(recording)
    assert band.target == pytest.approx(8e-3, rel=1e-9)
    assert band.achieved == pytest.approx(8e-3, rel=0.02)


def test_skin_bands_say_velocity_level_and_error(recordings):
    for recording in recordings.values():
        bands = skin_bands(recording)
        assert [band.target for band in bands] == pytest.approx([8e-3, 8e-3], rel=1e-9)
        assert [band.error for band in bands] == pytest.approx([0.0, 0.0], abs=0.02)
        amplitude = 8e-3 / (2 * math.pi * 60.0)
        assert bands[0].level == pytest.approx(hr.sensation_level(amplitude, 60.0), abs=0.2)


def test_the_waveform_is_the_derivative_of_the_texture_on_both(recordings):
    """Wanted is exact; achieved has the error of its envelopes, below 2 % of the sum of both partials."""
    for recording in recordings.values():
        time, wanted, achieved = skin_waveform(recording, 1.5, 0.05)
        texture = recording.scene.texture
        step = 1e-7
        ahead, behind = (texture.waveform(time + side * step, np.full(time.shape, np.nan)) for side in (1, -1))
        np.testing.assert_allclose(wanted, (ahead - behind) / (2 * step), atol=1e-6 * 16e-3)
        np.testing.assert_allclose(achieved, wanted, atol=0.02 * 16e-3)


@pytest.mark.parametrize(
    ("unit", "share"), [("m", 2 * math.pi * 400.0), ("N", 0.64), ("m/s", 1.0)], ids=["plate", "friction", "skin"]
)
def test_what_is_beside_the_bands_is_said_in_skin_velocity(unit, share):
    """A tone of 400 Hz beside a band of 100 Hz, and one of 1500 Hz that is not felt.

    A window of 20 ms holds 8 periods: its slope explains at most 6/(8 pi)^2 = 1 % of the tone's power, 0.5 % of its
    rms, and the Hann window's width adds 1/(6 (400 * 0.02)^2) = 0.3 %.  Of 1500 Hz, 25 lines above 1 kHz, the window
    lets 1e-4 through.
    """
    bands, size, felt = make_bands(100.0, 1.0), 0.3, times(2.0)
    tones = size * (np.cos(2 * np.pi * 400.0 * felt + 0.4) + np.cos(2 * np.pi * 1500.0 * felt))
    signals = make_signals(bands, 0.9 * bands.envelope, duration=2.0, extra=tones[:, None])
    signals["motion"] = signals["motion"][:, :1]
    fields = {"rate": RATE, "bands": bands, "unit": unit, "places": ("skin",)}
    recorder = Recorder(None, scene=make_scene(duration=2.0), method="h2", seed=0, **fields)
    recorder.append(**signals)
    recording = recorder.finish()
    assert residual_velocity(recording) == pytest.approx(share * size / math.sqrt(2), rel=0.008)
    both = math.hypot(400.0, 1500.0) / 400.0 if unit == "m" else math.sqrt(2)
    assert residual_velocity(recording, 2.5e3) == pytest.approx(share * both * size / math.sqrt(2), rel=0.008)


def test_where_nothing_can_be_judged_nothing_is_said_beside_the_bands():
    bands = make_bands(100.0, 1.0)
    recorder = Recorder(None, scene=make_scene(duration=2.0), method="h2", seed=0, rate=RATE, bands=bands)
    recorder.append(**make_signals(bands, bands.envelope, duration=0.01))
    assert math.isnan(residual_velocity(recorder.finish()))


def test_devices_are_drawn_side_by_side(recordings, tmp_path):
    pytest.importorskip("matplotlib")
    from hapticrender.report.devices_picture import draw_devices, plot_devices

    figure = draw_devices(recordings)
    assert [axes.get_title(loc="left").split(",")[0] for axes in figure.axes[:2]] == list(recordings)
    for axes, recording in zip(figure.axes, recordings.values(), strict=False):
        assert f"{recording.scene.device}, by " in axes.get_title(loc="left")
        beside = quantity(residual_velocity(recording), "m/s")
        assert axes.texts[0].get_text() == f"outside the bands {beside} rms"
    plot_devices(recordings, tmp_path / "devices.png")
    assert (tmp_path / "devices.png").read_bytes()[:4] == b"\x89PNG"


def test_the_page_shows_what_devices_share(tmp_path):
    from hapticrender.loop import prepare
    from hapticrender.report.outputs import run_into
    from hapticrender.report.page import devices_section

    texture = hr.Grating(velocity=8e-3, frequency=60.0)
    outputs = [
        run_into(
            tmp_path / device,
            prepare(hr.Scene(texture=texture, finger=FINGER, device=device, duration=1.0, name=device)),
        )
        for device in ("vt-plate", "ultrasonic")
    ]
    section = devices_section(tmp_path, outputs)
    assert "One texture, 2 devices" in section
    assert section.count("<td>8.000</td>") == 1
    assert devices_section(tmp_path, outputs[:1]) == ""
