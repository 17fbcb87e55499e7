"""Explicit vectors inside kernels: a value that holds as many neighbouring numbers as fit a register.

Such values read like arithmetic: ``+ - * /``, comparisons, `select`, `root`, `floor`, `low`, `high`, `size`, `any_of`,
`total`.  Everything takes plain floats as well, and a float meeting a vector is repeated in every lane, so that one
source serves lanes that are bands and lanes that are scenarios.  `total` sums what lanes of bands share; where the
scalars of a scenario are themselves lanes, there is nothing to sum.  They come from memory by `lanes_memory`.

Auto-vectorised loops reach C only for a few hundred bands; these files are the price of the rest (decision 7).
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic, models, register_model
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from hapticrender.protocols import Array

WIDTH = {np.dtype(np.float64): 8, np.dtype(np.float32): 16}  # lanes of a 512-bit register; narrower machines split it
ALIGNMENT = 64  # bytes
_CONTRACT = ("contract",)


def padded(count: int, dtype: Any = float) -> int:
    """Return how many rows of lanes hold `count` numbers."""
    return -(-count // WIDTH[np.dtype(dtype)])


def aligned(shape: tuple[int, ...], dtype: Any = float) -> Array:
    """Zeros on a cache line's boundary: unaligned vectors cost twice the time."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    room = np.zeros(size + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    return room[start : start + size].view(dtype).reshape(shape)


class LaneType(types.Type):
    """Numba's type of a vector of `width` numbers."""

    def __init__(self, dtype: Any, width: int) -> None:
        self.dtype, self.width = dtype, width
        super().__init__(f"lanes({dtype} x {width})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Take a plain number: it is repeated in every lane."""
        return Conversion.safe if isinstance(other, (types.Float, types.Integer)) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Let a variable that starts as a number become a vector."""
        return self if isinstance(other, (types.Float, types.Integer)) else None


class MaskType(types.Type):
    """Numba's type of a vector of `width` truths."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(f"mask({width})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Take a plain truth: it holds in every lane."""
        return Conversion.safe if isinstance(other, types.Boolean) else None


def number_type(dtype: Any) -> ir.Type:
    """LLVM's type of a number."""
    return ir.FloatType() if dtype == types.float32 else ir.DoubleType()


@register_model(LaneType)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: LaneType) -> None:
        super().__init__(manager, kind, ir.VectorType(number_type(kind.dtype), kind.width))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskType) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.width))


def _repeat(builder: Any, value: Any, width: int) -> Any:
    """Vector with `value` in every lane."""
    kind = ir.VectorType(value.type, width)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), order)


@lower_cast(types.Float, LaneType)
@lower_cast(types.Integer, LaneType)
def _cast_number(context: Any, builder: Any, fromty: Any, toty: LaneType, value: Any) -> Any:
    return _repeat(builder, context.cast(builder, value, fromty, toty.dtype), toty.width)


@lower_cast(types.Boolean, MaskType)
def _cast_truth(context: Any, builder: Any, fromty: Any, toty: MaskType, value: Any) -> Any:
    return _repeat(builder, context.cast(builder, value, fromty, types.boolean), toty.width)


def _lane_of(*kinds: Any) -> LaneType | None:
    """The vector type among the types of some operands, if the others are numbers."""
    found = next((kind for kind in kinds if isinstance(kind, LaneType)), None)
    fits = all(kind == found or isinstance(kind, (types.Float, types.Integer)) for kind in kinds)
    return found if found is not None and fits else None


