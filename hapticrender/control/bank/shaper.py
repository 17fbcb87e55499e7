"""The last step before a converter: a drive rounded to its steps, what that leaves shaped away from the bands."""

from __future__ import annotations

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import high, low
from hapticrender.compiled.lanes_memory import read, write
from hapticrender.compiled.polynomials import whole


@kernel
def shape_pass(numbers, shaper, exact, drive, i):
    """Write a drive of channel i inside its limit, as the converter will have it; noise is shaped by (1 - 1/z)^2."""
    limit, step = numbers.drive_limit, numbers.drive_step
    if step > 0.0:
        last = read(shaper, 0, i)
        shaped = exact + (2.0 * last - read(shaper, 1, i))
        exact = step * whole(shaped, 1.0 / step)
        write(last, shaper, 1, i)
        write(low(high(shaped - exact, -step), step), shaper, 0, i)
    write(low(high(exact, -limit), limit), drive, i)
