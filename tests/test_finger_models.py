"""Fits of finger models: their intervals cover the truth as often as they say, and the data choose the order."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2
from subjects import FREQUENCIES, make_impedance, population

import hapticrender as hr
from examples.grigorii2021.load_law import load_exponent
from hapticrender.analysis.models import FEWEST, LOAD_CLASSES
from hapticrender.analysis.pictures import fit_all
from hapticrender.analysis.records import LOADED, FingerRecord, PlateTrack, Series
from hapticrender.touch.mechanics import HEAVY, LIGHT, LIGHT_SECOND

DRAWS = {2: 120, 4: 30}
RARE = 1e-4  # probability of a false alarm of a bound
FINGERS = {2: LIGHT_SECOND, 4: LIGHT}


@pytest.mark.parametrize("order", [2, 4])
def test_intervals_chi_square_and_errors_of_many_fits_are_those_stated(order):
    """Intervals cover the truth at each fit's own reference load as often as they say; p is that of a true model."""
    rng, finger = np.random.default_rng(order), FINGERS[order]
    fits = [hr.fit_finger(make_impedance(rng, finger, 8, (0.1, 0.49), masked=0.1), order) for _ in range(DRAWS[order])]
    growth = np.array([finger.load_factor(fit.mechanics.reference_load) for fit in fits])
    for name in fits[0].names:
        truth = np.full(len(fits), 1 / 3) if name == "load_exponent" else getattr(finger, name) * growth
        for level in (0.683, 0.95):
            low, high = np.array([fit.interval(name, level) for fit in fits]).T
            hits = int(((low <= truth) & (truth <= high)).sum())
            assert binom.ppf(RARE, len(truth), level) <= hits <= binom.ppf(1 - RARE, len(truth), level), (name, hits)
    p = np.array([fit.p_value for fit in fits])
    assert p.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * len(p)))  # p is uniform
    f = np.array([25.0, 150.0, 400.0])
    off = np.log([fit.impedance(f) / finger.impedance(f) for fit in fits]) - np.log(growth)[:, None]
    predicted = np.mean([fit.relative_error(f) for fit in fits], axis=0)
    for part in (np.real, np.imag):  # ln |Z| and phase; the standard error of a deviation is 1/sqrt(2 n) of it
        measured = np.sqrt(np.mean(part(off) ** 2, axis=0))
        np.testing.assert_allclose(measured, part(predicted), rtol=4 / np.sqrt(2 * len(off)))


def test_errors_of_the_plate_are_not_averaged_over_windows():
    """All windows of a record have the same error of the plate's mass, damping and stiffness, drawn for each record."""
    rng, w = np.random.default_rng(3), 2 * np.pi * FREQUENCIES
    errors = np.array([3e-5, 0.02, 10.0])  # kg, N s/m, N/m
    patterns = np.array([1j * w, w**0, 1 / (1j * w)])
    sides = zip(("damping", "stiffness"), errors[1:], strict=True)
    stated = {f"{name}_{side}": np.full(6, each / np.sqrt(2)) for name, each in sides for side in (1, 2)}
    nothing = Series(np.zeros(6), np.ones(6), 10.0)
    touch = {"time": np.arange(6.0), "contact": np.full(6, LOADED), "normal_load": nothing, "position": nothing}
    plate, pulls = PlateTrack(np.arange(6.0), {}, stated, True), {"record": [], "impedance": []}
    touch |= {"velocity": nothing, "name": "", "segments": (), "plate": plate, "least_load": 0.1}
    for _ in range(60):
        z = make_impedance(rng, LIGHT_SECOND, 8, (0.1, 0.49), noise=0.02)
        stated = np.sqrt(z.standard_error**2 + errors**2 @ np.abs(patterns) ** 2 / 2)
        z = replace(z, value=z.value + (errors * rng.standard_normal(3)) @ patterns, standard_error=stated)
        for name, measured in (("record", FingerRecord(**touch, impedance=z)), ("impedance", z)):
            fit = hr.fit_finger(measured, 2)
            truth = LIGHT_SECOND.load_factor(fit.mechanics.reference_load)
            parts = [(getattr(fit.mechanics, key) / getattr(LIGHT_SECOND, key) - truth) for key in fit.names[:3]]
            sigma = [fit.standard_errors[key] / getattr(LIGHT_SECOND, key) for key in fit.names[:3]]
            pulls[name].append(np.divide(parts, sigma))
    inside = (np.abs(pulls["record"]) < 1).sum(axis=0)
    assert (binom.ppf(RARE, 60, 0.683) <= inside).all()
    assert (np.sqrt(np.mean(np.square(pulls["impedance"]), axis=0)) > 1.5).all()


