"""The damper by least squares: what it leaves of a load, its margins against exact poles, and where it is off."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from test_damping import bending, growth, heave_loop, heave_plant, loop_of, model_of

from hapticrender.control import load_damper
from hapticrender.control.damping import QUALITY, WORTH, DamperLoop, Oscillator, choose_damping, oscillators
from hapticrender.control.load_damper import (
    EFFORT_STEP,
    LEAST_EFFORT,
    LOW_END,
    LeastSquares,
    choose_load_damping,
    margins_hold,
)
from hapticrender.control.margins import LEAST, LeastMargins
from hapticrender.control.records import MOST_STRIDE
from hapticrender.plants.plate import EXPECTED_BENDING, PlateParameters

DEVICES = [(5000, 1), (5000, 25), (2000, 1), (1000, 1), (48000, 64), (192000, 1)]  # Hz, samples


def expected_of(rate, delay=1):
    """A plate that was not measured, whose bending mode may lie from 1.1 to 1.4 kHz, with either sign."""
    return replace(model_of(rate, delay), bending=EXPECTED_BENDING)


def every_sample(damping):
    """Taps (c, n), N/m, of every sample, with zeros between."""
    taps = np.zeros((len(damping.taps), damping.stride * damping.taps.shape[1]))
    taps[:, :: damping.stride] = damping.taps
    return taps


def left_by(taps, part, mode, c, rigid=False):
    """Of a load's step, over what is left without a damper: rms over the design's frequencies, with its weight."""
    design = LeastSquares(part, mode, c, rigid)
    left = design.load / abs(1.0 + design.p * design.response(taps / design.k)) ** 2
    return np.sqrt(left.sum() / design.load.sum())


def ringing(rate, delay, taps, mode=None):
    """Motion of heave by a step of a load (weighted rms, up to a factor), from that by a load of one sample."""
    plant, motions = heave_plant(rate, mode), np.zeros(rate)
    x = np.zeros((len(plant.a), 1))
    forces, past = np.zeros(delay + 1), np.zeros(len(taps))
    for n in range(rate):
        motions[n] = (plant.c @ x).item()
        past = np.concatenate([[motions[n]], past[:-1]])
        forces = np.concatenate([forces[1:], [-taps @ past]])
        x = plant.a @ x + plant.b * ((n == 0) + forces[0])
    frequency = np.arange(rate // 2 + 1)  # Hz
    step = np.fft.rfft(motions)[1:] / frequency[1:] * np.minimum(frequency[1:] / LOW_END, 1.0) ** 2
    return float(np.sqrt(np.sum(abs(step) ** 2)))


@pytest.mark.parametrize(("rate", "delay"), [(5000, 1), (5000, 25), (1000, 1), (20000, 4)])
def test_a_load_leaves_less_than_with_the_viscous_damper(rate, delay):
    """Sample by sample, not by the design's integral."""
    model = expected_of(rate, delay)
    viscous, chosen = (every_sample(choose(model))[0] for choose in (choose_damping, choose_load_damping))
    assert ringing(rate, delay, chosen) < ringing(rate, delay, viscous)


def test_what_a_load_leaves_is_that_of_the_documents():
    """Heave and rocking, to the three digits that docs/theory.md has; then of the viscous damper."""
    model, found = expected_of(5000), []
    for damping in (choose_load_damping(model), choose_damping(model)):
        for c, part in enumerate(oscillators(model)):
            found.append(left_by(every_sample(damping)[c], part, model.bending, c))
    np.testing.assert_allclose(found, [0.355, 0.214, 0.471, 0.386], atol=0.0005)


def test_what_is_left_is_that_of_the_exact_loop():
    """The design's integral over frequency, in steps of 0.5 Hz, against the loop sample by sample, in steps of 1 Hz."""
    model = expected_of(5000)
    part, taps = oscillators(model)[0], choose_load_damping(model).taps[0]
    left = left_by(taps, part, model.bending, 0)
    assert ringing(5000, 1, taps) / ringing(5000, 1, 0.0 * taps) == pytest.approx(left, rel=0.01)


