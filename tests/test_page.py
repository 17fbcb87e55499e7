"""The page: opens from a file with nothing but itself and the files beside it, and says plainly what missed."""

import json
from html.parser import HTMLParser

import pytest

from hapticrender import formatting
from hapticrender.report import text as wording
from hapticrender.report.outputs import Outputs, round_up
from hapticrender.report.page import page, refuse_foreign_page, write_page
from hapticrender.touch.builtin import builtin_scenes
from hapticrender.touch.grating import Grating
from hapticrender.touch.scene import Scene

VOID = {"meta", "img", "br", "circle", "path"}
FILES = ("scene.toml", "summary.json", "recording.au", "drive.wav", "sensed.wav", "picture.png")


class Reader(HTMLParser):
    """Collects addresses and text, and checks that every element is closed in turn."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.addresses, self.ids, self.open, self.text = set(), [], [], [], ""
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.addresses += [value for key, value in attributes if key in ("href", "src")]
        self.ids += [value for key, value in attributes if key == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def band(errors, frequency=170.0, wavelength=None, target=1e-5):
    places = dict(zip(wording.PLACES, errors, strict=True))
    return {
        "frequency": frequency,
        "wavelength": wavelength,
        "target": target,
        "achieved": target * (1 + errors[0]),
        "phase_error": 0.1,
        "settling_time": None,
        **{f"error_{place}": error for place, error in places.items()},
        **{f"rms_error_{place}": abs(error) for place, error in places.items()},
    }


def summary(bands, name="grating", notes=()):
    value, place, label = max(
        (abs(b[f"rms_error_{p}"]), p, formatting.band_label(b)) for b in bands for p in wording.PLACES
    )
    return {
        "scene": name,
        "device": "vt-plate",
        "method": "paper",
        "seed": 3,
        "rate": 5000.0,
        "unit": "m",
        "duration": 4.0,
        "judged_from": 1.0,
        "tolerance": 0.1,
        "verdict": "passed" if value <= 0.1 else "failed",
        "passed": value <= 0.1,
        "reason": "",
        "motion_source": "true",
        "worst": {"figure": f"rms_error_{place}", "value": value, "band": label, "place": place},
        "bands": bands,
        "wobble": 4.1e-8,
        "residual_rms": 1.58e-7,
        "saturated_share": 0.25,
        "flags": {"SATURATED": 5000},
        "notes": list(notes),
        "sound": {"drive.wav": {"full_scale": 2.0, "unit": "A"}, "sensed.wav": {"full_scale": 2e-5, "unit": "m"}},
    }


def outputs(folder, bands, name="grating", notes=(), picture=True, toml='name = "grating"\n'):
    return Outputs(name=name, folder=folder / name, summary=summary(bands, name, notes), toml=toml, picture=picture)


GOOD = band((0.001, -0.002, 0.003), frequency=20.0)
BAD = band((1.29, 0.5, 4.19))


def test_the_page_needs_nothing_but_the_files_beside_it(tmp_path):
    scenes = [outputs(tmp_path, [GOOD], "good one"), outputs(tmp_path, [BAD], "bad")]
    path = write_page(tmp_path, scenes)
    report = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert [scene["scene"] for scene in report["scenes"]] == ["good one", "bad"]
    refuse_foreign_page(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "index.html").write_text("<p>mine</p>")
    with pytest.raises(ValueError, match="from no earlier run"):
        refuse_foreign_page(tmp_path / "other")
    for scene in scenes:
        scene.folder.mkdir()
        for name in FILES:
            (scene.folder / name).touch()
    read = Reader(path.read_text(encoding="utf-8"))
    assert path == tmp_path / "index.html"
    assert not read.tags & {"script", "link", "iframe"}
    assert len(read.addresses) == 2 * (2 + 2 + 2 + 5)  # row and contents, picture and its link, players, files
    for address in read.addresses:
        if address.startswith("#"):
            assert address[1:] in (scene_id.replace(" ", "%20") for scene_id in read.ids)
        else:
            assert (tmp_path / address.replace("%20", " ")).is_file()


def test_a_miss_is_said_with_its_figure(tmp_path):
    text = Reader(page(tmp_path, [outputs(tmp_path, [GOOD], "a"), outputs(tmp_path, [BAD], "b")])).text
    sentence = "misses its tolerance: worst figure rms error of the 170 Hz band at end 2 = 419 %, tolerance 10 %"
    assert text.replace("\xa0", " ").lower().count(sentence.lower()) == 2  # in the table and in its section
    assert "1 of 2\nare within their tolerance, 1 miss it." in text
    assert "within 10\xa0%" in text
    assert "158 nm rms" in text


def test_nothing_in_a_scene_becomes_markup(tmp_path):
    nasty = '<script>alert("1")</script> & more'
    html = page(tmp_path, [outputs(tmp_path, [GOOD], "a&b", notes=[nasty], toml=f"# {nasty}")])
    read = Reader(html)
    assert "script" not in read.tags
    assert read.text.count(nasty) == 2


def test_amplitudes_of_one_unit_share_one_prefix(tmp_path):
    large, small = band((0.0, 0.0, 0.0), target=2e-3), band((0.0, 0.0, 0.0), target=1e-6)
    html = page(tmp_path, [outputs(tmp_path, [large], "a"), outputs(tmp_path, [small, large], "b")])
    assert html.count("<td>2.00 mm</td>") == 8  # overview and bands, target and achieved
    assert html.count("<td>0.00100 mm</td>") == 2


def test_without_a_picture_the_page_says_why(tmp_path):
    html = page(tmp_path, [outputs(tmp_path, [GOOD], picture=False)])
    assert "<img" not in html
    assert "matplotlib is not installed" in html


def test_many_bands_fold_and_add_up(tmp_path):
    bands = [band((0.0, 0.01, 0.02), frequency=20.0 * k, target=1e-6) for k in range(1, 17)]
    html = page(tmp_path, [outputs(tmp_path, bands)])
    assert "<details><summary>16 bands, 20 Hz to 320 Hz</summary>" in html
    assert "<td>4.00 µm</td>" in html  # sqrt(16) * 1 um


def test_missing_figures_are_dashes(tmp_path):
    empty = {key: None for key in GOOD} | {"frequency": 20.0}
    scene = outputs(tmp_path, [GOOD])
    why = {"verdict": "not judged", "passed": False, "reason": "no band has a target"}
    scene.summary.update(bands=[empty], worst=dict.fromkeys(("figure", "value", "band", "place")), **why)
    text = Reader(page(tmp_path, [scene])).text
    assert text.lower().count("not judged: no band has a target") == 2
    assert "0 of 1\nare within their tolerance, 0 miss it, 1 cannot be judged." in text
    assert "None" not in text


@pytest.mark.parametrize("peak", [1e-9, 1.0, 1.01, 2.0, 4.99, 9.99, 3.7e-5])
def test_full_scale_is_round_and_just_above_the_peak(peak):
    full_scale = round_up(peak)
    assert peak <= full_scale * (1 + 1e-12)
    assert full_scale <= 2.5 * peak * (1 + 1e-12)  # the widest step of 1, 2, 5, 10 is from 2 to 5
    assert f"{full_scale:e}"[0] in "125"


def test_a_scene_is_described_with_its_partials_and_its_device():
    scenes = builtin_scenes()
    assert wording.describe(scenes["grating-20"]) == "grating 10 µm 20 Hz; no finger; 5 s on vt-plate"
    assert wording.describe(scenes["one-texture-hybrid"]) == (
        "grating 25.46 µm 50 Hz, 3 partials; sliding finger 80 mm/s; 3 s on hybrid"
    )
    square = Scene(texture=Grating(amplitude=1e-5, frequency=20.0, shape="square", harmonics=4), duration=1.0)
    assert wording.describe(square) == "grating 10 µm 20 Hz, 4 partials; no finger; 1 s on vt-plate"
    assert len(square.texture.bands(rate=5000.0)) == 4
