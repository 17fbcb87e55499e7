"""The page: opens from a file with nothing but itself and the files beside it, and says plainly what missed."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest
from synthetic import make_bands, make_recording

from hapticrender.report.outputs import FILES, refuse_other_page, refuse_to_overwrite
from hapticrender.report.page import write_page

VOID = {"meta", "img", "br"}
SOUND = {"drive.wav": {"full_scale": 2.0, "unit": "A"}, "sensed.wav": {"full_scale": 2e-5, "unit": "m"}}


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


def outputs(folder, gain=1.0, name="grating", notes=(), toml='name = "grating"\n', bands=None, **scene):
    """Summary, by the folder of its scene, of a motion that is `gain` times its target."""
    bands = bands or make_bands(170.0, 1e-5)
    summary = make_recording(bands, np.array(gain) * bands.envelope, scene={"name": name, **scene}).summary()
    summary |= {"sound": SOUND, "notes": list(notes)}
    (folder / name).mkdir()
    (folder / name / "scene.toml").write_text(toml, encoding="utf-8")
    return {folder / name: summary}


def test_the_page_needs_nothing_but_the_files_beside_it(tmp_path):
    scenes = outputs(tmp_path, 1.0, "good one") | outputs(tmp_path, [[5.0], [1.0], [1.0]], "bad")
    for folder in scenes:
        for name in set(FILES) - {"recording.au"}:  # read where devices share a texture
            (folder / name).touch()
    path = write_page(tmp_path, scenes)
    report = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert [scene["scene"] for scene in report["scenes"]] == ["good one", "bad"]
    read = Reader(path.read_text(encoding="utf-8"))
    assert path == tmp_path / "index.html"
    assert not read.tags & {"script", "link", "iframe"}
    assert len(read.addresses) == 2 * (2 + 2 + 2 + 5)  # row and contents, picture and its link, players, files
    for address in read.addresses:
        if address.startswith("#"):
            assert address[1:] in (scene_id.replace(" ", "%20") for scene_id in read.ids)
        elif not address.endswith("recording.au"):
            assert (tmp_path / address.replace("%20", " ")).is_file()
    sentence = "misses its tolerance: worst figure waveform error at centre = 400 %, bound 10 %"
    assert read.text.replace("\xa0", " ").lower().count(sentence.lower()) == 2  # in the table and in its section
    assert "1 of 2 are within their tolerance,\n1 miss it." in read.text


def test_only_a_page_of_ours_is_replaced(tmp_path):
    write_page(tmp_path, {})
    refuse_other_page(tmp_path)
    refuse_to_overwrite(tmp_path)  # with a scene's files: a page and `summary.json` are all there is
    (tmp_path / "index.html").write_text("<p>mine</p>")
    with pytest.raises(ValueError, match="from no earlier run"):
        refuse_other_page(tmp_path)
    with pytest.raises(ValueError, match="from no earlier run"):
        refuse_to_overwrite(tmp_path)


def test_nothing_in_a_scene_becomes_markup(tmp_path):
    nasty = '<script>alert("1")</script> & more'
    path = write_page(tmp_path, outputs(tmp_path, name="a&b", notes=[nasty], toml=f"# {nasty}"))
    read = Reader(path.read_text(encoding="utf-8"))
    assert "script" not in read.tags
    assert read.text.count(nasty) == 2
    assert "matplotlib is not installed" in read.text
