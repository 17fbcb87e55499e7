"""The finger's force from a plate's signals: motion and its derivatives, the drive's force, and their noise."""

import math

import numpy as np

from hapticrender.analysis.course import Signals
from hapticrender.analysis.smoothing import History, convolve, derivative_kernels, half_width, held_kernel
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array

DIFFERENCES = 6  # order of the differences that show a sensor's noise
FINEST = 1e-9  # m: least noise that is assumed
GAIN = 924.0  # of white noise through them: binomial(12, 6)


def sensor_noise(sensed: Array) -> Array:
    """Standard deviation (m) of white noise, rounding included, of each sensor (n, channels).

    From the sixth differences, which pass 2e-3 of a motion at a tenth of the sampling rate, 1e-6 at a thirtieth.
    """
    differences = np.diff(sensed, DIFFERENCES, axis=0)
    return np.sqrt((differences**2).mean(axis=0) / GAIN)


def at_least(noise: Array, plate: PlateParameters) -> Array:
    """Noise (m rms) of the sensors, but no less than that of their rounding, or 1 nm."""
    return np.maximum(noise, max(plate.sensor_step / math.sqrt(12.0), FINEST))


def _bending(plate: PlateParameters, rate: float, late: int) -> tuple[Array, Array]:
    """Filter (b, a) from a heave force (N), held over each sample `late` samples later, to the bending of it (m)."""
    from scipy.signal import cont2discrete

    w = 2 * math.pi * plate.bending_frequency
    if not w:
        return np.zeros(2), np.array([1.0, 0.0])
    mode = [plate.bending_coil / plate.bending_mass], [1.0, 2 * plate.bending_damping * w, w**2]
    (b,), a, _ = cont2discrete(mode, 1 / rate, "zoh")
    return np.r_[np.zeros(late), b], a


class MotionFilter:
    """Smooth the sensed motion, differentiate it twice, and smooth the drive's force by one kernel, block by block.

    What the drive itself bends of the glass, by the plate's bending mode, is subtracted from the motion.

    Row n of the drive is held while row n to n + 1 are sensed, `late` samples later.  Results come `delay` samples
    after the sample that they belong to.  `rate` is in Hz, `spread` (s) that of the kernel in `smoothing`.
    """

    def __init__(self, plate: PlateParameters, rate: float, spread: float, late: int = 0) -> None:
        self._plate, self.spread, self.delay = plate, spread, half_width(spread, rate)
        pad = late + 1  # the kernels of the motion are as long as that of the force
        self._motion = np.pad(derivative_kernels(spread, rate), ((0, 0), (0, pad)))
        self._force = held_kernel(spread, rate, late)
        self._sensed, self._drive = (History(len(self._force) - 1) for _ in range(2))
        self._mode, self._bent = _bending(plate, rate, late), None
        gains = np.array([plate.sensor_gain_1, plate.sensor_gain_2])
        self.coordinate_from_sensed = np.linalg.inv(plate.displacement(plate.ends)[:, :2]) / gains

    def update(self, drive: Array, sensed: Array) -> Signals:
        """Signals (n, 2) of the samples `delay` before those of drive (A, (n, coils)) and measurement (m, (n, 2))."""
        from scipy.signal import lfilter, lfilter_zi

        force, coordinates, (b, a) = self.force(drive), sensed @ self.coordinate_from_sensed.T, self._mode
        before = lfilter_zi(b, a) * force[0, 0] if self._bent is None else self._bent
        bent, self._bent = lfilter(b, a, force[:, 0], zi=before)
        coordinates[:, 0] -= bent
        motion = self._sensed.before(coordinates)
        middle = motion[0]  # far from zero the taps' rounding would show
        x, v, a = (convolve(motion - middle, taps) for taps in self._motion)
        return Signals(x + middle, v, a, convolve(self._drive.before(force), self._force))

    def force(self, drive: Array) -> Array:
        """Force (N, (n, 2)) on heave and rocking of a drive (A, (n, coils)), rounded and limited as the plate does."""
        p = self._plate
        step, limit = p.current_step, p.current_limit
        current = step * np.floor(drive / step + 0.5) if step else drive
        return np.clip(current, -limit, limit) @ p.force_from_drive.T

    def coordinate_noise(self, noise: Array) -> Array:
        """Standard deviation (m, (2,)) of heave and rocking for that of the sensors (m, (2,))."""
        return np.sqrt(self.coordinate_from_sensed**2 @ np.asarray(noise) ** 2)

    def force_noise(self, noise: Array) -> Array:
        """Standard deviation (N, (2,)) of the residual forces of heave and rocking by that of the sensors (m, (2,))."""
        p = self._plate
        balance = np.stack([np.diagonal(each) for each in (p.stiffness_matrix, p.damping_matrix, p.mass_matrix)])
        taps = balance.T @ self._motion
        return self.coordinate_noise(noise) * np.sqrt((taps**2).sum(axis=1))
