"""Boards: the compiled firmware as a process behind a pseudo-terminal, played through the drivers."""

import os
from contextlib import nullcontext
from dataclasses import replace

import board
import numpy as np
import pytest
from board import (
    FINGER,
    MECHANICS,
    RATE,
    ROOT,
    SCENE,
    BoardProcess,
    SteppedBoard,
    build_board,
    program_of,
    sensed_error,
    simulated_as,
    tones,
)

import hapticrender as hr
from hapticrender.cli import main
from hapticrender.devices import open_driver
from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Cause, Kind, Reason, State
from hapticrender.drivers.serial import BoardClient, Line, SerialDriver
from hapticrender.errors import DeviceFault, DeviceNotFound, DeviceTimeout, DriverError
from hapticrender.plants.plate import PlateParameters

ROUNDING = 2.0**-24  # relative, of float32


def test_a_port_without_a_name_is_refused():
    with pytest.raises(ValueError, match="port='': must be the name of a serial port"):
        open_driver("serial:")


def test_the_verb_latency_states_the_delay_of_a_boards_design(tmp_path, capsys):
    delay = hr.prepare(SCENE).model.delay
    with BoardProcess(program_of("-O2"), tmp_path) as board:
        assert main(["latency", "--driver", f"serial:{board.port}"]) == 0
    assert f"the delay is stated by the design of the board: {delay} samples at 5000 Hz" in capsys.readouterr().out


@pytest.fixture
def fast(tmp_path):
    """Without sanitisers, under which `test_board_faults` plays."""
    with SteppedBoard(tmp_path, program=program_of("-O2")) as board:
        yield board


@pytest.mark.parametrize("noise", [1e-6, 1e-7])
def test_a_grating_on_the_board_is_as_good_as_on_the_simulated_device(tmp_path, noise):
    """The board's own plate against the library's, under a finger that moves as the board says it did."""
    with SteppedBoard(tmp_path, "--noise", str(noise), program=program_of("-O2")) as board:
        played = hr.render(SCENE, driver=board.driver(finger=FINGER))
    simulated = simulated_as(played, SCENE, noise)
    on_board, in_library = sensed_error(played), sensed_error(simulated)
    of_noise = noise / np.sqrt(2) * np.sqrt(480 / (RATE / 2)) / (10e-6 / np.sqrt(2))
    assert in_library > 0.9 * of_noise
    # float32 may take 1.2 times as much; the noises differ, and so does what is learned of the finger: 1.2 again
    assert on_board < 1.2 * 1.2 * in_library
    assert [each.summary()["passed"] for each in (played, simulated)] == [True, True]
    assert not played.read("flags").any()


def test_a_finger_begins_with_the_run_however_long_the_board_takes_to_be_set_up(fast):
    """A table of 0.1 s: where the finger was set before it, it had moved on by 50 ms at the start, and leapt back."""
    noise = np.random.default_rng(5).standard_normal(20_000)
    along = hr.Recorded(samples=noise, rate=RATE, gain=3e-6, passband=(30.0, 300.0), speed=0.1)
    scene = hr.Scene(texture=along, finger=hr.Finger.sliding(speed=0.1, span=0.06), duration=0.2)
    position = hr.render(scene, driver=fast.driver()).read("position")
    begun = int(np.argmax(np.isfinite(position)))
    assert begun <= 0.01 * RATE  # two frames of it may be 5 ms apart, and the host looks once a millisecond
    assert np.diff(position[begun:]) * RATE == pytest.approx(0.1, rel=0.2)  # 0.2 mm, approached within 10 ms


def test_a_scene_that_no_board_can_play_is_refused(fast):
    driver = fast.driver()
    with pytest.raises(DriverError, match="device_loop: method 'h2' of this scene cannot run on a board"):
        hr.render(SCENE, driver=driver, method="h2")
    with driver, pytest.raises(DriverError, match="play: the loop runs on the board"):
        driver.play(np.zeros((1, 2)))


class Swapped(SerialDriver):
    """A board whose sensors are swapped."""

    def signals(self, rows):
        found = super().signals(rows)
        return found | {"sensed": found["sensed"][:, ::-1]}


