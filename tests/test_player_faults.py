"""What fails in live play (device, disk, application, process): the drive is zero, and no loss goes unmarked."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from live_devices import RIDGES, TONE, Calling, Lying

import hapticrender as hr
from hapticrender.recordings.recording import Recording


def go_on(player):
    player.play(TONE)
    for _ in range(200):
        player.sleep(0.05)


def fail(player):
    player.play(TONE)
    player.sleep(0.2)
    raise ZeroDivisionError


def test_the_watchdog_silences_a_player_that_nobody_calls_and_the_next_call_wakes_it():
    with hr.Player(paced=False, watchdog=0.3) as player:
        player.play(TONE)
        for _ in range(10):
            player.sleep(0.1)
        assert player.state().bands[0].target == pytest.approx(5e-6, rel=0.01)
        player._called -= 10.0  # as if the application had hung
        player._service()
        player._advance(0.2)
        player._called -= 10.0
        player._service()
        assert abs(player._loop.entry.log(player._loop.entry.samples - 100)["reference"]).max() < 1e-8
        for _ in range(5):
            player.sleep(0.1)
        assert player.state().bands[0].target == pytest.approx(5e-6, rel=0.01)


def test_the_watchdog_acts_while_the_application_hangs():
    """In real time: nobody calls, the texture fades out; the next call wakes it."""
    with hr.Player(watchdog=0.2) as player:
        player.play(TONE)
        player.sleep(0.3)
        assert player._loop.entry.current_gain == pytest.approx(1.0, rel=1e-6)
        end = time.monotonic() + 20.0
        while player._loop.entry.current_gain > 1e-3 and time.monotonic() < end:
            time.sleep(0.05)
        assert player._loop.entry.current_gain < 1e-3
        player.sleep(0.4)
        assert player._loop.entry.current_gain > 0.9


def test_a_sensor_that_sticks_stops_the_drive_and_is_told_at_the_next_call(tmp_path):
    driver = Lying(0.5, "stuck")
    with hr.Player(driver=driver) as player:
        player.play(RIDGES)
        player.record(tmp_path / "fault.au")
        with pytest.raises(hr.DeviceFault, match="sensor 1: one value repeats"):
            go_on(player)
    drive = np.concatenate(driver.played)
    assert abs(drive[-10:]).max() == 0.0
    stopped = np.flatnonzero(Recording.load(tmp_path / "fault.au").flags & hr.Flag.STOPPED)
    assert stopped[0] / 5000.0 < 0.55


def test_a_device_that_is_unplugged_is_told_at_the_next_call():
    driver = Lying(0.3, "unplugged")
    with pytest.raises(hr.DeviceLost, match="no answer"), hr.Player(driver=driver) as player:
        go_on(player)
    assert abs(driver.played[-1]).max() == 0.0


def test_a_driver_that_fails_is_left_at_zero_drive_at_once():
    """Before the application has called anything."""
    driver = Lying(0.3, "cut")

    def hang(player):
        player.play(TONE)
        end = time.monotonic() + 20.0
        while player._error is None and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.1)
        assert abs(driver.played[-1]).max() == 0.0
        assert abs(np.concatenate(driver.played)).max() > 0.0

    with pytest.raises(hr.ProtocolError, match="sensed"), hr.Player(driver=driver) as player:
        hang(player)


def test_a_disk_that_fails_ends_the_recording_and_not_the_play(tmp_path, monkeypatch):
    with hr.Player(paced=False) as player:
        player.play(TONE)
        with pytest.raises(FileNotFoundError):
            player.record(tmp_path / "nowhere" / "a.au")
        player.record(tmp_path / "a.au")
        player.sleep(0.5)

        def full(**signals):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(player._recorder._recorder, "append", full)
        player.sleep(0.5)
        assert player.state().bands[0].error < 0.02
        with pytest.raises(OSError, match="No space left"):
            player.end_recording()


def test_samples_that_were_not_kept_are_marked(tmp_path):
    """The service thread held up for longer than the log: no numbers and a flag, and the clock goes on."""
    with hr.Player(paced=False) as player:
        player.play(TONE)
        player.record(tmp_path / "gap.au")
        player.sleep(0.5)
        for _ in range(15_000):
            player._block()
        player._loop.fill()
        player.sleep(0.1)
        state, recording = player.state(), player.end_recording()
    lost = recording.flags & hr.Flag.OVERRUN > 0
    assert len(recording) == 18_000
    assert 4_000 < np.count_nonzero(lost) == state.lost
    assert np.isnan(recording.motion[lost]).all()
    assert np.isfinite(recording.motion[~lost]).all()


def test_an_error_of_the_application_leaves_zero_drive():
    driver = Lying(1e9, "")
    with pytest.raises(ZeroDivisionError), hr.Player(driver=driver) as player:
        fail(player)
    assert abs(np.concatenate(driver.played)).max() > 0.0
    assert abs(driver.played[-1]).max() == 0.0


def test_a_device_that_does_not_start_is_left_closed():
    """And may be started again."""
    device = Calling()
    start, closed = device.start, []
    device.__class__ = type("Failing", (Calling,), {"__exit__": lambda self, *exc: closed.append(self)})
    device.start = lambda entry: (_ for _ in ()).throw(hr.DriverError("no stream"))
    with hr.Player(driver=device) as player:
        with pytest.raises(hr.DriverError, match="no stream"):
            player.play(TONE)
        assert closed == [device]
        with pytest.raises(ValueError, match="nothing plays yet"):
            player.state()
        device.start = start
        player.play(TONE)
        player.sleep(0.2)
        assert player.time >= 0.2


SCENE = """
name = "live"
duration = 100.0
[texture]
kind = "grating"
wavelength = 1e-3
amplitude = 5e-6
[finger]
motion = "swiping"
frequency = 2.0
speed = 0.1
[device]
kind = "vt-plate"
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_live_run_of_the_command_line_is_stopped_cleanly(tmp_path, number):
    """By Ctrl-C, or by whoever ends processes: the journal is whole, and the page about it is written."""
    (tmp_path / "live.toml").write_text(SCENE)
    command = [sys.executable, "-m", "hapticrender", "play", "live.toml", "--out", "out"]
    run = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.getcwd()},
    )
    line = run.stdout.readline()
    assert "Hz  target" in line
    run.send_signal(number)
    printed, complaint = run.communicate(timeout=120)
    assert run.returncode == (130 if number == signal.SIGINT else 143)
    assert "page: " in printed
    if number == signal.SIGINT:
        assert "interrupted" in complaint
    recording = Recording.load(tmp_path / "out" / "live" / "recording.au")
    assert len(recording) > 0.2 * recording.rate
    assert (tmp_path / "out" / "index.html").exists()
