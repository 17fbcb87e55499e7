"""The paper's controller of as many scenarios as there are lanes: the step is its own, only the layout is another.

A tile is one band of every scenario, so that together they look like one controller of W times as many bands, each
with its phase and its look-ups; only what its bands share, finger, sensors and drives, is a lane each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hapticrender.compiled.lanes import WIDTH, aligned
from hapticrender.control.bank.batch import side_by_side
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
    return mine.numbers == yours.numbers and np.array_equal(mine.speak, yours.speak) and shapes and heard and fresh and double


def batch_of(controllers: Sequence[PolarController]) -> tuple[PolarTables, PolarState]:
    """Tables and state of at most `LANES` controllers at rest that are `alike`, a lane each."""
    first = controllers[0]
    tables = first.tables._replace(
        tone=_interleaved([each.tables.tone.T for each in controllers]).T.copy(),
        listen=side_by_side([each.tables.listen for each in controllers]),
        gain=_interleaved([each.tables.gain for each in controllers]),
        lag=_interleaved([each.tables.lag for each in controllers]),
    )
    state, lanes = polar_state(tables, len(first.state.window), float), WIDTH[np.dtype(float)]
    return tables, state._replace(
        finger=aligned((*state.finger.shape, lanes)),
        doubt=aligned((*state.doubt.shape, lanes)),
        shared=aligned((len(state.shared), 1, lanes)),
    )


def _interleaved(arrays: Sequence[Array]) -> Array:
    """Rows of as many arrays as there are lanes in turns: the first of each, the second of each."""
    stacked = np.moveaxis(side_by_side(arrays), -1, 1)
    return np.ascontiguousarray(stacked.reshape(-1, stacked.shape[-1]))
