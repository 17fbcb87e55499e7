"""Seconds until the package is imported and until the first sample is out, in fresh processes."""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator

IMPORT = "import time, numpy; start = time.perf_counter(); import hapticrender; print(time.perf_counter() - start)"
FIRST = """
import time
start = time.perf_counter()
import numpy as np
import hapticrender as hr
scene = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=0.001)
hr.render(scene)
print(time.perf_counter() - start)
"""
TOUCHED = FIRST.replace("duration=0.001", "finger=hr.Finger.sliding(0.05), duration=1.0")


def _spent(code: str, cache: str | None = None) -> float:
    environment = dict(os.environ) | ({"NUMBA_CACHE_DIR": cache} if cache else {})
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps the byte code of modules, unless it is told not to
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return float(found.stdout)


def _cold(code: str) -> float:
    with tempfile.TemporaryDirectory() as empty:
        return _spent(code, empty)


def measure(times: int) -> Iterator[tuple[str, float, float, str]]:
    """Name, seconds (median) and bound of each, and a note."""
    with tempfile.TemporaryDirectory() as kept:
        _spent(FIRST, kept)
        rows = [(_spent(IMPORT), _spent(FIRST, kept), _cold(FIRST), _cold(TOUCHED)) for _ in range(times)]
    imported, warm, cold, touched = (statistics.median(column) for column in zip(*rows, strict=True))
    yield "import, over numpy's", imported, 0.25, ""
    yield "first sample, caches warm", warm, 0.7, ""
    yield "first sample, caches cold", cold, 2.5, f"{touched:.2f} s for a second under a sliding finger"
