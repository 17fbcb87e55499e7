"""Boards and hosts that fail, and a line that damages, loses and repeats bytes; time is the board's own."""

import struct
from contextlib import nullcontext

import numpy as np
import pytest
from board import RATE, Faults, SteppedBoard, driven, tones
from synthetic import make_bands

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Cause, Kind, Reason
from hapticrender.drivers.serial import Line
from hapticrender.errors import DeviceFault, DeviceLost, DeviceTimeout, DriverError, ProtocolError
from hapticrender.protocols import Flag


@pytest.fixture
def stepped(tmp_path):
    with SteppedBoard(tmp_path) as board:
        yield board


def assert_stopped(board, client, *causes):
    """For one of the causes, with a flag, and nothing is driven any more."""
    found = client._line.telemetry
    assert found.cause in causes
    assert found.flags & Flag.STOPPED
    board.assert_at_rest()


def test_a_board_that_stays_away_is_lost(stepped):
    client = stepped.started(seconds=0.1, reconnect=1.0)
    stepped.pulled = np.inf
    start = stepped.time
    with pytest.raises(DeviceLost, match=r"stepped: listen: no valid frame for 0.5 s \(\d+ bytes sent"):
        stepped.run(client, 10.0)
    # silence for 0.5 s, 1 s of attempts, the last of which may take 1 s and 0.05 s
    assert 1.5 <= stepped.time - start <= 2.56
    with pytest.raises(DeviceLost, match="no valid frame"):
        client.gain = 0.5


def test_an_app_that_hangs_ends_in_zero_drive(stepped):
    """No word for 100 ms of the board's clock: the host's process is stopped, so nothing else can say so."""
    client = stepped.started(seconds=0.5, stream=1)
    last = stepped.sample
    stepped.sleep(0.3)
    (silent,) = [int(line[0]) for line in stepped.board.log() if line[1:3] == ["state", "0"]]
    assert 0.080 * RATE <= silent - last <= 0.100 * RATE
    assert stepped.board.log()[-1][1:] == ["drives", "0"]
    assert int(stepped.board.log()[-1][0]) <= last + 0.100 * RATE
    with pytest.raises(DeviceLost, match="the board received no valid frame for 80 ms, and stopped"):
        stepped.run(client, 0.1)
    assert client._line.streamed[-1].rows[-1][-1] & Flag.STOPPED


def test_a_finger_that_is_not_heard_of_is_lifted(stepped):
    client = stepped.client().open()
    client.set_bands(tones(47.0))
    client.start(telemetry=0.001)
    client.finger(0.0, 0.1)
    stepped.run(client, 0.1)
    assert client.telemetry().position == pytest.approx(0.1 * 0.05, abs=0.1 * 0.002)  # followed for 50 ms
    stepped.run(client, 0.08)
    assert client.telemetry().position == pytest.approx(0.1 * 0.05, abs=0.1 * 0.002)
    stepped.run(client, 0.04)
    assert np.isnan(client.telemetry().position)
    client.finger(np.nan)
    stepped.run(client, 0.02)
    client.finger(0.03)
    stepped.run(client, 0.02)
    assert client.telemetry().position == pytest.approx(0.03, rel=1e-6)  # a touch is no glide


@pytest.mark.parametrize(
    ("limits", "cause", "named"),
    [
        ((0.5, 0.05, 0.1), Cause.LIMIT, "the mean square of the drive is above its limit"),
        ((0.5, 0.5, 0.1, 20e-6), Cause.BEYOND, r"a sensor shows more than \[limits\] displacement"),
    ],
)
def test_limits_stop_the_board(stepped, limits, cause, named):
    client = stepped.started(tones(20.0, amplitude=30e-6), seconds=0.5)
    client.limits(*limits)
    with pytest.raises(DeviceFault, match=f"the board stopped: {named}"):
        stepped.run(client, 1.0)
    assert_stopped(stepped, client, cause)


def test_a_press_that_moves_the_plate_too_far_stops_the_board(stepped):
    """20 N at the end of the glass: 20/45.3e3 (1 + 2 * 2) = 2.2 mm there."""
    client = stepped.started()
    client.finger(0.055, 0.0, 20.0)
    with pytest.raises(DeviceFault, match="the board stopped: the surface moved too far"):
        stepped.run(client, 0.2)
    assert_stopped(stepped, client, Cause.OVERMOTION)


