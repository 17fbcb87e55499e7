"""Signals that tests play, and what is read out of those that come back."""

import numpy as np
import soundfile
from scipy.signal import butter, sosfiltfilt

from hapticrender.bands import Bands


class Own:
    """A texture of one's own: a function of time (s) and position (m), played whole where no bands are given."""

    def __init__(self, waveform, spatial=False, bands=None):
        self.waveform, self.spatial, self._bands = waveform, spatial, bands

    def bands(self, rate):
        return Bands.none(spatial=self.spatial) if self._bands is None else self._bands


def phasor(signal, frequency, rate=5000.0):
    """Complex amplitude of a carrier of whole periods in a signal, or in each column of it."""
    return 2 * np.exp(-2j * np.pi * frequency / rate * np.arange(len(signal))) @ signal / len(signal)


def white(samples, rms, seed=0, rate=5000.0):
    """White noise of 20-400 Hz."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(samples))
    frequency = np.fft.rfftfreq(samples, 1 / rate)
    found = np.fft.irfft(np.where((frequency > 20) & (frequency < 400), spectrum, 0.0), samples)
    return found * rms / found.std()


def waveform_error(motion, reference, start, rate=5000.0):
    """Rms of the deviation over that of the reference, 20-500 Hz, from `start` (s) on; of each column of motion."""
    sos = butter(4, [20, 500], "bandpass", fs=rate, output="sos")
    reference = reference[: len(motion)].reshape(-1, *[1] * (motion.ndim - 1))
    deviation, reference = (sosfiltfilt(sos, each, axis=0) for each in (motion - reference, reference))
    late = slice(round(start * rate), None)
    return np.sqrt((deviation[late] ** 2).mean(axis=0) / (reference[late] ** 2).mean())


def read_back(path, full_scale=3.0):
    """Drive (A, shape (n, channels)) in a sound file, scaled by `full_scale` (A)."""
    blocks, count = [], 65536
    with soundfile.SoundFile(path) as file:
        while count == 65536:
            block = np.full((65536, file.channels), np.nan)
            try:
                count = len(file.read(out=block))
            except soundfile.SoundFileError:  # of FLAC that was never closed it cannot find the end
                count = int(np.isfinite(block[:, 0]).sum())
            blocks.append(block[:count])
    return np.concatenate(blocks) * full_scale
