"""What compiled threads share: values behind a pointer, and slots of numbers that change hands without a lock.

Three slots, one writer and one reader: the writer fills its own slot and swaps it for the one in the middle, the
reader swaps its own for that where it is fresh.  Both swaps are atomic, neither side ever waits or repeats, and a slot
is never read while it is written: a double buffer with one slot more, so that a writer may write twice between two
reads.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from hapticrender.compiled.records import RecordType

SLOTS = 3
FRESH = 4  # bit beside the number of the slot in the middle: the reader has not had it


@intrinsic
def swap(typingctx: Any, array: Any, value: Any) -> Any:
    """Put `value` into the first element of an int64 array and return what was there, in one indivisible step.

    What either thread wrote before is seen by the other after it.
    """
    if not isinstance(array, types.Array) or array.dtype != types.int64:
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("xchg", data, args[1], "acq_rel")

    return types.int64(array, types.int64), build


@intrinsic
def behind(typingctx: Any, pointer: Any) -> Any:
    """The record that a pointer points to."""
    if not (isinstance(pointer, types.CPointer) and isinstance(pointer.dtype, RecordType)):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(sig.return_type))

    return pointer.dtype(pointer), build


@intrinsic
def empty(typingctx: Any, pointer: Any) -> Any:
    """Whether a pointer is null."""
    if not isinstance(pointer, types.CPointer):
        return None
    return types.boolean(pointer), lambda context, builder, sig, args: cgutils.is_null(builder, args[0])


@intrinsic
def place(typingctx: Any, address: Any, value: Any) -> Any:
    """Copy a record to where `behind` will find it."""
    if not isinstance(value, RecordType):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(builder.load(args[1]), builder.inttoptr(args[0], args[1].type))
        return context.get_dummy_value()

    return types.void(types.uintp, value), build


@intrinsic
def bytes_of(typingctx: Any, value: Any) -> Any:
    """Bytes that `place` needs for a record."""
    if not isinstance(value, RecordType):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        size = context.get_abi_sizeof(args[0].type.pointee)
        return ir.Constant(cgutils.intp_t, size)

    return types.intp(value), build
