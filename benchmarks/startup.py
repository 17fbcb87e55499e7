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
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # so that Python keeps the byte code of modules
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return float(found.stdout)


def measure(times: int) -> Iterator[tuple[str, float, float, float, str]]:
    """Name, seconds (median), target and bound of each, and a note with a scene under a finger."""
    rows = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as cache:
            rows.append((_spent(IMPORT), _spent(FIRST, cache), _spent(FIRST, cache)))
    imported, cold, warm = (statistics.median(column) for column in zip(*rows, strict=True))
    with tempfile.TemporaryDirectory() as cache:
        note = f"{_spent(TOUCHED, cache):.2f} s for a second under a sliding finger"
    yield "import, over numpy's", imported, 0.1, 0.25, ""
    yield "first sample, caches warm", warm, 0.8, 0.8, ""
    yield "first sample, caches cold", cold, 3.0, 6.0, note
