"""The file driver: what is played is what the file holds, whatever interrupts it."""

import math
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import soundfile

import hapticrender as hr
from hapticrender.drivers.base import BaseDriver
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.drivers.wavefile import FORMATS, SUBTYPES, WaveFileDriver, read_back
from hapticrender.errors import DeviceLost, DeviceNotFound, DriverError
from hapticrender.protocols import Driver, Flag, Sensed

FULL_SCALE = 2.5  # A
FORMS = [
    (ending, subtype)
    for ending, kind in FORMATS.items()
    for subtype in SUBTYPES
    if soundfile.check_format(kind, subtype)
]
STEP = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31, "FLOAT": 2.0**-24, "DOUBLE": 0.0}


class Mirror(BaseDriver):
    """Senses what it is driven with, in metres; goes away at block `lost_at`."""

    def __init__(self, lost_at=None, flags=None):
        super().__init__(rate=4009.8, drive_channels=3, sensed_channels=3, block=5, delay=7)
        self.lost_at = lost_at
        self.flags = flags
        self.played = []

    def _play(self, drive):
        if len(self.played) == self.lost_at:
            raise DeviceLost("mirror: play: gone")
        self.played.append(drive.copy())
        return Sensed(1e-6 * drive, position=np.full(len(drive), 0.01), flags=self.flags)

    def _close(self):
        self.played.append("closed")

    def __exit__(self, kind, error, traceback):
        self.heard = (kind, error, traceback)
        super().__exit__(kind, error, traceback)


def played(driver, blocks):
    """Play all `blocks`, close, and return what the file holds without the closing block of zeros."""
    with driver:
        for block in blocks:
            driver.play(block)
    held = driver.read_back()
    assert not held[len(held) - driver.block :].any()
    return held[: len(held) - driver.block]


def run_script(script, **options):
    return subprocess.run([sys.executable, "-c", textwrap.dedent(script)], timeout=120, **options)


def largest_error(subtype):
    """Half a step: of the integers, of float32 between half and full scale; nothing for float64."""
    return 0.5 * FULL_SCALE * STEP[subtype]


@pytest.mark.parametrize(("ending", "subtype"), FORMS)
def test_a_file_holds_the_drive_within_half_a_step(tmp_path, rng, ending, subtype):
    channels = 3
    blocks = rng.uniform(-FULL_SCALE, FULL_SCALE * (1 - 2.0**-15), (3, 16, channels))
    driver = WaveFileDriver(
        tmp_path / f"drive{ending}", full_scale=FULL_SCALE, subtype=subtype, drive_channels=channels, block=16
    )
    held = played(driver, blocks)
    error = np.abs(held - blocks.reshape(-1, channels)).max()
    rounding = 4 * np.finfo(float).eps * FULL_SCALE  # of scaling there and back
    assert error <= largest_error(subtype) + rounding
    assert subtype == "DOUBLE" or error > 0.5 * largest_error(subtype)  # the form asked for, not a finer one
    assert driver.clipped == 0


def test_alone_it_is_a_driver_without_sensors(tmp_path):
    driver = WaveFileDriver(tmp_path / "a.wav", rate=5000, drive_channels=2, block=4)
    assert isinstance(driver, Driver)
    assert (driver.rate, driver.sensed_channels, driver.delay) == (5000, 0, 4)
    with driver:
        sensed = driver.play(np.ones((4, 2)))
    assert sensed.sensed.shape == (4, 0)
    assert sensed.position is None


def test_integers_cut_what_is_beyond_full_scale_and_say_so(tmp_path):
    driver = WaveFileDriver(tmp_path / "a.flac", full_scale=1.0, subtype="PCM_16", block=2)
    with driver:
        assert driver.play(np.array([[1.0, -1.0], [0.5, 0.0]])).flags is None
        assert driver.play(np.array([[0.25, 0.5], [1.5, -4.0]])).flags.tolist() == [0, Flag.SATURATED]
    assert driver.clipped == 2
    top = 1 - 2.0**-15
    assert driver.read_back().tolist() == [[top, -1.0], [0.5, 0.0], [0.25, 0.5], [top, -1.0], [0.0, 0.0], [0.0, 0.0]]


