"""Live play, not paced: what plays is the texture, whatever changes on the way, and whoever drives the device."""

from contextlib import nullcontext
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from live_devices import RIDGES, TONE, Blind, Calling, Lying, error_of, slide
from strangers_plate import StrangersPlate
from test_two_touches import HEAVY

import hapticrender as hr
from hapticrender.driver_checks import OPEN
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.recordings.recording import Recording
from hapticrender.sampled_texture import FADE


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session on a plate, finger moving: a tone, ridges, half of them, a chirp, the finger lifted."""
    path = tmp_path_factory.mktemp("live") / "session.au"
    states = []
    with hr.Player(paced=False) as player:
        player.play(TONE)
        player.record(path)
        place = slide(player, 1.0)
        states.append(player.state())
        player.play(RIDGES)
        place = slide(player, 1.0, start=place, speed=-0.05)
        states.append(player.state())
        player.gain = 0.5
        place = slide(player, 0.5, start=place, speed=-0.08)
        states.append(player.state())
        player.play(hr.Chirp(start=50.0, stop=300.0, duration=1.0, amplitude=5e-6) + 0.3 * TONE)
        player.finger(float("nan"))
        player.sleep(1.0)
        states.append(player.state())
        recording = player.end_recording()
    return recording, path, states


def test_every_part_of_a_session_is_its_texture(session):
    """Within what the law reaches in `render` (a sliding finger: 1 % must, 2 % at a touch that is new)."""
    recording, _, _ = session
    assert len(recording) == 17_500
    for start, stop in ((0.5, 1.0), (1.1, 2.0), (2.1, 2.5), (2.7, 3.5)):
        assert error_of(recording, start, stop) < 0.02
    assert error_of(recording, 1.0, 1.0 + FADE) < 0.05  # one fades into the other
    assert (recording.flags == 0).all()


def test_the_state_says_what_plays(session):
    _, _, states = session
    tone, ridges, half, chirp = (state.bands for state in states)
    assert [band.frequency for band in tone + ridges + half] == pytest.approx([100.0, 50.0, 80.0], rel=0.01)
    assert [band.target for band in tone + ridges + half] == pytest.approx([5e-6, 5e-6, 2.5e-6], rel=0.01)
    assert all(band.error < 0.02 for band in tone + ridges + half)
    [whole] = chirp
    assert (whole.frequency, whole.target) == (
        0.0,
        pytest.approx(0.5 * 5e-6 * np.hypot(1.0, 0.3) / np.sqrt(2), rel=0.1),
    )
    assert str(states[0]).startswith("  100.0 Hz  target     5e-06 m  achieved  ")
    assert [state.time for state in states] == pytest.approx([1.0, 2.0, 2.5, 3.5])


def test_a_session_is_a_recording_like_any_other(session):
    recording, path, _ = session
    loaded = Recording.load(path)
    np.testing.assert_array_equal(loaded.drive, recording.drive)
    assert loaded.header.motion_source == "true"
    assert loaded.summary()["waveform"]["share_in_band"] > 0.9


class Telling(Lying):
    """A plate that hands its motion over, only senses it, or does neither."""

    probe = False

    def __init__(self, source):
        super().__init__(100.0, "nothing")
        self.source, self.sensed_channels = source, 0 if source == "unknown" else 2

    def _play(self, drive):
        sensed = super()._play(drive)
        told = sensed.motion if self.source == "true" else None
        return sensed._replace(motion=told, sensed=sensed.sensed[:, : self.sensed_channels])


@pytest.mark.parametrize("source", ["true", "sensors", "unknown"])
def test_a_recording_says_where_its_motion_comes_from(source, tmp_path):
    with hr.Player(driver=Telling(source), paced=False) as player:
        player.play(TONE)
        player.record(tmp_path / "live.au")
        assert (tmp_path / "live.au").exists()
        player.sleep(0.5)
        state = player.state()
        recording = player.end_recording()
    assert state.bands[0].target == pytest.approx(5e-6, rel=1e-3)
    assert ("not sensed" in str(state)) == (source == "unknown")
    assert recording.header.motion_source == source
    judged = recording.summary()["verdict"] != "not judged"
    assert judged == (source == "true")  # 1 um of noise on 5 um is no error of the device


class Kept(StrangersPlate):
    """In blocks of 10 at 5 kHz, each acting a block later still, under a heavy finger from 0.3 s on."""

    def __init__(self):
        self.place, self.handed, self.sensed = hr.Finger.swiping(1.0, speed=0.1).position, [], []
        touch = {"finger": HEAVY, "load": 0.4, "contact": lambda time: 1.0 * (time > 0.3), "position": self.place}
        super().__init__(block=10, told=20, delay=11, **touch)

    def play(self, drive):
        found = super().play(drive)
        self.handed.append(drive.copy())
        self.sensed.append(found.sensed)
        return found


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize("method", ["inverse", "h2"])
def test_a_recording_has_the_drive_that_was_handed_over_with_each_block(method, live, tmp_path):
    """A law by samples and one in blocks, live and by `render`; out of step, one finger would pass for two."""
    driver = Kept()
    if live:
        with hr.Player(driver=driver, paced=False, method=method) as player:
            player.play(TONE)
            player.record(tmp_path / "live.au")
            player.sleep(1.5)
            recording = player.end_recording()
    else:
        recording = hr.render(hr.Scene(texture=TONE, duration=1.5, method=method), driver=driver)
    assert len(recording) == 7500
    handed, sensed = (np.concatenate(each)[: len(recording)] for each in (driver.handed, driver.sensed))
    assert abs(handed).max() > 0.01
    np.testing.assert_array_equal(recording.sensed, sensed)
    np.testing.assert_array_equal(recording.drive, handed)
    assert not (recording.flags & hr.Flag.TWO_TOUCHES).any()


@pytest.mark.parametrize(
    ("device", "stronger"),
    [("vt-plate", RIDGES), ("electroadhesion", hr.Grating(frequency=90.0, amplitude=20e-6))],
)
def test_one_that_is_not_paced_repeats_to_the_bit(device, stronger, monkeypatch):
    """Also block by block, as a driver of one's own is played; a stronger texture gives a screen another bias."""

    def drive():
        with hr.Player(device, paced=False, seed=3) as player:
            player.play(TONE)
            slide(player, 0.1)
            player.play(stronger)
            slide(player, 0.2)
            return player._loop.log(0)["drive"]

    at_once = drive()
    monkeypatch.setattr(SimulatedDriver, "device_loop", lambda self, controller: None)
    np.testing.assert_array_equal(drive(), at_once)


