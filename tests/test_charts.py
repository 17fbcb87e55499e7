"""The charts of benchmarks/charts: what cannot be measured, and that the largest is drawn."""

import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import measure, stability, stability_map
from benchmarks.charts.measure import Point, Setting


def test_a_setting_that_cannot_be_designed_says_why():
    setting = Setting(method="resonant", what="100 1/s", options={"gain": 100.0})
    (found,) = measure.measure([setting], rounds=1, progress=lambda _: None)
    assert "must be below" in found.refused
    assert not found.held


def test_the_front_is_what_nothing_beats_in_both():
    setting = Setting(method="h2")
    errors_and_costs = [(0.02, 3.0), (0.05, 1.0), (0.05, 2.0), (0.001, 9.0), (0.03, 4.0), (measure.LOST, 0.5)]
    points = [Point(setting=setting, error=error, nanoseconds=cost) for error, cost in errors_and_costs]
    found = measure.front(points, lambda point: point.nanoseconds)
    assert [(point.error, point.nanoseconds) for point in found] == [(0.05, 1.0), (0.02, 3.0), (0.001, 9.0)]


def test_the_stability_chart_is_drawn():
    rows = stability.measure(frequencies=2, bandwidths=2)
    stability.draw(rows, [stability_map.damper_map(stability.CASES[0])] * len(stability.CASES))
