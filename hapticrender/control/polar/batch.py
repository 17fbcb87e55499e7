"""The paper's controller of as many scenarios as there are lanes: the step is its own, only the layout is another.

A tile is one band of every scenario, so that together they look like one controller of W times as many bands, each
with its phase and its look-ups; only what its bands share, finger, sensors and drives, is a lane each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hapticrender.compiled.lanes import aligned
from hapticrender.control.bank.batch import LANES, side_by_side
from hapticrender.control.methods.paper import PolarController, polar_state
from hapticrender.control.polar.kernels import PolarState, PolarTables
from hapticrender.protocols import Array


def alike(first: PolarController, other: PolarController) -> bool:
    """Whether two can run side by side: they share every number but those of devices, tones and state."""
    mine, yours = first.tables, other.tables
    shapes = all(np.shape(getattr(mine, name)) == np.shape(getattr(yours, name)) for name in ("tone", "listen", "gain"))
    heard = first.state.window.shape == other.state.window.shape
    fresh = first.state.sample[0] == other.state.sample[0] == 0
    double = first.state.band.dtype == other.state.band.dtype == np.float64
    numbers = mine.numbers == yours.numbers and np.array_equal(mine.speak, yours.speak)
    return numbers and shapes and heard and fresh and double


def batch_of(controllers: Sequence[PolarController]) -> tuple[PolarTables, PolarState]:
    """Tables and state of at most `LANES` controllers at rest that are `alike`, a lane each."""
    first, every = controllers[0], [*controllers, *[controllers[-1]] * (LANES - len(controllers))]
    tones = side_by_side([each.tables.tone for each in controllers])  # (TONE_ROWS, bands, W)
    tables = first.tables._replace(
        tone=tones.reshape(len(tones), -1),
        listen=side_by_side([each.tables.listen for each in controllers]),
        gain=_in_turn([each.tables.gain for each in every]),
        lag=_in_turn([each.tables.lag for each in every]),
    )
    state = polar_state(tables, len(first.state.window), float)
    return tables, state._replace(
        finger=aligned((*state.finger.shape, LANES)),
        doubt=aligned((*state.doubt.shape, LANES)),
        shared=aligned((len(state.shared), 1, LANES)),
    )


def _in_turn(tables: Sequence[Array]) -> Array:
    """Tables of one scenario after another, or the one that all of them share."""
    return tables[0] if all(each is tables[0] for each in tables) else np.concatenate(tables)
