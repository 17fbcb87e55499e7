"""Explicit vectors against plain numpy, lane by lane."""

import numpy as np
import pytest

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import (
    ALIGNMENT,
    WIDTH,
    aligned,
    any_of,
    by_size,
    floor,
    fraction,
    high,
    low,
    padded,
    root,
    select,
    signed,
    size,
    total,
)
from hapticrender.compiled.lanes_memory import (
    column,
    lanes,
    put,
    put_column,
    put_stretch,
    read,
    record,
    record_whole,
    row_totals,
    stretch,
    write,
)

KINDS = [np.float64, np.float32]


@kernel
def arithmetic(a, out, factor):
    """One row of results a line, the same written for numpy below."""
    for t in range(a.shape[0]):
        x, y = lanes(a, t, 0), lanes(a, t, 1)
        put(out, t, 0, x + y)
        put(out, t, 1, x - y)
        put(out, t, 2, x * y + factor)
        put(out, t, 3, x / y)
        put(out, t, 4, -x)
        put(out, t, 5, root(size(x)))
        put(out, t, 6, floor(x))
        put(out, t, 7, fraction(x))
        put(out, t, 8, low(x, y))
        put(out, t, 9, high(x, 0.5))
        put(out, t, 10, select((x > y) & (y >= 0.0) | (x <= -1.0), x, 2.0 * y))
        put(out, t, 11, 3 * x)
        put(out, t, 12, signed(x, y))
        larger, smaller = by_size(x, y)
        put(out, t, 13, larger)
        put(out, t, 14, smaller)


def expected(x, y, factor):
    return [
        x + y,
        x - y,
        x * y + factor,
        x / y,
        -x,
        np.sqrt(abs(x)),
        np.floor(x),
        x - np.rint(x),
        np.minimum(x, y),
        np.maximum(x, 0.5),
        np.where((x > y) & (y >= 0.0) | (x <= -1.0), x, 2.0 * y),
        3 * x,
        np.copysign(x, y),
        np.maximum(abs(x), abs(y)),
        np.minimum(abs(x), abs(y)),
    ]


@pytest.mark.parametrize("dtype", KINDS)
def test_every_operation_equals_numpy(dtype, rng):
    width = WIDTH[np.dtype(dtype)]
    a = aligned((3, 2, width), dtype)
    a[:] = 2.0 * rng.standard_normal(a.shape)
    out = aligned((3, 15, width), dtype)
    arithmetic(a, out, 0.25)
    for row, wanted in enumerate(expected(a[:, 0], a[:, 1], dtype(0.25))):
        np.testing.assert_allclose(out[:, row], wanted, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).eps)


@kernel
def summed(a, like):
    acc = 0.0
    for t in range(a.shape[0]):
        acc += lanes(a, t, 0)
    return total(like, acc)


@pytest.mark.parametrize("dtype", KINDS)
def test_a_sum_over_lanes_is_a_number_where_the_scenario_is_one(dtype, rng):
    a = aligned((4, 1, WIDTH[np.dtype(dtype)]), dtype)
    a[:] = rng.standard_normal(a.shape)
    bound = a.size * float(np.finfo(dtype).eps) * float(abs(a).sum())
    assert summed(a, 1.0) == pytest.approx(float(a.sum(dtype=float)), abs=bound)


@kernel
def summed_by_lane(a, like, out):
    acc = 0.0
    for t in range(a.shape[0]):
        acc += lanes(a, t, 0)
    put(out, 0, 0, total(lanes(like, 0, 0), acc))


def test_a_sum_stays_apart_where_lanes_are_scenarios(rng):
    a, like, out = aligned((4, 1, 8)), aligned((1, 1, 8)), aligned((1, 1, 8))
    a[:] = rng.standard_normal(a.shape)
    summed_by_lane(a, like, out)
    np.testing.assert_allclose(out[0, 0], a[:, 0].sum(axis=0), rtol=1e-14)


@kernel
def both(x, y, z):
    """The same source for plain floats."""
    mask = x > y
    picked = select(mask, low(x, z), high(y, z))
    return picked, any_of(mask), root(z), floor(x), fraction(x), size(x), total(x, y), *by_size(x, y)


def test_plain_floats_run_through_the_same_source():
    assert both(1.7, -2.0, 9.0) == (1.7, True, 3.0, 1.0, 1.7 - 2.0, 1.7, -2.0, 2.0, 1.7)
    assert both(-1.7, 2.0, 9.0) == (9.0, False, 3.0, -2.0, 2.0 - 1.7, 1.7, 2.0, 2.0, 1.7)


@kernel
def moved(shared, by):
    """A quantity of the scenario: a number, or one a lane."""
    write(read(shared, 0) + by, shared, 1)


def test_a_scenarios_own_numbers_are_plain_or_lanes(rng):
    alone, many = np.array([0.5, 0.0]), aligned((2, 8))
    many[0] = rng.standard_normal(8)
    moved(alone, 0.25)
    moved(many, 0.25)
    assert alone[1] == 0.75
    np.testing.assert_allclose(many[1], many[0] + 0.25, rtol=1e-15)


