"""The charts of benchmarks/charts: what cannot be measured, and that the largest is drawn."""

import pytest

pytest.importorskip("matplotlib")

from benchmarks.charts import stability, stability_map


def test_the_stability_chart_is_drawn():
    rows = stability.measure(frequencies=2, bandwidths=2)
    stability.draw(rows, [stability_map.damper_map(stability.CASES[0])] * len(stability.CASES))
