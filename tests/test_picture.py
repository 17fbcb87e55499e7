"""The picture of a recording: what it shows, and that it is drawn whatever happened."""

import sys

import numpy as np
import pytest
from synthetic import make_bands, make_recording, times

UM = 1e-6

pytest.importorskip("matplotlib", reason="pictures are an extra")

from hapticrender.recordings.formats import MissingExtra  # noqa: E402
from hapticrender.report import figure as figures  # noqa: E402
from hapticrender.report import picture  # noqa: E402


def swiped(**fields):
    time = times(2.0)
    position = np.where((time > 1.2) & (time < 1.4), np.nan, 0.02 * np.sin(2 * np.pi * 1.5 * time))
    bands = make_bands([0.0, 0.0], [10 * UM, 3 * UM], wavenumber=[1000.0, 2000.0])
    places = np.array([1.0, 1.05, 0.9])[:, None]
    return make_recording(bands, bands.envelope * places, position=position, duration=2.0, **fields)


def panel(figure, title):
    (found,) = [axes for axes in figure.axes if axes.get_title(loc="left").startswith(title)]
    return found


def line(axes, label):
    (found,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(found.get_data())


def test_the_panels_show_what_was_recorded():
    bands = make_bands(100.0, 10 * UM)
    recording = make_recording(bands, bands.envelope * np.array([1.0, 1.2, 0.9])[:, None], duration=2.0)
    figure = picture.draw(recording)
    amplitude = panel(figure, "Peak amplitude")
    for name, level in (("target", 10.0), ("centre", 10.0), ("end 1", 12.0), ("end 2", 9.0)):
        np.testing.assert_allclose(line(amplitude, name)[1], level, rtol=1e-9)
    waveform = panel(figure, "Waveform")
    np.testing.assert_allclose(line(waveform, "centre")[1], line(waveform, "target")[1], atol=1e-6)
    errors = panel(figure, "Third octaves")
    assert line(errors, "end 1")[1].max() == pytest.approx(20.0)
    assert "misses its tolerance" in figure.axes[0].texts[-1].get_text()


@pytest.mark.parametrize(("samples", "late"), [(0, 0.0), (1, 0.0), (10_000, np.nan), (10_000, 1e200)])
def test_the_shortest_runs_and_motions_that_are_no_numbers_are_drawn(tmp_path, samples, late):
    bands, scene = make_bands(100.0, 10 * UM), {"duration": max(samples / 5000, 1.0)}
    extra = np.where(times(samples / 5000) > 1.5, late, 0.0)[:, None]
    make_recording(bands, bands.envelope, duration=samples / 5000, scene=scene, extra=extra).plot(tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


def test_a_picture_that_fails_leaves_the_older_one(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(b"older")
    with figures.new_figure((5, 3)) as figure:
        figure.savefig = lambda *_, **__: 1 / 0
    with pytest.raises(ZeroDivisionError):
        figures.save(figure, path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_without_matplotlib_a_warning_names_the_extra_and_the_script_goes_on(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.warns(UserWarning, match=r"pip install 'hapticrender\[plot\]'; the recording can be saved"):
        assert swiped().plot(tmp_path / "x.png") is False
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MissingExtra):
        picture.plot(swiped(), tmp_path / "x.png")
