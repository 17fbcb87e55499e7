"""The command line as a shell runs it: redirected, piped, closed, in a folder of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import SCENE_FILES, TINY


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def shell(line, folder, unbuffered="", **environment):
    """A command line as a shell runs the console script, without the current folder on Python's path."""
    root = str(Path(__file__).resolve().parent.parent)
    environment = {**os.environ, "PYTHONPATH": root, "PYTHONUNBUFFERED": unbuffered, **environment}
    command = ["bash", "-c", f"{sys.executable} -P -m hapticrender {line}"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.skipif(sys.platform == "win32", reason="no such redirections on this system")
@pytest.mark.parametrize(
    ("where", "unbuffered", "status"),
    [("2>&1 | true", "", 1), ("> /dev/full", "1", 2)],
)
def test_status_and_reports_do_not_depend_on_the_output(tmp_path, tiny, where, unbuffered, status):
    tiny.write_text(TINY.replace("0.1", "0.5") + "[render]\ntolerance = 1e-6\nsettle = 0.2\n")
    done = shell(f"validate {tiny} --json r.json --junit r.xml {where}; exit ${{PIPESTATUS[0]}}", tmp_path, unbuffered)
    assert (done.returncode, "Traceback" in done.stderr) == (status, False)
    assert json.loads((tmp_path / "r.json").read_text())["scenes"][0]["verdict"] == "failed"
    assert (tmp_path / "r.xml").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no such redirections on this system")
def test_closed_streams_are_no_error(tmp_path, tiny):
    done = shell(f"render {tiny} --out out <&- >&- 2>&-", tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    assert {path.name for path in (tmp_path / "out").iterdir()} >= SCENE_FILES


def test_a_driver_may_be_a_module_in_the_current_folder(tmp_path):
    """With -P, and so in the console script, that folder is no part of Python's path."""
    (tmp_path / "mine.py").write_text("def driver(*_, **__):\n    return {}['it is there']\n")
    done = shell("latency --driver mine:driver", tmp_path)
    assert "mine:driver: KeyError: 'it is there'" in done.stderr


def test_kernels_are_not_played_by_python(tmp_path, tiny):
    done = shell(f"render {tiny} --out out", tmp_path, NUMBA_DISABLE_JIT="1")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "NUMBA_DISABLE_JIT is set" in done.stderr
