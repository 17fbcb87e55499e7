"""Loop shaping: the controller C of one envelope's loop, for the closed loop T and the estimator's low pass L.

The loop is that of Grigorii et al. 2021: the error between the reference and L times the envelope drives C, and C
drives the plant, which a look-up table or an inverse makes 1 (docs/theory.md, "Loop shaping").  So
``T = C/(1 + L C)`` and ``C = T/(1 - L T)``.
"""

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.margins import LEAST, Margins, margins_of, unstable_poles
from hapticrender.errors import DesignError
from hapticrender.mathx import zero_crossings
from hapticrender.protocols import Array

Bandwidths = tuple[float, float]
Section = tuple[float, float, float, float, float]  # b0 b1 b2 a1 a2, a0 = 1
BESIDE = 1e-6  # 1/s: distance of Nyquist's contour from the imaginary axis, right of the integrator
NARROWER, SLOWEST = 0.9, 0.05  # steps in which a loop is slowed down for its delay, and how far


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

    def __mul__(self, other: "TransferFunction") -> "TransferFunction":
        return TransferFunction(
            tuple(np.polymul(self.numerator, other.numerator)), tuple(np.polymul(self.denominator, other.denominator))
        )

    def poles(self) -> Array:
        """Poles (rad/s, complex)."""
        return np.roots(self.denominator)

    def frequency_response(self, frequency: Any) -> Any:
        """Complex response at `frequency` (Hz)."""
        return self(2j * np.pi * np.asarray(frequency, float))

    def tustin(self, rate: float) -> tuple[Array, Array]:
        """Discretise by the bilinear transform at `rate` (Hz): b and a of z^-k, shape (order + 1,), a[0] = 1."""
        from scipy.signal import bilinear  # takes a second to import

        size = np.frexp(self(2 * rate))[1]  # scipy drops what is small beside 1 from the start of b; b[0] is H(2 rate)
        b, a = bilinear(np.ldexp(self.numerator, -size), self.denominator, rate)
        return np.ldexp(b, size), a


def butterworth(bandwidth: float) -> TransferFunction:
    """Second-order Butterworth low pass, ``w^2/(s^2 + sqrt2 w s + w^2)``, -3 dB at `bandwidth` w/(2 pi) (Hz, > 0)."""
    w = 2 * np.pi * bandwidth
    return TransferFunction((w**2,), (1.0, sqrt(2) * w, w**2))


def reduced_controller(loop_bandwidth: float, filter_bandwidth: float) -> TransferFunction:
    """Solve for the second-order controller ``ki p/(s (s + p))`` that makes the closed loop nearly a Butterworth T.

    ``ki = wT wL/(sqrt2 (wT + wL))``, ``p = sqrt2 wT wL/(wL - wT)`` for the bandwidths (Hz) of T and L: three moments of
    s C match those of T/(1 - L T) at s = 0.  A filter that is not faster than the loop is a `DesignError`: p would not
    be a stable pole.
    """
    if not 0.0 < loop_bandwidth < filter_bandwidth:
        raise DesignError(
            f"{loop_bandwidth=} Hz: must be > 0 and below {filter_bandwidth=} Hz, as it needs a filter faster than "
            "the loop: lower the one or raise the other"
        )
    wt, wl = 2 * np.pi * loop_bandwidth, 2 * np.pi * filter_bandwidth
    gain, pole = wt * wl / (sqrt(2) * (wt + wl)), sqrt(2) * wt * wl / (wl - wt)
    return TransferFunction((gain * pole,), (1.0, pole, 0.0))


def loop_margins(rational: TransferFunction, delay: float = 0.0) -> Margins:
    """Compute the margins of the loop L C of one envelope: `rational`, stable but for integrators, and a `delay` (s).

    They come from a logarithmic grid of 20001 frequencies; linear interpolation between them errs by less than 1e-6.
    A delay below 0, and a gain |L C| that never crosses 1, are a ValueError.
    """
    if not (np.isfinite(delay) and delay >= 0):
        raise ValueError(f"{delay=} s must be finite and >= 0")

    def loop(s: Array) -> Any:
        return rational(s) * np.exp(-delay * s)

    polynomials = rational.numerator, rational.denominator, np.polyadd(rational.numerator, rational.denominator)
    corners = np.abs(np.concatenate([np.roots(polynomial) for polynomial in polynomials])) / (2 * np.pi)
    corners = corners[corners > 1e-9 * corners.max()]  # of the open and the closed loop
    frequency = np.geomspace(1e-3 * corners.min(), 1e3 * corners.max(), 20001)
    gain = np.abs(rational.frequency_response(frequency))
    if not zero_crossings(np.log(gain)).size:
        raise ValueError(f"the loop gain never crosses 1 (largest {gain.max():.3g}): the loop has no margins")
    if unstable_poles(lambda f: 1 + loop(BESIDE + 2j * np.pi * f), np.append(0.0, frequency)):
        return Margins.unstable()
    return margins_of(lambda f: loop(2j * np.pi * f)[:, None, None], frequency)


def envelope_loop(
    model: DeviceModel,
    bands: Bands,
    *,
    boxcar: bool = False,
    bandwidths: Bandwidths | None = None,
    feedback: bool = True,
) -> tuple[dict[str, Any], float]:
    """Design the loop of one envelope for the lowest carrier, with the margins of a low-pass loop.

    Returns the settings (low pass and loop controller as second-order sections, window in samples), and the bandwidth
    (Hz) of the closed loop, lowered where the delay requires it.

    A `boxcar` estimates by a running mean over one period of the lowest carrier, which removes the image of that
    carrier and of its harmonics; its delay beyond the low pass's counts as the loop's.  `bandwidths` (Hz, of loop and
    low pass) are unchecked; by default they are a quarter and half of the lowest carrier, or less where the delay would
    leave too small a margin; a `DesignError` where even a loop twenty times slower has too small a one.  Without
    feedback no delay is in the loop.
    """
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = float(fixed.min(initial=model.lowest_frequency))
    length = round(model.rate / lowest) if boxcar else 0
    delay = model.delay / model.rate if feedback else 0.0
    if boxcar and feedback:
        delay += max((length - 1) / (2 * model.rate) - StarSTDFT(bandwidth=lowest / 2, rate=model.rate).delay, 0.0)
    width, wide = bandwidths or _widest(lowest, delay)
    low_pass, law = StarSTDFT(bandwidth=wide, rate=model.rate), reduced_controller(width, wide)
    found = {"low_pass": section(low_pass.coefficients), "loop": section(law.tustin(model.rate)), "window": length}
    return found, width


def _widest(lowest: float, delay: float) -> Bandwidths:
    """Widest loop (Hz), from a quarter of the lowest carrier down, whose margins hold with the delay (s); low pass."""
    width = lowest / 4
    while True:
        loop = reduced_controller(width, 2 * width) * butterworth(2 * width)
        complaint = LEAST["envelope"].complaint(loop_margins(loop, delay))
        if not complaint:
            return width, 2 * width
        width *= NARROWER
        if width < SLOWEST * lowest / 4:
            raise DesignError(f"{complaint} even with a loop of {width:.3g} Hz: lower the delay of {delay:.3g} s")


def section(coefficients: tuple[Array, Array]) -> Section:
    """At most second-order (b, a) with a0 = 1 as five numbers."""
    b, a = (np.pad(part, (0, 3 - len(part))) for part in coefficients)
    b0, b1, b2, a1, a2 = (float(value) for value in (*b, *a[1:]))
    return b0, b1, b2, a1, a2
