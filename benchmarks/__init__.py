"""Measurements that the documentation names; the plates that they play on are those of the tests."""

import sys
from pathlib import Path

# kernels that numba has cached while tests ran are of `strangers_plate`, not of `tests.strangers_plate`
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
