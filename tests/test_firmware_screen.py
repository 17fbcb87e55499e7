"""An electroadhesive screen on a board, in open loop: the law in C against the library's, and over the line."""

import ctypes
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from board import RATE, SANITISED, SCENE, SteppedBoard, build_board, tones
from laws import KINDS

import hapticrender as hr
from hapticrender.bands import Bands, hold_last
from hapticrender.drivers.protocol import Cause
from hapticrender.drivers.serial import BoardTexture
from hapticrender.errors import DeviceFault
from hapticrender.export import export
from hapticrender.plants.sliding_contact import SlidingParameters

FINGER = hr.Finger.swiping(frequency=1.0, stroke=0.05, normal_load=0.4)
RIDGES = hr.Grating(wavelength=1e-3, amplitude=5e-6)
SCREEN = hr.Scene(texture=RIDGES, finger=FINGER, duration=1.0, device="electroadhesion", profile={"rate": RATE})

LATE = slice(int(0.3 * RATE), None)  # after the fade-in


@pytest.fixture(scope="module")
def library():
    """Law of the library for the screen without sensors, for whole waveforms; and its rendering."""
    board = copy(hr.prepare(SCREEN).device)
    board.sensed_channels = 0
    rendering = hr.prepare(SCREEN, driver=board)
    return rendering, lambda: rendering.design(replace(Bands.none(spatial=False), differentiated=True))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("screen"), hr.prepare(SCREEN), *SANITISED)


def path_and_waveform(rendering, ahead):
    """A finger that touches, swipes, lifts for one sample and for 20 ms, sticks for 0.2 s, and leaps."""
    time = np.arange(4 * int(RATE)) / RATE
    position = FINGER.position(time)
    position[:1000] = position[6000] = position[12_000:12_100] = np.nan
    position[13_000:14_000] = position[13_000]
    position[17_000] += 0.02
    waveform = rendering.waveform(time + ahead / RATE, hold_last(position))
    waveform[[18_000, 18_001]] = np.nan, 1e3
    return position, waveform * (1.0 + 4.0 * (time > 3.5))  # at the end it takes more than the limit


@pytest.mark.parametrize("kind", KINDS)
def test_the_attraction_equals_the_librarys(exports, library, kind):
    """In double to 1e-9 of the limit and to the flag; in float the rms of what differs is below 1e-4 of it."""
    rendering, design = library
    controller = design()
    position, waveform = path_and_waveform(rendering, controller.lookahead)
    drive, _, flags = controller.run(np.zeros((len(position), 0)), position, waveform)
    exports.renderings["screen"] = hr.prepare(SCREEN)
    law = exports.law("screen", kind)
    found, found_flags = law.run(np.zeros((len(position), 1)), position, waveform, channels=1)
    limit = rendering.model.drive_limit
    if kind == "float":
        assert np.std(found - drive) < 1e-4 * limit
        return
    assert abs(found - drive).max() < 1e-9 * limit
    assert np.array_equal(found_flags, flags)
    assert not (flags[:6000] & hr.Flag.SATURATED).any()
    assert (flags[17_500:] & hr.Flag.SATURATED).any()
    assert abs(drive[1500:3000]).max() > 0.2 * limit
    assert abs(drive[13_500:14_000]).max() < 1e-3 * limit  # a finger that sticks: it has faded out
    carrier = law.code.law_carrier
    carrier.argtypes, carrier.restype = (ctypes.c_void_p, ctypes.c_double), ctypes.c_double
    design_at = ctypes.addressof(ctypes.c_char.in_dll(law.code, "design"))
    for attraction in (-limit, -0.3 * limit, 0.0, limit):
        assert carrier(design_at, attraction) == pytest.approx(float(rendering.shape(attraction)), rel=1e-12)


def friction_of(drive, position, root):
    """Friction that a screen makes of the carrier's peak, behind a contact of first order; as the theory has it."""
    p = SlidingParameters(rate=RATE)
    made, last, friction = 0.8 * (root.gain * drive**2 - root.bias), 0.0, np.zeros(len(drive))
    speed = abs(np.gradient(position)) * RATE
    for n in range(1, len(drive)):
        step = -np.expm1(-max(speed[n], 1e-4) / RATE / p.memory_length)
        last += step * (made[n - 1] - last)  # of the interval before
        friction[n] = last
    return friction


def friction_wanted(rendering, position):
    return np.gradient(rendering.waveform(np.zeros(len(position)), position), 1 / RATE)


def error_of(friction, wanted):
    return np.std((friction - wanted)[LATE]) / np.std(wanted[LATE])


def test_a_board_plays_a_screen(program, tmp_path, library):
    """The envelope that it streams makes friction as near to the texture as the library's law does in open loop."""
    with SteppedBoard(tmp_path, program=program) as board:
        driver = board.driver()
        recording = hr.render(SCREEN, driver=driver)
        assert (driver.device_kind, driver.drive_channels, driver.sensed_channels) == ("electroadhesion", 1, 0)
    root = library[0].shape
    drive, position = recording.drive[:, 0], recording.read("position")
    position[: np.argmax(np.isfinite(position))] = position[np.isfinite(position)][
        0
    ]  # it is sent once the run has begun
    assert not recording.read("flags").any()
    assert recording.header.motion_source == "unknown"
    # from rest to the bias without a step of more than the fade of 10 ms makes
    assert abs(np.diff(drive[: int(0.01 * RATE)])).max() < 1.1 * float(root(0.0)) / (0.01 * RATE) + 1e-6
    found, wanted = friction_of(drive, position, root), friction_wanted(library[0], position)
    time = np.arange(len(position)) / RATE
    exact, ahead = FINGER.position(time), driver.capabilities.lookahead / RATE
    waveform = library[0].waveform(time, FINGER.position(time + ahead))
    attraction = library[1]().run(np.zeros((len(time), 0)), exact, waveform)[0][:-1, 0]
    own = friction_of(np.r_[0.0, root(attraction)], exact, root), friction_wanted(library[0], exact)
    assert error_of(found, wanted) < 1.2 * error_of(*own)
    assert abs(recording.read("target")[LATE, 0]).max() == pytest.approx(wanted[LATE].max(), rel=0.02)


