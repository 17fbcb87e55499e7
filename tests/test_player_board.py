"""Live play on a board: a process behind a pseudo-terminal, with a plate in it."""

from contextlib import ExitStack

import numpy as np
import pytest
from board import RATE, SLOW, BoardProcess, SlowClock, build_board, sensed_error
from live_devices import TONE
from test_board_live import wait_for
from test_firmware_screen import FINGER, RIDGES, SCREEN
from waves import Own, phasor

import hapticrender as hr
from hapticrender.drivers.serial import SerialDriver
from hapticrender.recordings.recording import Recording

WHITE = hr.Recorded(
    samples=np.random.default_rng(5).standard_normal(20_000), rate=5000.0, gain=10e-6, passband=(30.0, 300.0), speed=0.1
)
WANDERING = Own(lambda time, place: 5e-6 * np.sin(2 * np.pi * (60.0 * time + np.nan_to_num(place) / 2e-3)))  # m


def slide(player, clock, seconds, start, speed):
    """Slide over the plate by the board's clock (m, m/s), under 0.4 N."""
    began = clock.monotonic()
    while (slid := clock.monotonic() - began) < seconds:
        player.finger(start + speed * slid, speed, 0.4)
        player.sleep(0.01)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("board"), hr.prepare(hr.Scene(texture=TONE, duration=1.0)))


def error_bound(recording):
    """Bound of `sensed_error` over the last 0.3 s: 5 %, beside the noise of 0.7 um rms in the middle."""
    noise = 0.71e-6 * np.sqrt(480 / 2500) / np.std(recording.reference[-1500:])  # within 20-500 Hz
    return np.hypot(1.13 * noise, 0.05)  # 288 numbers: 13 % are three sigmas of its rms


def test_a_board_plays_live(program, tmp_path):
    """Textures, gain and finger go over the line; what the board measures comes back, and a recording of it."""
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        with hr.Player(driver=driver) as player:
            player.play(TONE)
            player.record(tmp_path / "board.au")
            player.sleep(0.3)
            [tone] = player.state().bands
            player.play(hr.Grating(frequency=150.0, amplitude=4e-6))
            player.gain = 0.5
            player.sleep(0.5)
            [other] = player.state().bands
            recording = player.end_recording()
            player.gain = 1.0
            player.play(WHITE + 0.5 * hr.Chirp(start=50.0, stop=90.0, duration=1.0, amplitude=4e-6))
            player.record(tmp_path / "both.au")
            slide(player, driver.client.clock, 0.5, -0.03, 0.1)
            [white] = player.state().bands
            assert player.state().flags == hr.Flag(0)
            both = player.end_recording()
            player.play(hr.Grating(wavelength=1e-3, amplitude=4e-6))
            slide(player, driver.client.clock, 0.4, 0.03, -0.1)
            [ridges] = player.state().bands
            player.finger(-0.01, 0.0, 0.4)
            player.sleep(0.5)
            [resting] = player.state().bands
            player.record(tmp_path / "end.au")
    end = Recording.load(tmp_path / "end.au")
    assert len(end) > 0
    assert not (end.flags & hr.Flag.STOPPED).any()  # it ended well
    assert ridges.frequency == pytest.approx(100.0, rel=0.1)  # a correction of 2 mm is 8 % of a quarter of a second
    assert ridges.target == pytest.approx(4e-6, rel=1e-3)
    assert (resting.frequency, resting.target) == (0.0, 0.0)
    assert (tone.frequency, other.frequency) == (100.0, 150.0)
    assert (tone.target, other.target) == pytest.approx((5e-6, 2e-6), rel=1e-3)
    assert max(tone.error, other.error) < 0.2  # telemetry is of an instant, with 1 um of noise at each end
    # noise of 0.7 um rms in the middle; what is left of the error is below 5 % of the target
    assert white.frequency == 0.0
    assert white.error * white.target < np.hypot(0.75e-6, 0.05 * white.target)
    assert sensed_error(both, len(both) - 1500) < error_bound(both)
    wanted, moved = (phasor(each[-1500:], 150.0) for each in (recording.reference, recording.motion[:, 0]))
    # 1 um of noise at two ends: 0.7 um sqrt(2/1500) = 0.026 um in each part, three times; the phase needs no fit
    assert max(abs((moved - wanted).real), abs((moved - wanted).imag)) < 0.08e-6


def test_a_board_plays_a_texture_in_time_and_place_at_once(program, tmp_path):
    """Faded into, followed by another, and flagged nowhere; the board's own position is up to a round trip late."""
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        with hr.Player(driver=driver) as player:
            player.play(TONE)
            player.sleep(0.2)
            player.play(WANDERING)
            player.record(tmp_path / "wandering.au")
            slide(player, driver.client.clock, 0.6, -0.03, 0.05)
            assert player.state().flags == hr.Flag(0)
            found = player.end_recording()
            player.play(TONE)
            player.sleep(0.15)
            [tone] = player.state().bands
    assert tone.target == pytest.approx(5e-6, rel=1e-3)
    last = slice(-1500, None)
    turns = 60.0 * np.arange(len(found)) / found.rate + found.read("position") / 2e-3
    waves = np.exp(2j * np.pi * turns[last])
    size = 2 * np.mean(found.reference[last] * waves.conj())  # it began at some phase, and the clocks are off by some
    assert abs(size) == pytest.approx(5e-6, rel=0.01)
    # the host looks at the line once a millisecond: half of it at 0.05 m/s
    off = found.reference[last] - (size * waves).real
    assert np.std(off) < 5e-6 / np.sqrt(2) * 2 * np.pi * 0.05 * 0.5e-3 / 2e-3
    assert sensed_error(found, len(found) - 1500) < error_bound(found)


