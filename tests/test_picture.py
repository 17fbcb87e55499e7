"""The picture of a recording: what it shows, and that it is drawn whatever happened."""

import itertools
import sys

import numpy as np
import pytest
from synthetic import RATE, make_bands, make_recording, make_scene, make_signals, times

UM = 1e-6

pytest.importorskip("matplotlib", reason="pictures are an extra")

from hapticrender.charts import figures, picture  # noqa: E402
from hapticrender.recordings.formats import MissingExtra  # noqa: E402
from hapticrender.recordings.recording import Recorder  # noqa: E402


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
    return np.asarray(line_data(found))


def line_data(found):
    return found.get_xdata(), found.get_ydata()


def test_a_png_of_full_size_is_written_without_pyplot(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)  # another package may have imported it
    path = tmp_path / "run.png"
    swiped().plot(path)
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))
    assert (width, height) == (1210, 1122)
    assert "matplotlib.pyplot" not in sys.modules
    assert list(tmp_path.iterdir()) == [path]


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


def test_only_a_true_offset_is_taken_from_the_waveform():
    """The stretch holds 1.5 periods of the lowest band: its mean, 10 um 2/(3 pi) for a sine, is no offset.

    The other band adds half a period, a sample of the 150 at most, and a sum of samples is off by 0.04 %: 10 um / 140.
    """
    bands = make_bands([50.0, 250.0], [10 * UM, 10 * UM], phase=[np.pi / 2, 0.0])
    for offset in (0.0, 177.0):
        waveform = panel(
            picture.draw(make_recording(bands, bands.envelope, duration=2.0, extra=offset * UM)), "Waveform"
        )
        _, wanted = line(waveform, "target")
        assert abs(wanted.mean()) == pytest.approx(10 * 2 / (3 * np.pi), abs=10 / 140)
        np.testing.assert_allclose(line(waveform, "centre")[1], wanted, atol=1e-6)
        assert ("offset of 177 µm removed" in waveform.get_title(loc="left")) == bool(offset)


def test_bands_over_position_are_labelled_with_their_frequency_too():
    recording = swiped()
    labels = [label.get_text() for label in panel(picture.draw(recording), "Rms error").get_xticklabels()]
    bands = recording.summary()["bands"]
    assert labels == [
        f"{size} ({band['frequency']:.3g} Hz)" for size, band in zip(("1 mm", "500 µm"), bands, strict=True)
    ]


def test_windows_that_cannot_be_read_are_gaps():
    amplitude = panel(picture.draw(swiped()), "Peak amplitude")
    time, achieved = line(amplitude, "centre")
    assert np.isnan(achieved[(time > 1.2) & (time < 1.4)]).all()
    assert np.isfinite(achieved).any()


