"""A screen of one's own without a force sensor: its driver hands over what voltage and current say of the attraction.

Its physics shares no code with the library's: the attraction is that of the field in the gap, eps0 A |E|^2/4.
"""

import numpy as np
import pytest
from live_devices import Bench
from scipy.signal import lfilter
from waves import phasor

import hapticrender as hr
from hapticrender.plants.electroadhesion import MOIST, NORMAL, ElectroadhesionParameters
from hapticrender.plants.gap_estimator import estimate_attraction, gap_record

LOAD, SPEED, REST, FORCE = 1.0, 0.05, 0.2, 0.1  # N, m/s, s, N of friction
FINGER = hr.Finger.sampled([0.0, 0.0, 0.1], times=[0.0, REST, REST + 0.1 / SPEED], normal_load=LOAD)
KNOWN = {"sensor": "impedance", "level": "carrier"}
EPS = 8.854e-12  # F/m


class ImpedanceScreen(Bench):
    """Insulator, skin (R parallel to C), gap and body in series at 20 kHz; a lock-in reads V and I every 0.1 ms."""

    rate, block, delay, drive_channels, sensed_channels = 10e3, 10, 10, 1, 1

    def __init__(self, area, gap, leak, *, senses=True):
        self.area, self.gap, self.leak, self.at, self.friction = area, gap, leak, 0, np.array([0.8 * LOAD])
        self.rng, self.sensed_channels = np.random.default_rng(1), int(senses)
        load_gain = ElectroadhesionParameters().gain(LOAD)
        self.estimator = gap_record(ElectroadhesionParameters(**KNOWN, open_loop_gain=load_gain))

    def play(self, drive):
        time = (self.at + np.arange(len(drive) + 1)) / self.rate
        position = FINGER.position(time)
        speed, current, self.at = np.diff(position) * self.rate, drive[:, 0], self.at + len(drive)
        w = 2j * np.pi * 20e3
        series = 1 / (w * 3.45e-5) + 1 / (w * 2.95e-5 + 1 / 1.2)
        across = np.where(speed, 1 / (w * EPS / self.gap + 1 / self.leak), 0.0)
        voltage = current * (1e3 + (series + across) / self.area)
        field = abs(current * across / self.area) / self.gap
        whole, kept = 0.8 * (LOAD + EPS * self.area * field**2 / 4), np.exp(-SPEED / (self.rate * 11.5e-6))
        friction = lfilter([1 - kept], [1.0, -kept], whole, zi=kept * self.friction[-1:])[0]
        self.friction = np.r_[self.friction, friction]
        noise = self.rng.standard_normal((len(drive), 4)) @ np.array([[0.1, 0], [0.1j, 0], [0, 5e-6], [0, 5e-6j]])
        force, guessed = estimate_attraction(self.estimator, voltage + noise[:, 0], current + noise[:, 1], speed)
        flags = np.where(guessed, hr.Flag.OPEN_LOOP, 0)
        return hr.Sensed(force[:, None][:, : self.sensed_channels], position[:-1], flags=flags)


def played(screen):
    """Error of the friction at 100 Hz over the last 0.2 s, and the recording."""
    texture = hr.Grating(frequency=100.0, amplitude=0.64 * FORCE / (2 * np.pi * 100.0))
    fields = {"profile": {"sensor": "impedance"}, "simulation": {"level": "carrier"}, "keep_unfelt": True}
    scene = hr.Scene(texture=texture, finger=FINGER, device="electroadhesion", duration=0.8, settle=0.4, **fields)
    recording = hr.render(scene, driver=screen)
    return abs(phasor(screen.friction[6_001:8_001], 100.0, screen.rate)) / FORCE - 1, recording


@pytest.mark.parametrize(("area", "gap"), [(0.5e-4, 0.5e-6), (0.94e-4, 3e-6)])
def test_the_gap_that_a_driver_measures_closes_the_loop(area, gap):
    """Area -30 and +30 %: within the 3 % of the estimator.  It is inferred, so not judged."""
    error, recording = played(ImpedanceScreen(area, gap, NORMAL))
    assert abs(error) < 0.03
    assert not (recording.flags[round((REST + 0.01) * recording.rate) :] & hr.Flag.OPEN_LOOP).any()
    assert recording.summary()["verdict"] == "not judged"


@pytest.mark.parametrize(("area", "gap", "sign"), [(0.5e-4, 0.5e-6, 1), (0.94e-4, 3e-6, -1)])
def test_open_loop_the_gap_is_missed(area, gap, sign):
    """By +58 and -41 %."""
    error, _ = played(ImpedanceScreen(area, gap, NORMAL, senses=False))
    assert sign * error > 0.3


def test_a_gap_that_leaks_too_much_is_flagged():
    error, recording = played(ImpedanceScreen(0.72e-4, 1.5e-6, MOIST))
    assert (recording.flags[20:] & hr.Flag.OPEN_LOOP).all()
    assert error < -0.8
    assert recording.summary()["verdict"] != "passed"
