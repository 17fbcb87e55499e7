"""Normal numbers of a seed: those of numpy's generator one by one, in half the time.

Numpy's way is the ziggurat of Marsaglia and Tsang (2000), of 256 layers: of a random word eight bits say which layer,
one the sign, and 52 how far out.  Numpy takes word by word through a pointer and branches on the sign, which no
processor foresees; here words come in bulk.  Its tables are those that numba carries.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.compiled.lanes import size
from hapticrender.protocols import Array

FEW = 1000  # numbers at once that are not worth compiling for
SPARE = 64  # words beyond one a number: 1.2 % of the numbers take more
REACH, PER_REACH = 3.6541528853610088, 0.27366123732975828  # where the lowest layer ends, and its inverse


class Normals:
    """A stream of standard normal numbers, `numpy.random.default_rng(seed).standard_normal`'s own.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        from numba.np.random import _constants as numba_tables

        self._numpy: Any = np.random.default_rng(seed)
        self._words = np.empty(0, np.uint64)  # drawn, and not yet used
        self._layers = numba_tables.ki_double, numba_tables.wi_double, numba_tables.fi_double

    def fill(self, out: Array) -> Array:
        """Fill a contiguous array with the next numbers; returns it."""
        if out.size < FEW and not len(self._words):
            return self._numpy.standard_normal(out=out)
        left = out.reshape(-1)
        while len(left):
            missing = max(len(left) + len(left) // SPARE + SPARE - len(self._words), SPARE)
            words = np.concatenate([self._words, self._numpy.bit_generator.random_raw(missing)])
            found, used = normal_run(words, *self._layers, left)
            self._words, left = words[used:], left[found:]
        return out


@kernel
def share_of(word):  # type: ignore[no-untyped-def]
    """Uniform number in [0, 1) of a word."""
    return np.float64(word >> np.uint64(11)) * 2.0**-53


@kernel
def tail(words, at):  # type: ignore[no-untyped-def]
    """How far beyond the reach of the layers; and the next word, 0 where there are too few."""
    while at + 2 <= words.shape[0]:
        x = -PER_REACH * math.log1p(-share_of(words[at]))
        y = -math.log1p(-share_of(words[at + 1]))
        at += 2
        if y + y > x * x:
            return x, at
    return 0.0, 0


@kernel
def normal_run(words, inside, width, height, out):  # type: ignore[no-untyped-def]
    """As many numbers as the words make or as there is room for; returns how many, and how many words they took."""
    found = at = 0
    while found < out.shape[0] and at < words.shape[0]:
        word = words[at]
        layer, far = np.int64(word & np.uint64(255)), np.int64((word >> np.uint64(9)) & np.uint64(2**52 - 1))
        sign = 1.0 - 2.0 * np.float64(np.int64((word >> np.uint64(8)) & np.uint64(1)))
        x = np.float64(far) * width[layer]
        out[found] = sign * x
        if far < np.int64(inside[layer]):
            found, at = found + 1, at + 1
        elif layer > 0:  # at the edge of a layer
            if at + 2 > words.shape[0]:
                break
            edge = (height[layer - 1] - height[layer]) * share_of(words[at + 1]) + height[layer]
            found, at = found + (1 if edge < math.exp(-0.5 * x * x) else 0), at + 2
        else:
            x, after = tail(words, at + 1)
            if after == 0:
                break
            out[found] = (-1.0 if (far >> 8) & 1 else 1.0) * (REACH + size(x))  # as a product of its own
            found, at = found + 1, after
    return found, at
