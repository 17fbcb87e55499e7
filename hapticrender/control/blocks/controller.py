"""The band bank for devices that take blocks: from the bank's own design to a controller that runs block by block."""

from __future__ import annotations

import math

import numpy as np

from hapticrender.bands import Bands
from hapticrender.compiled.lanes import WIDTH, aligned, padded
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.controller import LEARNING_SHARE, BankController, settled_share, spacing
from hapticrender.control.bank.state import PRECISIONS, BankNumbers, BankTables, bank_state
from hapticrender.control.blocks.kernels import block_run
from hapticrender.control.blocks.state import (
    CHANNEL_ROWS,
    GROUP,
    PHASE_ROWS,
    TURN_SIN,
    TURNS,
    BlockState,
    BlockTables,
)
from hapticrender.protocols import Array

MOST_COORDINATES = 2
PER_SAMPLE = ("release", "ramp")  # steps that grow with the block
POLES = ("fast_pole", "slow_pole")  # of first order, per sample
TIMES = ("fast_time", "slow_time")  # samples


class BlockController:
    """The bank behind the `Controller` protocol, for whole blocks.

    Parameters
    ----------
    controller : BankController
        The bank as it was designed, sample by sample.
    block : int, samples
        Samples of a block, >= 2.
    precision : {"double", "single"}
        Of everything that a band owns; phases, and what the scenario owns, are always double.

    Raises
    ------
    ValueError
        A number is out of its bound.

    Notes
    -----
    No inner loop: it needs an answer within a sample or few.  The observer is the per-sample one to rounding;
    adaptation, detectors and law act once a block, and the drive runs linearly between them.  The finger is learnt from
    the force that acted (`control.bank.learning`), once a block.
    """

    def __init__(self, controller: BankController, block: int, precision: str = "double") -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"{precision=}: must be one of {', '.join(PRECISIONS)}")
        if block < 2:
            raise ValueError(f"{block=}: must be >= 2 samples")
        tables = controller.tables._replace(tone=controller.tables.tone.copy())
        if len(tables.shape) > MOST_COORDINATES:
            raise ValueError(f"{len(tables.shape)} coordinates: must be <= {MOST_COORDINATES} in blocks")
        if tables.numbers.lock > 0.0:
            tables = tables._replace(
                numbers=tables.numbers._replace(lock=0.0)
            )  # what it learns of the device has to do
        self.method = controller.method
        self.n_bands = controller.n_bands
        frequency, wavenumber, *_ = tables.tone.copy()
        self._designed = Bands(frequency=frequency, wavenumber=wavenumber, phase=np.zeros(self.n_bands))
        self.block = block
        self.note = f"{controller.note}\nin blocks of {block} samples, {precision} precision"
        self.tables = BlockTables(
            bank=tables._replace(numbers=numbers_of_blocks(tables.numbers, block)),
            sample=tables.numbers,
        )
        self.state = block_state(self.tables.bank, block, PRECISIONS[precision])

    @property
    def mismatch(self) -> float:
        """Share of a target that the integral part adds on the untouched device; see `BankController.mismatch`."""
        return settled_share(self.tables.bank, self.state.bank)

    @property
    def turns(self) -> Array:
        """Fixed part of each carrier's phase at the next sample (turns, 0 to 1, shape (bands,))."""
        phase = self.tables.bank.tone[2]
        return np.mod(self.state.phase[:, TURNS].ravel()[: self.n_bands] - phase, 1.0)

    def send(self, bands: Bands) -> None:
        """Take up other targets at the next block; see `fitting` for the errors."""
        self.tables.bank.tone[:] = self.fitting(bands)
        self.state.news[0] = 1

    def fitting(self, bands: Bands) -> Array:
        """Return the rows of other targets, if this design can bear them: its bandwidths rest on the carriers.

        Raises
        ------
        ValueError
            Their number differs from what was designed for, they are a waveform where that was none, or the other way
            round; others follow the finger; a carrier is lower, or two are nearer, than any that was designed for; or
            one is higher than the device's highest.
        """
        if len(bands) != self.n_bands:
            raise ValueError(f"{len(bands)} bands: must be {self.n_bands}, as designed for")
        if (bands.envelope is None) != self.tables.bank.numbers.analysed:
            raise ValueError("the targets are a waveform: must be constant envelopes, as designed for")
        follows, followed = ((each > 0.0) for each in (bands.wavenumber, self._designed.wavenumber))
        if (follows != followed).any():
            raise ValueError(f"bands {np.flatnonzero(follows != followed)}: must follow the finger as designed for")
        for what, now, then in (
            ("lowest fixed carrier", _lowest(bands), _lowest(self._designed)),
            ("least spacing", spacing(bands), spacing(self._designed)),
            ("least spacing of ridges per metre", _ridges_apart(bands), _ridges_apart(self._designed)),
        ):
            if now < then * (1.0 - 1e-9):
                raise ValueError(f"{what} of {now:g}: must be >= {then:g}, as designed for (Hz, or 1/m)")
        highest = max(self.tables.sample.highest, float(self._designed.frequency.max(initial=0.0)))
        if bands.frequency.max(initial=0.0) > highest:
            raise ValueError(f"carrier of {bands.frequency.max():g} Hz: must be <= {highest:g} Hz")
        return bands.tone()

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest whole blocks; see `Controller`.

        Raises
        ------
        ValueError
            The samples are no whole number of blocks.
        """
        n = len(sensed)
        if n % self.block:
            raise ValueError(f"{n} samples: must be a multiple of the block of {self.block} samples")
        drive = np.zeros((n, len(self.tables.bank.speak)))
        target = np.zeros((n // self.block, self.n_bands), complex)
        flags = np.zeros(n, np.int64)
        arrays = [np.ascontiguousarray(each, float) for each in (sensed, position, wanted)]
        block_run(self.tables, self.state, *arrays, drive, target, flags)
        held = np.broadcast_to(target[:, None], (len(target), self.block, self.n_bands))  # copied only where it must be
        return drive, held.reshape(n, self.n_bands), flags


def _lowest(bands: Bands) -> float:
    """Lowest carrier that does not follow the finger, Hz; infinite where all do."""
    return float(np.min(bands.frequency[bands.wavenumber == 0.0], initial=math.inf))


def _ridges_apart(bands: Bands) -> float:
    """Least distance between two carriers that follow the finger, 1/m; infinite where there is one or none."""
    return float(np.diff(np.sort(bands.wavenumber[bands.wavenumber > 0.0])).min(initial=math.inf))


def numbers_of_blocks(numbers: BankNumbers, block: int) -> BankNumbers:
    """What the bank's own passes are told where a block is their sample; no inner loop."""
    changes = {name: min(getattr(numbers, name) * block, 1.0) for name in PER_SAMPLE}
    changes |= {name: 1.0 - (1.0 - getattr(numbers, name)) ** block for name in POLES}
    changes |= {name: getattr(numbers, name) / block for name in TIMES}
    most = LEARNING_SHARE * numbers.rate / block
    changes |= {"adapt": min(numbers.adapt, most), "adapt_awake": min(numbers.adapt_awake, most)}
    return numbers._replace(
        error_observer=True,
        age=age_of_drive(numbers, block),
        rate=numbers.rate / block,
        peak_decay=numbers.peak_decay**block,
        inner=0.0,
        inner_awake=0.0,
        **changes,
    )


