"""Faults injected into a running loop: each ends in zero drive within 10 ms, or a block, and in an error that names it.

Sensors and coils that change during a run are in test_supervisor.py; what the start-up probe refuses, too.  Here:
the application, the process, the device that goes away, and what the probe had not been tried on.
"""

import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from other_plate import OtherPlate
from strangers_plate import StrangersPlate
from synthetic import make_bands
from waves import Own

import hapticrender as hr
from hapticrender.process_signals import DEFAULT, _end, stopped_by_signal

RATE = 5000.0


class Logged(OtherPlate):
    """A plate that keeps what it was played, in a file as well; ``__exit__`` leaves it as it is: zero is the loop's."""

    probe = False

    def __init__(self, path="", **wiring):
        super().__init__(seed=1, **wiring)
        self.log = open(path, "wb", buffering=0) if path else None  # noqa: SIM115 (closed when the process ends)

    def play(self, drive):
        if self.log:
            self.log.write(np.ascontiguousarray(drive, float).tobytes())
            time.sleep(self.block / self.rate / 10)
        return super().play(drive)


def logged(path):
    """A plate in blocks of 25 samples."""
    return Logged(path, block=25, told=25, delay=25)


def failing(error):
    """A texture whose application fails after half a second."""

    def waveform(at, position):
        if at.size <= 100 and at[-1] > 0.5:  # a piece of 20 ms; not while it is designed for
            raise error
        return 20e-6 * np.sin(2 * np.pi * 72.0 * at)

    return Own(waveform)


def stopped(recording):
    """Drive of a recording, which has to end with a sample of zero drive that says so, and with no other one."""
    assert list(np.flatnonzero(recording.flags & hr.Flag.STOPPED)) == [len(recording) - 1]
    assert not recording.drive[-1].any()
    return recording.drive[:-1]


def assert_kept(path, plate):
    """All that was played is in the journal, and ends with a block of zeros."""
    played, recording = np.concatenate(plate.played), hr.Recording.load(path)
    np.testing.assert_array_equal(stopped(recording), played[: -plate.block])  # but for the zeros at the end
    assert played[: -plate.block].any()
    assert not played[-plate.block :].any()
    return recording


@pytest.mark.parametrize("block", [1, 25])
@pytest.mark.parametrize("error", [RuntimeError("the app broke"), KeyboardInterrupt()])
def test_an_exception_in_the_application_ends_in_zero_drive(block, error):
    """The block in hand has been played; the next is zero, as many as it takes to come through."""
    plate = Logged(block=block, told=block, delay=block)
    with pytest.raises(type(error)):
        hr.render(hr.Scene(texture=failing(error), duration=1.0), driver=plate)
    drive = np.concatenate(plate.played)
    before = round(0.5 * RATE)
    assert np.any(drive[before - 200 : before])
    last = np.flatnonzero(drive.any(axis=1))[-1]
    assert last < before + 2 * block + 14  # the waveform is asked for up to 13 samples ahead
    assert not drive[last + 1 :].any()
    assert len(drive) > last + 1


def scene(frequency=72.0, amplitude=20e-6, duration=1.0, **fields):
    return hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=amplitude), duration=duration, **fields)


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals on this system")
def test_a_signal_to_the_process_ends_in_zero_drive(tmp_path):
    """The command line on a device of one's own: what it was played last is zero, and the journal can be read."""
    log, out = tmp_path / "played", tmp_path / "out"
    (tmp_path / "long.toml").write_text(scene(duration=600.0).to_toml())
    command = [sys.executable, "-m", "hapticrender", "render", tmp_path / "long.toml", "--out", out]
    command += ["--driver", f"test_faults:logged:{log}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    default = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # also where whoever runs the tests ignores it
    with subprocess.Popen(command, **pipes, preexec_fn=default) as child:
        end = time.monotonic() + 120
        while not (log.exists() and log.stat().st_size > 16 * RATE):  # a second of both coils
            assert child.poll() is None, child.communicate()
            assert time.monotonic() < end
            time.sleep(0.02)
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=120)
    assert child.returncode == 130, errors
    assert "hapticrender: interrupted; what is written so far can be read" in errors
    drive = np.fromfile(log).reshape(-1, 25, 2)
    assert drive[:-1].any()
    assert not drive[-1].any()
    assert drive[-3:-1].any()  # and no sooner: it played until the signal came
    recording = hr.Recording.load(out / "recording.au")
    assert hr.Scene.from_toml(out / "scene.toml") == hr.Scene.from_toml(tmp_path / "long.toml")
    assert len(recording) > 0.5 * RATE
    np.testing.assert_array_equal(stopped(recording), drive.reshape(-1, 2)[: len(recording) - 1])


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal on this system")
def test_a_signal_that_is_ignored_or_handled_stays_so():
    """`nohup` ignores SIGHUP before the program starts; an application may handle it."""
    for own in (signal.SIG_IGN, lambda *given: None):
        given = (signal.default_int_handler, signal.SIG_DFL, own)
        before = {each: signal.signal(each, handler) for each, handler in zip(DEFAULT, given, strict=True)}
        try:
            with stopped_by_signal(), stopped_by_signal():
                assert signal.getsignal(signal.SIGTERM) is _end
                assert signal.getsignal(signal.SIGHUP) is own
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
            assert signal.getsignal(signal.SIGHUP) is own
        finally:
            for each, handler in before.items():
                signal.signal(each, handler)