def test_sensors_out_of_their_range_stop_an_identification(tmp_path):
    """Noise of 1 um is 10 mm at a gain of 1e4; the range is 1 mm."""
    with SteppedBoard(tmp_path, "--gain", "1e4,1") as board:
        client = board.client().open()
        with pytest.raises(DeviceFault, match="the board stopped: a sensor was invalid for 10 ms"):
            client.identify([Line(0, 60.0, 0.05)], 1.0)
        assert_stopped(board, client, Cause.SENSOR)


CREST = 2515  # sample at which the tone below is at its largest: a gain that changes there is a jump


@pytest.mark.parametrize(
    ("gains", "start", "causes"),
    [
        ("0,1", 0, {Cause.FROZEN, Cause.INCONSISTENT}),
        ("1,-1", 0, {Cause.SENSOR_GAIN, Cause.ACTUATOR_GAIN}),
        ("-1,-1", 0, {Cause.SENSOR_GAIN, Cause.ACTUATOR_GAIN}),
        ("0,1", CREST, {Cause.FROZEN}),
        ("nan,1", CREST, {Cause.INVALID}),
        *((gains, CREST, {Cause.SENSOR_GAIN}) for gains in ("-1,-1", "1,-1", "3,3", "0.1,0.1")),
    ],
)
def test_a_sensor_that_lies_stops_the_board(tmp_path, gains, start, causes):
    """From sample `start` on; one that fails while it plays is named, and stopped within 10 ms."""
    with SteppedBoard(tmp_path, "--gain", f"{gains},{start}") as board:
        client = board.started(tones(72.0, amplitude=30e-6))
        with pytest.raises(DeviceFault, match="stepped: play: the board stopped: .*: check "):
            board.run(client, 2.0)
        assert_stopped(board, client, *causes)
        assert start == 0 or driven(board.board.log(), start + round(0.01 * RATE), board.sample) == []


def test_garbage_is_no_sign_of_life(stepped, rng):
    client = stepped.started(seconds=0.2)
    last = stepped.sample
    for _ in range(20):
        stepped.inject(bytes(rng.integers(0, 256, 200, dtype="u1")))
        stepped.sleep(0.01)
    assert driven(stepped.board.log(), last + int(0.1 * RATE), stepped.sample) == []
    with pytest.raises(DeviceLost, match="the board received no valid frame for 80 ms, and stopped"):
        stepped.run(client, 0.1)


@pytest.mark.parametrize(("late", "stops"), [(0.07, False), (0.09, True)])
def test_a_word_that_waited_for_long_is_no_sign_of_life(stepped, late, stops):
    """A line that fills up: words come every 15 ms, each 5 ms later than the one before, until they are `late` old."""
    client = stepped.started(seconds=0.2)
    start, waiting = stepped.time, []
    while stepped.time < start + 0.6:
        arrival = stepped.time + min(late, (stepped.time - start) / 2)
        waiting.append((arrival, client._line.due(stepped.time)))
        stepped.sleep(0.01)
        while waiting and waiting[0][0] <= stepped.time:
            stepped.inject(waiting.pop(0)[1])
    assert bool(driven(stepped.board.log(), stepped.sample - 100, stepped.sample)) != stops