def test_it_is_what_render_plays(tmp_path):
    """A scene with its own finger, from the same texture and law: within a tenth of the same figures, or 0.1 %."""
    scene = hr.Scene(texture=RIDGES, finger=hr.Finger.sliding(0.05, 0.4), duration=3.0)
    with hr.Player(scene, paced=False) as player:
        player.play(RIDGES)
        player.record(tmp_path / "live.au")
        player.sleep(3.0)
        live = player.end_recording()
    for place, wanted in hr.render(scene).waveform["places"].items():
        assert live.waveform["places"][place]["waveform_error"] == pytest.approx(
            wanted["waveform_error"], rel=0.1, abs=1e-3
        )


def test_what_is_given_beside_a_scene_replaces_the_scenes_own(tmp_path):
    finger = hr.Finger.sliding(0.02, 0.8)
    scene = hr.Scene(texture=RIDGES, finger=hr.Finger.sliding(0.05, 0.4), duration=1.0, seed=1, profile={"mass": 0.04})
    with hr.Player(scene, finger=finger, seed=7, paced=False) as player:
        player.play(RIDGES)
        player.record(tmp_path / "live.au")
        player.sleep(0.1)
        recording = player.end_recording()
    assert recording.scene == replace(scene, finger=finger, seed=7)
    np.testing.assert_allclose(np.diff(recording.position) * recording.rate, 0.02, rtol=1e-6)
    with pytest.raises(TypeError, match="colour"):
        hr.Player(scene, colour="red")


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic"])
def test_a_texture_in_time_and_along_the_surface_at_once_is_played_as_friction(device):
    """A recording of 140 Hz over time, and ridges at 80 Hz, of the same velocity of the skin."""
    recorded = np.sin(2 * np.pi * 140.0 * np.arange(4000) / 4000.0)
    both = hr.Recorded(samples=recorded, rate=4000.0, amplitude=5e-6) + 1.75 * RIDGES
    with hr.Player(device, paced=False) as player:
        player.finger(-0.04, 0.08, 0.4)
        player.play(both)
        slide(player, 0.6, start=-0.04, speed=0.08)
        [band] = player.state().bands
        reference = player._loop.signals(player._loop.samples - round(0.25 * player._loop.rate))[1]["reference"]
    lines = abs(np.fft.rfft(reference * np.hanning(len(reference))))
    peaks = [lines[round(f * len(reference) / player._loop.rate)] for f in (80.0, 140.0)]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.1)
    assert band.error < 0.04


