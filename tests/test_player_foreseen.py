"""Textures in time and place at once, evaluated by Python ahead of a callback that holds no lock."""

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from live_devices import TONE, Calling, slide
from test_player_textures import MOVING, Own

import hapticrender as hr
from hapticrender import sampled_texture
from hapticrender.live_loop import REFRESH, LiveLoop
from hapticrender.loop import prepare
from hapticrender.sampled_texture import BLEND, FADE, PIECE

RATE, BLOCK = Calling.rate, Calling.block
SPEED = 0.05  # m/s
LOOK = 4  # blocks between two looks of the thread: 5.3 ms


class Run:
    """A loop that is called block by block, and what was played."""

    def __init__(self, texture=MOVING):
        scene = hr.Scene(texture=texture, finger=hr.Finger.sliding(speed=SPEED), duration=10.0)
        scales = {"sensed_scale": Calling.sensed_scale, "drive_scale": Calling.drive_scale}
        self.loop = LiveLoop(prepare(scene, driver=Calling()), **scales)
        self.texture, self.found = texture, []

    def play(self, blocks, look=LOOK):
        for block in range(blocks):
            if look and block % look == 0:
                self.loop.foresee()
            start = self.loop.samples
            self.loop.process(np.zeros((BLOCK, 2)))
            self.found.append(self.loop.log(start))

    def slide(self, blocks, start, speed=SPEED, look=LOOK):
        """Set the finger every 16 blocks, exactly where it is at the start of the next one; returns where it ends."""
        for block in range(0, blocks, 16):
            self.loop.finger(start + speed * block * BLOCK / RATE, speed, 0.4)
            self.play(min(16, blocks - block), look)
        return start + speed * blocks * BLOCK / RATE

    def signals(self):
        """Reference, flags, and the texture where the finger really was; it begins the look-ahead after the start."""
        reference, position, flags = (
            np.concatenate([each[name] for each in self.found]) for name in ("reference", "position", "flags")
        )
        since = (np.arange(len(reference)) - self.loop.ahead) / RATE
        return reference, flags, self.texture.waveform(since, position)


def test_where_a_finger_goes_on_as_it_did_the_texture_is_that_of_its_place():
    """Predicted by the kernel that follows it: to rounding, once the texture and the first position have faded in."""
    run = Run()
    run.slide(200, -0.01)
    reference, flags, texture = run.signals()
    settled = slice(round((FADE + 4 * BLEND) * RATE) + run.loop.ahead + 2 * LOOK * BLOCK, None)
    np.testing.assert_allclose(reference[settled], texture[settled], rtol=0, atol=1e-9 * 5e-6)
    assert not (flags & hr.Flag.OVERRUN).any()


def test_a_finger_that_turns_is_followed_late_and_then_exactly():
    """One block until it is set, one look, the look-ahead and the fade later; nothing steps meanwhile."""
    run = Run()
    place = run.slide(160, -0.01)
    run.slide(80, place, -SPEED)
    reference, _, texture = run.signals()
    turn, late = 160 * BLOCK, (2 + LOOK) * BLOCK + run.loop.ahead + round(BLEND * RATE)
    off = abs(reference - texture)
    assert off[turn + late :].max() < 1e-9 * 5e-6
    # (speed before - after)/wavelength turns a second of wrong place, less what the blend has made up for
    assert off[turn : turn + late].max() > 0.5 * 5e-6 * 2 * np.pi * (2 * SPEED / 1e-3) * (late / RATE - BLEND) / 2
    # the steepest of the texture (200 Hz and 50 Hz of ridges), and of a blend over two textures a size apart
    steepest = 5e-6 * (2 * np.pi * (200.0 + SPEED / 1e-3) / RATE + 2 * 1.5 / (BLEND * RATE))
    assert abs(np.diff(reference)).max() < steepest


def test_a_thread_that_is_late_holds_the_texture_then_fades_it_out_and_says_so():
    """Both sides: 140 to 160 ms more are played in full and not flagged; then it fades, and back without a step."""
    run = Run()
    run.slide(160, -0.01)
    whole = 160 * BLOCK + round((PIECE - FADE - REFRESH) * RATE)
    fades = 160 * BLOCK + round((PIECE - FADE) * RATE) + 2 * BLOCK
    gone = fades + round(FADE * RATE) + run.loop.ahead
    run.play(200, look=0)
    run.loop.foresee()
    back = 360 * BLOCK + run.loop.ahead
    run.play(80)
    reference, flags, texture = run.signals()
    overrun = flags & hr.Flag.OVERRUN > 0
    assert not overrun[: whole - BLOCK].any()
    assert overrun[fades : 360 * BLOCK].all()
    held = slice(160 * BLOCK, whole - BLOCK)
    np.testing.assert_allclose(reference[held], texture[held], rtol=0, atol=1e-9 * 5e-6)
    assert not reference[gone:back].any()
    assert not overrun[361 * BLOCK :].any()
    again = slice(back + round(FADE * RATE) + 1, None)
    np.testing.assert_allclose(reference[again], texture[again], rtol=0, atol=1e-9 * 5e-6)
    steepest = 5e-6 * (2 * np.pi * (200.0 + SPEED / 1e-3) / RATE + 2 * 1.5 / (BLEND * RATE))
    assert abs(np.diff(reference)).max() < steepest


