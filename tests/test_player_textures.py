"""Live play, not paced: playlists, and textures of one's own, in time and place at once too."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from live_devices import RIDGES, TONE, Lying, error_of, slide

import hapticrender as hr


def test_a_playlist_along_the_surface_goes_round():
    """Ridges, a tone, and again, each within what its law reaches; then the next texture plays on."""
    bands, place = [], -0.05
    with hr.Player(paced=False) as player:
        player.play(TONE)
        player.sleep(0.1)
        player.play(hr.Playlist([(RIDGES, 0.5), (TONE, 0.7)]))
        for seconds in (0.3, 0.6, 0.6, 0.6):  # each ends in a part that began 0.3 s ago or more
            place = slide(player, seconds, start=place, speed=0.03)
            bands += player.state().bands
        player.play(TONE)
        slide(player, 0.8, start=place, speed=0.03)
        bands += player.state().bands
    assert [band.frequency for band in bands] == pytest.approx([30.0, 100.0, 30.0, 100.0, 100.0], rel=0.01)
    assert [band.target for band in bands] == pytest.approx([5e-6] * 5, rel=0.01)
    assert all(band.error < 0.02 for band in bands)


UNPLAYABLE = [
    ([(RIDGES, 0.05), (TONE, 0.7)], r"a part of 0\.05 s of a playlist along the surface: must be >= 0\.1 s"),
    ([(RIDGES, 0.5), (hr.Grating(frequency=2400.0, amplitude=5e-6), 0.5)], "frequency"),
]


@pytest.mark.parametrize("first", [True, False])
def test_a_playlist_that_cannot_be_played_leaves_what_plays_and_a_device_that_can(first):
    """Its second part is refused before anything plays, and before a device is started."""
    with hr.Player(paced=first) as player:
        if not first:
            player.play(TONE)
        threads = threading.active_count()
        for parts, message in UNPLAYABLE:
            with pytest.raises(ValueError, match=message):
                player.play(hr.Playlist(parts))
        assert threading.active_count() == threads
        if first:
            player.play(TONE)
        player.sleep(0.7)
        assert [band.frequency for band in player.state().bands] == [100.0]


@dataclass(frozen=True)
class Own:
    """A texture of one's own that does not say whether it is a function of position."""

    along: float = 0.0  # turns a metre
    in_time: float = 0.0  # Hz
    ready: Any = None  # an event that is waited for

    def bands(self, rate):
        if self.along and not self.in_time:
            return hr.Bands(frequency=np.zeros(1), wavenumber=np.array([self.along]), phase=np.zeros(1))
        return hr.Bands.none(spatial=False)

    def waveform(self, time, position):
        if self.ready is not None:
            self.ready.wait(60.0)
        turns = self.in_time * np.asarray(time) + self.along * np.nan_to_num(position)
        return 5e-6 * np.cos(2 * np.pi * turns)


def test_a_texture_of_ones_own_lies_where_its_bands_say(tmp_path):
    """With a wavenumber along the surface."""
    with hr.Player(paced=False) as player:
        player.play(Own(along=1e3))
        player.record(tmp_path / "own.au")
        slide(player, 1.0)
        recording = player.end_recording()
    assert np.std(recording.reference[2500:]) == pytest.approx(5e-6 / np.sqrt(2), rel=0.02)
    assert error_of(recording, 0.5) < 0.02


MOVING = Own(along=1e3, in_time=200.0)
WORST = 0.032  # error of ridges and a tone, of all sessions in docs/live.md


