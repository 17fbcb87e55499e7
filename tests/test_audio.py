"""Sound cards without one: channels, full scale, numbered blocks, the choice of a card, and the measured delay."""

import ctypes
import tomllib
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.devices import open_driver
from hapticrender.drivers import portaudio
from hapticrender.drivers.audio import AudioDriver
from hapticrender.drivers.audio_callback import AHEAD, LOST, SLOTS, BlockQueue, Relay
from hapticrender.errors import DeviceNotFound, DriverError
from hapticrender.latency import Latency, Trip, find_trip, measure_latency, write_delay
from hapticrender.protocols import Flag, Sensed

BLOCK = 16
POINTER, LONG = ctypes.c_void_p, ctypes.c_ulong
CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, POINTER, LONG, POINTER, LONG, POINTER)


def called(address, user_data, given, width, frames=BLOCK, status=0):
    """What the callback plays on `width` channels when `given` is sensed."""
    played = np.full((frames, width), np.nan, np.float32)
    into = None if given is None else given.ctypes.data
    assert CALLBACK(address)(into, played.ctypes.data, frames, None, status, user_data) == 0
    return played


@pytest.fixture
def mirror():
    """A function for the callback that plays what it senses, and counts its calls in its argument."""
    calls = np.zeros(1, np.int64)

    @CALLBACK
    def function(sensed, drive, frames, time, status, argument):
        ctypes.memmove(drive, sensed, 8 * frames)
        calls[0] += 1
        return 0

    return function, ctypes.cast(function, POINTER).value, calls


def test_the_callback_uses_the_channels_that_it_is_told(mirror, rng):
    """Sensors 1 and 2 are inputs 3 and 2, the drives outputs 2 and 4; the other outputs get zeros."""
    relay = Relay((2, 1), (1, 3), BLOCK)
    given = rng.uniform(-1, 1, (BLOCK, 3)).astype(np.float32)
    relay.call(mirror[1], 0)
    played = called(relay.address, relay.user_data, given, 4)
    np.testing.assert_array_equal(played[:, [1, 3]], given[:, [2, 1]])
    np.testing.assert_array_equal(played[:, [0, 2]], 0.0)


def test_no_more_than_full_scale_is_played(mirror):
    relay = Relay((0, 1), (0, 1), BLOCK)
    given = np.zeros((BLOCK, 2), np.float32)
    given[:4, 0] = 1.0, 1.0 + 1e-6, -3.0, np.nan
    relay.call(mirror[1], 0)
    played = called(relay.address, relay.user_data, given, 2)
    np.testing.assert_array_equal(played[:5, 0], [1.0, 1.0, -1.0, 0.0, 0.0])
    assert relay.count("clipped") == 3


def test_without_a_function_and_in_odd_calls_it_plays_zeros(mirror):
    relay = Relay((0, 1), (0, 1), BLOCK)
    given = np.ones((2 * BLOCK, 2), np.float32)
    assert (called(relay.address, relay.user_data, given, 2) == 0).all()
    relay.call(mirror[1], 0)
    assert (called(relay.address, relay.user_data, given, 2) == 1).all()
    assert (called(relay.address, relay.user_data, given, 2, frames=BLOCK - 1) == 0).all()
    assert (called(relay.address, relay.user_data, None, 2) == 1).all()  # no input: what was last sensed
    relay.rest()
    assert (called(relay.address, relay.user_data, given, 2, status=LOST) == 0).all()
    assert [relay.count(name) for name in ("calls", "blocks", "overruns")] == [5, 2, 0]
    assert mirror[2] == 2


def exchanged(queue, number, given=None, status=0):
    given = np.full((BLOCK, 2), number, np.float32) if given is None else given
    return called(queue.address, queue.user_data, given, 2, status=status)[0, 0]


