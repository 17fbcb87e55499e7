"""Boards in real time: a process behind a pseudo-terminal, five times as slow, and an emulated Cortex-M4."""

import re
import subprocess
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from board import FINGER, RATE, SCENE, SlowClock, slow_board, slow_client, tones
from synthetic import make_bands
from test_firmware_m4 import NOISE, QEMU, built

import hapticrender as hr
from hapticrender.drivers.protocol import State
from hapticrender.drivers.serial import BoardClient, SerialDriver
from hapticrender.errors import DriverError


def wait_for(done, seconds=30.0):
    """Wait until it is done; a test that hangs fails."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_replugged_board_goes_on(tmp_path):
    with slow_board(tmp_path) as first, slow_client(first, reconnect=20.0) as client:
        client.set_bands(tones(47.0))
        client.gain = 0.25
        client.start()
        first.kill()
        with slow_board(tmp_path) as second:
            wait_for(lambda: client.reconnections == 1 and client.telemetry().state == State.PLAYING)
            assert [line[1:] for line in second.log() if line[1] == "gain"] == [["gain", "0.25"]]
            client.stop()


def test_what_was_recorded_is_complete_and_of_the_board(tmp_path):
    scene = replace(SCENE, duration=0.2)
    with slow_board(tmp_path) as board:
        driver = SerialDriver(str(board.port), finger=FINGER, clock=SlowClock())
        recording = hr.render(scene, driver=driver)
        time.sleep(0.05)
        log = board.log()
    assert (driver.rate, driver.drive_channels, driver.sensed_channels, driver.delay) == (RATE, 2, 2, 1)
    assert len(recording) == 1000
    assert recording.header.motion_source == "sensors"
    commits = [line for line in log if line[1] == "commit"]
    assert [[float(each) for each in line[3:]] for line in commits] == [pytest.approx([0, 1000, 0, 1e-5, 0], rel=1e-6)]
    states = [["3", "0"], ["0", "1"], ["1", "0"], ["0", "1"]]  # the probe, at rest, the run, at rest
    assert [line[2:] for line in log if line[1] == "state"] == states
    with pytest.raises(DriverError, match="it has been closed"):
        driver.open()


def test_two_threads_can_set_a_board(tmp_path):
    with slow_board(tmp_path) as board, slow_client(board) as client:
        client.set_bands(tones(47.0))
        client.start()
        threads = [
            threading.Thread(target=lambda hertz=hertz: [client.set_bands(tones(hertz)) for _ in range(10)])
            for hertz in (50.0, 60.0)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        commits = [float(line[3]) for line in board.log() if line[1] == "commit"]
        assert sorted(commits) == [47.0] + 10 * [50.0] + 10 * [60.0]


def test_the_board_on_a_cortex_m4_speaks_to_the_host(exports, tmp_path):
    """The same client as for any board, over the emulated machine's serial line: a pseudo-terminal."""
    board = built(tmp_path, exports.rendering("tones"), "board-m4.elf")
    machine = [QEMU, "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "pty"]
    process = subprocess.Popen([*machine, "-kernel", board], stdout=subprocess.PIPE, text=True)
    try:
        port = re.search(r"/dev/\S+", process.stdout.readline())[0]
        with BoardClient(port, timeout=20.0) as client:  # the emulator looks for its host once a second
            envelope = np.array([10e-6, 4e-6])
            client.set_bands(make_bands([70.0, 120.0], envelope))
            start = client.start()
            while client.telemetry().sample < start + RATE:
                client.clock.sleep(0.05)
            bands = client.telemetry().bands
            client.stop()
        for band, wanted in zip(bands, envelope, strict=True):
            assert abs(band.target - wanted) < 1e-6 * wanted
            assert abs(band.measured - wanted) < 0.02 * wanted + 3 * NOISE
    finally:
        process.kill()
        process.communicate()
