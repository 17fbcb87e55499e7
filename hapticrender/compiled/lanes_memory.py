"""Reading and writing of explicit vectors (`hapticrender.compiled.lanes`) in arrays.

`lanes(array, i, j)` reads the row ``array[i, j, :]`` of a C-contiguous array whose last axis is as long as a register
(`WIDTH`) and `put(array, i, j, value)` writes one; `read` and `write` do it for a scenario's own numbers, which are
plain or lanes; a `stretch` starts anywhere, a `column` goes down the rows of a plain array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

from hapticrender.compiled.lanes import WIDTH, LaneType, number_type
from hapticrender.compiled.lowering import data_of, flat, length_of
from hapticrender.compiled.records import kept_apart


def _address(builder: Any, kind: Any, array: Any, *where: Any) -> Any:
    """Pointer to a row of lanes: array[where], each where counted in rows of the last axis but one."""
    width = WIDTH[np.dtype(str(kind.dtype))]
    vector = ir.VectorType(number_type(kind.dtype), width)
    rows = builder.bitcast(data_of(builder, array), vector.as_pointer())
    return builder.gep(rows, [flat(builder, array, where)])


def _load(builder: Any, kind: Any, array: Any, where: Any, count: int) -> Any:
    """Value at `where`: a row of lanes or a number."""
    if _is_rows(kind, count):
        value = builder.load(_address(builder, kind, array, *where), align=_wide(kind))
    else:
        value = builder.load(_number(builder, kind, array, *where))
    kept_apart(builder, value, "tile" if kind.ndim == 3 and _is_rows(kind, count) else "own")
    return value


def _store(builder: Any, kind: Any, array: Any, where: Any, count: int, value: Any) -> Any:
    """Write a row of lanes or a number at `where`."""
    if _is_rows(kind, count):
        access = builder.store(value, _address(builder, kind, array, *where), align=_wide(kind))
    else:
        access = builder.store(value, _number(builder, kind, array, *where))
    kept_apart(builder, access, "tile" if kind.ndim == 3 and _is_rows(kind, count) else "own")
    return access


def _is_rows(kind: Any, indices: int) -> bool:
    floats = (types.float64, types.float32)
    return isinstance(kind, types.Array) and kind.layout == "C" and kind.ndim == indices + 1 and kind.dtype in floats


def _lane(kind: Any) -> LaneType:
    return LaneType(kind.dtype, WIDTH[np.dtype(str(kind.dtype))])


def _wide(kind: Any) -> int:
    return WIDTH[np.dtype(str(kind.dtype))] * (4 if kind.dtype == types.float32 else 8)


@intrinsic
def lanes(typingctx: Any, array: Any, i: Any, j: Any) -> Any:
    """Row array[i, j, :]."""
    if not _is_rows(array, 2):
        return None
    return _lane(array)(array, types.intp, types.intp), lambda context, builder, sig, args: _load(
        builder, sig.args[0], args[0], args[1:], 2
    )


@intrinsic
def put(typingctx: Any, array: Any, i: Any, j: Any, value: Any) -> Any:
    """Write a row: array[i, j, :] = value."""
    if not _is_rows(array, 2):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _store(builder, sig.args[0], args[0], args[1:3], 2, args[3])
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, _lane(array)), build


@intrinsic
def stretch(typingctx: Any, array: Any, i: Any, j: Any) -> Any:
    """Read as many neighbours as there are lanes, array[i, j:], wherever they start; their columns have to exist."""
    if not _is_numbers(array, 2) or array.dtype not in (types.float64, types.float32):
        return None
    kind = _lane(array)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = _number(builder, sig.args[0], *args)
        vector = ir.VectorType(number_type(kind.dtype), kind.width)
        return builder.load(builder.bitcast(at, vector.as_pointer()), align=kind.dtype.bitwidth // 8)

    return kind(array, types.intp, types.intp), build


@intrinsic
def taken(typingctx: Any, array: Any, i: Any, j: Any, like: Any) -> Any:
    """Read as many neighbours as `like` has lanes from a plain array of any precision, in the precision of `like`."""
    if not _is_numbers(array, 2) or not isinstance(like, LaneType):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = _number(builder, sig.args[0], *args[:3])
        vector = ir.VectorType(number_type(array.dtype), like.width)
        value = builder.load(builder.bitcast(at, vector.as_pointer()), align=array.dtype.bitwidth // 8)
        return _converted(builder, value, number_type(like.dtype))

    return like(array, types.intp, types.intp, like), build


@intrinsic
def put_stretch(typingctx: Any, array: Any, i: Any, j: Any, value: Any) -> Any:
    """Write as many neighbours as there are lanes, array[i, j:], wherever they start; their columns have to exist."""
    if not _is_numbers(array, 2) or array.dtype not in (types.float64, types.float32):
        return None
    kind = value if isinstance(value, LaneType) else _lane(array)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = _number(builder, sig.args[0], *args[:3])
        given = _converted(builder, args[3], number_type(array.dtype))
        builder.store(given, builder.bitcast(at, given.type.as_pointer()), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, kind), build


@intrinsic
def column(typingctx: Any, array: Any, i: Any, j: Any) -> Any:
    """Read as many neighbours as there are lanes down a column, array[i:, j]; past the last row, that one again."""
    if not _is_numbers(array, 2) or array.dtype not in (types.float64, types.float32):
        return None
    kind = _lane(array)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = ir.Constant(ir.VectorType(number_type(kind.dtype), kind.width), ir.Undefined)
        for lane, at in enumerate(_down(builder, sig.args[0], kind.width, *args)):
            value = builder.insert_element(value, builder.load(at), ir.IntType(32)(lane))
        return value

    return kind(array, types.intp, types.intp), build


@intrinsic
def put_column(typingctx: Any, array: Any, i: Any, j: Any, value: Any) -> Any:
    """Write as many neighbours as there are lanes, or rows, down a column, array[i:, j]."""
    if not _is_numbers(array, 2) or array.dtype not in (types.float64, types.float32):
        return None
    kind = _lane(array)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = _down(builder, sig.args[0], kind.width, *args[:3])
        for lane in reversed(range(kind.width)):  # the last row's own comes after those that are past it
            builder.store(builder.extract_element(args[3], ir.IntType(32)(lane)), rows[lane])
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, kind), build


def _down(builder: Any, kind: Any, count: int, array: Any, i: Any, j: Any) -> list[Any]:
    """Pointers to array[i, j], array[i + 1, j] ...; past the last row, to that one again."""
    last = builder.sub(length_of(builder, array, 0), ir.IntType(64)(1))
    rows = [builder.add(i, ir.IntType(64)(k)) for k in range(count)]
    rows = [builder.select(builder.icmp_signed("<", row, last), row, last) for row in rows]
    return [_number(builder, kind, array, row, j) for row in rows]


@intrinsic
def put_pairs(typingctx: Any, array: Any, i: Any, re: Any, im: Any) -> Any:
    """Write W complex numbers from array[i * W] on, as many as there is room for.

    Scenarios side by side are not asked for theirs: nothing is written where the array has three axes.
    """
    if not (isinstance(array, types.Array) and isinstance(re, LaneType) and re == im):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind, (where, index, first, second), width = sig.args[0], args, re.width
        if kind.ndim == 3:
            return context.get_dummy_value()
        data = data_of(builder, where)
        element = number_type(kind.dtype.underlying_float)
        first, second = (_converted(builder, value, element) for value in (first, second))
        start = builder.mul(index, ir.IntType(64)(width))
        room = builder.sub(length_of(builder, where, 0), start)
        numbers = builder.gep(builder.bitcast(data, element.as_pointer()), [builder.shl(start, ir.IntType(64)(1))])
        with builder.if_else(builder.icmp_signed(">=", room, ir.IntType(64)(width))) as (whole, part):
            with whole:
                order = [lane for i in range(width) for lane in (i, width + i)]
                mixed = builder.shuffle_vector(
                    first, second, ir.Constant(ir.VectorType(ir.IntType(32), 2 * width), order)
                )
                builder.store(mixed, builder.bitcast(numbers, mixed.type.as_pointer()), align=8)
            with part:
                for lane in range(width):
                    with builder.if_then(builder.icmp_signed(">", room, ir.IntType(64)(lane))):
                        for j, value in enumerate((first, second)):
                            at = builder.gep(numbers, [ir.IntType(64)(2 * lane + j)])
                            builder.store(builder.extract_element(value, ir.IntType(32)(lane)), at)
        return context.get_dummy_value()

    return types.none(array, types.intp, re, im), build


def _converted(builder: Any, value: Any, element: Any) -> Any:
    """Vector of another float type."""
    kind = ir.VectorType(element, value.type.count)
    if kind == value.type:
        return value
    return builder.fpext(value, kind) if element == ir.DoubleType() else builder.fptrunc(value, kind)


@intrinsic
def row_totals(typingctx: Any, array: Any, i: Any, j: Any) -> Any:
    """Sums of the rows array[i, j], array[i, j + 1] ... side by side, as many rows as there are lanes."""
    if not _is_rows(array, 2):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        width, index = sig.return_type.width, ir.VectorType(ir.IntType(32), sig.return_type.width)
        rows = [
            _load(builder, sig.args[0], args[0], (args[1], builder.add(args[2], ir.IntType(64)(k))), 2)
            for k in range(width)
        ]
        block = 1
        while len(rows) > 1:  # of two vectors the lanes that belong to the same row, added pair by pair
            straight = [at + (width if at & block else 0) for at in range(width)]  # costs less than what moves lanes
            crossed = [at ^ block for at in straight]
            rows = [
                builder.fadd(
                    builder.shuffle_vector(first, second, ir.Constant(index, straight)),
                    builder.shuffle_vector(first, second, ir.Constant(index, crossed)),
                )
                for first, second in zip(rows[::2], rows[1::2], strict=True)
            ]
            block *= 2
        return rows[0]

    return _lane(array)(array, types.intp, types.intp), build


@intrinsic
def read(typingctx: Any, array: Any, *index: Any) -> Any:
    """Take a scenario's own number array[i, ...], or the row array[i, ..., :] where every lane is a scenario."""
    count = _count(index)
    if not _is_rows(array, count) and not _is_numbers(array, count):
        return None
    kind = _lane(array) if _is_rows(array, count) else array.dtype
    return kind(array, types.StarArgTuple.from_types([types.intp] * count)), lambda context, builder, sig, args: _load(
        builder, sig.args[0], args[0], cgutils.unpack_tuple(builder, args[1]), count
    )


