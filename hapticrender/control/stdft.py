"""The STDFT*, an estimator of the complex envelopes of a signal's bands: parameters and frequency response.

A real signal ``x = Re sum_k X_k exp(j phi_k)`` has an envelope X_k for every carrier phi_k.  A lock-in multiplies by
``exp(-j phi_k)`` and low-passes twice the result; what is left of the image at twice the carrier is its ripple.  This
is its design; it runs in `demodulator`, in `low_pass` (polar and complex methods) and in `plants.electroadhesion`.

References
----------
Grigorii, Li, Peshkin and Colgate, IEEE Transactions on Haptics, 2021, eqs. 1-5.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import numpy as np

from hapticrender.protocols import Array


@dataclass(frozen=True, kw_only=True)
class StarSTDFT:
    """The STDFT* of eq. 4: a second-order Butterworth low pass, discretised by Tustin's rule.

    The bilinear transform is prewarped at fL, so that the discrete filter is -3 dB there exactly.
    """

    bandwidth: float  # Hz, between 0 and rate/2: -3 dB frequency fL of the low pass
    rate: float  # Hz

    def __post_init__(self) -> None:
        if not 0 < self.bandwidth < self.rate / 2:
            raise ValueError(
                f"bandwidth={self.bandwidth!r} Hz must lie between 0 and half the rate, {self.rate / 2:g} Hz"
            )

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Filter coefficients b and a of eq. 4, with a[0] = 1."""
        k = np.tan(pi * self.bandwidth / self.rate)
        scale = 1 + sqrt(2) * k + k**2
        return k**2 * np.array([1, 2, 1]) / scale, np.array([scale, 2 * (k**2 - 1), 1 - sqrt(2) * k + k**2]) / scale

    @property
    def delay(self) -> float:
        """Group delay of a slow envelope, s: sqrt2/wL of the prewarped prototype."""
        return sqrt(2) / (2 * self.rate * np.tan(pi * self.bandwidth / self.rate))

    def frequency_response(self, offset: Any) -> Any:
        """Complex gain on an envelope that turns at `offset` (Hz), delay included: b(z)/a(z) on the unit circle."""
        z = np.exp(2j * pi * np.asarray(offset, float) / self.rate)
        b, a = self.coefficients
        return np.polyval(b, z) / np.polyval(a, z)
