"""Pictures and page of a measured finger show the record's own numbers, for one record or several, full or empty."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from finger_data import make_record
from test_page import Reader

import hapticrender as hr
from hapticrender.analysis import pictures
from hapticrender.analysis.load_law import LoadLaw, mean_exponent
from hapticrender.analysis.records import Impedance
from hapticrender.touch.mechanics import LIGHT

pytest.importorskip("matplotlib")


@pytest.fixture
def record(rng):
    return make_record(rng, replace(LIGHT, reference_load=0.4), "a <light> touch")


def parsed(path):
    """Sources of the pictures of a page, whose tags are closed, and its text."""
    text = path.read_text(encoding="utf-8")
    return sorted({address for address in Reader(text).addresses if address.endswith(".png")}), text


def test_a_folder_has_every_picture_and_a_page_of_them(record, tmp_path):
    path = pictures.draw([record, replace(record, name="another")], tmp_path / "new")
    shown, text = parsed(path)
    assert sorted(shown) == ["frequency.png", "load.png", "time-1.png", "time-2.png"]
    assert all((path.parent / name).read_bytes().startswith(b"\x89PNG") for name in shown)
    assert "a &lt;light&gt; touch" in text
    assert "<light>" not in text
    assert "400 Hz: too light a finger" in text
    fit = hr.fit_load_classes([record] * 2)["light"]
    assert f"{1e-3 * fit.mechanics.stiffness:.2f}" in text
    assert f"{fit.chi_square:.0f} / {fit.degrees_of_freedom}" in text


def test_a_mean_exponent_is_weighted_and_its_error_widened_by_scatter():
    one = LoadLaw(*np.array([[100.0], [0.1], [0.1], [1.0], [1.0], [1.0], [9.0]]))
    apart, near = (replace(one, exponent=np.array([n]), standard_error=np.array([0.2])) for n in (1.1, 0.1))
    missing = replace(one, exponent=np.array([np.nan]))
    (mean,), (error,), _ = mean_exponent([one, near, missing], np.array([101.0]))
    assert (mean, error) == pytest.approx((0.1, 0.2 / np.sqrt(5)))  # weights 100 and 25
    (mean,), (error,), _ = mean_exponent([one, apart], np.array([101.0]))
    assert mean == pytest.approx((100 * 0.1 + 25 * 1.1) / 125)
    assert error == pytest.approx(np.sqrt((100 * 0.2**2 + 25 * 0.8**2) / 125))
    assert np.isnan(mean_exponent([one], np.array([200.0]))).all()


def test_a_finger_that_never_touched_has_a_page(record, tmp_path):
    z, nothing = record.impedance, np.full(len(record.time), np.nan)
    masked = Impedance(z.time, z.frequency, z.value * np.nan, z.standard_error * np.nan, 0 * z.normal_load, z.position)
    empty = replace(record.position, value=nothing, standard_error=nothing)
    lifted = replace(record, impedance=masked, position=empty, velocity=empty, contact=0 * record.contact, segments=())
    shown, text = parsed(pictures.draw(lifted, tmp_path))
    assert shown == ["time-1.png"]
    assert re.search(r"Loaded</dt><dd>0\.00 of 5\.99 s, 0 touches", text)


def test_without_matplotlib_there_is_a_page_and_a_warning(record, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.warns(UserWarning, match=r"no pictures: pictures need matplotlib: pip install"):
        path = pictures.draw(record, tmp_path)
    shown, text = parsed(path)
    assert not shown
    assert "matplotlib is not installed" in text


def test_no_records_are_refused(tmp_path):
    with pytest.raises(ValueError, match="must be at least one FingerRecord"):
        pictures.draw([], tmp_path)
