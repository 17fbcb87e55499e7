"""The one place that knows how kernels are compiled and cached.

numba's disk cache looks only at the file of the kernel itself, so an edit to
a helper in another file would bring back stale results.  Here every cache
entry also carries the hash of every file that kernels, or the numbers that are
compiled into them, may live in.  Where no cache folder is writable,
kernels compile in memory.

"""

from __future__ import annotations

import copy
import gc
import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.typing.context import Context
from numba.core.untyped_passes import FixupArgs, GenericRewrites, IRProcessing, ReconstructSSA, TranslateByteCode

from hapticrender._records import Layout, as_record

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

PASSES = (
    TranslateByteCode,
    FixupArgs,
    IRProcessing,
    GenericRewrites,  # entries of tuples whose index is known
    ReconstructSSA,
    NopythonTypeInference,
    PreLowerStripPhis,
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
)


class _StampedCache(FunctionCache):
    """A function cache that is stale as soon as any kernel file has changed."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _STAMP)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=stamp
        )


class _KernelPipeline(CompilerBase):
    """The passes of numba that a kernel needs: it has no closures, comprehensions, array expressions or objects."""

    def define_pipelines(self) -> list[PassManager]:
        """Return the passes in their order."""
        passes = PassManager("kernel")
        for each in PASSES:
            passes.add_pass(each, each.__name__)
        passes.finalize()
        return [passes]


class _KernelTyping(Context):
    """Numba's typing, which remembers what it found: it tries every meaning of `+` anew at each `+`."""

    def _resolve_user_function_type(self, func: Any, args: Any, kws: Any, literals: Any = None) -> Any:
        known = self._lookup_global(func) or func
        if kws or not isinstance(known, types.Function):
            return super()._resolve_user_function_type(func, args, kws, literals)
        found = self.found.get((id(known), args))  # type: ignore[attr-defined]
        if found is None:
            sig = super()._resolve_user_function_type(func, args, kws, literals)
            found = self.found[id(known), args] = known, sig  # type: ignore[attr-defined]
        return found[1]


class _FragmentLibrary(JITCodeLibrary):
    """Code of a kernel as a part of others: neither linked, nor optimised, nor made to run by itself."""

    def finalize(self) -> None:
        self._finalized = True


class _WholeLibrary(JITCodeLibrary):
    """Code of a kernel with all its parts, each linked once."""

    def add_ir_module(self, ir_module: Any) -> None:
        """Add code, and promise that nothing writes to its records while it runs, so that their numbers are read once."""
        for function in ir_module.functions:
            for each in function.args if not function.is_declaration else ():
                if isinstance(getattr(each.type, "pointee", None), Layout):
                    each.add_attribute("noalias")
                    each.attributes.dereferenceable = each.type.pointee.get_abi_size(self._codegen.target_data)
        super().add_ir_module(ir_module)

    def add_linking_library(self, library: Any) -> None:
        if library not in self._linking_libraries:
            super().add_linking_library(library)
            for each in library._linking_libraries:
                self.add_linking_library(each)


class _FragmentCompiler(_FunctionCompiler):
    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        return flags


class _Target:
    """The processor, with kernels' typing and libraries of a class."""

    def __init__(self, target: Any, library: Any) -> None:
        self.options, self.typing_context = target.options, _typing(target)
        codegen = copy.copy(target.target_context.codegen())
        codegen._library_class = library
        self.target_context = target.target_context.subtarget(_internal_codegen=codegen)


@lru_cache
def _typing(target: Any) -> Any:
    typing = copy.copy(target.typing_context)
    typing.__class__, typing.found = _KernelTyping, {}
    return typing


_target = lru_cache(_Target)


class _Fragment(CPUDispatcher):
    """A kernel as its callers see it: typed and lowered once for each of its types, compiled inside of them."""

    def __init__(self, function: Any) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS, nopython=True))
        self._compiler: Any = _FragmentCompiler(
            function, _target(self.targetdescr, _FragmentLibrary), self.targetoptions, {}, _KernelPipeline
        )

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
                part = known._asdict()
                self.targetctx.insert_user_function(key, part["fndesc"], [part["library"]])
                self.overloads[tuple(args)] = known
        return known.entry_point


class _Kernel(CPUDispatcher):
    """A kernel as Python sees it: whole, and cached; other kernels get its fragment."""

    def __init__(self, function: Any) -> None:
        super().__init__(function, targetoptions=dict(OPTIONS, nopython=True))
        self.fragment = _Fragment(function)
        self._compiler: Any = _FunctionCompiler(
            function, _target(self.targetdescr, _WholeLibrary), self.targetoptions, {}, _KernelPipeline
        )

    def compile(self, sig: Any) -> Any:
        """Compile for these arguments, without a look for garbage at every step."""
        collects = gc.isenabled()
        gc.disable()
        try:
            return super().compile(sig)
        finally:
            if collects:
                gc.enable()

    def typeof_pyval(self, val: Any) -> Any:
        """Numba's type of an argument: named tuples go by address."""
        return as_record(super().typeof_pyval(val))  # type: ignore[misc]

    @property
    def _numba_type_(self) -> Any:
        return types.Dispatcher(self.fragment)


def kernel(function: Any) -> Any:
    """Compile `function` for the tick: no bounds checks, numpy error model, contracted arithmetic, cached on disk.

    A kernel allocates nothing, so arrays need no counting of references inside it (a call of the counter costs more
    than the arithmetic), and it becomes part of its caller, so that named tuples cost nothing to pass.
    """
    compiled = _Kernel(function)
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