def age_of_drive(numbers: BankNumbers, block: int) -> float:
    """How many blocks after its command a drive acts: the delay, >= 1."""
    return max((numbers.lead * numbers.rate - 0.5) / block, 1.0)


def block_state(tables: BankTables, block: int, dtype: type) -> BlockState:
    """State of a bank in blocks, at rest."""
    bank = bank_state(tables, dtype)
    coordinates, bands, channels = len(tables.shape), tables.tone.shape[1], len(tables.speak)
    tiles, width = padded(bands, dtype), WIDTH[np.dtype(dtype)]
    bank.pace[:] = row.GROWING
    bank.band[:, row.LIVE] = (np.arange(tiles * width) < bands).reshape(tiles, width)
    whole = -(-block // GROUP) * GROUP
    rows = max(2 * whole, TURN_SIN + 1) if (tables.tone[1] > 0.0).any() else TURN_SIN + 1
    phase = aligned((tiles * width // 8, PHASE_ROWS, 8))
    turns = np.zeros(tiles * width)
    turns[:bands] = np.mod(tables.tone[2], 1.0)
    phase[:, TURNS] = turns.reshape(-1, 8)
    return BlockState(
        bank=bank,
        phase=phase,
        carrier=aligned((2, tiles * width), dtype),
        table=aligned((tiles, rows, width), dtype),
        held=aligned((tiles, 2 * coordinates + CHANNEL_ROWS * (channels + channels % 2), width), dtype),
        response=np.zeros(whole),
        inverse=np.zeros((2, 2 * whole)),
        error=np.zeros((coordinates + 1, whole)),
        heard=np.zeros((coordinates + 1, whole), dtype),
        raw=np.zeros((coordinates + 1, whole)),
        place=np.zeros(block),
        sum=np.zeros((whole, 2)),
        lane_sum=aligned((whole, 2, width), dtype),
        stale=np.ones(1, np.int64),
        news=np.zeros(1, np.int64),
        gain=np.full(1, math.nan),
    )
