"""Named tuples inside kernels, handed over by address.

Numba takes a named tuple apart into its numbers at every call and puts it together again on the other side.  With
hundreds of numbers that is most of what there is to compile, so kernels get a record: the address of the numbers, of
which a field is read where it is named.
"""

from __future__ import annotations

import hashlib
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import NativeValue, lower_getattr_generic, models, register_model, unbox


class RecordType(types.NamedTuple):
    """Numba's type of a named tuple that is known by its address; those inside of it lie in the same memory."""

    def __init__(self, plain: Any) -> None:
        super().__init__([as_record(each) for each in plain], plain.instance_class)
        own = plain.instance_class
        said = f"{own.__module__} {own.__qualname__} {own._fields} {self.name}"  # numba's name knows the types only
        self.name = f"{own.__name__}.{hashlib.sha256(said.encode()).hexdigest()[:16]}"

    @property
    def key(self) -> str:
        """What tells it from others: its name, which is quick to compare."""
        return self.name


def as_record(kind: Any) -> Any:
    """Type of a kernel's argument: a record for a named tuple, else as it is."""
    return RecordType(kind) if isinstance(kind, types.BaseNamedTuple) else kind


class Layout(ir.LiteralStructType):
    """How a record lies in memory."""


def _memory(context: Any, kind: RecordType) -> Layout:
    """Layout of a record, with those inside of it."""
    return Layout(
        [
            _memory(context, each) if isinstance(each, RecordType) else context[each].get_value_type()
            for each in kind.types
        ]
    )


@register_model(RecordType)
class _RecordModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: RecordType) -> None:
        super().__init__(manager, kind, _memory(manager, kind).as_pointer())


def kept_apart(builder: Any, access: Any, kind: str) -> None:
    """Tell LLVM that memory of one kind (tiles, a scenario's own numbers, records) is never that of another."""
    module = builder.module
    base = module.add_metadata(
        [ir.MetaDataString(module, kind), module.add_metadata([ir.MetaDataString(module, "lanes")])]
    )
    access.set_metadata("tbaa", module.add_metadata([base, base, ir.IntType(64)(0)]))


@lower_getattr_generic(RecordType)
def _field(context: Any, builder: Any, kind: RecordType, value: Any, name: str) -> Any:
    """Field of a record: its number or array, or the address of a record inside."""
    index = kind.fields.index(name)
    at = cgutils.gep_inbounds(builder, value, 0, index)
    if isinstance(kind[index], RecordType):
        return at
    found = builder.load(at)
    kept_apart(builder, found, "record")
    return found


@unbox(RecordType)
def _unboxed(kind: RecordType, source: Any, c: Any) -> NativeValue:
    """Copy a named tuple of Python into memory of the wrapper."""
    record = cgutils.alloca_once(c.builder, _memory(c.context.data_model_manager, kind))
    wrong = cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    _fill(kind, source, record, wrong, c)
    with c.builder.if_then(cgutils.is_not_null(c.builder, c.pyapi.err_occurred()), likely=False):
        c.builder.store(cgutils.true_bit, wrong)
    return NativeValue(record, is_error=c.builder.load(wrong))


def _fill(kind: RecordType, source: Any, record: Any, wrong: Any, c: Any) -> None:
    """Copy field by field; a number that is none is noticed once, at the end."""
    for i, each in enumerate(kind.types):
        found, at = c.pyapi.tuple_getitem(source, i), cgutils.gep_inbounds(c.builder, record, 0, i)
        if isinstance(each, RecordType):
            _fill(each, found, at, wrong, c)
        elif each == types.float64:
            c.builder.store(c.pyapi.float_as_double(found), at)
        else:
            native = c.unbox(each, found)
            with c.builder.if_then(native.is_error, likely=False):
                c.builder.store(cgutils.true_bit, wrong)
            c.builder.store(native.value, at)
