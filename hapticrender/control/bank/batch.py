"""The band bank of as many scenarios as there are lanes: the step is the bank's own, only the layout is another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hapticrender.compiled.lanes import WIDTH, aligned
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.controller import BankController
from hapticrender.control.bank.state import BankState, BankTables
from hapticrender.protocols import Array

LANES = WIDTH[np.dtype(float)]
_TABLES = ("listen", "speak", "mass", "damping", "stiffness", "taps", "grip")
_STATE = ("track", "touch", "level", "past", "answer", "residual", "shaper")


def side_by_side(arrays: Sequence[Array]) -> Array:
    """Stack arrays of one shape along a last axis of `LANES`; the last one fills what is left."""
    filled = [*arrays, *[arrays[-1]] * (LANES - len(arrays))]
    stacked = aligned((*np.shape(arrays[0]), LANES))
    if all(each is arrays[0] for each in arrays):
        stacked[:] = np.asarray(arrays[0], float)[..., None]
    else:
        stacked[:] = np.stack([np.asarray(each, float) for each in filled], axis=-1)
    return stacked


def alike(first: BankController, other: BankController) -> bool:
    """Whether two banks can run side by side: they share every number but those of devices, tones and state."""
    mine, yours = first.tables, other.tables
    shapes = all(np.shape(getattr(mine, name)) == np.shape(getattr(yours, name)) for name in (*_TABLES, "tone"))
    fresh = first.state.sample[0] == other.state.sample[0] == 0
    double = first.state.band.dtype == other.state.band.dtype == np.float64
    return mine.numbers == yours.numbers and mine.shape == yours.shape and shapes and fresh and double


def batch_of(controllers: Sequence[BankController]) -> tuple[BankTables, BankState]:
    """Tables and state of at most `LANES` banks at rest that are `alike`, a lane each."""
    first = controllers[0]
    tables, state, bands = first.tables, first.state, first.n_bands
    tones = side_by_side([each.tables.tone.T for each in controllers])  # (bands, TONE_ROWS, W)
    many: dict[str, Any] = {
        name: side_by_side([getattr(each.tables, name) for each in controllers]) for name in _TABLES
    }
    own: dict[str, Any] = {name: side_by_side([getattr(each.state, name) for each in controllers]) for name in _STATE}
    return tables._replace(tone=tones, **many), state._replace(
        band=aligned((bands, row.BAND_ROWS, LANES)),
        loop=aligned((bands, state.loop.shape[1], LANES)),
        law=aligned((bands, state.law.shape[1], LANES)),
        ahead=aligned((bands, state.ahead.shape[1], LANES)),
        sent=aligned((bands, state.sent.shape[1], LANES)),
        phase=np.zeros(bands * LANES, np.uint64),
        pace=np.zeros(bands, np.int64),
        follows=np.zeros(2, np.int64),
        sample=np.zeros(1, np.int64),
        **own,
    )