@pytest.mark.parametrize("device", ["electroadhesion", "ultrasonic", "vt-plate"])
def test_only_a_plate_is_to_move_without_a_finger(device, tmp_path):
    with hr.Player(device, paced=False) as player:
        player.play(TONE)
        player.record(tmp_path / "lifted.au")
        slide(player, 0.3)
        player.finger(float("nan"))
        player.sleep(0.4)
        [lifted] = player.state().bands
        recording = player.end_recording()
    away = np.isnan(recording.position)
    assert recording.reference[~away].any()
    assert recording.reference[away].any() == (device == "vt-plate")
    assert (lifted.target > 0.0) == (device == "vt-plate")


def test_a_grating_under_a_finger_that_rests_has_no_amplitude():
    """The plate holds the displacement of that place; there is nothing else to compare."""
    with hr.Player(paced=False) as player:
        player.play(RIDGES)
        slide(player, 0.5)
        [moving] = player.state().bands
        player.finger(0.005, 0.0, 0.4)
        player.sleep(0.6)
        [resting] = player.state().bands
    assert moving.error < 0.02
    assert resting.target == 0.0
    assert np.isnan(resting.error)


def test_a_texture_that_cannot_be_played_changes_nothing():
    with hr.Player(paced=False) as player:
        player.play(TONE)
        player.sleep(0.3)
        with pytest.raises(ValueError, match=r"texture.frequency = 2400: must be <= 2250 Hz"):
            player.play(hr.Grating(frequency=2400.0, amplitude=1e-6))
        with pytest.raises(ValueError, match=r"amplitude"):
            player.play(hr.Grating(frequency=400.0, amplitude=5e-3))
        player.sleep(0.3)
        assert player.state().bands[0].error < 0.02


def test_a_load_of_the_devices_own_is_not_the_players():
    device = Blind(Plate(PlateParameters(), hr.Finger.absent()))
    device.load = lambda time: 0.4
    with hr.Player(driver=device, paced=False) as player:
        player.play(TONE)
        assert np.isnan(player.state().load)


