"""Failures of numerics: rounding of the command, and one coordinate too few."""

import numpy as np
import pytest
from held import fixed, hold
from waves import phasor

import hapticrender as hr
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import HEAVY

RATE = 5000.0
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)


def spur(method, bits_known):
    """Largest line (m) of the centre at 180-220 Hz while 1 um at 20 Hz is held by a 12-bit drive, 5 s."""
    plate = PlateParameters()
    known = plate if bits_known else PlateParameters(current_bits=0)
    motion = hold(method, fixed((20.0, 1e-6)), 10.0, plate, known)[1][-25_000:, 0]
    line = 2 * abs(np.fft.rfft(motion - motion.mean())) / len(motion)
    frequency = np.fft.rfftfreq(len(motion), 1 / RATE)
    return line[(frequency >= 180) & (frequency <= 220)].max()


@pytest.mark.parametrize("method", ["h", "h2"])
def test_rounding_of_the_command(method):
    """12 bits, 1 um at 20 Hz: harmonics of the stairs meet the mode at 189 Hz.  expected: 0.24-0.31 um, shaped 0.011.

    Paper 0.40 um, H 0.33, H2 0.24, above the threshold of 0.1 um; noise shaping leaves 0.003.  Rounding is unshaped
    where the controller is not told of the step.
    """
    assert 0.20e-6 < spur(method, False) < 0.45e-6
    assert spur(method, True) < 0.011e-6
    if method == "h2":
        assert 0.20e-6 < spur("paper", True) < 0.45e-6


def test_controlling_both_coordinates_holds_the_ends():
    """Common mode leaves the ends to the plate, 30 % and more near the rocking mode; heave and rocking hold them."""
    finger = hr.Finger.still(15e-3, normal_load=0.8, mechanics=HEAVY)
    errors = {}
    for method in ("paper-common", "h2"):
        motion = hold(method, fixed((147.0, 5e-5)), 6.0, IDEAL, finger=finger)[1][-5000:]
        found = phasor(motion, 147.0)
        errors[method] = abs(found / found[0] - 1).max()
    assert errors["paper-common"] > 0.3
    assert errors["h2"] < 1e-4