@pytest.mark.parametrize(("order", "draws"), [(2, 8), (4, 4)])
def test_the_data_choose_the_order(rng, order, draws):
    """A finger of the 2nd order seems one of the 4th where chi^2 of 3 parameters gains more than 3 ln N."""
    fits = [hr.fit_finger(make_impedance(rng, FINGERS[order], 6, (0.1, 0.49))) for _ in range(draws)]
    wrong = sum(fit.order != order for fit in fits)
    assert wrong <= binom.ppf(1 - RARE, draws, chi2.sf(3 * np.log(2 * 6 * len(FREQUENCIES)), 3))
    assert all(fit.bic_margin > 0 for fit in fits)


def test_each_class_of_loads_has_its_own_finger(rng):
    light, heavy = (make_impedance(rng, LIGHT, 12, (0.1, 0.49)), make_impedance(rng, HEAVY, 12, (0.51, 1.5)))
    fits = fit_all([light, heavy])
    assert list(fits) == list(LOAD_CLASSES)
    for finger, (name, of_class) in zip((LIGHT, HEAVY), fits.items(), strict=True):
        fit = next(iter(of_class.values()))  # the better one
        assert LOAD_CLASSES[name][0] <= fit.loads[0] < fit.loads[1] < LOAD_CLASSES[name][1]
        truth = finger.stiffness * finger.load_factor(fit.mechanics.reference_load)
        assert abs(fit.mechanics.stiffness - truth) < 4 * fit.standard_errors["stiffness"] < truth
    assert list(fit_all([light])) == ["light"]


def test_the_fingers_of_simulated_subjects_are_found():
    """Two of Table 1, of either order, on plates 2 % off their profile: order, and 95 % intervals of all numbers."""
    inside = []
    for subject in population(10)[:4:3]:
        fit = hr.fit_finger(hr.analyse_finger(subject.record()))
        assert fit.order == subject.mechanics.order
        growth = subject.mechanics.load_factor(fit.mechanics.reference_load)
        given = {name: getattr(subject.mechanics, name, 0) * growth for name in fit.names} | {"load_exponent": 1 / 3}
        inside += [
            low <= given[name] <= high for name, (low, high) in ((each, fit.interval(each)) for each in fit.names)
        ]
    assert sum(inside) >= binom.ppf(RARE, len(inside), 0.95)


def test_at_one_load_there_is_no_exponent(rng):
    data = make_impedance(rng, LIGHT_SECOND, 5, (0.3, 0.3))
    assert hr.fit_finger(data, 2).names == ("mass", "damping", "stiffness")
    assert np.isnan(load_exponent(data).exponent).all()


@pytest.mark.parametrize("order", [2, 4])
def test_too_few_carriers_are_refused_and_enough_are_not(rng, order):
    few = make_impedance(rng, LIGHT, 6, (0.1, 0.49), frequency=FREQUENCIES[: FEWEST[order] - 1])
    with pytest.raises(ValueError, match=f"{FEWEST[order] - 1} different carriers .* needs at least {FEWEST[order]}"):
        hr.fit_finger(few, order)
    enough = make_impedance(rng, LIGHT, 6, (0.1, 0.49), frequency=FREQUENCIES[: FEWEST[order]])
    assert hr.fit_finger(enough, order).order == order
    assert hr.fit_finger(enough).order == order  # with two carriers only the 2nd order can be fitted


@pytest.mark.parametrize("exponent", [0.0, 1 / 3])
@pytest.mark.parametrize("stated", [1.0, 1 / 3])
def test_the_exponent_is_within_its_error_also_where_the_windows_scatter_more_than_they_state(rng, exponent, stated):
    laws = []
    for _ in range(40):
        data = make_impedance(rng, LIGHT, 60, (0.1, 1.2), exponent=exponent, noise=0.06)
        laws.append(load_exponent(replace(data, standard_error=stated * data.standard_error)))
    off = np.array([(law.exponent - exponent) / law.standard_error for law in laws])
    inside = np.abs(off) < 1
    assert inside.mean() == pytest.approx(0.683, abs=4 * np.sqrt(0.683 * 0.317 / off.size))
    np.testing.assert_array_equal(laws[0].frequency, FREQUENCIES)
    assert (laws[0].count == 60).all()
