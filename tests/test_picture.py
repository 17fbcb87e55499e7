"""The picture of a recording: what it shows, and that it is drawn whatever happened."""

import itertools
import sys

import numpy as np
import pytest
from synthetic import RATE, make_bands, make_recording, make_scene, make_signals, times

UM = 1e-6

pytest.importorskip("matplotlib", reason="pictures are an extra")

from hapticrender.recordings.formats import MissingExtra  # noqa: E402
from hapticrender.recordings.recording import Recorder  # noqa: E402
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
    milliseconds, wanted = line(waveform, "target")
    assert milliseconds[-1] == pytest.approx(4 * 10 - 0.2)  # ms: four periods, less one sample
    np.testing.assert_allclose(line(waveform, "centre")[1], wanted, atol=1e-6)
    errors = panel(figure, "Rms error")
    assert line(errors, "end 1")[1] == pytest.approx([20.0])
    assert "misses its tolerance" in figure.axes[0].texts[-1].get_text()
    assert "±3 A" in panel(figure, "Drive").get_title(loc="left")


@pytest.mark.parametrize("count", [1, 40])
def test_no_text_lies_on_another(count):
    bands = make_bands(20.0 * np.arange(1, count + 1), 10 * UM)
    figure = picture.draw(make_recording(bands, bands.envelope * 1.3, duration=2.0, scene={"name": "a" * 40}))
    figure.canvas.draw()
    texts = [text for axes in figure.axes for text in (axes._left_title, axes.xaxis.label, axes.yaxis.label)]
    texts += [text for axes in figure.axes for text in axes.texts]
    texts += [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    boxes = [text.get_window_extent(figure.canvas.get_renderer()) for text in texts]
    boxes = [box for box in boxes if box.width > 0 and box.height > 0]
    assert len(boxes) >= 12
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_every_lane_of_drive_has_its_unit():
    bands = make_bands(100.0, 10 * UM)
    signals = make_signals(bands, bands.envelope, duration=2.0, position=0.0)
    signals["drive"] = np.cos(50 * times(2.0))[:, None] * [0.4, 0.2, 0.03]
    fields = {"rate": RATE, "bands": bands, "drive_channels": 3, "drive_unit": "A, A, N"}
    recorder = Recorder(None, scene=make_scene(duration=2.0), method="h2", seed=0, **fields)
    recorder.append(**signals)
    figure = picture.draw(recorder.finish())
    first = figure.axes.index(panel(figure, "Drive"))
    reach = {axes.get_ylabel(): axes.get_ylim()[1] / 1.12 for axes in figure.axes[first : first + 3]}
    assert reach == pytest.approx({"coil 1 (A)": 0.4, "coil 2 (A)": 0.4, "screen (N)": 0.03}, rel=1e-3)


@pytest.mark.parametrize("extra", [np.nan, 1e200])
def test_a_motion_that_is_no_number_is_drawn_all_the_same(tmp_path, extra):
    bands = make_bands(100.0, 10 * UM)
    late = np.where(times(2.0) > 1.5, extra, 0.0)[:, None]
    make_recording(bands, bands.envelope, duration=2.0, extra=late).plot(tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


@pytest.mark.parametrize("samples", [0, 1, 60])
def test_the_shortest_runs_are_drawn(tmp_path, samples):
    bands = make_bands(100.0, 10 * UM)
    recording = make_recording(bands, bands.envelope, duration=samples / 5000, scene={"duration": 1.0})
    recording.plot(tmp_path / "x.png")
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


def test_outlines_keep_the_extremes_and_gaps_of_a_long_signal(rng):
    bands = make_bands(100.0, 10 * UM)
    recording = make_recording(bands, bands.envelope, duration=20.0, position=1.0)
    recording.frames[:, recording.header.slices["position"]] = values = rng.standard_normal((100_000, 1))
    time, low, high = picture.outline(recording, "position")
    assert len(time) == picture.COLUMNS
    assert (low.min(), high.max()) == (values.min(), values.max())
    assert time[0] < 0.02 < 19.98 < time[-1] < 20.0
    recording.frames[71, recording.header.slices["position"]] = np.nan  # 1400 stretches of 71.4 samples
    assert np.flatnonzero(np.isnan(picture.outline(recording, "position")[1])).tolist() == [1]


@pytest.mark.parametrize(("suffix", "magic"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".PDF", b"%PDF")])
def test_the_ending_chooses_the_format(tmp_path, suffix, magic):
    assert swiped().plot(tmp_path / f"x{suffix}")
    assert (tmp_path / f"x{suffix}").read_bytes().startswith(magic)


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"'\.jpg' is no picture format: must be one of \.png, \.svg, \.pdf"):
        swiped().plot(tmp_path / "x.jpg")
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_a_warning_names_the_extra_and_the_script_goes_on(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.warns(UserWarning, match=r"pip install 'hapticrender\[plot\]'; the recording can be saved"):
        assert swiped().plot(tmp_path / "x.png") is False
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MissingExtra):
        picture.plot(swiped(), tmp_path / "x.png")
