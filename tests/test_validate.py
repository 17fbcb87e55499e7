"""Verdicts, and the reports that machines read."""

import json
import os
import re
import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from test_player_faults import full_disk

from hapticrender.cli import main
from hapticrender.errors import PlateMismatch
from hapticrender.loop import render
from hapticrender.touch.builtin_scenes import builtin_scenes
from hapticrender.touch.grating import Grating
from hapticrender.touch.scene import Scene
from hapticrender.validate import Verdict, counted, exit_status, open_scene, validate, write_json, write_junit

FINE = {"current_bits": 20}  # of 12 bits a finger may feel the rounding at 160 to 200 Hz


@pytest.fixture(scope="module")
def verdicts():
    scenes = builtin_scenes()
    return validate([replace(scenes["grating-47"], profile=FINE), "grating-170"], method="paper", seed=4)


def test_the_paper_holds_47_hz_and_fails_at_170_hz(verdicts):
    good, bad = verdicts
    assert good.passed
    assert good.value <= good.tolerance
    assert not bad.passed  # Grigorii et al. 2021: two sides controlled apart fail between 129 and 189 Hz
    assert bad.value > 0.5
    assert bad.figure == "waveform_error"
    assert str(bad).startswith("grating-170 misses its tolerance: worst figure waveform error at ")
    assert [verdict.seed for verdict in verdicts] == [4, 4]
    assert all(verdict.elapsed > 0 for verdict in verdicts)


SLOW = Scene(texture=Grating(amplitude=10e-6, frequency=10.0), duration=1.0, name="slow")
SHORT = Scene(texture=Grating(amplitude=10e-6, frequency=47.0), duration=0.5, name="short", profile=FINE)


def junit(folder, found):
    """The suite that is written in JUnit's format."""
    write_junit(folder / "r.xml", found)
    return ElementTree.parse(folder / "r.xml").getroot().find("testsuite")


def test_a_scene_that_settles_for_longer_than_it_lasts_is_refused(tmp_path):
    """The default of 1 s is nobody's statement: of a shorter scene the last half is judged."""
    (tmp_path / "a.toml").write_text(replace(SHORT, duration=2.0, settle=2.0).to_toml())
    (tmp_path / "b.toml").write_text(SHORT.to_toml())
    assert [open_scene(tmp_path / name).duration for name in ("a.toml", "b.toml")] == [2.0, 0.5]
    (tmp_path / "a.toml").write_text(replace(SHORT, duration=2.0, settle=2.1).to_toml())
    with pytest.raises(ValueError, match=r"a.toml: render.settle = 2.1: must be <= 2 s, the scene's duration"):
        open_scene(tmp_path / "a.toml")


def test_scenes_of_one_name_are_told_apart_by_their_files(tmp_path):
    """One that cannot be read, and one of the same name as the next that no device carries."""
    texts = {"a": SHORT.to_toml(), "b": SHORT.to_toml().replace("47.0", "4700.0"), "c": "x = "}
    files = [tmp_path / f"{name}.toml" for name in texts]
    for file, text in zip(files, texts.values(), strict=True):
        file.write_text(text)
    found = validate(files)
    assert [each.verdict for each in found] == ["passed", "error", "error"]
    assert str(found[1]).startswith(f"short (2): {files[1]}: texture.frequency")
    assert [str(each).count(str(file)) for each, file in zip(found, files, strict=True)] == [0, 1, 1]


