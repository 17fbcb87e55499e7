"""Polynomials against numpy: errors over dense grids, at special points, for numbers and vectors of both precisions."""

import numpy as np
import pytest

from hapticrender._jit import kernel
from hapticrender._lanes import WIDTH, aligned, lanes, put
from hapticrender._polynomials import polar, unit

BOUNDS = {np.float64: (2.5e-15, 4e-11, 2e-11), np.float32: (2e-7, 4e-7, 3e-7)}  # sine and cosine; angle, rad; size


@kernel
def units(turns, out):
    for t in range(turns.shape[0]):
        cos, sin = unit(lanes(turns, t, 0))
        put(out, t, 0, cos)
        put(out, t, 1, sin)


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


@pytest.mark.parametrize("dtype", BOUNDS)
def test_cosine_and_sine(dtype):
    turns = np.linspace(-1.5, 1.5, 2**18).astype(dtype)
    given = tiles(turns[None], dtype)
    out = aligned((len(given), 2, given.shape[2]), dtype)
    units(given, out)
    exact = 2 * np.pi * (turns.astype(float) - np.rint(turns.astype(float)))
    assert abs(flat(out) - [np.cos(exact), np.sin(exact)]).max() <= BOUNDS[dtype][0]


@pytest.mark.parametrize("dtype", BOUNDS)
def test_magnitude_and_angle(dtype, rng):
    theta = np.linspace(-np.pi, np.pi, 2**16)
    radius = 10.0 ** rng.uniform(-9, 3, theta.size)
    pairs = tiles(np.array([radius * np.cos(theta), radius * np.sin(theta)]), dtype)
    out = aligned((len(pairs), 2, pairs.shape[2]), dtype)
    polars(pairs, out)
    re, im = flat(pairs).astype(float)
    magnitude, angle = flat(out)
    np.testing.assert_allclose(magnitude, np.hypot(re, im), rtol=BOUNDS[dtype][2])
    off = angle - np.arctan2(im, re)
    assert abs(np.mod(off + np.pi, 2 * np.pi) - np.pi).max() <= BOUNDS[dtype][1]


def test_far_from_zero_only_the_fraction_counts():
    for turns in (1e6 + 0.125, -3e5 - 0.25, 7.0, -0.5):
        assert one_unit(turns) == pytest.approx(
            (np.cos(2 * np.pi * (turns % 1)), np.sin(2 * np.pi * (turns % 1))), abs=3e-15
        )


@pytest.mark.parametrize(
    ("im", "re"),
    [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 1.0), (-1.0, -1.0), (1e-200, 1.0)],
)
def test_axes_and_diagonals(im, re):
    assert one_polar(im, re)[1] == pytest.approx(np.arctan2(im, re), abs=4e-11)
    assert one_polar(im, re)[0] == pytest.approx(np.hypot(im, re), rel=2e-11)
    assert abs(float(one_polar(np.float32(im), np.float32(re))[1]) - np.arctan2(im, re)) <= 4e-7