def test_damage_that_the_crc_does_not_show_does_nothing(stepped):
    """Commands with a number changed and the CRC-16 made anew: what one in 65 536 damaged frames amounts to."""
    client = stepped.started(seconds=0.2)
    before, refused = stepped.board.log(), client.telemetry().refused
    link = client._line
    words = [
        (Kind.SETPOINT, protocol.pack(Kind.SETPOINT, 0, 47.0, 0.0, 0.0, 5e-6, 0.0)),
        (Kind.GAIN, protocol.pack(Kind.GAIN, 0.5)),
        (Kind.FINGER, protocol.pack(Kind.FINGER, 0, 0, 0, 0.01, 0.0, 0.4)),
        (Kind.STOP, b""),
    ]
    for index, (kind, payload) in enumerate(words):
        (frame,) = protocol.Reader().feed(
            protocol.command(link.capabilities.session, kind, (link._sequence + 100 + index) & 0xFFFF, payload)
        )
        changed = bytes([frame.payload[0] ^ 1]) + frame.payload[1:]
        stepped.inject(protocol.encode(frame._replace(payload=changed)))
        stepped.run(client, 0.02)
    client._line._foreign = 0
    stepped.run(client, 0.1)
    assert client.telemetry().refused == refused + len(words)
    assert client.telemetry().commits == 1
    assert np.isnan(client.telemetry().position)
    assert [line for line in stepped.board.log()[len(before) :] if line[1] != "drives"] == []


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", Reason.LENGTH),
        (bytes([protocol.VERSION]), Reason.LENGTH),
        (struct.pack("<BIB", protocol.VERSION, 7, 0), Reason.LENGTH),
        (struct.pack("<BI", protocol.VERSION, 0), Reason.VALUE),
        (struct.pack("<BI", protocol.VERSION + 1, 7), Reason.VERSION),
        (bytes([protocol.VERSION + 1]), Reason.VERSION),
    ],
)
def test_a_greeting_that_does_not_hold_is_refused_with_its_reason(stepped, payload, reason):
    """Of another version by that alone; the session that there is goes on."""
    client = stepped.client().open()
    version = pytest.raises(ProtocolError, match="the board refuses version")
    with version if reason == Reason.VERSION else nullcontext():
        assert client._line.request(Kind.HELLO, payload).refused == reason
    client.set_bands(tones(47.0))


@pytest.mark.parametrize(
    ("finger", "there"),
    [
        ((0.15, 10.0, 0.0), True),
        *((each, False) for each in ((1e30, 0.0, 0.4), (0.151, 0.0, 0.4), (0.0, 0.0, -0.1), (0.0, 0.0, np.nan))),
        *(((0.0, speed, 0.4), False) for speed in (np.inf, -10.1, np.nan)),
    ],
)
def test_a_finger_that_is_impossible_is_taken_for_lifted(stepped, finger, there):
    """Keep-alives all the same: the board plays on."""
    client = stepped.client().open()
    client.set_bands(tones(47.0))
    client.start(telemetry=0.001)
    client.finger(0.01)
    stepped.run(client, 0.02)
    assert client.telemetry().position == pytest.approx(0.01)
    client.finger(*finger)
    stepped.run(client, 0.15)
    assert np.isfinite(client.telemetry().position) == there
    assert client.telemetry().state == protocol.State.PLAYING


def test_a_commit_acts_only_on_what_it_says(stepped):
    """A set-point that never came leaves the one from before in its place: the digest shows it."""
    client = stepped.client().open()
    client.set_bands(tones(47.0, 72.0))
    payloads = [protocol.pack(Kind.SETPOINT, index, 100.0 + 20 * index, 0.0, 0.0, 5e-6, 0.0) for index in (0, 1)]
    client._line.send(Kind.SETPOINT, payloads[1])
    with pytest.raises(DriverError, match="COMMIT: refused by the board: digest"):
        client._line.command(Kind.COMMIT, 2, protocol.digest(payloads))
    assert [line[3:9:5] for line in stepped.board.log() if line[1] == "commit"] == [["47", "72"]]


def test_doubled_and_recorded_commands_do_nothing(stepped):
    """A whole session, played back to the board in the same session and in the next."""
    recorded = []
    stepped.damage = lambda data: recorded.append(data) or data

    def play(client):
        client.set_bands(tones(47.0))
        client.start()
        stepped.run(client, 0.2)

    with stepped.client() as client:
        play(client)
        client.stop()
        stepped.run(client, 0.1)
        stepped.damage = lambda data: data
        before = len(stepped.board.log())
        replay(stepped, recorded)
        stepped.run(client, 0.1)
        assert len(stepped.board.log()) == before
    with stepped.client() as client:
        play(client)
        before = stepped.board.log()
        replay(stepped, recorded)
        # greeted anew, it stopped, and refused all the rest
        after = [line[1:] for line in stepped.board.log()[len(before) :] if line[1] != "drives"]
        assert after == [["state", "0", str(int(Cause.SESSION))]]
        assert driven(stepped.board.log(), stepped.sample - 1, stepped.sample) == []
        with pytest.raises(DeviceLost, match="session: the board has another session"):
            stepped.run(client, 1.0)


