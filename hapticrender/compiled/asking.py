"""Code that waits for Python without running it: a thread of Python's does what is asked for and lets it go on.

Python hears a signal at the first instruction that it gets to run.  Asked in the thread that plays samples, it would
hear one in their middle; asked in another, it hears it when they are played.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba.core import cgutils

ASK, ANSWER = "hapticrender.ask", "hapticrender_answer"  # names in the code
POINTER, WORD = ir.IntType(8).as_pointer(), ir.IntType(32)
REQUEST = ir.LiteralStructType([POINTER.as_pointer(), POINTER, POINTER, POINTER])


def asking(context: Any, module: Any) -> Any:
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
            builder.store(context.insert_const_string(module, "no thread could be started"), said)
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


_find: list[Callable[[bytes], int]] = []
_said: list[bytes] = []  # what went wrong; the code that waits keeps only where it stands
_answered = ctypes.pythonapi["PyThread_release_lock"]
_answered.argtypes, _answered.restype = (ctypes.c_void_p,), None


@ctypes.CFUNCTYPE(None, ctypes.POINTER(_Request))
def _answer(asked: Any) -> None:
    """Fill a cell, in a thread of its own, and let the code that waits go on."""
    request = asked.contents
    try:
        request.cell[0] = _find[-1](request.text)
    except BaseException as error:
        _said.append(f"{type(error).__name__}: {error}".encode())
        request.said = _said[-1]
    finally:
        _answered(request.lock)


binding.add_symbol(ANSWER, ctypes.cast(_answer, ctypes.c_void_p).value)


def answer_by(find: Callable[[bytes], int]) -> None:
    """Let `find` tell the address that a text asks for; what it raises is a RuntimeError of the code that waits."""
    _find.append(find)