@pytest.mark.parametrize(
    ("gain", "kind", "named"),
    [
        ("1,1", SerialDriver, ""),
        ("-1,1", SerialDriver, "sensor 1 is inverted"),
        ("-1,-1", SerialDriver, "both sensors, or all actuators, are inverted"),
        ("1,1", Swapped, "swapped"),
        ("1,0", SerialDriver, "sensor 2 (is dead|repeats its values)"),
        ("0,0", SerialDriver, "nothing moves"),
        ("3,3", SerialDriver, "have (2.9|3|3.1) times the gain"),
    ],
)
def test_a_board_is_probed_before_its_loop_closes(tmp_path, gain, kind, named):
    """By the drive of the host: what is wired wrongly is refused and named, and the board's law has not begun."""
    with SteppedBoard(tmp_path, "--noise", "1e-6", "--gain", gain, program=program_of("-O2")) as board:
        driver = kind("stepped", background=False, clock=board, connect=board.connect, finger=FINGER)
        refusal = pytest.raises(DeviceFault, match=f"refused by the start-up probe: .*({named})")
        with refusal if named else nullcontext():
            hr.render(replace(SCENE, duration=0.05), driver=driver)
        board.sleep(0.02)  # its fade takes 10 ms
        board.assert_at_rest()
        states = [line[2] for line in board.board.log() if line[1] == "state"]
    driving, at_rest, playing = (str(int(state)) for state in (State.DRIVING, State.IDLE, State.PLAYING))
    assert states == (3 * [driving, at_rest] if named else [driving, at_rest, playing, at_rest])


def test_a_probe_on_a_line_that_loses_samples_says_so(fast):
    """One in ten pieces on their way from the board: no sensor is blamed, and a scene may leave the probe out."""
    lost = np.random.default_rng(3)
    read = fast.read
    fast.read = lambda most: data if len(data := read(most)) < 200 or lost.random() > 0.1 else b""
    with pytest.raises(DeviceFault, match=r"refused by the start-up probe: .*% of the samples were lost on the way"):
        hr.render(SCENE, driver=fast.driver(finger=FINGER))
    probed = replace(SCENE, duration=0.05, rendering={"probe": False})
    assert len(hr.render(probed, driver=fast.driver(finger=FINGER))) == 250


PRESSED = hr.Scene(
    texture=hr.Grating(frequency=189.0, amplitude=10e-6),
    finger=hr.Finger.still(normal_load=0.8, mechanics=MECHANICS),
    duration=0.5,
)


def test_the_limits_of_a_device_are_held_on_a_board(fast):
    """A finger takes more than the free plate, by which a scene is refused: the drive is cut, or the board stops."""
    free = hr.render(PRESSED, driver=fast.driver())
    most, step = abs(free.drive).max(), 3.0 / 2**11
    limit = 0.5 * most
    assert limit > 3 * step  # of the converter, of which a peak is a multiple
    unprobed = replace(PRESSED, limits={"peak_drive": limit}, rendering={"probe": False})  # noise hides so weak a probe
    recording = hr.render(unprobed, driver=fast.driver())
    assert limit - step <= abs(recording.drive).max() <= limit
    assert recording.read("flags").max() & hr.Flag.SATURATED
    rms = np.sqrt((free.drive**2).mean(axis=0).max())  # of a tone: reached within some time constants
    for limits, fault in (
        ({"rms_drive": 0.5 * rms, "rms_time": 0.1}, "the mean square of the drive is above its limit"),
        ({"displacement": 0.5 * abs(free.sensed).max()}, r"a sensor shows more than \[limits\] displacement"),
    ):
        with pytest.raises(DeviceFault, match=fault) as caught:
            hr.render(replace(PRESSED, limits=limits), driver=fast.driver())
        fast.assert_at_rest()
        played = caught.value.recording  # to the end of the board's fade, of 10 ms
        stopped = round(caught.value.time * played.rate)
        np.testing.assert_array_equal(played.flags & hr.Flag.STOPPED > 0, np.arange(len(played)) >= stopped)
        assert played.drive[stopped - 1].any()
        assert 10 <= len(played) - stopped <= 50