def _register(function: Any, build: Any, answers: Any = lambda lane: lane, operands: int = 2) -> None:
    """Give `function` a meaning for vectors: `build` makes the instruction, `answers` the type of its result."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            lane = _lane_of(*args)
            return signature(answers(lane), *[lane] * operands) if lane and len(args) == operands else None

    infer_global(function)(Template)
    lower_builtin(function, *[LaneType] * operands)(lambda context, builder, sig, args: build(builder, *args))


for _operator, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _each in _operator:
        _register(_each, lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=_CONTRACT))
_register(operator.neg, lambda builder, a: builder.fneg(a), operands=1)
for _each, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _register(
        _each,
        lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b),
        answers=lambda lane: MaskType(lane.width),
    )


def _register_mask(function: Any, name: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            mask = next((kind for kind in args if isinstance(kind, MaskType)), None)
            same = mask is not None and all(kind == mask or isinstance(kind, types.Boolean) for kind in args)
            return signature(mask, mask, mask) if same and len(args) == 2 else None

    infer_global(function)(Template)
    lower_builtin(function, MaskType, MaskType)(lambda context, builder, sig, args: getattr(builder, name)(*args))


_register_mask(operator.and_, "and_")
_register_mask(operator.or_, "or_")


def _numbers(*kinds: Any) -> bool:
    return all(isinstance(kind, (types.Float, types.Integer)) for kind in kinds)


def _common(kinds: Any) -> Any:
    """Type of the result of an elementwise function: the vector's, or the widest float's."""
    lane = _lane_of(*kinds)
    if lane is not None:
        return lane
    if not _numbers(*kinds):
        return None
    floats = [kind for kind in kinds if isinstance(kind, types.Float)]
    return max(floats, key=lambda kind: kind.bitwidth) if floats else types.float64


def _elementwise(build: Any) -> Any:
    """Make the typed and lowered function of `build(builder, *values)`, for floats and vectors alike."""

    def typed(typingctx: Any, *kinds: Any) -> Any:
        kind = _common(kinds)
        if kind is None:
            return None
        return kind(*[kind] * len(kinds)), lambda context, builder, sig, args: build(builder, *args)

    return typed


def _call(builder: Any, name: str, *values: Any) -> Any:
    """Call LLVM's own function `name` on values of one type."""
    kind = values[0].type
    wide = isinstance(kind, ir.VectorType)
    element = "f64" if (kind.element if wide else kind) == ir.DoubleType() else "f32"
    named = f"{name}.v{kind.count}{element}" if wide else f"{name}.{element}"
    function = builder.module.declare_intrinsic(named, (), ir.FunctionType(kind, [kind] * len(values)))
    return builder.call(function, values, fastmath=_CONTRACT)


@intrinsic
def root(typingctx: Any, a: Any) -> Any:
    """Square root."""
    return _elementwise(lambda builder, a: _call(builder, "llvm.sqrt", a))(typingctx, a)


@intrinsic
def floor(typingctx: Any, a: Any) -> Any:
    """Largest whole number not above a, as a float."""
    return _elementwise(lambda builder, a: _call(builder, "llvm.floor", a))(typingctx, a)


@intrinsic
def fraction(typingctx: Any, a: Any) -> Any:
    """What is left of a after taking away its nearest whole number, halves to even: within 1/2 of zero."""
    kind = _common((a,))
    if kind is None:
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if _has_avx512(context, kind):
            return _avx512(builder, "reduce", 8, *args)
        return builder.fsub(args[0], _call(builder, "llvm.rint", args[0]))

    return kind(kind), build


@intrinsic
def by_size(typingctx: Any, a: Any, b: Any) -> Any:
    """Magnitudes of two, the larger one first."""
    kind = _common((a, b))
    if kind is None:
        return None

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if _has_avx512(context, kind):
            ordered = [_avx512(builder, "range", 11, *args), _avx512(builder, "range", 10, *args)]
        else:
            one, other = (_call(builder, "llvm.fabs", value) for value in args)
            more = builder.fcmp_ordered(">", one, other)
            ordered = [builder.select(more, one, other), builder.select(more, other, one)]
        return context.make_tuple(builder, sig.return_type, ordered)

    return types.UniTuple(kind, 2)(kind, kind), build


def _has_avx512(context: Any, kind: Any) -> bool:
    """Whether AVX-512 can work on these vectors; its instructions do in one what LLVM needs three for."""
    return isinstance(kind, LaneType) and "+avx512dq" in context.codegen().magic_tuple()[2].split(",")


