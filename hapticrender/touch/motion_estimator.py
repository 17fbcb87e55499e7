"""A finger's position and velocity now, from positions that come late, at irregular times and with errors.

A Kalman filter with the state s = [x, v, a] and white jerk of density q (m2/s5).  Over a time T::

    s' = F(T) s,  F = [[1, T, T2/2], [0, 1, T], [0, 0, 1]],  Q = q [[T5/20, T4/8, T3/6], [T4/8, T3/3, T2/2], [., ., T]]

(Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3).  q follows from how a finger moves: swipes of frequency f and
peak speed V have the jerk w2 V sin(w t), w = 2 pi f.  A jerk of that mean square, w4 V2/2, with the correlation time
1/w, has the density q = 2 (w4 V2/2)/w = w3 V2 at low frequencies (Singer 1970, for acceleration).

A sample beyond `GATE` standard errors of what is predicted is left out, unless the next one is as far off: then the
finger was put elsewhere, stopped or turned at once, and the filter starts afresh from these two.
"""

import math
from typing import NamedTuple

import numpy as np

from hapticrender import checks
from hapticrender.protocols import Array

FREQUENCY, SPEED = 3.0, 0.05  # Hz and m/s of the swipes that a finger makes on a texture
GATE = 5.0  # standard errors: one good sample in two million is beyond it
FASTEST = 10.0  # m/s
LEAST_NOISE = 1e-9  # m
ANYWHERE = 20.0**0.2  # over w: time after which q t5/20 is the squared amplitude (V/w)2 of the swipe


class MotionEstimate(NamedTuple):
    """Position (m, NaN while lifted) and velocity (m/s, 0 while lifted), and the standard error of each."""

    position: Array
    velocity: Array
    position_error: Array
    velocity_error: Array


def transition(time: float) -> Array:
    """F(T), shape (3, 3)."""
    return np.array([[1.0, time, 0.5 * time * time], [0.0, 1.0, time], [0.0, 0.0, 1.0]])


def jerk_covariance(time: float, density: float) -> Array:
    """Q(T) of white jerk of `density` (m2/s5), shape (3, 3)."""
    t = abs(time)
    rows = [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]
    return density * np.array(rows)


