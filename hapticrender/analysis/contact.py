"""Contact from the force on the glass: two thresholds, and the force at rest followed while nothing touches."""

from __future__ import annotations

import numpy as np

from hapticrender.analysis.smoothing import History
from hapticrender.protocols import Array

FALSE = 1e-3  # false contacts in `SPAN`
SPAN = 600.0  # s
HOLD = 5e-3  # s for which the force stays below the lower threshold before contact is lost
TICK = 0.05  # s between two corrections of the force at rest
FOLLOWED = 2.0  # s over which it is averaged


def clear_sigmas(bandwidth: float) -> float:
    """Standard deviations that noise of a bandwidth (Hz, one-sided) exceeds `FALSE` times in `SPAN`.

    Such noise has about two independent values per hertz and second.
    """
    from scipy.stats import norm

    return float(norm.isf(FALSE / (2 * bandwidth * SPAN)))


class ContactDetector:
    """Detect contact in the heave force, block by block: on above `high`, off once below half of it for `HOLD`.

    While nothing touches, the force at rest (sensors that drift, a suspension that creeps) is followed as a mean over
    up to `FOLLOWED`, corrected every `TICK`; under a finger it is held.

    Parameters
    ----------
    rate : float, Hz
    quiet : int, samples
        At the beginning, in which filters settle and no contact is detected.
    still : float, N
        A mean of the heave force over a tick that is farther from that at rest counts as if it were so far: a touch too
        light to be detected changes the force at rest slowly.
    columns : int
        Of what is measured: the heave force (N) first, others beside it, whose values at rest are followed as well.
    """

    def __init__(self, rate: float, quiet: int, still: float, columns: int = 1) -> None:
        self.rate, self.delay = rate, round(HOLD * rate)
        self._tick = max(round(TICK * rate), 1)
        self._measured, self._high = History(self.delay), History(self.delay)
        self._given = History(self.delay)
        self._at = -self.delay  # sample of the next result
        self._quiet, self._still, self._loaded = quiet, still, False
        self._rest, self._ticks = np.zeros(columns), 0.0  # values at rest; ticks averaged in them
        self._sum, self._count = np.zeros(columns), 0  # of the present tick

    @property
    def averaged(self) -> float:
        """Samples of which the values at rest are the mean."""
        return self._ticks * self._tick

    def update(self, measured: Array, high: Array, rest: Array | None = None) -> tuple[Array, Array]:
        """Contact (bool, (n,)) and values at rest (n, columns) of the n samples that end `delay` before the block's end.

        `measured` (n, columns) has the heave force (N) first, `high` (N, (n,)) is its upper threshold; `rest`
        (n, columns) replaces what would be followed.
        """
        from scipy.ndimage import maximum_filter1d

        n = len(measured)
        joined, high = self._measured.before(measured), self._high.before(high)
        ahead = maximum_filter1d(joined[:, 0], self.delay + 1, origin=-((self.delay + 1) // 2))[:n]
        loaded, level = np.zeros(n, bool), np.zeros_like(measured)
        delayed = None if rest is None else self._given.before(rest)
        first = 0
        while first < n:
            last = min(n, first + self._tick - (self._at + first) % self._tick)
            now = slice(first, last)
            level[now] = self._rest if rest is None else delayed[now]
            loaded[now] = self._decide(joined[now, 0] - level[now, 0], ahead[now] - level[now, 0], high[now], first)
            self._follow(joined[now], loaded[now], self._at + last)
            first = last
        self._at += n
        return loaded, level

    def _decide(self, force: Array, ahead: Array, high: Array, first: int) -> Array:
        """Contact of a part of a tick: the last of the events on and off."""
        event = np.where(force > high, 1, np.where(ahead < 0.5 * high, -1, 0))
        event[np.arange(len(event)) + self._at + first < self._quiet] = 0
        last = np.maximum.accumulate(np.where(event != 0, np.arange(len(event)), -1))
        loaded = np.where(last < 0, self._loaded, event[last] > 0)
        self._loaded = bool(loaded[-1])
        return loaded

    def _follow(self, measured: Array, loaded: Array, end: int) -> None:
        """Average a tick without contact into the values at rest."""
        if not loaded.any() and end - self._count - len(measured) >= self._quiet:
            self._sum, self._count = self._sum + measured.sum(axis=0), self._count + len(measured)
        if end % self._tick == 0:
            change = self._sum / self._tick - self._rest
            if self._count == self._tick:
                most = np.inf if self._ticks == 0.0 else self._still
                self._ticks = min(self._ticks + 1.0, FOLLOWED / TICK)
                self._rest = self._rest + change * min(1.0, most / max(abs(change[0]), 1e-30)) / self._ticks
            self._sum, self._count = np.zeros_like(self._sum), 0
