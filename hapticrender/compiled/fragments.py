"""How numba compiles a kernel and its parts: fewer passes, typing that remembers, parts that are linked once.

Numba compiles every function for itself, and everything it calls into it, again and again.  A kernel is a tree of
dozens, of which only the root is called from Python: here the others are typed, lowered and simplified once (a
fragment each), and the root links them all, is optimised as a whole and made to run.
"""

from __future__ import annotations

import copy
from contextlib import nullcontext
from functools import lru_cache
from typing import Any

from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.cpu import CPUContext
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.errors import NumbaError
from numba.core.interpreter import Interpreter, peep_hole_delete_with_exit
from numba.core.ir_utils import build_definitions
from numba.core.rewrites.static_getitem import RewriteConstGetitems
from numba.core.ssa import reconstruct_ssa
from numba.core.transforms import canonicalize_cfg
from numba.core.typed_passes import NativeLowering, NoPythonBackend, PreLowerStripPhis
from numba.core.typeinfer import TypeInferer
from numba.core.typing.context import Context
from numba.core.untyped_passes import FixupArgs

from hapticrender.compiled.lowering import KernelLower
from hapticrender.compiled.records import Layout

LINE = 64  # bytes of a cache line, and of the widest register


class _KernelLowering(NativeLowering):
    @property
    def lowering_class(self) -> Any:
        """What lowers a kernel."""
        return KernelLower


class _Interpreter(Interpreter):
    """Numba's step from Python's code to its own."""

    def post_process(self, peepholes: Any, func_ir: Any) -> Any:
        """Mend what needs it, and look for no `with`."""
        return super().post_process([each for each in peepholes if each is not peep_hole_delete_with_exit], func_ir)


class _Warnings:
    """Numba holds back the warnings of each statement, to tell where they come from; here they just pass."""

    def catch_warnings(self, **where: Any) -> Any:
        """Pass them."""
        return nullcontext()


class _Passes(PassManager):
    """What numba has to do for a kernel: it has no closures, comprehensions, array expressions or objects."""

    def run(self, state: Any) -> None:
        """Do it."""
        state.func_ir = _Interpreter(state.func_id).interpret(state.bc)
        FixupArgs().run_pass(state)
        state.func_ir.blocks, state.func_ir.generator_info = canonicalize_cfg(state.func_ir.blocks), None
        self.name_entries(state)
        self.defined(state, reconstruct_ssa(state.func_ir))
        self.infer(state)
        self.defined(state, PreLowerStripPhis()._strip_phi_nodes(state.func_ir))
        _KernelLowering().run_pass(state)
        NoPythonBackend().run_pass(state)

    def name_entries(self, state: Any) -> None:
        """Take entries whose index is known, of tuples above all, by what it is."""
        blocks, rewrite = state.func_ir.blocks, RewriteConstGetitems(state)
        for key, block in blocks.items():
            if rewrite.match(state.func_ir, block, None, None):
                blocks[key] = rewrite.apply()

    def infer(self, state: Any) -> None:
        """Find the type of every variable."""
        context, func_ir = state.typingctx, state.func_ir
        inferer = TypeInferer(context, func_ir, _Warnings())
        with context.callstack.register(state.targetctx.target, inferer, state.func_id, state.args):
            for i, (name, kind) in enumerate(zip(func_ir.arg_names, state.args, strict=True)):
                inferer.seed_argument(name, i, kind)
            inferer.build_constraint()
            inferer.propagate()
            state.typemap, state.return_type, state.calltypes = inferer.unify()

    def defined(self, state: Any, func_ir: Any) -> None:
        """Take over what has been rewritten."""
        func_ir._definitions, func_ir.generator_info = build_definitions(func_ir.blocks), None
        state.func_ir = func_ir


class _KernelPipeline(CompilerBase):
    def define_pipelines(self) -> list[PassManager]:
        """Return the one there is."""
        return [_Passes("kernel")]


