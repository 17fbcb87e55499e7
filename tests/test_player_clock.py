"""Live play in real time: on devices that call back, without a clock of their own, or that fail, hang or are slow."""

import threading
import time
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from live_devices import RIDGES, TONE, Blind, Calling, Lying, slide
from test_player_friction import HANG, KINDS, TEXTURE, failing, unplug
from test_player_textures import Own

import hapticrender as hr
import hapticrender.player
from hapticrender import live_threads
from hapticrender.bands import Bands
from hapticrender.plants.plate import Plate, PlateParameters


def test_a_device_that_calls_back_is_handed_the_compiled_entry():
    """Its log is the drive that was handed over, to half a unit in the last place of a float of 24 bits."""
    device, handed = Calling(), []
    run = device.plate.run
    device.plate.run = lambda drive: (handed.append(drive), run(drive))[1]
    with hr.Player(driver=device) as player:
        player.play(TONE)
        player.sleep(0.3)
        player.play(hr.Grating(frequency=180.0, amplitude=4e-6))
        player.sleep(0.5)
        state = player.state()
    log = player._loop.log(0)
    assert (player._loop.block, log["first"]) == (1, 0)  # a law by samples behind blocks of 64
    assert abs(log["drive"]).max() > 0.01
    np.testing.assert_allclose(log["drive"], np.concatenate(handed)[: len(log["drive"])], rtol=2.0**-24, atol=1e-40)
    assert state.load == 0.25
    assert state.bands[0].target == pytest.approx(4e-6, rel=0.01)
    assert state.bands[0].error < 0.03
    assert abs(device.last).max() == 0.0


def test_a_device_that_is_left_behind_by_the_clock_has_lost_samples():
    class Slow(Lying):
        def _play(self, drive):
            if 100 < self.count <= 130:
                time.sleep(0.02)  # a sample
            return super()._play(drive)

    with hr.Player(driver=Slow(1e9, "")) as player:
        player.play(TONE)
        player.sleep(0.7)
        assert hr.Flag.OVERRUN in player.state().flags


@dataclass(frozen=True)
class Slow(Own):
    """It takes 0.15 s once, where a simulation evaluates it sample by sample."""

    at: Any = None

    def waveform(self, time, position):
        if self.at is not None and self.at.is_set():
            self.at.clear()
            threading.Event().wait(0.15)
        return super().waveform(time, position)


def test_a_simulation_that_is_slower_than_the_clock_is_flagged_and_counted():
    at = threading.Event()
    with hr.Player() as player:
        player.play(Slow(1e3, 200.0, at=at))
        player.sleep(0.2)
        before = player.state().lost
        at.set()
        player.sleep(0.3)
        state = player.state()
    assert hr.Flag.OVERRUN in state.flags
    assert state.lost > before


class Device:
    """What `hold_to_clock` sees of a loop on a real device whose own clock is off: time passes within `play` only."""

    def __init__(self, takes, opening=0.0):
        self.driver, self.rendering = SimpleNamespace(block=25, rate=5000.0), SimpleNamespace(plant=None)
        self.samples, self.now, self.slept, self.takes, self.opening = 0, 0.0, 0.0, takes, opening

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.slept += seconds
        self.now += seconds

    def play(self, stopping, found, late):
        self.now += self.takes * 5e-3 + (self.opening if not self.samples else 0.0)
        self.samples += 25
        found.append(late)
        if self.samples >= 500_000:  # 100 s
            stopping.set()


@pytest.mark.parametrize(
    ("takes", "opening", "late"), [(1.009, 0.0, False), (0.991, 0.0, False), (1.0, 0.5, False), (1.02, 0.0, True)]
)
def test_a_clock_of_its_own_may_be_a_hundredth_off(monkeypatch, takes, opening, late):
    """It is neither late, where it is slower, nor kept waiting, where it is faster; opening a stream is not late."""
    device, stopping, found = Device(takes, opening), threading.Event(), []
    monkeypatch.setattr(live_threads, "time", device)
    live_threads.hold_to_clock(device, partial(device.play, stopping, found), stopping)
    assert any(found) == late
    assert device.slept == 0.0


