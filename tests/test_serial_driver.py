"""Boards: the compiled firmware as a process behind a pseudo-terminal, played, disturbed and unplugged."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from board import RATE, SANITISED, SLOW, BoardProcess, Faults, SlowClock, SteppedBoard, build_board

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Cause, Kind, Reason, State
from hapticrender.drivers.serial import BoardClient, Line, SerialDriver
from hapticrender.errors import DeviceFault, DeviceLost, DeviceNotFound, DeviceTimeout, DriverError
from hapticrender.plants.identify import identify
from hapticrender.plants.plate import PlateParameters

MECHANICS = "heavy-2nd-order"
FINGER = hr.Finger.swiping(frequency=0.8, stroke=0.05, normal_load=0.4, mechanics=MECHANICS)
SCENE = hr.Scene(texture=hr.Grating(wavelength=1e-3, amplitude=10e-6), finger=FINGER, duration=2.0, tolerance=0.1)
ROUNDING = 2.0**-24  # relative, of float32


@pytest.fixture(scope="module")
def rendering():
    return hr.prepare(SCENE)


@pytest.fixture(scope="module")
def program(rendering, tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("firmware"), rendering, "-O2")


@pytest.fixture(scope="module")
def sanitised(rendering, tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("sanitised"), rendering, *SANITISED)


@pytest.fixture
def stepped(sanitised, tmp_path):
    with SteppedBoard(sanitised, tmp_path) as board:
        yield board


@pytest.fixture
def fast(program, tmp_path):
    """The same without sanitisers."""
    with SteppedBoard(program, tmp_path) as board:
        yield board


def client_of(board, **options):
    return BoardClient("stepped", background=False, clock=board, connect=board.connect, **options)


def driver_of(board, **options):
    return SerialDriver("stepped", background=False, clock=board, connect=board.connect, **options)


def tones(*frequencies, amplitude=5e-6):
    n = len(frequencies)
    return Bands(frequency=frequencies, wavenumber=np.zeros(n), phase=np.zeros(n), envelope=np.full(n, amplitude))


def run(client, board, seconds):
    end = board.monotonic() + seconds
    while board.monotonic() < end:
        client.step()
        board.sleep(0.005)


def sensed_error(recording):
    """Error of the middle of the plate by its sensors, 20-500 Hz, over the texture, after the fade-in."""
    start = int(0.3 * RATE)
    reference = recording.read("reference", start)
    error = np.fft.rfft(recording.read("sensed", start).mean(axis=1) - reference)
    frequency = np.fft.rfftfreq(len(reference), 1 / RATE)
    inside = (frequency >= 20) & (frequency <= 500)
    return np.linalg.norm(error[inside]) / np.linalg.norm(np.fft.rfft(reference)[inside])


@pytest.mark.parametrize("noise", [1e-6, 1e-7])
def test_a_grating_on_the_board_is_as_good_as_on_the_simulated_device(program, tmp_path, noise):
    """The board's own plate against the library's, under a finger that moves as the board says it did."""
    with SteppedBoard(program, tmp_path, options=("--noise", str(noise))) as board:
        played = hr.render(SCENE, driver=driver_of(board, finger=FINGER))
    position = played.read("position")
    position[: np.argmax(np.isfinite(position))] = position[np.isfinite(position)][0]
    same = hr.Finger.sampled(position, rate=RATE, normal_load=0.4, mechanics=MECHANICS)
    simulated = hr.render(replace(SCENE, finger=same, simulation={"sensor_noise": noise}))
    on_board, in_library = sensed_error(played), sensed_error(simulated)
    of_noise = noise / np.sqrt(2) * np.sqrt(480 / (RATE / 2)) / (10e-6 / np.sqrt(2))
    print(f"error by the sensors, noise {noise}: board {on_board:.4f}, library {in_library:.4f}, noise {of_noise:.4f}")
    assert in_library > 0.9 * of_noise
    # float32 may take 1.2 times as much; the noises differ, and so does what is learned of the finger: 1.2 again
    assert on_board < 1.2 * 1.2 * in_library
    summaries = played.summary(), simulated.summary()
    print([(each["verdict"], each["bands"][0]["complex_error"], each["worst"]) for each in summaries])
    assert [each["passed"] for each in summaries] == [True, True]
    assert not played.read("flags").any()


def test_what_was_recorded_is_complete_and_of_the_board(program, tmp_path):
    scene = replace(SCENE, duration=0.6)
    with BoardProcess(program, tmp_path, *SLOW) as board:
        driver = SerialDriver(str(board.port), finger=FINGER, clock=SlowClock())
        recording = hr.render(scene, driver=driver)
        time.sleep(0.05)
        log = board.log()
    assert (driver.rate, driver.drive_channels, driver.sensed_channels, driver.delay) == (RATE, 2, 2, 1)
    assert len(recording) == 3000
    assert recording.header.motion_source == "sensors"
    commits = [line for line in log if line[1] == "commit"]
    assert [[float(each) for each in line[3:]] for line in commits] == [pytest.approx([0, 1000, 0, 1e-5, 0], rel=1e-6)]
    assert [line[2:] for line in log if line[1] == "state"] == [["1", "0"], ["0", "1"]]
    with pytest.raises(DriverError, match="it has been closed"):
        driver.open()


def test_a_scene_that_no_board_can_play_is_refused(stepped):
    white = hr.Scene(texture=hr.Recorded(samples=np.sin(np.arange(500.0)), rate=5000.0, amplitude=1e-6), duration=0.1)
    driver = driver_of(stepped)
    with pytest.raises(DriverError, match="exchange: method 'h2' of this scene cannot run on a board"):
        hr.render(SCENE, driver=driver, method="h2")
    with pytest.raises(DriverError, match="exchange: method 'inverse' of this scene cannot run"):
        hr.render(white, driver=driver)
    with driver, pytest.raises(DriverError, match="play: the loop runs on the board"):
        driver.play(np.zeros((1, 2)))


def test_textures_gain_and_finger_change_while_it_plays(stepped):
    client = client_of(stepped).open()
    client.set_bands(tones(47.0, amplitude=10e-6))
    client.limits(0.5)
    client.finger(0.01, 0.0, 0.4)
    client.start()
    found = []
    for change in (lambda: None, lambda: setattr(client, "gain", 0.5), lambda: client.set_bands(tones(72.0, 180.0))):
        change()
        for _ in range(10):
            client.finger(0.01, 0.0, 0.4)
            run(client, stepped, 0.05)
        found.append(client.telemetry())
    assert [telemetry.state for telemetry in found] == 3 * [State.PLAYING]
    assert [[abs(band.target) for band in each.bands] for each in found] == [
        pytest.approx([1e-5], rel=1e-6),
        pytest.approx([5e-6], rel=1e-6),
        pytest.approx([2.5e-6, 2.5e-6], rel=1e-6),
    ]
    for telemetry in found:
        for band in telemetry.bands:
            # noise of 1/sqrt(2) um through an observer of 10 Hz: 0.06 um, three sigmas of 2.5 um
            assert abs(band.measured - band.target) < 0.02 * abs(band.target) + 0.2e-6
        assert telemetry.position == pytest.approx(0.01, rel=1e-6)
        assert 0 < telemetry.cycles < telemetry.cycles_most
    assert found[2].commits == 2
    client.stop()
    run(client, stepped, 0.1)
    assert client.telemetry()[4:6] == (State.IDLE, Cause.COMMAND)
    client.close()
    with pytest.raises(DriverError, match="it is not open"):
        client.telemetry()


def test_refusals_name_port_command_and_bytes(stepped):
    client = client_of(stepped).open()
    with pytest.raises(DriverError, match=r"stepped: START: refused by the board: state \(00 00 64 00\)"):
        client.start()
    with pytest.raises(ValueError, match=r"9 bands: must be <= 8 on stepped"):
        client.set_bands(tones(*range(20, 200, 20)))
    with pytest.raises(ValueError, match=r"COMMIT: refused by the board: value"):
        client.set_bands(tones(2100.0))
    with pytest.raises(ValueError, match=r"LIMITS: refused by the board: value"):
        client.limits(2.0 * client.capabilities.drive_limit)
    client.limits(client.capabilities.drive_limit)
    with pytest.raises(ValueError, match=r"gain = 1.01: must be 0 to 1"):
        client.gain = 1.01
    with pytest.raises(ValueError, match="must be constant envelopes"):
        client.set_bands(replace(tones(50.0), envelope=None))
    request = client._line.link.submit(Kind.COMMIT, protocol.pack(Kind.COMMIT, 1, 0))
    assert client._line._answer(request).refused == Reason.DIGEST


def test_the_board_identifies_itself(program, tmp_path):
    """Drive as the lines say, and sensed what the device model makes of it."""
    lines = [Line(0, 60.0, 0.05), Line(1, 110.0, 0.05, 0.25)]
    with SteppedBoard(program, tmp_path, options=("--noise", "1e-8")) as board:
        client = client_of(board).open()
        rows = client.identify(lines, 1.0)
        run(client, board, 0.1)
        assert client.telemetry().cause == Cause.DONE
    drive, sensed = rows[:, :2], rows[:, 2:]
    assert rows.shape == (5000, 4)
    n = np.arange(4000)
    for line in lines:
        # a row's drive is that of the tick before it
        expected = line.amplitude * np.cos(2 * np.pi * (line.frequency * (n + 999) / RATE + line.phase))
        # the phase is summed in float32, once a sample
        assert drive[1000:, line.channel] == pytest.approx(expected, abs=line.amplitude * 2 * np.pi * 5000 * ROUNDING)
    model = hr.prepare(hr.Scene(texture=hr.Grating(frequency=60.0, amplitude=1e-6), duration=1.0)).model
    waves = np.exp(-2j * np.pi * np.outer([60.0, 110.0], np.arange(1000, 5000)) / RATE)
    ratio = np.einsum("kn,nc->kc", waves, sensed[1000:])
    into = np.einsum("kn,nc->kc", waves, drive[1000:])
    # the row's drive acts from the row's sensing on, so that only the hold lies between them
    frequency = np.array([60.0, 110.0])
    held = np.exp(-1j * np.pi * frequency / RATE) * np.sinc(frequency / RATE)
    motion = np.linalg.solve(model.dynamic_stiffness(frequency), (model.force_from_drive @ into.T).T[..., None])[..., 0]
    expected = np.linalg.solve(model.coordinate_from_sensed, (motion * held[:, None]).T).T
    # modes at 147 and 189 Hz ring from the fade-in with time constants of 56 and 36 ms; steps of 12 and 14 bits
    assert abs(ratio - expected).max() < 0.01 * abs(expected).max()


def test_drive_from_the_host_identifies_the_plate(fast):
    expected = PlateParameters()
    with driver_of(fast, block=100) as driver:
        found = identify(driver, expected, amplitude=50e-6)
        delay = driver.delay
    assert found.estimates["delay"].value == pytest.approx(delay, abs=0.01)
    for name in ("mass", "inertia", "stiffness_1", "stiffness_2"):
        estimate = found.estimates[name]
        assert estimate.value == pytest.approx(getattr(expected, name), abs=4 * estimate.interval)


def test_nothing_there_and_nothing_that_answers(tmp_path):
    with pytest.raises(DeviceNotFound, match="no-such-port: open: .*No such file"):
        BoardClient(str(tmp_path / "no-such-port")).open()
    master, other = __import__("os").openpty()
    name = __import__("os").ttyname(other)
    with pytest.raises(DeviceTimeout, match=rf"{name}: HELLO: no answer in 0.1 s \(\d+ bytes sent, 0 received\)"):
        BoardClient(name, timeout=0.1).open()
    for each in (master, other):
        __import__("os").close(each)


@pytest.mark.parametrize("name", ["timeout", "reconnect"])
def test_times_are_checked(name):
    BoardClient("x", **{name: 0.0})
    for wrong in (-1e-9, np.inf, np.nan):
        with pytest.raises(ValueError, match=rf"{name} = .*: must be finite and >= 0 s"):
            BoardClient("x", **{name: wrong})


def test_an_unplugged_board_is_lost_with_port_operation_and_bytes(program, tmp_path):
    with BoardProcess(program, tmp_path, *SLOW) as board, BoardClient(str(board.port), clock=SlowClock()) as client:
        client.set_bands(tones(47.0))
        client.start()
        board.kill()
        lost = r"tty: (line|listen): .* \(\d+ bytes sent, \d+ received, 0 bad frames\)"
        with pytest.raises(DeviceLost, match=lost):
            wait_for(lambda: client.telemetry() and False)
        with pytest.raises(DeviceLost, match=lost):
            client.finger(0.0)


def test_a_replugged_board_goes_on(program, tmp_path):
    with (
        BoardProcess(program, tmp_path, *SLOW) as first,
        BoardClient(str(first.port), clock=SlowClock(), reconnect=20.0) as client,
    ):
        client.set_bands(tones(47.0))
        client.gain = 0.25
        client.start()
        first.kill()
        with BoardProcess(program, tmp_path, *SLOW) as second:
            wait_for(lambda: client.reconnections == 1 and client.telemetry().state == State.PLAYING)
            assert [line[1:] for line in second.log() if line[1] == "gain"] == [["gain", "0.25"]]
            client.stop()


def wait_for(done, seconds=30.0):
    """Wait until it is done; a test that hangs fails."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_an_app_that_hangs_ends_in_zero_drive(stepped):
    """No word for 100 ms of the board's clock: the host's process is stopped, so nothing else can say so."""
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start()
    run(client, stepped, 0.5)
    last = stepped.sample
    stepped.sleep(0.3)
    (silent,) = [int(line[0]) for line in stepped.board.log() if line[1:3] == ["state", "0"]]
    assert 0.080 * RATE <= silent - last <= 0.100 * RATE
    assert stepped.board.log()[-1][1:] == ["drives", "0"]
    assert int(stepped.board.log()[-1][0]) <= last + 0.100 * RATE
    with pytest.raises(DeviceLost, match="the board heard no good word for 80 ms, and stopped"):
        run(client, stepped, 0.1)


