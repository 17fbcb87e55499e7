"""Live play on a device that calls back, on one without a clock of its own, or with another one."""

import threading
import time
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from live_devices import RIDGES, TONE, Blind, Calling, Lying
from test_player_textures import Own

import hapticrender as hr
from hapticrender import live_threads
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
