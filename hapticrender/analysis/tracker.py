"""Load, position, velocity and contact of a finger from the plate's drive and measurement, block by block.

With ``F_f [1, p/a]`` the residual of the plate's balance of forces (`hapticrender.analysis.course`), smoothed to 10 Hz,
the load is W = F_f and the position p = a (F_f p/a)/W.  At rest this is the paper's ``d k1 x1/(k1 x1 + k2 x2)`` (its
printed form divides by zero at x1 = 0), p being a distance from the middle and x_i the displacement at the coils.

Standard errors: white noise of standard deviation s_c, s_r in heave and rocking gives the forces ``(k1 + k2) s_c`` and
``(k1 + k2) s_r`` per sample, of which a share G (`LocalLine`) passes; with P the covariance of k1, k2 and x_i the sag::

    var W = (k1 + k2)^2 s_c^2 G + [x1, x2] P [x1, x2]',   g = p/a
    var p = (a/W)^2 ((k1 + k2)^2 (s_r^2 + g^2 s_c^2) G + d P d'),   d = [-x1, x2] - g [x1, x2]
    var v = (a/W)^2 (k1 + k2)^2 (s_r^2 + g^2 s_c^2) G',   v = a (dN/dt - g dW/dt)/W,   N = F_f p/a

so that the position is lost as 1/W.
"""

import math
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from hapticrender.analysis.contact import ContactDetector, clear_sigmas
from hapticrender.analysis.course import Course, MotionFilter, Rest, Signals, at_least
from hapticrender.analysis.records import DOUBTFUL, LOADED, UNLOADED, Series, Touch
from hapticrender.analysis.smoothing import History, LocalLine, half_width, spread_of
from hapticrender.bands import hold_last
from hapticrender.checks import integer, number, require
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array

SLOW = 10.0  # Hz: bandwidth of load, position and velocity
FAST = 100.0  # Hz: of the force that shows contact
LEAST_RATE = 5 * FAST  # Hz: with fewer samples in the kernel the load is too small, by 2 % at 417 Hz, 8 % at 333 Hz
MODEL_SIGMAS = 3.0  # of the plate's uncertainty, added to the threshold of contact
PEAK = 0.05  # s: longest half period of a carrier twice over, in which its peak lies
DOUBT = 0.75  # of the threshold: from here on a force without contact is doubtful, by noise once in ten minutes
FARTHEST = 0.25  # of a: largest standard error of a position that is stated