@pytest.mark.parametrize(("rate", "delay"), DEVICES)
def test_margins_hold_and_are_where_the_exact_poles_cross(rate, delay):
    """Poles of a matrix beside margins by frequency, on both sides of the gain margin; no static force."""
    chosen = choose_load_damping(expected_of(rate, delay))
    taps, parts = every_sample(chosen), oscillators(model_of(rate, delay))
    assert abs(chosen.taps.sum(axis=1)).max() < 1e-9 * abs(chosen.taps).max()
    assert chosen.taps.any(axis=1).all()
    assert chosen.stride <= MOST_STRIDE
    for c, part in enumerate(parts):
        assert margins_hold(part, chosen.taps[c], EXPECTED_BENDING, c)
    for late, mode in itertools.product((0, 1), EXPECTED_BENDING.corners()):  # it couples into heave alone
        loop = DamperLoop(parts[0]._replace(delay=delay + late), chosen.taps[0], mode, 0, chosen.stride)
        assert LEAST["spread"].complaint(loop.margins(), rate) == ""
    if rate > 5000:
        return  # its matrix has 400 states
    margins = heave_loop(model_of(rate, delay), taps).margins()
    assert LEAST["damper"].complaint(margins, rate) == ""
    plant = heave_plant(rate)
    assert growth(loop_of(plant, 0.999 * margins.gain * taps[:1], delay)) < 1e-3
    assert growth(loop_of(plant, 1.001 * margins.gain * taps[:1], delay)) > 0.0


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("frequency", [1100.0, 1180.0, 1250.0, 1330.0, 1400.0])
def test_a_mode_wherever_it_is_expected_stays_stable(frequency, late, sign):
    """By exact poles; a damper that knows of none makes one of them grow."""
    mode = bending(0.1 * sign, frequency)
    chosen = choose_load_damping(expected_of(5000)).taps[:1]
    assert growth(loop_of(heave_plant(5000, mode), chosen, 1 + late)) < 1e-3


def test_a_damper_that_knows_of_no_mode_drives_one():
    """The other side: designed for a rigid plate."""
    rigid = choose_load_damping(replace(model_of(5000), rigid=True)).taps[:1]
    grows = [growth(loop_of(heave_plant(5000, bending(coil, 1100.0)), rigid, 1)) for coil in (-0.1, 0.1)]
    assert max(grows) > 1.0


@pytest.mark.parametrize("coil", [-0.1, 0.1])
@pytest.mark.parametrize("frequency", [450.0, 600.0, 850.0, 2000.0])
def test_a_measured_mode_keeps_its_margin_anywhere_within_its_spread(frequency, coil):
    """100 Hz to either side, and not at the ends alone, where the design sees to it."""
    stated = bending(coil, frequency)
    part, taps = oscillators(model_of(5000))[0], choose_load_damping(replace(model_of(5000), bending=stated)).taps[0]
    assert taps.any()
    for off in np.linspace(-stated.spread, stated.spread, 21):
        loop = DamperLoop(part, taps, bending(coil, frequency + off), 0)
        assert LEAST["spread"].complaint(loop.margins(), 5000) == "", off


@pytest.mark.parametrize(("frequency", "coil"), [(700.0, -0.1), (1150.0, 0.1)])
def test_beside_a_measured_mode_a_load_leaves_less_than_with_the_viscous_damper(frequency, coil):
    mode = bending(coil, frequency)
    model = replace(model_of(5000), bending=mode)
    assert growth(loop_of(heave_plant(5000, mode), choose_load_damping(model).taps[:1], 1)) < 1e-3
    chosen, viscous = (choose(model).taps[0] for choose in (choose_load_damping, choose_damping))
    assert ringing(5000, 1, chosen, mode) < ringing(5000, 1, viscous, mode)


def test_it_is_the_strongest_whose_margins_hold():
    """With a weight of the force one step less a margin fails, with taps a quarter larger the margin of gain, 2.5."""
    model = replace(model_of(5000), rigid=True)
    part, chosen = oscillators(model)[0], choose_load_damping(model).taps[0]
    design = LeastSquares(part, None, 0, rigid=True)
    weights = LEAST_EFFORT * EFFORT_STEP ** np.arange(300)
    holds = [margins_hold(part, design.taps(float(weight)), None, 0) for weight in weights[::10]]
    first = int(np.argmax(holds))
    assert 0 < first
    assert all(holds[first:])
    found = next(weight for weight in weights if margins_hold(part, design.taps(float(weight)), None, 0))
    np.testing.assert_allclose(chosen, design.taps(float(found)), rtol=1e-9)
    assert not margins_hold(part, 1.25 * chosen, None, 0)


