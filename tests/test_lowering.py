"""Loops and entries of arrays inside kernels, against plain Python."""

import numpy as np
import pytest

from hapticrender.compiled.jit import kernel


@kernel
def counted(start, stop, step, out):
    """Every number of a range, in order; returns how many."""
    n = 0
    for i in range(start, stop, step):
        out[n] = i
        n += 1
    return n


@kernel
def summed(stop, start):
    total = 0
    for i in range(stop):
        total += i
    for i in range(start, stop):
        for j in range(i, -1, -2):
            total += 100 * j
    return total


@pytest.mark.parametrize("numbers", [(0, 5, 1), (2, 2, 1), (5, 2, 1), (-3, 8, 4), (7, -8, -3), (1, 9, -1), (0, 1, 5)])
def test_a_range_is_that_of_python(numbers):
    out = np.full(20, 99)
    expected = list(range(*numbers))
    assert counted(*numbers, out) == len(expected)
    assert out[: len(expected)].tolist() == expected
    assert (out[len(expected) :] == 99).all()
    assert summed(numbers[1], numbers[0]) == summed.py_func(numbers[1], numbers[0])


@kernel
def entries(a, b, c, whole, truth, i, j, k):
    """Entries are taken and put from either end."""
    a[i] += 1.0
    b[i, -1] = a[-1]
    b[j, k] = 2.0 * b[i, j]
    c[i, j, k] -= b[j, 0]
    c[-1, k, j] = c[0, 0, 0] + c[i, j, k]
    whole[i] = whole[-2] + 1
    truth[j] = truth[i] or truth[-1]
    return a[i] + b[-1, k] + c[j, k, i] + whole[i]


@pytest.mark.parametrize("at", [(0, 1, 2), (2, 1, 0), (-1, 0, -2), (1, -3, 1)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_entries_are_those_of_numpy(at, dtype, rng):
    numbers = [rng.standard_normal(shape).astype(dtype) for shape in ((3,), (3, 3), (3, 3, 3))]
    numbers += [np.array([3, 1, 2]), np.array([True, False, False])]
    mine, right = ([each.copy() for each in numbers] for _ in range(2))
    assert entries(*mine, *at) == entries.py_func(*right, *at)
    for found, expected in zip(mine, right, strict=True):
        np.testing.assert_array_equal(found, expected)