def replay(board, recorded):
    for data in recorded:
        board.inject(data)
        board.sleep(0.005)


class Session:
    """Minutes with a board: textures change, cables are pulled, boards reset, garbage comes; what was asked for."""

    def __init__(self, board, seed):
        self.board, self.rng = board, np.random.default_rng(seed)
        self.client = board.client(reconnect=10.0)
        self.asked, self.gains, self.silences = [], [1.0], []
        self.recorded = []

    def change(self):
        n = self.rng.integers(1, 5)
        frequencies = np.sort(self.rng.choice(np.arange(30.0, 300.0, 15.0), n, replace=False))
        phase, size, angle = self.rng.uniform(0, 6, n), self.rng.uniform(1e-6, 5e-6, n), self.rng.uniform(0, 6, n)
        bands = make_bands(frequencies, size * np.exp(1j * angle), phase=phase)
        columns = frequencies, 0 * frequencies, bands.phase / (2 * np.pi), bands.envelope.real, bands.envelope.imag
        self.asked.append(np.ravel(np.transpose(columns)).astype("f4"))
        self.client.set_bands(bands)

    def change_gain(self):
        self.gains.append(float(np.float32(self.rng.uniform(0.1, 1.0))))
        self.client.gain = self.gains[-1]

    def flood(self):
        garbage = bytes(self.rng.integers(0, 256, 3000, dtype="u1"))
        self.board.inject(garbage if self.rng.random() < 0.5 else b"".join(self.recorded[-100:]))

    def pull(self):
        duration = self.rng.uniform(0.02, 0.8)
        start = self.board.sample
        self.silences.append((len(self.board.records), start, start + duration * RATE))
        self.board.pulled = self.board.time + duration
        self.board.run(self.client, duration)

    def play(self, seconds):
        client, board, rng = self.client, self.board, self.rng
        with client:
            self.change()
            client.start()
            changes = [self.change, self.change_gain, self.flood, self.pull, board.reset]
            while board.monotonic() < seconds:
                client.finger(rng.uniform(-0.02, 0.02), rng.uniform(-0.1, 0.1), 0.4)
                board.run(client, rng.uniform(0.05, 0.5))
                attempt(rng.choice(changes, p=[0.5, 0.25, 0.15, 0.05, 0.05]))


def attempt(change):
    """A change that the line swallows is asked for again by the app; here the next one will do."""
    try:
        change()
    except (DeviceTimeout, DeviceLost):
        pass


@pytest.mark.slow
def test_a_bad_line_never_plays_what_was_not_asked_for(tmp_path, rng, monkeypatch):
    """60 s of the board's time at a share of 1 % of faulty bytes."""
    seconds = 60
    monkeypatch.setattr("secrets.randbelow", lambda most: int(rng.integers(most)))
    faults = Faults(18, 0.01)
    with SteppedBoard(tmp_path) as board:
        session = Session(board, 18)
        board.damage = lambda data: session.recorded.append(data) or faults(data)
        session.play(seconds)
    logs = board.records
    commits = [np.array(line[3:], "f4") for log in logs for line in log if line[1] == "commit"]
    assert len(commits) > seconds / 2
    at = 0
    for commit in commits:  # in the order in which they were asked for, none made of two
        at = next(index for index in range(at, len(session.asked)) if np.array_equal(session.asked[index], commit))
    gains = [float(np.float32(line[2])) for log in logs for line in log if line[1] == "gain"]
    assert set(gains) <= set(session.gains)
    assert session.client.reconnections > seconds / 60
    assert faults.faulty == pytest.approx(0.01 * faults.carried, rel=0.1)
    assert session.silences
    for incarnation, start, stop in session.silences:
        drives = driven(logs[incarnation], start + int(0.1 * RATE), stop)
        assert not drives, f"{drives} after the cable was pulled at {start}"
