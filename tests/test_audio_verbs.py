"""A sound card named by a text, through JACK as in `test_audio_jack`: identified, rendered, validated, played, lost.

While the card is open every period waits for all clients (freewheel), and until Python waits for what is sensed in it,
or for `PACE`: what is lost does not depend on what else the machine does, and no time is lost by waiting.
"""

import re
import signal
import subprocess
import sys
import time

import jack_ring
import numpy as np
import pytest
from jack_ring import BLOCK, CLIENT, METRES, NOISE, RATE, ROUND_TRIP
from waves import phasor

import hapticrender as hr
from hapticrender.cli import main
from hapticrender.drivers.audio import AudioDriver
from hapticrender.process_signals import Terminated
from hapticrender.protocols import Flag

pytestmark = pytest.mark.skipif(bool(jack_ring.missing()), reason=jack_ring.missing())

PACE = 8  # ms a period: Python is late with a block after 16 ms
TEXT = f"audio:{CLIENT}"
TONE = hr.Grating(frequency=60.0, amplitude=10e-6)
CARD = f"""[profile]
kind = "vt-plate"
name = "ring"
[device]
rate = {RATE}
[calibration]
drive_per_full_scale = {jack_ring.AMPERES}
sensed_per_full_scale = {METRES}
delay = {ROUND_TRIP}.0
"""


@pytest.fixture
def paced(connected, monkeypatch):
    """Function that runs a system as the second client, in freewheel from when a card is open until it closes."""
    opened, waited, started, closed = (getattr(AudioDriver, name) for name in ("_open", "_wait_for", "start", "close"))

    def open_and_wait(driver):
        opened(driver)
        device.say("free 1")
        device.say(f"pace {PACE}")

    def wait_and_go_on(driver, number):
        if driver._queue.blocks <= number:
            device.say("next")
        waited(driver, number)

    def start_sooner(driver, entry):
        device.say("pace 2")  # a compiled callback is never late: every period waits for it
        started(driver, entry)

    def close_in_time(driver):
        if driver.active:
            device.say("pace 0")
            device.say("free 0")
        closed(driver)

    monkeypatch.setattr(AudioDriver, "_open", open_and_wait)
    monkeypatch.setattr(AudioDriver, "_wait_for", wait_and_go_on)
    monkeypatch.setattr(AudioDriver, "start", start_sooner)
    monkeypatch.setattr(AudioDriver, "close", close_in_time)

    def run(system, **options):
        nonlocal device
        device = connected(system, length=round(60 * RATE), **options)
        return device

    device = None
    return run


@pytest.fixture
def plate(paced):
    """The plate without a finger as the second client."""
    return paced(jack_ring.plate(load=0.0), noise=NOISE / METRES)


@pytest.fixture
def scene(tmp_path):
    """File of a scene on the card's profile."""
    (tmp_path / "card.toml").write_text(CARD)
    path = tmp_path / "tone.toml"
    path.write_text(hr.Scene(device=str(tmp_path / "card.toml"), texture=TONE, duration=1.2).to_toml())
    return path