def test_a_block_is_played_in_its_turn_or_not_at_all():
    """Numbers 2 and 3 in time, 4 too late, 5 in time; and what was sensed meanwhile."""
    queue = BlockQueue(BLOCK, 2, 2)
    queue.put(AHEAD, np.full((BLOCK, 2), 0.2))
    queue.put(AHEAD + 1, np.full((BLOCK, 2), 0.3))
    assert [exchanged(queue, n) for n in range(5)] == pytest.approx([0, 0, 0.2, 0.3, 0], abs=1e-7)
    queue.put(AHEAD + 2, np.full((BLOCK, 2), 0.4))
    queue.put(AHEAD + 3, np.full((BLOCK, 2), 0.5))
    assert exchanged(queue, 5) == pytest.approx(0.5, abs=1e-7)
    assert [queue.take(n)[0][0, 1] for n in range(6)] == list(range(6))
    late = [queue.take(n)[1] for n in range(6)]
    assert late == [0, 0, 0, 0, Flag.OVERRUN, 0]


@pytest.mark.parametrize("bit", [1, 2, 4, 8])
def test_what_the_card_loses_is_flagged_and_counted(mirror, bit):
    queue, relay = BlockQueue(BLOCK, 2, 2), Relay((0, 1), (0, 1), BLOCK)
    exchanged(queue, 0, status=bit)
    exchanged(queue, 1, status=16)  # output is being primed: nothing is lost
    assert [queue.take(n)[1] for n in (0, 1)] == [Flag.OVERRUN, 0]
    relay.call(mirror[1], 0)
    for status in (bit, 16, 0):
        called(relay.address, relay.user_data, np.zeros((BLOCK, 2), np.float32), 2, status=status)
    assert relay.count("overruns") == 1


def test_slots_are_used_again(rng):
    queue = BlockQueue(BLOCK, 2, 2)
    drive = rng.uniform(-1, 1, 5 * SLOTS)
    for number, value in enumerate(drive):
        queue.put(number + AHEAD, np.full((BLOCK, 2), value))
        played = exchanged(queue, number)
        assert played == (np.float32(drive[number - AHEAD]) if number >= AHEAD else 0)


def card(index, name, host="ALSA", inputs=2, outputs=2):
    return portaudio.Card(index, name, host, inputs, outputs, 48e3, (0.005, 0.02), (0.006, 0.03))


CARDS = [card(0, "USB Audio"), card(1, "USB Audio Pro"), card(2, "Scarlett 2i2", "JACK"), card(3, "Scarlett 2i2")]


@pytest.mark.parametrize(("device", "index"), [(1, 1), ("pro", 1), ("usb audio", 0), ("scarlett jack", 2), (3, 3)])
def test_a_card_is_found_by_its_index_or_its_words(device, index):
    assert portaudio.chosen(CARDS, device) is CARDS[index]


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("scarlett", "device 'scarlett': 2 cards fit: 2 Scarlett 2i2 .*JACK.*; 3 Scarlett 2i2 "),
        ("focusrite", "device 'focusrite': 0 cards fit: 0 USB Audio .*; 3 Scarlett"),
        (7, "device 7: 0 cards fit: 0 USB"),
        (-1, "no default output: 0 USB"),
    ],
)
def test_a_card_that_is_not_there_is_refused_with_those_that_are(device, message):
    with pytest.raises(DeviceNotFound, match=message):
        portaudio.chosen(CARDS, device)
    with pytest.raises(DeviceNotFound, match="there is no sound card"):
        portaudio.chosen([], device)


def test_without_portaudio_it_is_said_how_to_get_it(monkeypatch):
    """Nor with a library that is something else."""
    portaudio.load.cache_clear()
    try:
        monkeypatch.setattr(portaudio, "find_library", lambda name: None)
        with pytest.raises(DeviceNotFound, match="PortAudio is not installed; to get it: .*apt install libportaudio2"):
            AudioDriver().open()
        monkeypatch.setattr(portaudio, "find_library", lambda name: "libc.so.6")
        with pytest.raises(DeviceNotFound, match="libc.so.6 is no PortAudio that can be used.*Pa_GetVersion"):
            AudioDriver("0").open()
    finally:
        portaudio.load.cache_clear()


