"""Loop shaping: the controller C of one envelope's loop, for the closed loop T and the estimator's low pass L.

The loop is that of Grigorii et al. 2021: the error between the reference and L times the envelope drives C, and C
drives the plant, which a look-up table or an inverse makes 1 (docs/theory.md, "Loop shaping").  So
``T = C/(1 + L C)`` and ``C = T/(1 - L T)``.
"""

from math import pi, sqrt
from typing import Any

from hapticrender.bands import Bands
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.control.device_model import DeviceModel
from hapticrender.errors import DesignError

Bandwidths = tuple[float, float]
Section = tuple[float, float, float, float, float]  # b0 b1 b2 a1 a2, a0 = 1
MOST_DELAY = 0.0468437
"""Longest delay times the loop's bandwidth, with a filter twice as wide.

It leaves the least margins: modulus 1/1.8, gain 2.5, phase 45 degrees; tests/test_loopshape.py derives it from them.
"""
NARROWER, SLOWEST = 0.9, 0.05  # steps in which a loop is slowed down for its delay, and how far


def reduced_controller(loop_bandwidth: float, filter_bandwidth: float) -> tuple[float, float]:
    """Solve for ki (1/s) and p (rad/s) of the controller ``ki p/(s (s + p))`` that makes T nearly a Butterworth one.

    ``ki = wT wL/(sqrt2 (wT + wL))``, ``p = sqrt2 wT wL/(wL - wT)`` for the bandwidths (Hz) of T and L: three moments of
    s C match those of T/(1 - L T) at s = 0.  A filter that is not faster than the loop is a `DesignError`: p would not
    be a stable pole.
    """
    if not 0.0 < loop_bandwidth < filter_bandwidth:
        raise DesignError(
            f"{loop_bandwidth=} Hz: must be > 0 and below {filter_bandwidth=} Hz, as it needs a filter faster than "
            "the loop: lower the one or raise the other"
        )
    wt, wl = 2 * pi * loop_bandwidth, 2 * pi * filter_bandwidth
    return wt * wl / (sqrt(2) * (wt + wl)), sqrt(2) * wt * wl / (wl - wt)


def loop_section(loop_bandwidth: float, filter_bandwidth: float, rate: float) -> Section:
    """Discretise `reduced_controller` by the bilinear transform at `rate` (Hz)."""
    (gain, pole), c = reduced_controller(loop_bandwidth, filter_bandwidth), 2 * rate
    b = gain * pole / (c * (c + pole))
    return b, 2 * b, b, -2 * c / (c + pole), (c - pole) / (c + pole)


def envelope_loop(
    model: DeviceModel,
    bands: Bands,
    *,
    boxcar: bool = False,
    bandwidths: Bandwidths | None = None,
    feedback: bool = True,
) -> tuple[dict[str, Any], float]:
    """Design the loop of one envelope for the lowest frequency, with the margins of a low-pass loop.

    Returns the settings (low pass and loop controller as second-order sections, window in samples), and the bandwidth
    (Hz) of the closed loop, lowered where the delay requires it.

    A `boxcar` estimates by a running mean over whole periods of the lowest fixed carrier, as many as one period of the
    device's lowest frequency holds: it removes that carrier's image, its harmonics' and a steady load's; its delay
    beyond the low pass's counts as the loop's.  `bandwidths` (Hz, of loop and low pass) are unchecked; by default they
    are a quarter and half of the device's lowest frequency (of a carrier below it), or less where the delay would leave
    too small a margin; a `DesignError` where even a loop twenty times slower has too small a one.  Without feedback no
    delay is in the loop.
    """
    fixed = bands.frequency[bands.wavenumber == 0.0]
    lowest = float(fixed.min(initial=model.lowest_frequency))
    carrier = float(min(fixed, default=lowest))
    length = round(carrier // lowest * model.rate / carrier) if boxcar else 0
    delay = model.delay / model.rate if feedback else 0.0
    if boxcar and feedback:
        delay += max((length - 1) / (2 * model.rate) - StarSTDFT(bandwidth=lowest / 2, rate=model.rate).delay, 0.0)
    width, wide = bandwidths or _widest(lowest, delay)
    b, a = StarSTDFT(bandwidth=wide, rate=model.rate).coefficients
    return {"low_pass": (*b, *a[1:]), "loop": loop_section(width, wide, model.rate), "window": length}, width


def _widest(lowest: float, delay: float) -> Bandwidths:
    """Widest loop (Hz), from a quarter of the lowest frequency down, that bears the delay (s); low pass."""
    width = lowest / 4
    while width * delay > MOST_DELAY:
        width *= NARROWER
        if width < SLOWEST * lowest / 4:
            last = width / NARROWER
            bound = f"must be <= {0.995 * MOST_DELAY / last:.3g} s, even with a loop of {last:.3g} Hz"  # rounded down
            raise DesignError(f"delay of {delay:.3g} s leaves too small a margin: {bound}: lower it")
    return width, 2 * width
