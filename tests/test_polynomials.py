"""Polynomials against numpy: errors over dense grids, at special points, for numbers and vectors of both precisions."""

from math import pi, tan

import numpy as np
import pytest
from remainders import Rounded, of_angle, of_cosine, of_root, of_sine

from hapticrender.compiled import polynomials
from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import WIDTH, aligned
from hapticrender.compiled.lanes_memory import lanes, put
from hapticrender.compiled.polynomials import cosine, polar, unit

EIGHTH = tan(pi / 8)
SIDES = np.linspace(0.0, 1.0, 4097)  # the smaller over the larger of two sides
UNITS = {np.float64: 2.0**-53, np.float32: 2.0**-24}
SHORT = {np.float64: "", np.float32: "_SHORT"}


def series(name, dtype):
    return getattr(polynomials, name + SHORT[dtype])


def most_off_cosine(name, reach, dtype):
    """What interpolation leaves and rounding adds, of turns up to `reach`, which are exact."""
    coefficients, turns = series(name, dtype), np.linspace(0.0, reach, 4097)
    x = Rounded(turns, 0.0 * turns, UNITS[dtype])
    rounded = (x * x).series(coefficients, dtype is np.float64)
    return of_cosine(len(coefficients), reach) + rounded.error.max()


def most_off_sine(dtype):
    """As for the cosine."""
    coefficients, turns = series("S", dtype), np.linspace(0.0, 0.25, 4097)
    x = Rounded(turns, 0.0 * turns, UNITS[dtype])
    rounded = x * (x * x).series(coefficients, dtype is np.float64)
    return of_sine(len(coefficients), 0.25) + rounded.error.max()


def most_off_polar(dtype):
    """As for the cosine, of the magnitude, relative, and of an angle that is turned as far as angles are."""
    angle, root = series("A", dtype), series("R", dtype)
    smaller = Rounded(SIDES, 0.0 * SIDES, UNITS[dtype])
    larger, eighth = Rounded(SIDES * 0.0 + 1.0, 0.0 * SIDES, UNITS[dtype]), smaller.constant(EIGHTH)
    x = larger + eighth * smaller
    t = (smaller - eighth * larger) / x
    size = x * (t * t).series(root, dtype is np.float64)
    turned = smaller.constant(pi / 8) + t * (t * t).series(angle, dtype is np.float64)
    turned = smaller.constant(-pi) - (smaller.constant(pi / 2) - turned)
    return (
        of_root(len(root), EIGHTH) + (size.error / np.hypot(1.0, SIDES)).max(),
        of_angle(len(angle), EIGHTH) + turned.error.max(),
    )


UNIT = {dtype: max(most_off_cosine("C", 0.25, dtype), most_off_sine(dtype)) for dtype in UNITS}
COSINE = {dtype: most_off_cosine("W", 0.5, dtype) for dtype in UNITS}
SIZE, ANGLE = ({dtype: most_off_polar(dtype)[which] for dtype in UNITS} for which in (0, 1))


@kernel
def units(turns, out):
    for t in range(turns.shape[0]):
        cos, sin = unit(lanes(turns, t, 0))
        put(out, t, 0, cos)
        put(out, t, 1, sin)


@kernel
def cosines(turns, out):
    for t in range(turns.shape[0]):
        put(out, t, 0, cosine(lanes(turns, t, 0)))


@kernel
def polars(pairs, out):
    for t in range(pairs.shape[0]):
        magnitude, angle = polar(lanes(pairs, t, 1), lanes(pairs, t, 0))
        put(out, t, 0, magnitude)
        put(out, t, 1, angle)


@kernel
def one_unit(turns):
    return unit(turns)


@kernel
def one_polar(im, re):
    return polar(im, re)


