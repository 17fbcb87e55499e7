"""A sample in which little happens is left out of nothing: what is spared there changes no drive."""

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.bank.settled import settled
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters

RATE, SAMPLES = 5000.0, 6000
QUIET = PlateParameters(current_bits=0, sensor_noise=0.0)  # what is rounded off hides nothing
# as in test_bank: some hundred roundings a sample, each kept for good by the integrals
ROUNDING = 100 * SAMPLES * np.finfo(float).eps
FINGER = hr.Finger.still(normal_load=0.6, mechanics="heavy", touches=((0.4, 0.7), (0.9, 1.1)))


def designed(amplitude, frequency, phase=0.7):
    """A controller of fixed carriers, and its plate with a finger that comes and goes."""
    count = len(frequency)
    bands = Bands(
        frequency=np.array(frequency),
        wavenumber=np.zeros(count),
        phase=np.linspace(0.0, phase, count),
        envelope=amplitude * np.exp(0.4j * np.arange(count)),
    )
    return METHODS["h2"].design(QUIET.band_model(RATE, 1), bands), Plate(QUIET, FINGER)


def played(controller, plate, wanted, piece=SAMPLES):
    """Drive and target of a run, and in which share of its pieces the controller ended settled."""
    rows, calm = [], []
    for start in range(0, SAMPLES, piece):
        drive, target, _, _ = plate.closed_loop(controller, wanted[start : start + piece])
        rows.append((drive, target))
        calm.append(settled(controller.state))
    drive, target = (np.concatenate(column) for column in zip(*rows, strict=True))
    return drive, target, np.mean(calm)


@pytest.mark.parametrize("frequency", [(47.0,), (23.0, 47.0, 150.0, 189.0, 261.0), tuple(np.linspace(20.0, 380.0, 19))])
def test_a_settled_sample_equals_the_same_sample_taken_at_length(frequency):
    """A target that is a factor away from constant is never settled, also where the factor is always 1."""
    spared, plate = designed(1e-6, frequency)
    at_length, another = designed(1e-6, frequency)
    at_length.tables = at_length.tables._replace(numbers=at_length.tables.numbers._replace(modulated=True))
    drive, target, share = played(spared, plate, np.ones(SAMPLES), 100)
    expected, same_target, none = played(at_length, another, np.ones(SAMPLES), 100)
    assert share > 0.8
    assert none == 0.0
    np.testing.assert_allclose(drive, expected, rtol=0, atol=ROUNDING * abs(expected).max())
    np.testing.assert_array_equal(target, same_target)


def test_near_its_limit_a_drive_is_not_settled():
    """From half of the limit on its quadrature is watched as well: a steady tone is then scaled, not cut."""
    controller, plate = designed(3e-4, (47.0, 261.0))
    limit, calm, near = controller.tables.numbers.drive_limit, [], []
    for _ in range(2000):
        drive, *_ = plate.closed_loop(controller, np.zeros(1))  # what the last sample led to
        near.append(abs(drive).max() > 0.5 * limit)
        calm.append(settled(controller.state))
    assert any(calm)
    assert any(near)
    assert not np.any(np.array(calm[:-1]) & np.array(near[1:]))
