"""The charts of benchmarks/charts: what is measured, what is on the front, and that every picture is drawn."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import measure, stability
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


def test_the_stability_chart_shows_what_a_wrong_plate_does():
    """On a plate 10 % stiffer than designed for, H is unstable near the heave mode at 5 Hz and H2 is not."""
    rows = stability.measure(frequencies=40, bandwidths=4)
    at = {name: row[1].growth[0, 0, 0][:, 1] for name, row in rows.items()}  # bandwidth 4.3 Hz
    assert at["h"].max() > 0
    assert at["h2"].max() < 0
    assert len(stability.draw(rows).axes) == 4 * len(stability.cases()) + 1
