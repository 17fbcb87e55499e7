"""Vectors of eight bands for kernels: `get` and `put` fields of a tile, arithmetic with operators, no loop over bands.

A *tile* is a record whose fields hold a number for each of W = 8 bands.  ``get(b, "omega")`` loads one as a real
vector, ``get(b, "e0")`` as a complex one where the record has the fields ``e0_re`` and ``e0_im``.  Vectors take + - * /
with vectors and scalars, comparisons (which make masks for `where`), and the functions below.  Built on numba's
extension interface only; LLVM chooses the registers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import (
    intrinsic,
    lower_builtin,
    make_attribute_wrapper,
    models,
    register_model,
    type_callable,
)

from hapticrender.jit import kernel
from hapticrender.mathx import ATAN, CHORD, COS, EIGHTH, LEAST, SIN, TURN

W = 8  # bands a vector
DOUBLE, INDEX = ir.DoubleType(), ir.IntType(32)
LANES, MASK_LANES = ir.VectorType(DOUBLE, W), ir.VectorType(ir.IntType(1), W)
FIRST = ir.Constant(ir.VectorType(INDEX, W), [0] * W)


class RealVector(types.Type):
    """A number for each of W bands."""

    def __init__(self) -> None:
        super().__init__("real vector")


class ComplexVector(types.Type):
    """A complex number for each of W bands."""

    def __init__(self) -> None:
        super().__init__("complex vector")


class MaskVector(types.Type):
    """A truth value for each of W bands."""

    def __init__(self) -> None:
        super().__init__("mask vector")


REAL, COMPLEX, MASK = RealVector(), ComplexVector(), MaskVector()


@register_model(RealVector)
class RealModel(models.PrimitiveModel):
    """LLVM's vector of doubles."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, LANES)


@register_model(MaskVector)
class MaskModel(models.PrimitiveModel):
    """LLVM's vector of bits."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, MASK_LANES)


@register_model(ComplexVector)
class ComplexModel(models.StructModel):
    """Real and imaginary parts."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, [("real", REAL), ("imag", REAL)])


make_attribute_wrapper(ComplexVector, "real", "real")
make_attribute_wrapper(ComplexVector, "imag", "imag")


def _broadcast(builder: Any, value: Any) -> Any:
    """Vector of W times the same number."""
    one = builder.insert_element(ir.Constant(LANES, ir.Undefined), value, ir.Constant(INDEX, 0))
    return builder.shuffle_vector(one, ir.Constant(LANES, ir.Undefined), FIRST)


def _parts(context: Any, builder: Any, kind: Any, value: Any) -> tuple[Any, Any]:
    """Real and imaginary vector of a scalar or vector; the imaginary one is None where there is none."""
    if kind == COMPLEX:
        return builder.extract_value(value, 0), builder.extract_value(value, 1)
    if kind == REAL:
        return value, None
    return _broadcast(builder, context.cast(builder, value, kind, types.float64)), None


def _pair(builder: Any, real: Any, imag: Any) -> Any:
    """Complex vector of its parts."""
    pair = ir.Constant(ir.LiteralStructType([LANES, LANES]), ir.Undefined)
    return builder.insert_value(builder.insert_value(pair, real, 0), imag, 1)


