"""The paper's controller: what it holds, where it fails, and that its kernel is its equations."""

import dataclasses

import numpy as np
import pytest
from held import amplitude, envelopes, fixed, hold, play

import hapticrender as hr
from hapticrender.control.methods import METHODS, Polar
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import HEAVY_SECOND

RATE = 5000.0
NOISY, QUIET = PlateParameters(), PlateParameters(sensor_noise=0.0)
IDEAL = PlateParameters(sensor_noise=0.0, sensor_bits=0, current_bits=0)


@pytest.mark.parametrize(("frequency", "target"), [(20.0, 100e-6), (31.0, 10e-6), (72.0, 10e-6), (400.0, 10e-6)])
def test_baseline_holds_on_the_free_plate(frequency, target):
    """<= 0.3 % with noise and <= 0.15 % without, centre and ends, 14-bit sensing and 12-bit command included.

    Averaged over 20 s: the loop follows the noise of the mean, sqrt(2/N) um = 0.045 % of 10 um, 3 sigma < 0.14 %.
    """
    for plate, bound in ((NOISY, 3e-3), (QUIET, 1.5e-3)):
        motion = hold("paper", fixed((frequency, target)), 21.0, plate)[1]
        error = amplitude(motion, frequency, 20.0) / target - 1.0
        assert abs(error).max() <= bound


@pytest.mark.parametrize(("frequency", "stable"), [(125, True), (131, False), (188, False), (192, True)])
def test_two_sides_apart_are_unstable_between_129_and_189_hz(frequency, stable):
    """From the eigen-loops rho = rocking/heave receptance ; 2 and 3 Hz outside, growth is slow."""
    motion = hold("paper", fixed((float(frequency), 10e-6)), 41.0, IDEAL)[1]
    error = abs(amplitude(motion, frequency, 1.0) / 10e-6 - 1.0).max()
    assert error < 0.01 if stable else error > 0.1


@pytest.mark.parametrize(
    ("frequency", "target", "position", "expected", "within"),
    [
        (20.0, 1e-6, 0.0, -1.0, 1e-6),
        (31.0, 1e-6, 0.0, -1.0, 1e-6),
        (20.0, 10e-6, 0.0, -0.079, 0.003),
        (20.0, 10e-6, 10e-3, -0.098, 0.003),
    ],
)
def test_a_press_blinds_it_at_low_frequency(frequency, target, position, expected, within):
    """0.5 N sags 11 um, which leaks through L; the paper says that it ignores the load.

    The sag adds a phasor of 2 * 11.04 um * |L(20 Hz)| = 5.35 um that turns at 20 Hz, so that the mean of |X| is
    A + 5.35^2/(4 A): it is 10 um at A = 9.22 um, and the 2f image takes another 0.12 %.  That is with the finger in
    the middle; -9.8 % is found with the finger 10 mm to one side, and 27.5 mm to one side gives -50 %.
    """
    finger = hr.Finger.still(position=position, normal_load=0.5, mechanics="none")
    motion = hold("paper", fixed((frequency, target)), 14.0, QUIET, finger=finger)[1]
    error = amplitude(motion, frequency, 10.0)[0] / target - 1.0
    assert error == pytest.approx(expected, abs=within)


def test_a_table_of_the_loaded_plate_limit_cycles_at_lift_off():
    """at 189 Hz the free plate has 3.9 x the gain of the loaded one, above the gain margin of 3.5."""
    free = IDEAL.device_model(RATE, 1)
    finger = np.diag([1.0, 0.0])
    loaded = dataclasses.replace(
        free,
        mass=free.mass + HEAVY_SECOND.mass * finger,
        damping=free.damping + HEAVY_SECOND.damping * finger,
        stiffness=free.stiffness + HEAVY_SECOND.stiffness * finger,
    )
    spread = {}
    for name, table in (("free", free), ("loaded", loaded)):
        motion = play(METHODS["paper-common"].design(table, fixed((189.0, 10e-6))), 10.0, IDEAL)[1]
        time, found = envelopes(motion, 2 * np.pi * 189.0 * np.arange(len(motion)) / RATE, RATE, 0.05)
        spread[name] = abs(found[time > 8.0, 0]).std() / 10e-6
    assert spread["free"] < 0.01
    assert spread["loaded"] > 0.3


def test_a_long_delay_slows_the_loop_down_until_its_margins_hold():
    """at 5 Hz polar loops bear 30-42 ms; slowed down they hold at 60 ms."""
    late = dataclasses.replace(IDEAL, delay=300)
    for method, holds in ((METHODS["paper-common"], True), (Polar(common=True, bandwidths=(5.0, 10.0)), False)):
        motion = hold(method, fixed((111.0, 1e-5)), 12.0, late)[1]
        error = abs(amplitude(motion, 111.0, 2.0)[0] / 1e-5 - 1)
        assert error < 2e-3 if holds else error > 0.05