def streamed(board, rendering):
    """Client whose screen plays ridges, and streams."""
    client = board.client().open()
    texture = BoardTexture(rendering.scene.texture, client.capabilities, rendering.model, rendering.waveform_of)
    client.set_bands(Bands.none(spatial=False), texture)
    return client


def test_its_limits_are_those_of_the_carrier(program, tmp_path, library):
    """A peak is cut to, and flagged; a mean square stops; none may be above the design's."""
    with SteppedBoard(tmp_path, program=program) as board:
        client = streamed(board, library[0])
        most = client.capabilities.drive_limit
        root, limit = library[0].shape, library[0].model.drive_limit
        assert most == pytest.approx(float(root(limit)), rel=1e-6)
        with pytest.raises(ValueError, match="LIMITS: refused by the board: value"):
            client.limits(1.01 * most)
        with pytest.raises(ValueError, match="COMMIT: refused by the board: value"):
            client.set_bands(tones(47.0))
        bias = float(root(0.0))
        client.limits(0.9 * bias)
        client.start(stream=1)
        board.run(client, 0.3)
        rows = client.rows()
        assert rows[-1, 0] == pytest.approx(0.9 * bias, rel=1e-6)
        assert int(rows[-1, -1]) & hr.Flag.SATURATED
        client.limits(most, 0.5 * bias, 0.05)
        with pytest.raises(DeviceFault, match="the mean square of the drive is above its limit"):
            board.run(client, 0.3)
        board.assert_at_rest()


def test_it_is_at_rest_where_the_host_is_silent(program, tmp_path, library):
    with SteppedBoard(tmp_path, program=program) as board:
        client = streamed(board, library[0])
        client.start()
        board.run(client, 0.2)
        silent = board.sample
        board.sleep(0.2)
        log = board.board.log()
    assert [int(line[3]) for line in log if line[1:3] == ["state", "0"]][-1] == Cause.SILENCE
    (zero,) = [int(line[0]) for line in log if line[1:3] == ["drives", "0"]][-1:]
    assert 0.08 * RATE < zero - silent <= 0.09 * RATE + 2


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            {"device": "ultrasonic", "profile": {}},
            "'ultrasonic': no board plays it: its drive is .*rate, 192 kHz .*: play it",
        ),
        (
            {"device": "hybrid", "profile": {}},
            "'hybrid': no board plays it: it takes two laws, .*: play .*, or its plate alone",
        ),
        (
            {"rendering": {"square_root": "off"}},
            "square_root = 'off': must be 'on' on a board, which puts out the carrier's",
        ),
        (
            {"rendering": {"output": "carrier"}},
            "output = 'carrier': must be 'envelope' on a board, which puts out the carri",
        ),
        ({"method": "h2"}, "method = 'h2': a board plays \"inverse\" only"),
    ],
)
def test_what_no_board_plays_is_refused(tmp_path, change, problem):
    with pytest.raises(ValueError, match=problem):
        export(hr.prepare(replace(SCREEN, **change)), tmp_path)


@pytest.mark.parametrize(
    ("scene", "problem"),
    [
        (
            SCENE,
            "device = 'vt-plate': .*has the law of 'electroadhesion' on it: export this scene to it, or take another",
        ),
        (replace(SCREEN, rendering={"square_root": "off"}), "square_root = 'off': must be 'on' on a board"),
    ],
    ids=["plate", "square root off"],
)
def test_other_devices_are_refused_by_a_screens_board(program, tmp_path, scene, problem):
    refused = pytest.raises(ValueError, match=problem)
    with SteppedBoard(tmp_path, program=program) as board, refused:
        hr.render(scene, driver=board.driver())


def test_a_profiles_mean_square_reaches_the_board_and_targets_know_no_blocks(program, tmp_path, library):
    """The board's is that of the carrier's peak, twice that of the carrier; one that touches has no speed."""
    limited = hr.prepare(replace(SCREEN, texture=0.5 * RIDGES, limits={"rms_drive": 0.7e-3, "rms_time": 0.5}))
    position = np.r_[np.linspace(0.0, 1e-3, 50), np.full(10, np.nan), np.linspace(2e-3, 3e-3, 40)]
    with SteppedBoard(tmp_path, program=program) as board:
        driver = board.driver()
        with driver:
            sent = []
            driver.client.limits = lambda *values: sent.append(values)
            driver.protect(limited)
            assert sent[0][1:3] == (pytest.approx(np.sqrt(2.0) * 0.7e-3), 0.5)
            whole = driver._targets(library[0], position)
            driver._last = np.full(1, np.nan)
            split = [driver._targets(library[0], part) for part in np.split(position, [25, 55, 70])]
    np.testing.assert_array_equal(np.concatenate(split), whole)
    assert np.isfinite(whole).all()
    assert whole[25:49].all()
    assert not whole[50:61].any()
