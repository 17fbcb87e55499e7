"""Live play on a board: a process behind a pseudo-terminal, with a plate in it."""

from contextlib import ExitStack

import numpy as np
import pytest
from board import SLOW, BoardProcess, SlowClock, build_board
from live_devices import TONE

import hapticrender as hr
from hapticrender.drivers.serial import SerialDriver


def test_a_board_plays_live(tmp_path):
    """Textures, gain and finger go over the line; what the board measures comes back, and a recording of it."""
    folder = tmp_path / "board"
    program = build_board(folder, hr.prepare(hr.Scene(texture=TONE, duration=1.0)))
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), clock=SlowClock())
        with hr.Player(driver=driver) as player:
            player.play(TONE)
            player.record(tmp_path / "board.au")
            player.sleep(0.8)
            [tone] = player.state().bands
            player.play(hr.Grating(frequency=150.0, amplitude=4e-6))
            player.gain = 0.5
            player.sleep(0.8)
            [other] = player.state().bands
            with pytest.raises(ValueError, match="Chirp is a waveform"):
                player.play(hr.Chirp(start=50.0, stop=100.0, duration=1.0, amplitude=1e-6))
            recording = player.end_recording()
    assert (tone.frequency, other.frequency) == (100.0, 150.0)
    assert (tone.target, other.target) == pytest.approx((5e-6, 2e-6), rel=1e-3)
    assert max(tone.error, other.error) < 0.2  # telemetry is of an instant, with 1 um of noise at each end
    last = slice(-1500, None)
    time = np.arange(len(recording))[last] / 5000.0
    waves = np.stack([np.cos(2 * np.pi * 150.0 * time), np.sin(2 * np.pi * 150.0 * time), np.ones(1500)], axis=1)
    parts = [
        np.linalg.lstsq(waves, each[last], rcond=None)[0] for each in (recording.reference, recording.motion[:, 0])
    ]
    # 1 um of noise at two ends: 0.7 um sqrt(2/1500) = 0.026 um in each part, three times; the phase needs no fit
    assert abs(parts[0] - parts[1])[:2].max() < 0.08e-6


def test_a_board_that_is_found_again_is_heard_again(tmp_path):
    """Its clock begins anew: rows of the new run follow those of the old one, and a flag says that some are lost."""
    program = build_board(tmp_path / "board", hr.prepare(hr.Scene(texture=TONE, duration=1.0)))
    with ExitStack() as boards:
        board = boards.enter_context(BoardProcess(program, tmp_path, *SLOW))
        driver = SerialDriver(str(board.port), clock=SlowClock(), reconnect=20.0)
        with hr.Player(driver=driver) as player:
            player.play(TONE)
            player.record(tmp_path / "board.au")
            player.sleep(0.5)
            before = player.time
            board.kill()
            boards.enter_context(BoardProcess(program, tmp_path, *SLOW))
            player.sleep(0.6)
            assert player.time >= before + 0.6
            assert player.state().flags & hr.Flag.OVERRUN
            recording = player.end_recording()
    phase = 2 * np.pi * 100.0 * np.arange(1500) / 5000.0
    parts = [2 * np.mean(each[-1500:] * np.exp(-1j * phase)) for each in (recording.reference, recording.motion[:, 0])]
    assert abs(parts[1] - parts[0]) < 0.05 * 5e-6  # the new run's carriers begin anew, and so does the texture
