"""Set up every test: a cache of compiled kernels that is never stale, seeded randomness, loud arithmetic."""

import hashlib
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

# Before numpy is loaded: two workers whose sums of small matrices run on two threads each wait for one another on two
# cores; fits of 13 simulated subjects took 37 s instead of 1 s.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell starts what it runs in the background with Ctrl-C ignored, and the programs under test would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import hypothesis  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
KEPT = 86_400.0  # s: caches of older sources are deleted after a day

# The programs that a test starts find the package and the tests' modules wherever they run.
PATHS = (str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH"))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, PATHS))


def fresh_cache(root: Path) -> Path:
    """Folder of compiled kernels named by numba's version and a hash of all sources that compile something.

    numba compiles a cached kernel anew when its own file changes, but not when a kernel that it calls, in another
    file, does.
    """
    digest = hashlib.sha256(version("numba").encode())
    for folder in ("hapticrender", "renderers", "drivers", "tests"):
        for path in sorted((root / folder).rglob("*.py")):
            source = path.read_bytes()
            if b"numba" in source or b"hapticrender.jit" in source:
                digest.update(source)
    caches = root / ".pytest_cache" / "numba"
    for old in caches.glob("*"):
        if time.time() - old.stat().st_mtime > KEPT:
            shutil.rmtree(old, ignore_errors=True)
    cache = caches / digest.hexdigest()[:16]
    cache.mkdir(parents=True, exist_ok=True)
    os.utime(cache)
    return cache


if "numba" in sys.modules:
    raise RuntimeError("numba is imported before tests/conftest.py: NUMBA_CACHE_DIR would come too late")
os.environ["NUMBA_CACHE_DIR"] = str(fresh_cache(ROOT))

hypothesis.settings.register_profile("house", derandomize=True, deadline=None, max_examples=25, database=None)
hypothesis.settings.load_profile("house")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Let a test fail that skips for want of a package although all are there, as in CI (`.ci/run`)."""
    report = yield
    if report.skipped and "install" in str(call.excinfo.value) and "HAPTICRENDER_PACKAGES" in os.environ:
        report.outcome = "failed"
    return report


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20210617)


@pytest.fixture(autouse=True)
def loud_arithmetic() -> Iterator[None]:
    with np.errstate(all="raise"):
        yield


@pytest.fixture
def empty_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave pictures of recordings empty: drawing one takes longer than playing what it shows."""
    monkeypatch.setattr("hapticrender.report.picture.plot", lambda recording, path: Path(path).touch())


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """Designs of the textures of `laws`, and their laws in C."""
    from laws import Exports

    return Exports(tmp_path_factory.mktemp("exports"))


@pytest.fixture(scope="module")
def jack_program(tmp_path_factory):
    """The second client of `jack_ring`, compiled."""
    import jack_ring

    return jack_ring.build(tmp_path_factory.mktemp("jack"))


@pytest.fixture(scope="module")
def jack_server(tmp_path_factory):
    """A JACK server with its dummy back end."""
    import jack_ring

    with jack_ring.server(tmp_path_factory.mktemp("server")):
        yield


@pytest.fixture
def connected(jack_server, jack_program, tmp_path):
    """Function that runs a system as the second client until the test ends."""
    import jack_ring

    with ExitStack() as stack:

        def run(system, **options):
            return stack.enter_context(jack_ring.device(jack_program, tmp_path, system, **options))

        yield run


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with the recorded finger, which is no part of this repository."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the recorded finger is not here: no ../shared/data beside the checkout")
    return folder