def test_the_limits_of_a_device_are_held_live_on_a_board(fast):
    driver = fast.driver()
    limits = {"peak_drive": 0.5, "rms_drive": 0.25, "rms_time": 5e3, "displacement": 4e-4}
    loop = driver.loop(hr.prepare(replace(PRESSED, limits=limits), driver=driver))
    with driver:
        loop.start()
        peak, *others = driver.client._settings[Kind.LIMITS]
    assert 0.5 - 3.0 / 2**11 < peak <= 0.5
    assert others == [0.25, 1e3, 4e-4]


def test_textures_gain_and_finger_change_while_it_plays(fast):
    client = fast.client().open()
    client.set_bands(tones(47.0, amplitude=10e-6))
    client.limits(0.5)
    client.finger(0.01, 0.0, 0.4)
    client.start()
    found = []
    for change in (lambda: None, lambda: setattr(client, "gain", 0.5), lambda: client.set_bands(tones(72.0, 180.0))):
        change()
        for _ in range(10):
            client.finger(0.01, 0.0, 0.4)
            fast.run(client, 0.05)
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
    fast.run(client, 0.1)
    assert client.telemetry()[4:6] == (State.IDLE, Cause.COMMAND)
    client.close()
    with pytest.raises(DriverError, match="it is not open"):
        client.telemetry()


def test_refusals_name_port_command_and_bytes(fast):
    client = fast.client().open()
    client.limits(client.capabilities.drive_limit)
    with pytest.raises(DriverError, match=r"stepped: START: .*: state: nothing is set, .* \(00 00 64 00, 4 bytes\)"):
        client.start()
    for act, message in (
        (lambda: client.set_bands(tones(*range(20, 200, 20))), "9 bands: must be <= 8 on stepped"),
        (lambda: client.set_bands(tones(2100.0)), "COMMIT: refused by the board: value"),
        (lambda: client.limits(2.0 * client.capabilities.drive_limit), "LIMITS: refused by the board: value"),
        (lambda: setattr(client, "gain", 1.01), "gain = 1.01: must be a finite number >= 0 and <= 1"),
        (lambda: client.set_bands(replace(tones(50.0), envelope=None)), "must be constant envelopes"),
    ):
        with pytest.raises(ValueError, match=message):
            act()
    assert client._line.request(Kind.COMMIT, protocol.pack(Kind.COMMIT, 1, 0)).refused == Reason.DIGEST


def test_the_board_identifies_itself(tmp_path):
    """Drive as the lines say, and sensed what the device model makes of it."""
    lines = [Line(0, 60.0, 0.05), Line(1, 110.0, 0.05, 0.25)]
    with SteppedBoard(tmp_path, "--noise", "1e-8", program=program_of("-O2")) as board:
        client = board.client().open()
        rows = client.identify(lines, 1.0)
        board.run(client, 0.1)
        assert client.telemetry().cause == Cause.DONE
        faded = client.rows()[:, -1]
        assert len(faded) == 0.01 * RATE
        assert not faded.any()
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


def test_the_command_identifies_the_plate_of_a_board(fast, tmp_path, monkeypatch):
    """By drive from the host, within the board's limit; the profile has the delay of its own loop, for an export."""
    expected, path = PlateParameters(), tmp_path / "plate.toml"
    monkeypatch.setattr(board, "board_under_test", lambda: fast.driver(), raising=False)
    command = ["identify", "--driver", "board:board_under_test", "--out", str(path)]
    assert main(command) == 0
    found = hr.DeviceProfile.load(path)
    assert found.device["delay"] == 1
    for name in ("mass", "inertia", "stiffness_1", "stiffness_2"):  # the uncertainty is a standard one
        assert found.device[name] == pytest.approx(getattr(expected, name), abs=8 * found.uncertainty[name])


