"""The firmware calls no function again before it has returned: its stack is bounded."""

import re
import subprocess
from graphlib import CycleError, TopologicalSorter

import pytest
from board import SCENE, build_board, compile_c

import hapticrender as hr

TABLE = re.compile(r"\{KIND_\w+, [^{}]*, (\w+)\}")  # the handlers of a board's commands, called through a pointer
MUTUAL = (
    "int odd(int n);\nint even(int n) { return n == 0 || odd(n - 1); }\nint odd(int n) { return n && even(n - 1); }\n"
)


def calls_of(build, folder):
    """Names of the functions that every function calls, as gcc writes them beside its output."""
    try:
        build("-O0", "-fcallgraph-info")
    except subprocess.CalledProcessError:
        pytest.skip("no -fcallgraph-info here: install gcc 10")
    calls = {}
    for graph in folder.glob("*.ci"):
        for caller, called in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph.read_text()):
            calls.setdefault(caller.rpartition("/")[2], set()).add(called.rpartition("/")[2])
    return calls


def test_no_function_of_the_board_calls_itself_nor_by_way_of_others(tmp_path):
    """A call through a pointer counts as one of every command's handler, and there is no other."""
    calls = calls_of(lambda *options: build_board(tmp_path, hr.prepare(SCENE), *options), tmp_path)
    assert [caller for caller in calls if "__indirect_call" in calls[caller]] == ["board_commands.c:execute"]
    handlers = TABLE.findall((tmp_path / "board_commands.c").read_text())
    known = {name.rpartition(":")[2]: name for name in calls}
    assert len(handlers) == 13
    assert set(handlers) <= set(known)
    calls["__indirect_call"] = {known[name] for name in handlers}
    assert any("law_step" in called for called in calls.values())
    TopologicalSorter(calls).prepare()


def test_functions_that_call_each_other_are_found(tmp_path):
    source = tmp_path / "mutual.c"
    source.write_text(MUTUAL)
    calls = calls_of(lambda *options: compile_c(tmp_path / "mutual.o", [source], "-c", *options), tmp_path)
    with pytest.raises(CycleError):
        TopologicalSorter(calls).prepare()
