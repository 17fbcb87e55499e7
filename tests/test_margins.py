"""Margins against closed forms, Nyquist's count on both sides of a boundary, and what falls short named."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hapticrender.control.margins import (
    LEAST,
    LeastMargins,
    Margins,
    borne_errors,
    margins_of,
    sensitivity,
    unstable_poles,
)

GRID = np.geomspace(1e-4, 1e2, 20001)  # Hz
CROSSOVER = math.sqrt((math.sqrt(17) - 1) / 2)  # rad/s, of 2/(s (s + 1)): w^4 + w^2 = 4
PHASE = math.pi / 2 - math.atan(CROSSOVER)


def second_order(frequency):
    """2/(s (s + 1)) in one coordinate and 1/s in the other."""
    s = 2j * np.pi * frequency
    loop = np.zeros((len(s), 2, 2), complex)
    loop[:, 0, 0], loop[:, 1, 1] = 2 / (s * (s + 1)), 1 / s
    return loop


def third_order(gain):
    """gain/(s + 1)^3: gain margin 8/gain, at w = sqrt 3."""
    return lambda frequency: (gain / (2j * np.pi * frequency + 1) ** 3)[:, None, None]


def test_errors_that_a_loop_bears_in_closed_form():
    """Linear interpolation on a grid of steps 0.07 % errs by the square of that: 1e-4 is ample."""
    delay, phase, gain = borne_errors(GRID, second_order(GRID))
    assert phase == pytest.approx(PHASE, rel=1e-4)
    assert delay == pytest.approx(PHASE / CROSSOVER, rel=1e-4)
    assert gain == math.inf


@pytest.mark.parametrize("gain", [2.0, 5.0, 7.9])
def test_margins_of_a_third_order_lag_in_closed_form(gain):
    found = margins_of(third_order(gain), GRID)
    assert found.gain == pytest.approx(8 / gain, rel=1e-5)
    fine = np.geomspace(1e-2, 1.0, 400_001)
    assert 1 / found.modulus == pytest.approx(sensitivity(third_order(gain)(fine)).max(), rel=1e-6)
    assert found.stable


@pytest.mark.parametrize("size", [1, 2, 4])
def test_the_sensitivity_is_that_of_the_inverse(size, rng):
    loop = rng.normal(size=(20, size, size)) + 1j * rng.normal(size=(20, size, size))
    highest = np.linalg.norm(np.linalg.inv(np.eye(size) + loop), 2, axis=(1, 2))
    assert sensitivity(loop) == pytest.approx(highest, rel=1e-9)


def test_a_gain_that_may_not_fall_counts_as_well():
    """5 (s + 1)^2/s^3 is stable for gains above 1/2 (Routh), so it bears division by 10."""
    s = 2j * np.pi * GRID
    assert borne_errors(GRID, (5 * (s + 1) ** 2 / s**3)[:, None, None])[2] == pytest.approx(10.0, rel=1e-4)


def test_coupled_coordinates_have_the_margins_of_their_eigenloci():
    """A rotation of the coordinates changes no margin."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    plain = margins_of(second_order, GRID)
    turned = margins_of(lambda frequency: turn @ second_order(frequency) @ turn.T, GRID)
    for name in ("modulus", "delay", "phase"):
        assert getattr(turned, name) == pytest.approx(getattr(plain, name), rel=1e-9)


@pytest.mark.parametrize(("gain", "poles"), [(7.99, 0), (8.01, 2)])
def test_nyquists_count_on_both_sides_of_a_boundary(gain, poles):
    grid = np.append(0.0, GRID)
    assert unstable_poles(lambda frequency: 1 + third_order(gain)(frequency)[:, 0, 0], grid) == poles


def test_nyquists_count_refines_its_grid():
    """A resonance 0.3 Hz wide between two points 1 Hz apart: the grid is refined there."""
    rate, pole = 1000.0, np.exp(2j * np.pi * (100.5 + 0.3j) / 1000.0)

    def difference(frequency):
        z = np.exp(2j * np.pi * frequency / rate)
        away = (z - pole) * (z - pole.conj())
        return 1 + 8e-3 * (z - 1) / away * sign

    for sign, poles in ((1.0, 0), (-1.0, 2)):
        roots = np.roots(np.polyadd(np.poly([pole, pole.conj()]).real, sign * 8e-3 * np.array([1.0, -1.0])))
        assert (abs(roots) > 1).sum() == poles
        assert unstable_poles(difference, np.linspace(0.0, 500.0, 501)) == poles


def test_least_margins_name_the_margin_that_falls_short():
    good = Margins(stable=True, modulus=0.6, worst_frequency=90.0, delay=1e-3, phase=1.0, gain=3.0)
    least = LeastMargins()
    assert least.complaint(good, 5000.0, 200.0) == ""
    for change, words in (
        ({"stable": False}, "the loop is unstable"),
        ({"modulus": 0.4}, "modulus margin 0.40 at 90 Hz is below 0.50"),
        ({"delay": 1e-4}, "delay margin 0.50 samples is below 1.00"),
        ({"phase": 0.5}, "phase margin 28.6 deg is below 30.0 deg"),
        ({"gain": 1.5}, "gain margin 1.50 is below 2.00"),
    ):
        assert least.complaint(replace(good, **change), 5000.0, 200.0) == words


def test_no_more_delay_is_required_than_the_highest_carrier_bears():
    """30 deg at 1 kHz is 0.42 samples at 5 kHz."""
    fast = Margins(stable=True, modulus=0.6, worst_frequency=9.0, delay=1e-4, phase=1.0, gain=3.0)
    assert LeastMargins().complaint(fast, 5000.0, 1000.0) == ""
    assert "below 0.42" in LeastMargins().complaint(replace(fast, delay=8e-5), 5000.0, 1000.0)


def test_an_unstable_loop_has_no_margins_and_keeps_none():
    assert Margins.unstable().modulus == 0.0
    for least in LEAST.values():
        assert least.complaint(Margins.unstable(), 5000.0, 100.0) == "the loop is unstable"
