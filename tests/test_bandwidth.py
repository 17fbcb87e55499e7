"""Margins and bandwidths of the error observer's law: both sides of bounds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_kernel import plate_controller, tones

from benchmarks.charts.poles import growth, loop_poles
from hapticrender.control.damping import damping_taps, oscillators
from hapticrender.control.margin_check import OF_LOOP, SCHEDULE, STEPS, checked_settings, error_loop
from hapticrender.control.margins import LeastMargins
from hapticrender.errors import DesignError
from hapticrender.plants.plate import PlateParameters

RATE = 5000.0
MODEL = PlateParameters().device_model(RATE, 1)
TAPS = damping_taps(oscillators(MODEL), 1.4)
USUAL = LeastMargins()


def settings_of(controller):
    """Settings of a controller that its linear loop takes."""
    return {name: float(controller.settings[name]) for name in OF_LOOP}


SETTINGS = settings_of(plate_controller(tones([170.0]), parameters=PlateParameters()))


def at(*frequencies):
    return np.array(frequencies, float)


def test_a_sound_design_is_left_alone():
    checked = checked_settings(MODEL, at(170.0), SETTINGS, taps=TAPS, least=USUAL)
    assert checked.settings == SETTINGS
    assert checked.notes == ()
    assert set(checked.margins) == set(SCHEDULE)
    assert all(margins.stable and margins.modulus >= 0.5 for margins in checked.margins.values())


def test_a_bandwidth_too_wide_is_lowered_no_further_than_need_be():
    """An observer of 60 Hz on 20 Hz: unstable; lowered by quarter octaves until Ms <= 2."""
    wide = SETTINGS | dict(observer_high=2 * 2 * math.pi * 60.0 / RATE, integral_high=204.0)
    assert growth(error_loop(MODEL, at(20.0), wide)) > 0
    checked = checked_settings(MODEL, at(20.0), wide, least=USUAL)
    assert "bandwidth (high) lowered" in checked.notes[-1]
    assert "unstable" in checked.notes[-1]
    assert checked.margins["high"].modulus >= 0.5
    step = checked.settings["observer_high"] / wide["observer_high"]
    assert np.abs(STEPS - step).min() < 1e-12
    assert checked.settings["integral_high"] == pytest.approx(step * wide["integral_high"])
    wider = {
        **checked.settings,
        **{name: 2**0.25 * checked.settings[name] for name in ("observer_high", "integral_high")},
    }
    assert error_loop(MODEL, at(20.0), wider).margins().modulus < 0.5


def test_an_inner_damper_too_strong_is_softened_first():
    """Gain margin 2.7 at full strength, at any bandwidth, where 4 is required."""
    checked = checked_settings(MODEL, at(170.0), SETTINGS, taps=TAPS, least=LeastMargins(gain=4.0))
    assert "inner damper (high) softened to" in checked.notes[0]
    assert "gain margin 2.7" in checked.notes[0]
    assert checked.margins["high"].gain >= 4.0
    assert 0.5 < checked.settings["damper_high"] < 1.0
    assert checked.settings["observer_high"] == SETTINGS["observer_high"]


def test_a_design_that_no_bandwidth_saves_is_refused():
    """Observer and integral in a fixed ratio peak alike at any speed: modulus below 0.9 where 0.9 is required."""
    same = SETTINGS | dict(integral=17.0, integral_medium=17.0, integral_high=17.0, observer_high=SETTINGS["observer"])
    with pytest.raises(DesignError, match=r"modulus margin 0\.8\d at 1\d\d(\.\d)? Hz is below 0\.90 \(low"):
        checked_settings(MODEL, at(170.0), same, least=LeastMargins(modulus=0.9))


def test_carriers_locked_to_the_finger_are_checked_at_its_speeds():
    """A grating and its third: their loops at five speeds, and the smallest of every margin."""
    wavenumber, zero = np.array([1000.0, 3000.0]), np.zeros(2)
    slow = SETTINGS | dict(observer_high=SETTINGS["observer"], integral_high=SETTINGS["integral_medium"])
    checked = checked_settings(MODEL, zero, slow, wavenumber=wavenumber, least=LeastMargins(modulus=0.1, gain=1.1))
    assert checked.notes == ()
    loops = [
        error_loop(MODEL, zero, slow, wavenumber=wavenumber, speed=speed)
        for speed in np.geomspace(20.0 / 1000.0, 1000.0 / 3000.0, 5)
    ]
    assert loops[0].frequency.tolist() == [20.0, 60.0]
    assert checked.margins["high"].modulus == pytest.approx(min(loop.margins().modulus for loop in loops), rel=1e-9)
    assert checked.margins["high"].delay == pytest.approx(min(loop.margins().delay for loop in loops), rel=1e-9)


def test_a_carrier_out_of_range_fades_out_and_crowded_ones_slow_down():
    def observer(speed, **changes):
        loop = error_loop(MODEL, at(0.0), SETTINGS | changes, wavenumber=at(1000.0), speed=speed)
        return loop.observer, loop.share[0]

    assert observer(0.1) == (SETTINGS["observer_high"], 1.0)
    assert observer(0.009)[1] == 0.0
    assert observer(0.015)[1] == pytest.approx(0.5)
    assert observer(1.125)[1] == pytest.approx(0.5)
    assert observer(0.1, crowd_speed=0.4)[0] == pytest.approx(SETTINGS["observer_high"] / 4)


@pytest.mark.parametrize("level", list(SCHEDULE))
@pytest.mark.parametrize("frequencies", [(20.0,), (400.0,), (100.0, 150.0, 170.0)])
def test_nyquists_count_agrees_with_the_poles(frequencies, level):
    for delay in (1, 8):
        loop = replace(error_loop(MODEL, at(*frequencies), SETTINGS, level, taps=TAPS), delay=delay)
        assert loop.margins().stable == (growth(loop) < 0.02), delay


def test_poles_and_frequency_response_are_of_one_loop():
    """The return difference vanishes at every closed-loop pole, relative to its size 1 1/s beside it."""
    free = error_loop(MODEL, at(100.0, 150.0, 170.0), SETTINGS, taps=TAPS)
    jw, arms = 2j * np.pi * free.frequency[:, None, None], np.outer([1.0, 0.5], [1.0, 0.5])
    finger, slope = (4e-3 * jw**2 + 1.0 * jw + 200.0) * arms, (1.0 + 2 * jw * 4e-3) * arms
    loop = replace(free, delay=3, law=free.law + finger, slope=free.slope + slope)
    poles = loop_poles(loop)
    poles = poles[(poles.imag > 1.0) & (poles.real > -200.0)]
    assert len(poles) >= 8
    here, beside = (abs(loop.difference(np.exp((poles + away) / RATE))) for away in (0.0, 1.0))
    assert (here < 1e-5 * beside).all()


def test_the_margin_of_a_loop_is_that_of_a_brute_force_search():
    """Grid of 0.05 Hz over the whole spectrum: the margins' own search finds the same peak within 0.1 %."""
    loop = error_loop(MODEL, at(143.0, 160.0), SETTINGS, "low")
    fine = np.arange(0.005, RATE / 2, 0.05)
    values = np.linalg.inv(np.eye(2) + loop.loop(np.exp(2j * np.pi * fine / RATE)))
    peak = np.linalg.norm(values, 2, axis=(1, 2)).max()
    assert 1 / loop.margins().modulus == pytest.approx(peak, rel=1e-3)
