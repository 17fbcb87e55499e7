"""Electroadhesion without a force sensor: the loop closes on the attraction estimated from voltage and current."""

import numpy as np
import pytest
from electroadhesive import FORCE, MU, RATE, SPEED, tone
from waves import phasor

import hapticrender as hr
from hapticrender import loop
from hapticrender.plants.electroadhesion import DRY, MOIST, NORMAL, ElectroadhesionParameters

SENSORLESS = {"sensor": "impedance", "level": "carrier"}
REST = 0.2  # s
REST_THEN_SLIDE = hr.Finger.sampled([0.0, 0.0, 0.1], times=[0.0, REST, REST + 0.1 / SPEED], normal_load=1.0)
BOUND = 0.03  # bias 2 % and standard deviation 1.3 % of the gap estimator
BEYOND = 1e-3  # of a force: the law's D ends at s^2
WANTED = FORCE / MU / abs(ElectroadhesionParameters().lag_response(100.0, SPEED))  # N of attraction at 100 Hz


def swing(attraction):
    """Amplitude at 100 Hz over the last tenth of a second."""
    return abs(phasor(attraction[-RATE // 10 :], 100.0, RATE))


def sensed(seconds=1.2, finger=REST_THEN_SLIDE, **plant):
    """Drive, flags and true attraction (N) of a run, sample by sample; the plant keeps that of the whole run."""
    session = loop.prepare(tone(100.0, finger=finger, duration=seconds, **SENSORLESS, **plant))
    screen = session.driver.plant
    drive, _, flags, _ = screen.closed_loop(session.controller(), np.zeros(session.samples))
    return drive[:, 0], flags, screen.motion[:, 1]


@pytest.mark.parametrize(
    ("leak", "area", "gap"), [(DRY, 0.7, 3e-6), (DRY, 1.3, 0.5e-6), (NORMAL, 0.7, 0.5e-6), (NORMAL, 1.3, 3e-6)]
)
def test_the_true_attraction_is_within_3_percent_of_the_wanted_one(leak, area, gap):
    """Over area +-30 % and gaps of 0.5 to 3 um."""
    _, flags, attraction = sensed(gap_resistance=leak, area_scale=area, gap_thickness=gap)
    assert swing(attraction) == pytest.approx(WANTED, rel=BOUND)
    assert not (flags[int((REST + 0.01) * RATE) :] & hr.Flag.OPEN_LOOP).any()
    assert not (flags & hr.Flag.SATURATED).any()


def test_a_swipe_shows_its_area_where_it_turns():
    """It starts in full motion, so the first stroke is open loop; then the finger rests for 8 ms below 1 mm/s."""
    finger = hr.Finger.swiping(frequency=1.0, speed=0.05, normal_load=1.0)
    _, flags, _ = sensed(seconds=1.2, finger=finger, area_scale=0.7)
    guessed = (flags & hr.Flag.OPEN_LOOP) > 0
    assert guessed[1:2500].all()  # it turns after 0.25 s
    assert not guessed[2600:7400].any()
    assert guessed[7480:7520].all()
    assert not guessed[7600:].any()


def test_a_moist_finger_is_flagged_and_played_open_loop():
    """Its share of 0.13 of the attraction would ask for seven times the drive; the loop sees what it expects."""
    drive, flags, attraction = sensed(gap_resistance=MOIST)
    assert (flags[1:] == hr.Flag.OPEN_LOOP).all()  # nor is it driven to its limit
    ratio = ElectroadhesionParameters(gap_resistance=MOIST).gain(1.0) / ElectroadhesionParameters().gain(1.0)
    assert swing(drive) == pytest.approx(WANTED, rel=BOUND)
    assert swing(attraction) / swing(drive) == pytest.approx(ratio, rel=BEYOND)
    assert ratio < 0.15
