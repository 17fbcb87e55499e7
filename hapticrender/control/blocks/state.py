"""Parameters and state of the band bank in blocks, and the names of their rows."""

from __future__ import annotations

from typing import NamedTuple

from hapticrender.control.bank.state import BankNumbers, BankState, BankTables
from hapticrender.protocols import Array

EIGHT = 8  # lanes of double precision: phases are always double
GROUP = 16  # samples, whose sums over the lanes fill a register of either precision
PAIRS = GROUP // 2  # of samples in a group, at +-0.5, 1.5, 2.5 ... samples about its middle
# rows of BlockState.table where a tile's carriers stay: PAIR_ROWS a pair, then the turn from group to group
PAIR_COS, PAIR_SIN, FAR_COS, FAR_SIN = range(4)  # at the pair's later sample; the same times its distance over M
PAIR_ROWS = 4
TURN_COS, TURN_SIN = PAIRS * PAIR_ROWS, PAIRS * PAIR_ROWS + 1
# rows of BlockState.phase: turns of the fixed part of each carrier at the block's start, turns a block, and turns from
# the block's start to where the tables begin: the middle of the first group, if it stays
TURNS, TURNED, TO_MIDDLE = range(3)
PHASE_ROWS = 3
# rows of BlockState.held, CHANNEL_ROWS a channel after two for each coordinate: the drive's envelope at the end of the
# last block and of this one, and both as this block's tables want them
LAST_RE, LAST_IM, NOW_RE, NOW_IM, FROM_RE, FROM_IM, STEP_RE, STEP_IM = range(8)
CHANNEL_ROWS = 8


class BlockTables(NamedTuple):
    """Parameters of the bank in blocks."""

    bank: BankTables  # its rates are those of a block
    sample: BankNumbers  # the same of a sample


class BlockState(NamedTuple):
    """State of the bank in blocks; changed in place.  M is the block, in scratch a multiple of `GROUP`."""

    bank: BankState
    phase: Array  # (tiles of 8, PHASE_ROWS, 8) float64
    carrier: Array  # (2, bands) scratch: cosine and sine of the carriers where the tables begin
    # (tiles, TURN_SIN + 1, W): see PAIR_COS; or 2 M rows where any follow: cosine and sine at each of a tile's samples
    table: Array
    held: Array  # (tiles, 2 coordinates + CHANNEL_ROWS channels, W)
    response: Array  # (M,) r: what a residual of 1 adds to the ones after it
    inverse: Array  # (2, 2 M) first column of Q, and of its like for the wanted waveform, behind M zeros
    error: Array  # (coordinates + 1, M) scratch: residuals; the last row that of the wanted waveform
    heard: Array  # the same in the precision of the bands, folded: sums of a group's pairs, then differences
    raw: Array  # (coordinates + 1, M) scratch: residuals as the held envelopes would leave them
    place: Array  # (M,) scratch: position of the finger
    sum: Array  # (M, 2) scratch: sums over the bands
    lane_sum: Array  # (M, 2, W) scratch: the same a lane, and folded; not 4 KB apart, where stores delay loads
    stale: Array  # (1,) integer: 1 where tables and `response` have to be found anew
    news: Array  # (1,) integer: 1 where all tones are to be looked at; otherwise it is one tile a block
    gain: Array  # (1,) gain of the observer that `inverse` holds for
