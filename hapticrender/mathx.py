"""Mathematics that several packages need: design-time functions in numpy, and their compiled counterparts."""

import math

import numpy as np

from hapticrender.jit import kernel
from hapticrender.protocols import Array
from hapticrender.vectors import imag, magnitude, maximum, minimum, nearest, pair, real, where

# design time: numpy and scipy


def state_space(mass: Array, damping: Array, stiffness: Array, inputs: Array) -> tuple[Array, Array]:
    """Matrices a (2n, 2n) and b (2n, m) of (q, q') with M q'' + C q' + K q = inputs u."""
    n, inverse = len(mass), np.linalg.inv(mass)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    return a, np.vstack([np.zeros_like(inputs), inverse @ inputs])


def zoh(a: Array, b: Array, period: float) -> tuple[Array, Array]:
    """Discretise x' = a x + b u, a (n, n) and b (n, m), with the input held over each sample of a `period` (s).

    Returns the matrices of x[k+1] = ad x[k] + bd u[k], of the same shapes, exact.

    References
    ----------
    Van Loan, Computing integrals involving the matrix exponential, IEEE Transactions on Automatic Control 23, 1978.
    Higham, Functions of matrices, SIAM 2008, section 10.3: scaling and squaring.
    """
    n, m = b.shape
    augmented = np.zeros((n + m, n + m))
    augmented[:n] = period * np.hstack([a, b])
    halvings = max(math.ceil(math.log2(np.abs(augmented).sum(axis=0).max() + 1e-300)) + 1, 0)
    found = term = np.eye(n + m)
    for k in range(1, 16):  # norm <= 1/2; scipy's `expm` starts BLAS's threads: 10 ms on a busy machine
        term = term @ augmented / (k * 2.0**halvings)
        found = found + term
    for _ in range(halvings):
        found = found @ found
    return found[:n, :n], found[:n, n:]


def foh(a: Array, b: Array, period: float) -> Array:
    """Discretise x' = a x + b u, shapes as of `zoh`, with the input running linearly from sample to sample.

    Returns the matrix of x[k+1] by x[k], u[k] and u[k+1], shape (n, n + 2 m), exact.
    """
    n, m = b.shape
    slope = np.vstack([np.zeros((n, m)), np.eye(m) / period])
    whole, rise = zoh(np.block([[a, b], [np.zeros((m, n + m))]]), slope, period)
    return np.hstack([whole[:n, :n], whole[:n, n:] - rise[:n], rise[:n]])


def on_time(values: Array, count: int, late: float) -> Array:
    """First `count` rows of a signal (n, k), n >= count + late, that comes `late` samples late.

    Between samples it is on a line, at the frequency w too small by w^2 T^2/8 at most.
    """
    if late == 0.0 or not count:
        return values[:count]
    at, known = np.arange(count) + late, np.arange(len(values))
    return np.stack([np.interp(at, known, each) for each in values.T], axis=1)


def zero_crossings(values: Array) -> Array:
    """Find the fractional indices at which `values`, shape (n,), change sign, by linear interpolation."""
    before = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return before + values[before] / (values[before] - values[before + 1])


def smoothstep(x: Array) -> Array:
    """Third-order step from 0 to 1 over 0..1: x^2 (3 - 2 x), x clipped to that range."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


# compiled functions; each is written so that a loop over bands vectorises around it

TURN = 2.0 * math.pi
SIN = (  # in x^2, of sin(2 pi x)/x for |x| <= 1/4, by interpolation at Chebyshev nodes: good to 2.8e-15
    6.283185307179585,
    -41.341702240398284,
    81.60524927557972,
    -76.70585968962543,
    42.05868995380649,
    -15.094506137312086,
    3.8173655924824907,
    -0.6925065068391115,
)
COS = (  # in x^2, of cos(2 pi x) for |x| <= 1/4
    0.9999999999999981,
    -19.739208802174744,
    64.93939402133272,
    -85.45681703563243,
    60.244630608149656,
    -26.425888742714854,
    7.896555728040881,
    -1.645223312598949,
)


ATAN = (  # in t^2, of atan(t)/t for |t| <= tan(pi/8), by interpolation at Chebyshev nodes: the angle is good to 2.3e-10
    0.9999999993712274,
    -0.33333306893036774,
    0.1999818304075261,
    -0.1423953266624381,
    0.10569828793087244,
    -0.060263052137509994,
)
CHORD = (  # in t^2, of cos(pi/8) sqrt(1 + t^2) in the same range: the magnitude is good to 1.8e-10 of itself
    0.9238795326722804,
    0.4619396985700442,
    -0.115480295049026,
    0.05762462199042945,
    -0.034713385758947064,
    0.01753980290023211,
)
EIGHTH = math.sqrt(2.0) - 1.0  # tan(pi/8)
LEAST = 1e-150  # added to the real part: the angle of 0 is 0


@kernel
def unit(turns):
    """e^(2 pi j turns) of a vector."""
    x = turns - nearest(turns)
    far = magnitude(x) > 0.25
    x = where(far, where(x > 0.0, 0.5, -0.5) - x, x)
    u = x * x
    s = SIN[0] + u * (SIN[1] + u * (SIN[2] + u * (SIN[3] + u * (SIN[4] + u * (SIN[5] + u * (SIN[6] + u * SIN[7]))))))
    c = COS[0] + u * (COS[1] + u * (COS[2] + u * (COS[3] + u * (COS[4] + u * (COS[5] + u * (COS[6] + u * COS[7]))))))
    return pair(where(far, -1.0 * c, c), s * x)


@kernel
def polar(z):
    """Magnitude of a complex vector and its angle (rad), above -3/2 pi up to pi/2.

    An octant, turned back by half of it, leaves |t| <= tan(pi/8) to the polynomials.
    """
    re = real(z) + LEAST
    x, y = magnitude(re), magnitude(imag(z))
    larger, smaller = maximum(x, y), minimum(x, y)
    base = larger + EIGHTH * smaller
    t = (smaller - EIGHTH * larger) / base
    u = t * t
    size = CHORD[0] + u * (CHORD[1] + u * (CHORD[2] + u * (CHORD[3] + u * (CHORD[4] + u * CHORD[5]))))
    angle = ATAN[0] + u * (ATAN[1] + u * (ATAN[2] + u * (ATAN[3] + u * (ATAN[4] + u * ATAN[5]))))
    angle = TURN / 16.0 + t * angle
    angle = where(y > x, 0.25 * TURN - angle, angle)
    angle = where(imag(z) < 0.0, -1.0 * angle, angle)
    return base * size, where(re < 0.0, -0.5 * TURN - angle, angle)


@kernel
def smooth(x):
    """Third-order step of a vector from 0 to 1 over 0..1: x^2 (3 - 2 x)."""
    x = minimum(maximum(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
