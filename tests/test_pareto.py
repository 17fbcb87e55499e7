"""The chart of accuracy against cost: what it measures, what it calls the front, and what it calls lost."""

import json

import numpy as np
import pytest

from hapticrender.accuracy.plate import SLIDING, tones
from hapticrender.charts import pareto
from hapticrender.control.methods import METHODS


def point(error, nanoseconds, speed=1.0):
    setting = pareto.Setting(method="h2", what="", design=METHODS["h2"].design)
    return pareto.Point(setting=setting, error=error, nanoseconds=nanoseconds, speed=speed)


def test_the_front_holds_what_nothing_beats_in_both():
    cheap, good, worse, alike, lost = (
        point(0.1, 1),
        point(0.01, 5),
        point(0.05, 6),
        point(0.0095, 7),
        point(np.inf, 0.1),
    )
    found = pareto.front([worse, good, lost, alike, cheap], lambda each: each.nanoseconds)
    assert found == [cheap, good]


def test_every_method_is_there_at_several_settings():
    settings = pareto.every_setting()
    assert {each.method for each in settings} == set(METHODS)
    assert len({(each.method, each.what) for each in settings}) == len(settings)
    for name in METHODS:
        assert sum(each.method == name for each in settings) >= 2
    assert {each.block for each in settings} == {1, 10, 25, 32, 64}
    assert any("single" in each.what for each in settings)
    assert any("heave only" in each.what for each in settings)


def test_errors_are_those_of_a_motion_that_is_known():
    """A tone 2 % too large before the finger, 5 % under it; wandering by 0.1 of it, slowly."""
    bands, rate = tones([100.0], 1e-6), 5000.0
    time = np.arange(int(4 * rate)) / rate
    size = np.where(time < 1.3, 1.02, 1.05)
    motion = 1e-6 * size * np.cos(2 * np.pi * 100 * time)
    assert pareto.found_error(motion, bands, rate, (pareto.FREE,)) == pytest.approx(0.02, rel=1e-6)
    assert pareto.found_error(motion, bands, rate, (pareto.FREE, pareto.HELD)) == pytest.approx(0.05, rel=1e-6)
    assert pareto.wandering(motion, bands, rate) < 1e-9
    motion *= 1 + 0.1 * np.sqrt(2) * np.cos(2 * np.pi * 3 * time)
    assert pareto.wandering(motion, bands, rate) == pytest.approx(0.105, rel=0.02)
    assert pareto.found_error(np.full(len(time), np.nan), bands, rate, (pareto.HELD,)) == np.inf


def test_it_draws_and_writes_what_it_measured(tmp_path, monkeypatch):
    """Two settings and two carriers: the paper's controller is lost or far off at 178 Hz, h2 holds within 1 %."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(pareto, "MAP", np.array([100.0, 178.0]))
    settings = [each for each in pareto.every_setting() if each.what in ("as it comes", "5 Hz")]
    settings = [each for each in settings if each.method in ("paper", "h2")]
    monkeypatch.setattr("hapticrender.charts.pareto_picture.MAP", pareto.MAP)
    told = []
    points = pareto.pareto(tmp_path / "pareto.png", settings=settings, rounds=1, progress=told.append)
    by_name = {each.setting.method: each for each in points}
    assert by_name["paper"].scenes["178 Hz"] > 0.3
    assert by_name["h2"].error < 0.01
    assert all(each.nanoseconds > 0 and each.speed > 0 for each in points)
    data = json.loads((tmp_path / "pareto.json").read_text(encoding="utf-8"))
    assert [each["front"] for each in data["points"]].count(True) >= 1
    error, wandering = (np.array(data["stability"][key]["paper"], float) for key in ("error", "wandering"))
    assert error[0] < pareto.OFF
    assert max(error[1], wandering[1]) > pareto.RESTLESS
    assert max(data["stability"]["error"]["h2"]) < pareto.OFF
    assert max(data["stability"]["wandering"]["h2"]) < pareto.RESTLESS
    assert (tmp_path / "pareto.png").stat().st_size > 10_000
    assert told[-1] == "stability: h2"


def test_a_setting_that_cannot_be_designed_says_why():
    setting = pareto.Setting(
        method="resonant", what="100 1/s", design=pareto._plain(METHODS["resonant"].__class__(gain=100.0))
    )
    (found,) = pareto.measure([setting], rounds=1)
    assert "must be below" in found.refused
    assert not found.stable


def test_blocks_are_played_as_blocks():
    """A controller in blocks follows a tone under the sliding finger within the bound of its own tests."""
    setting = next(each for each in pareto.every_setting() if each.block == 25 and "double" in each.what)
    bands = tones([178.0], 50e-6)
    motion = pareto.play(setting, bands, SLIDING, 3.0)
    assert len(motion) == 15_000
    assert pareto.found_error(motion, bands, 5000.0, ((1.6, 3.0),)) < 0.0075


def test_a_second_of_the_comb_is_like_any_other():
    """So a controller may be shown the same one again and again while it is timed."""
    frequency, time = pareto.scenes()["8 bands"].frequency, np.linspace(0.0, 0.99, 100)
    np.testing.assert_array_equal(frequency, np.round(frequency))
    position = SLIDING.motion.position
    np.testing.assert_allclose(position(time + 1.0), position(time), rtol=0, atol=1e-15)
