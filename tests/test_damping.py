"""The inner damper: its taps, its margins against exact poles, and a bending mode that it must not drive."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.charts.poles import growth
from hapticrender.control.damping import (
    BendingMode,
    added_damping,
    choose_damping,
    damper_loops,
    damping_taps,
    oscillators,
)
from hapticrender.control.linear import DiscretePlant, ErrorLoop
from hapticrender.plants.plate import PlateParameters

PLATE = PlateParameters()
HEAVE, ROCKING = 0, 1
MODAL_MASS = 9.5e-3


def model_of(rate, delay=1):
    return replace(PLATE.device_model(float(rate), delay), rigid=False)  # a plate that was not measured


def heave_loop(model, taps, mode=None):
    return damper_loops(oscillators(model), taps, mode)[HEAVE]


def bending(coil, frequency=1150.0, **more):
    return BendingMode(frequency=frequency, damping=0.01, coupling=(coil / MODAL_MASS, 0.0), **more)


def loop_of(plant, taps, delay):
    """Closed loop of nothing but the damper; its poles come from a matrix, apart from the margins under test."""
    c = len(taps)
    return ErrorLoop(
        plant=plant,
        delay=delay,
        frequency=np.array([100.0]),
        observer=0.0,
        integral=0.0,
        dc=0.0,
        dc_drift=0.0,
        inner=1.0,
        taps=taps,
        law=np.zeros((1, c, c), complex),
        slope=np.zeros((1, c, c), complex),
        share=np.ones(1),
    )


def test_margins_of_many_bands_take_no_gigabytes():
    """Bands that drive nothing leave those of the damper; an array of all frequencies and 200 bands has 120 MB."""
    count = 200
    taps = damping_taps(oscillators(model_of(5000)), 2.0)[:1]
    alone = loop_of(heave_plant(5000), taps, 1)
    bands = {"frequency": np.linspace(20.0, 400.0, count), "share": np.ones(count), "observer": 4e-3}
    loop = replace(alone, **bands, law=np.zeros((count, 1, 1), complex), slope=np.zeros((count, 1, 1), complex))
    tracemalloc.start()
    found = loop.margins()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.modulus == pytest.approx(alone.margins().modulus, rel=0.01)
    assert peak < 50e6


def heave_plant(rate, mode=None):
    """Heave alone, with the bending mode beside it; the sensors show the sum of the two displacements."""
    both = np.array([[32e-3, 1.7, 45.3e3]])
    if mode is not None:
        omega, mass = 2 * np.pi * mode.frequency, 1.0 / mode.coupling[0]
        both = np.vstack([both, [mass, 2 * mode.damping * omega * mass, omega**2 * mass]])
    free = DiscretePlant.free(*(np.diag(column) for column in both.T), float(rate))
    return replace(free, b=free.b.sum(axis=1, keepdims=True), c=free.c.sum(axis=0, keepdims=True))


def holds(taps, rate, delay, mode=None):
    """Whether the poles of the heave loop decay; carrier and DC estimate, which are not driven, neither do nor grow."""
    return growth(loop_of(heave_plant(rate, mode), taps[None, :], delay)) < 1e-3


def test_taps_are_those_of_the_study():
    """At the plate's coupled modes 189.38 and 147.27 Hz: printed to 1e-3 of themselves."""
    parts = oscillators(model_of(5000))
    taps, added = damping_taps(parts, 1.4), added_damping(parts, 1.4)
    np.testing.assert_allclose(added, [27.2, 35.0], atol=0.05)
    expected = [[379679, -645298, 265619], [502327, -847020, 344693]]
    np.testing.assert_allclose(taps, expected, rtol=1e-3)


