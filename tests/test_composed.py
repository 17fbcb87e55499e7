"""Textures made of textures, arrays and chirps: what they play, in which bands, in a scene file; who refuses them."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.control.methods import METHODS

TIME = np.arange(0.0, 3.0, 1 / 5000)
AWAY = np.full(TIME.size, np.nan)
TONE = hr.Grating(amplitude=10e-6, frequency=47.0)
RIDGES = hr.Grating(amplitude=10e-6, wavelength=1e-3)
CHIRP = hr.Chirp(start=20.0, stop=400.0, duration=2.0, amplitude=5e-6)
ARRAY = hr.Recorded(samples=np.sin(2 * np.pi * 100 * np.arange(2000) / 2000), rate=2000.0, amplitude=5e-6)


def test_a_chirp_passes_its_frequencies_to_and_fro():
    """Phase and frequency are continuous where it turns: f(t) = 20 + 190 t Hz, then back."""
    turned = CHIRP.waveform(4.0 - TIME, AWAY)
    np.testing.assert_allclose(CHIRP.waveform(4.0 + TIME, AWAY), CHIRP.waveform(TIME, AWAY), atol=1e-15)
    np.testing.assert_allclose(np.abs(turned), np.abs(5e-6 * np.cos(2 * np.pi * phase(4.0 - TIME))), atol=1e-14)


def phase(time):
    there = np.minimum(time, 4.0 - time)
    turns = 20 * there + 95 * there**2
    return np.where(time > 2.0, 2 * 420 - turns, turns)  # 420 turns a pass


def test_samples_are_a_texture_like_a_file(tmp_path):
    soundfile = pytest.importorskip("soundfile")
    soundfile.write(tmp_path / "a.wav", np.array(ARRAY.samples), 2000, subtype="DOUBLE")
    file = hr.Recorded(file=tmp_path / "a.wav", amplitude=5e-6)
    np.testing.assert_allclose(file.waveform(TIME, AWAY), ARRAY.waveform(TIME, AWAY), atol=1e-15)
    assert (file.passband, hr.Recorded(file="a.wav", amplitude=1e-6, carriers=8).passband) == ((20, 1000), (20, 400))


def test_a_sum_adds_waveforms_and_bands():
    both = TONE + -0.5 * (RIDGES + TONE)
    position = 0.01 * np.sin(TIME)
    expected = 0.5 * TONE.waveform(TIME, position) - 0.5 * RIDGES.waveform(TIME, position)
    np.testing.assert_allclose(both.waveform(TIME, position), expected, atol=1e-18)
    bands = both.bands(5000.0)
    assert len(bands) == 2  # the tone of both parts is one carrier
    played = (bands.envelope * np.exp(1j * bands.carrier_phase(TIME, position))).real.sum(axis=1)
    np.testing.assert_allclose(played, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("texture", "bands", "follows"),
    [
        (TONE + CHIRP, 0, False),
        (2 * ARRAY, 0, False),
        (2 * hr.Recorded(samples=ARRAY.samples, rate=2000.0, amplitude=1e-6, carriers=1), 1, False),
        (RIDGES + hr.Recorded(samples=ARRAY.samples, rate=2000.0, amplitude=1e-6, speed=0.1), 0, True),
        (hr.Playlist([(RIDGES, 1.0)]), 0, True),
        (hr.Playlist([(RIDGES, 1.0), (TONE, 1.0)]), 0, False),
    ],
)
def test_what_has_no_carriers_is_a_waveform(texture, bands, follows):
    found = texture.bands(5000.0)
    assert (len(found), found.envelope, found.follows_finger) == (bands, None, follows)
    checked = found.checked("it", texture.waveform, TIME, AWAY)
    assert checked.any() != follows


def test_a_playlist_plays_each_from_its_beginning_and_starts_again():
    played = hr.Playlist([(TONE, 0.31), (CHIRP, 0.5)], fade=0.0).waveform(TIME, AWAY)
    np.testing.assert_array_equal(played[:1550], TONE.waveform(TIME[:1550], AWAY[:1550]))
    np.testing.assert_allclose(played[1551:4050], CHIRP.waveform(TIME[1:2500], AWAY[1:2500]), atol=1e-14)
    np.testing.assert_allclose(played[4051:5600], played[1:1550], atol=1e-14)


def test_a_playlist_joins_its_parts_without_a_click_where_friction_is_the_slope():
    parts = [(hr.Grating(frequency=120.0, amplitude=2e-6), 0.5), (hr.Grating(frequency=60.0, amplitude=4e-6), 0.5)]
    scene = hr.Scene(texture=hr.Playlist(parts), device="electroadhesion", finger=hr.Finger.sliding(0.05), duration=1.5)
    joined = hr.prepare(scene).requested(TIME, np.zeros(len(TIME)), np.zeros(len(TIME)))
    hard = hr.prepare(replace(scene, texture=hr.Playlist(parts, fade=0.0)))
    assert abs(joined).max() < 2 * abs(joined[1000:2000]).max()
    assert abs(hard.requested(TIME, np.zeros(len(TIME)), np.zeros(len(TIME)))).max() > 1e3 * abs(joined).max()
    assert hr.render(scene).waveform["places"]["friction"]["waveform_error"] < 0.01


@pytest.mark.parametrize("texture", [CHIRP, ARRAY, 0.5 * ARRAY + TONE, hr.Playlist([(TONE + CHIRP, 1.0), (TONE, 0.5)])])
def test_a_scene_file_holds_them(texture):
    scene = hr.Scene(texture=texture, duration=1.0)
    assert hr.Scene.from_toml_text(scene.to_toml()) == scene


def test_a_part_that_is_no_texture_is_named():
    text = hr.Scene(texture=TONE + CHIRP, duration=1.0).to_toml().replace("chirp", "chimp")
    with pytest.raises(hr.SceneError, match=r"texture\.parts\[1\]\[0\]\.kind = 'chimp': must be one of"):
        hr.Scene.from_toml_text(text)


@pytest.mark.parametrize(
    ("device", "method"),
    [("hybrid", "inverse"), *product(("vt-plate", "hybrid"), sorted(set(METHODS) - {"inverse"}))],
)
def test_methods_that_play_bands_refuse_a_whole_waveform(device, method):
    texture = hr.Recorded(samples=ARRAY.samples, rate=2000.0, amplitude=1e-6, speed=0.1)
    scene = hr.Scene(texture=texture, finger=hr.Finger.sliding(speed=0.1), device=device, duration=0.1, method=method)
    with pytest.raises(ValueError, match="texture.carriers is missing: must be >= 1"):
        hr.prepare(scene).controller()


def test_a_chirp_beyond_the_judged_band_is_played_up_to_what_the_rate_carries():
    """Its drive counts as needed, so that nothing stops it; above 0.45 of the rate there is an image, not a chirp."""
    chirp = hr.Chirp(start=1000.0, stop=1900.0, duration=0.5, amplitude=5e-6)
    recording = hr.render(hr.Scene(texture=chirp, duration=0.5))
    assert abs(recording.motion[-250:, 0]).max() > 4.5e-6  # the filters pass 0.9 of it or more
    with pytest.raises(ValueError, match=r"texture\.stop = 2300\.0: must be <= 2250 Hz, 0\.45 of the rate of 5000 Hz"):
        hr.render(hr.Scene(texture=hr.Chirp(start=50.0, stop=2300.0, duration=1.0, amplitude=1e-6), duration=0.1))


@pytest.mark.parametrize("fast", [replace(CHIRP, stop=3000.0), replace(TONE, frequency=3000.0)], ids=["chirp", "tone"])
def test_no_part_of_a_playlist_or_of_a_sum_with_a_waveform_is_played_as_an_image(fast):
    for texture in (hr.Playlist([(TONE, 0.1), (fast, 0.1)]), CHIRP + fast):
        with pytest.raises(ValueError, match=r"3000.*: must be <= 2250 Hz, 0\.45 of the rate of 5000 Hz"):
            hr.prepare(hr.Scene(texture=texture, duration=0.1))


@pytest.mark.parametrize("rate", [5e3, 48e3])
def test_a_waveform_needs_what_its_frequencies_need_wherever_its_record_ends(rate):
    """A step from the end of the record to its start has all frequencies: at 48 kHz 150 times the drive of a chirp.

    A fade of 50 ms has sidebands of 20 Hz, within which the plate's stiffness rises by a tenth at 400 Hz.
    """
    for duration in (0.997, 1.0, 1.3):
        scene = hr.Scene(texture=CHIRP, profile={"rate": rate}, duration=duration)
        rendering = hr.prepare(scene)
        tone = hr.prepare(replace(scene, texture=replace(TONE, amplitude=5e-6, frequency=400.0)))
        assert rendering.model.demand.drive < 1.1 * tone.model.demand.drive


def test_a_waveform_needs_what_the_laws_filters_pass_on():
    """Of the acceleration 0.03 at 20 kHz of 48; the whole would need 18 A, and be refused."""
    chirp = hr.Chirp(start=2e4, stop=2e4, duration=1.0, amplitude=5e-7)
    rendering = hr.prepare(hr.Scene(texture=chirp, profile={"rate": 48e3}, duration=0.2))
    played = abs(hr.run(rendering).drive).max()
    assert 0.0 < played < rendering.model.demand.drive
