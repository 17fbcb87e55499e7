"""Sine, cosine and angle as polynomials, for numbers and vectors alike: the C library's cost 10 to 17 ns a call.

Coefficients interpolate at Chebyshev nodes: in x^2 of sin(2 pi x)/x and cos(2 pi x) for |x| <= 1/4, and of the latter
for |x| <= 1/2; and in t^2 of atan(t)/t and sqrt(1 + t^2) for |t| <= tan(pi/8), to which an octant shrinks when it is
turned back by half of it: its singularity at t = +-j is then so far away that a term is worth 1.4 digits, not 0.77.
The degree goes with the type: sine and cosine are good to 2.8e-15 in double and 4.3e-7 in single precision, the shorter
cosine to 1.4e-10 and 2.9e-6, the angle to 2.3e-10 and 7.8e-6 rad, the magnitude to 1.8e-10 and 8.9e-6 of itself, the
most that roundings could add included: no sensor of these envelopes is that good, and a term more of each costs 3 % of
the paper's controller.
"""

from __future__ import annotations

import math
from typing import Any

from numba.core import types

from hapticrender.compiled.jit import by_types, kernel
from hapticrender.compiled.lanes import LaneType, by_size, fraction, select, signed, size

S = (
    6.283185307179585,
    -41.341702240398284,
    81.60524927557972,
    -76.70585968962543,
    42.05868995380649,
    -15.094506137312086,
    3.8173655924824907,
    -0.6925065068391115,
)
C = (
    0.9999999999999981,
    -19.739208802174744,
    64.93939402133272,
    -85.45681703563243,
    60.244630608149656,
    -26.425888742714854,
    7.896555728040881,
    -1.645223312598949,
)
S_SHORT = (6.283185280154407, -41.34168061334652, 81.60247636892517, -76.5811726442785, 39.75982708531718)
C_SHORT = (0.9999999530275123, -19.739171209957835, 64.93457265220157, -85.23987025839904, 56.23870043529675)
A = (
    0.9999999993712274,
    -0.33333306893036774,
    0.1999818304075261,
    -0.1423953266624381,
    0.10569828793087244,
    -0.060263052137509994,
)
A_SHORT = (0.9999813450979946, -0.3313618483144449, 0.16806253719203817)
R = (
    0.9238795326722804,
    0.4619396985700442,
    -0.115480295049026,
    0.05762462199042945,
    -0.034713385758947064,
    0.01753980290023211,
)
R_SHORT = (0.9238873553347188, 0.4611142601786392, -0.10222220273104511)
W = (
    0.999999999884617,
    -19.739208743087502,
    64.9393890524762,
    -85.45665775339239,
    60.24212492771494,
    -26.404630603916303,
    7.800022165291011,
    -1.4529874920845032,
)
W_SHORT = (
    0.9999991998413434,
    -19.738978175861273,
    64.92858783993262,
    -85.27084362689533,
    58.786940762944745,
    -21.065429407375632,
)
WHOLE = 1.5 * 2.0**52  # added and taken away it leaves no fraction, of numbers up to 2^51
HALF_PI = 0.5 * math.pi
EIGHTH = math.sqrt(2.0) - 1.0  # tan(pi/8)
TINY, TINY_SHORT = 1e-150, 1e-30  # m: an envelope this small counts as none


def _short(kind: Any) -> bool:
    """Whether numbers of this type are of single precision."""
    return (kind.dtype if isinstance(kind, LaneType) else kind) == types.float32


@kernel
def whole(value, factor):  # type: ignore[no-untyped-def]
    """Nearest whole number to value * factor, up to 2^51, in double precision."""
    return (value * factor + WHOLE) - WHOLE


