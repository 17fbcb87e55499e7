"""What others offer for a part of the work; where a package is not installed its case is left out."""

import numpy as np
from scipy.signal import sosfilt

from hapticrender.control.stdft import StarSTDFT


class Absent(RuntimeError):
    """A peer is not installed."""


class ScipyLockIn:
    """Heterodyne and `scipy.signal.sosfilt`, all bands and channels at once, states carried from block to block."""

    def __init__(self, frequency, bandwidth, rate, channels):
        b, a = StarSTDFT(bandwidth=bandwidth, rate=rate).coefficients
        self.sections = np.concatenate([b, a])[None]
        self.step = -2j * np.pi * np.asarray(frequency) / rate
        self.state = np.zeros((1, 2, channels, len(self.step)), complex)
        self.sample = 0

    def run(self, signal):
        """Envelopes (n, channels, bands) of a block (n, channels)."""
        index = np.arange(self.sample, self.sample + len(signal))
        self.sample += len(signal)
        turned = 2.0 * signal[:, :, None] * np.exp(np.outer(index, self.step))[:, None]
        found, self.state = sosfilt(self.sections, turned, axis=0, zi=self.state)
        return found


class SlidingDFT:
    """The `sdft` package: as many bins as bands, a transform a channel."""

    def __init__(self, bands, channels):
        try:
            from sdft import SDFT
        except ImportError as error:
            raise Absent("the package sdft is not installed: pip install 'hapticrender[bench]'") from error
        self.each = [SDFT(bands) for _ in range(channels)]

    def run(self, signal):
        """Bins (channels, n, bands) of a block (n, channels)."""
        return np.stack([one.sdft(np.ascontiguousarray(signal[:, c])) for c, one in enumerate(self.each)])


class PythonControl:
    """Open loop of the free plate by `control.forced_response`: not even a controller, and no finger."""

    def __init__(self, parameters):
        try:
            import control
        except ImportError as error:
            raise Absent("the package control is not installed: pip install 'hapticrender[bench]'") from error
        self.control, self.rate = control, parameters.rate
        inverse = np.linalg.inv(parameters.mass_matrix)
        zero, one = np.zeros((2, 2)), np.eye(2)
        a = np.block([[zero, one], [-inverse @ parameters.stiffness_matrix, -inverse @ parameters.damping_matrix]])
        b = np.vstack([zero, inverse @ parameters.force_from_drive])
        self.system = control.ss(a, b, np.hstack([one, zero]), np.zeros((2, 2))).sample(1 / parameters.rate)

    def run(self, samples):
        """Displacements (2, samples) under two sinusoidal currents."""
        time = np.arange(samples) / self.rate
        drive = np.vstack([np.sin(2 * np.pi * 47.0 * time)] * 2)
        return self.control.forced_response(self.system, timepts=time, inputs=drive).outputs