@dataclass(frozen=True)
class Stubborn(Own):
    """It fails, or takes its time, once `at` is set."""

    at: Any = None
    fails: bool = False
    seconds: float = 0.0

    def waveform(self, time, position):
        if self.at is not None and self.at.is_set():
            if self.fails:
                raise ZeroDivisionError("no more ridges")
            threading.Event().wait(self.seconds)
        return super().waveform(time, position)


def test_it_fades_into_others_and_back_under_a_callback(tmp_path):
    """Also ridges in a playlist beside a tone; nothing stops the drive, whatever follows what."""
    ridges = hr.Playlist([(hr.Grating(wavelength=1e-3, amplitude=5e-6), 0.3), (TONE, 0.3)]) + TONE
    with hr.Player(driver=Calling()) as player:
        targets = []
        for texture in (TONE, MOVING, ridges, TONE):
            player.play(texture)
            slide(player, 0.4)
            targets.append(player.state().bands[0].target)
        assert player.state().flags & hr.Flag.STOPPED == 0
    assert [targets[0], targets[3]] == pytest.approx([5e-6, 5e-6], rel=1e-3)
    assert targets[1] == pytest.approx(5e-6 / np.sqrt(2), rel=0.05)  # rms; words come when the application is awake
    assert targets[2] > 0.9 * 5e-6 / np.sqrt(2)


def test_a_texture_that_was_replaced_is_evaluated_no_more():
    """What it raises once it has faded out is no fault of the texture that plays."""
    at = threading.Event()
    with hr.Player(driver=Calling()) as player:
        player.play(Stubborn(1e3, 200.0, at=at, fails=True))
        player.sleep(0.1)
        player.play(TONE)
        player.sleep(0.1)  # its fade is over
        at.set()
        player.sleep(0.3)
        assert player.state().flags & hr.Flag.STOPPED == 0


def test_a_texture_that_takes_longer_than_a_piece_lasts_is_flagged():
    """Half a second for 0.1 s: some of it plays, and what fades out counts as lost."""
    at = threading.Event()
    with hr.Player(driver=Calling()) as player:
        player.play(Stubborn(1e3, 200.0, at=at, seconds=0.5))
        player.sleep(0.2)
        before = player.state().lost
        at.set()
        player.sleep(0.8)
        state = player.state()
    assert state.flags & hr.Flag.OVERRUN
    assert state.lost > before


def test_what_its_waveform_raises_ends_the_play_with_zero_drive():
    at, device = threading.Event(), Calling()
    with hr.Player(driver=device) as player:
        player.play(Stubborn(1e3, 200.0, at=at, fails=True))
        player.sleep(0.1)
        at.set()
        with pytest.raises(ZeroDivisionError, match="no more ridges"):
            player.sleep(5.0)
    assert not device.last.any()


def test_a_waveform_that_does_not_return_is_named_and_the_device_left_at_rest(monkeypatch):
    monkeypatch.setattr("hapticrender.player.TIMEOUT", 0.5)
    at, device = threading.Event(), Calling()
    named = pytest.raises(hr.HapticError, match="Stubborn: its waveform has not returned")
    with named, hr.Player(driver=device) as player:
        player.play(Stubborn(1e3, 200.0, at=at, seconds=2.0))
        player.sleep(0.1)
        at.set()
        player.sleep(0.2)
    assert not device.last.any()


def test_what_plays_goes_on_while_a_texture_is_prepared(tmp_path, monkeypatch):
    """The samples ahead last 0.2 s, the next texture takes longer: none is lost, and the watchdog waits."""
    monkeypatch.setattr(sampled_texture, "AHEAD", 0.2)
    ready = threading.Event()
    with hr.Player(watchdog=0.3) as player:
        player.play(Own(in_time=100.0))
        player.sleep(0.3)
        player.record(tmp_path / "long.au")
        began = player.time
        change = threading.Thread(target=player.play, args=(Own(in_time=150.0, ready=ready),))
        change.start()
        while player.time < began + 0.6:
            time.sleep(0.01)  # the application waits in `play`
        ready.set()
        change.join(60.0)
        player.sleep(0.2)
        recording = player.end_recording()
    assert np.isfinite(recording.motion).all()  # as of samples that were not kept; a busy machine may flag some as late
    meanwhile = recording.reference[500:2500]  # 0.1 to 0.5 s
    assert min(np.std(meanwhile[i : i + 500]) for i in range(0, 2000, 500)) > 0.9 * 5e-6 / np.sqrt(2)