def test_a_plate_of_which_nothing_is_known_has_a_weaker_damper_at_high_frequency():
    """Its surface may bend anywhere above 450 Hz; that of a rigid one may not."""
    unknown, rigid = (choose_load_damping(replace(model_of(5000), rigid=each)).taps[0] for each in (False, True))
    gains = [abs(np.fft.rfft(taps, 1000))[90:] for taps in (unknown, rigid)]  # above 450 Hz
    assert np.linalg.norm(gains[0]) < 0.9 * np.linalg.norm(gains[1])


@pytest.mark.parametrize(("quality", "on"), [(0.99, False), (1.01, True)])
def test_it_is_off_where_the_mode_damps_itself(quality, on):
    """Where it could not add 3.5 times the mode's own damping with a Q of 1.4: over the bound and under it."""
    free = model_of(5000)
    ratio = 1.0 / (2.0 * WORTH * QUALITY * quality)
    heave = free.damping.copy()
    heave[0, 0] *= ratio / oscillators(free)[0].ratio
    assert choose_load_damping(replace(free, damping=heave)).taps.any(axis=1).tolist() == [on, True]


def test_it_is_found_on_odd_plates_whatever_their_unit_of_mass(rng):
    """Peaks narrower than the design's steps of frequency included, whose normal equations nearly are singular."""
    rounding = np.finfo(float).eps / load_damper.RIDGE  # times the largest condition
    for _ in range(8):
        rate, ratio, mass = (10.0 ** rng.uniform(*each) for each in ((3.0, 5.0), (-4.0, -1.1), (-3.0, 0.0)))
        part = Oscillator(rate, 1, mass, 2 * np.pi * rng.uniform(20.0, min(400.0, rate / 5)), ratio, 0.7)
        taps = load_damper._chosen(part, None, 0, True)
        assert left_by(taps, part, None, 0, rigid=True) < 1.0
        heavy = load_damper._chosen(part._replace(mass=3.0 * mass), None, 0, True)
        np.testing.assert_allclose(heavy, 3.0 * taps, rtol=0.0, atol=rounding * abs(heavy).max())


@pytest.mark.parametrize(("rate", "delay", "most"), [(5000, 3, 1.8), (48000, 64, 2.0), (5000, 25, 3.0)])
def test_a_stiff_finger_takes_some_of_the_margins(rate, delay, most):
    """Ms by docs/theory.md, under 12 kN/m without mass or damping, which no design includes."""
    model, found = expected_of(rate, delay), []
    for choose, (c, part) in itertools.product((choose_damping, choose_load_damping), enumerate(oscillators(model))):
        damping = choose(model)
        stiffer = np.sqrt(1.0 + 12e3 / (part.mass * part.omega**2))
        touched = part._replace(omega=stiffer * part.omega, ratio=part.ratio / stiffer)
        found.append(1.0 / DamperLoop(touched, damping.taps[c], None, c, damping.stride).margins().modulus)
    assert max(found) == pytest.approx(most, abs=0.05)  # its last digit


@pytest.mark.parametrize("frequency", [60.0, 190.0])
def test_a_mode_below_the_usual_spread_is_taken(frequency):
    """Its spread is half its frequency then; rocking, into which it does not couple, keeps its damper."""
    model = PlateParameters(bending_frequency=frequency).device_model(5000.0, 1)
    assert choose_load_damping(model).taps[1].any()


def test_it_is_off_where_no_margins_hold(monkeypatch):
    monkeypatch.setitem(LEAST, "damper", LeastMargins(gain=1e6))
    load_damper._chosen.cache_clear()
    assert not choose_load_damping(model_of(5000)).on
    load_damper._chosen.cache_clear()


def test_it_is_off_where_none_would_help():
    """No mass, a loop that comes a period late; rocking alone where heave's is too late."""
    friction = replace(model_of(5000), mass=np.zeros((2, 2)))
    for model in (friction, model_of(48000, 400)):
        assert not choose_load_damping(model).on
    late = choose_load_damping(model_of(48000, 256))
    assert late.taps.any(axis=1).tolist() == [False, True]
