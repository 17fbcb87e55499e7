"""Textures made of textures, arrays and chirps: what they play, in which bands, in a scene file; who refuses them."""

from dataclasses import replace

import numpy as np
import pytest
from waves import Own

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.touch import composed
from hapticrender.touch.grating import Grating

TIME = np.arange(0.0, 3.0, 1 / 5000)
AWAY = np.full(TIME.size, np.nan)
TONE = hr.Grating(amplitude=10e-6, frequency=47.0)
RIDGES = hr.Grating(amplitude=10e-6, wavelength=1e-3)
CHIRP = hr.Chirp(start=20.0, stop=400.0, duration=2.0, amplitude=5e-6)
BY_BANDS = sorted(set(METHODS) - {"inverse"})
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


@pytest.mark.parametrize(("device", "method"), [("hybrid", "h2"), *(("vt-plate", each) for each in BY_BANDS)])
def test_methods_that_play_bands_refuse_a_whole_waveform(device, method):
    texture = hr.Recorded(samples=ARRAY.samples, rate=2000.0, amplitude=1e-6, speed=0.1)
    scene = hr.Scene(texture=texture, finger=hr.Finger.sliding(speed=0.1), device=device, duration=0.1, method=method)
    with pytest.raises(ValueError, match="plays bands, no whole waveform"):
        hr.prepare(scene).controller()


def test_a_chirp_beyond_the_judged_band_is_played_up_to_what_the_rate_carries():
    """Its drive counts as needed, so that nothing stops it; above 0.45 of the rate there is an image, not a chirp."""
    chirp = hr.Chirp(start=1000.0, stop=1900.0, duration=0.5, amplitude=5e-6)
    recording = hr.render(hr.Scene(texture=chirp, duration=0.5))
    assert abs(recording.motion[-250:, 0]).max() > 0.65 * 5e-6  # filters pass 0.9 at 1900 Hz, the hold 0.78
    with pytest.raises(ValueError, match=r"texture\.stop = 2300\.0: must be <= 2250 Hz, 0\.45 of the rate of 5000 Hz"):
        hr.render(hr.Scene(texture=hr.Chirp(start=50.0, stop=2300.0, duration=1.0, amplitude=1e-6), duration=0.1))


INSTANTS = np.linspace(0.0, 0.1, 501)

GRATINGS = {
    "sine in time": Grating(amplitude=10e-6, frequency=111.0, phase=0.7),
    "sine in space": Grating(amplitude=10e-6, wavelength=1e-3, phase=-2.0),
    "square in time": Grating(amplitude=1e-6, frequency=31.0, shape="square", phase=0.3),
    "triangle in space": Grating(amplitude=1e-6, wavelength=2e-3, shape="triangle", harmonics=3, phase=1.0),
    "inharmonic": Grating(amplitude=5e-6, frequency=20.0, partials=((1, 1.0, 0.0), (2.7, -0.5, 1.2))),
}


def test_a_spatial_grating_is_still_while_lifted_and_a_tone_is_not():
    position = np.array([0.0, np.nan, 0.0005, np.nan])
    time = np.zeros(4)
    assert Grating(amplitude=1e-6, wavelength=1e-3).waveform(time, position).tolist() == [1e-6, 0.0, -1e-6, 0.0]
    assert Grating(amplitude=1e-6, frequency=50.0).waveform(time, position).tolist() == [1e-6] * 4


@pytest.mark.parametrize("name", GRATINGS)
def test_bands_carry_the_waveform(name):
    grating = GRATINGS[name]
    position = 0.02 * np.sin(2 * np.pi * 3 * INSTANTS)
    bands = grating.bands(rate=5000.0)
    summed = (bands.envelope * np.exp(1j * bands.carrier_phase(INSTANTS, position))).real.sum(axis=1)
    np.testing.assert_allclose(grating.waveform(INSTANTS, position), summed, atol=1e-9 * grating.amplitude)


@pytest.mark.parametrize(("shape", "order"), [("square", 1), ("triangle", 3)])
def test_partials_converge_to_the_shape_at_the_order_of_their_series(shape, order):
    """Coefficients fall as 1/n (square) or 1/n^2 (triangle): the power left out falls as N^-1 or N^-3."""
    turns = (np.arange(1 << 14) + 0.5) / (1 << 14)
    ideal = {"square": np.sign(np.cos(2 * np.pi * turns)), "triangle": np.abs(4 * turns - 2) - 1}[shape]
    left_out = []
    for harmonics in (8, 16):
        grating = Grating(amplitude=1e-3, frequency=1.0, shape=shape, harmonics=harmonics)
        left_out.append(np.mean((grating.waveform(turns, turns) / 1e-3 - ideal) ** 2))
    assert np.log2(left_out[0] / left_out[1]) == pytest.approx(order, abs=0.02)


def test_velocity_and_level_become_the_amplitude():
    """Closed form: 0.06 m/s is 0.48 mm at 20 Hz and 0.024 mm at 400 Hz; threshold 0.63 um at 100 Hz."""
    assert Grating(velocity=0.06, frequency=20.0).amplitude == pytest.approx(0.48e-3, abs=0.005e-3)
    assert Grating(velocity=0.06, frequency=400.0).amplitude == pytest.approx(0.024e-3, abs=0.0005e-3)
    assert Grating(velocity=0.06, wavelength=1e-3, speed=0.4).amplitude == pytest.approx(0.024e-3, abs=0.0005e-3)
    assert Grating(level=20.0, frequency=100.0).amplitude == pytest.approx(6.3e-6, rel=1e-12)
    assert Grating(level=-20.0, wavelength=1e-3, speed=0.1).amplitude == pytest.approx(0.063e-6, rel=1e-12)


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
