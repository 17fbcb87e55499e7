"""Compiled tick of the paper's polar loops on the boxcar STDFT (eq. 1-3).

Carriers, targets and loops are those of ``kernels.py``; only the listening
differs.  The window holds what it hears unmirrored, so that a carrier that
turns round need not rewrite it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hapticrender._jit import kernel
from hapticrender.control.kernels import (
    COS,
    FAR,
    FORWARD,
    LOOP_ROWS,
    SIN,
    X_IM,
    X_RE,
    PolarState,
    PolarTables,
    carrier_pass,
    doubt_pass,
    follow_finger,
    listen_pass,
    open_pass,
    polar_pass,
    speak_pass,
)
from hapticrender.protocols import Array


class BoxcarTables(NamedTuple):
    """Parameters of the polar controller that listens through a window."""

    polar: PolarTables


class BoxcarState(NamedTuple):
    """State of the polar controller and of its window; changed in place."""

    polar: PolarState
    window: Array  # (length, 2 * coordinates, bands)
    total: Array  # (2, 2 * coordinates, bands) its running sum, and one summed afresh
    oldest: Array  # (1,) integer: row of the window


@kernel
def slide(window, total, at, row, k, x):
    """Mean over the window (eq. 2); once a window its sum is replaced by one summed afresh, as rounding piles up."""
    total[0, row, k] += x - window[at, row, k]
    total[1, row, k] += x
    window[at, row, k] = x
    if at == window.shape[0] - 1:
        total[0, row, k], total[1, row, k] = total[1, row, k], 0.0
    return total[0, row, k] / window.shape[0]


@kernel
def boxcar_pass(band, loop, window, total, at, c, y):
    """STDFT (eq. 1-3): envelopes X of coordinate c."""
    base = c * LOOP_ROWS
    for k in range(band.shape[1]):
        forward = band[FORWARD, k]
        loop[base + X_RE, k] = slide(window, total, at, 2 * c, k, 2.0 * y * band[COS, k])
        loop[base + X_IM, k] = forward * slide(window, total, at, 2 * c + 1, k, -2.0 * y * forward * band[SIN, k])


@kernel
def boxcar_step(tables, state, sensed, position, wanted, drive, target):
    """One sample of the whole controller: fills `drive` (channels,) and `target` (bands,), returns flags."""
    polar, own = tables.polar, state.polar
    numbers, gain, band, loop, coordinate = polar.numbers, polar.gain, own.band, own.loop, own.coordinate
    at = state.oldest[0]
    flags = listen_pass(numbers, polar.listen, sensed, coordinate)
    trust = doubt_pass(numbers, own.doubt, loop, flags)
    if not abs(wanted) <= FAR:
        wanted = 0.0
        flags |= 2
    if abs(position) > FAR:
        position = math.nan
        flags |= 2
    follow_finger(own.finger, numbers.rate, position)
    carrier_pass(numbers, polar.tone, band, loop, own.finger, wanted, target)
    for c in range(coordinate.shape[0]):
        if numbers.feedback:
            boxcar_pass(band, loop, state.window, state.total, at, c, coordinate[c])
            coordinate[c] = polar_pass(numbers, gain, band, loop, c)
        else:
            coordinate[c] = open_pass(numbers, gain, polar.lag, band, c)
    state.oldest[0] = (at + 1) % state.window.shape[0]
    return flags | speak_pass(numbers, polar.speak, coordinate, trust, drive)


@kernel
def boxcar_run(tables, state, sensed, position, wanted, drive, target, flags):
    """A block: `boxcar_step` for every row."""
    for n in range(sensed.shape[0]):
        flags[n] = boxcar_step(tables, state, sensed[n], position[n], wanted[n], drive[n], target[n])
