"""The one place that knows what a kernel is and how it is cached; `fragments` knows how it is compiled.

numba's disk cache looks only at the file of the kernel itself, so an edit to
a helper in another file would bring back stale results.  Here every cache
entry also carries the hash of every file that kernels, or the numbers that are
compiled into them, may live in.  Where no cache folder is writable,
kernels compile in memory.

"""

from __future__ import annotations

import gc
import hashlib
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.ccallback import CFunc
from numba.core.compiler_lock import global_compiler_lock
from numba.core.imputils import lower_builtin
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.typing.templates import AbstractTemplate, infer_global

from hapticrender.compiled.fragments import compiler
from hapticrender.compiled.late import Late, code_of, complete
from hapticrender.compiled.records import as_record

ROOMS = ("compiled", "control", "plants")  # where kernels and their numbers live


def _source_stamp() -> str:
    home = Path(__file__).parent.parent
    stamped = hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        source = path.read_bytes()
        if path.relative_to(home).parts[0] in ROOMS or b"kernel" in source:
            stamped.update(source)
    return stamped.hexdigest()


_STAMP = _source_stamp()
OPTIONS: Any = {"error_model": "numpy", "fastmath": {"contract"}, "nogil": True, "forceinline": True, "_nrt": False}

# what reading a file that is not whole may raise
TORN = (OSError, EOFError, UnpicklingError, ValueError, LookupError, AttributeError, ImportError)


class CacheFile(IndexDataCacheFile):
    """Numba's index of what is cached.

    What another version wrote, of modules that are no more, or a killed process left unfinished counts as nothing.
    """

    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[misc]
        except TORN:
            return {}


class _StampedCache(FunctionCache):
    """A function cache that is stale as soon as any kernel file has changed."""

    def __init__(self, function: Any, kind: str) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _STAMP)
        self._cache_file = CacheFile(
            cache_path=self._cache_path, filename_base=f"{self._impl.filename_base}.{kind}", source_stamp=stamp
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is cached; what cannot be read, or is of other types, counts as nothing."""
        try:
            found = super().load_overload(sig, target_context)
        except TORN:
            return None
        return found if found is None or tuple(found.signature.args) == normalize_signature(sig)[0] else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what has been compiled; where there is no room for it any more, it serves this process only."""
        with suppress(OSError):
            super().save_overload(sig, data)


def _cache_of(function: Any, kind: str) -> Any:
    try:
        return _StampedCache(function, kind)
    except RuntimeError:  # numba: no writable cache location
        return NullCache()


class _Fragment(CPUDispatcher):
    """A kernel as its callers see it: typed and lowered once for each of its types, compiled inside of them."""

    def __init__(self, function: Any) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS, nopython=True))
        self._compiler: Any = compiler(function, self.targetdescr, self.targetoptions, "fragment")

    def compile(self, sig: Any) -> Any:
        """Type and lower the kernel for these arguments."""
        args, returned = normalize_signature(sig)
        args = tuple(types.unliteral(each) for each in args)  # once for all numbers: LLVM sees them where it inlines
        with global_compiler_lock, self._compiling_counter:
            known: Any = self.overloads.get(tuple(args))
            if known is None:
                key = object()
                lowered: Any = self._compiler.compile(args, returned)
                known = lowered._replace(entry_point=key)
                self.targetctx.insert_user_function(key, known.fndesc, code_of(known).parts)
                self.overloads[tuple(args)] = known
        return known.entry_point


class _Kernel(CPUDispatcher):
    """A kernel as Python sees it, whole; other kernels get its fragment.

    Of kind "part" it has no way in for Python and is called by its address.  A `live` one has compiled its late parts
    before it runs.
    """

    def __init__(self, function: Any, kind: str = "whole", *, live: bool = True, cached: bool = True) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS, nopython=True))
        self.kind, self.live, self.cached = kind, live, cached
        self._compiler: Any = compiler(function, self.targetdescr, self.targetoptions, kind)
        self._cache: Any = NullCache()

    def compile(self, sig: Any) -> Any:
        """Compile for these arguments, without a look for garbage at every step.

        Most kernels are parts of others and never come here: to look for a cache takes longer than to make the kernel.
        """
        if self.cached and isinstance(self._cache, NullCache):
            self._cache = _cache_of(self.py_func, self.kind)
        collects = gc.isenabled()
        gc.disable()
        try:
            return super().compile(sig)
        finally:
            if collects:
                gc.enable()

    def add_overload(self, cres: Any) -> None:
        """Let calls find what has been compiled, or came from the cache."""
        if self.live:
            complete(code_of(cres))
        super().add_overload(cres)

    def typeof_pyval(self, val: Any) -> Any:
        """Numba's type of an argument: named tuples go by address."""
        return as_record(super().typeof_pyval(val))  # type: ignore[misc]

    @cached_property
    def fragment(self) -> _Fragment:
        """What its callers compile in."""
        return _Fragment(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        return types.Dispatcher(self.fragment)


def kernel(function: Any) -> Any:
    """Compile `function` for the tick: no bounds checks, numpy error model, contracted arithmetic, cached on disk.

    A kernel allocates nothing, so arrays need no counting of references inside it (a call of the counter costs more
    than the arithmetic), and it becomes part of its caller, so that named tuples cost nothing to pass.
    """
    return _Kernel(function)


def simulation(function: Any) -> Any:
    """Make a `kernel` in which nothing is live: its late parts may be compiled while it runs."""
    return _Kernel(function, live=False)


def late(function: Any) -> Any:
    """Make a `kernel` that does not become part of its caller, but is compiled when it is first called.

    It is for what many scenes do not need, and returns nothing.  Only a `simulation` waits for it; every other kernel
    that Python or C calls has compiled its late parts beforehand.
    """
    return Late(function, _Kernel(function, "part", live=False))


def by_types(choose: Any) -> Any:
    """Make of a function, which returns a kernel for the types of some arguments, what kernels call with those.

    What is called is decided while the caller is compiled, and becomes part of it, as a kernel does.
    """

    class Template(AbstractTemplate):
        key = choose

        def generic(self, args: Any, kws: Any) -> Any:
            return choose(*args)._numba_type_.get_call_type(self.context, args, kws)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        call = context.get_function(choose(*sig.args)._numba_type_, sig)
        context.add_linking_libs(getattr(call, "libs", ()))
        return call(builder, args)

    infer_global(choose, types.Function(Template))
    lower_builtin(choose, types.VarArg(types.Any))(build)
    return choose


def callback(function: Any, returned: Any, *taken: Any) -> Any:
    """Compile `function` for callers in C, cached on disk: a `CFunc` with `address` and `ctypes`."""
    compiled: Any = CFunc(function, (taken, returned), {}, OPTIONS)
    compiled._cache = _cache_of(function, "callback")
    compiled.compile()
    complete(compiled._library)
    return compiled