def tiles(rows, dtype):
    """Rows (n, count) as tiles (count/W, n, W)."""
    width = WIDTH[np.dtype(dtype)]
    tiled = aligned((rows.shape[1] // width, len(rows), width), dtype)
    tiled[:] = rows.reshape(len(rows), -1, width).transpose(1, 0, 2)
    return tiled


def flat(tiled):
    return tiled.transpose(1, 0, 2).reshape(tiled.shape[1], -1)


@pytest.mark.parametrize("dtype", UNITS)
def test_cosine_and_sine(dtype):
    turns = np.linspace(-1.5, 1.5, 2**18).astype(dtype)
    given = tiles(turns[None], dtype)
    out = aligned((len(given), 2, given.shape[2]), dtype)
    units(given, out)
    exact = 2 * np.pi * (turns.astype(float) - np.rint(turns.astype(float)))
    assert abs(flat(out) - [np.cos(exact), np.sin(exact)]).max() <= UNIT[dtype]
    out = aligned((len(given), 1, given.shape[2]), dtype)
    cosines(given, out)
    assert abs(flat(out) - np.cos(exact)).max() <= COSINE[dtype]


@pytest.mark.parametrize("dtype", UNITS)
def test_magnitude_and_angle(dtype, rng):
    theta = np.linspace(-np.pi, np.pi, 2**16)
    radius = 10.0 ** rng.uniform(-9, 3, theta.size)
    pairs = tiles(np.array([radius * np.cos(theta), radius * np.sin(theta)]), dtype)
    out = aligned((len(pairs), 2, pairs.shape[2]), dtype)
    polars(pairs, out)
    re, im = flat(pairs).astype(float)
    magnitude, angle = flat(out)
    np.testing.assert_allclose(magnitude, np.hypot(re, im), rtol=SIZE[dtype])
    assert -1.5 * np.pi - ANGLE[dtype] <= angle.min() < -np.pi < 0.49 * np.pi < angle.max()
    assert angle.max() <= 0.5 * np.pi + ANGLE[dtype]
    off = angle - np.arctan2(im, re)
    assert abs(np.mod(off + np.pi, 2 * np.pi) - np.pi).max() <= ANGLE[dtype]


def test_far_from_zero_only_the_fraction_counts():
    for turns in (1e6 + 0.125, -3e5 - 0.25, 7.0, -0.5):
        exact = 2 * np.pi * (turns % 1)
        assert one_unit(turns) == pytest.approx(
            (np.cos(exact), np.sin(exact)), abs=UNIT[np.float64] + 2 * UNITS[np.float64]
        )


@pytest.mark.parametrize(
    ("im", "re"),
    [*((im, re) for im in (-1.0, 0.0, 1.0) for re in (-1.0, 0.0, 1.0)), (1e-200, 1.0)],
)
def test_axes_and_diagonals(im, re):
    """Cut at 90 degrees, which itself is 90 degrees and not -270."""
    expected = np.arctan2(im, re)
    expected -= 2 * np.pi if expected > 0.5 * np.pi else 0.0
    assert one_polar(im, re)[1] == pytest.approx(expected, abs=ANGLE[np.float64])
    assert one_polar(im, re)[0] == pytest.approx(np.hypot(im, re), rel=SIZE[np.float64], abs=1e-140)
    assert abs(float(one_polar(np.float32(im), np.float32(re))[1]) - expected) <= ANGLE[np.float32]


def test_bounds_are_those_stated():
    """Rounded up to two digits."""
    stated = {np.float64: (2.8e-15, 1.4e-10, 2.3e-10, 1.8e-10), np.float32: (4.3e-7, 2.9e-6, 7.8e-6, 8.9e-6)}
    for dtype, numbers in stated.items():
        for bound, number in zip((UNIT, COSINE, ANGLE, SIZE), numbers, strict=True):
            digit = 10.0 ** (np.floor(np.log10(number)) - 1)
            assert number - digit <= bound[dtype] <= number
            assert f"{number:g}".replace("e-0", "e-") in polynomials.__doc__


def test_what_interpolation_leaves_is_what_is_found():
    """Of the angle and the root in double precision, where rounding is 1e-15 of 2e-10."""
    u = (EIGHTH * SIDES) ** 2
    root = np.cos(pi / 8) * np.sqrt(1.0 + u)
    left = abs(np.polynomial.polynomial.polyval(u, polynomials.R) / root - 1.0).max()
    assert left == pytest.approx(of_root(len(polynomials.R), EIGHTH), rel=1e-4)
    left = abs(np.sqrt(u) * np.polynomial.polynomial.polyval(u, polynomials.A) - np.arctan(np.sqrt(u))).max()
    assert left == pytest.approx(of_angle(len(polynomials.A), EIGHTH), rel=1e-4)