def test_a_finger_that_is_not_heard_of_is_lifted(stepped):
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start(telemetry=0.001)
    client.finger(0.0, 0.1)
    run(client, stepped, 0.1)
    assert client.telemetry().position == pytest.approx(0.1 * 0.05, abs=0.1 * 0.002)  # followed for 50 ms
    run(client, stepped, 0.08)
    assert client.telemetry().position == pytest.approx(0.1 * 0.05, abs=0.1 * 0.002)
    run(client, stepped, 0.04)
    assert np.isnan(client.telemetry().position)
    client.finger(np.nan)
    run(client, stepped, 0.02)
    client.finger(0.03)
    run(client, stepped, 0.02)
    assert client.telemetry().position == pytest.approx(0.03, rel=1e-6)  # a touch is no glide


def test_limits_stop_the_board(stepped):
    client = client_of(stepped).open()
    client.set_bands(tones(20.0, amplitude=30e-6))
    client.start()
    run(client, stepped, 0.5)
    client.limits(0.5, 0.05, 0.1)
    with pytest.raises(DeviceFault, match="the board stopped: the mean square of the drive is above its limit"):
        run(client, stepped, 1.0)


def test_a_press_beyond_the_sensors_range_stops_the_board(stepped):
    """20 N at the end of the glass: 20/45.3e3 (1 + 2 * 2) = 2.2 mm there, of 1 mm."""
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start()
    client.finger(0.055, 0.0, 20.0)
    with pytest.raises(DeviceFault, match="the board stopped: a sensor was invalid for 10 ms"):
        run(client, stepped, 0.2)
    last = stepped.board.log()[-1]
    assert last[1:] == ["drives", "0"]


