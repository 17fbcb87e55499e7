"""Figures of docs/figures.md, on a plate that shares no code with the library: by the accuracy suite.

Rows that take longer are in ``hapticrender validate --suite accuracy --driver tests.strangers_plate:plate`` alone.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import resample_poly
from strangers_plate import StrangersPlate

from hapticrender.accuracy.plate import FINGERS, Bench, SimulatedPlate, touching
from hapticrender.accuracy.signals import recorded
from hapticrender.accuracy.suite import run_suite
from hapticrender.touch.finger import Finger

ON_THE_STRANGERS_PLATE = {  # cases, and the bounds that they miss; all others are played in test_accuracy.py
    "white": set(),
    "white wrong": set(),
    "white 48 kHz": set(),
    "comb": {"first"},
}


@pytest.mark.parametrize("case", ON_THE_STRANGERS_PLATE)
def test_what_must_be_reached_is(case):
    found = run_suite(["inverse"], [case], make=StrangersPlate.of)
    assert len(found) == (3 if case == "comb" else 4)
    assert {each.target.key for each in found if not each.passed} == ON_THE_STRANGERS_PLATE[case], found


@pytest.mark.parametrize("finger", FINGERS[2:], ids=["light", "heavy"])
def test_a_recorded_swipe_is_played_within_what_it_must(shared_data, finger):
    """Lateral force of a finger at 40 mm/s, 4.6 to 6.9 s of the recording, in time: 2 / 4 %.

    Of four fingers these are the worst, the light one in the middle (0.7 %), the heavy one at the end (1.7 %).
    """
    with np.load(shared_data / "swipe_40mm_s.npz") as file:
        force = file["lateral_force"][46000:69000].astype(float)
    texture = recorded(resample_poly(force - force.mean(), 2, 1))
    at, end = Bench(method="inverse", make=StrangersPlate.of).play(texture, 2.3, touching(*finger)).wave_error(0.7)
    assert at < 0.02
    assert end < 0.04


@pytest.mark.parametrize(
    ("finger", "bound"),
    [
        (Finger.absent(), 1e-3 * 2.2e-6),  # m: Runge and Kutta's (w h)^5/120 a step over the 300 steps that 2.2 um ring
        (touching(*FINGERS[3]), 2 * np.pi * 147.0 * 1e-4 * 31e-6),  # half a sample of 31 um (0.8 N) at its fastest mode
    ],
)
def test_the_suites_own_plate_moves_as_the_strangers_does(finger, bound):
    """Under the same drive, at 150 Hz and in the mode; load and position are held over a sample here, lines there."""
    parameters, time = replace(Bench(method="").plate, current_bits=0), np.arange(2000) / 5e3
    drive = 0.1 * np.sin(2 * np.pi * np.multiply.outer(time, [150.0, parameters.bending_frequency])).sum(axis=1)
    truths = []
    for make in (SimulatedPlate, StrangersPlate.of):
        with make(parameters, finger) as plate:
            for current in drive:
                plate.play(np.array([[current, 0.5 * current]]))
            truths.append(plate.truth[1000 : len(drive)])
    assert abs(truths[0] - truths[1]).max() < bound
    heave = truths[0][:, 1:3].mean(axis=1) - truths[0][:, 3]
    assert abs(heave).max() > 1e-6  # what the mode adds to the ends beside the middle
