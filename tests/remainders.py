"""How far polynomials can be off: what interpolation leaves, and what rounding adds, without a look at their values.

With n Chebyshev nodes on [0, U] and y = 1 + 2 c/U, interpolation of 1/(c + u) leaves T_n of it over T_n(y), at most
1/T_n(y) of it.  Sums of such terms are atan and the square root, s^2 standing for 1/c::

    atan(t)/t     = int_0^1 ds/(1 + u s^2)                             u = t^2
    sqrt(1 + u)   = 1 + 2/pi int_0^1 u sqrt(1 - s^2)/(1 + u s^2) ds

Of cos(2 pi x) in u = x^2 the n-th derivative over n! is largest at 0, (2 pi)^(2n)/(2n)!, and 2 (U/4)^n of it is left.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.polynomial.chebyshev import chebval

MIDDLES = (np.arange(1000) + 0.5) / 1000  # of s


def _left(nodes, top):
    """1/T_n at the poles of all s: largest share of each term that is left."""
    return 1.0 / chebval(1.0 + 2.0 / (top * MIDDLES**2), [0.0] * nodes + [1.0])


def of_cosine(nodes, reach):
    """Of cos(2 pi x), |x| <= reach."""
    return 2.0 * (reach * np.pi) ** (2 * nodes) / factorial(2 * nodes)


def of_sine(nodes, reach):
    """Of sin(2 pi x), times the x that is left out of the series."""
    return reach * 2.0 * (reach * np.pi) ** (2 * nodes) * 2.0 * np.pi / factorial(2 * nodes + 1)


def of_angle(nodes, reach):
    """Of atan(t), |t| <= reach: largest where t is."""
    return reach * np.mean(_left(nodes, reach**2) / (1.0 + (reach * MIDDLES) ** 2))


def of_root(nodes, reach):
    """Of sqrt(1 + t^2), relative; largest at 0, where the root is 1 and 1 + u s^2 as well."""
    return 2.0 / np.pi * np.mean(_left(nodes, reach**2) * np.sqrt(1.0 - MIDDLES**2) / MIDDLES**2)


@dataclass(frozen=True)
class Rounded:
    """Numbers with the most that rounding has put them off, every operation adding a unit of its result."""

    value: np.ndarray
    error: np.ndarray
    unit: float

    def _new(self, value, error):
        return Rounded(value, error + self.unit * abs(value), self.unit)

    def constant(self, value):
        """A number that is rounded as it is written down."""
        return self._new(np.float64(value), np.float64(0.0))

    def __add__(self, other):
        return self._new(self.value + other.value, self.error + other.error)

    def __sub__(self, other):
        return self._new(self.value - other.value, self.error + other.error)

    def __mul__(self, other):
        error = abs(self.value) * other.error + abs(other.value) * self.error + self.error * other.error
        return self._new(self.value * other.value, error)

    def __truediv__(self, other):
        value = self.value / other.value
        return self._new(value, (self.error + abs(value) * other.error) / (abs(other.value) - other.error))

    def series(self, coefficients, pairs):
        """Polynomial in this, from the last coefficient on; in `pairs`, a sum of two terms is one coefficient."""
        terms, power = [self.constant(each) for each in coefficients], self
        if pairs:
            terms = [first + second * self for first, second in zip(terms[::2], terms[1::2], strict=True)]
            power = self * self
        result = terms[-1]
        for term in terms[-2::-1]:
            result = term + power * result
        return result