def _sum(name: str) -> Callable[..., Any]:
    def parts(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
        act = getattr(builder, name)
        zero = ir.Constant(LANES, [ir.Constant(DOUBLE, 0.0)] * W)
        imag = None if b is None and y is None else b if y is None else act(zero if b is None else b, y)
        return act(a, x), imag

    return parts


def _product(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
    real = builder.fmul(a, x)
    if b is None:
        return real, None if y is None else builder.fmul(a, y)
    if y is None:
        return real, builder.fmul(b, x)
    return builder.fsub(real, builder.fmul(b, y)), builder.fadd(builder.fmul(a, y), builder.fmul(b, x))


def _quotient(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
    if y is not None:
        raise TypeError("a vector is divided by a complex one")
    return builder.fdiv(a, x), None if b is None else builder.fdiv(b, x)


KINDS = (RealVector, ComplexVector, types.Float, types.Integer)


def _arithmetic(function: Any, combine: Callable[..., Any]) -> None:
    """Give an operator its types and code for every pair of kinds of which one is a vector."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        def result(a: Any, b: Any) -> Any:
            if a == COMPLEX or b == COMPLEX:
                return COMPLEX
            return REAL if REAL in (a, b) else None

        return result

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        (a, b), (x, y) = (_parts(context, builder, *each) for each in zip(signature.args, values, strict=True))
        real, imag = combine(builder, a, b, x, y)
        return real if imag is None else _pair(builder, real, imag)

    for one in KINDS:
        for other in KINDS:
            if one in KINDS[:2] or other in KINDS[:2]:
                lower_builtin(function, one, other)(build)


_arithmetic(operator.add, _sum("fadd"))
_arithmetic(operator.sub, _sum("fsub"))
_arithmetic(operator.mul, _product)
_arithmetic(operator.truediv, _quotient)
_arithmetic(operator.iadd, _sum("fadd"))
_arithmetic(operator.isub, _sum("fsub"))


def _comparison(function: Any, sign: str) -> None:
    """Give a comparison of real vectors (and scalars) its type and code."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        def result(a: Any, b: Any) -> Any:
            return MASK if REAL in (a, b) else None

        return result

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = (_parts(context, builder, *each)[0] for each in zip(signature.args, values, strict=True))
        return builder.fcmp_ordered(sign, a, b)

    for one, other in ((RealVector, RealVector), (RealVector, types.Float), (types.Float, RealVector)):
        lower_builtin(function, one, other)(build)


ORDER = {operator.gt: ">", operator.ge: ">=", operator.lt: "<", operator.le: "<=", operator.ne: "!="}
for _function, _sign in ORDER.items():
    _comparison(_function, _sign)


def _place(builder: Any, tile: Any, offset: int) -> Any:
    """Pointer to a field of a tile."""
    start = builder.bitcast(tile, ir.PointerType(ir.IntType(8)))
    return builder.bitcast(builder.gep(start, [ir.Constant(ir.IntType(64), offset)]), ir.PointerType(LANES))


def _offsets(tile: Any, name: str) -> list[int]:
    names = [name] if name in tile.fields else [f"{name}_re", f"{name}_im"]
    return [tile.offset(each) for each in names]


@intrinsic(prefer_literal=True)
def get(typingctx: Any, tile: Any, name: Any) -> Any:
    """Load a field of a tile: a real vector, or a complex one."""
    offsets = _offsets(tile, name.literal_value)

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        parts = [builder.load(_place(builder, values[0], offset), align=64) for offset in offsets]
        return parts[0] if len(parts) == 1 else _pair(builder, *parts)

    return (REAL if len(offsets) == 1 else COMPLEX)(tile, name), build


@intrinsic(prefer_literal=True)
def put(typingctx: Any, tile: Any, name: Any, vector: Any) -> Any:
    """Store a vector (or a number, for all bands) in a field of a tile."""
    offsets = _offsets(tile, name.literal_value)
    if vector == COMPLEX and len(offsets) == 1:
        raise TypeError(f"{name.literal_value} is real")

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        parts = _parts(context, builder, vector, values[2])
        zero = ir.Constant(LANES, [ir.Constant(DOUBLE, 0.0)] * W)
        for part, offset in zip(parts, offsets, strict=False):
            builder.store(zero if part is None else part, _place(builder, values[0], offset), align=64)
        return context.get_dummy_value()

    return types.void(tile, name, vector), build


@intrinsic
def load(typingctx: Any, address: Any) -> Any:
    """Load the real vector at an address, which is a multiple of 64 bytes."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(builder.inttoptr(values[0], ir.PointerType(LANES)), align=64)

    return REAL(types.int64), build


@intrinsic
def where(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Select a where the mask is true, else b, in every lane."""
    result = COMPLEX if COMPLEX in (a, b) else REAL

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        zero = ir.Constant(LANES, [ir.Constant(DOUBLE, 0.0)] * W)
        pairs = zip(*(_parts(context, builder, *each) for each in ((a, values[1]), (b, values[2]))), strict=True)
        parts = [builder.select(values[0], zero if x is None else x, zero if y is None else y) for x, y in pairs]
        return _pair(builder, *parts) if result == COMPLEX else parts[0]

    return result(MASK, a, b), build


@intrinsic
def some(typingctx: Any, mask: Any) -> Any:
    """Whether the mask is true in any lane."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bits = ir.IntType(W)
        return builder.icmp_unsigned("!=", builder.bitcast(values[0], bits), ir.Constant(bits, 0))

    return types.boolean(MASK), build


@intrinsic
def total(typingctx: Any, vector: Any) -> Any:
    """Sum over the lanes of a real vector."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        value, width = values[0], W
        while width > 1:
            width //= 2
            halves = [
                builder.shuffle_vector(
                    value, value, ir.Constant(ir.VectorType(INDEX, width), list(range(first, first + width)))
                )
                for first in (0, width)
            ]
            value = builder.fadd(*halves)
        return builder.extract_element(value, ir.Constant(INDEX, 0))

    return types.float64(REAL), build


def _of_llvm(name: str, arguments: int) -> Any:
    """Function of real vectors that LLVM has as an intrinsic of its own."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        full = f"llvm.{name}.v{W}f64"
        function = builder.module.globals.get(full)
        if function is None:
            function = ir.Function(builder.module, ir.FunctionType(LANES, [LANES] * arguments), full)
        vectors = [_parts(context, builder, *each)[0] for each in zip(signature.args, values, strict=True)]
        return builder.call(function, vectors)

    if arguments == 1:

        @intrinsic
        def function(typingctx: Any, x: Any) -> Any:
            return REAL(x), build
    else:

        @intrinsic
        def function(typingctx: Any, x: Any, y: Any) -> Any:
            return REAL(x, y), build

    return function


sqrt, nearest, magnitude = (_of_llvm(name, 1) for name in ("sqrt", "rint", "fabs"))
minimum, maximum = (_of_llvm(name, 2) for name in ("minnum", "maxnum"))


@intrinsic
def zeros(typingctx: Any) -> Any:
    """Real vector of zeros."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return ir.Constant(LANES, [ir.Constant(DOUBLE, 0.0)] * W)

    return REAL(), build


@intrinsic
def pair(typingctx: Any, real: Any, imag: Any) -> Any:
    """Complex vector of its real and imaginary parts."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        parts = (_parts(context, builder, *each)[0] for each in zip(signature.args, values, strict=True))
        return _pair(builder, *parts)

    return COMPLEX(real, imag), build


@kernel
def conj(z):
    """Complex conjugate."""
    return pair(z.real, -1.0 * z.imag)


@kernel
def square(z):
    """Squared magnitude of a complex vector."""
    return z.real * z.real + z.imag * z.imag


@kernel
def unit(turns):
    """e^(2 pi j turns) of a real vector."""
    x = turns - nearest(turns)
    far = magnitude(x) > 0.25
    x = where(far, where(x > 0.0, 0.5, -0.5) - x, x)
    u = x * x
    s = SIN[0] + u * (SIN[1] + u * (SIN[2] + u * (SIN[3] + u * (SIN[4] + u * (SIN[5] + u * (SIN[6] + u * SIN[7]))))))
    c = COS[0] + u * (COS[1] + u * (COS[2] + u * (COS[3] + u * (COS[4] + u * (COS[5] + u * (COS[6] + u * COS[7]))))))
    return pair(where(far, -1.0 * c, c), s * x)


@kernel
def smooth(x):
    """Third-order step from 0 to 1 over 0..1: x^2 (3 - 2 x)."""
    x = minimum(maximum(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def polar(z):
    """Magnitude of a complex vector and its angle (rad), above -3/2 pi up to pi/2.

    An octant, turned back by half of it, leaves |t| <= tan(pi/8) to the polynomials.
    """
    re = z.real + LEAST
    x, y = magnitude(re), magnitude(z.imag)
    larger, smaller = maximum(x, y), minimum(x, y)
    base = larger + EIGHTH * smaller
    t = (smaller - EIGHTH * larger) / base
    u = t * t
    size = CHORD[0] + u * (CHORD[1] + u * (CHORD[2] + u * (CHORD[3] + u * (CHORD[4] + u * CHORD[5]))))
    angle = ATAN[0] + u * (ATAN[1] + u * (ATAN[2] + u * (ATAN[3] + u * (ATAN[4] + u * ATAN[5]))))
    angle = TURN / 16.0 + t * angle
    angle = where(y > x, 0.25 * TURN - angle, angle)
    angle = where(z.imag < 0.0, -1.0 * angle, angle)
    return base * size, where(re < 0.0, -0.5 * TURN - angle, angle)
