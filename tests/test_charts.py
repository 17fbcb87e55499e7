"""The charts of benchmarks/charts: that the largest is drawn, of two of its cases."""

import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import stability, stability_map


def test_the_stability_chart_is_drawn(monkeypatch):
    monkeypatch.setattr(stability, "CASES", stability.CASES[:2])
    stability.draw(stability.measure(2, 2), [stability_map.damper_map(stability.CASES[0])] * 2)
