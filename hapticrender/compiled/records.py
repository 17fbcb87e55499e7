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
    kinds, done = list(kind.types), 0
    for i, each in enumerate(kinds):
        if i < done:
            continue
        at = cgutils.gep_inbounds(c.builder, record, 0, i)
        if each == types.float64:
            done = next((j for j in range(i, len(kinds)) if kinds[j] != each), len(kinds))
            _take_numbers(c, source, i, done - i, at)
        elif isinstance(each, types.Array):
            _take_array(c, source, i, at)
        elif isinstance(each, RecordType):
            _fill(each, c.pyapi.tuple_getitem(source, i), at, wrong, c)
        elif isinstance(each, types.UniTuple) and each.dtype == types.float64:
            _take_numbers(c, c.pyapi.tuple_getitem(source, i), 0, each.count, cgutils.gep_inbounds(c.builder, at, 0, 0))
        else:
            native = c.unbox(each, c.pyapi.tuple_getitem(source, i))
            with c.builder.if_then(native.is_error, likely=False):
                c.builder.store(cgutils.true_bit, wrong)
            c.builder.store(native.value, at)


def _helper(c: Any, name: str, taken: list[Any], write: Any) -> Any:
    """Function of the wrapper's module, written once: in line it would be most of what there is to compile."""
    module, python = c.builder.module, c.pyapi
    found = module.globals.get(name)
    if found is None:
        kind = ir.FunctionType(python.pyobj, [python.pyobj, python.py_ssize_t])
        item = cgutils.get_or_insert_function(module, kind, "PyTuple_GetItem")
        found = ir.Function(module, ir.FunctionType(ir.VoidType(), taken), name)
        found.linkage = "internal"
        found.attributes.add("noinline")
        builder = ir.IRBuilder(found.append_basic_block())
        write(builder, c.context.get_python_api(builder), lambda *at: builder.call(item, at), *found.args)
        builder.ret_void()
    return found


def _take_numbers(c: Any, source: Any, first: int, count: int, at: Any) -> None:
    """Copy some floats of a tuple."""

    def write(builder: Any, python: Any, item: Any, items: Any, start: Any, stop: Any, to: Any) -> None:
        with cgutils.for_range_slice(builder, start, stop, start.type(1)) as (i, _):
            builder.store(python.float_as_double(item(items, i)), builder.gep(to, [builder.sub(i, start)]))

    size = c.pyapi.py_ssize_t
    take = _helper(c, "take_numbers", [c.pyapi.pyobj, size, size, ir.DoubleType().as_pointer()], write)
    c.builder.call(take, [source, size(first), size(first + count), at])


def _take_array(c: Any, source: Any, index: int, at: Any) -> None:
    """Copy where an array of a tuple lies, and how."""

    def write(builder: Any, python: Any, item: Any, items: Any, i: Any, to: Any) -> None:
        failed = python.numba_array_adaptor(item(items, i), to)
        with cgutils.if_unlikely(builder, cgutils.is_not_null(builder, failed)):
            python.err_set_string("PyExc_TypeError", "a field of a named tuple is no array any more")

    size = c.pyapi.py_ssize_t
    take = _helper(c, "take_array", [c.pyapi.pyobj, size, c.pyapi.voidptr], write)
    c.builder.call(take, [source, size(index), c.builder.bitcast(at, c.pyapi.voidptr)])