@pytest.mark.parametrize(("rate", "quality", "noise"), [(5000, 2.0, 0.22), (5000, 1.0, 0.43), (20000, 1.4, 0.11)])
def test_noise_is_that_of_the_study_and_of_the_exact_loop(rate, quality, noise):
    """1 um on each end is 0.707 um on heave; the exact rms sums the impulse response from the sensor's noise."""
    model = model_of(rate)
    taps = damping_taps(oscillators(model), quality)
    found = heave_loop(model, taps).noise()
    assert found == pytest.approx(noise, abs=0.005)
    plant, x, past, force, power = heave_plant(rate), np.zeros((2, 1)), np.zeros(3), 0.0, 0.0
    for n in range(rate // 20):  # decayed to exp(-2 pi 189 / 4 / 20), squared
        motion = (plant.c @ x).item()
        past = np.array([motion + (n == 0), *past[:-1]])  # a unit of noise in one sample
        x, force = plant.a @ x + plant.b * force, -taps[0] @ past
        power += motion**2
    assert found == pytest.approx(math.sqrt(power / 2), rel=1e-3)


@pytest.mark.parametrize(
    ("rate", "delay", "quality", "margin"),
    [(5000, 1, 1.4, 0.86e-3), (5000, 3, 2.5, None), (20000, 1, 1.4, 0.96e-3), (2000, 1, 3.0, None)],
)
def test_margins_are_where_the_exact_poles_cross(rate, delay, quality, margin):
    """Both sides of the gain margin, and the whole samples on both sides of the delay margin."""
    model = model_of(rate, delay)
    taps = damping_taps(oscillators(model), quality)
    found = heave_loop(model, taps).margins()
    assert holds(0.999 * found.gain * taps[HEAVE], rate, delay)
    assert not holds(1.001 * found.gain * taps[HEAVE], rate, delay)
    late = math.floor(found.delay * rate)
    assert holds(taps[HEAVE], rate, delay + late)
    assert not holds(taps[HEAVE], rate, delay + late + 1)
    assert margin is None or found.delay == pytest.approx(margin, abs=5e-6)


def test_five_taps_carry_zeros_at_the_bending_mode():
    """Its five equations, and the margins of the study: Ms 1.63, gain 2.8, phase 79 deg, noise 0.278 at Q 1.4."""
    model = model_of(5000)
    parts = oscillators(model)
    taps, added = damping_taps(parts, 1.4, bending(0.1)), added_damping(parts, 1.4)
    order = np.arange(5)
    scale = abs(taps[HEAVE]).sum()
    assert abs(taps[HEAVE].sum()) < 1e-12 * scale
    assert abs(np.exp(-2j * np.pi * 1150 / 5000 * order) @ taps[HEAVE]) < 1e-12 * scale
    omega = math.sqrt(45.3e3 / 32e-3)
    force = np.exp(-1j * omega / 5000 * order) @ taps[HEAVE] * model.hold_and_delay(omega / (2 * np.pi))
    assert force == pytest.approx(1j * omega * added[HEAVE], rel=1e-9)
    np.testing.assert_array_equal(taps[ROCKING], np.append(damping_taps(oscillators(model), 1.4)[ROCKING], [0.0, 0.0]))
    found = heave_loop(model, taps).margins()
    assert 1 / found.modulus == pytest.approx(1.63, abs=0.005)
    assert found.gain == pytest.approx(2.8, abs=0.05)
    assert math.degrees(found.phase) == pytest.approx(79, abs=0.5)
    assert heave_loop(model, taps).noise() == pytest.approx(0.278, abs=0.0005)


@pytest.mark.parametrize(("rate", "delay", "quality"), [(5000, 1, 2.0), (5000, 3, 2.5)])
def test_quality_is_the_least_that_keeps_the_bounds(rate, delay, quality):
    model = model_of(rate, delay)
    chosen, parts = choose_damping(model), oscillators(model)
    assert chosen.quality == quality
    for found in (loop.margins() for loop in damper_loops(parts, chosen.taps)):
        assert 1 / found.modulus <= 1.7
        assert found.gain >= 2.5
        assert found.phase >= math.radians(60)
        assert found.delay * rate >= 1.0
    if quality > 2.0:
        below = [loop.margins() for loop in damper_loops(parts, damping_taps(parts, quality - 0.1))]
        assert any(1 / found.modulus > 1.7 or found.gain < 2.5 for found in below)


@pytest.mark.parametrize(("rate", "coil", "quality"), [(5000, -0.1, 1.5), (5000, 0.1, 1.9), (20000, -0.1, 1.4)])
def test_a_measured_mode_lets_the_quality_down(rate, coil, quality):
    chosen = choose_damping(replace(model_of(rate), bending=bending(coil)))
    assert chosen.quality == quality
    for frequency in (1050.0, 1100.0, 1150.0, 1200.0, 1250.0):
        assert holds(chosen.taps[HEAVE], rate, 1, bending(coil, frequency))


def test_a_slow_or_late_loop_raises_the_quality_or_switches_off():
    """32 samples at 48 kHz can still be borne; a period of the mode, or 500 Hz, cannot."""
    assert choose_damping(model_of(48000, 32)).quality == 2.5
    viscous = PlateParameters(damping_1=20.0, damping_2=20.0).device_model(5000.0, 1)
    for model in (model_of(500), model_of(48000, 256), viscous):
        off = choose_damping(model)
        assert off.quality == math.inf
        assert not off.on
