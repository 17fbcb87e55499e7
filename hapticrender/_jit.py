"""The one place that knows how kernels are compiled and cached.

numba's disk cache looks only at the file of the kernel itself, so an edit to
a helper in another file would bring back stale results.  Here every cache
entry also carries the hash of every file of the package that holds kernels or
speaks of them.  Where no cache folder is writable,
kernels compile in memory.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc


def _source_stamp() -> str:
    sources = (path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
    return hashlib.sha256(b"".join(source for source in sources if b"kernel" in source)).hexdigest()


_STAMP = _source_stamp()
OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract"}, "nogil": True, "forceinline": True, "_nrt": False}


class _StampedCache(FunctionCache):
    """A function cache that is stale as soon as any kernel file has changed."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _STAMP)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=stamp
        )


def kernel(function: Any) -> Any:
    """Compile `function` for the tick: no bounds checks, numpy error model, contracted arithmetic, cached on disk.

    A kernel allocates nothing, so arrays need no counting of references inside it (a call of the counter costs more
    than the arithmetic), and it becomes part of its caller, so that named tuples cost nothing to pass.
    """
    compiled = numba.njit(**OPTIONS)(function)
    try:
        compiled._cache = _StampedCache(function)  # type: ignore[attr-defined]
    except RuntimeError:  # numba: no writable cache location
        pass
    return compiled


def callback(function: Any, returned: Any, *taken: Any) -> Any:
    """Compile `function` for callers in C, cached on disk: a `CFunc` with `address` and `ctypes`."""
    compiled: Any = CFunc(function, (taken, returned), {}, OPTIONS)
    try:
        compiled._cache = _StampedCache(function)
    except RuntimeError:
        pass
    compiled.compile()
    return compiled