def test_the_delay_is_the_cards_and_that_of_play():
    """Rounded to the nearest sample; the callback has no more than the card's."""
    driver = AudioDriver("0", delay=143.5, sensed_per_full_scale=1e-3)
    assert (driver.delay, driver.sensed_channels) == (144 + driver.host_delay, 2)
    live = driver.live()
    assert live.play_delay == driver.delay
    assert (live.delay, live.sensed_channels, live.sensed_scale, live.drive_scale) == (144, 2, 1e-3, 1 / 3)
    assert AudioDriver("0", delay=143.4, sensed_per_full_scale=1e-3).live().delay == 143
    assert AudioDriver("0", delay=64, sensed_per_full_scale=1e-3).live().delay == 64


@pytest.mark.parametrize("identified", [100, 128, 130])
def test_a_profiles_delay_is_without_what_play_queues(identified):
    """The loop is designed for the longer one of what is stated and what was identified, as the card has it."""
    driver = AudioDriver("0", delay=128, sensed_per_full_scale=1e-3)
    texture = hr.Grating(frequency=60.0, amplitude=1e-5)
    scene = hr.Scene(texture=texture, profile={"rate": 48e3, "delay": identified}, duration=0.1)
    models = [hr.prepare(scene, driver=each, compiled=False).model for each in (driver, driver.live())]
    assert [each.delay for each in models] == [max(identified, 128) + driver.host_delay, max(identified, 128)]


HYBRID = {
    "kind": "hybrid",
    "calibration": {"drive_per_full_scale": [2, 2, 0.02], "sensed_per_full_scale": [1e-3, 1e-3, 4], "delay": 128},
}


def test_block_and_rate_are_options_of_the_text():
    """The advice names them too, quoted for a shell: a delay is that of a block and a rate."""
    driver = open_driver("audio:usb?block=256&rate=44100&channels=3,4&latency=high&sensed_channels=1,&delay=300.5")
    assert (driver.device, driver.block, driver.rate, driver.latency) == ("usb", 256, 44_100, "high")
    assert (driver.channels, driver.inputs, driver.live().delay) == ((3, 4), (1,), 301)
    assert str(driver) == "audio:usb?block=256&rate=44100"
    with pytest.raises(DriverError, match="delay and sensed_per_full_scale.*, and give sensed_per_full_scale; or"):
        AudioDriver("0", (1, 2), (1, 2)).check_calibrated()
    late = open_driver("audio:usb?block=256&rate=44100&sensed_per_full_scale=0.001")
    with pytest.raises(DriverError, match=r"`hapticrender latency --driver 'audio:usb\?block=256&rate=44100' --out"):
        late.check_calibrated()
    profile = hr.DeviceProfile(kind="vt-plate", calibration={"drive_per_full_scale": 2.0})
    assert open_driver("audio:0?drive_per_full_scale=1.5", profile).drive_limit == 1.5
    for text in ("", "&drive_per_full_scale=3,3,0.01"):
        driver = open_driver(f"audio:0?channels=1,2,3&sensed_channels=1,2,3{text}", hr.DeviceProfile(**HYBRID))
        np.testing.assert_allclose(driver.drive_scale, [1 / 3, 1 / 3, 100.0] if text else [0.5, 0.5, 50.0])
        assert (driver.sensed_scale.tolist(), driver.drive_limit) == ([1e-3, 1e-3, 4.0], 0.01 if text else 0.02)
    assert str(open_driver("audio:0?block=64")) == "audio:0"
    assert open_driver("audio:0?channels=1").channels == (1,)
    for options, refused in (
        ("blok=64", "option 'blok': must be one of channels, sensed_channels"),
        ("latency=-1", r"latency=-1: must be 'low', 'high' or 0 to 10 s"),
        ("latency=nan", "latency='nan': must be"),
        ("latency=True", "latency=True: must be"),
        ("latency=0.1,", r"latency=\(0.1,\): must be"),
        ("block=many", "block='many' must be a whole number >= 1"),
        ("channels=0", r"channels=0: must be different whole numbers >= 1"),
        ("drive_per_full_scale=3,3,3", "drive_per_full_scale = .3, 3, 3.: must be a number, or a list of 2"),
        ("drive_per_full_scale=3,0", r"drive_per_full_scale\[1\] = 0: must be a finite number > 0"),
    ):
        with pytest.raises(ValueError, match=refused):
            open_driver(f"audio:0?{options}")


