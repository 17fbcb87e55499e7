"""Ctrl-C, SIGTERM and SIGHUP, alone and several at once, in every thread: the drive is zero and the device closed."""

import signal
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
from live_devices import RIDGES, TONE
from test_faults import Logged, scene

import hapticrender as hr
from hapticrender.analysis.two_touches import TouchWatch
from hapticrender.latency import measure_latency
from hapticrender.plants.plate import PlateParameters
from hapticrender.process_signals import CLOSING, DEFAULT, GUARDED, WAITING, Terminated, _end, stopped_by_signal

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no such signals on this system")
MADE = []


class Struck(Logged):
    """A plate in blocks of 25 samples: `first` come in the 20th block with drive, `again` in each later one.

    And as it closes.
    """

    def __init__(self, first, again, path):
        super().__init__(path, block=25, told=100, delay=100)
        self.first, self.again, self.driven = first, again, 0

    def play(self, drive):
        sensed, before = super().play(drive), self.driven
        self.driven += int(drive.any())
        if before >= 20:
            strike(self.again)
        elif self.driven == 20:
            strike(self.first)
        return sensed

    def __exit__(self, *error):
        strike(self.again)
        super().__exit__(*error)


def strike(numbers):
    """All at once, to this thread."""
    signal.pthread_sigmask(signal.SIG_BLOCK, DEFAULT)
    for number in numbers:
        signal.raise_signal(number)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, DEFAULT)


def struck(text):
    """Make a plate of names of signals, such as "INT+TERM,INT,path"."""
    *names, path = text.split(",")
    numbers = ([getattr(signal, f"SIG{name}") for name in each.split("+") if name] for each in names)
    MADE.append(Struck(*numbers, path))
    return MADE[-1]


@pytest.fixture
def defaults():
    """Signals as a program starts with them, also where whoever runs the tests ignores some; nothing is left of it."""
    before = {each: signal.signal(each, handler) for each, handler in DEFAULT.items()}
    yield
    assert [signal.getsignal(each) for each in DEFAULT] == list(DEFAULT.values())
    assert (GUARDED, CLOSING, WAITING) == ([], [], [])
    for each, handler in before.items():
        signal.signal(each, handler)


def live(driver, **options):
    with hr.Player(driver=driver, **options) as player:
        player.play(TONE)
        player.sleep(60.0)


HOW = {
    "render": lambda driver: hr.render(scene(duration=60.0), driver=driver),
    "player": partial(live, paced=False),
    "paced": live,
    "identify": lambda driver: hr.identify(driver, PlateParameters()),
    "latency": measure_latency,
}


@pytest.mark.parametrize(
    ("how", "struck"), [("player", "INT,INT"), *((how, "INT+TERM+HUP,INT+TERM+HUP") for how in HOW)]
)
def test_signals_wait_until_a_device_is_at_rest(how, struck, defaults):
    """Every block at rest and the end of the driver are struck; as many zeros are played as it takes."""
    with pytest.raises((KeyboardInterrupt, Terminated)):
        HOW[how](f"test_signals:struck:{struck},")
    plate = sys.modules["test_signals"].MADE.pop()  # as the library has imported it
    drive = np.concatenate(plate.played)
    assert plate.driven >= 20
    assert not drive[-25 if how == "identify" else -100 :].any()
    assert not plate.is_open


def test_a_plate_that_the_application_has_opened_is_left_at_zero_drive_by_identify(defaults):
    with struck("TERM,,") as plate, pytest.raises(Terminated):
        hr.identify(plate, PlateParameters())
    assert plate.driven == 20
    assert not plate.played[-1].any()


@pytest.mark.parametrize(("verb", "name", "status"), [("identify", "TERM", 143), ("latency", "HUP", 129)])
def test_what_measures_is_ended_by_a_signal_at_zero_drive(verb, name, status, tmp_path):
    """With the exit status that every verb has, also where the signal comes again while it closes the driver."""
    log = tmp_path / "played"
    command = [sys.executable, "-m", "hapticrender", verb, "--driver", f"test_signals:struck:{name},{name},{log}"]
    default = partial(signal.signal, getattr(signal, f"SIG{name}"), signal.SIG_DFL)
    ended = run(command, preexec_fn=default)
    assert ended.returncode == status, ended.stderr
    drive = np.fromfile(log).reshape(-1, 25, 2)
    assert drive[:-1].any()
    assert not drive[-1].any()


