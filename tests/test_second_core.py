"""Compilation on two cores: what the child compiled is loaded, and whatever becomes of the child is made up for."""

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from hapticrender import second_core

EXPECTED = {"assemble", "sum_series"}  # two functions of the plate: what is waited for, and what is called
START = """
import numpy as np
from hapticrender import jit, second_core
from hapticrender.plants.plate_kernels import PLATE, assemble, sum_series
{change}
for function in (assemble, sum_series):
    function.expect()
"""
SCRIPT = """
assert sum_series.address
(child,) = set(second_core.CHILDREN.values())
assert len(second_core.CHILDREN) == 1 and not second_core.EXPECTED
assert assemble.address
plate, term = jit.aligned(1, PLATE), np.arange(8.0)
plate["system"][0, :8], plate["term"][0, :8] = np.eye(8), term
sum_series(plate.ctypes.data)
assert np.allclose(plate["total"][0], (np.e - 1) * term)  # (exp(A) - 1)/A, of the identity
print("child", child.returncode)
"""


two_cores = pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one core: there is no child")
AT_ONCE = "jit.ANNOUNCED_AFTER = 0.0; "  # a single function may take less than a second
ENDLESS = AT_ONCE + "second_core.CODE, second_core.TIMEOUT = 'while True: pass', 0.0"


def lines_of(script, cache, change=""):
    """Lines that a script prints in a process of its own, with a folder for its cache, and what numba says of it."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "NUMBA_DEBUG_CACHE": "1"}
    command = [sys.executable, "-c", START.format(change=change) + script]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert found.returncode == 0, found.stderr
    return found.stdout.splitlines()


@two_cores
@pytest.mark.parametrize(("change", "ended"), [(AT_ONCE, True), (ENDLESS, False)], ids=["it works", "it hangs"])
def test_what_a_child_does_not_compile_is_compiled_here(tmp_path, change, ended):
    lines = lines_of(SCRIPT, tmp_path, change)
    here, loaded = (
        {name for name in EXPECTED for line in lines if f"[cache] data {done}" in line and f".{name}_" in line}
        for done in ("saved to", "loaded from")
    )
    assert (lines[-1] == "child 0") == ended
    assert here == ({"sum_series"} if ended else EXPECTED)
    assert loaded == EXPECTED - here
    if ended:  # what is in the cache needs no child
        lines_of("assert sum_series.address and assemble.address and not second_core.CHILDREN", tmp_path)


@two_cores
@pytest.mark.skipif(os.name == "nt", reason="no signal 0 on Windows: nothing shows whether a process is there")
def test_a_child_does_not_outlive_its_parent(tmp_path):
    script = "second_core.start_child(); print(next(iter(second_core.CHILDREN.values())).pid)"
    pid = int(lines_of(script, tmp_path, ENDLESS)[-1])
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def started(_=None):
    """Whether a child would be started here for a function that is expected; it is not waited for."""
    second_core.EXPECTED.add(("math", "sin"))  # has no address: the child fails
    second_core.start_child()
    child = second_core.CHILDREN.pop(("math", "sin"), None)
    second_core.EXPECTED.clear()
    if child:
        second_core.end(child, 60.0)
    return child is not None


@pytest.fixture
def nothing_expected(monkeypatch):
    monkeypatch.setattr(second_core, "EXPECTED", set())
    monkeypatch.setattr(second_core, "CHILDREN", {})
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(2), raising=False)


def test_no_child_without_a_second_core_or_an_interpreter(nothing_expected, monkeypatch, tmp_path):
    assert started()
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(1), raising=False)
    assert not started()
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(2), raising=False)
    for executable in (None, "", tmp_path / "blender", tmp_path / "python-audio-app", tmp_path / "python3.99"):
        monkeypatch.setattr(sys, "executable", executable and str(executable))
        assert not started()


def test_no_child_of_one_of_many_processes():
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert not any(pool.map(started, range(2)))
