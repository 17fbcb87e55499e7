"""The verb `finger`: what it prints, writes and refuses; its pictures and page show the record's own numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest
from subjects import Subject
from test_page import Reader

import hapticrender as hr
from hapticrender import cli
from hapticrender.analysis import output, pictures
from hapticrender.analysis.records import LOADED, Impedance
from hapticrender.touch.mechanics import LIGHT

BANDS = (47.0, 111.0, 170.0)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("finger") / "recording.npz"
    recording = Subject(LIGHT, 0.4, 0.05, 9, frequencies=BANDS).record()
    recording.save(path)
    return path, recording


@pytest.fixture
def record(recorded):
    notes = ("400 Hz: too light a finger",)
    return replace(hr.analyse_finger(recorded[1]), name="a <light> touch", notes=notes)


def test_verb_writes_tables_and_a_summary(recorded, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(pictures, "save", lambda figure, path: path.touch())
    path, recording = recorded
    profile = tmp_path / "plate.toml"
    hr.DeviceProfile(kind="vt-plate", device={"stiffness_1": 22.4e3}).save(profile)
    out = tmp_path / "out"
    assert cli.main(["finger", str(path), "--profile", str(profile), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("touch", "111.0", "stiffness_1", "position is good to 1 mm"))
    found = hr.analyse_finger(recording, profile)
    series = np.loadtxt(out / "finger.csv", delimiter=",", skiprows=1)
    assert series.shape == (-(-len(found.time) // 50), 8)
    np.testing.assert_allclose(series[:, 1], found.normal_load.value[::50], rtol=1e-8)
    windows = np.loadtxt(out / "impedance.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(windows[:, 4] + 1j * windows[:, 5], found.impedance.value.ravel(), rtol=1e-8)
    figures = json.loads((out / "finger.json").read_text())
    assert [each["kind"] for each in figures["segments"]].count("loaded") == 1
    assert figures["plate"]["measured"]
    assert (out / "index.html").exists()
    assert cli.main(["finger", str(path), "--out", str(out)]) == 2
    assert "is there: choose another folder, or add --force" in capsys.readouterr().err
    assert cli.main(["finger", str(path), "--out", str(out), "--force"]) == 0


def test_verb_names_the_recording_in_an_error(recorded, tmp_path, capsys):
    path, _ = recorded
    assert cli.main(["finger", str(path), "--block", "2", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert (
        "block=2 samples: must be an integer from 1 to the plate's delay, 1: state delay, from a sensed sample to"
        in error
    )
    assert not (tmp_path / "out").exists()


def test_summary_states_the_mean_of_each_band_with_its_own_error(recorded):
    """Nine windows of one error each: a third of it, where they scatter by no more; of the load that of a sample."""
    found = hr.analyse_finger(recorded[1])
    z = found.impedance
    value, error = np.full((9, 1), 3.0 + 4.0j), np.full((9, 1), 0.6)
    few = Impedance(z.time[:9], np.full((9, 1), 111.0), value, error, z.normal_load[:9], z.position[:9])
    text = output.text(replace(found, impedance=few))
    (row,) = [line.split() for line in text.splitlines() if line.startswith("111.0")]
    assert row == ["111.0", "5", "0.2", "53.1", "2.3", "9"]  # degrees of 0.2/5
    (touch,) = [line.split() for line in text.splitlines() if line.startswith("1 ")]
    load = slice(*found.at(np.array([found.of_kind(LOADED)[0].start, found.of_kind(LOADED)[0].stop])))
    assert touch[4] == f"{np.nanmedian(found.normal_load.standard_error[load]):.3f}"
    assert touch[-1] == f"{1e3 * np.nanmedian(found.position.standard_error[load]):.2f}"


def test_summary_of_a_recording_without_a_finger():
    recording = hr.render(hr.Scene(texture=hr.Grating(frequency=111.0, amplitude=10e-6), duration=1.5))
    text = output.text(hr.analyse_finger(recording))
    assert "note: no finger touches" in text
    assert "nan" not in text


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
    fit = next(iter(pictures.fit_all([record] * 2)["light"].values()))
    assert f"{1e-3 * fit.mechanics.stiffness:.2f}" in text
    assert f"{fit.chi_square:.0f} / {fit.degrees_of_freedom}" in text


def test_a_finger_that_never_touched_has_a_page(record, tmp_path):
    z, nothing = record.impedance, np.full(len(record.time), np.nan)
    masked = Impedance(z.time, z.frequency, z.value * np.nan, z.standard_error * np.nan, 0 * z.normal_load, z.position)
    empty = replace(record.position, value=nothing, standard_error=nothing)
    lifted = replace(record, impedance=masked, position=empty, velocity=empty, contact=0 * record.contact, segments=())
    shown, text = parsed(pictures.draw(lifted, tmp_path))
    assert shown == ["time-1.png"]
    assert "se: standard error of one sample" not in text, "it lists no touch"
    assert "position is good to 1 mm" in text
