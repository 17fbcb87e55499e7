"""Vectors of eight bands: every operation against numpy's, on real, complex and scalar operands."""

import operator

import numba
import numpy as np
import pytest

from hapticrender import vectors
from hapticrender.control.records import aligned
from hapticrender.jit import kernel, record
from hapticrender.vectors import W, tile_type

NAMES = ("a", "b", "z_re", "z_im", "w_re", "w_im", "out_re", "out_im")
TILE = np.dtype([(name, float, (W,)) for name in NAMES])
TILE_T = tile_type(TILE)
OPERATORS = {"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv}
COMPARISONS = {">": operator.gt, ">=": operator.ge, "<": operator.lt, "!=": operator.ne}
VALUES = {"a": 'get(x, "a")', "z": 'get(x, "z")', "w": 'get(x, "w")', "b": 'get(x, "b")', "number": "2.5", "whole": "3"}
FUNCTIONS = {
    **{name: getattr(vectors, name) for name in vectors.__dict__ if name[0].islower()},
    **{"record": record, "TILE_T": TILE_T},
}


@pytest.fixture
def tile(rng):
    made = aligned(1, TILE)
    for name in NAMES:
        made[name] = rng.standard_normal(W)
    return made


def result(tile, expression):
    """What a kernel stores for an expression in x, in the field `out`."""
    scope = dict(FUNCTIONS)
    exec(f"def function(at):\n    x = record(at, TILE_T, 0)\n    put(x, 'out', {expression})\n", scope)
    kernel(scope["function"])(tile.ctypes.data)
    return (tile["out_re"] + 1j * tile["out_im"])[0]


def numbers(tile):
    z, w = (tile[f"{name}_re"][0] + 1j * tile[f"{name}_im"][0] for name in "zw")
    return {"a": tile["a"][0], "b": tile["b"][0], "z": z, "w": w, "number": 2.5, "whole": 3}


PAIRS = "a b, a z, z a, z w, a number, number a, z number, number z, whole a, z whole"


@pytest.mark.parametrize("sign", OPERATORS)
def test_arithmetic_is_numpys(sign, tile):
    """To two roundings of the largest term, as products may be fused with sums."""
    known = numbers(tile)
    for one, other in (each.split() for each in PAIRS.split(", ")):
        if sign == "/" and other in "zw":
            continue
        found = result(tile, f"{VALUES[one]} {sign} {VALUES[other]}")
        expected = OPERATORS[sign](known[one], known[other])
        scale = np.max(abs(known[one])) * np.max(abs(known[other])) + np.max(abs(expected))
        np.testing.assert_allclose(found, expected, rtol=0, atol=4e-16 * scale)


@pytest.mark.parametrize("sign", COMPARISONS)
def test_comparisons_select(sign, tile):
    known = numbers(tile)
    tile["b"][0, :3] = tile["a"][0, :3]
    chosen = {">": np.greater, ">=": np.greater_equal, "<": np.less, "!=": np.not_equal}[sign](
        tile["a"][0], tile["b"][0]
    )
    found = result(tile, f"where({VALUES['a']} {sign} {VALUES['b']}, {VALUES['z']}, 2.0)")
    np.testing.assert_array_equal(found, np.where(chosen, known["z"], 2.0))


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("real(Z)", lambda a, b, z: z.real),
        ("imag(Z)", lambda a, b, z: z.imag),
        ("conj(Z)", lambda a, b, z: z.conj()),
        ("square(Z)", lambda a, b, z: abs(z) ** 2),
        ("sqrt(magnitude(A))", lambda a, b, z: np.sqrt(abs(a))),
        ("nearest(3.0 * A)", lambda a, b, z: np.rint(3.0 * a)),
        ("minimum(A, B)", lambda a, b, z: np.minimum(a, b)),
        ("maximum(A, 0.25)", lambda a, b, z: np.maximum(a, 0.25)),
        ("pair(A, B)", lambda a, b, z: a + 1j * b),
        ("zeros() + total(A)", lambda a, b, z: np.full(W, a.sum())),
        ("(1.0 if some(A > 9.0) else 2.0) * A", lambda a, b, z: 2.0 * a),
        ("(1.0 if some(A != 0.0) else 2.0) * A", lambda a, b, z: a),
    ],
)
def test_functions_are_numpys(expression, expected, tile):
    known = numbers(tile)
    for letter in "ABZ":
        expression = expression.replace(letter, VALUES[letter.lower()])
    found = result(tile, expression)
    np.testing.assert_allclose(found, expected(known["a"], known["b"], known["z"]), rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ('get(x, "a") / get(x, "z")', "a complex vector divides nothing"),
        ('put(x, "a", get(x, "z"))', "field 'a' is real"),
        ('get(x, "none")', "none_re"),
    ],
)
def test_what_has_no_meaning_does_not_compile(expression, message, tile):
    with pytest.raises((numba.core.errors.NumbaError, KeyError, TypeError), match=message):
        result(tile, expression)
