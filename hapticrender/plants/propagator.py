"""What one sample does to the plate, exactly: z grows to Phi z + Gamma f, Phi = e^A, Gamma = (1 + A/2! + A^2/3! ...) B.

A depends on the finger's place and grip.  While both stay, Phi and Gamma stay.  While the finger slides with the same
grip, they are polynomials in its place, good to rounding over a window around it; else they are summed anew, term by
term, as many as rounding asks for.  Which way is taken depends on the state alone, so that a run equals its pieces.

Columns of Phi (8) and Gamma (3) are rows of eight lanes, so that a sample costs eleven products.
"""

from __future__ import annotations

import math

import numpy as np

from hapticrender._jit import kernel
from hapticrender._lanes import aligned, any_of, lanes, put, size
from hapticrender.protocols import Array

STATES, FORCES = 8, 3
COLUMNS = STATES + FORCES
NODES = 7  # of the polynomial in the place
WIDEST, NARROWEST = 0.06, 0.006  # half the window's width, in units of p/a
LEAST_STAY = 16  # samples that the finger must stay in half a window, at its present speed, for one to pay
EXACT = 2e-15  # largest error of the polynomial at a place between its nodes, relative to a state
PLACES = tuple(math.sin(math.pi * (m - NODES // 2) / NODES) for m in range(NODES))  # Chebyshev's nodes, 0 among them
TRIAL = math.cos(math.pi / NODES)  # between the outermost two nodes
_POWERS = np.linalg.inv(np.vander(PLACES, increasing=True))
FROM_VALUES = tuple(tuple(float(share) for share in line) for line in _POWERS)  # powers of the place from the nodes
# entries of PlateState.window: its middle, half its width, the grip it holds for (negative: it is shut)
MIDDLE, WIDTH, GRIP = range(3)


def identity() -> Array:
    """Phi of no time at all, shape (1, 8, 8)."""
    one = aligned((1, STATES, STATES))
    one[0] = np.eye(STATES)
    return one


@kernel
def sum_series(terms, flexible, a, push, one, out, at):
    """Phi and Gamma of the system `a`, `push` from `terms` terms, into row block `at` of `out`; `one` is the identity.

    T_n = T_(n-1) A / n column by column; A is empty but for the rows of the rates and a shift.
    """
    t0, t1, t2, t3 = lanes(one, 0, 0), lanes(one, 0, 1), lanes(one, 0, 2), lanes(one, 0, 3)
    t4, t5, t6, t7 = lanes(one, 0, 4), lanes(one, 0, 5), lanes(one, 0, 6), lanes(one, 0, 7)
    p0, p1, p2, p3, p4, p5, p6, p7 = t0, t1, t2, t3, t4, t5, t6, t7
    heave = rock = bend = 0.0 * t0
    for n in range(1, terms + 1):
        s = 1.0 / n
        heave, rock = heave + s * t3, rock + s * t4
        n0 = t3 * a[3, 0] + t4 * a[4, 0] + t5 * a[5, 0]
        n1 = t3 * a[3, 1] + t4 * a[4, 1] + t5 * a[5, 1]
        n2 = t3 * a[3, 2] + t4 * a[4, 2] + t5 * a[5, 2]
        n3 = t3 * a[3, 3] + t4 * a[4, 3] + (t5 * a[5, 3] + t0)
        n4 = t3 * a[3, 4] + t4 * a[4, 4] + (t5 * a[5, 4] + t1)
        n5 = t3 * a[3, 5] + t4 * a[4, 5] + (t5 * a[5, 5] + t2 * a[2, 5])
        if flexible:
            bend += s * t7
            n6 = t3 * a[3, 6] + t4 * a[4, 6] + (t5 * a[5, 6] + t7 * a[7, 6])
            n7 = t3 * a[3, 7] + t4 * a[4, 7] + (t5 * a[5, 7] + t7 * a[7, 7]) + t6
            n0, n1, n2 = n0 + t7 * a[7, 0], n1 + t7 * a[7, 1], n2 + t7 * a[7, 2]
            n3, n4, n5 = n3 + t7 * a[7, 3], n4 + t7 * a[7, 4], n5 + t7 * a[7, 5]
            t6, t7 = s * n6, s * n7
            p6, p7 = p6 + t6, p7 + t7
        t0, t1, t2, t3, t4, t5 = s * n0, s * n1, s * n2, s * n3, s * n4, s * n5
        p0, p1, p2, p3, p4, p5 = p0 + t0, p1 + t1, p2 + t2, p3 + t3, p4 + t4, p5 + t5
    put(out, at, 0, p0)
    put(out, at, 1, p1)
    put(out, at, 2, p2)
    put(out, at, 3, p3)
    put(out, at, 4, p4)
    put(out, at, 5, p5)
    put(out, at, 6, p6)
    put(out, at, 7, p7)
    for f in range(FORCES):
        put(out, at, STATES + f, heave * push[0, f] + rock * push[1, f] + bend * push[2, f])


@kernel
def to_powers(nodes, powers):
    """Coefficients of the polynomials through the values at the nodes; taken about the middle, so that none cancels."""
    middle = NODES // 2
    for j in range(COLUMNS):
        for n in range(1, NODES):
            value = 0.0 * lanes(nodes, middle, j)
            for m in range(NODES):
                value += FROM_VALUES[n][m] * (lanes(nodes, m, j) - lanes(nodes, middle, j))
            put(powers, n, j, value)
        put(powers, 0, j, lanes(nodes, middle, j))


@kernel
def interpolate(flexible, powers, x, out):
    """Phi and Gamma at `x`, -1 to 1 over the window."""
    for j in range(COLUMNS):
        if not flexible and (6 <= j < 8 or j == 10):
            continue  # rigid glass: columns 6, 7 and the last force stay as they are
        value = lanes(powers, NODES - 1, j)
        for n in range(NODES - 2, -1, -1):
            value = lanes(powers, n, j) + x * value
        put(out, 0, j, value)


@kernel
def agree(one, other):
    """Whether two propagators differ by no more than rounding."""
    for j in range(COLUMNS):
        if any_of(size(lanes(one, 0, j) - lanes(other, 0, j)) > EXACT):
            return False
    return True


@kernel
def propagate(flexible, step, z, force0, force1, force2):
    """Replace z by Phi z + Gamma f."""
    first = lanes(step, 0, 0) * z[0, 0, 0] + lanes(step, 0, 4) * z[0, 0, 4]
    second = lanes(step, 0, 1) * z[0, 0, 1] + lanes(step, 0, 5) * z[0, 0, 5]
    third = lanes(step, 0, 2) * z[0, 0, 2] + lanes(step, 0, 8) * force0
    fourth = lanes(step, 0, 3) * z[0, 0, 3] + lanes(step, 0, 9) * force1
    if flexible:
        third += lanes(step, 0, 6) * z[0, 0, 6] + lanes(step, 0, 10) * force2
        fourth += lanes(step, 0, 7) * z[0, 0, 7]
    put(z, 0, 0, (first + second) + (third + fourth))
