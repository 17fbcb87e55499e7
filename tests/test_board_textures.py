"""Textures that are no sum of bands on a board: recordings in time and along the surface, and hosts that are late."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from board import (
    FINGER,
    RATE,
    ROOT,
    SANITISED,
    SCENE,
    Faults,
    SteppedBoard,
    program_of,
    sensed_error,
    simulated_as,
    tones,
)
from waves import Own

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.drivers import protocol
from hapticrender.drivers.board_line import FINGER_PERIOD
from hapticrender.drivers.board_texture import AHEAD, BLEND, COARSE, LIFTED, ROWS, SPARE, BoardTexture
from hapticrender.drivers.protocol import Cause, Kind, Reason, State
from hapticrender.errors import DriverError, WatchdogTimeout
from hapticrender.mathx import smoothstep

NOISE = np.random.default_rng(3).standard_normal(20_000)
RECORDED = {"samples": NOISE, "rate": 5000.0, "gain": 4e-6, "passband": (20.0, 400.0)}
MODEL = hr.prepare(SCENE).model
NO_BANDS = Bands.none(spatial=False)


def sine(wavelength):
    """A sine along the surface."""
    return Own(lambda time, position: 5e-6 * np.sin(2 * np.pi * position / wavelength), spatial=True)


def two_tones(time, position=None):
    """They never repeat within a run: a sample of another moment is another."""
    return 4e-6 * np.sin(2 * np.pi * 70.0 * time) + 4e-6 * np.sin(2 * np.pi * 70.0 * np.sqrt(2.0) * time)


@pytest.fixture
def stepped(tmp_path):
    with SteppedBoard(tmp_path, "--noise", "1e-8") as board:
        yield board


CHIRP = hr.Chirp(start=40.0, stop=300.0, duration=1.0, amplitude=3e-6)
SMALL = "-DTEXTURE_RING=1024u", "-DTEXTURE_POINTS=2048u"


@pytest.mark.parametrize(
    ("texture", "sizes"),
    [
        (hr.Recorded(**RECORDED), ()),
        (hr.Recorded(**RECORDED, speed=0.08), ()),
        (hr.Recorded(**RECORDED, speed=0.3) + CHIRP, SMALL),
    ],
    ids=["time", "surface", "both, in a small memory"],
)
def test_a_recording_on_the_board_is_as_good_as_on_the_simulated_device(tmp_path, texture, sizes):
    """Under a finger that moves as the board says it did; sanitisers on; both plates have their own noise."""
    scene = replace(SCENE, texture=texture, duration=1.5)
    with SteppedBoard(tmp_path, "--noise", "1e-7", program=program_of(*SANITISED, *sizes)) as board:
        played = hr.render(scene, driver=board.driver(finger=FINGER))
    assert sensed_error(played) < 1.2 * sensed_error(simulated_as(played, scene, 1e-7))
    assert not played.read("flags").any()


def streaming(board, texture):
    """Client whose board plays a texture and streams every sample."""
    client = board.client().open()
    found = BoardTexture(texture, client.capabilities, MODEL)
    client.set_bands(NO_BANDS, found)
    client.start(stream=1)
    return client, found


def motion_of(rows):
    return rows[:, 2:4].mean(axis=1)


def test_a_board_that_starves_fades_out_and_plays_nothing_stale(stepped):
    """The host sends nothing for a second, half a second more than it had sent ahead, then goes on."""
    client, texture = streaming(stepped, Own(two_tones))
    stepped.run(client, 0.4)
    texture.samples, samples = lambda now, finger: None, texture.samples
    last = texture.written
    stepped.run(client, 1.0)
    texture.samples = samples
    stepped.run(client, 1.2)
    rows = client.rows(int(2.5 * RATE))
    n = np.arange(len(rows))
    ahead, fade = client.capabilities.lookahead, 0.04 * RATE
    starved = np.flatnonzero(rows[:, -1].astype(int) & hr.Flag.OVERRUN)
    # its reference lies `ahead` samples ahead; flagged from where fewer than a fade's samples are left, to the recovery
    assert starved[0] == last - ahead - fade + 1
    assert (np.diff(starved) == 1).all()
    back = starved[-1] + 1 - fade + ahead  # where the first late samples came, rising from 0
    # a frame in a step of at most 7.5 ms makes up for the half second
    assert last + 0.4 * RATE < back < (1.41 + 0.5 / (ROWS / (0.0075 * RATE) - 1.0)) * RATE
    weight = smoothstep((last - n) / fade) + smoothstep((n - back) / fade)
    expected = weight * two_tones(n / RATE)
    late = n > 0.3 * RATE  # after the fade-in, and what is learned of the free plate
    silent = (n > last + 0.05 * RATE) & (n < back)
    # edges of the fades are followed as any texture; sensors of 14 bits, 0.12 um a step, two of them: 0.025 um rms
    assert np.sqrt(np.mean((motion_of(rows) - expected)[late] ** 2)) < 0.03 * 4e-6
    assert np.sqrt(np.mean(motion_of(rows)[silent] ** 2)) < 0.03 * 4e-6


def test_only_what_was_sent_plays(stepped):
    """A point lost or changed on its way, samples out of order or too many: refused, and what plays goes on."""
    client, texture = streaming(stepped, Own(two_tones))
    line = client._line
    never_described = protocol.pack(Kind.PLAY, 0)
    assert line.request(Kind.PLAY, never_described).refused == Reason.STATE
    frames = list(BoardTexture(sine(2e-3), client.capabilities, MODEL).frames(200, 0.0, LIFTED))
    (_, described), *points, play = frames
    line.send(Kind.TEXTURE, described)
    for kind, payload in points[:-1]:
        line.send(kind, payload)
    assert line.request(*play).refused == Reason.STATE
    kind, payload = points[-1]
    assert line.request(kind, payload + payload[-2:]).refused == Reason.STATE
    line.send(kind, payload[:-2] + bytes([payload[-2] ^ 1]) + payload[-1:])
    assert line.request(*play).refused == Reason.DIGEST
    number, scale = texture._number, 1e-9
    for index, first in ((number, texture.written + 1), (number + 1, texture.written)):
        samples = protocol.pack(Kind.SAMPLES, index, first, scale) + bytes(2)
        assert line.request(Kind.SAMPLES, samples).refused == Reason.STATE
    sent = texture.written
    while texture.written < sent + client.capabilities.ring:
        head = protocol.pack(Kind.SAMPLES, number, texture.written, scale)
        if line.request(Kind.SAMPLES, head + bytes(2 * ROWS)).refused == Reason.STATE:
            break
        texture.written += ROWS
    # 0.5 s are held, and up to a frame more; what plays meanwhile makes room
    assert 0 < texture.written - sent < client.capabilities.ring - (AHEAD - 0.1) * RATE
    with pytest.raises(DriverError, match="TEXTURE: refused by the board: length"):
        line.send(Kind.TEXTURE, described[:-1])
    with pytest.raises(ValueError, match="TEXTURE: refused by the board: value"):
        line.send(Kind.TEXTURE, protocol.pack(Kind.TEXTURE, 1, 0, 8193, 0.0, 1e-5, 1e-9))
    rows = client.rows(int(0.3 * RATE))
    assert client.telemetry().state == State.PLAYING
    assert not rows[:, -1].any()


def test_a_line_that_damages_bytes_plays_no_other_sample(stepped):
    """1 byte of 1000, 14 % of the frames of samples; what is sent again may come too late, which is flagged."""
    client, _ = streaming(stepped, Own(two_tones))
    stepped.damage = Faults(11, 0.001)
    stepped.run(client, 3.0)
    stepped.damage = lambda data: data
    stepped.run(client, 0.1)
    rows = client.rows(int(2.9 * RATE))
    whole = (rows[:, -1] == 0.0) & (np.arange(len(rows)) > 0.3 * RATE)
    expected = two_tones(np.arange(len(rows)) / RATE)
    assert client.telemetry().bad > 30
    # eight rows in a frame of 253 bytes: 0.998^253 = 0.6 come, half of them at least in time
    assert np.mean(whole) > 0.3
    assert np.sqrt(np.mean((motion_of(rows) - expected)[whole] ** 2)) < 0.03 * 4e-6


def test_a_board_that_was_reset_begins_its_texture_anew(tmp_path):
    with SteppedBoard(tmp_path, "--noise", "1e-8") as board:
        client = board.client(reconnect=5.0).open()
        client.set_bands(NO_BANDS, BoardTexture(Own(two_tones), client.capabilities, MODEL))
        client.start(stream=1)
        board.run(client, 0.2)
        board.reset()
        while not client.reconnections:
            board.run(client, 0.01)
        board.run(client, 1.0)
        rows = client.rows()
    begins = np.flatnonzero(rows[:, -1].astype(int) & hr.Flag.OVERRUN)[0]  # some before it are lost
    assert 0.15 * RATE < begins < 0.25 * RATE
    rows = rows[begins : begins + int(0.9 * RATE)]
    late = np.arange(int(0.3 * RATE), len(rows))
    expected = two_tones(late / RATE)
    assert np.sqrt(np.mean((motion_of(rows)[late] - expected) ** 2)) < 0.03 * 4e-6  # as where it starves
    assert not rows[1:, -1].any()


def test_what_the_samples_take_of_the_line_is_what_the_page_says(stepped):
    client, _ = streaming(stepped, hr.Recorded(**RECORDED))
    stepped.run(client, 0.2)
    before = client._line.sent_bytes
    stepped.run(client, 2.0)
    # a frame more or less in two seconds; signs of life come up to 1 ms late, as a command is waited for in between
    assert (client._line.sent_bytes - before) / 2.0 - 1900 == pytest.approx(11_600, abs=74 + 0.1 * 1900)
    assert "| 11 600 |" in (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")


WAVELENGTH, HERTZ, SPEED = 1e-3, 70.0, 0.05  # m, Hz, m/s
STEP, PERIOD = 1e-3, 0.01  # s: of the line below; between two settings of the finger


def wandering(time, position):
    """Ridges that wander: a function of time and position at once."""
    return 4e-6 * np.sin(2 * np.pi * (HERTZ * time + np.nan_to_num(position) / WAVELENGTH))


def turning(time):
    """Position (m) of a finger that turns after 0.8 s."""
    return SPEED * (0.3 - abs(time - 0.8))


def slid(board, texture, seconds):
    """Rows of a board whose finger turns, position (m) and time (s) of each, and the texture."""
    (client, found), due = streaming(board, texture), 0.0
    while board.time < seconds:
        if board.time >= due:
            velocity = turning(board.time + 1e-6) - turning(board.time)
            client.finger(turning(board.time), 1e6 * velocity, 0.4)
            due = board.time + PERIOD
        client.step()
        board.sleep(STEP)
    rows = client.rows()
    clock = board.time - (board.sample - client.started - np.arange(len(rows))) / RATE
    return rows, turning(clock), clock, found


def test_a_texture_in_time_and_place_at_once_is_that_of_where_the_finger_is(stepped):
    """Both sides: while the finger goes on as it did, and late where it turns; and never a step."""
    rows, position, clock, found = slid(stepped, Own(wandering), 1.6)
    texture = wandering(np.arange(len(rows)) / RATE, position)
    off = abs(rows[:, 6] - texture)
    # the clocks are known to half the step between sending a frame and reading its reply
    known = 4e-6 * 2 * np.pi * SPEED / WAVELENGTH * STEP / 2
    # until it is set, which may wait for a frame that is under way, and sent; until its frame is there; then the fade
    late = PERIOD + STEP + FINGER_PERIOD + STEP + (found._late + SPARE + found.lookahead + BLEND) / RATE
    turns = (clock > 0.8) & (clock < 0.8 + late)
    assert off[(clock > 0.3) & ~turns].max() < known
    assert off[turns].max() > 4e-6 / 2
    steepest = 4e-6 * (2 * np.pi * (HERTZ + SPEED / WAVELENGTH) / RATE + 2 * 1.5 / BLEND)
    assert abs(np.diff(rows[:, 6])).max() < steepest
    assert not rows[:, -1].any()


def test_it_is_silent_where_no_finger_is(stepped):
    """Where it says that it lies along the surface: before the finger touches, and 0.2 s after it was last set."""
    client, _ = streaming(stepped, Own(wandering, spatial=True, bands=Bands.none(spatial=True)))
    stepped.run(client, 0.2)
    client.finger(0.01, 0.0, 0.4)
    stepped.run(client, 0.6)
    reference = client.rows()[:, 6]
    assert not reference[: int(0.2 * RATE)].any()
    assert abs(reference[int(0.25 * RATE) : int(0.35 * RATE)]).max() > 3.9e-6
    assert not reference[int((0.2 + 0.2 + 0.01) * RATE) :].any()


def test_samples_replace_those_that_have_not_been_played(stepped):
    """As far back as the ring holds them: what is past stays so, and all others are as they were."""
    client, texture = streaming(stepped, Own(two_tones))
    stepped.run(client, 0.1)
    line, number = client._line, texture._number
    texture.samples = lambda now, finger: None

    def send(first, count=ROWS):
        head = protocol.pack(Kind.SAMPLES, number, first % 2**32, 1e-9)
        return line.request(Kind.SAMPLES, head + np.full(count, 1000, "<i2").tobytes())

    while texture.written < client.capabilities.ring:
        line.send(Kind.SAMPLES, BoardTexture.samples(texture, stepped.time + 1.0, LIFTED))
        texture.taken()
    written = texture.written
    assert send(written + 1).refused == Reason.STATE
    assert send(written - client.capabilities.ring - 1).refused == Reason.STATE
    assert send(written - client.capabilities.ring).refused is None  # its first ones, which are past
    assert send(1000).refused is None
    stepped.run(client, 0.2)
    middle = stepped.sample - client.started - 30  # some of them are past
    assert send(middle).refused is None
    stepped.run(client, written / RATE - 0.3)
    played = np.arange(300, written - 250)  # between its fades
    reference, expected = client.rows()[played, 6], two_tones(played / RATE)
    expected[1000 - 300 : 1000 - 300 + ROWS] = 1e-6
    changed = played[abs(reference - expected) > 1e-9]  # the rest of i16
    assert 0 < len(changed) <= ROWS - 30 + line.capabilities.lookahead
    assert middle <= changed[0]
    assert (np.diff(changed) == 1).all()
    np.testing.assert_allclose(reference[changed - 300], 1e-6, rtol=1e-6)


def test_a_texture_that_differs_when_it_is_read_again_is_refused(stepped):
    draws = np.random.default_rng(1)
    noisy = Own(lambda time, position: 1e-6 * draws.standard_normal(len(time)) + 0.0 * position)
    with pytest.raises(ValueError, match="Own: must not change with a reading"):
        BoardTexture(noisy, stepped.client().open().capabilities, MODEL)


def test_textures_fade_into_each_other(stepped):
    """From time to the surface, to bands and back, without a step: a jump of either texture would be 4 um and more."""
    client, _ = streaming(stepped, Own(two_tones))
    surface = BoardTexture(sine(2e-3), client.capabilities, MODEL)
    changes = [
        lambda: None,
        lambda: client.set_bands(NO_BANDS, surface),
        lambda: client.set_bands(tones(60.0, amplitude=4e-6)),
        lambda: client.set_bands(NO_BANDS, BoardTexture(Own(two_tones), client.capabilities, MODEL)),
    ]
    for change in changes:
        change()
        for _ in range(8):
            client.finger(0.0005, 0.0, 0.4)  # a quarter of the wavelength
            stepped.run(client, 0.05)
    rows = client.rows(int(1.5 * RATE))
    # tones up to 100 Hz of 8 um: 1 um a sample, its half for what the sum of two fading textures adds
    assert abs(np.diff(motion_of(rows)))[int(0.2 * RATE) :].max() < 1.5e-6
    assert not rows[:, -1].any()
    client.finger(0.0005, 0.0, 0.4)
    assert client.telemetry().state == State.PLAYING


def test_a_table_is_as_fine_as_it_has_to_be(stepped):
    """Cubic interpolation at x = 0.382 between points of distance h has the response sum w_j e^(i k h (j - x))."""
    found = stepped.client().open().capabilities
    reach = 0.055 + 2e-3  # of the plate's glass
    places, x = np.arange(-1, 3), 0.382
    weights = np.array([np.prod([(x - other) / (own - other) for other in places if other != own]) for own in places])
    turns = np.linspace(1.0, 2.5, 15_001)
    error = abs(np.exp(1j * np.multiply.outer(turns, places - x)) @ weights - 1.0)
    finest = 2 * np.pi * (2 * reach / (found.points - 1)) / turns[np.argmin(abs(error - COARSE))]
    assert len(BoardTexture(sine(1.02 * finest), found, MODEL)._table) == found.points
    with pytest.raises(ValueError, match=r"texture Own: 8192 points, 13.9 um apart, are .* % off it: must be <= 10 %"):
        BoardTexture(sine(finest / 1.02), found, MODEL)
    assert len(BoardTexture(sine(5e-3), found, MODEL)._table) < found.points


def test_a_force_and_carriers_are_refused(stepped):
    screen = replace(SCENE, texture=hr.Grating(velocity=8e-3, frequency=80.0), device="electroadhesion")
    with pytest.raises(ValueError, match=r"device = 'electroadhesion': .*has the law of 'vt-plate' on it: export"):
        hr.render(screen, driver=stepped.driver())
    scene = replace(SCENE, texture=hr.Recorded(**RECORDED, carriers=4), duration=0.1)
    with pytest.raises(ValueError, match="carriers = 4: must be left out on a board"):
        hr.render(scene, driver=stepped.driver())


@pytest.mark.parametrize(("beats", "stops"), [(True, False), (False, True)])
def test_the_board_stops_without_a_beat_of_the_application(stepped, beats, stops):
    """The service goes on: fingers and signs of life, but none of them from the application."""
    client, _ = streaming(stepped, Own(two_tones))
    client.watch(0.1)
    stepped.run(client, 0.02)
    start = stepped.sample
    with pytest.raises(WatchdogTimeout) if stops else nullcontext():
        for _ in range(6):
            if beats:
                client.beat()
            client.finger(0.0, 0.0, 0.4)
            stepped.run(client, 0.05)
    if not stops:
        assert client.telemetry().state == State.PLAYING
        return
    assert client._line.telemetry.cause == Cause.APPLICATION
    (stopped,) = [int(line[0]) for line in stepped.board.log() if line[1:3] == ["state", "0"]]
    # 0.1 s and the fade of 10 ms, from a beat that came in the 20 ms before `start`
    assert 0.090 * RATE <= stopped - start <= 0.110 * RATE + 2
    assert stepped.board.log()[-1][1:] == ["drives", "0"]


@pytest.mark.parametrize("wrong", [0.049, 66.0, -1.0, np.nan])
def test_a_watchdog_that_no_board_can_count_is_refused(stepped, wrong):
    client = stepped.client().open()
    for right in (0.05, 65.0, None):
        client.watch(right)
    with pytest.raises(ValueError, match="must be 0.05 to 65 s on a board, or None"):
        client.watch(wrong)
