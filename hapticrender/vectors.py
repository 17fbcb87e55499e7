"""Vectors of eight bands for kernels: fields of tiles, arithmetic with operators, no loop over bands.

A *tile* is a record whose fields hold a number for each of W = 8 bands.  ``get(b, "omega")`` loads one as a real
vector, ``get(b, "e0")`` as a complex one where the record has the fields ``e0_re`` and ``e0_im``; `put` stores alike.
Vectors take + - * / with vectors and numbers, real ones comparisons, which make masks for `where` and `some`.

Everything here is numba's documented extension interface and llvmlite's builder; LLVM chooses the registers.
"""

import operator
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

W = 8  # bands a vector
DOUBLE, INDEX = ir.DoubleType(), ir.IntType(32)
LANES, BITS, NONE = ir.VectorType(DOUBLE, W), ir.IntType(W), ir.Constant(ir.IntType(W), 0)
LAYOUTS: dict[Any, dict[str, int]] = {}  # offsets of the fields (bytes) of tiles, by their types


class Vector(types.Type):
    """Type of a vector; `representation` is LLVM's."""

    def __init__(self, name: str, representation: Any) -> None:
        super().__init__(name)
        self.representation = representation


@register_model(Vector)
class VectorModel(models.PrimitiveModel):
    """A vector is what LLVM makes of it."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.representation)


REAL, COMPLEX = Vector("real vector", LANES), Vector("complex vector", ir.LiteralStructType([LANES, LANES]))
MASK, ZERO = Vector("mask vector", ir.VectorType(ir.IntType(1), W)), ir.Constant(LANES, [ir.Constant(DOUBLE, 0.0)] * W)


def _parts(builder: Any, kind: Any, value: Any) -> tuple[Any, Any]:
    """Real and imaginary lanes of a vector or number; the imaginary ones are None where there are none."""
    if kind == COMPLEX:
        return builder.extract_value(value, 0), builder.extract_value(value, 1)
    if isinstance(kind, Vector):
        return value, None
    number = builder.sitofp(value, DOUBLE) if isinstance(kind, types.Integer) else value
    one = builder.insert_element(ZERO, number, ir.Constant(INDEX, 0))
    return builder.shuffle_vector(one, ZERO, ir.Constant(ir.VectorType(INDEX, W), [0] * W)), None


def _value(builder: Any, kind: Any, real: Any, imag: Any) -> Any:
    """Vector of a kind from its lanes."""
    if kind != COMPLEX:
        return real
    pair = builder.insert_value(ir.Constant(COMPLEX.representation, ir.Undefined), real, 0)
    return builder.insert_value(pair, ZERO if imag is None else imag, 1)


def _operator(function: Any, act: Callable[..., Any], kind: Any = None) -> None:
    """Give an operator its types, and its code for vectors and numbers; `act` makes lanes of lanes."""

    @type_callable(function)
    def typed(context: Any) -> Any:
        def result(a: Any, b: Any) -> Any:
            vectors = isinstance(a, Vector) or isinstance(b, Vector)
            return (kind or (COMPLEX if COMPLEX in (a, b) else REAL)) if vectors else None

        return result

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        (a, b), (x, y) = (_parts(builder, *each) for each in zip(signature.args, values, strict=True))
        return _value(builder, signature.return_type, *act(builder, a, b, x, y))

    number, integer = types.Float, types.Integer
    for kinds in ((Vector, Vector), (Vector, number), (number, Vector), (Vector, integer), (integer, Vector)):
        lower_builtin(function, *kinds)(build)


def _of_llvm(name: str) -> Callable[..., Any]:
    """Code of a function that LLVM has an intrinsic of."""

    def act(builder: Any, *lanes: Any) -> Any:
        lanes = tuple(each for each in lanes if each is not None)
        kind = ir.FunctionType(LANES, [LANES] * len(lanes))
        return builder.call(builder.module.declare_intrinsic(f"llvm.{name}.v{W}f64", (), kind), lanes)

    return act


FUSED = _of_llvm("fma")  # a b + c


def _each(name: str) -> Callable[..., Any]:
    def act(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
        combine = getattr(builder, name)
        imag = None if b is y is None else combine(*(ZERO if each is None else each for each in (b, y)))
        return combine(a, x), imag

    return act


def _product(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
    real = builder.fmul(a, x)
    if b is None:
        return real, None if y is None else builder.fmul(a, y)
    if y is None:
        return real, builder.fmul(b, x)
    return FUSED(builder, builder.fneg(b), y, real), FUSED(builder, a, y, builder.fmul(b, x))


def _quotient(builder: Any, a: Any, b: Any, x: Any, y: Any) -> tuple[Any, Any]:
    if y is not None:
        raise TypeError("a complex vector divides nothing: multiply by its conjugate over its squared magnitude")
    return builder.fdiv(a, x), None if b is None else builder.fdiv(b, x)


_operator(operator.add, _each("fadd"))
_operator(operator.sub, _each("fsub"))
_operator(operator.mul, _product)
_operator(operator.truediv, _quotient)
for _sign, _function in {">": operator.gt, ">=": operator.ge, "<": operator.lt, "!=": operator.ne}.items():
    _operator(_function, lambda builder, a, b, x, y, sign=_sign: (builder.fcmp_ordered(sign, a, x), None), MASK)


def tile_type(dtype: np.dtype[Any]) -> Any:
    """Type of records of `dtype`, whose fields are W wide, for `get` and `put`."""
    kind = numba.from_dtype(dtype)
    LAYOUTS[kind] = {name: place[1] for name, place in (dtype.fields or {}).items()}
    return kind


def _places(builder: Any, tile: Any, value: Any, name: str) -> list[Any]:
    """Pointers to the field `name`, or to its real and imaginary parts."""
    fields = LAYOUTS[tile]
    start = builder.bitcast(value, ir.PointerType(ir.IntType(8)))
    names = [name] if name in fields else [f"{name}_re", f"{name}_im"]
    offsets = [ir.Constant(ir.IntType(64), fields[each]) for each in names]
    return [builder.bitcast(builder.gep(start, [each]), ir.PointerType(LANES)) for each in offsets]


@intrinsic(prefer_literal=True)
def get(typingctx: Any, tile: Any, name: Any) -> Any:
    """Load a field of a tile: a real vector, or a complex one."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        parts = [builder.load(each, align=64) for each in _places(builder, tile, values[0], name.literal_value)]
        return _value(builder, signature.return_type, parts[0], parts[-1])

    return (REAL if name.literal_value in LAYOUTS[tile] else COMPLEX)(tile, name), build


