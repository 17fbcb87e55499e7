"""Detection of two touches on a plate: whether one finger can explain what the plate senses.

With q heave and rocking, i the drive, p the finger's position and g = p/a its lever arm, one finger of any mechanics
leaves the force f = B i - D(s) q = F [1, g]: the moment over the force is g, real and the same from 0 Hz to the highest
band.  Two fingers leave z1 u1 [1, g1] + z2 u2 [1, g2] with u the motion and z the dynamic stiffness at each, and their
ratio depends on frequency, is complex, or contradicts the position that is reported.  So of ``u = f_2 - (g + d) f_1``
nothing but noise is left for one finger, where d is the error of g.  Over a window of Hann, with U_k its spectrum,
S_k the known density of its noise, and y the plate's errors (of M, C, K and the delay, covariance P from the untouched
plate)::

    T = min over d, y of  sum_k |U_k - a_k y|^2/S_k + y^T P^-1 y + d^2/s_d^2

A position that is late, or predicted, is off along the finger's velocity and acceleration too: two more entries of y.
T is a sum of squares with one degree of freedom for each real number in U: chi-square, by which the window's threshold
follows from the rate of false alarms.  Two fingers alike, at places that the plate moves alike under the same load,
leave what one finger between them would.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.inverse import derivative_filters
from hapticrender.control.inverse_records import HEAVE, LOAD, TAPS
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.recording import Recording

WINDOW = 0.25  # s
BAND = (20.0, 400.0)  # Hz
FALSE_ALARMS = 1e-6  # of a window: one in 70 hours of touch
POSITION_ERROR = 2e-3  # m, of a reported position against the centre of the forces
LATENESS = 50e-3  # s, of a reported position, and of its prediction: errors along velocity and acceleration
SMOOTHED = 34e-3  # s: mean of the reported position, which may come in steps: two samples of a panel of 60 Hz
DRIFT = 1e-6  # m, of a sensor's offset since the plate was last free
ERRORS = {"stiffness": 0.02, "damping": 0.3, "mass": 0.02}  # of a profile, of the largest entry of each matrix
DELAY_ERROR = 1.0  # samples: what the waveform law assumes, too
SPACING = 2  # bins: those of a Hann window that are two apart are correlated by 1/6, their squares by 1/36
CORRELATION = 1.0 + 2.0 / 36.0  # variance of a sum of those squares, over that of independent ones
LEAST_NOISE = 1e-4  # of a sensor's range: a model may state no noise
LEAST_SIGNAL = 100.0  # of the noise's power
MARGIN = 60e-3  # s after a touch or a lift, which may be reported late
KEPT = 15 / 16  # of what earlier windows of the free plate have shown: 4 s of memory, coils warm up
SLOWER = 100.0  # times the variance that the law assumes of a deviation: it learns ten times more slowly
DEVICE = slice(int(HEAVE), int(LOAD))  # of the law's parameters: the device's own
UNUSABLE = int(Flag.NONFINITE | Flag.SENSOR_CLIPPED | Flag.OVERRUN | Flag.STOPPED)
TWO_TOUCHES = int(Flag.TWO_TOUCHES)
SEARCH = np.linspace(-4.0, 4.0, 9)  # grid of d, three times: in s_d, and in a quarter of the last one


class TouchTest(NamedTuple):
    """Result of a window: T, its degrees of freedom and bound; the error d of the position (m), found on the way."""

    statistic: float
    freedom: float
    bound: float
    offset: float

    @property
    def two(self) -> bool:
        """Whether one finger cannot explain the window."""
        return self.statistic > self.bound


def measures_moment(model: DeviceModel) -> bool:
    """Whether a finger's force and moment can be measured on such a device: a plate with two coils and two sensors."""
    plate = model.finger.contact is not None and model.lever_per_metre > 0.0
    return plate and len(model.mass) == 2 and model.coordinate_from_sensed.shape == (2, 2)


def bound_of(freedom: float, false_alarms: float = FALSE_ALARMS) -> float:
    """Value that the statistic of one finger, of `freedom`, passes with the probability `false_alarms`."""
    from scipy.special import chdtri

    return float(CORRELATION * chdtri(freedom / CORRELATION, false_alarms))