def test_a_signal_while_the_journal_is_written_loses_nothing(tmp_path):
    """Ctrl-C while the reference of a tone is computed for the journal; signals are left as they were before."""
    before = [signal.getsignal(each) for each in DEFAULT]
    came = []

    def waveform(at, position):
        if at[0] > 0.2 and not came:
            came.append(True)
            raise KeyboardInterrupt
        return 20e-6 * np.cos(2 * np.pi * 72.0 * at)

    plate, texture = logged(""), Own(waveform, bands=make_bands(72.0, 20e-6))
    with pytest.raises(KeyboardInterrupt):
        hr.render(hr.Scene(texture=texture, duration=2.0), driver=plate, journal=tmp_path / "run.au")
    assert [signal.getsignal(each) for each in DEFAULT] == before
    assert _end not in before
    assert_kept(tmp_path / "run.au", plate)


def test_an_exception_in_the_progress_of_a_run_ends_in_zero_drive(tmp_path):
    """What the application does while it is told how far a run is; the journal holds all that was played."""

    def progress(done, total):
        if done >= 0.5:
            raise RuntimeError("the app broke")

    plate = logged("")
    with pytest.raises(RuntimeError, match="the app broke"):
        hr.render(scene(), driver=plate, journal=tmp_path / "run.au", progress=progress)
    assert len(assert_kept(tmp_path / "run.au", plate)) > 0.5 * RATE


def test_the_loop_itself_ends_with_zero_drive():
    plate = Logged(block=4, told=8, delay=8)
    hr.render(scene(), driver=plate)
    assert not np.any(plate.played[-2:])
    assert np.any(plate.played[-3])


def lost(sample, sensed):
    """Unplugged after half a second."""
    if sample >= 0.5 * RATE:
        raise hr.DeviceLost("bench: play: unplugged")
    return sensed


def test_a_device_that_is_unplugged_raises_device_lost(tmp_path):
    """It cannot be played zeros; the error says so, and what happened until then is kept."""
    plate = Logged(spoil=lost)
    with pytest.raises(hr.DeviceLost, match="bench: play: unplugged") as gone:
        hr.render(scene(), driver=plate, journal=tmp_path / "run.au")
    assert any("while the drive was set to zero" in note for note in gone.value.__notes__)
    assert not plate.is_open
    assert len(stopped(hr.Recording.load(tmp_path / "run.au"))) == 0.5 * RATE
    assert not plate.played[-1].any()  # that was tried


def test_a_gain_of_1_6_during_a_run_goes_on():
    """The loop holds what it senses; drive and motion stay small.  A gain of 3 stops: `test_supervisor`."""

    def grown(sample, sensed):
        return sensed._replace(sensed=1.6 * sensed.sensed) if sample >= 0.5 * RATE else sensed

    plate = Logged(spoil=grown)
    with pytest.warns(hr.PlateMismatch):
        recording = hr.render(scene(duration=4.0), driver=plate)
    assert abs(np.concatenate(plate.played)[round(0.5 * RATE) :]).max() < recording.header.drive_limit
    settled = recording.read("sensed", round(1.5 * RATE)) / 1.6
    assert np.ptp(settled, axis=0).max() / 2 < 25e-6


class Held(StrangersPlate):
    """A driver that repeats each value of its sensors, `hold` samples long, and one for ever from `dead_from` on."""

    hold, count, held, dead_from = 1, 0, None, np.inf

    def play(self, drive):
        sensed = super().play(drive)
        shown = sensed.sensed.copy()
        for row in shown:
            if self.count % self.hold == 0 and self.count <= self.dead_from:
                self.held = row.copy()
            self.count += 1
            row[:] = self.held
        return sensed._replace(sensed=shown)


@pytest.mark.parametrize(
    ("rate", "hold", "noise", "block", "stated"),
    [
        (20e3, 1, 0.0, 1, 1),
        (5e3, 5, 1e-6, 1, 1),
        (5e3, 9, 1e-6, 1, 1),
        (5e3, 10, 1e-6, 1, 5),
        (5e3, 10, 1e-6, 25, 25),
        (48e3, 96, 1e-6, 64, 64),
    ],
)
def test_converters_that_repeat_their_values_are_not_frozen(rate, hold, noise, block, stated):
    """Values of 0.12 um without noise at 20 kHz, and values held over 1 to 2 ms, under a finger.

    Sample by sample those of 2 ms have to be stated as the delay that they amount to, half of it.
    """
    touching = {"finger": (5e-3, 2.0, 2000.0), "position": 0.01, "load": 0.5, "contact": 1.0}
    plate = Held(rate=rate, noise=noise, block=block, told=stated, **touching)
    plate.hold = hold
    hr.render(scene(20.0, 10e-6, 0.4), driver=plate)


@pytest.mark.parametrize(("rate", "hold"), [(20e3, 1), (5e3, 1), (5e3, 5)])
def test_a_sensor_that_freezes_is_found_within_10_ms_even_so(rate, hold):
    plate = Held(rate=rate, noise=1e-6)
    plate.hold, plate.dead_from = hold, round(0.2 * rate)
    with pytest.raises(hr.DeviceFault, match="one value repeats") as stopped:
        hr.render(scene(72.0, 20e-6, 0.4), driver=plate)
    assert 0.0 < stopped.value.time - 0.2 <= 10e-3
