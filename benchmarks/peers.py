"""A lock-in on scipy's filters, the reference of demodulation."""

import numpy as np
from scipy.signal import butter, sosfilt

BLOCK = 64  # samples


class ScipyLockIn:
    """Heterodyne and `scipy.signal.sosfilt`, all bands and channels at once, states carried from block to block.

    At its best: a block's carriers are a table made beforehand, turned by the phase at which the block starts.
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