def test_a_file_is_whole_after_an_exception_in_mid_run(tmp_path, rng):
    blocks = rng.uniform(-1, 1, (3, 8, 2))
    driver = WaveFileDriver(tmp_path / "a.wav", subtype="DOUBLE", full_scale=1.0, block=8)

    def interrupted():
        with driver:
            for block in blocks:
                driver.play(block)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    np.testing.assert_array_equal(driver.read_back(), np.vstack([*blocks, np.zeros((8, 2))]))


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
@pytest.mark.parametrize("ending", FORMATS)
def test_a_killed_process_leaves_what_it_played(tmp_path, ending):
    """All in WAV and W64; FLAC's encoder holds back a block of 4096; RF64 and AIFF count frames when closed."""
    path = tmp_path / f"a{ending}"
    script = f"""
        import os, signal
        import numpy as np
        from hapticrender.drivers.wavefile import WaveFileDriver
        with WaveFileDriver({str(path)!r}, full_scale=1.0, block=1000) as driver:
            for number in range(100):
                driver.play(np.full((1000, 2), number / 128))
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = run_script(script)
    assert done.returncode == -signal.SIGKILL
    played = np.repeat(np.arange(100) / 128, 1000)[:, None] * np.ones(2)
    held = read_back(path, full_scale=1.0)
    if ending in (".rf64", ".aiff", ".aif"):
        assert held.shape == (0, 2)
    else:
        assert len(played) - len(held) <= (4096 if ending == ".flac" else 0)
        np.testing.assert_array_equal(held, played[: len(held)])


def test_a_truncated_flac_is_refused_by_name(tmp_path, rng):
    path = tmp_path / "a.flac"
    soundfile.write(path, rng.uniform(-1, 1, (100_000, 2)), 8000)
    os.truncate(path, int(0.4 * path.stat().st_size))
    with pytest.raises(DriverError, match=r"a\.flac: read: "):
        read_back(path)


def test_a_tee_passes_numbers_sensing_and_drive_on(tmp_path, rng):
    mirror = Mirror()
    driver = WaveFileDriver(tmp_path / "a.wav", through=mirror, subtype="DOUBLE", full_scale=1.0)
    assert (driver.rate, driver.block, driver.delay) == (4009.8, 5, 7)
    assert (driver.drive_channels, driver.sensed_channels) == (3, 3)
    block = rng.uniform(-1, 1, (5, 3))
    with driver:
        answer = driver.play(block)
    np.testing.assert_array_equal(answer.sensed, 1e-6 * block)
    assert answer.position.tolist() == [0.01] * 5
    assert mirror.played[-1] == "closed"
    device = np.vstack(mirror.played[:-1])
    rest = math.ceil(7 / 5) * 5  # samples until zeros have come through the delay, the tee's and then the device's own
    np.testing.assert_array_equal(device, np.vstack([block, np.zeros((2 * rest, 3))]))
    np.testing.assert_array_equal(driver.read_back(), device[: 5 + rest])
    assert mirror.heard == (None, None, None)
    assert soundfile.info(tmp_path / "a.wav").samplerate == 4010


def test_a_tee_adds_its_flags_to_those_of_the_device(tmp_path):
    mirror = Mirror(flags=np.array([Flag.OVERRUN, 0, Flag.OVERRUN, 0, 0]))
    with WaveFileDriver(tmp_path / "a.flac", through=mirror, full_scale=1.0) as driver:
        flags = driver.play(np.array([[2.0], [2.0], [0.5], [0.5], [-1.5]]) * np.ones(3)).flags
    both = Flag.OVERRUN | Flag.SATURATED
    assert flags.tolist() == [both, Flag.SATURATED, Flag.OVERRUN, 0, Flag.SATURATED]
    assert driver.clipped == 9


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.mp3", {}, r"a\.mp3: the ending '\.mp3' must be one of \.wav, "),
        ("a.flac", {"subtype": "FLOAT"}, r"a\.flac: subtype='FLOAT' must be one of PCM_16, PCM_24 for FLAC"),
        ("a.wav", {"through": Mirror(), "rate": 5000.0}, r"rate=5000.0 cannot be given beside through="),
    ],
)
def test_what_does_not_fit_is_refused_with_its_value(name, options, message):
    with pytest.raises(ValueError, match=message):
        WaveFileDriver(name, **options)


def test_reading_back_what_is_no_sound_names_the_file(tmp_path):
    with pytest.raises(DeviceNotFound, match=r"none\.wav: read: no such file"):
        read_back(tmp_path / "none.wav")
    (tmp_path / "text.wav").write_text("not a sound")
    with pytest.raises(DriverError, match=r"text\.wav: read: "):
        read_back(tmp_path / "text.wav")


SCENE = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.5)


def test_a_run_through_a_tee_is_the_run_without_it(tmp_path):
    plain = hr.render(SCENE, seed=3)
    plant = hr.prepare(SCENE, seed=3).plant
    driver = WaveFileDriver(tmp_path / "a.w64", through=SimulatedDriver(plant), subtype="DOUBLE", full_scale=1.0)
    through = hr.render(SCENE, driver=driver)
    for name in ("drive", "sensed", "motion"):
        np.testing.assert_array_equal(getattr(through, name), getattr(plain, name))
    held = driver.read_back()
    assert len(held) == len(plain.drive) + 1  # and a sample of rest
    np.testing.assert_array_equal(held[:-1], plain.drive)
