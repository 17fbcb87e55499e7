"""Drivers chosen by a text, the same on the command line and in Python, and what `hapticrender devices` shows."""

import sys
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from board import slow_board
from live_devices import Bench
from other_plate import OtherPlate
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo
from waves import read_back

import hapticrender as hr
from hapticrender import devices
from hapticrender.devices import open_driver
from hapticrender.drivers.serial import SerialDriver

TONE = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.1, rendering={"probe": False})


class Calibrated(Bench):
    """A driver that is told what its device's profile says."""

    rate, block, drive_channels, sensed_channels = 5000.0, 1, 2, 0

    def __init__(self, argument="", *, drive_per_full_scale=3.0, delay=1, profile=None):
        self.argument, self.scale, self.delay, self.profile = argument, drive_per_full_scale, delay, profile

    def play(self, drive):
        return hr.Sensed(np.empty((1, 0)))

    @classmethod
    def found(cls):
        return ["7  a box on the bench, 2 out", "9"]


class Needy(Calibrated):
    """A driver that cannot do without its argument."""

    def __init__(self, path):
        super().__init__(path)


NOT_CALLABLE = 3


def test_a_text_makes_a_driver(tmp_path):
    assert open_driver("simulated") is None
    assert open_driver(f"wavefile:{tmp_path / 'a:b.wav'}").path == tmp_path / "a:b.wav"  # only the first colon counts
    assert open_driver("test_devices:Calibrated").argument == ""
    assert open_driver("test_devices:Calibrated:a:b").argument == "a:b"
    for text in ("test_devices:Calibrated?delay=2", "test_devices:Calibrated:a?b?delay=2"):
        made = open_driver(text)
        assert (made.argument, made.delay) == ("a?b" if ":a" in text else "", 2)
    assert open_driver("test_devices:Calibrated?argument=a:b").argument == "a:b"  # an option where none stands before


def test_a_driver_gets_what_it_names_of_its_profile_and_no_more():
    profile = hr.DeviceProfile(kind="vt-plate", calibration={"drive_per_full_scale": 2.0, "gain_uncertainty": 0.1})
    made = open_driver("test_devices:Calibrated", profile)
    assert (made.scale, made.delay, made.profile) == (2.0, 1, profile)  # no delay was measured: its own
    with pytest.warns(UserWarning, match="drive_per_full_scale = 2: other_plate:OtherPlate does not take it"):
        assert open_driver("other_plate:OtherPlate", profile).rate == 5000.0  # names none


@pytest.mark.parametrize(
    ("stated", "attributes", "lost"),
    [
        ({"sensed_per_full_scale": 5.0, "delay": 197.4}, {}, "sensed_per_full_scale = 5, delay = 197.4: OtherPlate"),
        ({"sensed_per_full_scale": 5.0}, {"sensed_per_full_scale": 4.0}, "sensed_per_full_scale = 5: OtherPlate"),
        ({"sensed_per_full_scale": 5.0, "delay": 1.4}, {"sensed_per_full_scale": 5.0}, ""),
        ({"drive_per_full_scale": [3.0, 0.01]}, {}, "drive_per_full_scale = 3, 0.01: OtherPlate"),
        ({"drive_per_full_scale": [3.0, 0.01]}, {"drive_per_full_scale": (3.0, 0.01)}, ""),
        ({"gain_uncertainty": 0.1}, {}, ""),
    ],
)
def test_a_calibration_that_a_driver_object_does_not_have_is_named(stated, attributes, lost):
    driver = OtherPlate()
    vars(driver).update(attributes)
    scene = hr.Scene(texture=hr.Grating(frequency=80.0, amplitude=1e-5), duration=0.1, calibration=stated)
    with pytest.warns(UserWarning, match=lost) if lost else nullcontext():
        hr.prepare(scene, driver=driver, compiled=False)