@intrinsic
def write(typingctx: Any, value: Any, array: Any, *index: Any) -> Any:
    """Write a scenario's own number array[i, ...], or the row array[i, ..., :] where every lane is a scenario."""
    return _written(array, index, soon=True)


@intrinsic
def record(typingctx: Any, value: Any, array: Any, *index: Any) -> Any:
    """`write` what is not read soon: a row of lanes goes past the caches, and leaves in them what is."""
    return _written(array, index, soon=False)


def _written(array: Any, index: Any, *, soon: bool) -> Any:
    count = _count(index)
    rows = _is_rows(array, count)
    if not rows and not _is_numbers(array, count):
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        access = _store(builder, sig.args[1], args[1], cgutils.unpack_tuple(builder, args[2]), count, args[0])
        if rows and not soon:
            _past_caches(builder, access)
        return context.get_dummy_value()

    kind = _lane(array) if rows else array.dtype
    return types.none(kind, array, types.StarArgTuple.from_types([types.intp] * count)), build


@intrinsic
def record_whole(typingctx: Any, value: Any, array: Any, i: Any) -> Any:
    """`record` whole numbers in a row array[i, :] of an array of 64-bit integers."""
    whole = isinstance(array, types.Array) and array.dtype == types.int64 and array.layout == "C" and array.ndim == 2
    if not whole or not isinstance(value, LaneType) or value.dtype != types.float64:
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.IntType(64), value.width)
        data = data_of(builder, args[1])
        at = builder.gep(builder.bitcast(data, vector.as_pointer()), [args[2]])
        _past_caches(builder, builder.store(builder.fptosi(args[0], vector), at, align=_wide(value)))
        return context.get_dummy_value()

    return types.none(value, array, types.intp), build


def _past_caches(builder: Any, access: Any) -> None:
    """Tell a store that what it writes is not read soon."""
    access.set_metadata("nontemporal", builder.module.add_metadata([ir.IntType(32)(1)]))


def _count(index: Any) -> int:
    """How many indices were given: numba hands them over one by one, or as one tuple."""
    return len(index[0]) if len(index) == 1 and isinstance(index[0], types.BaseTuple) else len(index)


def _is_numbers(kind: Any, indices: int) -> bool:
    return isinstance(kind, types.Array) and kind.layout == "C" and kind.ndim == indices


def _number(builder: Any, kind: Any, array: Any, *where: Any) -> Any:
    """Pointer to one number of an array."""
    return builder.gep(data_of(builder, array), [flat(builder, array, where)])
