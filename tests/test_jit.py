"""The kernel cache: hit when nothing changed, stale as soon as any kernel source did (where numba's own is not)."""

import os
import pickle
import shutil
import subprocess
import sys
from collections import namedtuple
from typing import NamedTuple

import numba
import numpy as np
import pytest
from conftest import ROOT
from numba.core import types
from numba.core.errors import TypingError

from hapticrender.compiled.jit import CacheFile, by_types, kernel

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
    (package / "compiled").mkdir(parents=True)
    (package / "__init__.py").touch()
    if request.param == "ours":
        shutil.copy(ROOT / "hapticrender" / "compiled" / "jit.py", package / "compiled")
    else:
        (package / "compiled" / "jit.py").write_text(NAIVE_JIT)
    (package / "caller.py").write_text(CALLER.format(jit="toy.compiled.jit"))
    return request.param, package


def run(package, value):
    """Write the helper, call the caller in a fresh process; returns result and cache hits of the caller.

    Python itself would take a helper for the last one that is as long and was written in the same second: no byte code.
    """
    (package / "helper.py").write_text(HELPER.format(jit="toy.compiled.jit", value=value))
    script = "from toy.caller import scaled; print(scaled(1.0), sum(scaled.stats.cache_hits.values()))"
    environment = {name: text for name, text in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-B", "-c", script],
        cwd=package.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    result, hits = done.stdout.split()
    return float(result), int(hits)


def test_an_edit_in_another_file_is_noticed(toy):
    kind, package = toy
    assert run(package, 2.0) == (2.0, 0)
    assert run(package, 2.0) == (2.0, 1)
    assert run(package, 3.0) == ((3.0, 0) if kind == "ours" else (2.0, 1))


def test_a_read_only_install_with_no_cache_still_runs(tmp_path):
    """Nothing can be written, neither beside the package nor in the user's home: it compiles in memory, and renders."""
    if not hasattr(os, "geteuid"):
        pytest.skip("permissions are checked the POSIX way")
    shutil.copytree(
        ROOT / "hapticrender", tmp_path / "site" / "hapticrender", ignore=shutil.ignore_patterns("__pycache__")
    )
    for room in ("renderers", "drivers"):
        shutil.copytree(
            ROOT / room, tmp_path / "site" / "hapticrender" / room, ignore=shutil.ignore_patterns("__pycache__")
        )
    script = """
import pathlib, sys
import hapticrender as hr
from hapticrender.plants.closed import closed_plate_run
from numba.core.caching import NullCache
assert pathlib.Path(hr.__file__).is_relative_to(sys.argv[1]), hr.__file__
scene = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.01)
print(len(hr.render(scene).drive))
assert closed_plate_run.signatures and isinstance(closed_plate_run._cache, NullCache), closed_plate_run._cache
"""
    for path in sorted((tmp_path / "site").rglob("*"), reverse=True):
        path.chmod(0o555 if path.is_dir() else 0o444)
    (tmp_path / "site").chmod(0o555)
    kept = {name: text for name, text in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    nowhere = {"HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none", "PYTHONPATH": str(tmp_path / "site")}
    command = [sys.executable, "-B", "-c", script, str(tmp_path / "site")]
    if os.geteuid() == 0:  # root may write anywhere: be somebody else
        for parent in [tmp_path, *tmp_path.parents][:-2]:
            parent.chmod(parent.stat().st_mode | 0o055)
        nobody = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
        trial = [*nobody, sys.executable, "-c", "import numba"]
        if not shutil.which("setpriv") or subprocess.run(trial, capture_output=True, cwd="/").returncode:
            pytest.skip("root may write anywhere, and nobody else may run this interpreter")
        command = [*nobody, *command]
    done = subprocess.run(command, env=kept | nowhere, capture_output=True, text=True, cwd="/", timeout=300)
    assert done.stdout.strip() == "50", done.stderr


def test_numbers_that_are_compiled_in_count(tmp_path):
    """A file of row numbers, which never says what it is for: an edit makes another stamp, one to a page does not."""
    package = tmp_path / "toy"
    for room in ("compiled", "control"):
        (package / room).mkdir(parents=True)
    shutil.copy(ROOT / "hapticrender" / "compiled" / "jit.py", package / "compiled")

    def stamp(rows, page):
        (package / "control" / "rows.py").write_text(rows)
        (package / "page.py").write_text(page)
        script = "from toy.compiled.jit import _STAMP; print(_STAMP)"
        return subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout

    first = stamp("RE, IM = 0, 1", "a")
    assert stamp("RE, IM = 0, 1", "b") == first
    assert stamp("IM, RE = 0, 1", "b") != first


@kernel
def mass_of(pair):
    return pair.mass


class Inner(NamedTuple):
    gain: float
    steps: tuple


class Outer(NamedTuple):
    offset: float
    inner: Inner
    out: np.ndarray


@kernel
def apply(inner, x):
    return inner.gain * x + inner.steps[1]


@kernel
def fill(outer, x):
    for i in range(outer.out.shape[0]):
        outer.out[i] = outer.offset + apply(outer.inner, x[i])


def test_named_tuples_reach_a_kernel_and_its_parts():
    """Fields, a tuple inside, an array that is written to, and a field that is no number."""
    x, record = np.array([1.0, 2.0]), Outer(10.0, Inner(3.0, (5.0, 7.0)), np.zeros(2))
    fill(record, x)
    np.testing.assert_array_equal(record.out, 10.0 + 3.0 * x + 7.0)
    with pytest.raises(TypingError):
        fill(record._replace(offset="10"), x)


class Mixed(NamedTuple):
    a: float
    b: float
    count: int
    on: bool
    c: float
    three: tuple
    two: tuple
    out: np.ndarray
    inner: Inner
    whole: np.ndarray
    d: float


@kernel
def spread(mixed):
    out, inner = mixed.out, mixed.inner
    out[0], out[1], out[2], out[3], out[4] = mixed.a, mixed.b, mixed.count, mixed.on, mixed.c
    for i in range(3):
        out[5 + i] = mixed.three[i]
    out[8], out[9] = mixed.two[0], mixed.two[1]
    out[10], out[11], out[12] = inner.gain, inner.steps[0], inner.steps[1]
    out[13], out[14], out[15] = mixed.whole[0], mixed.whole[1], mixed.d


def test_every_kind_of_field_arrives_where_it_belongs():
    """Runs of floats between other numbers, tuples of one kind, arrays of two kinds, a record inside."""
    out, whole = np.zeros(16), np.array([13, 14])
    spread(Mixed(0.5, 1.0, 2, True, 4.0, (5.0, 6.0, 7.0), (8, 9), out, Inner(10.0, (11.0, 12.0)), whole, 15.0))
    np.testing.assert_array_equal(out, [0.5, 1, 2, 1, *range(4, 16)])


@kernel
def twice(x):
    return 2.0 * x


@kernel
def first(x):
    return x[0]


@by_types
def plain(x):
    return first if isinstance(x, types.Array) else twice


@kernel
def both(x, y):
    return plain(x) + plain(y)


def test_types_choose_what_is_called():
    assert both(np.array([3.0]), 4.0) == 11.0


@kernel
def loudness(x):
    return abs(x)


@kernel
def louder(x):
    return 2.0 * loudness(x)


def test_what_numba_compiles_inside_of_a_part_is_linked():
    """The magnitude of a complex number is numba's own function, which calls another."""
    assert louder(3.0 + 4.0j) == 10.0


def test_plain_numba_calls_a_kernel_with_all_its_parts():
    @numba.njit
    def caller(x, y):
        return both(x, y)

    assert caller(np.array([3.0]), 4.0) == 11.0
    assert numba.njit(lambda x: louder(x))(3.0 + 4.0j) == 10.0


def test_records_of_one_name_are_told_apart_by_their_fields():
    """Two named tuples called alike, of the same types in another order of names."""
    for pair in (namedtuple("Pair", "mass damping"), namedtuple("Pair", "damping mass")):
        assert mass_of(pair(mass=1.0, damping=2.0)) == 1.0


def test_what_a_version_with_other_modules_cached_counts_as_nothing(tmp_path):
    """An index whose entries name a module that is no more: not loaded, and written anew."""
    cached = CacheFile(str(tmp_path), "kernel", "stamp")
    cached.save("key", 1)
    assert cached.load("key") == 1
    (index,) = tmp_path.glob("*.nbi")
    index.write_bytes(pickle.dumps(numba.__version__) + b"cno_such_module\nThing\n.")
    assert cached.load("key") is None
    cached.save("key", 2)
    assert cached.load("key") == 2