def assert_accurate(recording):
    """1 % of the texture's amplitude, from 0.5 s on, 0.15 s after a block was lost, and before it fades out.

    By the sensors: their noise is 0.1 % of it over 12 000 samples, 15 periods.
    """
    whole = np.flatnonzero(recording.flags & Flag.OVERRUN == 0)
    whole = whole[(whole > 0.5 * RATE) & (whole < len(recording) - 0.1 * RATE)]
    end = max(np.split(whole, np.flatnonzero(np.diff(whole) > 1) + 1), key=len)[round(0.15 * RATE) :][-24_000:]
    assert len(end) >= 12_000
    end = end[: len(end) // 800 * 800]
    wanted = phasor(recording.reference[end], 60.0, RATE)
    assert abs(wanted) == pytest.approx(10e-6, rel=1e-3)
    assert abs(phasor(recording.motion[end, 0], 60.0, RATE) - wanted) < 0.01 * 10e-6


@pytest.mark.usefixtures("empty_pictures")
def test_a_card_is_identified_and_a_scene_on_its_profile_rendered_validated_and_played(plate, scene, tmp_path, capsys):
    """By the command line; the profile has the delay of the card alone, to which `render` adds what `play` queues.

    The callback of live play adds nothing.
    """
    found = tmp_path / "found.toml"
    assert main(["identify", "--driver", TEXT, "--scene", str(scene), "--out", str(found)]) == 0
    assert "driver.delay" not in capsys.readouterr().out
    profile = hr.DeviceProfile.load(found)
    assert profile.device["delay"] == ROUND_TRIP
    assert profile.uncertainty["delay"] < 0.1
    scene.write_text(hr.Scene(device=str(found), texture=TONE, duration=1.2).to_toml())
    assert main(["render", str(scene), "--driver", TEXT, "--out", str(tmp_path / "out")]) == 0
    rendered = hr.Recording.load(tmp_path / "out" / "recording.au")
    assert rendered.header.delay == ROUND_TRIP + 3 * BLOCK
    assert_accurate(rendered)
    # a block that a busy machine loses all the same may miss the tolerance
    assert 0 in (main(["validate", str(scene), "--driver", TEXT]) for _ in range(4))
    capsys.readouterr()
    assert main(["play", str(scene), "--driver", TEXT, "--seconds", "1.2", "--out", str(tmp_path / "live")]) == 0
    assert re.search(r"60\.0 Hz  target .* achieved .*\n1\.\d s, no flags, 0 lost", capsys.readouterr().out)
    [path] = (tmp_path / "live").glob("*/recording.au")
    live = hr.Recording.load(path)
    assert live.header.delay == ROUND_TRIP
    assert_accurate(live)


class Late(AudioDriver):
    """A card whose program sleeps, once, through some periods."""

    periods, at = 0, 0

    def _play(self, drive):
        self.at -= 1
        if self.at == 0:
            time.sleep(self.periods * PACE / 1e3)
        return super()._play(drive)


PROBED = 225  # blocks: 0.3 s, after which the loop begins


@pytest.mark.parametrize(("at", "periods"), [(PROBED + 400, 28), (PROBED + 400, 90)])
def test_python_may_be_late(plate, tmp_path, at, periods):
    """By up to 32 blocks all that was sensed meanwhile arrives, so that nothing seems to jump; beyond it is lost.

    What is not played in time is zeros, and flagged in either case.
    """
    driver = Late(CLIENT, delay=ROUND_TRIP, sensed_per_full_scale=METRES)
    driver.at, driver.periods = at, periods
    recording = hr.render(hr.Scene(texture=TONE, duration=1.5), driver=driver)
    assert (recording.flags & Flag.OVERRUN).any()
    noisy = plate.recorded(tmp_path / "record")[1].astype(float) * METRES
    sensed = recording.sensed
    [begin] = np.flatnonzero((noisy[:, 0] == sensed[0, 0]) & (noisy[:, 1] == sensed[0, 1]))
    assert np.array_equal(noisy[begin : begin + len(sensed)], sensed) == (periods < 32)
    assert_accurate(recording)


def hang(player):
    while player._error is None:
        time.sleep(0.01)
    player.sleep(0.1)


ENDS = {  # what ends an application, and how
    "exception": (lambda player: 1 // 0, ZeroDivisionError),
    "SIGTERM": (lambda player: signal.raise_signal(signal.SIGTERM), Terminated),
    "hangs": (hang, hr.WatchdogTimeout),
}


@pytest.mark.parametrize("end", ENDS)
def test_what_ends_an_application_leaves_a_card_at_zero_drive_within_10_ms(paced, tmp_path, end):
    """As the other side of the card records it, from the cause on: a block, and the two that the card holds.

    Python, which a busy machine may keep for 60 ms, has 8 ms a period; the watchdog of 0.3 s needs none.
    """
    cause, error = ENDS[end]
    device, patience = paced(jack_ring.straight()), 0.3 if end == "hangs" else np.inf
    began = 0

    def live(player):
        nonlocal began
        player.play(TONE)
        player.record(tmp_path / "end.au")
        player.sleep(0.3)
        device.say(f"pace {PACE}")
        player.sleep(0.02)
        began = device.say("count").periods * BLOCK
        if end == "hangs":
            device.say("pace 2")
        cause(player)

    with pytest.raises(error), hr.Player("vt-plate", AudioDriver(CLIENT), watchdog=patience) as player:
        live(player)
    began += round(patience * RATE) if end == "hangs" else 0
    played, recording = device.recorded(tmp_path / "record")[0], hr.Recording.load(tmp_path / "end.au")
    assert abs(played[began - 480 : began - BLOCK]).max() > 0.005
    assert not played[began + 480 + 3 * BLOCK :].any()
    assert recording.flags[-1] & Flag.STOPPED
    assert not recording.drive[-1].any()


LOSE = """
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import jack_ring
import numpy as np

import hapticrender as hr
import hapticrender.player
from hapticrender.drivers import portaudio

hapticrender.player.TIMEOUT = portaudio.CLOSE_TIMEOUT = 1.0
folder, program, how = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
with ExitStack() as stack:
    server = stack.enter_context(ExitStack())
    process = server.enter_context(jack_ring.server(folder))
    device = jack_ring.device(program, folder, jack_ring.straight(), length=round(60 * jack_ring.RATE))
    device = stack.enter_context(device)
    try:
        with hr.Player("vt-plate", f"audio:{jack_ring.CLIENT}") as player:
            player.play(hr.Grating(frequency=60.0, amplitude=10e-6))
            player.record(folder / "lost.au")
            player.sleep(0.5)
            if how == "ends":
                server.close()
            else:
                process.send_signal(signal.SIGSTOP)
                time.sleep(0.2)
                halted = device.say("count").periods
            player.sleep(30.0)
    finally:
        if how == "halts":
            process.send_signal(signal.SIGCONT)
            end = time.monotonic() + 10.0
            while device.say("count").periods < halted + 100 and time.monotonic() < end:
                time.sleep(0.01)
            played = device.recorded(folder / "played")[0]
            print(halted, device.say("count").periods, *np.flatnonzero(abs(played).max(axis=1))[[0, -1]], flush=True)
"""


LOST = {
    "ends": r"DeviceLost: audio:plate: the card stopped after \d+ samples: is it still connected",
    "halts": r"DeviceTimeout: the device has played no sample for 1",
}


@pytest.mark.parametrize("how", LOST)
def test_a_card_that_goes_away_under_a_player_is_a_lost_device(jack_program, tmp_path, how):
    """The error is the first one, with that of closing as a note; the recording ends in zero drive and a flag.

    A server that goes on after all plays zeros: the program's last blocks are those from before.
    """
    command = [sys.executable, "-c", LOSE, tmp_path, jack_program, how]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert re.search(f"^hapticrender.errors.{LOST[how]}", done.stderr, re.M), done.stderr
    assert "and while closing: audio:plate: close: PortAudio did not return within 1 s" in done.stderr
    recording = hr.Recording.load(tmp_path / "lost.au")
    assert recording.flags[-1] == Flag.STOPPED
    assert not recording.drive[-1].any()
    assert recording.drive[-round(0.1 * RATE) :].any()
    if how == "halts":
        halted, periods, first, last = map(int, done.stdout.split())
        assert periods >= halted + 100
        assert first < last < (halted + 2) * BLOCK
