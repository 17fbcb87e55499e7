"""Parameters and state of the band bank's compiled step.

Everything a band owns is a column of rows named in `rows`, W columns to a tile (`compiled.lanes`).  What a
scenario owns is a plain number, or a row of W scenarios side by side: then a lane of a tile is a scenario, and a tile
one band of each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hapticrender.compiled.lanes import WIDTH, aligned, padded
from hapticrender.control.bank import rows as row
from hapticrender.protocols import Array

PRECISIONS = {"double": np.float64, "single": np.float32}


class BankNumbers(NamedTuple):
    """What all bands share."""

    rate: float
    analysed: bool
    error_observer: bool
    lead: float  # s: delay and half the hold
    reference: float  # g of the bank that analyses and filters the target, per sample
    observer: float  # g of the observer in quiet, per sample; 0 without feedback
    observer_awake: float
    crowd_speed: float  # m/s: below it finger-locked carriers crowd, and the observer slows down with the finger
    dc: float  # 1.6 w h of the DC band (type 2)
    dc_drift: float  # (w h)^2
    integral: float  # 1/s in quiet
    integral_stirred: float
    integral_awake: float
    age: float  # steps of learning from a command to the middle of what it does
    adapt: float  # 1/s in quiet; negative: never
    adapt_awake: float
    rest: float  # 1/s: adaptation of each band's remaining stiffness, in quiet
    rest_awake: float
    inner: float  # share of the inner loop that is always on
    inner_awake: float
    fast_pole: float  # per sample
    slow_pole: float
    fast_level: float  # m, squared; infinite: no detectors
    slow_level: float
    fast_time: float  # samples
    slow_time: float
    release: float  # per sample
    ramp: float  # per sample
    lowest: float  # Hz
    highest: float
    highest_edge: float  # times it: where finger-locked carriers have faded out
    contact_on: float  # N
    contact_off: float
    drive_limit: float
    drive_step: float  # 0: not shaped
    peak_decay: float  # per sample
    back: float  # 1/s: back-calculation at the limit
    sensed_limit: float
    modulated: bool  # the wanted waveform is a factor of every target
    differentiated: bool  # what is wanted is the time derivative of what the tones say
    presence: bool  # targets are wanted only while a finger is there
    least_speed: float  # m/s: and slides at least so fast
    dc_quick: float  # of the DC band after a touch, and while no finger is there
    dc_drift_quick: float
    memory: float  # damping times speed of a sliding contact; 0: none
    typical_speed: float  # m/s: for which the device's own damping holds
    shows: bool  # the sensor does not show what is wanted, but is `late` (s), and has not lagged by `foresight` (m)
    late: float
    foresight: float
    lock: float  # 1/s: pace at which the carriers follow the resonance; 0: not
    least_motion: float
    typical_mass: float
    typical_stiffness: float
    least_mass: float
    most_mass: float
    least_damping: float
    most_damping: float
    least_stiffness: float
    most_stiffness: float


class BankTables(NamedTuple):
    """Parameters of the bank."""

    numbers: BankNumbers
    tone: Array  # (5, bands)
    listen: Array  # (coordinates, sensors)
    speak: Array  # (channels, coordinates): drive per force
    mass: Array  # (coordinates, coordinates)
    damping: Array
    stiffness: Array
    shape: tuple[float, ...]  # pattern of the target over the coordinates; their number is known while compiling
    taps: Array  # (coordinates, taps) of the inner loop, N/m
    grip: Array  # (coordinates,) damping that the inner loop adds, N s/m


class BankState(NamedTuple):
    """State of the bank; changed in place."""

    band: Array  # (tiles, BAND_ROWS, W)
    loop: Array  # (tiles, coordinates * LOOP_ROWS, W)
    law: Array  # (tiles, FIRST_LAW + coordinates^2 * LAW_ROWS, W)
    ahead: Array  # (tiles, 2 coordinates (coordinates + 1), W) of settled targets: D R, and D' + T D
    sent: Array  # (tiles, SHOWN_ROWS + SENT_ROWS steps, W): what was commanded in the last steps of learning
    phase: Array  # (bands,) uint64: fixed part of each carrier at the next refresh, 2^64 a turn
    pace: Array  # (tiles,) integer: LOCKED, GROWING or STEADY
    track: Array  # (TRACK_ROWS,)
    touch: Array  # (TOUCH_ROWS,)
    level: Array  # (2, coordinates) DC band and its drift
    past: Array  # (coordinates, taps) last deviations, newest first
    lags: tuple[int, ...]  # samples by which each tap looks back; their number is known while compiling
    answer: Array  # (2 coordinates, coordinates) of settled bands: force, then a quarter ahead, per residual, N/m
    residual: Array  # (RESIDUAL_ROWS, coordinates) scratch
    shaper: Array  # (2, channels) last two errors of the command's rounding
    follows: Array  # (2,) integer: tiles that follow the finger; tiles whose targets do not stay
    sample: Array  # (1,) integer: samples so far
    shift: Array  # (2,) resonance lock: shift of the fixed carriers (Hz), and 1 while it is lost


def bank_state(tables: BankTables, dtype: type = np.float64) -> BankState:
    """State of a bank at rest, its bands in `dtype`."""
    coordinates, bands = len(tables.shape), tables.tone.shape[1]
    tiles, width = padded(bands, dtype), WIDTH[np.dtype(dtype)]
    touch = np.zeros(row.TOUCH_ROWS)
    touch[[row.SCALE, row.TRUST]] = 1.0
    return BankState(
        band=aligned((tiles, row.BAND_ROWS, width), dtype),
        loop=aligned((tiles, coordinates * row.LOOP_ROWS, width), dtype),
        law=aligned((tiles, row.FIRST_LAW + coordinates**2 * row.LAW_ROWS, width), dtype),
        ahead=aligned((tiles, 2 * coordinates * (coordinates + 1), width), dtype),
        sent=aligned((tiles, row.SHOWN_ROWS + row.SENT_ROWS * (int(tables.numbers.age + 0.5) + 2), width), dtype),
        phase=np.zeros(bands, np.uint64),
        pace=np.zeros(tiles, np.int64),
        track=np.zeros(row.TRACK_ROWS),
        touch=touch,
        level=np.zeros((2, coordinates)),
        past=np.zeros(tables.taps.shape),
        lags=tuple(range(tables.taps.shape[1])),
        answer=np.zeros((2 * coordinates, coordinates)),
        residual=np.zeros((row.RESIDUAL_ROWS, coordinates)),
        shaper=np.zeros((2, len(tables.speak))),
        follows=np.zeros(2, np.int64),
        sample=np.zeros(1, np.int64),
        shift=np.array([0.0, 1.0]),
    )


def across_bands(tiled: Array, index: int, bands: int) -> Array:
    """Copy of row `index` of a tiled array (tiles, rows, W), band after band, shape (bands,)."""
    return np.ascontiguousarray(tiled[:, index]).reshape(-1)[:bands]