@pytest.mark.parametrize(
    ("known", "unknown"), [({"sensed_per_full_scale": 1e-3}, "delay"), ({"delay": 128.0}, "sensed_per_full_scale")]
)
def test_no_loop_is_closed_with_what_is_unknown(known, unknown):
    """Without sensed channels there is no loop, and nothing has to be known; one of two numbers asks for one."""
    assert AudioDriver("0", sensed_channels=(), **known).sensed_channels == AudioDriver("0").sensed_channels == 0
    profile = hr.DeviceProfile(kind="vt-plate", calibration=known)
    chosen = AudioDriver("0", (3, 4), (5, 6), **known)
    cables = {chosen: "3 to input 5", chosen.live(): "3 to input 5", open_driver("audio:0", profile): "1 to input 1"}
    for driver, cable in cables.items():
        cure = f"connect output {cable}.*`hapticrender latency --driver audio:0" if unknown == "delay" else "give it"
        message = f"audio:0: {unknown}.* is unknown.*: {cure}"
        with pytest.raises(DriverError, match=message):
            driver.open()
        with pytest.raises(DriverError, match=message):  # and before anything is designed for a delay that is none
            hr.prepare(hr.Scene(texture=hr.Grating(frequency=60.0, amplitude=1e-5), duration=0.1), driver=driver)
    scene = hr.Scene(texture=hr.Grating(frequency=60.0, amplitude=1e-5), duration=0.1, calibration=known)
    with pytest.raises(DriverError, match=message):
        hr.render(scene, driver="audio:0")
    with hr.Player(scene, driver="audio:0") as player, pytest.raises(DriverError, match=message):
        player.play(scene.texture)


def test_a_driver_that_is_not_open_plays_nothing():
    driver = AudioDriver("0")
    with pytest.raises(DriverError, match="audio:0: play: it is new, not open"):
        driver.play(np.zeros((64, 2)))
    with pytest.raises(DriverError, match="audio:0: start: it is new"):
        driver.live().start(None)
    driver.close()
    driver.close()
    with pytest.raises(DriverError, match="it has been closed; make a new one"):
        driver.open()


class Cable:
    """A driver whose input is its output, `trips` samples later, one figure an open after the other.

    The runs `losing` lose every second sample, or the whole block number `gap` alone.
    """

    rate, block, delay, drive_channels, sensed_channels = 48e3, 64, 64, 2, 1

    def __init__(self, *trips, gain=-0.25, noise=1e-3, losing=(), gap=None):
        self._trips, self._gain, self._noise, self._losing, self._gap = iter(trips * 99), gain, noise, losing, gap
        self._opened = -1

    def loop_back(self):
        return self

    def __enter__(self):
        self._opened += 1
        self._line, self._rng = np.zeros(next(self._trips)), np.random.default_rng(self._opened)
        self._blocks = 0
        return self

    def __exit__(self, *exc):
        pass

    def play(self, drive):
        line = np.concatenate([self._line, drive[:, 0]])
        self._line = line[64:]
        loses = self._opened in self._losing and self._gap in (None, self._blocks)
        flags, self._blocks = np.full(64, int(Flag.OVERRUN) if loses else 0), self._blocks + 1
        if loses:
            line[: 64 : 2 if self._gap is None else 1] = 0.0
        sensed = self._gain * line[:64] + self._noise * self._rng.standard_normal(64)
        return Sensed(sensed[:, None], flags=flags)

    def __str__(self):
        return "cable"


def test_the_delay_of_a_loop_is_that_of_its_cable():
    """In blocks of 64 what is played 100 samples before acts on what is sensed: 64 + 100 - 1/2; a lost run is redone.

    Noise of 1 % over 0.55 s, a burst of 0.05 s, n = 2400: 0.01 sqrt(11)/(2 pi 0.25 sqrt(0.7 n)) = 5e-4 samples rms.
    """
    found = measure_latency(Cable(100, noise=1e-4, gain=-0.1, losing=(1,)), runs=3)
    assert found.delay == pytest.approx(163.5, abs=5 * 5e-4)
    assert found.gain == pytest.approx(-0.1, rel=0.01)
    assert len(found.trips) == 3
    assert "delay 163.50 samples (3.406 ms) at 48000 Hz in blocks of 64; 3 runs, spread 0.00" in str(found)
    assert "gain of the cable -0.1; inverted: swap the two wires" in str(replace(found, trips=[Trip(1.0, -0.1, 1.0)]))
    assert "inverted" not in str(replace(found, trips=[Trip(1.0, 0.1, 1.0)]))