def test_a_device_that_does_not_wait_is_held_to_the_clock(monkeypatch):
    """To the hundredth that a clock of its own may be off."""
    device, stopping = Device(0.0), threading.Event()
    monkeypatch.setattr(live_threads, "time", device)
    live_threads.hold_to_clock(device, partial(device.play, stopping, []), stopping)
    assert device.now == pytest.approx(100.0, rel=0.0101)


def test_the_finger_of_a_scene_is_sent_to_a_device_that_does_not_sense_it():
    """Positions every 10 ms of signal: a swipe of 2 Hz is off by a quarter of its acceleration times 10 ms squared."""
    scene = hr.Scene(texture=RIDGES, finger=hr.Finger.swiping(2.0, speed=0.05), duration=5.0)
    driver = Blind(Plate(PlateParameters(), scene.finger))
    with hr.Player(scene, driver) as player:
        player.play(RIDGES)
        player.sleep(0.7)
        played = player._loop.signals(0)[1]
    time = np.arange(len(played["position"])) / 5000.0
    off = abs(played["position"] - scene.finger.position(time))[1000:]
    assert np.median(off) < 1e-3  # a loaded machine sends them late
    assert np.isfinite(played["position"][1000:]).all()


class Called(Calling):
    """A device of `KINDS` whose drive a compiled callback makes, like a sound card's, in blocks of 10."""

    sensed_scale, block, delay = 1.0, 10, 10

    def __init__(self, kind):
        self.stopping, self.device = threading.Event(), KINDS[kind]().open()
        self.rate, self.drive_channels = self.device.rate, self.device.drive_channels
        self.sensed_channels = self.device.sensed_channels
        self.play(np.zeros((self.block, self.drive_channels)))  # compiles what real time has no time for

    def play(self, drive):
        return hr.Sensed(self.device.play(drive).sensed)


@pytest.mark.parametrize("kind", ["electroadhesion", "hybrid"])
def test_what_calls_back_runs_the_compiled_controller_behind_a_square_root(kind, tmp_path):
    """No Python between; a texture that needs twice the bias; and zero drive at the end.

    Where a busy machine keeps the application from setting the finger, friction rests: that only adds to the error.
    """
    card = Called(kind)
    with hr.Player(kind, card) as player:
        player.finger(-0.05, 0.08, 0.4)
        player.play(hr.Grating(frequency=100.0, velocity=5e-3))
        slide(player, 0.6, start=-0.05, speed=0.08)
        player.play(TEXTURE)
        slide(player, 0.6, start=-0.002, speed=0.08)
        player.record(tmp_path / "live.au")
        errors = [1.0]
        while errors[-1] >= 0.05 and len(errors) < 8:
            slide(player, 0.3, start=0.0, speed=0.08)
            errors += [band.error for band in player.state().bands]
        recording = player.end_recording()
        assert player._loop.model.delay == card.block
    assert min(errors) < 0.05
    assert recording.header.motion_source == "sensors"
    assert np.isfinite(recording.motion).all()
    screen = np.concatenate(card.device.played)[:, -1]
    assert screen[-1] == 0.0
    assert screen.min() >= 0.0


LOST = hr.DeviceLost, "no answer"
FAILING = [
    ("vt-plate", partial(Lying, 0.3, "cut"), hr.ProtocolError, "sensed"),
    ("vt-plate", partial(Lying, 0.3, "unplugged"), *LOST),
    *((kind, partial(failing, kind, unplug, HANG), *LOST) for kind in ("electroadhesion", "hybrid")),
]


@pytest.mark.parametrize(("kind", "make", "error", "cause"), FAILING)
def test_a_driver_that_fails_is_left_without_drive_at_once(kind, make, error, cause, tmp_path):
    """Before the application has called anything; so is one that is unplugged, where it can be reached again."""
    device, failed = make(), []

    def hang(player):
        player.play(TEXTURE)
        player.record(tmp_path / "failed.au")
        player.finger(0.0, 0.08, 0.4)
        end = time.monotonic() + 60.0
        while player._error is None and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.1)
        failed.extend(device.played)
        player.state()

    with pytest.raises(error, match=cause), hr.Player(kind, device) as player:
        hang(player)
    assert np.concatenate(failed).any()
    assert not failed[-1].any()
    recording = hr.Recording.load(tmp_path / "failed.au")
    assert recording.flags[-1] == hr.Flag.STOPPED
    assert not recording.drive[-1].any()