class FingerTracker:
    """Track the finger on a plate block by block: a loop calls `update` with each block that it played.

    Results come `latency` samples after the samples that they belong to.

    Parameters
    ----------
    plate : PlateParameters or Course
        Model of the plate; a Course states its uncertainty as well.
    rate : float, Hz
        Of the samples, at least 500 Hz; default: that of the plate.
    late : int, samples
        From a row of the drive to the samples in which it acts, beyond the one sensed with it, >= 0.
    noise : array of two floats, m
        White noise of the sensors, rms; default: that of the plate.
    lookahead : float, s
        How much later than a sample the last one lies that load, position and velocity use: 0 to 66 ms, where the
        estimate is symmetric in time, the noise least and the bandwidth 10 Hz.
    rest : Rest, optional
        Forces and displacement of the plate at rest over time; default: followed while nothing touches.

    Examples
    --------
    >>> tracker = FingerTracker(PlateParameters())
    >>> f"{1e3 * tracker.latency / 5000:.0f} ms, {tracker.bandwidth[0]:.1f} Hz"
    '39 ms, 11.7 Hz'
    """

    def __init__(
        self,
        plate: PlateParameters | Course,
        *,
        rate: float | None = None,
        late: int = 0,
        noise: Array | None = None,
        lookahead: float = 0.02,
        rest: Rest | None = None,
    ) -> None:
        known = isinstance(plate, Course | PlateParameters)
        require(known, "plate", plate, "a PlateParameters or a Course", TypeError)
        self.course = plate if isinstance(plate, Course) else Course.of(plate)
        p = self.course.plate
        self.rate = number("rate", p.rate if rate is None else rate, "Hz", least=LEAST_RATE)
        late, lookahead = integer("late", late, "samples", least=0), number("lookahead", lookahead, "s", least=0.0)
        noise = np.full(2, p.sensor_noise) if noise is None else np.asarray(noise, float)
        require(noise.shape == (2,) and bool((noise >= 0.0).all()), "noise", noise, "two numbers >= 0, in m rms")
        noise, spread = at_least(noise, p), spread_of(SLOW)
        self._line = LocalLine(spread, self.rate, min(round(lookahead * self.rate), half_width(spread, self.rate)))
        self._filter = MotionFilter(p, self.rate, spread_of(FAST), late)
        self._noise = float(self._filter.force_noise(noise)[0])
        self._clear = clear_sigmas(2 * FAST)
        self._bent = float(p.stiffness_matrix[0, 0] * self.course.bending(0.0).real)
        self._white = p.stiffness_matrix[0, 0] * self._filter.coordinate_noise(noise)
        quiet, still = 2 * self._filter.delay, self._clear * self._noise / 2
        self._detector = ContactDetector(self.rate, quiet, still, columns=4)
        self._edge = self._filter.delay  # samples beside a change of contact that are left out
        self._given, self._at, self._first = rest, -self._filter.delay, 0
        self._history = History(self._line.behind + self._line.ahead + 2 * self._edge)
        self._held = np.zeros((1, self.course.plate.coils + 2))  # A, m: last drive and measurement
        self._peak = History(round(PEAK * self.rate))

    @property
    def latency(self) -> int:
        """Samples from a sample to the estimate of it."""
        return self._filter.delay + self._detector.delay + self._edge + self._line.ahead

    @cached_property
    def bandwidth(self) -> tuple[float, float]:
        """Frequencies (Hz) at which load and position, and the velocity, pass half of the power."""
        return self._line.bandwidths(self._filter.spread)

    @property
    def threshold(self) -> float:
        """Force (N) above which contact is certain, on a plate that is exactly known."""
        return self._clear * self._noise

    def least_load(self, position: float, error: float) -> float:
        """Load (N) from which on the position's standard error is below `error` (m) at `position` (m); may be inf."""
        g, a = position / self.course.plate.half_spacing, self.course.plate.half_spacing
        sag = -np.linalg.solve(self.course.plate.stiffness_matrix, [1.0, g])
        wrong = a * math.sqrt(self._of_stiffness(sag[None], np.array([g]))[1][0])
        noise = a * math.hypot(self._white[1], g * self._white[0]) * math.sqrt(self._line.noise[0])
        return noise / math.sqrt(error**2 - wrong**2) if wrong < error else math.inf

    def update(self, drive: Array, sensed: Array) -> Touch:
        """Estimates from the next n >= 1 samples of drive (A, (n, coils)) and measurement (m, (n, 2)).

        They are of the n samples `latency` before these, less those before the first one.  What is no number is
        replaced by the last one that is.
        """
        drive, sensed = np.asarray(drive, float), np.asarray(sensed, float)
        n = max(sensed.size // 2, 1)
        shapes, due = (drive.shape, sensed.shape), ((n, self.course.plate.coils), (n, 2))
        if shapes != due:
            given = f"drive and measurement of shapes {shapes[0]} and {shapes[1]}"
            raise ValueError(f"{given}: must be {due[0]} and {due[1]}, in A and m, at least one sample")
        rows = np.vstack([self._held, np.column_stack([drive, sensed])])
        rows = np.apply_along_axis(hold_last, 0, rows)[1:]
        self._held, (drive, sensed) = rows[-1:], np.split(rows, [drive.shape[1]], axis=1)
        signals = self._filter.update(drive, sensed)
        time = (self._at + np.arange(len(drive))) / self.rate
        self._at += len(drive)
        force = signals.residual(self.course.at(time), self.course.plate.half_spacing)
        measured = np.concatenate([force, signals.displacement], axis=1)
        rest = None if self._given is None else self._given.at(time - self._detector.delay / self.rate)
        loaded, moved, high = self._detector.update(measured, self._thresholds(signals), rest)
        rows = np.column_stack([moved, loaded, high])
        return self._touch(self._history.before(rows), len(drive))

    def _thresholds(self, signals: Signals) -> Array:
        """Upper threshold (N, (n,)) of contact: noise, and what the plate's uncertainty makes of its motion at most."""
        covariance = self.course.covariance_at(max(self._at, 0) / self.rate)
        phi = signals.regressors(self.course.plate.half_spacing)[:, 0]
        variance = self._peak.before(np.einsum("ni,ij,nj->n", phi, covariance, phi))
        n, size = len(phi), len(variance) - len(phi) + 1
        highest = maximum_filter1d(variance, size, origin=(size - 1) // 2)[-n:]
        return self.threshold + MODEL_SIGMAS * np.sqrt(highest)

    def _touch(self, rows: Array, n: int) -> Touch:
        """Fit load and position of n samples to the rows around them."""
        edge, line = self._edge, self._line
        loaded = rows[:, 4] > 0.5
        first = edge + line.behind
        here = slice(first, first + n)
        fits = []
        for inside in (loaded, ~loaded):
            kept = minimum_filter1d(inside.astype(np.uint8), 2 * edge + 1)[edge : len(rows) - edge] > 0
            fits.append(line.fit(rows[edge : len(rows) - edge, :4], kept))
        now, fast, high = loaded[here], rows[here, 0], rows[here, 5]
        pairs = zip(*fits, strict=True)
        level, slope, of_level, of_slope = (np.where(now[:, None] if a.ndim > 1 else now, a, b) for a, b in pairs)
        with np.errstate(invalid="ignore"):
            doubtful = np.where(now, level[:, 0] < high, fast > DOUBT * high)
        contact = np.where(doubtful, DOUBTFUL, np.where(now, LOADED, UNLOADED))
        series = self._series(level, slope, of_level, of_slope, now)
        time = self._first - self.latency + np.arange(n)
        self._first += n
        kept = time >= 0
        load, position, velocity = (Series(value[kept], error[kept], width) for value, error, width in series)
        return Touch(time[kept] / self.rate, load, position, velocity, contact[kept])

    def _series(
        self, level: Array, slope: Array, of_level: Array, of_slope: Array, loaded: Array
    ) -> list[tuple[Array, Array, float]]:
        """Load, position and velocity, each with its standard error and bandwidth."""
        a, widths = self.course.plate.half_spacing, self.bandwidth
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            load = np.where(loaded & (level[:, 0] > 0.0), level[:, 0], np.nan)
            for _ in range(2 if self._bent else 0):  # the bending depends on the place, and that on the load
                load = level[:, 0] / (1 + self._bent * self.course.plate.displacement(a * level[:, 1] / load)[:, 2])
            g, share = level[:, 1] / load, load / level[:, 0]
            of_load, of_lever = self._of_stiffness(level[:, 2:], g)
            rest = self._detector.variance / self._white[0] ** 2 if self._given is None else 1.0 / self._given.samples
            scatter = self._white[1] ** 2 + g**2 * self._white[0] ** 2
            load_error = np.sqrt(self._white[0] ** 2 * (of_level + rest) + of_load)
            error = a / load * np.sqrt(scatter * (of_level + rest) + of_lever)
            velocity = a * (slope[:, 1] - g * share * slope[:, 0]) / load
            velocity_error = a / load * np.sqrt(scatter * of_slope)
            defined = error < FARTHEST * a
        position, velocity = (np.where(defined, each, np.nan) for each in (a * g, velocity))
        error, velocity_error = (np.where(defined, each, np.nan) for each in (error, velocity_error))
        load = np.where(np.isnan(load), level[:, 0], load)
        errors = load_error, error, velocity_error
        return list(zip((load, position, velocity), errors, (widths[0], *widths), strict=True))

    def _of_stiffness(self, sag: Array, g: Array) -> tuple[Array, Array]:
        """Variances of the load (N^2) and of N - g W (N^2) by the uncertainty of k1 and k2, for a sag (m, (n, 2))."""
        covariance = self.course.covariance_at(max(self._at, 0) / self.rate)[2:4, 2:4]
        x1, x2 = sag[:, 0] - sag[:, 1], sag[:, 0] + sag[:, 1]
        heave = np.stack([x1, x2], axis=1)
        lever = np.nan_to_num(np.stack([-x1, x2], axis=1) - g[:, None] * heave)
        return tuple(np.einsum("ni,ij,nj->n", each, covariance, each) for each in (heave, lever))  # type: ignore[return-value]
