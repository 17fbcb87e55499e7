"""A touch panel as it is: late, irregular, rounded samples of a finger's position, and what is made of them."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hapticrender.checks import Validated, parameter
from hapticrender.protocols import Array
from hapticrender.touch.motion_estimator import FREQUENCY, SPEED, MotionEstimator

SMOOTHING = 5e-3  # s: a correction of the estimate is spread by two poles of this time, so that no texture steps


@dataclass(frozen=True, kw_only=True)
class TouchPanel(Validated):
    """A touch panel, or any other sensor of the finger's position; in a scene, the table ``[touch_panel]``.

    Notes
    -----
    Defaults are engineering estimates of a panel of a phone or tablet; measure yours.

    Examples
    --------
    >>> estimator = TouchPanel(rate=240.0, latency=8e-3).estimator()
    >>> estimator.update(0.108, 0.01)
    True
    """

    rate: float = parameter(120.0, "Hz", "scans", least=1.0, most=1e6)
    noise: float = parameter(50e-6, "m", "white noise of a sample, rms", most=0.01)
    resolution: float = parameter(20e-6, "m", "step of a sample; 0 is ideal", most=0.01)
    latency: float = parameter(15e-3, "s", "from a scan to its arrival", most=1.0)
    jitter: float = parameter(0.5e-3, "s", "of the arrival, rms; 0 with time stamps of the scans", most=0.1)
    dropouts: float = parameter(0.01, about="share of samples that are lost", most=0.9)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.estimator()  # refuses a sensor without any error

    def estimator(self, frequency: float = FREQUENCY, speed: float = SPEED) -> MotionEstimator:
        """Return an estimator for a finger that swipes with `frequency` (Hz) and peak `speed` (m/s)."""
        errors = {"resolution": self.resolution, "latency": self.latency, "jitter": self.jitter}
        return MotionEstimator(self.noise, **errors, frequency=frequency, speed=speed)


class PanelReader:
    """Finger positions at `rate` (Hz) as an application behind a touch panel has them, for simulations."""

    def __init__(self, panel: TouchPanel, rate: float, seed: int = 0) -> None:
        self.panel, self.rate, self.estimator = panel, rate, panel.estimator()
        self._random = np.random.default_rng([seed, 1])  # beside that of the device's own noise
        self._samples, self._scans, self._last = 0, 0, np.nan  # positions so far, scans so far, the last position (m)
        self._pending: deque[tuple[float, float]] = deque()
        self._arrived = 0.0  # s: the last arrival
        self._correction, self._changed = np.zeros(2), 0.0  # what is left of it, see `_corrected`; since when

    def __call__(self, position: Array) -> Array:
        """Positions (m, shape (n,), NaN: lifted) that are known while the finger is at `position`, (n,)."""
        time = (self._samples + np.arange(len(position))) / self.rate
        self._samples += len(position)
        self._pending.extend(self._scanned(time, position))
        found, first = np.empty(len(position)), 0
        while self._pending and self._pending[0][0] <= time[-1]:
            arrival, sample = self._pending.popleft()
            last = int(np.searchsorted(time, arrival))
            found[first:last] = self._corrected(time[first:last])
            self._take(arrival, sample)
            first = last
        found[first:] = self._corrected(time[first:])
        return found

    def _scanned(self, time: Array, position: Array) -> Iterator[tuple[float, float]]:
        """Arrival (s) and position (m) of the samples that are scanned in a block, in order."""
        panel, earlier = self.panel, time[0] - 1.0 / self.rate
        times, positions = np.append(earlier, time), np.append(self._last, position)
        self._last = position[-1]
        while (scan := self._scans / panel.rate) <= time[-1]:
            near = np.searchsorted(times, scan)
            exact = positions[near] if times[near] == scan else np.interp(scan, times, positions)
            late, error = self._random.standard_normal(2) * (panel.jitter, panel.noise)
            lost, step = self._random.random() < panel.dropouts, panel.resolution
            sample = exact + error if step == 0.0 else step * np.round((exact + error) / step)
            self._scans += 1
            self._arrived = max(scan + panel.latency + late, scan, self._arrived)  # in order, and none before its scan
            if not lost:
                yield self._arrived, float(sample)

    def _take(self, arrival: float, sample: float) -> None:
        """Hand a sample to the estimator; the position goes on from where it is."""
        before = self._corrected(np.array([arrival]))[0]
        self.estimator.update(arrival, sample)
        jump = before - self.estimator.at(arrival).position
        u = (arrival - self._changed) / SMOOTHING
        first, second = self._correction
        # two poles in series: the jump enters both, what the first had on its way to the second stays on its way
        self._correction = np.array([first * np.exp(-u) + jump - (second + u * first) * np.exp(-u), jump])
        self._correction, self._changed = np.nan_to_num(self._correction), arrival  # after a lift there is none

    def _corrected(self, time: Array) -> Array:
        """Estimated positions (m) at `time` (s), with what is left of the last correction."""
        u = (time - self._changed) / SMOOTHING
        first, second = self._correction
        return np.asarray(self.estimator.at(time).position + (second + u * first) * np.exp(-u))