class TouchMonitor:
    """Test of one finger against two, window by window, for signals that come in pieces of any length.

    `model` is of a plate, see `measures_moment`.  `last` is the result of the last window under a finger,
    `tests` counts these, `detections` those that one finger cannot explain; `two` says whether two fingers touch, by
    the last window: a lift ends it.
    """

    def __init__(self, model: DeviceModel) -> None:
        if not measures_moment(model):
            raise ValueError(f"{len(model.mass)} coordinates: must be a plate with 2, and a sensor for each of them")
        self.model, self.length, self._margin = model, round(WINDOW * model.rate), round(MARGIN * model.rate)
        top = min(model.highest_frequency, 0.2 * model.rate)
        self._filters = derivative_filters(float(model.rate), float(top))[:3]
        self._late = model.delay - model.block  # samples, from a row of the drive to the interval in which it acts
        bins = np.arange(0, self.length // 2)
        hertz = bins * model.rate / self.length
        self._bins = bins[(hertz >= BAND[0]) & (hertz <= min(BAND[1], top))][::SPACING]
        self._window = np.hanning(self.length + 1)[:-1]
        self._variance = max(model.sensed_noise, LEAST_NOISE * model.sensed_limit) ** 2  # of a sensor's noise (m2)
        self._lines = np.r_[0, self._bins]
        self._noise = self._noise_density()
        self._precision = 2.0 * np.linalg.inv(self._noise[1:])  # of complex numbers: half the variance in the real part
        largest = [error * abs(getattr(model, name)).max() for name, error in ERRORS.items()]
        self._prior = np.diag(np.r_[np.repeat(largest, 3), DELAY_ERROR, 1.0, 1.0] ** -2.0)
        self._information, self._known = self._prior.copy(), np.zeros(len(self._prior))
        self._rest: Array | None = None  # force that the free plate leaves at 0 Hz: offsets of the sensors
        self._free: Array | None = None  # last window of the free plate, until no touch is seen to follow
        self._pieces: list[Array] = []
        self._count = self._skip = 0  # samples in them; how many are to come that are done with
        self.last: TouchTest | None = None
        self.tests = self.detections = 0
        self.two = False

    def update(self, drive: Array, sensed: Array, position: Array, flags: Array) -> Array:
        """Take the next samples and return `Flag.TWO_TOUCHES` of each by which two fingers are known to touch, else 0.

        `drive` (n, channels) and `sensed` (n, sensors) are as played and measured, `position` (n,) is that of the
        finger (m, NaN while lifted); windows with samples whose `flags` (n,) are `UNUSABLE` are left out.
        """
        rows = np.column_stack((drive, sensed, position, flags & UNUSABLE))[self._skip :]
        self._skip -= len(position) - len(rows)
        self._pieces.append(rows)
        self._count += len(rows)
        need = self.length + TAPS - 1 + self._late
        raised = np.full(len(position), TWO_TOUCHES * self.two)
        while self._count >= need:
            last = len(position) - 1 - (self._count - need)  # of the window
            rows = np.concatenate(self._pieces)
            done = self._take(rows[:need])
            self._skip = max(done - len(rows), 0)
            self._pieces, self._count = [rows[done:]], max(len(rows) - done, 0)
            raised[last:] = TWO_TOUCHES * self.two
        return raised

    def restart(self) -> None:
        """Begin a new window: samples are missing here."""
        self._pieces, self._count, self._skip, self._free = [], 0, 0, None

    def _take(self, rows: Array) -> int:
        """Test or learn from a window; returns the samples that are done with: up to a while after a change."""
        position, channels = rows[:, -2], self.model.force_from_drive.shape[1]
        touching = np.isfinite(position)
        changes = np.flatnonzero(np.diff(touching))
        if changes.size or rows[:, -1].any() or not np.isfinite(rows[:, :-2]).all():
            self.two, self._free = self.two and bool(touching.all()), None
            return int(changes[-1]) + 1 + self._margin if changes.size else self.length
        parts = self._parts(rows[:, :channels], rows[:, channels:-2])
        if touching.all():
            first = self._late + TAPS // 2 - 1
            self.last = self._test(parts, self.model.lever_per_metre * position[first : first + self.length])
            self.tests, self.two, self._free = self.tests + 1, self.last.two, None
            self.detections += self.two
        else:
            if self._free is not None:
                self._calibrate(self._free)
            self.two, self._free = False, parts
        return self.length

    def _parts(self, drive: Array, sensed: Array) -> Array:
        """Force B i and the motion's derivatives of order 0, 1, 2 in both coordinates, shape (4, 2, length)."""
        model, n = self.model, self.length
        motion = sensed[self._late :] @ model.coordinate_from_sensed.T
        acting = drive[TAPS // 2 - 1 : TAPS // 2 - 1 + n] @ model.force_from_drive.T
        derivatives = [[np.correlate(motion[:, c], each, "valid")[:n] for c in (0, 1)] for each in self._filters]
        return np.array([acting.T, *derivatives])

    def _noise_density(self) -> Array:
        """Covariance of the force's spectrum by the sensors' noise, of 0 Hz and every bin, shape (bins + 1, 2, 2)."""
        model, power = self.model, float(np.sum(self._window**2))
        turn = np.exp(2j * np.pi / self.length * np.multiply.outer(self._lines, np.arange(TAPS)))
        h = turn @ self._filters.T
        terms = (model.stiffness, model.damping, model.mass)
        response = sum(h[:, k, None, None] * each for k, each in enumerate(terms)) @ model.coordinate_from_sensed
        density = self._variance * power * response @ np.conj(np.swapaxes(response, 1, 2))
        density[0] += (DRIFT * self._window.sum()) ** 2 * (response[0] @ response[0].conj().T)
        return density.real  # the sensors are alike: cross terms are real but for the filters' tiny phase

    def _spectrum(self, signal: Array) -> Array:
        """Hann-weighted spectrum at 0 Hz and at the bins, along the last axis."""
        return np.fft.rfft(signal * self._window, axis=-1)[..., self._lines]

    def _force(self, parts: Array) -> Array:
        """Return f = B i - K q - C q' - M q'' in both coordinates, shape (2, length)."""
        model = self.model
        return parts[0] - model.stiffness @ parts[1] - model.damping @ parts[2] - model.mass @ parts[3]

    def _regressors(self, parts: Array) -> Array:
        """Forces per error of K, C and M (entries 11, 12, 22 each) and per sample of delay, shape (2, 12, length).

        The last two entries are for a late position: 0.
        """
        found = np.zeros((2, 12, parts.shape[-1]))
        for row in (0, 1):
            found[row, row:9:3], found[row, row + 1 : 9 : 3] = parts[1:, 0], parts[1:, 1]
            found[row, 9] = np.gradient(parts[0, row])
        return found

    def _calibrate(self, parts: Array) -> None:
        """Learn the plate's errors and the sensors' offsets from a window of the free plate; older ones fade.

        Bins in which the plate hardly moves are left out: their noise would be taken for a softer plate.
        """
        force, rows = self._spectrum(self._force(parts)), self._spectrum(self._regressors(parts))
        self._rest = force[:, 0].real
        quiet = self._variance * np.sum(self._window**2) * np.sum(self.model.coordinate_from_sensed[0] ** 2)
        moved = np.flatnonzero(abs(rows[0, 0]) ** 2 > LEAST_SIGNAL * quiet)
        moved = moved[moved > 0]
        rows, force = np.moveaxis(rows[:, :, moved], 2, 0), force[:, moved].T[:, :, None]
        weighted = rows.conj().transpose(0, 2, 1) @ self._precision[moved - 1]
        self._information = self._prior + KEPT * (self._information - self._prior) + (weighted @ rows).real.sum(axis=0)
        self._known = KEPT * self._known + (weighted @ force).real.sum(axis=0)[:, 0]

    def _test(self, parts: Array, lever: Array) -> TouchTest:
        """T over d by a grid and two refinements; the plate's errors are found for each d by least squares."""
        from scipy.ndimage import uniform_filter1d

        lever = uniform_filter1d(lever, max(round(SMOOTHED * self.model.rate), 1), mode="nearest")
        force, per_error = self._force(parts), self._regressors(parts)
        along, across = self._spectrum(force[0]), self._spectrum(force[1] - lever * force[0])
        speed = self.model.rate * np.gradient(lever)
        changes = [LATENESS * speed, LATENESS**2 / 2.0 * self.model.rate * np.gradient(speed)]  # of the lever arm
        per_error[1, 10:] = np.array(changes) * force[0]
        rows = self._spectrum(per_error[1] - lever * per_error[0]), self._spectrum(per_error[0])
        if self._rest is None:
            along, across, rows = along[1:], across[1:], (rows[0][:, 1:], rows[1][:, 1:])
        else:
            along[0] -= self._rest[0]
            across[0] -= self._rest[1] - lever.mean() * self._rest[0]
        spread, best = POSITION_ERROR * self.model.lever_per_metre, 0.0
        mean, noise = float(lever.mean()), self._noise[len(self._noise) - along.size :]
        fixed = float(self._known @ np.linalg.solve(self._information, self._known))
        for width in (1.0, 0.25, 0.0625):
            errors = best + spread * width * SEARCH
            left, per_error = across - errors[:, None] * along, rows[0] - errors[:, None, None] * rows[1]
            totals = self._values(left, per_error, noise, mean + errors) + (errors / spread) ** 2
            best, statistic = float(errors[np.argmin(totals)]), fixed + float(totals.min())
        freedom = 2.0 * along.size - (1.0 if self._rest is not None else 0.0)  # at 0 Hz a number is real
        return TouchTest(statistic, freedom, bound_of(freedom), best / self.model.lever_per_metre)

    def _values(self, left: Array, rows: Array, noise: Array, lever: Array) -> Array:
        """T for each `lever` (e,), but for its terms without the data; `left` (e, bins), `rows` (e, errors, bins).

        It is found by least squares over the plate's errors and lateness.
        """
        combine = np.stack([-lever, np.ones_like(lever)])
        variance = np.einsum("ie,kij,je->ek", combine, noise, combine)
        weight = 2.0 / variance
        if left.shape[1] > self._bins.size:
            weight[:, 0] = 1.0 / variance[:, 0]
        weighted = rows.conj() * weight[:, None]
        matrix = self._information + (weighted @ rows.transpose(0, 2, 1)).real
        vector = self._known[:, None] + (weighted @ left[:, :, None]).real
        explained = (vector * np.linalg.solve(matrix, vector)).sum(axis=(1, 2))
        return np.asarray((weight * abs(left) ** 2).sum(axis=1) - explained)


def windows_under_touch(recording: Recording, model: DeviceModel) -> list[tuple[float, TouchTest]]:
    """Test every whole window of a recording under a finger; each with the time by which it was over (s).

    The recording is of a plate, with its drive, what was sensed and the finger's position; the model is that of
    ``hapticrender.prepare(scene).model``, or of `PlateParameters.device_model`.
    """
    monitor, found, piece = TouchMonitor(model), [], round(0.1 * WINDOW * model.rate)
    signals = [recording.drive, recording.sensed, recording.position, recording.flags]
    for start in range(0, len(recording), piece):
        before = monitor.tests
        monitor.update(*(each[start : start + piece] for each in signals))
        if monitor.last is not None and monitor.tests > before:
            found.append((min(start + piece, len(recording)) / recording.rate, monitor.last))
    return found


class TouchWatch:
    """A `TouchMonitor` on a running controller: while two fingers touch, the waveform law is set back and slowed.

    What was learned of the finger returns to the prior, of the device to what it was while one finger explained the
    signals, and the law assumes `SLOWER` times the variance of what it measures: it is the open inverse of an average
    finger, which improves slowly.  Once one finger explains the signals again it learns as designed.

    Laws by bands are left as they are.  Without `active` nothing is tested, as on a
    simulated device, which has one finger; without `slows`, `slow` is left to the thread that runs the controller.
    """

    def __init__(self, model: DeviceModel, controller: Any, active: bool = True, slows: bool = True) -> None:
        self._slows, self._slowed, self._tests = slows, False, 0
        self.monitor = TouchMonitor(model) if active and measures_moment(model) else None
        self._law: Any = getattr(controller, "law", None)
        self._kept: dict[str, Array] = {}
        if self._law is not None:
            self._kept["noise"] = self._law["noise"].copy()
            self._note_device()

    @property
    def flags(self) -> Flag:
        """`Flag.TWO_TOUCHES` once it was ever raised."""
        return Flag.TWO_TOUCHES if self.monitor is not None and self.monitor.detections else Flag(0)

    def update(self, signals: Mapping[str, Array]) -> Array:
        """Take the next drive, sensed, position and flags; returns the flags, with `Flag.TWO_TOUCHES` where it is."""
        monitor = self.monitor
        if monitor is None or signals["sensed"].shape[1] != 2:
            return signals["flags"]
        raised = monitor.update(*(signals[name] for name in ("drive", "sensed", "position", "flags")))
        if self._slows:
            self.slow()
        return signals["flags"] | raised

    def slow(self) -> None:
        """Set the law back and slow it, or let it go on, by what was found last; while the controller does not run."""
        monitor = self.monitor
        if monitor is None or self._law is None:
            return
        two, tests, law, kept, end = monitor.two, monitor.tests, self._law, self._kept, int(LOAD)
        if two == self._slowed and tests <= self._tests:
            return
        if two and not self._slowed:
            law["theta"][:end], law["covariance"][:end] = law["prior"][:end], law["prior_covariance"][:end]
            law["covariance"][:, :end] = law["prior_covariance"][:, :end]
            law["theta"][DEVICE], law["covariance"][DEVICE, DEVICE] = kept["theta"], kept["covariance"]
        elif not two:
            self._note_device()
        law["noise"] = kept["noise"] * (SLOWER if two else 1.0)
        self._slowed, self._tests = two, tests

    def _note_device(self) -> None:
        """Note what is learned of the device itself, while one finger explains the signals."""
        self._kept["theta"] = self._law["theta"][DEVICE].copy()
        self._kept["covariance"] = self._law["covariance"][DEVICE, DEVICE].copy()