def _avx512(builder: Any, name: str, immediate: int, *values: Any) -> Any:
    """Call the AVX-512 instruction `name` with its immediate operand, for all lanes, rounding as it is set."""
    kind, mask, number = values[0].type, ir.IntType(values[0].type.count), ir.IntType(32)
    named = f"llvm.x86.avx512.mask.{name}.{'pd' if kind.element == ir.DoubleType() else 'ps'}.512"
    taken = [kind] * len(values) + [number, kind, mask, number]
    function = builder.module.declare_intrinsic(named, (), ir.FunctionType(kind, taken))
    rest = [number(immediate), ir.Constant(kind, ir.Undefined), mask(-1), number(4)]
    return builder.call(function, [*values, *rest])


@intrinsic
def size(typingctx: Any, a: Any) -> Any:
    """Magnitude."""
    return _elementwise(lambda builder, a: _call(builder, "llvm.fabs", a))(typingctx, a)


@intrinsic
def signed(typingctx: Any, a: Any, b: Any) -> Any:
    """Magnitude of a with the sign of b."""
    return _elementwise(lambda builder, a, b: _call(builder, "llvm.copysign", a, b))(typingctx, a, b)


@intrinsic
def low(typingctx: Any, a: Any, b: Any) -> Any:
    """Smaller of two; b where a is not a number."""
    return _elementwise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))(typingctx, a, b)


@intrinsic
def high(typingctx: Any, a: Any, b: Any) -> Any:
    """Larger of two; b where a is not a number."""
    return _elementwise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))(typingctx, a, b)


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Take a where the mask is true and b elsewhere; both are computed."""
    if isinstance(mask, MaskType):
        lane = _lane_of(a, b)
        if lane is None and _numbers(a, b):
            lane = LaneType(types.float64 if mask.width == 8 else types.float32, mask.width)
    else:
        lane = _common((a, b))
    if lane is None or not isinstance(mask, (MaskType, types.Boolean)):
        return None
    return lane(mask, lane, lane), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def any_of(typingctx: Any, mask: Any) -> Any:
    """Whether any lane is true."""
    if isinstance(mask, types.Boolean):
        return types.boolean(mask), lambda context, builder, sig, args: args[0]

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = ir.IntType(mask.width)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], whole), whole(0))

    return (types.boolean(mask), build) if isinstance(mask, MaskType) else None


@intrinsic
def total(typingctx: Any, like: Any, a: Any) -> Any:
    """Sum of the lanes where `like`, a quantity that they share, is a plain number; a itself where it has lanes."""
    if isinstance(like, LaneType) or not isinstance(a, LaneType):
        return a(like, a), lambda context, builder, sig, args: args[1]

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = args[1]
        while value.type.count > 1:
            value = _folded(builder, value)
        return builder.extract_element(value, ir.IntType(32)(0))

    return a.dtype(like, a), build


@intrinsic
def totals(typingctx: Any, like: Any, a: Any, b: Any) -> Any:
    """Both `total(like, a)` and `total(like, b)`, in half the instructions."""
    if isinstance(like, LaneType) or not isinstance(a, LaneType) or a != b:
        return types.UniTuple(a, 2)(like, a, b), lambda context, builder, sig, args: context.make_tuple(
            builder, sig.return_type, args[1:]
        )

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first, second = args[1:]
        half, index = a.width // 2, ir.VectorType(ir.IntType(32), a.width)
        straight = [i + (a.width if i & 1 else 0) for i in range(a.width)]  # costs less than what moves lanes
        value = builder.fadd(
            builder.shuffle_vector(first, second, ir.Constant(index, straight)),
            builder.shuffle_vector(first, second, ir.Constant(index, [i ^ 1 for i in straight])),
        )  # first, second, first, second ...
        while half > 1:
            value, half = _folded(builder, value), half // 2
        sums = [builder.extract_element(value, ir.IntType(32)(i)) for i in range(2)]
        return context.make_tuple(builder, sig.return_type, sums)

    return types.UniTuple(a.dtype, 2)(like, a, b), build


def _folded(builder: Any, value: Any) -> Any:
    """Sum of the lower and the upper half of a vector."""
    half = value.type.count // 2
    order = ir.VectorType(ir.IntType(32), half)
    lower = builder.shuffle_vector(value, value, ir.Constant(order, list(range(half))))
    upper = builder.shuffle_vector(value, value, ir.Constant(order, list(range(half, 2 * half))))
    return builder.fadd(lower, upper)