@pytest.mark.parametrize("option", ["--json", "--junit"])
def test_a_report_that_cannot_be_written_whole_leaves_the_older_one(tmp_path, capsys, option):
    (tmp_path / "r").write_text("older")
    with full_disk(512):
        assert main(["validate", *["no-such-scene"] * 50, option, str(tmp_path / "r")]) == 2
    assert f"{option} = '{tmp_path / 'r'}': File too large" in capsys.readouterr().err
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("r", "older")]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_bad_scene_stops_no_other(tmp_path, capsys, jobs):
    """One of them cannot be sent to another process."""

    class Local(Grating):
        """Known to this process only."""

    local = replace(SHORT, texture=Local(frequency=47.0, amplitude=10e-6), name="plateless")
    bad = tmp_path / "bad.toml"
    bad.write_text(SHORT.to_toml().replace("47.0", "-47.0"))
    plate = replace(SHORT, device="no-such-plate", name="plateless") if jobs == 1 else local
    found = validate([bad, SHORT, plate, SLOW], jobs=jobs, progress=sys.stderr)
    assert [verdict.verdict for verdict in found] == ["error", "passed", "error", "not judged"]
    assert "texture.frequency = -47.0" in found[0].reason
    assert ("no-such-plate" if jobs == 1 else "local object") in found[2].reason
    assert found[3].reason.startswith("the texture has nothing from 20 to 500 Hz")
    assert exit_status(found) == 2
    assert [exit_status(found[1:2] + found[3:], strict=strict) for strict in (False, True)] == [0, 1]
    assert counted(found) == "4 scenes: 1 passed, 1 not judged, 2 not rendered"
    assert capsys.readouterr().err == "1/3 short\n2/3 plateless\n3/3 slow\n"
    write_json(tmp_path / "r.json", found)
    assert len(json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))["scenes"]) == 4
    suite = junit(tmp_path, found)
    assert [suite.get(key) for key in ("tests", "failures", "errors", "skipped")] == ["4", "0", "2", "1"]
    assert suite.findall("testcase")[3].find("skipped").get("message") == found[3].reason


FAULTY = """
import sys
from other_plate import OtherPlate
made = []
class Gone(OtherPlate):
    def play(self, drive):
        raise OSError("usb gone")
class Exits(OtherPlate):
    def play(self, drive):
        sys.exit(0)
def driver():
    made.append(1)
    return [lambda: {}["x"], Gone, Exits, lambda: sys.exit(3), OtherPlate][len(made) - 1]()
"""


def test_whatever_a_driver_raises_is_the_error_of_that_scene(tmp_path, monkeypatch):
    (tmp_path / "faulty_driver.py").write_text(FAULTY)
    monkeypatch.syspath_prepend(tmp_path)
    found = validate([SHORT] * 5, driver="faulty_driver:driver")
    assert [verdict.verdict for verdict in found] == ["error"] * 4 + ["passed"]
    assert [verdict.reason for verdict in found[2:4]] == ["SystemExit: 0", "SystemExit: 3"]
    assert [verdict.reason for verdict in found[:2]] == [
        f"faulty_driver:driver: {problem}" for problem in ("KeyError: 'x'", "OSError: usb gone")
    ]


DISTURBED = """
import multiprocessing, os, signal, sys, threading, time
from pathlib import Path
from hapticrender.cli import main
def disturb():
    while sum(path.stat().st_size > 0 for path in Path(os.environ["TMPDIR"]).glob("*/recording.au")) < 2:
        time.sleep(0.02)
    {}
threading.Thread(target=disturb, daemon=True).start()
sys.exit(main(["validate", *sys.argv[1:], "--jobs", "2", "--json", "r.json"]))
"""
ENDS = {  # what happens while two scenes render: exit status, journals that stay behind
    "multiprocessing.active_children()[0].kill()": (2, 1),
    "os.kill(os.getpid(), signal.SIGTERM)": (-signal.SIGTERM, 0),
    "os.kill(os.getpid(), signal.SIGINT)": (130, 0),
}


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals on this system")
@pytest.mark.parametrize("event", ENDS)
def test_a_signal_leaves_no_process_behind_and_a_killed_one_is_an_error(tmp_path, event):
    """Pipes stay open as long as any process has them: `run` returns when all have ended."""
    (tmp_path / "long.toml").write_text(replace(SHORT, duration=20000.0).to_toml())
    (tmp_path / "bad.toml").write_text("")
    command = [sys.executable, "-c", DISTURBED.format(event), "bad.toml", "long.toml", "long.toml", "long.toml"]
    folder = {"TMPDIR": str(tmp_path)}
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=120, env=os.environ | folder, cwd=tmp_path
    )
    status, left = ENDS[event]
    assert ended.returncode == status, ended.stderr
    assert len(list(tmp_path.glob("*/recording.au"))) == left
    if status == 2:
        report = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))["scenes"]
        assert ["was killed" in scene["reason"] for scene in report] == [False, True, True, True]
        assert {(scene["verdict"], scene["device"]) for scene in report[1:]} == {("error", "vt-plate")}
        assert "4 scenes: 4 not rendered" in ended.stdout


