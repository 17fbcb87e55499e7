"""The carrier itself for a driver that is fast enough: what a file of it holds, and who is refused."""

from fractions import Fraction

import numpy as np
import pytest
from electroadhesive import tone

import hapticrender as hr
from hapticrender.drivers.base import BaseDriver
from hapticrender.drivers.wavefile import WaveFileDriver, read_back
from hapticrender.renderers.electroadhesion import ElectroadhesionRenderer

FAST = 192_000  # Hz
FULL = 10e-3  # A


def played(tmp_path, **plant):
    """The recording of half a second of 100 Hz, the scene, and the file's samples (A) that belong to it."""
    driver = WaveFileDriver(tmp_path / "carrier.wav", rate=FAST, drive_channels=1, full_scale=FULL, subtype="DOUBLE")
    scene = tone(100.0, duration=0.5, output="carrier", **plant)
    recording = hr.render(scene, driver=driver)
    return recording, scene, read_back(driver.path, full_scale=driver.full_scale)[:, 0]


def held(recording, scene):
    """Envelope of the current (A) that the recorded drive asks for, at the file's rate."""
    envelope = ElectroadhesionRenderer().read(scene, None).compensation(recording.drive[:, 0])
    return np.repeat(envelope, round(FAST / recording.rate))


def test_the_attraction_of_the_file_is_the_wanted_force(tmp_path):
    """Mean of g I(t)^2 cos^2 over whole turns of the carrier: bias/2 + half of 100 Hz, without harmonics.

    To the rounding of the sums.  A sample of the drive is held for 16 of the file: sinc(f/rate)/sinc(f/file's rate).
    """
    recording, scene, file = played(tmp_path)
    root = ElectroadhesionRenderer().read(scene, None).compensation
    force = 2 * root.gain * (DROOP * file[FAST // 5 :][: FAST // 5]) ** 2  # 0.2 s from 0.2 s on
    line, summed = 2 * np.fft.rfft(force) / len(force), len(force) * np.finfo(float).eps
    assert abs(line[0]) / 2 == pytest.approx(root.bias, rel=summed)
    last = recording.drive[-round(recording.rate / 10) :, 0]
    wanted = 2 * abs(np.mean(last * np.exp(-2j * np.pi * 100 * np.arange(len(last)) / recording.rate)))
    hold = np.sinc(100 / recording.rate) / np.sinc(100 / FAST)
    assert abs(line[20]) == pytest.approx(wanted * hold, rel=summed)
    assert abs(line[40]) < summed * abs(line[20])


def test_the_carrier_starts_at_its_crest_and_keeps_its_phase(tmp_path):
    """Every sample is the envelope's times cos(2 pi k 5/48).

    A phase counted in doubles modulo a turn loses at most 2^-53 turns a block, 1e-12 rad in these 1000 blocks.
    """
    recording, scene, file = played(tmp_path)
    wanted = held(recording, scene)
    turns = np.array([float(Fraction(5 * k % 48, 48)) for k in range(48)])
    carrier = np.cos(2 * np.pi * np.resize(turns, len(wanted)))
    np.testing.assert_allclose(file[: len(wanted)], wanted * carrier / DROOP, rtol=0, atol=1e-11 * FULL)
    assert file[0] == pytest.approx(wanted[0] / DROOP)


DROOP = np.sinc(5 / 48)  # of a carrier behind the file's hold: the driver makes up for it


class Still(BaseDriver):
    """A device that keeps what it was handed."""

    def __init__(self, rate=FAST, block=96, delay=None, sensed_channels=0, **told):
        super().__init__(rate=rate, drive_channels=1, sensed_channels=sensed_channels, block=block, delay=delay)
        self.told, self.drive = told, []

    def _play(self, drive):
        self.drive.append(drive)
        return hr.Sensed(np.zeros((len(drive), 0)), **self.told)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (Still(rate=79_999), r"driver.rate = 79999: must be >= 80000 Hz where output = 'carrier', 4 samples a turn"),
        (Still(sensed_channels=1), r"driver.sensed_channels = 1: must be 0 where output = 'carrier'"),
    ],
)
def test_a_driver_that_cannot_carry_it_is_refused(device, message):
    with pytest.raises(ValueError, match=message):
        hr.render(tone(100.0, output="carrier"), driver=device)