def run(command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, **options)


IN_THREADS = """
import os, signal, sys, threading, time
import hapticrender as hr
from test_faults import logged, scene
from test_signals import live
signal.signal(signal.SIGINT, signal.default_int_handler)
paths = sys.argv[1:]
for work in (lambda: hr.render(scene(duration=600.0), driver=logged(paths[0])), lambda: live(logged(paths[1]))):
    threading.Thread(target=work, daemon=True).start()
while not all(os.path.exists(path) and os.path.getsize(path) > 80_000 for path in paths):
    time.sleep(0.02)
signal.raise_signal(signal.SIGINT)
"""


def test_runs_in_daemon_threads_end_at_zero_drive_with_the_program(tmp_path):
    """As docs/live.md says: by Ctrl-C, as by any exception that the application raises."""
    logs = [tmp_path / "render", tmp_path / "player"]
    ended = run([sys.executable, "-c", IN_THREADS, *logs])
    assert ended.returncode == -signal.SIGINT, ended.stderr
    for log in logs:
        drive = np.fromfile(log).reshape(-1, 25, 2)
        assert drive[-30:-2].any()
        assert not drive[-1].any()


def test_a_player_may_be_closed_by_another_thread(defaults):
    """It cannot restore the handlers of signals; those do so themselves when one comes, or the next guard does."""
    errors = []
    for restore in (True, False):
        with hr.Player(paced=False) as player:
            player.play(TONE)

            def close(player=player):
                try:
                    player.__exit__(None, None, None)
                except BaseException as error:
                    errors.append(error)

            thread = threading.Thread(target=close)
            thread.start()
            thread.join(60.0)
        assert errors == []
        assert signal.getsignal(signal.SIGINT) is signal.getsignal(signal.SIGTERM) is _end
        if restore:
            with stopped_by_signal():
                pass
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with stopped_by_signal():
        pass


def test_an_application_that_catches_ctrl_c_gets_the_next_one(defaults):
    """Also within its handler, where a player that is opened there is ended by it."""
    with hr.Player(paced=False) as player:
        player.play(TONE)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            player.sleep(0.05)
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        with hr.Player(paced=False), pytest.raises(Terminated):
            signal.raise_signal(signal.SIGTERM)


def test_a_live_run_of_the_command_line_is_stopped_cleanly(tmp_path):
    """The journal is whole, and the page about it is written."""
    scene = hr.Scene(texture=RIDGES, finger=hr.Finger.swiping(2.0, speed=0.1), duration=100.0, name="live")
    (tmp_path / "live.toml").write_text(scene.to_toml())
    (tmp_path / "matplotlib.py").write_text("raise ImportError")  # no picture is drawn
    run = subprocess.Popen(
        [sys.executable, "-m", "hapticrender", "play", "live.toml", "--out", "out"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # also where who runs the tests ignores it
    )
    line = run.stdout.readline()
    assert "Hz  target" in line
    run.send_signal(signal.SIGINT)
    printed, complaint = run.communicate(timeout=120)
    assert run.returncode == 130
    assert "page: " in printed
    assert "interrupted" in complaint
    recording = hr.Recording.load(tmp_path / "out" / "live" / "recording.au")
    assert len(recording) > 0.2 * recording.rate
    assert (tmp_path / "out" / "index.html").exists()


def test_a_signal_while_samples_are_recorded_loses_none(defaults, monkeypatch, tmp_path):
    """They are looked through and recorded 20 ms at once."""
    update, calls = TouchWatch.update, []

    def struck(watch, signals):
        calls.append(len(signals["flags"]))
        strike([signal.SIGINT] if len(calls) == 3 else [])
        return update(watch, signals)

    monkeypatch.setattr(TouchWatch, "update", struck)
    driver = Logged(block=25, told=100, delay=100)
    with pytest.raises(KeyboardInterrupt):
        hr.render(scene(duration=1.0), driver=driver, journal=tmp_path / "run.au")
    assert len(hr.Recording.load(tmp_path / "run.au")) == sum(calls) + 1  # zero drive
    assert calls == [100, 100, 100]