def test_the_driver_may_be_a_text(monkeypatch):
    monkeypatch.setattr("other_plate.cable", lambda: Cable(100, noise=1e-4), raising=False)
    assert measure_latency("other_plate:cable", runs=1).delay == measure_latency(Cable(100, noise=1e-4), runs=1).delay
    with pytest.raises(ValueError, match="driver = 'simulated': must be a device with a cable, such as audio:0"):
        measure_latency("simulated")


def test_a_run_that_lost_a_block_gives_no_gain():
    """64 of 2400 samples leave a correlation of 0.987, and a gain that is 2.7 % off."""
    found = measure_latency(Cable(100, noise=1e-4, losing=(0,), gap=10), runs=1)
    assert found.gain == pytest.approx(-0.25, rel=0.01)


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        (Cable(100, 100, 164), r"the runs disagree by 64.00 samples \(bound 0.5\): 100.00, 100.00, 164.00"),
        (Cable(100, gain=0.0), "with a correlation of 0.0., must be >= 0.5: connect the first output"),
        (Cable(100, gain=0.0, noise=0.0), "with a correlation of 0.00"),
        (Cable(100, losing=range(30)), "cable: latency: samples were lost in 30 of 30 runs: use larger blocks"),
    ],
)
def test_what_is_no_delay_is_refused(driver, message):
    with pytest.raises(DriverError, match=message):
        measure_latency(driver, runs=3)


def test_arguments_of_the_measurement_are_checked():
    for arguments in ({"runs": 0}, {"amplitude": 0.0}, {"amplitude": np.nan}, {"amplitude": 1.1}):
        with pytest.raises(
            ValueError, match="(runs = 0: must be|amplitude=.*: must be > 0 and <= 1, the limit of the drive)"
        ):
            measure_latency(Cable(100), **arguments)


@pytest.mark.parametrize("delay", [20.0, 20.3, 20.5, 20.81])
def test_a_round_trip_is_found_to_a_fraction_of_a_sample(delay, rng):
    """Of a burst that is delayed by its spectrum, exactly; what remains are roundings."""
    played = np.concatenate([rng.choice([-0.1, 0.1], 4096), np.zeros(4096)])
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(8192) * delay)
    shift[-1] = shift[-1].real
    found = find_trip(played, np.fft.irfft(0.3 * np.fft.rfft(played) * shift))
    assert found.samples == pytest.approx(delay, abs=1e-3)
    assert found.gain == pytest.approx(0.3, rel=1e-2)


def test_the_delay_is_written_into_a_profile(tmp_path):
    found, path = Latency((Trip(272.0, 1.0, 1.0),), 48e3, 64, host_delay=192), tmp_path / "plate.toml"
    for tool in ("a cable", 300 * "b"):  # the second replaces the first, as its delay does
        write_delay(path, found, tool)
        written = tomllib.loads(path.read_text())
        head = {"kind": "vt-plate", "measured_with": tool[:200], "measured_on": date.today()}
        assert written["calibration"] == {"delay": 143.5}
        assert written["profile"] | {"name": ""} == head | {"name": ""}
    before = """[profile]\nkind = "hybrid"\nname = "my plate"\n[device]\nplate_mass = 0.03
[calibration]\nsensed_per_full_scale = 1e-3\ndelay = 7\n[limits]\nrms_drive = 1.0\n"""
    path.write_text(before)
    write_delay(path, found)
    expected = {"sensed_per_full_scale": 1e-3, "delay": 143.5}
    assert tomllib.loads(path.read_text()) == tomllib.loads(before) | {"calibration": expected}
