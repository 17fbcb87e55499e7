"""Margins from the model against the compiled loop: growth, and boundaries of gain, delay and phase on both sides."""

import math
from dataclasses import replace

import numpy as np
import pytest
from synthetic import make_bands
from test_bandwidth import settings_of

import hapticrender as hr
from benchmarks.charts.poles import growth
from benchmarks.charts.stability_map import loaded_plate
from hapticrender.control.controller_design import ONE_SPEED, design_controller, rules_for
from hapticrender.control.margin_check import error_loop
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY, NAMED, NONE

RATE = 5000.0
IDEAL = {"sensor_noise": 0.0, "sensor_bits": 0, "current_bits": 0, "current_limit": 1e6, "sensor_range": 1e3}
PLATE = PlateParameters(**IDEAL)
MODEL = PLATE.device_model(RATE, 1)
COMB = tuple(np.arange(20.0, 401.0, 20.0))
SCHEDULED = (("observer",), ("integral", "integral_medium"), ("damper",))  # settings at low and medium, beside "_high"


def frozen(method, *frequencies, **changes):
    """Controller whose targets are 0, that stays at its high gains, never saturates and never adapts."""
    bands = make_bands(frequencies, 0.0)
    controller = design_controller(method, MODEL, bands, ONE_SPEED if method == "h" else rules_for(bands))
    settings = controller.state["p"]
    for names in SCHEDULED:
        for name in names:
            settings[name] = settings[f"{names[0]}_high"]
    changes = {"adaptation": -1.0, "drive_limit": 1e9, "sensor_limit": 1e9} | changes
    for name, value in changes.items():
        settings[name] = value
    return controller


def predicted(controller, parameters=PLATE, mechanics=NONE, position=0.0):
    """Linear loop of this controller on a plate that may differ from the one it was designed for."""
    p = controller.settings
    plant = loaded_plate(parameters, MODEL, mechanics, position=position)
    taps = p["taps"][:, : p["n_taps"]]
    loop = error_loop(MODEL, controller.bands.frequency, settings_of(controller), taps=taps)
    return replace(loop, plant=plant, delay=parameters.delay)


def fitted_growth(size, least=1e-200):
    """Growth (1/s) of `size` (m), from its peaks in windows of 20 ms between `least` and 1 mm, last two thirds."""
    width = round(0.02 * RATE)
    peaks = size[: len(size) // width * width].reshape(-1, width).max(axis=1)
    used = np.cumprod((peaks > least) & (peaks < 1e-3)).astype(bool)
    used[: used.sum() // 3] = False
    return np.polyfit(np.flatnonzero(used) * 0.02, np.log(peaks[used]), 1)[0]


def simulated(controller, parameters, mechanics=NONE, position=0.0, seconds=4.0):
    """Growth (1/s) of a kicked plate in the compiled loop whose targets are 0."""
    finger = hr.Finger.still(position, 0.0, mechanics=mechanics) if mechanics.order else hr.Finger.absent()
    plate = Plate(parameters, finger)
    plate.run(np.array([[1e-20, 0.5e-20]]))  # A: small, so that growth has room
    sensed = plate.closed_loop(controller, np.zeros(round(seconds * RATE)))[3]
    return fitted_growth(np.abs(sensed.motion).max(axis=1))


WRONG = [
    ("h", (189.0,), {"mass": 30.4e-3}, ()),
    ("h", (170.0,), {"delay": 8}, ()),
    ("h", (100.0, 120.0, 140.0, 160.0), {}, ()),
    ("h2", (400.0,), {"force_constant": 2.5 * 7.4}, ()),
    ("h2", COMB, {}, ()),
    ("h", (178.0,), {}, (HEAVY, 15e-3)),
    ("h", (178.0,), {}, (NAMED["light-2nd-order"], 0.02)),
]


@pytest.mark.parametrize(("method", "frequencies", "wrong", "finger"), WRONG)
def test_growth_of_the_loop_is_the_predicted_one(method, frequencies, wrong, finger):
    """The fit contains beats of close poles over its 2.7 s or more: 0.1 1/s and 1 % of the growth.

    Contact is without load, so that neither adaptation nor gain schedule starts.
    """
    controller, parameters = frozen(method, *frequencies), replace(PLATE, **wrong)
    expected = growth(predicted(controller, parameters, *finger))
    assert simulated(controller, parameters, *finger) == pytest.approx(expected, abs=0.1, rel=0.01)


def test_growth_with_bending_glass_is_the_predicted_one():
    """Taps designed without a bending mode drive it where coils and sensors are in phase, and damp the other sign."""
    bending = replace(PLATE, bending_frequency=1250.0, bending_coil=0.1)
    controller = frozen("h2", 170.0)
    expected = growth(predicted(controller, bending))
    assert expected > 100
    assert simulated(controller, bending) == pytest.approx(expected, rel=0.01)
    assert growth(predicted(controller, replace(bending, bending_coil=-0.1))) < 0


@pytest.mark.parametrize(("method", "frequency"), [("h", 20.0), ("h2", 400.0)])
def test_the_boundary_lies_where_the_margins_say(method, frequency):
    """Gain: 1 % either side.  Delay: the last whole sample inside and the first outside, by simulation."""
    margins = predicted(frozen(method, frequency)).margins()
    for gain in (1.01 * margins.gain, 0.99 * margins.gain):
        parameters, controller = replace(PLATE, force_constant=7.4 * min(gain, 50.0)), frozen(method, frequency)
        grows = margins.gain < 50.0 and gain > margins.gain
        assert (growth(predicted(controller, parameters)) > 0) == grows
        assert (simulated(controller, parameters, seconds=8.0) > 0) == grows
    borne = math.floor(margins.delay * RATE)
    for extra, grows in ((borne, False), (borne + 1, True)):
        found = simulated(frozen(method, frequency), replace(PLATE, delay=1 + extra), seconds=8.0)
        assert (found > 0) == grows


def test_the_phase_error_that_is_borne_is_the_simulated_one():
    """The law of a single band turned ahead is the plant turned ahead, short of the image at minus f0: 0.5 deg of room.

    Half a degree away the growth is 0.13 1/s, which a run of 8 s tells from none.
    """
    frequency = 72.0
    phase, growths = predicted(frozen("h", frequency)).margins().phase, []
    for error in (phase - np.radians(0.5), phase + np.radians(0.5)):
        controller = frozen("h", frequency)
        controller.state["p"]["lead"] += error / (2 * np.pi * frequency)
        growths.append(simulated(controller, PLATE, seconds=8.0))
    assert growths[0] < -0.05
    assert growths[1] > 0.05
