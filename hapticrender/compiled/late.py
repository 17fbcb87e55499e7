"""Parts of a kernel that are compiled when a sample first needs them: what a scene never needs costs nothing.

A late part is called by its address, which stands in a cell of the caller's code.  Where the cell is empty, the code
asks a thread of Python's for the part, and waits.  It runs no Python itself: signals are heard when it has returned.
Where something is live, so that nothing may be compiled in the middle, `complete` fills all cells beforehand.
"""

from __future__ import annotations

import base64
import ctypes
import hashlib
import inspect
import pickle
from collections.abc import Iterator
from typing import Any

from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

CELL, TEXT = "hapticrender.late.", ".text"  # names in the code: of a cell, and what follows in that of its text
ASK, ANSWER = "hapticrender.ask", "hapticrender_answer"
POINTER, WORD = ir.IntType(8).as_pointer(), ir.IntType(32)
REQUEST = ir.LiteralStructType([POINTER.as_pointer(), POINTER, POINTER, POINTER])


class Late:
    """A kernel that others call by address; it returns nothing, so that nobody has to look into it."""

    def __init__(self, function: Any, part: Any, whole: Any) -> None:
        if "<locals>" in function.__qualname__:
            raise ValueError(f"late kernel {function.__qualname__!r}: must be found by its name in its module")
        self.__module__, self.__qualname__ = function.__module__, function.__qualname__
        self.__name__, self.__doc__ = function.__name__, function.__doc__
        self.part, self.whole = part, whole
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

    def __call__(self, *args: Any) -> None:
        """Call it from Python."""
        self.whole(*args)

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
            failed = builder.call(_asking(context, module), [cell, told])
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


def _asking(context: Any, module: Any) -> Any:
    """Return the function that has a cell filled by another thread and waits; true, and Python's error, if it failed.

    Nothing in it runs Python: a signal that came meanwhile would be heard in the middle of the samples.
    """
    known = module.globals.get(ASK)
    if known is not None:
        return known
    made = ir.Function(module, ir.FunctionType(ir.IntType(1), [POINTER.as_pointer(), POINTER]), ASK)
    made.linkage = "linkonce_odr"
    made.attributes.add("noinline")
    builder = ir.IRBuilder(made.append_basic_block())
    python, void, nothing = context.get_python_api(builder), ir.VoidType(), ir.Constant(POINTER, None)

    def call(name: str, returns: Any, *values: Any) -> Any:
        kind = ir.FunctionType(returns, [each.type for each in values])
        return builder.call(cgutils.get_or_insert_function(module, kind, name), values)

    request = cgutils.alloca_once(builder, REQUEST)
    thread = cgutils.alloca_once_value(builder, nothing)
    holds = builder.icmp_signed("!=", call("PyGILState_Check", WORD), WORD(0))
    with builder.if_then(holds):
        builder.store(python.save_thread(), thread)
    lock = call("PyThread_allocate_lock", POINTER)
    call("PyThread_acquire_lock", WORD, lock, WORD(1))
    for i, each in enumerate((*made.args, lock, nothing)):
        builder.store(each, cgutils.gep_inbounds(builder, request, 0, i))
    said = cgutils.gep_inbounds(builder, request, 0, 3)
    answer = cgutils.get_or_insert_function(module, ir.FunctionType(void, [POINTER]), ANSWER)
    started = call("PyThread_start_new_thread", WORD, answer, builder.bitcast(request, POINTER))
    with builder.if_else(builder.icmp_signed("!=", started, WORD(-1))) as (then, otherwise):
        with then:
            call("PyThread_acquire_lock", WORD, lock, WORD(1))  # until it is answered
        with otherwise:
            builder.store(context.insert_const_string(module, "a late kernel: no thread could be started"), said)
    call("PyThread_release_lock", void, lock)
    call("PyThread_free_lock", void, lock)
    with builder.if_then(holds):
        python.restore_thread(builder.load(thread))
    failed = cgutils.is_not_null(builder, builder.load(said))
    with cgutils.if_unlikely(builder, failed):
        state = python.gil_ensure()
        python.err_set_string("PyExc_RuntimeError", builder.load(said))
        python.gil_release(state)
    builder.ret(failed)
    return made


class _Request(ctypes.Structure):
    """What the waiting code tells the thread that answers: `REQUEST`."""

    _fields_ = (
        ("cell", ctypes.POINTER(ctypes.c_void_p)),
        ("text", ctypes.c_char_p),
        ("lock", ctypes.c_void_p),
        ("said", ctypes.c_char_p),
    )


_said: list[bytes] = []  # what went wrong; the code that waits keeps only where it stands
_answered = ctypes.pythonapi["PyThread_release_lock"]
_answered.argtypes, _answered.restype = (ctypes.c_void_p,), None


@ctypes.CFUNCTYPE(None, ctypes.POINTER(_Request))
def _answer(asked: Any) -> None:
    """Fill a cell, in a thread of its own, and let the code that waits go on."""
    request = asked.contents
    try:
        request.cell[0] = _address(_part(request.text))
    except BaseException as error:
        kernel, _ = wanted(request.text)
        _said.append(f"late kernel {kernel.__qualname__!r}: {type(error).__name__}: {error}".encode())
        request.said = _said[-1]
    finally:
        _answered(request.lock)


binding.add_symbol(ANSWER, ctypes.cast(_answer, ctypes.c_void_p).value)


def wanted(text: bytes) -> tuple[Late, Any]:
    """Kernel and types that a text tells."""
    kernel, args = pickle.loads(base64.b64decode(text))
    return kernel, args


def _part(text: bytes) -> Any:
    kernel, args = wanted(text)
    return kernel.compiled(args)


def _address(part: Any) -> int:
    return int(part.library.get_pointer_to_function(part.fndesc.llvm_func_name))


def cells(library: Any) -> Iterator[tuple[Any, bytes]]:
    """Cells of some code, and what belongs into each."""
    engine = library.codegen._engine._ee
    for each in (library._shared_module or library._final_module).global_variables:
        if each.name.startswith(CELL) and not each.name.endswith(TEXT):
            cell = ctypes.c_void_p.from_address(engine.get_global_value_address(each.name))
            yield cell, ctypes.string_at(engine.get_global_value_address(each.name + TEXT))


def complete(library: Any, known: frozenset[bytes] = frozenset()) -> None:
    """Compile all late parts of some code, and theirs."""
    for cell, text in cells(library):
        if text not in known:
            part = _part(text)
            cell.value = _address(part)
            complete(part.library, known | {text})
