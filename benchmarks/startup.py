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


def _spent(code: str, cache: str | None = None) -> float:
    environment = dict(os.environ) | ({"NUMBA_CACHE_DIR": cache} if cache else {})
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return float(found.stdout)


def measure(times: int) -> Iterator[tuple[str, float, float]]:
    """Name, seconds (median) and bound of each."""
    with tempfile.TemporaryDirectory() as kept:
        _spent(FIRST, kept)
        rows = []
        for _ in range(times):
            with tempfile.TemporaryDirectory() as empty:
                rows.append((_spent(IMPORT), _spent(FIRST, kept), _spent(FIRST, empty)))
    names = (("import, over numpy's", 0.25), ("first sample, caches warm", 0.7), ("first sample, caches cold", 2.5))
    for (name, bound), column in zip(names, zip(*rows, strict=True), strict=True):
        yield name, statistics.median(column), bound