def test_a_texture_in_time_and_place_at_once_is_as_good_live_as_in_a_run(tmp_path):
    """Under the same finger; the noise of the sensors, at another phase of the texture, may cost a tenth."""
    finger = hr.Finger.swiping(frequency=1.0, stroke=0.04, normal_load=0.4)
    scene = hr.Scene(texture=MOVING, finger=finger, duration=2.0)
    with hr.Player(scene, paced=False) as player:
        player.play(MOVING)
        player.record(tmp_path / "live.au")
        player.sleep(2.0)
        live = player.end_recording()
    assert error_of(live, 0.5) < 1.1 * error_of(hr.render(scene), 0.5)
    time = np.arange(len(live)) / live.rate
    turns = 200.0 * time + 1e3 * live.position
    waves = np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)[2500:]
    size, residual, *_ = np.linalg.lstsq(waves, live.reference[2500:])  # of any phase: it begins the look-ahead later
    assert np.hypot(*size) == pytest.approx(5e-6, rel=1e-6)
    assert residual[0] < (1e-9 * 5e-6) ** 2 * len(waves)


def test_a_texture_in_time_and_place_at_once_follows_the_finger_of_the_application(tmp_path):
    """It fades into others and back, goes on in time where nothing touches, and stops nothing."""
    with hr.Player(paced=False) as player:
        player.play(TONE)
        place = slide(player, 0.5)
        player.record(tmp_path / "moving.au")
        player.play(MOVING)
        place = slide(player, 0.5, place)
        player.finger(np.nan)
        player.sleep(0.5)
        player.play(TONE)
        player.sleep(0.2)
        recording, state = player.end_recording(), player.state()
    assert error_of(recording, 0.05, 0.5) < WORST
    assert error_of(recording, 0.6, 1.0) < WORST
    power = abs(np.fft.rfft(recording.reference[3000:5000]))
    assert np.fft.rfftfreq(2000, 1 / 5000)[power.argmax()] == 200.0  # the finger's last place counts no more
    assert state.bands[0].error < 0.02
    assert state.flags == hr.Flag(0)


@dataclass(frozen=True)
class Ridges(Own):
    """Ridges that wander, and nothing while the finger is away."""

    fails: Any = None  # an event

    def bands(self, rate):
        return hr.Bands.none(spatial=True)

    def waveform(self, time, position):
        if self.fails is not None and self.fails.is_set():
            raise ZeroDivisionError("no more ridges")
        return super().waveform(time, position)


def test_ridges_that_wander_are_zero_while_the_finger_is_away(tmp_path):
    """Their own error ends the play, with the device at rest."""
    fails, driver = threading.Event(), Lying(1e9, "")
    with hr.Player(driver=driver, paced=False) as player:
        player.play(Ridges(along=1e3, in_time=100.0, fails=fails))
        slide(player, 0.5)
        player.record(tmp_path / "ridges.au")
        player.finger(np.nan)
        player.sleep(0.2)
        away = player.end_recording()
        fails.set()
        with pytest.raises(ZeroDivisionError, match="no more ridges"):
            player.sleep(0.1)
    assert not away.reference[500:].any()
    assert not driver.played[-1].any()


@dataclass(frozen=True)
class Noise(Own):
    """White noise that is drawn anew at every reading."""

    def waveform(self, time, position):
        return 1e-6 * np.random.default_rng().standard_normal(np.shape(time))


def test_a_texture_that_changes_with_every_reading_is_refused():
    """What is recorded would not be what has been played."""
    with hr.Player(paced=False) as player, pytest.raises(ValueError, match="Noise: must not change with a reading"):
        player.play(Noise())


def test_a_playlist_along_the_surface_plays_beside_a_tone_and_within_another():
    """As functions of time and place at once."""
    ridges = hr.Playlist([(RIDGES, 0.3), (hr.Grating(wavelength=0.5e-3, amplitude=5e-6), 0.3)])
    with hr.Player(paced=False) as player:
        for texture in (ridges + TONE, hr.Playlist([(ridges, 0.6), (TONE, 0.2)])):
            player.play(texture)
            slide(player, 0.5)
            (row,) = player.state().bands
            assert row.target > 0.9 * 5e-6 / np.sqrt(2)
            assert row.error < WORST