def test_a_watchdog_that_nobody_has_set_runs_in_real_time(monkeypatch):
    """It begins with the first word of a finger, ends as it lifts, and begins again; without one nothing stops."""
    monkeypatch.setattr(hapticrender.player, "TIMEOUT", 0.5)
    with hr.Player() as player:
        player.play(TONE)
        for _ in range(2):
            time.sleep(0.8)
            player.finger(0.0)
            player.finger(np.nan)
        player.finger(0.0)
        end = time.monotonic() + 20.0
        while player._error is None and time.monotonic() < end:
            time.sleep(0.02)
        with pytest.raises(hr.WatchdogTimeout, match=r"for 0\.5 s, the time of its watchdog"):
            player.state()


def test_the_watchdog_runs_in_real_time_and_waits_for_calls_that_take_long():
    with hr.Player(watchdog=0.2) as player:
        player.play(TONE)
        with player._lock, player._busy():
            time.sleep(0.5)
        player.sleep(0.1)
        end = time.monotonic() + 20.0
        while not player._loop.timed_out and time.monotonic() < end:
            time.sleep(0.02)
        assert player._loop.timed_out
        while player._error is None and time.monotonic() < end:  # until it is at rest, and seen
            time.sleep(0.02)
        with pytest.raises(hr.WatchdogTimeout):
            player.finger(0.0)


def test_a_driver_that_does_not_return_ends_in_an_error_that_says_so(monkeypatch):
    """Zero drive cannot be played through it: the user is told; a driver that returns is closed without a word."""
    monkeypatch.setattr(hapticrender.player, "TIMEOUT", 0.5)
    stuck = threading.Event()

    class Hanging(Lying):
        def _play(self, drive):
            if self.count > 1000:
                stuck.wait(60.0)
            return super()._play(drive)

    def play(player):
        player.play(TONE)
        with pytest.raises(hr.HapticError, match="has played no sample"):
            player.sleep(10.0)

    trouble = r"has not returned for 0\.5 s: zero drive could not be played"
    with pytest.raises(hr.DriverError, match=trouble), hr.Player(driver=Hanging(1e9, "")) as player:
        play(player)
    stuck.set()


class Lengthy:
    """A tone of one's own; once it is live it takes `share` s to compute for a second of it, or waits for `ready`."""

    spatial, live, share = False, False, 0.0

    def __init__(self, ready=None):
        self.ready = ready

    def bands(self, rate):
        return Bands.none(spatial=False)

    def waveform(self, time, position):
        if self.live:
            threading.Event().wait(self.share * (np.max(time) - np.min(time)))
            if self.ready is not None:
                self.ready.wait(60.0)
        return 5e-6 * np.sin(2 * np.pi * 100.0 * time)


@pytest.mark.parametrize(("share", "hangs"), [(0.3, False), (4.0, False), (0.0, True)])
def test_a_texture_that_is_slower_than_the_clock_is_named_and_the_device_closed(share, hangs, monkeypatch):
    """Whether it is slow or hangs in the end, the driver plays every block; one that takes 0.3 s a second is well."""
    monkeypatch.setattr(hapticrender.player, "TIMEOUT", 0.5)
    ready, closed = threading.Event(), []

    class Closing(Lying):
        def __exit__(self, *error):
            closed.append(abs(self.played[-1]).max())
            return super().__exit__(*error)

    texture = Lengthy(ready if hangs else None)
    named = pytest.raises(hr.HapticError, match="Lengthy: 0.25 s of it took .* times as long as it lasts")
    with nullcontext() if share == 0.3 else named as caught, hr.Player(driver=Closing(1e9, "")) as player:
        player.play(texture)
        texture.share, texture.live = share, True
        player.sleep(2.0 if share == 0.3 else 3.5)
        player.state()
    ready.set()
    assert closed == [0.0]
    assert caught is None or type(caught.value) is hr.HapticError  # and not the driver's