class MotionEstimator:
    """Position and velocity of a finger at any time, from samples of its position.

    Parameters
    ----------
    noise : float, m rms, >= 0
        Of a sample, beside its rounding.
    resolution : float, m, >= 0
        Step of the samples; a rounding adds ``resolution**2/12`` to their variance.  At least one of the two is > 0.
    latency : float, s, >= 0
        Age of a sample at the time that is passed to `update`.
    jitter : float, s rms, >= 0
        Error of that time; it adds ``(v jitter)**2`` to the variance of a sample.
    frequency, speed : float, Hz and m/s, > 0
        Of the swipes that are expected; see the module.

    Notes
    -----
    Without a sample for ``20**(1/5)/(2 pi frequency)`` (97 ms) the finger may be anywhere along its swipe, and counts
    as lifted.  What the filter makes of a motion, and of the samples' noise: `hapticrender.touch.latency_budget`.

    Examples
    --------
    >>> estimator = MotionEstimator(noise=50e-6, latency=10e-3)
    >>> for n in range(60):
    ...     _ = estimator.update(n / 120 + 10e-3, 0.04 * n / 120)
    >>> found = estimator.at(0.5)
    >>> f"{1e3 * found.position:.3f} mm, {1e3 * found.velocity:.2f} mm/s"
    '20.000 mm, 40.00 mm/s'
    """

    def __init__(
        self,
        noise: float = 0.0,
        *,
        resolution: float = 0.0,
        latency: float = 0.0,
        jitter: float = 0.0,
        frequency: float = FREQUENCY,
        speed: float = SPEED,
    ) -> None:
        self.noise = checks.number("noise", noise, "m", least=0.0)
        self.resolution = checks.number("resolution", resolution, "m", least=0.0)
        self.latency = checks.number("latency", latency, "s", least=0.0)
        self.jitter = checks.number("jitter", jitter, "s", least=0.0)
        omega = 2 * math.pi * checks.number("frequency", frequency, "Hz", above=0.0)
        speed = checks.number("speed", speed, "m/s", above=0.0)
        self.variance = self.noise**2 + self.resolution**2 / 12  # m2, of a sample of a finger at rest
        if self.variance < LEAST_NOISE**2:
            raise ValueError(f"{noise=} and {resolution=}: one must be > {LEAST_NOISE:g} m, no sensor is exact")
        dithered = self.noise > 0.5 * self.resolution
        self._bias = 0.0 if dithered else self.resolution**2 / 12  # m2: at rest every sample is rounded alike
        self.density = omega**3 * speed**2  # m2/s5
        self.patience = ANYWHERE / omega  # s
        self._prior = np.array([0.0, speed**2, (omega * speed) ** 2])  # variances of an unknown motion
        self._sampled = self.variance  # of the sample at hand
        self._state, self._covariance = np.zeros(3), np.zeros((3, 3))
        self._time = math.nan  # of the last sample that was taken; NaN: lifted
        self._rejected: tuple[float, float] | None = None  # the last sample, where it was left out

    def update(self, time: float, position: float, error: float | None = None) -> bool:
        """Take a sample (m; NaN: lifted) that arrives at `time` (s); False where it is left out.

        `error` (m, > 0) is its own standard error, where that differs from sample to sample, as that of a place found
        from the load on a plate does; by default that of the sensor.  A sample that is no later than the last one is
        left out, too, unless the clock has been set back by more than `patience`.  ValueError: a number is not finite.
        """
        if math.isnan(position):
            self.lift()
            return True
        if not (math.isfinite(time) and math.isfinite(position)):
            raise ValueError(f"{time=} s, {position=} m: must be finite (a position may be NaN: lifted)")
        self._sampled = self.variance if error is None else checks.number("error", error, "m", above=0.0) ** 2
        time -= self.latency
        if math.isnan(self._time) or abs(time - self._time) > self.patience:
            self._start(time, position)
            return True
        if time <= max(self._time, self._rejected[0] if self._rejected else -math.inf):
            return False
        if self._correct(time, position):
            self._rejected = None
            return True
        if self._rejected is None:
            self._rejected = time, position
            return False
        before, there = self._rejected
        velocity = (position - there) / (time - before)
        if abs(velocity) > FASTEST:  # no finger is so fast: start from the newer one
            self._start(time, position)
        else:  # from both, at the velocity between them
            self._start(before, there)
            self._covariance[1, 1] = max(self._covariance[1, 1], velocity**2)
            self._correct(time, position, gate=math.inf)
        return True

    def at(self, time: float | Array) -> MotionEstimate:
        """Return the motion at `time` (s, any shape), by the samples so far: velocity and acceleration go on."""
        ahead = np.asarray(time, float) - self._time
        gone = ~(abs(ahead) <= self.patience)  # NaN as well
        h = np.where(gone, 0.0, ahead)
        one, zero, t = np.ones_like(h), np.zeros_like(h), abs(h)
        rows = np.stack([[one, h, 0.5 * h * h], [zero, one, h]])  # of position and velocity
        position, velocity = np.einsum("ki...,i->k...", rows, self._state)
        spread = np.einsum("ki...,ij,kj...->k...", rows, self._covariance, rows)
        spread += [self._bias + self.density * t**5 / 20.0, self.density * t**3 / 3.0]
        position, velocity = np.where(gone, np.nan, position), np.where(gone, 0.0, velocity)
        errors = np.where(gone, np.nan, np.sqrt(spread))
        return MotionEstimate(*(each[()] for each in (position, velocity, *errors)))

    def lift(self) -> None:
        """The finger has left: its position is not known until the next sample."""
        self._time, self._rejected = math.nan, None

    def _start(self, time: float, position: float) -> None:
        """Start from one sample of a finger of unknown motion."""
        self._state = np.array([position, 0.0, 0.0])
        self._covariance = np.diag(self._prior + [self._sampled + self._prior[1] * self.jitter**2, 0.0, 0.0])
        self._time, self._rejected = time, None

    def _correct(self, time: float, position: float, gate: float = GATE) -> bool:
        """Predict to `time` and correct by a sample, unless it is beyond the gate."""
        step = time - self._time
        f = transition(step)
        state = f @ self._state
        covariance = f @ self._covariance @ f.T + jerk_covariance(step, self.density)
        variance = self._sampled + (state[1] * self.jitter) ** 2
        innovation, scatter = position - state[0], covariance[0, 0] + variance
        if innovation**2 > gate**2 * scatter:
            return False
        gain = covariance[:, 0] / scatter
        reduced = np.eye(3)
        reduced[:, 0] -= gain
        self._state = state + gain * innovation
        self._covariance = reduced @ covariance @ reduced.T + variance * np.outer(gain, gain)  # Joseph's form
        self._time = time
        return True


class Encoder(MotionEstimator):
    """Position and velocity from the counts of an incremental encoder, whose counter wraps.

    Parameters
    ----------
    resolution : float, m, not 0
        Of a count; negative where it counts backwards.
    bits : int, 2 to 64
        Of the counter: counts wrap through ``2**bits``, both ways.  Between two samples the finger must move by less
        than half of that.
    origin : float, m
        Position at the first count.
    **motion : float
        `noise`, `latency`, `jitter`, `frequency` and `speed`, as for `MotionEstimator`.

    Examples
    --------
    >>> encoder = Encoder(resolution=0.5e-6)
    >>> for n in range(100):
    ...     _ = encoder.update(1e-3 * n, (2**32 - 2000 + 80 * n) % 2**32)
    >>> f"{1e3 * encoder.at(0.099).position:.3f} mm, {1e3 * encoder.at(0.099).velocity:.2f} mm/s"
    '3.960 mm, 40.00 mm/s'
    """

    def __init__(self, resolution: float, bits: int = 32, origin: float = 0.0, **motion: float) -> None:
        step = checks.number("resolution", resolution, "m")
        checks.require(step != 0.0, "resolution", resolution, "the metres of a count, not 0")
        super().__init__(resolution=abs(step), **motion)
        self.step, self.bits = step, checks.integer("bits", bits, least=2, most=64)
        self.origin = checks.number("origin", origin, "m")
        self._count: int | None = None
        self._total = 0  # counts from the first one

    def update(self, time: float, position: float, error: float | None = None) -> bool:
        """Take a count (`position`, an integer) that arrives at `time` (s); False where it is left out."""
        whole = float(position).is_integer()
        checks.require(whole, "position", position, "a whole number of counts; call lift() where no finger touches")
        count, half = int(position), 1 << (self.bits - 1)
        last = count if self._count is None else self._count
        self._total += (count - last + half) % (2 * half) - half
        self._count = count
        return super().update(time, self.origin + self.step * self._total, error)