def test_what_it_refuses(tmp_path):
    with hr.Player(paced=False) as player:
        for act, what in (
            (lambda: player.sleep(1.0), "sleep: nothing plays yet"),
            (player.state, "state: nothing plays yet"),
            (lambda: player.record(tmp_path / "a.au"), "record: nothing plays yet"),
            (player.end_recording, "nothing is being recorded"),
            (lambda: player.finger(np.inf), "position=inf m"),
            (lambda: player.finger(-20.0), r"position=-20\.0 m, .* must be at most 0\.15 m from the middle"),
            (lambda: player.finger(0.0, 50.0), r"velocity=50\.0 m/s"),
            (lambda: player.finger(0.0, 0.1, -1.0), r"load=-1\.0 N"),
            (lambda: player.finger(None), "position=None"),
            (lambda: player.finger(0.01j, 0.0), "position=0.01j"),
            (lambda: player.finger(0.0, Decimal("0.01")), "velocity=Decimal"),
            (lambda: player.finger(0.0, 10**400), "velocity=1000"),
            (lambda: setattr(player, "gain", np.nan), "gain = nan: must be a finite number >= 0 and <= 10"),
            (lambda: player.sleep(-1.0), "seconds = -1.0"),
        ):
            with pytest.raises(ValueError, match=what):
                act()
    with pytest.raises(ValueError, match="the player has been closed"):
        player.play(TONE)
    with pytest.raises(ValueError, match="the player is not open: use it in a with statement"):
        hr.Player(paced=False).play(TONE)
    with pytest.raises(ValueError, match=r"watchdog = 0: must be a finite number >= 0\.1 and <= 60 s"):
        hr.Player(watchdog=0)
    with hr.Player(driver=Calling(), paced=False) as player, pytest.raises(ValueError, match="paced = False"):
        player.play(TONE)
    driver = Lying(100.0, "nothing")
    driver.block = driver.delay = 1000
    late = pytest.raises(ValueError, match=r"watchdog = 0\.3 s: must be >= 0\.4 s, two blocks")
    with hr.Player(driver=driver, watchdog=0.3) as player, late:
        player.play(TONE)
    with hr.Player(paced=False) as player:
        player.play(TONE)
        for path in (None, 3):
            with pytest.raises(TypeError, match=r"path .*: must be the name of a journal, such as session\.au"):
                player.record(path)
    with pytest.raises(TypeError, match="texture: .* call play"):
        hr.Player(texture=TONE)
    with hr.Player() as player:
        for gain in (-0.1, 10.1):
            with pytest.raises(ValueError, match=f"gain = {gain}: must be a finite number >= 0 and <= 10"):
                player.gain = gain


def test_a_driver_that_another_player_has_open_is_refused():
    """It goes on there, and once that is closed it is free again."""
    driver = Lying(1e9, "")
    with hr.Player(driver=driver, paced=False) as first:
        first.play(TONE)
        with (
            hr.Player(driver=driver, paced=False) as second,
            pytest.raises(ValueError, match="is already open in a Player"),
        ):
            second.play(TONE)
        with pytest.raises(ValueError, match="is already open in a Player or a run: end that one first"):
            hr.render(hr.Scene(texture=TONE, duration=0.1), driver=driver)
        first.sleep(0.5)
        assert first.state().bands[0].error < 0.02
    assert id(driver) not in OPEN


@pytest.mark.parametrize(
    ("device", "error", "message"),
    [
        ("vt_plate", ValueError, "device 'vt_plate' is not installed: must be one of .*vt-plate"),
        (replace(hr.Scene(texture=TONE, duration=1.0), device="tea"), ValueError, "device 'tea' is not installed"),
        (None, TypeError, "device is missing: must be"),
        ("none.toml", hr.SceneError, "none.toml: must be a readable file"),
    ],
)
def test_a_device_that_cannot_be_is_refused_at_once(device, error, message):
    with pytest.raises(error, match=message):
        hr.Player(device)


@pytest.mark.parametrize("device", ["vt-plate", "electroadhesion", "ultrasonic", "hybrid"])
@pytest.mark.parametrize(
    ("tables", "error", "message"),
    [
        ({}, None, ""),
        ({"method": "tea"}, ValueError, "method = 'tea': must be one of paper"),
        ({"profile": {"massive": 1.0}}, ValueError, "device.massive = 1.0: unknown key; known: "),
        ({"simulation": {"massive": 1.0}}, ValueError, "simulation.massive = 1.0: unknown key; known: "),
        ({"profile": {"rate": -1.0}}, ValueError, "device.rate = -1.0: must be a finite number >= "),
        ({"limits": {"peak_drive": 400.0}}, ValueError, r"\[limits\] peak_drive = 400 [AV]: must be <= .*left out"),
        ({"limits": {"displacement": 1.0}}, ValueError, r"displacement = 1(.0| m): must be .*left out"),
        ({"rendering": {"probe": 1}}, TypeError, "render.probe = 1: must be true or false"),
    ],
)
def test_a_method_and_entries_that_no_texture_could_be_played_with_are_refused_at_once(device, tables, error, message):
    """By a scene's tables, too; with none of them wrong it is made."""
    for made_of in (lambda: device, lambda: hr.Scene(texture=TONE, duration=1.0, device=device)):
        with pytest.raises(error, match=message) if error else nullcontext():
            hr.Player(made_of(), **tables)