@intrinsic(prefer_literal=True)
def put(typingctx: Any, tile: Any, name: Any, vector: Any) -> Any:
    """Store a vector, or a number for all bands, in a field of a tile; returns 0."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        places = _places(builder, tile, values[0], name.literal_value)
        if vector == COMPLEX and len(places) == 1:
            raise TypeError(f"field {name.literal_value!r} is real")
        for part, place in zip(_parts(builder, vector, values[2]), places, strict=False):
            builder.store(ZERO if part is None else part, place, align=64)
        return ir.Constant(ir.IntType(64), 0)

    return types.int64(tile, name, vector), build


@intrinsic
def load(typingctx: Any, address: Any) -> Any:
    """Load the real vector at an address, which is a multiple of 64 bytes."""
    return REAL(types.int64), lambda context, builder, signature, values: builder.load(
        builder.inttoptr(values[0], ir.PointerType(LANES)), align=64
    )


@intrinsic
def zeros(typingctx: Any) -> Any:
    """Real vector of zeros."""
    return REAL(), lambda context, builder, signature, values: ZERO


@intrinsic
def where(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Select a where the mask is true, else b, in every lane."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        one, other = _parts(builder, a, values[1]), _parts(builder, b, values[2])
        pairs = [[ZERO if each is None else each for each in both] for both in zip(one, other, strict=True)]
        return _value(builder, signature.return_type, *(builder.select(values[0], *both) for both in pairs))

    return (COMPLEX if COMPLEX in (a, b) else REAL)(mask, a, b), build


@intrinsic
def fused(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c of real vectors or numbers, rounded once."""
    return REAL(a, b, c), lambda context, builder, signature, values: FUSED(
        builder, *(_parts(builder, *each)[0] for each in zip(signature.args, values, strict=True))
    )


def _of_one(kind: Any, act: Callable[..., Any]) -> Any:
    """Function of one vector, from what makes a value of its lanes."""

    @intrinsic
    def function(typingctx: Any, x: Any) -> Any:
        return kind(x), lambda context, builder, signature, values: act(builder, *_parts(builder, x, values[0]))

    return function


def _of_two(kind: Any, act: Callable[..., Any]) -> Any:
    """Function of two real vectors or numbers, from what makes a value of their lanes."""

    @intrinsic
    def function(typingctx: Any, x: Any, y: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return act(builder, _parts(builder, x, values[0])[0], _parts(builder, y, values[1])[0])

        return kind(x, y), build

    return function


def _total(builder: Any, value: Any, _: Any) -> Any:
    for width in (4, 2, 1):
        halves = (ir.Constant(ir.VectorType(INDEX, width), [*range(start, start + width)]) for start in (0, width))
        value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in halves))
    return builder.extract_element(value, ir.Constant(INDEX, 0))


real = _of_one(REAL, lambda builder, real, imag: real)
imag = _of_one(REAL, lambda builder, real, imag: imag)
conj = _of_one(COMPLEX, lambda builder, real, imag: _value(builder, COMPLEX, real, builder.fneg(imag)))
square = _of_one(REAL, lambda builder, real, imag: builder.fadd(builder.fmul(real, real), builder.fmul(imag, imag)))
sqrt, nearest, magnitude = (_of_one(REAL, _of_llvm(name)) for name in ("sqrt", "rint", "fabs"))
total = _of_one(types.float64, _total)  # sum over the lanes
some = _of_one(types.boolean, lambda builder, mask, _: builder.icmp_unsigned("!=", builder.bitcast(mask, BITS), NONE))
pair = _of_two(COMPLEX, lambda builder, real, imag: _value(builder, COMPLEX, real, imag))
minimum, maximum = (  # the second where one is NaN
    _of_two(REAL, lambda builder, x, y, sign=sign: builder.select(builder.fcmp_ordered(sign, x, y), x, y))
    for sign in "<>"
)
