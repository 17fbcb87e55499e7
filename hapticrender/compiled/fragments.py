"""How numba compiles a kernel and its parts: fewer passes, typing that remembers, parts that are linked once.

Numba compiles every function for itself, and everything it calls into it, again and again.  A kernel is a tree of
dozens, of which only the root is called from Python: here the others are typed, lowered and simplified once (a
fragment each), and the root links them all, is optimised as a whole and made to run.
"""

from __future__ import annotations

import copy
from functools import lru_cache
from typing import Any

from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.typing.context import Context
from numba.core.untyped_passes import FixupArgs, GenericRewrites, IRProcessing, ReconstructSSA, TranslateByteCode

from hapticrender.compiled.records import Layout

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

LINE = 64  # bytes of a cache line, and of the widest register


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
        known, plain = self._lookup_global(func) or func, tuple(types.unliteral(each) for each in args)
        if kws or not isinstance(known, types.Function):
            return super()._resolve_user_function_type(func, args, kws, literals)
        key = id(known), plain  # of an object that is kept beside
        if key not in self.found:  # type: ignore[attr-defined]
            self.found[key] = known, super()._resolve_user_function_type(func, plain, kws)  # type: ignore[attr-defined]
        return self.found[key][1]  # type: ignore[attr-defined]


class _Library(JITCodeLibrary):
    """Code of a kernel, which knows everything that it calls, also by others."""

    def add_linking_library(self, library: Any) -> None:
        """Note a part, and its parts, once."""
        if library not in self._linking_libraries:
            super().add_linking_library(library)
            for each in library._linking_libraries:
                self.add_linking_library(each)

    @property
    def parts(self) -> list[Any]:
        """Itself and everything that it calls."""
        return [self, *self._linking_libraries]


class _FragmentLibrary(_Library):
    """Code of a kernel as a part of others: each function optimised, not linked, nor made to run by itself."""

    def finalize(self) -> None:
        """Leave everything else to who calls it."""
        self._finalized = True


class _WholeLibrary(_Library):
    """Code of a kernel with all its parts."""

    def add_ir_module(self, ir_module: Any) -> None:
        """Add code, and promise that nothing else writes to its records, so that their numbers are read once.

        Its stack starts on a cache line's boundary: vectors that it puts aside else lie across two of them, or not,
        depending on who calls.
        """
        for function in ir_module.functions:
            if function.is_declaration:
                continue
            function.attributes.alignstack = LINE
            for each in function.args:
                if isinstance(getattr(each.type, "pointee", None), Layout):
                    each.add_attribute("noalias")
                    each.attributes.dereferenceable = each.type.pointee.get_abi_size(self._codegen.target_data)
        super().add_ir_module(ir_module)

    def _optimize_final_module(self) -> None:
        """Optimise once: the parts are in order already, and what pays as vectors is written as vectors."""
        passes, builder = self._codegen._module_pass_manager(opt=2)
        passes.run(self._final_module, builder)


class _WholeCompiler(_FunctionCompiler):
    """A wrapper for Python, none for C."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cfunc_wrapper = True
        return flags


class _FragmentCompiler(_FunctionCompiler):
    """Neither wrappers nor machine code."""

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
    """Numba's typing context, one for all kernels: it shares what numba knows, and remembers for itself."""
    typing = copy.copy(target.typing_context)
    typing.__class__, typing.found = _KernelTyping, {}
    return typing


_target = lru_cache(_Target)


def compiler(function: Any, target: Any, options: Any, *, whole: bool) -> Any:
    """Compile `function` as a whole, or as a part of others."""
    kind, library = (_WholeCompiler, _WholeLibrary) if whole else (_FragmentCompiler, _FragmentLibrary)
    return kind(function, _target(target, library), options, {}, _KernelPipeline)
