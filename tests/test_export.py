"""The verb export: what it writes, refuses and ships; the stack of what it writes is bounded."""

import fnmatch
import re
import subprocess
import tomllib
from dataclasses import replace
from graphlib import TopologicalSorter

import pytest
from board import FIRMWARE, ROOT, SCENE, build_board

import hapticrender as hr
from hapticrender import cli
from hapticrender.export import board_design, export, sources
from hapticrender.renderers.vibrotactile import VibrotactileRenderer


def test_export_says_what_it_writes_and_keeps_what_was_changed(exports, tmp_path):
    rendering = exports.rendering("tones")
    written = export(rendering, tmp_path, bands=12)
    assert {path.name for path in written} == {path.name for path in sources()} | {"design.c", "design.h"}
    assert "#define LAW_BANDS 12\n" in (tmp_path / "design.h").read_text()
    assert [board_design(rendering, bands)[0]["BANDS"] for bands in (2, 64)] == [2, 64]
    assert export(rendering, tmp_path) == written
    for name in ("law.c", "design.c"):
        (tmp_path / name).write_text("mine\n")
        with pytest.raises(ValueError, match=f"{name}.*not as it was written.*--force"):
            export(rendering, tmp_path)
        assert (tmp_path / name).read_text() == "mine\n"
        export(rendering, tmp_path, force=True)


def test_the_command_line_exports(tmp_path, capsys):
    assert cli.main(["export", "grating-47", "--out", str(tmp_path / "bo ard")]) == 0
    assert f"build them with: make -C '{tmp_path / 'bo ard'}'\n" in capsys.readouterr().out


@pytest.mark.parametrize(("scene", "noted"), [("screen-spatial", True), ("grating-47", False)])
def test_a_screen_with_a_tribometer_is_exported_in_open_loop_and_the_command_says_so(tmp_path, capsys, scene, noted):
    assert cli.main(["export", scene, "--out", str(tmp_path / "board")]) == 0
    said = capsys.readouterr().out
    assert ("in open loop, as a board reads no tribometer; in closed loop play it from the host" in said) == noted


class Pad(VibrotactileRenderer):
    """A plate of another kind."""

    name = "pad"


def test_a_renderer_names_the_law_of_boards_that_plays_its_device(tmp_path):
    """Not of its name; a rendering of no renderer of the library says what it lacks."""
    pad = hr.prepare(replace(SCENE, device="pad"), renderer=Pad())
    folders = tmp_path / "pad", tmp_path / "plate"
    for rendering, folder in zip((pad, hr.prepare(SCENE)), folders, strict=True):
        export(rendering, folder)
    for name in "design.h", "design.c":
        assert len({(folder / name).read_text() for folder in folders}) == 1
    with pytest.raises(ValueError, match="pad: its renderer names no law of a board: must set `board_law`"):
        export(replace(pad, board_law=None), tmp_path)


def test_every_source_is_shipped():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["hapticrender.drivers"]
    names = [f"firmware/{path.name}" for path in FIRMWARE.iterdir()]
    assert not [name for name in names if not any(fnmatch.fnmatch(name, each) for each in patterns)]
    assert {path.name for path in sources()} == {path.name for path in FIRMWARE.iterdir()}


TABLE = re.compile(r"\{KIND_\w+, [^{}]*, (\w+)\}")  # the handlers of a board's commands, called through a pointer


def test_no_function_of_the_board_calls_itself_nor_by_way_of_others(tmp_path):
    """By gcc's own graph; a call through a pointer counts as one of every command's handler, and there is no other."""
    try:
        build_board(tmp_path, hr.prepare(SCENE), "-O0", "-fcallgraph-info")
    except subprocess.CalledProcessError:
        pytest.skip("no -fcallgraph-info here: install gcc 10")
    calls = {}
    for graph in tmp_path.glob("*.ci"):
        for caller, called in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph.read_text()):
            calls.setdefault(caller.rpartition("/")[2], set()).add(called.rpartition("/")[2])
    assert [caller for caller in calls if "__indirect_call" in calls[caller]] == ["board_commands.c:execute"]
    handlers = TABLE.findall((tmp_path / "board_commands.c").read_text())
    known = {name.rpartition(":")[2]: name for name in calls}
    assert len(handlers) == 13
    assert set(handlers) <= set(known)
    calls["__indirect_call"] = {known[name] for name in handlers}
    assert any("law_step" in called for called in calls.values())
    TopologicalSorter(calls).prepare()  # raises CycleError
