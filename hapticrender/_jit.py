"""The one place that knows how kernels are compiled and cached.

numba's disk cache looks only at the file of the kernel itself, so an edit to
a helper in another file would bring back stale results.  Here every cache
entry also carries the hash of every file that kernels, or the numbers that are
compiled into them, may live in.  Where no cache folder is writable,
kernels compile in memory.

"""

from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature

ROOMS = ("control", "plants")  # where kernels and their numbers live, besides files that begin with _


def _source_stamp() -> str:
    home = Path(__file__).parent
    stamped = hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        source = path.read_bytes()
        below = path.relative_to(home).parts[0] in ROOMS or path.name.startswith("_")
        if below or b"kernel" in source:
            stamped.update(source)
    return stamped.hexdigest()


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


class _FragmentLibrary(JITCodeLibrary):
    """Code of a kernel as a part of others: neither optimised as a whole nor made to run by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _FragmentCompiler(_FunctionCompiler):
    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        return flags


class _FragmentTarget:
    """The processor, with libraries that are fragments."""

    def __init__(self, target: Any) -> None:
        self.options, self.typing_context = target.options, target.typing_context
        codegen = copy.copy(target.target_context.codegen())
        codegen._library_class = _FragmentLibrary
        self.target_context = target.target_context.subtarget(_internal_codegen=codegen)


class _Fragment(CPUDispatcher):
    """A kernel as its callers see it: typed and lowered once for each of its types, compiled inside of them."""

    def __init__(self, function: Any) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS, nopython=True))
        target, options = _FragmentTarget(self.targetdescr), self.targetoptions
        self._compiler: Any = _FragmentCompiler(function, target, options, {}, Compiler)

    def compile(self, sig: Any) -> Any:
        """Type and lower the kernel for these arguments."""
        args, returned = normalize_signature(sig)
        with global_compiler_lock, self._compiling_counter:
            known: Any = self.overloads.get(tuple(args))
            if known is None:
                key = object()
                lowered: Any = self._compiler.compile(args, returned)
                known = lowered._replace(entry_point=key)
                part = known._asdict()
                self.targetctx.insert_user_function(key, part["fndesc"], [part["library"]])
                self.overloads[tuple(args)] = known
        return known.entry_point


class _Kernel(CPUDispatcher):
    """A kernel as Python sees it: whole, and cached; other kernels get its fragment."""

    fragment: Any = None

    @property
    def _numba_type_(self) -> Any:
        return types.Dispatcher(self.fragment)


def kernel(function: Any) -> Any:
    """Compile `function` for the tick: no bounds checks, numpy error model, contracted arithmetic, cached on disk.

    A kernel allocates nothing, so arrays need no counting of references inside it (a call of the counter costs more
    than the arithmetic), and it becomes part of its caller, so that named tuples cost nothing to pass.
    """
    compiled = _Kernel(function, targetoptions=dict(OPTIONS, nopython=True))
    compiled.fragment = _Fragment(function)
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