def test_a_board_that_is_found_again_is_recorded_again(program, tmp_path):
    """Its clock begins anew: rows of the new run follow those of the old one, and a flag says that some are lost."""
    with ExitStack() as boards:
        board = boards.enter_context(BoardProcess(program, tmp_path, *SLOW))
        driver = SerialDriver(str(board.port), clock=SlowClock(), reconnect=20.0)
        with hr.Player(driver=driver) as player:
            player.play(TONE)
            player.record(tmp_path / "board.au")
            player.sleep(0.3)
            before = player.time
            board.kill()
            boards.enter_context(BoardProcess(program, tmp_path, *SLOW))
            player.sleep(0.5)
            assert round((player.time - before) * driver.rate) >= 2500  # 0.5 s of samples
            assert player.state().flags & hr.Flag.OVERRUN
            recording = player.end_recording()
    parts = [phasor(each[-1500:], 100.0) for each in (recording.reference, recording.motion[:, 0])]
    assert abs(parts[1] - parts[0]) < 0.05 * 5e-6  # the new run's carriers begin anew, and so does the texture


def unplug(board, player, path):
    player.play(TONE)
    player.record(path)
    player.sleep(0.15)
    board.kill()
    player.sleep(10.0)


def test_a_board_that_is_pulled_is_lost_with_port_operation_and_bytes(program, tmp_path):
    """Without `reconnect`; its recording ends with a sample of zero drive and a stop."""
    lost = pytest.raises(hr.DeviceLost, match=r"tty: (line|listen): .* \(\d+ bytes sent, \d+ received, 0 bad frames\)")
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        with lost, hr.Player(driver=driver) as player:
            unplug(board, player, tmp_path / "board.au")
    recording = Recording.load(tmp_path / "board.au")
    assert recording.drive[:-1].any()
    assert recording.flags[-1] == hr.Flag.STOPPED
    assert not recording.drive[-1].any()


def test_a_sensor_that_dies_on_the_board_stops_live_play(program, tmp_path):
    """Half a second after its reset; its supervisor's word for it is the error of the next call."""
    with BoardProcess(program, tmp_path, *SLOW, "--gain", "0,1,2500") as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        driver.probe = False
        dead = pytest.raises(hr.DeviceFault, match="tty: play: the board stopped: a sensor (repeats|is suddenly)")
        with dead, hr.Player(driver=driver) as player:
            player.play(TONE)
            player.record(tmp_path / "dead.au")
            player.sleep(10.0)
        assert [line[2] for line in board.log() if line[1] == "drives"][-1] == "0"
    recording = Recording.load(tmp_path / "dead.au")
    assert recording.drive.any()
    assert (recording.flags[:-1] & hr.Flag.STOPPED).any()  # of the board's fade; the last sample is the player's own
    assert not recording.drive[-1].any()


def test_the_board_stops_when_the_application_is_silent(program, tmp_path):
    """The player's threads go on, and so do the signs of life; only the calls of the application are missing."""
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        with hr.Player(driver=driver, watchdog=0.1) as player:
            player.play(TONE)
            player.record(tmp_path / "silent.au")
            player.sleep(0.05)
            assert player.state().flags == hr.Flag(0)
            driver.client.clock.sleep(0.3)
            with pytest.raises(hr.WatchdogTimeout, match="no method of the player was called"):
                player.state()
        assert [line[2:] for line in board.log() if line[1] == "state"][-2:] == [["1", "0"], ["0", "7"]]
    flags = Recording.load(tmp_path / "silent.au").flags
    assert (flags[:-1] & hr.Flag.STOPPED).any()  # of the board's fade; the last sample is the player's own


def test_a_screen_plays_live(tmp_path):
    """Ridges, then a tone, under a finger of the application; at the end the carrier is at zero."""
    program = build_board(tmp_path / "screen", hr.prepare(SCREEN))
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        tone, place = hr.Grating(frequency=80.0, amplitude=5e-6), -0.01
        with hr.Player("electroadhesion", driver=driver, finger=FINGER, profile={"rate": RATE}) as player:
            for texture, hertz, speed in ((RIDGES, 50.0, 0.05), (tone, 80.0, -0.05)):
                player.play(texture)
                start, began = driver.client.clock.monotonic(), place
                while (slid := driver.client.clock.monotonic() - start) < 0.3:
                    place = began + speed * slid
                    player.finger(place, speed, 0.4)
                    player.sleep(0.01)
                [state] = player.state().bands
                # v/F = 0.64 m/(N s)
                assert state.target == pytest.approx(2 * np.pi * hertz * 5e-6 / 0.64 / np.sqrt(2), rel=0.05)
                assert np.isnan(state.achieved)
                player.finger(place, 0.0, 0.4)  # it rests while the next one is prepared
                player.sleep(0.1)
            # a host that pauses leaves the finger behind, which is then approached faster than it slides
            assert player.state().flags & ~hr.Flag.SATURATED == hr.Flag(0)
        wait_for(lambda: [line[2] for line in board.log() if line[1] == "drives"][-1] == "0")
