"""Polynomials against numpy: errors over dense grids, at special points, for numbers and vectors of both precisions."""

import numpy as np
import pytest

from hapticrender._jit import kernel
from hapticrender._lanes import WIDTH, aligned
from hapticrender._lanes_memory import lanes, put
from hapticrender._polynomials import cosine, polar, unit

# sine and cosine; angle, rad; size; the shorter cosine: what the polynomials leave (2.3e-10, 1.8e-10 and 1.2e-10 in
# double, 6.84e-6, 8.47e-6 and 8e-7 in single precision) and what rounding adds: to an angle of up to 3/2 pi 2.4e-7, for
# pi itself 0.9e-7 and before it is added 1.2e-7; to a size three times 0.6e-7; to a sum of terms up to 5 thrice 2.4e-7
BOUNDS = {np.float64: (2.5e-15, 2.3e-10, 1.8e-10, 1.2e-10), np.float32: (2e-7, 7.3e-6, 8.7e-6, 1.5e-6)}


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


@pytest.mark.parametrize("dtype", BOUNDS)
def test_cosine_and_sine(dtype):
    turns = np.linspace(-1.5, 1.5, 2**18).astype(dtype)
    given = tiles(turns[None], dtype)
    out = aligned((len(given), 2, given.shape[2]), dtype)
    units(given, out)
    exact = 2 * np.pi * (turns.astype(float) - np.rint(turns.astype(float)))
    assert abs(flat(out) - [np.cos(exact), np.sin(exact)]).max() <= BOUNDS[dtype][0]
    out = aligned((len(given), 1, given.shape[2]), dtype)
    cosines(given, out)
    assert abs(flat(out) - np.cos(exact)).max() <= BOUNDS[dtype][3]


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
    assert -1.5 * np.pi - BOUNDS[dtype][1] <= angle.min() < -np.pi < 0.49 * np.pi < angle.max()
    assert angle.max() <= 0.5 * np.pi + BOUNDS[dtype][1]
    off = angle - np.arctan2(im, re)
    assert abs(np.mod(off + np.pi, 2 * np.pi) - np.pi).max() <= BOUNDS[dtype][1]


def test_far_from_zero_only_the_fraction_counts():
    for turns in (1e6 + 0.125, -3e5 - 0.25, 7.0, -0.5):
        assert one_unit(turns) == pytest.approx(
            (np.cos(2 * np.pi * (turns % 1)), np.sin(2 * np.pi * (turns % 1))), abs=3e-15
        )


@pytest.mark.parametrize(
    ("im", "re"),
    [*((im, re) for im in (-1.0, 0.0, 1.0) for re in (-1.0, 0.0, 1.0)), (1e-200, 1.0)],
)
def test_axes_and_diagonals(im, re):
    """Cut at 90 degrees, which itself is 90 degrees and not -270."""
    expected = np.arctan2(im, re)
    expected -= 2 * np.pi if expected > 0.5 * np.pi else 0.0
    assert one_polar(im, re)[1] == pytest.approx(expected, abs=BOUNDS[np.float64][1])
    assert one_polar(im, re)[0] == pytest.approx(np.hypot(im, re), rel=BOUNDS[np.float64][2], abs=1e-140)
    assert abs(float(one_polar(np.float32(im), np.float32(re))[1]) - expected) <= BOUNDS[np.float32][1]
