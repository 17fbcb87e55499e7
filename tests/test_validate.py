"""Verdicts, and the reports that machines read."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from hapticrender.progress import Progress
from hapticrender.touch.builtin import builtin_scenes
from hapticrender.validate import Verdict, validate, write_json, write_junit


@pytest.fixture(scope="module")
def verdicts():
    scenes = builtin_scenes()
    return validate([scenes["grating-47"], scenes["grating-170"]], method="paper", seed=4)


def test_the_paper_holds_47_hz_and_fails_at_170_hz(verdicts):
    good, bad = verdicts
    assert good.passed
    assert good.value <= good.tolerance
    assert not bad.passed  # FACTS 2, row 4: two sides controlled apart, 129-189 Hz
    assert bad.value > 0.5
    assert bad.figure.startswith("rms_error_")
    assert str(bad).startswith("grating-170 misses its tolerance: worst figure rms error of the 170 Hz band at ")
    assert [verdict.seed for verdict in verdicts] == [4, 4]
    assert all(verdict.elapsed > 0 for verdict in verdicts)


def test_a_verdict_turns_with_the_tolerance(verdicts):
    scene = builtin_scenes()["grating-47"]
    worst = verdicts[0].value
    for tolerance, passed in ((worst * 1.01, True), (worst * 0.99, False)):
        assert validate([replace(scene, tolerance=tolerance)], method="paper", seed=4)[0].passed is passed


def test_the_seed_decides_the_noise(verdicts):
    scene = builtin_scenes()["grating-47"]
    again, other = (validate([scene], method="paper", seed=seed)[0] for seed in (4, 5))
    assert again.summary == verdicts[0].summary
    assert other.summary != verdicts[0].summary


def test_all_scenes_are_prepared_before_any_runs(monkeypatch):
    monkeypatch.setattr("hapticrender.validate.run", lambda *a, **k: pytest.fail("a sample was run"))
    scene = builtin_scenes()["grating-47"]
    with pytest.raises(ValueError, match="renderer 'no-such-plate' is not installed"):
        validate([scene, replace(scene, device="no-such-plate")])
    with pytest.raises(ValueError, match="must be one of paper"):
        validate([scene], method="magic")


def test_progress_is_shown(capsys):
    scene = replace(builtin_scenes()["grating-47"], duration=0.1)
    validate([scene, scene], progress=Progress([0.1, 0.1]))
    assert capsys.readouterr().err == "1/2 grating-47\n2/2 grating-47\n"


def test_json_holds_everything(verdicts, tmp_path):
    write_json(tmp_path / "report.json", verdicts)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert report["passed"] is False
    assert [scene["scene"] for scene in report["scenes"]] == ["grating-47", "grating-170"]
    assert report["scenes"][0]["summary"]["bands"][0]["frequency"] == 47.0


def test_junit_is_what_ci_reads(verdicts, tmp_path):
    write_junit(tmp_path / "report.xml", verdicts)
    suite = ElementTree.parse(tmp_path / "report.xml").getroot().find("testsuite")
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    good, bad = suite.findall("testcase")
    assert (good.get("classname"), good.get("name")) == ("hapticrender.vt-plate.paper", "grating-47")
    assert good.find("failure") is None
    assert re.fullmatch(r"\d+\.\d{3}", good.get("time"))
    message = bad.find("failure").get("message")
    assert re.fullmatch(
        r"misses its tolerance: worst figure rms error of the 170 Hz band at .* = \d+ %, tolerance 2 %", message
    )
    assert json.loads(bad.find("failure").text)[0]["frequency"] == 170.0


def test_reports_survive_figures_and_names_that_formats_forbid(verdicts, tmp_path):
    summary = verdicts[1].summary | {"scene": "bell \x07 & <tag>", "wobble": float("nan"), "worst": {}}
    summary["worst"] = verdicts[1].summary["worst"] | {"value": float("inf")}
    verdict = Verdict.of(summary, elapsed=0.5)
    write_junit(tmp_path / "report.xml", [verdict])
    assert ElementTree.parse(tmp_path / "report.xml").find(".//testcase").get("name") == "bell \ufffd & <tag>"
    write_json(tmp_path / "report.json", [verdict])
    [scene] = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)["scenes"]
    assert scene["value"] is None
    assert scene["summary"]["wobble"] is None


class Terminal:
    """A stream that says it is a terminal."""

    def __init__(self):
        self.text = ""

    def isatty(self):
        return True

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def test_the_bar_grows_by_duration_and_ends_its_line():
    terminal = Terminal()
    progress = Progress([1.0, 3.0], stream=terminal)
    for name in ("short", "long"):
        with progress.scene(name) as tick:
            tick(0.5, 1.0)
    shares = [int(share) for share in re.findall(r"(\d+) %", terminal.text)]
    assert shares == [0, 12, 25, 25, 62, 100]  # halves of a quarter, then of three quarters
    assert terminal.text.endswith("100 %  long\x1b[K\n")
    assert terminal.text.count("\n") == 1


def test_a_broken_off_bar_ends_its_line_too():
    terminal = Terminal()
    with pytest.raises(KeyboardInterrupt), Progress([1.0], stream=terminal).scene("only"):
        raise KeyboardInterrupt
    assert terminal.text.endswith("\n")
