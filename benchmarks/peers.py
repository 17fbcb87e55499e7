"""What others offer for a part of the work; where a package is not installed its case is left out."""

import numpy as np
from scipy.signal import butter, sosfilt

BLOCK = 64  # samples


class Absent(RuntimeError):
    """A peer is not installed."""


class ScipyLockIn:
    """Heterodyne and `scipy.signal.sosfilt`, all bands and channels at once, states carried from block to block.

    At its best: a block's carriers are a table made beforehand, turned by where the block starts.
    """

    def __init__(self, frequency, bandwidth, rate, channels):
        self.sections = butter(2, bandwidth, fs=rate, output="sos")
        self.turn = np.asarray(frequency) / rate
        self.table = 2.0 * np.exp(-2j * np.pi * np.outer(np.arange(BLOCK), self.turn))
        self.state = np.zeros((1, 2, channels, len(self.turn)), complex)
        self.turned = np.empty((BLOCK, channels, len(self.turn)), complex)
        self.sample = 0

    def run(self, signal):
        """Envelopes (64, channels, bands) of a block (64, channels)."""
        carrier = self.table * np.exp(-2j * np.pi * np.mod(self.sample * self.turn, 1.0))
        self.sample += BLOCK
        np.multiply(signal[:, :, None], carrier[:, None], out=self.turned)
        found, self.state = sosfilt(self.sections, self.turned, axis=0, zi=self.state)
        return found


class SlidingDFT:
    """The `sdft` package: as many bins as bands, a transform a channel, with its cheapest window."""

    def __init__(self, bands, channels):
        try:
            from sdft import SDFT
        except ImportError as error:
            raise Absent("the package sdft is not installed: pip install 'hapticrender[bench]'") from error
        self.each = [SDFT(bands, window="boxcar") for _ in range(channels)]

    def run(self, signal):
        """Bins (n, bands) of every channel of a block (n, channels)."""
        return [one.sdft(signal[:, c]) for c, one in enumerate(self.each)]


class PythonControl:
    """Open loop of the free plate in python-control, currents held: not even a controller, and no finger."""

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
        self.system = control.ss(a, b, np.hstack([one, zero]), zero).sample(1 / parameters.rate)

    def forced(self, current):
        """Displacements (samples, 2) under `current`, by `forced_response`."""
        return self.control.forced_response(self.system, self._time(current), current.T).outputs.T

    def stepped(self, current):
        """The same by `input_output_response`, which takes nonlinear systems as well."""
        return self.control.input_output_response(self.system, self._time(current), current.T).outputs.T

    def _time(self, current):
        return np.arange(len(current)) / self.rate