@kernel
def recorded(shared, out):
    record(2.0 * read(shared, 0), out, 1, 0)


@kernel
def recorded_whole(shared, out):
    record_whole(read(shared, 0), out, 1)


def test_what_is_recorded_is_written():
    """Past the caches or not: numbers, rows of lanes, and rows of whole numbers."""
    alone, many = np.array([1.5]), aligned((1, 8))
    many[0] = np.arange(8.0) - 3.0
    numbers, rows, whole = np.zeros((2, 1)), aligned((2, 1, 8)), aligned((2, 8)).view(np.int64)
    recorded(alone, numbers)
    recorded(many, rows)
    recorded_whole(many, whole)
    np.testing.assert_array_equal(numbers, [[0.0], [3.0]])
    np.testing.assert_array_equal(rows, [[0.0 * many[0]], [2.0 * many[0]]])
    np.testing.assert_array_equal(whole, [[0] * 8, np.arange(8) - 3])


@kernel
def summed_rows(values, out):
    for m in range(0, values.shape[1], values.shape[2]):
        put_stretch(out, 0, m, row_totals(values, 0, m))


@pytest.mark.parametrize("dtype", KINDS)
def test_rows_are_summed_side_by_side_in_any_precision(dtype, rng):
    """W rows at once add up in a tree: each sum is off by a rounding a level, log2(W), of its magnitudes."""
    width = WIDTH[np.dtype(dtype)]
    values, out = aligned((1, 2 * width, width), dtype), np.zeros((1, 2 * width))
    values[:] = rng.standard_normal(values.shape)
    summed_rows(values, out)
    bound = np.log2(width) * np.finfo(dtype).eps * abs(values[0]).sum(axis=1, dtype=float)
    assert (abs(out[0] - values[0].sum(axis=1, dtype=float)) <= bound).all()


@kernel
def moved_on(values, start, out):
    put_stretch(out, 1, start + 1, stretch(values, 0, start) + 1.0)


@pytest.mark.parametrize("dtype", KINDS)
def test_a_stretch_starts_anywhere(dtype, rng):
    values, out = rng.standard_normal((2, 40)).astype(dtype), np.zeros((2, 40), dtype)
    width = WIDTH[np.dtype(dtype)]
    moved_on(values, 3, out)
    expected = np.zeros((2, 40), dtype)
    expected[1, 4 : 4 + width] = values[0, 3 : 3 + width] + dtype(1.0)
    np.testing.assert_array_equal(out, expected)


@kernel
def moved_over(values, start, out):
    put_column(out, start, 1, column(values, start, 0) + 1.0)


@pytest.mark.parametrize("dtype", KINDS)
@pytest.mark.parametrize("start", [0, 3, 18, 19])
def test_a_column_ends_with_the_rows(dtype, start, rng):
    """Lanes past the last row change nothing: neither that row, nor what lies behind the array."""
    values, room = rng.standard_normal((20, 3)).astype(dtype), np.zeros((20 + 16, 2), dtype)
    expected, stop = room.copy(), min(start + WIDTH[np.dtype(dtype)], 20)
    expected[start:stop, 1] = values[start:stop, 0] + dtype(1.0)
    moved_over(values, start, room[:20])
    np.testing.assert_array_equal(room, expected)


@kernel
def crossed(table):
    """Element by row and column, in a plain table or in one whose lanes are scenarios."""
    write(read(table, 0, 1) - read(table, 1, 0), table, 1, 1)


def test_tables_are_read_by_row_and_column():
    alone, many = np.arange(4.0).reshape(2, 2), aligned((2, 2, 8))
    many[:] = np.arange(4.0).reshape(2, 2, 1)
    crossed(alone)
    crossed(many)
    assert alone[1, 1] == -1.0
    assert np.array_equal(many[1, 1], -np.ones(8))


@kernel
def seen(a, bound):
    return any_of(lanes(a, 0, 0) > bound)


def test_any_lane_is_enough():
    a = aligned((1, 1, 8))
    assert not seen(a, 0.5)
    a[0, 0, 7] = 1.0
    assert seen(a, 0.5)


def test_what_is_not_a_number_gives_way():
    @kernel
    def bounded(x):
        return low(x, 2.0), high(x, -2.0)

    assert bounded(np.nan) == (2.0, -2.0)


@pytest.mark.parametrize(("count", "dtype", "rows"), [(1, float, 1), (8, float, 1), (9, float, 2), (17, np.float32, 2)])
def test_rows_are_padded_and_aligned(count, dtype, rows):
    assert padded(count, dtype) == rows
    array = aligned((rows, 3, WIDTH[np.dtype(dtype)]), dtype)
    assert array.ctypes.data % ALIGNMENT == 0
    assert array.flags.c_contiguous
    assert not array.any()
