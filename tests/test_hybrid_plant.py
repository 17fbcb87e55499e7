"""The hybrid's plant: plate and screen under one finger, and parts that do not fit."""

import numpy as np
import pytest

import hapticrender as hr
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.plants.hybrid import HybridPlant
from hapticrender.plants.plate import Plate, PlateParameters

RATE = 10_000
SLIDE = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")


@pytest.mark.parametrize("screen_levels", [{}, {"level": "carrier", "sensor": "impedance"}], ids=["force", "gap"])
def test_plate_and_screen_are_those_of_their_own(screen_levels):
    """Sensed, flags and motion are those of plate and screen alone, sample for sample, in blocks or not."""
    finger = hr.Finger.sliding(speed=0.03, normal_load=0.4, span=0.1, mechanics="heavy")
    parameters = PlateParameters(rate=RATE, bending_frequency=1250.0)

    def fresh():
        return Plate(parameters, finger, 1), ElectroadhesionScreen(
            ElectroadhesionParameters(**screen_levels), finger, 2
        )

    plate, screen = fresh()
    hybrid = HybridPlant(*fresh(), 0.64)
    time = np.arange(3000) / RATE
    drive = np.column_stack(
        [0.2 * np.sin(2 * np.pi * 80 * time), 0.05 * np.cos(2 * np.pi * 80 * time), 3e-3 * (1 + np.sin(500 * time))]
    )
    pieces = []
    for part in np.split(drive, [1, 700]):
        both = hybrid.run(part)
        pieces.append((both.sensed, both.motion, hybrid.motion[:, 1:], both.flags))
    sensed, motion, felt, flags = (np.concatenate(column) for column in zip(*pieces, strict=True))
    moved, rubbed = plate.run(drive[:, :2]), screen.run(drive[:, 2:])
    np.testing.assert_array_equal(sensed, np.hstack([moved.sensed, rubbed.sensed]))
    np.testing.assert_array_equal(felt[:, 0], plate.motion[:, 3])
    np.testing.assert_allclose(felt[:, 1], 0.64 * rubbed.motion[:, 0], rtol=1e-14)
    np.testing.assert_allclose(motion[:, 0], felt.sum(axis=1), rtol=1e-12)
    np.testing.assert_array_equal(flags, moved.flags | rubbed.flags)
    assert (abs(felt).max(axis=0) > 1e-3).all()


def test_parts_that_do_not_fit_are_refused():
    screen = ElectroadhesionScreen(ElectroadhesionParameters(), SLIDE)
    with pytest.raises(ValueError, match=r"plate.rate = 5000.0: must be 10000.0"):
        HybridPlant(Plate(PlateParameters(), SLIDE), screen, 0.64)
    with pytest.raises(ValueError, match=r"plate.coils = 1: must be 2"):
        HybridPlant(Plate(PlateParameters(rate=RATE, coils=1), SLIDE), screen, 0.64)
    with pytest.raises(ValueError, match=r"velocity_per_force=0.0: must be > 0"):
        HybridPlant(Plate(PlateParameters(rate=RATE), SLIDE), screen, 0.0)
