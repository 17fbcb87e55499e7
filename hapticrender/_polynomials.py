"""Sine, cosine and angle as polynomials, for numbers and vectors alike: the C library's cost 10 to 17 ns a call.

Coefficients interpolate at Chebyshev nodes: in x^2 of sin(2 pi x)/x and cos(2 pi x) for |x| <= 1/4, and in t^2 of
atan(t)/t and sqrt(1 + t^2) for |t| <= 1.  The degree goes with the type: sine and cosine are good to 2.2e-15 in double
and 2e-7 in single precision, the angle to 4e-11 and 4e-7 rad, the magnitude to 2e-11 and 3e-7 of itself.
"""

from __future__ import annotations

import math
from typing import Any

from numba.core import types

from hapticrender._jit import by_types, kernel
from hapticrender._lanes import LaneType, high, low, nearest, select, size

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
    0.9999999999293037,
    -0.3333333129088999,
    0.19999901102171566,
    -0.1428381325574332,
    0.11091922963683955,
    -0.08974171958365748,
    0.07228278345380153,
    -0.05395668057139031,
    0.033826218952776495,
    -0.01582832274912274,
    0.0047324841934043614,
    -0.0006633954571063534,
)
A_SHORT = (
    0.9999998819964931,
    -0.3333181265562783,
    0.19966961829591534,
    -0.14003290184652264,
    0.0986886545813245,
    -0.0588297531430651,
    0.023780518597165685,
    -0.004559791986130401,
)
R = (
    1.0000000000147595,
    0.49999999573668286,
    -0.12499979375491127,
    0.062496042348161536,
    -0.0390226609832503,
    0.02710234733592613,
    -0.019553882124309464,
    0.01352321027069434,
    -0.008065036427080693,
    0.0036568570008333502,
    -0.0010718515375976211,
    0.00014833450119119404,
)
R_SHORT = (
    1.0000000312900168,
    0.4999959701462716,
    -0.12491270664306559,
    0.061758064885640854,
    -0.035830959648051434,
    0.019134855550508964,
    -0.007282173243121042,
    0.0013504976258104989,
)
WHOLE = 1.5 * 2.0**52  # added and taken away it leaves no fraction, of numbers up to 2^51
HALF_PI = 0.5 * math.pi


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
    x = turns - nearest(turns)
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
    x = turns - nearest(turns)
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
def _long_polar(im, re):  # type: ignore[no-untyped-def]
    """`polar` in double precision."""
    across, along = size(im), size(re)
    steep, larger = across > along, high(across, along)
    t = low(across, along) / high(larger, 1e-300)
    u = t * t
    u2 = u * u
    u4 = u2 * u2
    p = (A[0] + A[1] * u) + (A[2] + A[3] * u) * u2 + ((A[4] + A[5] * u) + (A[6] + A[7] * u) * u2) * u4
    p = t * (p + ((A[8] + A[9] * u) + (A[10] + A[11] * u) * u2) * (u4 * u4))
    r = (R[0] + R[1] * u) + (R[2] + R[3] * u) * u2 + ((R[4] + R[5] * u) + (R[6] + R[7] * u) * u2) * u4
    r += ((R[8] + R[9] * u) + (R[10] + R[11] * u) * u2) * (u4 * u4)
    p = select(steep, HALF_PI - p, p)
    p = select(re < 0.0, 2.0 * HALF_PI - p, p)
    return larger * r, select(im < 0.0, -p, p)


@kernel
def _short_polar(im, re):  # type: ignore[no-untyped-def]
    """`polar` in single precision."""
    across, along = size(im), size(re)
    steep, larger = across > along, high(across, along)
    t = low(across, along) / high(larger, 1e-30)
    u = t * t
    u2 = u * u
    u4 = u2 * u2
    p = (A_SHORT[0] + A_SHORT[1] * u) + (A_SHORT[2] + A_SHORT[3] * u) * u2
    p = t * (p + ((A_SHORT[4] + A_SHORT[5] * u) + (A_SHORT[6] + A_SHORT[7] * u) * u2) * u4)
    r = (R_SHORT[0] + R_SHORT[1] * u) + (R_SHORT[2] + R_SHORT[3] * u) * u2
    r += ((R_SHORT[4] + R_SHORT[5] * u) + (R_SHORT[6] + R_SHORT[7] * u) * u2) * u4
    p = select(steep, HALF_PI - p, p)
    p = select(re < 0.0, 2.0 * HALF_PI - p, p)
    return larger * r, select(im < 0.0, -p, p)


@by_types
def polar(im: Any, re: Any) -> Any:
    """Magnitude of re + j im and its angle (rad, -pi to pi; 0 for 0)."""
    return _short_polar if _short(im) else _long_polar
