"""The kernel cache: hit when nothing changed, stale as soon as any kernel source did (where numba's own is not)."""

import os
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT

HELPER = """
from {jit} import kernel

@kernel
def factor():
    return {value}
"""
CALLER = """
from {jit} import kernel
from toy.helper import factor

@kernel
def scaled(x):
    return factor() * x
"""
NAIVE_JIT = """
import numba
kernel = numba.njit(cache=True)
"""


@pytest.fixture(params=["ours", "naive"])
def toy(request, tmp_path):
    """A package of two kernel files, one calling the other, with our decorator or numba's plain one."""
    package = tmp_path / "toy"
    package.mkdir()
    (package / "__init__.py").touch()
    if request.param == "ours":
        shutil.copy(ROOT / "hapticrender" / "_jit.py", package / "_jit.py")
    else:
        (package / "_jit.py").write_text(NAIVE_JIT)
    (package / "caller.py").write_text(CALLER.format(jit="toy._jit"))
    return request.param, package


def run(package, value):
    """Write the helper, call the caller in a fresh process; returns result and cache hits of the caller."""
    (package / "helper.py").write_text(HELPER.format(jit="toy._jit", value=value))
    script = "from toy.caller import scaled; print(scaled(1.0), sum(scaled.stats.cache_hits.values()))"
    environment = {name: text for name, text in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=package.parent, env=environment, capture_output=True, text=True, check=True
    )
    result, hits = done.stdout.split()
    return float(result), int(hits)


def test_an_edit_in_another_file_is_noticed(toy):
    kind, package = toy
    assert run(package, 2.0) == (2.0, 0)
    assert run(package, 2.0) == (2.0, 1)
    assert run(package, 3.0) == ((3.0, 0) if kind == "ours" else (2.0, 1))
