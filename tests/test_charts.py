"""The charts of benchmarks/charts: what is measured, what is on the front, and that every picture is drawn."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import draw, measure, stability
from benchmarks.charts.measure import Point, Setting
from hapticrender import Grating


def point(error, nanoseconds, speed=1.0, **setting):
    return Point(setting=Setting(method="h2", **setting), error=error, nanoseconds=nanoseconds, speed=speed)


def test_the_front_holds_what_nothing_beats_in_both():
    cheap, good, worse = point(0.1, 1), point(0.01, 5), point(0.05, 6)
    equal, lost = point(0.0095, 7), point(np.inf, 0.1)
    assert measure.front([worse, good, lost, equal, cheap], lambda each: each.nanoseconds) == [cheap, good]


def test_every_method_and_device_is_there():
    settings = measure.methods_and_settings()
    assert {each.method for each in settings} == set(measure.METHODS)
    assert {each.block for each in settings} == {1, 10, 25, 32, 64}
    assert len({(each.method, each.what) for each in settings}) == len(settings)
    assert {each.device for each in measure.devices_and_levels()} == set(measure.LEVELS)


@pytest.mark.parametrize(
    ("method", "frequency", "holds"), [("h2", 178.0, True), ("paper", 178.0, False), ("paper-common", 47.0, True)]
)
def test_errors_tell_methods_that_hold_from_those_that_do_not(method, frequency, holds):
    """Two sides controlled separately fail at 129-189 Hz; the others stay within 1 %."""
    error = measure.error_of(Setting(method=method), Grating(frequency=frequency, velocity=0.01), measure.HEAVY)
    assert error < 0.01 if holds else error > 0.1


def test_a_setting_that_cannot_be_designed_says_why():
    setting = Setting(method="resonant", what="100 1/s", options={"gain": 100.0})
    (found,) = measure.measure([setting], rounds=1, progress=lambda _: None)
    assert "must be below" in found.refused
    assert not found.held


def test_pictures_of_the_points():
    """Every point of a front is named; lost and refused points are drawn or left out without an error."""
    points = [point(0.1, 9.0, 9.0), point(0.01, 5.0, 5.0, what="x"), point(np.inf, 2.0, 2.0)]
    swept = {"vt-plate h2": [0.01] * len(measure.SWEEP), "vt-plate h": [np.nan] * len(measure.SWEEP)}
    data = measure.as_data(points, swept)
    assert [each["error"] for each in data["points"]] == [0.1, 0.01, None]
    cost = draw.pareto(points, swept).axes[0]
    assert any("1  h2, x" in each.get_text() for each in cost.texts)
    points.append(point(0.2, 3.0, 3.0, device="ultrasonic", level="envelope"))
    speed = draw.devices(points, {"vt-plate h2": swept["vt-plate h2"]}).axes[0]
    assert {each.get_text() for each in speed.texts} >= {"h2", "h2, x"}


def test_the_stability_chart_shows_what_a_wrong_plate_does():
    """On a plate 10 % stiffer than designed for, H is unstable near the heave mode at 5 Hz and H2 is not."""
    rows = stability.measure(frequencies=40, bandwidths=4)
    at = {name: row[1].growth[0, 0, 0][:, 1] for name, row in rows.items()}  # bandwidth 4.3 Hz
    assert at["h"].max() > 0
    assert at["h2"].max() < 0
    assert len(stability.draw(rows).axes) == 4 * len(stability.cases()) + 1