def test_garbage_is_no_sign_of_life(stepped, rng):
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start()
    run(client, stepped, 0.2)
    last = stepped.sample
    for _ in range(20):
        stepped.inject(bytes(rng.integers(0, 256, 200, dtype="u1")))
        stepped.sleep(0.01)
    assert driven(stepped.board.log(), last + int(0.1 * RATE), stepped.sample) == []


@pytest.mark.parametrize(("late", "stops"), [(0.07, False), (0.09, True)])
def test_a_word_that_waited_for_long_is_no_sign_of_life(stepped, late, stops):
    """A line that fills up: words come every 15 ms, each 5 ms later than the one before, until they are `late` old."""
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start()
    run(client, stepped, 0.2)
    start, waiting = stepped.time, []
    while stepped.time < start + 0.6:
        arrival = stepped.time + min(late, (stepped.time - start) / 2)
        waiting.append((arrival, client._line.link.due(stepped.time)))
        stepped.sleep(0.01)
        while waiting and waiting[0][0] <= stepped.time:
            stepped.inject(waiting.pop(0)[1])
    assert bool(driven(stepped.board.log(), stepped.sample - 100, stepped.sample)) != stops


def test_damage_that_the_crc_does_not_show_does_nothing(stepped):
    """Commands with a number changed and the CRC-16 made anew: what one in 65 536 damaged frames amounts to."""
    client = client_of(stepped).open()
    client.set_bands(tones(47.0))
    client.start()
    run(client, stepped, 0.2)
    before, refused = stepped.board.log(), client.telemetry().refused
    link = client._line.link
    words = [
        (Kind.SETPOINT, protocol.pack(Kind.SETPOINT, 0, 47.0, 0.0, 0.0, 5e-6, 0.0)),
        (Kind.GAIN, protocol.pack(Kind.GAIN, 0.5)),
        (Kind.FINGER, protocol.pack(Kind.FINGER, 0, 0.01, 0.0, 0.4)),
        (Kind.STOP, b""),
    ]
    for index, (kind, payload) in enumerate(words):
        (frame,) = protocol.Reader().feed(
            protocol.command(link.capabilities.session, kind, (link._sequence + 100 + index) & 0xFFFF, payload)
        )
        changed = bytes([frame.payload[0] ^ 1]) + frame.payload[1:]
        stepped.inject(protocol.encode(frame._replace(payload=changed)))
        run(client, stepped, 0.02)
    client._line.link._strange = 0
    run(client, stepped, 0.1)
    assert client.telemetry().refused == refused + len(words)
    assert client.telemetry().commits == 1
    assert np.isnan(client.telemetry().position)
    assert [line for line in stepped.board.log()[len(before) :] if line[1] != "drives"] == []


