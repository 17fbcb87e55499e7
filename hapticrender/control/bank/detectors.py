"""The two detectors of the band bank: what they hear of the deviation opens the loop for a while."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import high, select, total
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.learning import in_a_turn

HUGE = 1e300  # stands for infinity, where fast arithmetic is not told of it


@kernel
def fast_pass(numbers, state, t, c):
    """How much of the deviation in coordinate c the fast detector hears beyond its level, squared, in a tile."""
    band, loop = state.band, state.loop
    at, pole = c * row.LOOP_ROWS + row.FAST_RE, numbers.fast_pole
    pull = 2.0 * pole * read(state.residual, row.DEVIATION, c)
    re = (1.0 - pole) * lanes(loop, t, at) + pull * lanes(band, t, row.COS)
    im = (1.0 - pole) * lanes(loop, t, at + 1) - pull * lanes(band, t, row.SIN)
    put(loop, t, at, re)
    put(loop, t, at + 1, im)
    return high((re * re - numbers.fast_level) + im * im, 0.0)


@kernel
def slow_pass(numbers, state, t, c):
    """The same of the slow detector, which listens to the fast one, once in a turn."""
    loop, base, heard = state.loop, c * row.LOOP_ROWS, 0.0
    pole = in_a_turn(numbers.slow_pole)
    for r in range(2):
        slow = lanes(loop, t, base + row.SLOW_RE + r)
        slow += pole * (lanes(loop, t, base + row.FAST_RE + r) - slow)
        put(loop, t, base + row.SLOW_RE + r, slow)
        heard += slow * slow
    return high(heard - numbers.slow_level, 0.0)


@kernel
def wake(numbers, touch, fast, slow):
    """Timers of the two detectors and how far each has opened the loop."""
    for timer, opening, heard, time in (
        (row.FAST_TIME, row.FAST_OPEN, fast, numbers.fast_time),
        (row.SLOW_TIME, row.SLOW_OPEN, slow, numbers.slow_time),
    ):
        left = select(heard > 0.0, time, read(touch, timer))
        write(select(left > 0.0, 1.0, high(read(touch, opening) - numbers.release, 0.0)), touch, opening)
        write(left - 1.0, touch, timer)


@kernel
def fast_all(tables, state):
    """What the fast detector hears in all bands; see `fast_pass`."""
    heard = 0.0
    for c in range(len(tables.shape)):
        for t in range(state.band.shape[0]):
            heard += fast_pass(tables.numbers, state, t, c)
    return total(read(state.touch, row.TRUST), heard)


@kernel
def detect(tables, state, fast, turn):
    """Wake the loop by what its detectors hear: the fast one now, the slow one in its turn."""
    numbers, touch = tables.numbers, state.touch
    slow = 0.0 * read(touch, row.TRUST)
    if turn and numbers.fast_level < HUGE:
        heard = 0.0
        for c in range(len(tables.shape)):
            for t in range(state.band.shape[0]):
                heard += slow_pass(numbers, state, t, c)
        slow = total(slow, heard)
    wake(numbers, touch, fast, slow)
