"""Rational functions of s: the continuous-time values that design works with, and Tustin's way to samples."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from hapticrender.protocols import Array


@dataclass(frozen=True)
class TransferFunction:
    """A proper rational function of s, ``numerator(s)/denominator(s)``.

    Coefficients are in descending powers of s (rad/s), kept as tuples and scaled so that the denominator is monic;
    common factors stay.  A denominator that is zero, or of lower order than the numerator, is a ValueError.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def __post_init__(self) -> None:
        above, below = (np.trim_zeros(np.array(each, float), "f") for each in (self.numerator, self.denominator))
        if not below.size or above.size > below.size:
            raise ValueError(f"denominator of order {below.size - 1} must be >= the numerator's, {above.size - 1}")
        object.__setattr__(self, "numerator", tuple((above / below[0]).tolist()))
        object.__setattr__(self, "denominator", tuple((below / below[0]).tolist()))

    def __call__(self, s: Any) -> Any:
        """Value at complex `s` (rad/s)."""
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s)

    def __mul__(self, other: TransferFunction) -> TransferFunction:
        return TransferFunction(
            tuple(np.polymul(self.numerator, other.numerator)), tuple(np.polymul(self.denominator, other.denominator))
        )

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.denominator) - 1

    def poles(self) -> Array:
        """Poles (rad/s, complex)."""
        return np.roots(self.denominator)

    def frequency_response(self, frequency: Any) -> Any:
        """Complex response at `frequency` (Hz)."""
        return self(2j * np.pi * np.asarray(frequency, float))

    def tustin(self, rate: float, *, prewarp: float | None = None) -> tuple[Array, Array]:
        """Discretise by the bilinear transform at `rate` (Hz), exact at `prewarp` (Hz, below rate/2), or at 0 Hz.

        Returns
        -------
        b, a : ndarray, shape (order + 1,)
            Coefficients of z^-k in ``y[n] = sum b[k] x[n-k] - sum_(k>0) a[k] y[n-k]``; ``a[0] = 1``.

        Notes
        -----
        ``s = K (1 - z^-1)/(1 + z^-1)`` with K = 2 rate, or ``2 pi prewarp/tan(pi prewarp/rate)``.  Poles far below the
        rate crowd at z = 1, and a direct form of order n loses about n log10(rate/|pole|) of the 16 digits.
        """
        scale = 2 * rate if prewarp is None else 2 * np.pi * prewarp / np.tan(np.pi * prewarp / rate)
        b, a = (_bilinear(polynomial, self.order, scale) for polynomial in (self.numerator, self.denominator))
        return b / a[0], a / a[0]


def _bilinear(polynomial: tuple[float, ...], order: int, scale: float) -> Array:
    """``(1 + q)^order polynomial(scale (1 - q)/(1 + q))`` in ascending powers of q = z^-1."""
    ascending = np.polynomial.polynomial
    result = np.zeros(order + 1)
    for power, coefficient in enumerate(reversed(polynomial)):
        factors = ascending.polypow([1.0, -1.0], power), ascending.polypow([1.0, 1.0], order - power)
        result += coefficient * scale**power * ascending.polymul(*factors)
    return result


def butterworth(bandwidth: float) -> TransferFunction:
    """Second-order Butterworth low pass, ``w^2/(s^2 + sqrt2 w s + w^2)``, -3 dB at `bandwidth` w/(2 pi) (Hz, > 0)."""
    w = 2 * np.pi * bandwidth
    return TransferFunction((w**2,), (1.0, sqrt(2) * w, w**2))