def test_a_commit_acts_only_on_what_it_says(stepped):
    """A set-point that never came leaves the one from before in its place: the digest shows it."""
    client = client_of(stepped).open()
    client.set_bands(tones(47.0, 72.0))
    payloads = [protocol.pack(Kind.SETPOINT, index, 100.0 + 20 * index, 0.0, 0.0, 5e-6, 0.0) for index in (0, 1)]
    client._line.send(Kind.SETPOINT, payloads[1])
    with pytest.raises(DriverError, match="COMMIT: refused by the board: digest"):
        client._line.ask(Kind.COMMIT, 2, protocol.digest(payloads))
    assert [line[3:9:5] for line in stepped.board.log() if line[1] == "commit"] == [["47", "72"]]


def test_a_board_that_stays_away_is_lost(stepped):
    client = client_of(stepped, reconnect=1.0).open()
    client.set_bands(tones(47.0))
    client.start()
    run(client, stepped, 0.1)
    stepped.pulled = np.inf
    start = stepped.time
    with pytest.raises(DeviceLost, match=r"stepped: listen: no good frame for 0.5 s \(\d+ bytes sent"):
        run(client, stepped, 10.0)
    # silence for 0.5 s, 1 s of attempts, the last of which may take 1 s and 0.05 s
    assert 1.5 <= stepped.time - start <= 2.56
    with pytest.raises(DeviceLost, match="no good frame"):
        client.gain = 0.5


