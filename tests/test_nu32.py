"""The authors' boards: tables of what is sent and what comes back; an entry that is not used is a failure."""

import re

import numpy as np
import pytest
from synthetic import make_bands

from hapticrender.drivers.nu32 import FAST_CLOCK, FREQUENCIES, MOST, NU32Board
from hapticrender.errors import DeviceLost, DeviceNotFound, DeviceTimeout, DriverError, ProtocolError

FRESH = [(b"z\n", b"CONNECTED\n\r"), (b"z\n", b"z\r\n")]
AWAKE = [(b"z\n", b"z\r\n")]
REST = [(b"z\n", b"z\r\n")]
CLOSED = [(b"f\n", b"f\r\nclosed loop turned on\n\r")]
TONE = [(b"a\n", b"a\r\n"), (b"0.010000\n", b""), (b"2\n", b"amp\t0.010000\tfrequency\t47.000000\r\n")]


class Wire:
    """A line that expects what a table says, entry after entry, and answers so."""

    def __init__(self, table):
        self._table, self._waiting, self.closed = list(table), b"", False

    def __call__(self, port, timeout):
        return self

    def write(self, data):
        assert self._table, f"{data} is sent, but no entry is left"
        expected, reply = self._table.pop(0)
        if isinstance(reply, Exception):
            raise reply
        assert data == expected
        self._waiting += reply

    def readline(self):
        line, end, self._waiting = self._waiting.partition(b"\n")
        return line + end

    def close(self):
        assert not self._table, f"{self._table} are unused"
        self.closed = True


def play(*tables):
    wire = Wire([entry for table in tables for entry in table])
    return wire, NU32Board("COM7", connect=wire)


def tone(hertz=47.0, amplitude=10e-6):
    return make_bands(hertz, amplitude)


@pytest.mark.parametrize("start", [FRESH, AWAKE])
def test_a_tone_is_played_and_left(start):
    asked = [(b"t\n", b"t\r\n-0.001500\t0.002500\n\r"), (b"p\n", b"p\r\n0.0099\t0.0101\n\r0.1\t-0.2\t0.3\t-0.4\n\r")]
    wire, board = play(start, CLOSED, TONE, asked, REST, REST)
    with board:
        board.set_bands(tone())
        board.start()
        assert board.sensed() == pytest.approx((-1.5e-6, 2.5e-6))
        found = board.telemetry()
        board.stop()
    assert found.amplitude == pytest.approx((9.9e-6, 10.1e-6))
    assert found.phase + found.command == (0.1, -0.2, 0.3, -0.4)
    assert wire.closed


def test_a_loop_that_was_closed_is_closed_again():
    wire, board = play(AWAKE, [(b"f\n", b"f\r\nclosed loop turned off\n\r")], CLOSED, TONE, REST)
    with board:
        board.set_bands(tone(47.1))
        board.start()
    assert wire.closed


@pytest.mark.parametrize(
    ("table", "error", "match"),
    [
        ([(b"z\n", b"hello\r\n")], ProtocolError, "COM7: z: received 'hello', must be z or CONNECTED"),
        ([(b"z\n", b"z")], DeviceTimeout, "COM7: z: no whole line in 1 s, only b'z'"),
        ([(b"z\n", OSError("gone"))], DeviceLost, "COM7: z: gone"),
    ],
)
def test_a_board_that_does_not_open(table, error, match):
    _, board = play(table)
    with pytest.raises(error, match=re.escape(match)):
        board.open()


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ([(b"f\n", b"x\r\n")], "f: received 'x', must be f"),
        ([(b"f\n", b"f\r\nloop\n\r")], "f: received 'loop', must be closed loop turned on"),
        ([*CLOSED, *TONE[:2], (b"2\n", b"amp\t0.01\r\n")], "a: received 'amp\\t0.01', must be amp, frequency"),
        ([*CLOSED, *TONE[:2], (b"2\n", b"amp\t0.010000\tfrequency\t72.000000\r\n")], "must be 0.010000 mm at 47 Hz"),
        ([*CLOSED, *TONE[:2], (b"2\n", b"amp\t0.000100\tfrequency\t47.000000\r\n")], "must be 0.010000 mm at 47 Hz"),
        ([*CLOSED, *TONE[:2], (b"2\n", b"amp\tx\tfrequency\t47.000000\r\n")], "must be 2 numbers"),
    ],
)
def test_a_reply_that_is_wrong(table, match):
    wire, board = play(AWAKE, table, REST)
    board.set_bands(tone())
    with board, pytest.raises(ProtocolError, match=re.escape(match)):
        board.start()
    assert wire.closed


@pytest.mark.parametrize("index", range(8))
def test_bounds_of_a_tone(index):
    _, board = play()
    board.set_bands(tone(FREQUENCIES[index] * 1.0049, MOST[index]))
    with pytest.raises(ValueError, match=r"frequency = .* Hz: must be one of 20, 31, 47, 72, 111, 170, 261, 400"):
        board.set_bands(tone(FREQUENCIES[index] * 1.0051, MOST[index]))
    with pytest.raises(ValueError, match=r"amplitude = .* m: must be <= "):
        board.set_bands(tone(FREQUENCIES[index], np.nextafter(MOST[index], 1.0)))


def test_states_in_which_nothing_can_be_sent():
    _, board = play(AWAKE, REST)
    with pytest.raises(DriverError, match="COM7: z: it is not open"):
        board.stop()
    with board, pytest.raises(DriverError, match="COM7: start: nothing is set"):
        board.start()
    with pytest.raises(DeviceNotFound, match="/dev/no-such-board: open: "):
        NU32Board("/dev/no-such-board").open()


def test_the_clock_of_the_board_is_fast_as_its_timer_says():
    assert FAST_CLOCK == pytest.approx(4009.8 / 4000, abs=0.05 / 4000)
