"""Textures made of textures, arrays and chirps: what they play, in which bands, in a scene file; who refuses them."""

from itertools import product

import numpy as np
import pytest
from waves import Own

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.touch import composed

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
    played = hr.Playlist([(TONE, 0.31), (CHIRP, 0.5)]).waveform(TIME, AWAY)
    np.testing.assert_array_equal(played[:1550], TONE.waveform(TIME[:1550], AWAY[:1550]))
    np.testing.assert_allclose(played[1551:4050], CHIRP.waveform(TIME[1:2500], AWAY[1:2500]), atol=1e-14)
    np.testing.assert_allclose(played[4051:5600], played[1:1550], atol=1e-14)


@pytest.mark.parametrize("texture", [CHIRP, ARRAY, 0.5 * ARRAY + TONE, hr.Playlist([(TONE + CHIRP, 1.0), (TONE, 0.5)])])
def test_a_scene_file_holds_them(texture):
    scene = hr.Scene(texture=texture, duration=1.0)
    assert hr.Scene.from_toml_text(scene.to_toml()) == scene


class InPlace:
    """A texture and a motion of one's own: of the arrays that they are handed, or of copies of them."""

    def __init__(self, spatial, copies):
        self.spatial, self.take = spatial, np.copy if copies else np.asarray
        self.bands = Own(None, spatial).bands

    def waveform(self, time, position):
        turns = self.take(position if self.spatial else time)
        turns *= 1000.0 if self.spatial else 100.0
        return 5e-6 * np.sin(2 * np.pi * turns)

    def position(self, time):
        place = self.take(time)
        place *= 0.08
        return place

    load = position


@pytest.mark.parametrize("spatial", [False, True])
def test_what_is_handed_to_a_users_code_is_a_copy(spatial):
    """A texture that works in place changed that of the next part, what was recorded and constants of the module."""
    readings, found = composed.READINGS.copy(), []
    for copies in (False, True):
        own = InPlace(spatial, copies)
        texture = hr.Sum([(own, 1.0), (RIDGES if spatial else TONE, 0.5)])
        time = TIME.copy()
        waveform = texture.waveform(time, time)
        assert np.array_equal(time, TIME)
        run = hr.render(hr.Scene(texture=texture, finger=hr.Finger(own, None), duration=0.5))
        with hr.Player(paced=False) as player:
            player.play(texture)
            player.play(own)
            player.sleep(0.1)
        found.append([waveform, run.position, run.normal_load, run.reference, run.drive])
    assert np.array_equal(composed.READINGS, readings)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_textures_are_added_and_subtracted():
    class Mine(Own):
        """One of one's own, without operators."""

    mine = Mine(lambda time, position: 1e-6 * np.sin(time))
    a, b = TONE.waveform(TIME, AWAY), CHIRP.waveform(TIME, AWAY)
    for texture, expected in (
        (sum([TONE, CHIRP]), a + b),
        (TONE - CHIRP, a - b),
        (TONE - (CHIRP - 0.5 * TONE), 1.5 * a - b),
        (-TONE, -a),
        (TONE - mine, a - 1e-6 * np.sin(TIME)),
    ):
        np.testing.assert_allclose(texture.waveform(TIME, AWAY), expected, atol=1e-18)
    for act in (lambda: TONE - 1, lambda: 1 + TONE, lambda: 1 - TONE, lambda: sum([TONE], 1.0)):
        with pytest.raises(TypeError, match="unsupported operand"):
            act()


def test_bands_are_equal_by_their_numbers():
    one, other = (TONE + RIDGES).bands(5000.0), (TONE + RIDGES).bands(5000.0)
    assert one == other
    assert one in [other]
    louder = (TONE + 2 * RIDGES).bands(5000.0)
    for different in (louder, TONE.bands(5000.0), hr.Bands.none(spatial=True), 2 * one.envelope, None):
        assert one != different
    assert hr.Bands.none(spatial=True) != hr.Bands.none(spatial=False)
    scene = hr.Scene(texture=TONE, duration=0.1)
    runs = [
        hr.Recorder(None, scene=scene, method="h2", seed=0, rate=5000.0, bands=each) for each in (one, other, louder)
    ]
    assert runs[0].header == runs[1].header != runs[2].header


def test_what_holds_signals_is_equal_to_itself_alone():
    blocks, scene = [hr.Sensed(np.zeros((2, 2)), np.zeros(2)) for _ in range(2)], hr.builtin_scenes()["grating-47"]
    models = [hr.prepare(scene, compiled=False).model for _ in range(2)]
    for one, other in (blocks, models):
        assert one == one  # noqa: PLR0124
        assert one != other
        assert one in [other, one]
        assert one not in [other]


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