@pytest.mark.parametrize(("kind", "tag"), [("not judged", "skipped"), ("passed in band", "system-out")])
def test_what_is_not_wholly_passed_is_so_in_every_report(verdicts, tmp_path, kind, tag):
    found = [verdicts[0], Verdict.of(verdicts[0].summary | {"verdict": kind, "reason": "why"}, elapsed=0.5)]
    write_json(tmp_path / "r.json", found)
    assert json.loads((tmp_path / "r.json").read_text())["passed"] is False
    suite = junit(tmp_path, found)
    assert int(suite.get("skipped")) == len(suite.findall("testcase/skipped")) == (tag == "skipped")
    assert [child.tag for child in suite.findall("testcase")[1]] == [tag]


def test_only_what_does_not_pass_leaves_its_files(tmp_path, empty_pictures):
    strict = replace(SHORT, tolerance=1e-6, name="a strict one")
    validate([SHORT, strict], out=tmp_path / "out")
    (folder,) = (tmp_path / "out").iterdir()
    assert folder.name == "a_strict_one"
    assert {"recording.au", "summary.json", "scene.toml", "drive.wav"} <= {path.name for path in folder.iterdir()}


def test_junit_is_what_ci_reads(verdicts, tmp_path):
    suite = junit(tmp_path, verdicts)
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    good, bad = suite.findall("testcase")
    assert (good.get("classname"), good.get("name")) == ("hapticrender.vt-plate.paper", "grating-47")
    assert good.find("failure") is None
    assert re.fullmatch(r"\d+\.\d{3}", good.get("time"))
    message = bad.find("failure").get("message")
    assert re.fullmatch(r"misses its tolerance: worst figure waveform error at .* = \d+ %, bound 2 %", message)
    assert json.loads(bad.find("failure").text)["places"]["centre"]["waveform_error"] > 0.5


HEAVY = Scene(texture=Grating(amplitude=10e-6, frequency=120.0), duration=2.0, name="heavy", simulation={"mass": 0.036})


def test_a_mismatch_that_is_raised_as_an_error_holds_the_recording():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(PlateMismatch, match="the device differs") as raised:
            render(HEAVY)
    assert len(raised.value.recording) == 2.0 * raised.value.recording.rate
    assert (str(raised.value),) == raised.value.recording.warnings


def test_a_mismatch_is_a_warning_in_every_report_and_stops_no_scene(tmp_path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("error")
        [verdict] = validate([HEAVY])
    assert verdict.verdict == "passed"
    [text] = verdict.warnings
    assert [(each.category, str(each.message)) for each in caught] == [(PlateMismatch, text)]
    assert text.startswith("the device differs from its model")
    assert junit(tmp_path, [verdict]).find("testcase").findtext("system-err") == text
    write_json(tmp_path / "r.json", [verdict])
    [scene] = json.loads((tmp_path / "r.json").read_text())["scenes"]
    assert scene["warnings"] == [text]


def test_reports_survive_figures_and_names_that_formats_forbid(verdicts, tmp_path):
    summary = verdicts[1].summary | {"scene": "bell \x07 & <tag> \udce9", "wobble": float("nan"), "worst": {}}
    summary["worst"] = verdicts[1].summary["worst"] | {"value": float("inf")}
    verdict = Verdict.of(summary, elapsed=0.5)
    assert junit(tmp_path, [verdict]).find("testcase").get("name") == "bell \\x07 & <tag> \\udce9"
    write_json(tmp_path / "report.json", [verdict])
    [scene] = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)["scenes"]
    assert (scene["value"], scene["scene"]) == (None, summary["scene"])
    assert scene["summary"]["wobble"] is None
