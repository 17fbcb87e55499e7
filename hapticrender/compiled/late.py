"""Parts of a kernel that are compiled when a sample first needs them: what a scene never needs costs nothing.

A late part is called by its address, which stands in a cell of the caller's code.  Where the cell is empty, the code
asks for the part (`asking`), and waits.  Where something is live, so that nothing may be compiled in the middle,
`complete` fills all cells beforehand.
"""

from __future__ import annotations

import base64
import ctypes
import hashlib
import inspect
import pickle
from collections.abc import Iterator
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from hapticrender.compiled.asking import POINTER, answer_by, asking

CELL, TEXT = "hapticrender.late.", ".text"  # names in the code: of a cell, and what follows in that of its text


class Late:
    """A kernel that others call by address; it returns nothing, so that nobody has to look into it."""

    def __init__(self, function: Any, part: Any) -> None:
        if "<locals>" in function.__qualname__:
            raise ValueError(f"late kernel {function.__qualname__!r}: must be found by its name in its module")
        self.__module__, self.__qualname__ = function.__module__, function.__qualname__
        self.__name__, self.__doc__ = function.__name__, function.__doc__
        self.part = part
        count = len(inspect.signature(function).parameters)

        class Template(AbstractTemplate):
            key = self

            def generic(self, args: Any, kws: Any) -> Any:
                fits = len(args) == count and not kws
                return signature(types.none, *(types.unliteral(each) for each in args)) if fits else None

        infer_global(self, types.Function(Template))  # type: ignore[arg-type]
        lower_builtin(self, types.VarArg(types.Any))(self._call)

    def __reduce__(self) -> str:
        """Go by name."""
        return self.__qualname__

    def compiled(self, args: Any) -> Any:
        """Return what numba knows of the code for these types."""
        self.part.compile(args)
        found = self.part.overloads[args]
        if found.signature.return_type != types.none:
            raise TypeError(f"late kernel {self.__qualname__!r} returns {found.signature.return_type}: must be nothing")
        return found

    def _call(self, context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Write the code of a call."""
        text = base64.b64encode(pickle.dumps((self, sig.args)))
        module, name = builder.module, CELL + hashlib.sha256(text).hexdigest()[:24]
        cell, convention = module.globals.get(name), context.call_conv
        if cell is None:
            cell = _shared(module, name, ir.Constant(POINTER, None))
            _shared(module, name + TEXT, cgutils.make_bytearray(text + b"\0"))
        with cgutils.if_unlikely(builder, cgutils.is_null(builder, builder.load(cell))):
            told = builder.bitcast(module.globals[name + TEXT], POINTER)
            failed = builder.call(asking(context, module), [cell, told])
            with cgutils.if_unlikely(builder, failed):
                convention.return_exc(builder)
        kind = convention.get_function_type(types.none, sig.args)
        part = builder.bitcast(builder.load(cell), kind.as_pointer())
        status, _ = convention.call_function(builder, part, types.none, sig.args, args)
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()


def _shared(module: Any, name: str, value: Any) -> Any:
    """Make a variable that all code in this process shares."""
    made = ir.GlobalVariable(module, value.type, name)
    made.initializer, made.linkage = value, "linkonce_odr"
    return made


def wanted(text: bytes) -> tuple[Late, Any]:
    """Kernel and types that a text tells."""
    kernel, args = pickle.loads(base64.b64decode(text))
    return kernel, args


def _part(text: bytes) -> Any:
    kernel, args = wanted(text)
    return kernel.compiled(args)


def code_of(compiled: Any) -> Any:
    """Where numba keeps the code of what it has compiled."""
    return compiled._asdict()["library"]


def _address(part: Any) -> int:
    return int(code_of(part).get_pointer_to_function(part.fndesc.llvm_func_name))


answer_by(lambda text: _address(_part(text)))


def cells(code: Any) -> Iterator[tuple[Any, bytes]]:
    """Cells of some code, and what belongs into each."""
    engine = code.codegen._engine._ee
    for each in (code._shared_module or code._final_module).global_variables:
        if each.name.startswith(CELL) and not each.name.endswith(TEXT):
            cell = ctypes.c_void_p.from_address(engine.get_global_value_address(each.name))
            yield cell, ctypes.string_at(engine.get_global_value_address(each.name + TEXT))


def complete(code: Any, known: frozenset[bytes] = frozenset()) -> None:
    """Compile all late parts of some code, and theirs."""
    for cell, text in cells(code):
        if text not in known:
            part = _part(text)
            cell.value = _address(part)
            complete(code_of(part), known | {text})