class _KernelTyping(Context):
    """Numba's typing, which remembers what it found: it tries every meaning of `+` anew at each `+`."""

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Type of a call."""
        func = self._lookup_global(func) or func
        if kws or not isinstance(func, types.Function | types.Dispatcher):
            return super().resolve_function_type(func, args, kws)
        plain = tuple(types.unliteral(each) for each in args)
        key = id(func), plain  # of an object that is kept beside
        if key not in self.found:  # type: ignore[attr-defined]
            self.found[key] = func, self.first_match(func, plain)  # type: ignore[attr-defined]
        return self.found[key][1]  # type: ignore[attr-defined]

    def resolve_getattr(self, typ: Any, attr: str) -> Any:
        """Type of an attribute."""
        key = typ, attr
        if key not in self.found:  # type: ignore[attr-defined]
            self.found[key] = super().resolve_getattr(typ, attr)  # type: ignore[attr-defined]
        return self.found[key]  # type: ignore[attr-defined]

    def first_match(self, func: Any, args: Any) -> Any:
        """Return the first signature that fits; numba's own way tells what is wrong where none does."""
        for each in getattr(func, "templates", ()):
            try:
                template = each(self)
                signature = template.apply(args, {})
            except NumbaError:
                continue
            if signature is not None:
                func._impl_keys[signature.args] = template.get_impl_key(signature)
                return signature
        return super().resolve_function_type(func, args, {})


class _KernelTarget(CPUContext):
    """Numba's knowledge of how to lower what, which remembers, too."""

    def get_function(self, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        """How a function is lowered for these arguments."""
        if fn == "__array__":  # nothing but an array is one, yet numba asks of each, and then looks for news
            raise NotImplementedError
        key = id(fn), sig
        if key not in self.found:  # type: ignore[attr-defined]
            self.found[key] = fn, super().get_function(fn, sig, _firstcall=_firstcall)  # type: ignore[attr-defined]
        return self.found[key][1]  # type: ignore[attr-defined]


class _Library(JITCodeLibrary):
    """Code of a kernel, which knows everything that it calls, also by others."""

    def add_linking_library(self, library: Any) -> None:
        """Note a part, and its parts, once."""
        if library not in self._linking_libraries:
            super().add_linking_library(library)
            for each in library._linking_libraries:
                self.add_linking_library(each)

    def _optimize_functions(self, ll_module: Any) -> None:
        """Simplify what is written in this module, not what is only named."""
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = _passes(self._codegen)
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    @property
    def parts(self) -> list[Any]:
        """Itself and everything that it calls."""
        return [self, *self._linking_libraries]


@lru_cache
def _passes(codegen: Any) -> Any:
    """Passes over a function; nothing in a kernel counts references, so none looks for counts to spare."""
    builder = codegen._pass_builder()
    return builder.getFunctionPassManager(), builder


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
        """Optimise lightly: the parts are in order already, and what pays as vectors is written as vectors."""
        passes, builder = self._codegen._module_pass_manager(opt=1)
        passes.run(self._final_module, builder)


class _WholeCompiler(_FunctionCompiler):
    """A wrapper for Python, none for C."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cfunc_wrapper = True
        return flags


class _PartCompiler(_FunctionCompiler):
    """No wrappers: it is called by its address."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
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
        self.target_context = target.target_context.subtarget(
            _internal_codegen=codegen, typing_context=self.typing_context
        )
        self.target_context.__class__, self.target_context.found = _KernelTarget, {}


@lru_cache
def _typing(target: Any) -> Any:
    """Numba's typing context, one for all kernels: it shares what numba knows, and remembers for itself."""
    typing = copy.copy(target.typing_context)
    typing.__class__, typing.found = _KernelTyping, {}
    return typing


_target = lru_cache(_Target)


KINDS = {
    "whole": (_WholeCompiler, _WholeLibrary),
    "part": (_PartCompiler, _WholeLibrary),
    "fragment": (_FragmentCompiler, _FragmentLibrary),
}


def compiler(function: Any, target: Any, options: Any, kind: str) -> Any:
    """Compile `function` as a whole, or as a part of others."""
    made, library = KINDS[kind]
    return made(function, _target(target, library), options, {}, _KernelPipeline)
