"""The charts of benchmarks/charts: what is measured, what is on the front, and that the largest is drawn."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import measure, stability, stability_map
from benchmarks.charts.measure import Point, Setting


def point(error, nanoseconds, speed=1.0, **setting):
    return Point(setting=Setting(method="h2", **setting), error=error, nanoseconds=nanoseconds, speed=speed)


def test_the_front_holds_what_nothing_beats_in_both():
    cheap, good, worse = point(0.1, 1), point(0.01, 5), point(0.05, 6)
    equal, lost = point(0.0095, 7), point(np.inf, 0.1)
    assert measure.front([worse, good, lost, equal, cheap], lambda each: each.nanoseconds) == [cheap, good]


def test_a_setting_that_cannot_be_designed_says_why():
    setting = Setting(method="resonant", what="100 1/s", options={"gain": 100.0})
    (found,) = measure.measure([setting], rounds=1, progress=lambda _: None)
    assert "must be below" in found.refused
    assert not found.held


def test_the_stability_chart_is_drawn():
    rows = stability.measure(frequencies=2, bandwidths=2)
    stability.draw(rows, [stability_map.damper_map(stability.CASES[0])] * len(stability.CASES))
