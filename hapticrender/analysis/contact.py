"""Contact from the force on the glass: two thresholds, and the force at rest followed while nothing touches."""

import math
from statistics import NormalDist

import numpy as np
from scipy.ndimage import maximum_filter1d

from hapticrender.analysis.smoothing import History
from hapticrender.protocols import Array

FALSE = 1e-3  # false contacts in `SPAN`
SPAN = 600.0  # s
CREEP = 0.05  # of a touch's load: what may be left of it after a lift, by a suspension that creeps
HOLD = 5e-3  # s for which the force stays below the lower threshold before contact is lost
TICK = 0.05  # s between two corrections of the force at rest
FOLLOWED = 5.0  # s over which it and its trend are fitted
LEAST = 2.0  # s of a line before its trend counts
TREND = 4.0  # standard deviations from which on a trend counts, and goes on under a finger


def clear_sigmas(bandwidth: float) -> float:
    """Standard deviations that noise of a bandwidth (Hz, one-sided) exceeds `FALSE` times in `SPAN`.

    Such noise has about two independent values per hertz and second.
    """
    return -NormalDist().inv_cdf(FALSE / (2 * bandwidth * SPAN))


class ContactDetector:
    """Detect contact in the heave force, block by block: on above `high`, off below half of it for `HOLD`.

    While nothing touches, the force at rest (sensors that drift, a suspension that creeps) is followed as a line over
    up to `FOLLOWED`, corrected every `TICK`; under a finger it is held, or goes on by its trend.  A lift may leave
    `CREEP` of the touch's load, which is then the force at rest.

    In the first `quiet` samples filters settle, and no contact is detected.  Where the mean of the heave force over a
    tick is farther than `still` (N) from that at rest, as by a touch too light to be detected, the values at rest go
    towards it by so much in `FOLLOWED`.  There are `columns` of measured values: the heave force (N) first, others
    beside it, whose values at rest are followed as well.
    """

    def __init__(self, rate: float, quiet: int, still: float, columns: int = 1) -> None:
        self.rate, self.delay = rate, round(HOLD * rate)
        self._tick = max(round(TICK * rate), 1)
        self._measured, self._high = History(self.delay), History(self.delay)
        self._at = -self.delay  # sample of the next result
        self._quiet, self._still, self._loaded = quiet, still, False
        self._rest, self._trend, self._ticks = np.zeros(columns), np.zeros(columns), 0  # trend: a tick; ticks fitted
        self._scatter = 0.0  # N^2: mean square of what ticks differ from the line
        self._sum, self._count, self._down = np.zeros(columns), 0, 0  # of the present tick; samples under a finger
        self._peak = 0.0  # N: largest mean of a tick in the present touch

    @property
    def variance(self) -> float:
        """Variance (N^2) of the heave force at rest: at its end a line is four times as uncertain as a mean."""
        return 4 * self._scatter / max(self._ticks, 1)

    def update(self, measured: Array, high: Array, rest: Array | None = None) -> tuple[Array, Array, Array]:
        """Contact (bool, (n,)), values less those at rest (n, columns) and thresholds (n,), `delay` samples late.

        They are of the n samples that end so long before the block does.  `measured` (n, columns) has the heave force
        (N) first, `high` (N, (n,)) is its upper threshold; `rest` (n, columns), of the samples of the result, replaces
        what would be followed.
        """
        n = len(measured)
        joined, high = self._measured.before(measured), self._high.before(high)
        ahead = maximum_filter1d(joined[:, 0], self.delay + 1, origin=-((self.delay + 1) // 2))[:n]
        loaded, level = np.zeros(n, bool), np.zeros_like(measured)
        first = 0
        while first < n:
            last = min(n, first + self._tick - (self._at + first) % self._tick)
            now = slice(first, last)
            level[now] = self._rest if rest is None else rest[now]
            before = self._loaded
            loaded[now] = self._decide(joined[now, 0] - level[now, 0], ahead[now] - level[now, 0], high[now], first)
            if before and not loaded[now].all():
                lifted = first + int(np.argmin(loaded[now]))
                left = joined[lifted : lifted + self.delay + 1].mean(axis=0) - level[lifted]
                if self._lift(left, rest is None):
                    now = slice(first, lifted + 1)
                    level[lifted] = self._rest
            self._follow(joined[now], loaded[now], self._at + now.stop)
            first = now.stop
        self._at += n
        return loaded, joined[:n] - level, high[:n]

    def _decide(self, force: Array, ahead: Array, high: Array, first: int) -> Array:
        """Contact of a part of a tick: the last of the events on and off."""
        low = np.maximum(0.5 * high, CREEP * self._peak)
        event = np.where(force > np.maximum(high, low), 1, np.where(ahead < low, -1, 0))
        event[np.arange(len(event)) + self._at + first < self._quiet] = 0
        last = np.maximum.accumulate(np.where(event != 0, np.arange(len(event)), -1))
        loaded = np.where(last < 0, self._loaded, event[last] > 0)
        self._loaded = bool(loaded[-1])
        return loaded

    def _lift(self, left: Array, follow: bool) -> bool:
        """End a touch; whether the suspension has crept, so that values at rest that are followed begin anew."""
        crept, self._peak = self._still < left[0] <= CREEP * self._peak, 0.0
        if not (follow and crept):
            return False
        self._rest, self._trend, self._ticks, self._loaded = self._rest + left, 0 * self._trend, 1, False
        return True

    def _follow(self, measured: Array, loaded: Array, end: int) -> None:
        """Take a part of a tick in; at its end correct the values at rest, or note the load of the touch."""
        self._sum, self._count = self._sum + measured.sum(axis=0), self._count + len(measured)
        self._down += int(loaded.sum())
        if end % self._tick:
            return
        change = self._sum / self._count - self._rest
        if self._count == self._tick and end - self._tick >= self._quiet and self._down == 0:
            self._correct(change)
        elif self._clear:
            self._rest = self._rest + self._trend
        if self._down == self._tick:
            self._peak = max(self._peak, float(change[0]))
        self._sum, self._count, self._down = np.zeros_like(self._sum), 0, 0

    def _correct(self, change: Array) -> None:
        """Move line and trend at rest by what a tick differs from them: least squares over a growing, then fading span.

        The gains are those of a line fitted to k values (Brookner, Tracking and Kalman filtering made easy, 1998, 4.3).
        """
        gone = change - self._trend
        if self._ticks > 1 and abs(gone[0]) > self._still:
            trend = self._trend if self._clear else 0.0
            self._rest = self._rest + trend + gone * self._still / abs(gone[0]) * TICK / FOLLOWED
            return
        self._ticks = k = min(self._ticks + 1, round(FOLLOWED / TICK))
        self._rest = self._rest + self._trend + gone * 2 * (2 * k - 1) / (k * (k + 1))
        if k > 1:
            self._trend = self._trend + gone * 6 / (k * (k + 1))
            self._scatter += (float(gone[0]) ** 2 - self._scatter) / (k - 1)

    @property
    def _clear(self) -> bool:
        """Whether the trend is beyond chance."""
        k = self._ticks
        return k * TICK >= LEAST and abs(self._trend[0]) > TREND * math.sqrt(12 * self._scatter / k**3)
