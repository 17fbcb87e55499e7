"""Mathematics that several packages need: accuracy of the compiled functions, and of the design-time ones."""

import math

import numba
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from hapticrender import mathx
from hapticrender.control.records import aligned
from hapticrender.jit import kernel, record
from hapticrender.vectors import W, get, put, tile_type

RATE = 5000.0


TILE = np.dtype([(name, float, (W,)) for name in ("x_re", "x_im", "y_re", "y_im")])
TILE_T = tile_type(TILE)
unit_of = kernel(lambda b: put(b, "y", mathx.unit(get(b, "x_re"))))


@numba.njit
def played(function, tiles, count):
    """Give every tile at an address to a function."""
    for t in range(count):
        function(record(tiles, TILE_T, t))


def through(function, values):
    """Complex results of a function of vectors for many numbers."""
    tiles = aligned(-(-len(values) // W), TILE)
    padded = np.zeros(W * len(tiles), complex)
    padded[: len(values)] = values
    tiles["x_re"], tiles["x_im"] = padded.real.reshape(-1, W), padded.imag.reshape(-1, W)
    played(function, tiles.ctypes.data, len(tiles))
    return (tiles["y_re"] + 1j * tiles["y_im"]).ravel()[: len(values)]


def test_sine_and_cosine_of_turns(rng):
    """To 3e-15 within half a turn, quarter turns included; beyond it the whole turns go without a rounding."""
    quarters = np.arange(-8, 9) / 4
    beside = [quarters, quarters + 2e-16, quarters - 2e-16]
    turns = np.concatenate([rng.uniform(-0.5, 0.5, 100_000), *beside, rng.uniform(-1e6, 1e6, 1000)])
    found, exact = through(unit_of, turns), turns - np.rint(turns)
    angle = 2 * np.longdouble(math.pi) * exact.astype(np.longdouble) + np.longdouble(2.4492935982947064e-16) * exact
    np.testing.assert_allclose(found.imag, np.sin(angle).astype(float), rtol=0, atol=3e-15)
    np.testing.assert_allclose(found.real, np.cos(angle).astype(float), rtol=0, atol=3e-15)


@pytest.mark.parametrize(("period", "within"), [(1 / RATE, 1e-12), (2 / RATE, 1e-12), (0.05, 1e-9), (1.0, 1e-9)])
def test_zero_order_hold_is_scipys(period, within):
    """An oscillator under a held force; two inputs, one without effect.  Rounding grows with the norm, 280 to 1.4e6."""
    w, damping = 2 * math.pi * 189.0, 30.0  # rad/s, 1/s
    a, b = np.array([[0.0, 1.0], [-(w**2), -2 * damping]]), np.array([[0.0, 0.0], [w**2, 0.0]])
    exact = scipy.linalg.expm(a * period), scipy.signal.cont2discrete((a, b, a, b), period)[1]
    for found, each in zip(mathx.zoh(a, b, period), exact, strict=True):
        np.testing.assert_allclose(found, each, rtol=within, atol=1e-9 * abs(each).max() if period > 0.01 else 0.0)


def test_first_order_hold_follows_a_ramp():
    """x' = u - p x under u from u0 to u1 in T, in closed form; an integrator of both inputs beside it."""
    p, t, u0, u1 = 400.0, 1 / RATE, 0.7, -0.2
    a, b = np.diag([-p, 0.0]), np.array([[1.0, 0.0], [1.0, 2.0]])
    found = mathx.foh(a, b, t) @ [3.0, 5.0, u0, 11.0, u1, 13.0]
    decay, slope = math.exp(-p * t), (u1 - u0) / t
    ramp = u0 / p * (1 - decay) + slope / p * (t - (1 - decay) / p)
    np.testing.assert_allclose(found, [3.0 * decay + ramp, 5.0 + t * (0.5 * (u0 + u1) + 24.0)], rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_zero_crossings_are_found_between_samples(sign):
    """Of straight lines exactly; of a sine to the chord's error, w^2 t (1 - t) (1 - 2 t)/6 <= w^2/(36 sqrt 3)."""
    np.testing.assert_allclose(mathx.zero_crossings(sign * np.array([1.0, -3.0, -1.0, 1.0])), [0.25, 2.5])
    w = 2 * math.pi / 50
    found = mathx.zero_crossings(sign * np.sin(w * np.arange(500) - 0.3))
    np.testing.assert_allclose(found, (0.3 + math.pi * np.arange(20)) / w, atol=1.1 * w**2 / (36 * math.sqrt(3)))
    assert mathx.zero_crossings(np.ones(5)).size == 0