REFUSED = [
    ("tea", ValueError, "driver 'tea' is not installed: must be one of .*simulated.*; or NAME, NAME:ARGUMENT"),
    ("simulated:x", ValueError, "driver = 'simulated:x': must be 'simulated', without an argument"),
    ("tea:cup", ValueError, "driver = 'tea:cup': No module named 'tea'; installed are .*wavefile"),
    ("test_devices:Tea", ValueError, "has no attribute 'Tea'"),
    ("test_devices:NOT_CALLABLE", ValueError, "NOT_CALLABLE is a int: must be a class or a function"),
    ("os:getcwd", ValueError, "driver = 'os:getcwd': it returned a str: must be a driver"),
    ("gc:enable", ValueError, "driver = 'gc:enable': it returned a NoneType: must be a driver"),
    ("wavefile", ValueError, "driver = 'wavefile': .*missing.*path.*give its argument as wavefile:ARGUMENT"),
    ("test_devices:Tea?delay=2", ValueError, "has no attribute 'Tea'"),
    ("test_devices:Calibrated?tea=2", ValueError, "'tea': must be one of argument, drive_per_full_scale, delay, prof"),
    ("test_devices:Calibrated:a?argument=2", ValueError, "'argument': must be one of drive_per_full_scale, delay"),
    ("test_devices:Calibrated?delay", ValueError, r"options = '\?delay': must be \?OPTION=VALUE"),
    ("test_devices:Needy", ValueError, r"missing .* 'path'; give its argument as test_devices:Needy:ARGUMENT\?OPTION"),
    ("wavefile:a.tea", ValueError, "ending '.tea' must be one of .wav"),
]


@pytest.mark.parametrize(("text", "error", "message"), REFUSED, ids=[each[0] for each in REFUSED])
def test_a_text_that_names_no_driver_is_refused_with_what_there_is(text, error, message):
    with pytest.raises(error, match=message):
        open_driver(text)


@pytest.mark.parametrize(
    ("module", "source", "message"),
    [
        ("my_card", "import sounddevice", r'sounddevice.*to get it: pip install "hapticrender\[audio\]"'),
        ("my_driver", "1 / 0", "my_driver cannot be loaded: ZeroDivisionError"),
    ],
)
def test_a_module_that_fails_or_lacks_a_package_is_named(tmp_path, monkeypatch, module, source, message):
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises((ValueError, hr.HapticError), match=message):
        open_driver(f"{module}:Driver")


def test_python_takes_the_same_texts(tmp_path):
    """The drive in the file is that of the driver's object."""
    played = tmp_path / "played.wav"
    recording = hr.render(TONE, driver=f"wavefile:{played}")
    np.testing.assert_allclose(read_back(played)[: len(recording)], recording.drive, rtol=0, atol=3.0 * 2.0**-24)
    own = hr.render(TONE, driver="other_plate:OtherPlate")
    np.testing.assert_array_equal(own.drive, hr.render(TONE, driver=OtherPlate()).drive)
    np.testing.assert_array_equal(hr.render(TONE, driver="simulated").drive, hr.render(TONE).drive)


def test_devices_shows_what_each_driver_finds(monkeypatch):
    """One that finds two, one nothing, one that lacks a library, and one without a search."""

    def missing():
        raise OSError("PortAudio library not found")

    none, card = (type("Kind", (Calibrated,), {"found": staticmethod(each)}) for each in (list, missing))
    kinds = {"box": Calibrated, "card": card, "none": none, "plain": OtherPlate}
    points = [SimpleNamespace(name=name, value="there", load=lambda kind=kind: kind) for name, kind in kinds.items()]
    known = devices.entry_points
    found = lambda group: points if group.endswith("drivers") else known(group=group)  # noqa: E731
    monkeypatch.setattr(devices, "entry_points", found)
    lines = [" ".join(line.split()) for line in devices.text().splitlines()]
    assert {"box:7 a box on the bench, 2 out", "box:9", "none: none"} <= set(lines)
    (line,) = [line for line in lines if line.startswith("card:")]
    how = "to get it: install PortAudio (Debian: apt-get install libportaudio2)"
    assert line.endswith(f"(OSError: PortAudio library not found; {how})")
    assert not [line for line in lines if line.startswith("plain:")]


def test_serial_ports_are_shown_with_the_boards_that_answer(tmp_path, monkeypatch):
    """A compiled board at one port, nothing at the other."""
    with slow_board(tmp_path) as board:
        monkeypatch.setattr(list_ports, "comports", lambda: [ListPortInfo("COM1"), ListPortInfo(str(board.port))])
        monkeypatch.setattr("hapticrender.drivers.serial.LIST_TIMEOUT", 10.0)
        assert SerialDriver.found() == [
            "COM1  n/a; no board answers (DeviceNotFound)",
            f"{board.port}  n/a; a board of 5000 Hz, 2 out, 2 in",
        ]