def assert_texts_apart(figure, least):
    """At least so many texts, none of them on another or outside."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    texts = [text for axes in figure.axes for text in (axes._left_title, axes.xaxis.label, axes.yaxis.label)]
    texts += [text for axes in figure.axes for text in axes.texts]
    texts += [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    boxes = [text.get_window_extent(renderer) for text in texts]
    boxes = [box for box in boxes if box.width > 0 and box.height > 0]
    assert len(boxes) >= least
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)
    for box in boxes:
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width


@pytest.mark.parametrize("count", [1, 2, 5, 40])
def test_no_text_lies_on_another(count):
    bands = make_bands(20.0 * np.arange(1, count + 1), 10 * UM)
    figure = picture.draw(make_recording(bands, bands.envelope * 1.3, duration=2.0, scene={"name": "a" * 40}))
    assert_texts_apart(figure, 12)


def driven(unit, peaks, limit=None):
    """A recording whose drive channels reach the peaks, a finger resting on it."""
    bands = make_bands(100.0, 10 * UM)
    signals = make_signals(bands, bands.envelope, duration=2.0, position=0.0)
    signals["drive"] = np.cos(50 * times(2.0))[:, None] * peaks
    scene = make_scene(duration=2.0)
    fields = {"rate": RATE, "bands": bands, "drive_limit": limit, "drive_channels": len(peaks), "drive_unit": unit}
    recorder = Recorder(None, scene=scene, method="h2", seed=0, **fields)
    recorder.append(**signals)
    return recorder.finish()


@pytest.mark.parametrize(
    ("unit", "peaks", "limit", "lanes"),
    [
        ("A", [2.0, 1.0], 2.5, {"coil 1 (A)": 2.5, "coil 2 (A)": 2.5}),
        ("A, A, N", [0.4, 0.2, 0.03], None, {"coil 1 (A)": 0.4, "coil 2 (A)": 0.4, "screen (N)": 0.03}),
        ("A, N", [0.4, 0.03], 2.5, {"coil (A)": 0.4, "screen (N)": 0.03}),
        ("N", [0.03], 0.14, {"drive (N)": 0.03}),
        ("V", [3.0, 5.0], None, {"channel 1 (V)": 5.0, "channel 2 (V)": 5.0}),
    ],
)
def test_every_lane_of_drive_has_its_unit_and_one_scale_a_unit(unit, peaks, limit, lanes):
    recording = driven(unit, peaks, limit)
    figure = picture.draw(recording)
    first = figure.axes.index(panel(figure, "Drive"))
    shown = {axes.get_ylabel(): axes.get_ylim() for axes in figure.axes[first : first + len(peaks)]}
    reach = {name: pytest.approx((-1.12 * most, 1.12 * most), rel=1e-3) for name, most in lanes.items()}
    assert shown == reach
    assert ("limit" in panel(figure, "Drive").get_title(loc="left")) == (limit is not None and ", " not in unit)
    each = [name.rpartition("(")[2].rstrip(")") for name in lanes]
    assert recording.header.channels[: len(peaks)] == [(f"drive {i + 1}", own) for i, own in enumerate(each)]
    assert_texts_apart(figure, 12 + len(peaks))


@pytest.mark.parametrize("extra", [np.nan, np.inf, 1e200])
def test_a_motion_that_is_no_number_is_drawn_all_the_same(tmp_path, extra):
    bands = make_bands(100.0, 10 * UM)
    late = np.where(times(2.0) > 1.5, extra, 0.0)[:, None]
    make_recording(bands, bands.envelope, duration=2.0, extra=late).plot(tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


@pytest.mark.parametrize("samples", [0, 1, 2, 60])
def test_the_shortest_runs_are_drawn(tmp_path, samples):
    bands = make_bands(100.0, 10 * UM)
    recording = make_recording(bands, bands.envelope, duration=samples / 5000, scene={"duration": 1.0})
    recording.plot(tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


def test_nothing_wanted_is_drawn(tmp_path):
    bands = make_bands(100.0, 0.0)
    make_recording(bands, bands.envelope, duration=2.0).plot(tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


def test_outline_keeps_the_extremes_of_a_long_signal(rng):
    values = rng.standard_normal(100_003)
    time, low, high = picture.outline(values, 1000.0)
    assert len(time) == picture.COLUMNS
    assert (low.min(), high.max()) == (values.min(), values.max())
    assert time[0] < 0.1 < 99.9 < time[-1] < 100.003
    short = picture.outline(values[:7], 1000.0)
    np.testing.assert_array_equal(short[0], np.arange(7) / 1000)
    np.testing.assert_array_equal(short[1], values[:7])


def test_a_gap_in_the_signal_is_a_gap_in_its_outline():
    values = np.ones(14_000)
    values[70] = np.nan
    _, low, high = picture.outline(values, 1000.0)
    assert np.flatnonzero(np.isnan(low)).tolist() == np.flatnonzero(np.isnan(high)).tolist() == [7]


def test_without_matplotlib_the_extra_is_named_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match=r"pip install 'hapticrender\[plot\]'"):
        swiped().plot(tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


def test_a_new_figure_has_our_style_only_while_it_is_drawn():
    import matplotlib

    before = dict(matplotlib.rcParams)
    with figures.new_figure((5, 3), pads=(0.12, 0.07), style={"axes.grid": False}) as figure:
        assert matplotlib.rcParams["legend.fontsize"] == figures.STYLE["legend.fontsize"]
        assert not matplotlib.rcParams["axes.grid"]
    assert dict(matplotlib.rcParams) == before
    assert tuple(figure.get_size_inches()) == (5, 3)
    assert figure.get_layout_engine().get()["w_pad"] == 0.12


def test_a_picture_that_fails_leaves_the_older_one(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(b"older")
    with figures.new_figure((5, 3)) as figure:
        figure.savefig = lambda *_, **__: 1 / 0
    with pytest.raises(ZeroDivisionError):
        figures.save(figure, path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]