@kernel
def _long_unit(turns):  # type: ignore[no-untyped-def]
    """`unit` in double precision."""
    x = fraction(turns)
    far = size(x) > 0.25
    x = select(far, select(x > 0.0, 0.5, -0.5) - x, x)
    u = x * x
    u2 = u * u
    s = (S[0] + S[1] * u) + (S[2] + S[3] * u) * u2 + ((S[4] + S[5] * u) + (S[6] + S[7] * u) * u2) * (u2 * u2)
    c = (C[0] + C[1] * u) + (C[2] + C[3] * u) * u2 + ((C[4] + C[5] * u) + (C[6] + C[7] * u) * u2) * (u2 * u2)
    return select(far, -c, c), s * x


@kernel
def _short_unit(turns):  # type: ignore[no-untyped-def]
    """`unit` in single precision."""
    x = fraction(turns)
    far = size(x) > 0.25
    x = select(far, select(x > 0.0, 0.5, -0.5) - x, x)
    u = x * x
    s = S_SHORT[0] + u * (S_SHORT[1] + u * (S_SHORT[2] + u * (S_SHORT[3] + u * S_SHORT[4])))
    c = C_SHORT[0] + u * (C_SHORT[1] + u * (C_SHORT[2] + u * (C_SHORT[3] + u * C_SHORT[4])))
    return select(far, -c, c), s * x


@by_types
def unit(turns: Any) -> Any:
    """Cosine and sine of 2 pi `turns`, of any size that still knows its fraction."""
    return _short_unit if _short(turns) else _long_unit


@kernel
def _long_cosine(turns):  # type: ignore[no-untyped-def]
    """`cosine` in double precision."""
    x = fraction(turns)
    u = x * x
    u2 = u * u
    late = (W[4] + W[5] * u) + (W[6] + W[7] * u) * u2
    return (W[0] + W[1] * u) + u2 * ((W[2] + W[3] * u) + u2 * late)


@kernel
def _short_cosine(turns):  # type: ignore[no-untyped-def]
    """`cosine` in single precision."""
    x = fraction(turns)
    u = x * x
    w = W_SHORT[2] + u * (W_SHORT[3] + u * (W_SHORT[4] + u * W_SHORT[5]))
    return W_SHORT[0] + u * (W_SHORT[1] + u * w)


@by_types
def cosine(turns: Any) -> Any:
    """Cosine of 2 pi `turns`, like that of `unit` but with fewer digits."""
    return _short_cosine if _short(turns) else _long_cosine


@kernel
def _long_polar(im, re):  # type: ignore[no-untyped-def]
    """`polar` in double precision."""
    re = re + TINY
    larger, smaller = by_size(im, re)
    x = larger + EIGHTH * smaller
    t = (smaller - EIGHTH * larger) / x
    u = t * t
    u2 = u * u
    r = x * ((R[0] + R[1] * u) + u2 * ((R[2] + R[3] * u) + u2 * (R[4] + R[5] * u)))
    p = 0.25 * HALF_PI + t * ((A[0] + A[1] * u) + u2 * ((A[2] + A[3] * u) + u2 * (A[4] + A[5] * u)))
    p = signed(select(larger > size(re), HALF_PI - p, p), im)
    return r, select(re < 0.0, -2.0 * HALF_PI - p, p)


@kernel
def _short_polar(im, re):  # type: ignore[no-untyped-def]
    """`polar` in single precision."""
    re = re + TINY_SHORT
    larger, smaller = by_size(im, re)
    x = larger + EIGHTH * smaller
    t = (smaller - EIGHTH * larger) / x
    u = t * t
    r = x * (R_SHORT[0] + u * (R_SHORT[1] + u * R_SHORT[2]))
    p = 0.25 * HALF_PI + t * (A_SHORT[0] + u * (A_SHORT[1] + u * A_SHORT[2]))
    p = signed(select(larger > size(re), HALF_PI - p, p), im)
    return r, select(re < 0.0, -2.0 * HALF_PI - p, p)


@by_types
def polar(im: Any, re: Any) -> Any:
    """Magnitude of re + j im and its angle (rad, cut at a quarter turn: above -3/2 pi, up to pi/2; 0 for 0)."""
    return _short_polar if _short(im) else _long_polar
