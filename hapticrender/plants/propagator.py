"""What one sample does to the plate, exactly: z grows to Phi z + Gamma f, Phi = e^A, Gamma = (1 + A/2! + A^2/3! ...) B.

A depends on the finger's place and grip.  While both stay, Phi and Gamma stay.  While the finger slides with the same
grip, they are polynomials in its place, good to rounding over a window around it; else they are summed anew.  Which
way is taken depends on the state alone, so that a run equals its pieces.

Matrices are kept column by column, a column of eight states in eight lanes: Phi (8 columns) and Gamma (3) make a sample
cost eleven products, nine where the glass is rigid.
"""

from __future__ import annotations

import math

import numpy as np

from hapticrender.compiled.jit import kernel, late
from hapticrender.compiled.lanes import aligned, any_of, size
from hapticrender.compiled.lanes_memory import lanes, put, read, write
from hapticrender.protocols import Array

STATES, RIGID, FORCES = 8, 6, 3  # states; how many of them move where the glass is rigid; columns of Gamma
COLUMNS = STATES + FORCES
NODES = 7  # of the polynomial in the place
TRIAL = NODES  # row block of the propagator that the polynomial is tried against
WIDEST, NARROWER, NARROWEST = 0.16, 0.75, 0.004  # half the window's width (units of p/a), and how it shrinks
LEAST_STAY = 16  # samples that the finger must stay in half a window, at its present speed, for one to pay
EXACT = 2e-15  # largest error of the polynomial at a place between its nodes, relative to a state
PLACES = (
    *(math.sin(math.pi * (m - NODES // 2) / NODES) for m in range(NODES)),  # Chebyshev's nodes, 0 among them
    math.cos(math.pi / NODES),  # between the outermost two nodes
)
HALF = NODES // 2
_ODD = np.vander(np.square(PLACES[:HALF]), increasing=True) * np.reshape(PLACES[:HALF], (-1, 1))
_EVEN = np.vander(np.square(PLACES[:HALF]), increasing=True) * np.reshape(np.square(PLACES[:HALF]), (-1, 1))
# odd and even powers of the place from differences and sums across the middle
ODD = tuple(tuple(float(share) for share in line) for line in np.linalg.inv(-2 * _ODD))
EVEN = tuple(tuple(float(share) for share in line) for line in np.linalg.inv(2 * _EVEN))
# entries of PlateState.window: its middle, half its width, the grip it holds for (negative: it is shut)
MIDDLE, WIDTH, GRIP = range(3)
LEVER, STRENGTH = range(2)  # entries of PlateState.frozen and .seen


def identity() -> Array:
    """Phi of no time at all, shape (8, 8)."""
    one = aligned((STATES, STATES))
    one[:] = np.eye(STATES)
    return one


def shifts() -> Array:
    """A of a plate without forces, shape (8, 8), column by column: displacements grow by their rates."""
    system = aligned((STATES, STATES))
    for displacement, rate in ((0, 3), (1, 4), (2, 5), (6, 7)):
        system[rate, displacement] = 1.0
    return system


@kernel
def columns(matrix):
    """The columns of a matrix, to hold in registers."""
    return (
        read(matrix, 0),
        read(matrix, 1),
        read(matrix, 2),
        read(matrix, 3),
        read(matrix, 4),
        read(matrix, 5),
        read(matrix, 6),
        read(matrix, 7),
    )


@kernel
def product(flexible, left, right, j):
    """Column j of the product of two matrices, the left one given by its `columns`."""
    early = left[0] * read(right, j, 0) + left[1] * read(right, j, 1) + left[2] * read(right, j, 2)
    late = left[3] * read(right, j, 3) + left[4] * read(right, j, 4) + left[5] * read(right, j, 5)
    if flexible:
        early += left[6] * read(right, j, 6)
        late += left[7] * read(right, j, 7)
    return early + late


@kernel
def sum_series(terms, flexible, state, out, at):
    """Phi and Gamma of `state.system` and `state.push` from `terms` terms, into row block `at` of `out`.

    With G = 1 + A/2! + A^2/3! ..., Phi = 1 + G A and Gamma = G B.  Three terms of G at a time, from the last:
    G_k = 1 + A/n + A^2/(n (n + 1)) + G_(k+1) A^3/(n (n + 1) (n + 2)), n = 3 k + 2, and G = G_0.
    """
    one, a, square, cube, g = state.one, state.system, state.square, state.cube, state.series
    many = STATES if flexible else RIGID
    left = columns(a)
    for j in range(many):
        write(product(flexible, left, a, j), square, j)
    left = columns(square)
    for j in range(many):
        write(product(flexible, left, a, j), cube, j)
    left = columns(one)
    for k in range((terms - 2) // 3, -1, -1):
        n = 3.0 * k + 2.0
        s, s2, s3 = 1.0 / n, 1.0 / (n * (n + 1.0)), 1.0 / (n * (n + 1.0) * (n + 2.0))
        for j in range(many):
            write((read(one, j) + s * read(a, j) + s2 * read(square, j)) + s3 * product(flexible, left, cube, j), g, j)
        left = columns(g)
    for j in range(many):
        put(out, at, j, read(one, j) + product(flexible, left, a, j))
    for f in range(FORCES):
        moved = left[3] * read(state.push, f, 0) + left[4] * read(state.push, f, 1)
        if flexible:
            moved += left[7] * read(state.push, f, 2)
        put(out, at, STATES + f, moved)


@kernel
def to_powers(flexible, nodes, powers):
    """Coefficients of the polynomials through the values at the nodes; taken about the middle, so that none cancels."""
    for j in range(COLUMNS):
        if RIGID <= j < STATES and not flexible:
            continue
        middle = lanes(nodes, HALF, j)
        put(powers, 0, j, middle)
        for m in range(HALF):
            below, above = lanes(nodes, m, j) - middle, lanes(nodes, NODES - 1 - m, j) - middle
            put(powers, 2 * m + 1, j, above - below)
            put(powers, 2 * m + 2, j, above + below)
        o0, o1, o2 = lanes(powers, 1, j), lanes(powers, 3, j), lanes(powers, 5, j)
        e0, e1, e2 = lanes(powers, 2, j), lanes(powers, 4, j), lanes(powers, 6, j)
        for n in range(HALF):
            put(powers, 2 * n + 1, j, ODD[n][0] * o0 + ODD[n][1] * o1 + ODD[n][2] * o2)
            put(powers, 2 * n + 2, j, EVEN[n][0] * e0 + EVEN[n][1] * e1 + EVEN[n][2] * e2)


@kernel
def polynomial(powers, j, x):
    """Column j of Phi and Gamma at `x`, -1 to 1 over the window."""
    value = lanes(powers, NODES - 1, j)
    for n in range(NODES - 2, -1, -1):
        value = lanes(powers, n, j) + x * value
    return value


@late
def interpolate(flexible, powers, x, out):
    """Phi and Gamma at `x`; rigid glass leaves the columns of its bending as they are."""
    for j in range(RIGID):
        put(out, 0, j, polynomial(powers, j, x))
    for j in range(STATES, COLUMNS):
        put(out, 0, j, polynomial(powers, j, x))
    if flexible:
        for j in range(RIGID, STATES):
            put(out, 0, j, polynomial(powers, j, x))


@kernel
def exact(flexible, powers, nodes):
    """Whether the polynomials meet the propagator on trial to rounding."""
    for j in range(COLUMNS):
        if RIGID <= j < STATES and not flexible:
            continue
        if any_of(size(polynomial(powers, j, PLACES[TRIAL]) - lanes(nodes, TRIAL, j)) > EXACT):
            return False
    return True


@kernel
def kept(step, j, x):
    """Column j of Phi and Gamma as they are kept."""
    return lanes(step, 0, j)


@kernel
def propagate(column, flexible, source, x, z, common, opposed, weight):
    """Replace z by Phi z + Gamma f, of which `column(source, j, x)` gives the columns."""
    first = column(source, 0, x) * read(z, 0, 0) + column(source, 4, x) * read(z, 0, 4)
    second = column(source, 1, x) * read(z, 0, 1) + column(source, 5, x) * read(z, 0, 5)
    third = column(source, 8, x) * common + column(source, 2, x) * read(z, 0, 2)
    fourth = column(source, 9, x) * opposed + column(source, 10, x) * weight + column(source, 3, x) * read(z, 0, 3)
    if flexible:
        third += column(source, 6, x) * read(z, 0, 6)
        fourth += column(source, 7, x) * read(z, 0, 7)
    write((first + second) + (third + fourth), z, 0)