def test_a_run_goes_on_with_a_flag_after_its_board_was_lost(fast):
    """0.7 s without a line, and 50 Hz: the rows before it stay, those that were lost are counted and flagged."""
    scene = hr.Scene(texture=hr.Grating(frequency=50.0, amplitude=5e-6), duration=2.0)
    wait = fast.sleep

    def pull(seconds):
        wait(seconds)
        if fast.time > 0.9 and not fast.pulled:
            fast.pulled = fast.time + 0.7

    fast.sleep = pull
    with fast.driver(reconnect=5.0) as driver:
        recording = hr.render(scene, driver=driver)
    assert driver.client.reconnections == 1
    lost = np.flatnonzero(recording.read("flags") & hr.Flag.OVERRUN)
    assert len(recording) == 10_000
    assert 0.7 * RATE <= len(lost) < 0.8 * RATE  # and until it was found again
    assert lost[0] > 0.4 * RATE
    before = slice(round(0.2 * RATE), round(0.4 * RATE))
    error = recording.read("sensed")[before].mean(axis=1) - recording.read("reference")[before].ravel()
    assert np.sqrt((error**2).mean()) < 0.5 * 5e-6 / np.sqrt(2)  # in phase: noise of 1 um in two sensors, 0.2 of it


def test_a_misspelt_option_names_the_driver_and_its_options():
    """Before the port is opened; a right one is taken."""
    for text, error, message in (
        (
            "bau=9600",
            ValueError,
            "driver = 'serial:no-such-port.bau=9600': option 'bau' of SerialDriver: must be one of "
            "finger, baud, timeout, reconnect, .*; give its argument as serial:ARGUMENT.OPTION=VALUE",
        ),
        ("baud=9600", DeviceNotFound, "no-such-port: open"),
    ):
        with pytest.raises(error, match=message):
            open_driver(f"serial:no-such-port?{text}")


def test_nothing_there_and_nothing_that_answers(tmp_path):
    with pytest.raises(DeviceNotFound, match="no-such-port: open: .*No such file"):
        BoardClient(str(tmp_path / "no-such-port")).open()
    master, other = os.openpty()
    name = os.ttyname(other)
    silent = rf"{name}: HELLO: no answer in 0.1 s \(\d+ bytes sent, 0 received\): .* `hapticrender export`, .*230400"
    with pytest.raises(DeviceTimeout, match=silent):
        BoardClient(name, timeout=0.1).open()
    for each in (master, other):
        os.close(each)


def test_more_bands_than_a_frame_holds(tmp_path):
    program = build_board(tmp_path / "firmware", hr.prepare(SCENE), "-O1", "-DREAL_DOUBLE", bands=20)
    with SteppedBoard(tmp_path, program=program) as board:
        client = board.client().open()
        client.limits(client.capabilities.drive_limit)  # a float, and in double perhaps above the limit itself
        client.set_bands(tones(*range(40, 340, 20), amplitude=1e-6))
        client.start()
        board.run(client, 0.1)
        found = client.telemetry()
        assert len(found.bands) == found.total == 15
        assert [abs(band.target) for band in found.bands] == pytest.approx(15 * [1e-6], rel=ROUNDING)


@pytest.mark.parametrize(
    ("stream", "period", "received"), [(1, 60.0 / RATE * 1000, 158_000), (10, 10.0, 15_800), (0, 0.02, 9_700)]
)
def test_what_the_line_carries_is_what_the_page_says(fast, stream, period, received):
    """Bytes a second of the stream alone, of every tenth row, and of the telemetry of 8 bands; words besides."""
    client = fast.client().open()
    client.set_bands(tones(*range(40, 280, 30), amplitude=1e-6))
    client.start(stream=stream, telemetry=period)
    fast.run(client, 0.2)
    before = client._line.received_bytes, client._line.sent_bytes
    fast.run(client, 1.0)
    found = client._line.received_bytes - before[0], client._line.sent_bytes - before[1]
    assert found[0] == pytest.approx(received, rel=0.02)
    assert found[1] == pytest.approx(1900, rel=0.02)
    page = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
    assert f"| {received:,} |".replace(",", " ") in page