def test_more_bands_than_a_frame_holds(rendering, tmp_path):
    program = build_board(tmp_path / "firmware", rendering, "-O1", "-DREAL_DOUBLE", bands=20)
    with SteppedBoard(program, tmp_path) as board:
        client = client_of(board).open()
        client.set_bands(tones(*range(40, 340, 20), amplitude=1e-6))
        client.start()
        run(client, board, 0.1)
        found = client.telemetry()
        assert len(found.bands) == found.total == 15
        assert [abs(band.target) for band in found.bands] == pytest.approx(15 * [1e-6], rel=ROUNDING)


def test_doubled_and_recorded_commands_do_nothing(stepped):
    """A whole session, played back to the board in the same session and in the next."""
    recorded = []
    stepped.damage = lambda data: recorded.append(data) or data

    def play(client):
        client.set_bands(tones(47.0))
        client.start()
        run(client, stepped, 0.2)

    with client_of(stepped) as client:
        play(client)
        client.stop()
        run(client, stepped, 0.1)
        stepped.damage = lambda data: data
        before = len(stepped.board.log())
        replay(stepped, recorded)
        run(client, stepped, 0.1)
        assert len(stepped.board.log()) == before
    with client_of(stepped) as client:
        play(client)
        before = stepped.board.log()
        replay(stepped, recorded)
        # greeted anew, it stopped, and refused all the rest
        after = [line[1:] for line in stepped.board.log()[len(before) :] if line[1] != "drives"]
        assert after == [["state", "0", str(int(Cause.SESSION))]]
        assert driven(stepped.board.log(), stepped.sample - 1, stepped.sample) == []
        with pytest.raises(DeviceLost, match="session: the board has another session"):
            run(client, stepped, 1.0)


