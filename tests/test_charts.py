"""The charts of benchmarks/charts: what is measured, what is on the front, and that every picture is drawn."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from benchmarks import figures
from benchmarks.charts import measure, stability, stability_map, story
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
    _, _, h, h2 = (row[1].growth[:, 1] for row in rows.values())  # bandwidth 4.3 Hz
    assert h.max() > 0
    assert h2.max() < 0
    dampers = [stability_map.damper_map(stability.CASES[0])] * len(stability.CASES)
    assert len(stability.draw(rows, dampers).axes) == 5 * len(stability.CASES) + 1


def test_the_damper_of_the_waveform_law_has_the_margins_of_its_design():
    """Ms on a grid of 8.3 Hz, at a peak some 200 Hz wide: within (4.2/200)^2; stable below the gain margin only."""
    designed = stability_map.choose_damping(stability_map.MODEL).margins
    found = stability_map.damper_map(stability.CASES[0])
    assert stability.limits(found)[1] == pytest.approx(min(each.modulus for each in designed), rel=(4.2 / 200) ** 2)
    stable = stability_map.FACTORS < min(each.gain for each in designed)
    assert np.array_equal(found.growth[0] < 0, stable)


def test_no_motion_is_an_error_of_all_of_the_reference():
    time = np.arange(round(story.SECONDS * story.RATE)) / story.RATE
    with np.errstate(under="ignore"):  # in scipy's periodic splines
        reference = figures.white().waveform(time, None)
    for share in (0.0, 0.9):
        moved = figures.Run(time, share * reference[:, None] * np.ones(4), None, reference)
        assert list(story.over_time(moved)[2].values()) == pytest.approx([100 * (1 - share)] * 3)