def replay(board, recorded):
    for data in recorded:
        board.inject(data)
        board.sleep(0.005)


class Session:
    """Ten minutes with a board: textures change, cables are pulled, boards reset, garbage comes; what was asked for."""

    def __init__(self, board, seed):
        self.board, self.rng = board, np.random.default_rng(seed)
        self.client = client_of(board, reconnect=10.0)
        self.asked, self.gains, self.silences = [], [1.0], []
        self.recorded = []

    def change(self):
        n = self.rng.integers(1, 5)
        frequencies = np.sort(self.rng.choice(np.arange(30.0, 300.0, 15.0), n, replace=False))
        bands = Bands(
            frequency=frequencies,
            wavenumber=np.zeros(n),
            phase=self.rng.uniform(0, 6, n),
            envelope=self.rng.uniform(1e-6, 5e-6, n) * np.exp(1j * self.rng.uniform(0, 6, n)),
        )
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
        run(self.client, self.board, duration)

    def play(self, seconds):
        client, board, rng = self.client, self.board, self.rng
        with client:
            self.change()
            client.start()
            changes = [self.change, self.change_gain, self.flood, self.pull, board.reset]
            while board.monotonic() < seconds:
                client.finger(rng.uniform(-0.02, 0.02), rng.uniform(-0.1, 0.1), 0.4)
                run(client, board, rng.uniform(0.05, 0.5))
                attempt(rng.choice(changes, p=[0.5, 0.25, 0.15, 0.05, 0.05]))


def attempt(change):
    """A change that the line swallows is asked for again by the app; here the next one will do."""
    try:
        change()
    except (DeviceTimeout, DeviceLost):
        pass


@pytest.mark.parametrize("seconds", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_a_bad_line_never_plays_what_was_not_asked_for(fast, seconds, rng, monkeypatch):
    monkeypatch.setattr("secrets.randbelow", lambda most: int(rng.integers(most)))
    faults = Faults(18, 0.01)
    session = Session(fast, 18)

    def damage(data):
        session.recorded.append(data)
        return faults(data)

    fast.damage = damage
    session.play(seconds)
    logs = [*fast.records, fast.board.log()]
    commits = [np.array(line[3:], "f4") for log in logs for line in log if line[1] == "commit"]
    assert len(commits) > seconds / 2
    at = 0
    for commit in commits:  # in the order in which they were asked for, none made of two
        at = next(index for index in range(at, len(session.asked)) if np.array_equal(session.asked[index], commit))
    gains = [float(np.float32(line[2])) for log in logs for line in log if line[1] == "gain"]
    assert set(gains) <= set(session.gains)
    assert session.client.reconnections > seconds / 60
    assert faults.faulty == pytest.approx(0.01 * faults.carried, rel=0.1)
    for incarnation, start, stop in session.silences:
        drives = driven(logs[incarnation], start + int(0.1 * RATE), stop)
        assert not drives, f"{drives} after the cable was pulled at {start}"


def driven(log, start, stop):
    """Samples from which on it drove between `start` and `stop`."""
    changes = [(int(line[0]), line[2] == "1") for line in log if line[1] == "drives"]
    ends = [sample for sample, _ in changes[1:]] + [2**62]
    return [
        sample for (sample, drives), end in zip(changes, ends, strict=True) if drives and sample < stop and end > start
    ]


def test_two_threads_can_set_a_board(program, tmp_path):
    with BoardProcess(program, tmp_path, *SLOW) as board, BoardClient(str(board.port), clock=SlowClock()) as client:
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
