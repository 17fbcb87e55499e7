"""Other libraries that do a part of what this one does, each at its best: settled numbers made beforehand."""

import importlib

import numpy as np
import scipy.signal
from numpy_loop import NumpyPlate
from pairing import interleave

BLOCK = 64  # samples


class NoPeer(RuntimeError):
    """A library to compare with is not installed."""


def peer(name):
    """Another library, by name."""
    try:
        return importlib.import_module(name)
    except ImportError as missing:
        raise NoPeer(f"{name} is not installed (extra bench)") from missing


def in_blocks(run, samples):
    """Hand over samples in whole blocks; returns what the last one gave."""
    found = None
    for start in range(0, len(samples), BLOCK):
        found = run(samples[start : start + BLOCK])
    return found


class LockIn:
    """`scipy.signal.sosfilt` of 2 y exp(-j w t), all bands and channels at once, its state carried on.

    A block's carrier is a table made beforehand, turned by where the block starts: an exp a sample would cost more.
    """

    def __init__(self, frequency, bandwidth, rate, channels):
        self.turn, self.samples = frequency / rate, 0
        self.table = 2 * np.exp(-2j * np.pi * np.outer(np.arange(BLOCK), self.turn))
        self.sections = scipy.signal.butter(2, bandwidth, fs=rate, output="sos")
        self.state = np.zeros((1, 2, channels, len(frequency)), complex)
        self.heard = np.empty((BLOCK, channels, len(frequency)), complex)

    def run(self, samples):
        carrier = self.table * np.exp(-2j * np.pi * np.mod(self.turn * self.samples, 1.0))
        self.samples += BLOCK
        heard = np.multiply(samples[:, :, None], carrier[:, None, :], out=self.heard)
        envelopes, self.state = scipy.signal.sosfilt(self.sections, heard, axis=0, zi=self.state)
        return envelopes


class SlidingDft:
    """`sdft.SDFT`, one a channel, with its cheapest window; bin k of N listens at k rate/(2 N)."""

    def __init__(self, bands, channels):
        self.each = [peer("sdft").SDFT(bands, window="boxcar") for _ in range(channels)]

    def run(self, samples):
        return [each.sdft(samples[:, c]) for c, each in enumerate(self.each)]


class ControlPlate:
    """The free plate as a system of python-control, its coil currents held from sample to sample."""

    def __init__(self, parameters):
        self.control = peer("control")
        inverse, nothing = np.linalg.inv(parameters.mass_matrix), np.zeros((2, 2))
        advance = np.block(
            [[nothing, np.eye(2)], [-inverse @ parameters.stiffness_matrix, -inverse @ parameters.damping_matrix]]
        )
        push = np.vstack([nothing, inverse @ parameters.force_from_drive])
        sense = np.hstack([NumpyPlate(parameters).sense_matrix, nothing])
        smooth = self.control.ss(advance, push, sense, nothing)
        self.system = self.control.c2d(smooth, 1 / parameters.rate, "zoh")

    def forced(self, current):
        """What the sensors of the open loop see (samples, 2), by `forced_response`."""
        return self.control.forced_response(self.system, U=current.T).outputs.T

    def stepped(self, current):
        """The same by `input_output_response`, which takes nonlinear systems as well."""
        time = np.arange(len(current)) * self.system.dt
        return self.control.input_output_response(self.system, time, current.T).outputs.T


def open_loop(parameters, pairs):
    """Simulated seconds a second of python-control's two ways through a second of open loop, outputs compared first."""
    plate, ideal = ControlPlate(parameters), NumpyPlate(parameters)
    current = 0.1 * np.random.default_rng(0).standard_normal((int(parameters.rate), 2))
    expected = np.empty_like(current)
    for n, each in enumerate(current):
        expected[n] = ideal.sense()
        ideal.advance(each)
    for found in (plate.forced(current), plate.stepped(current)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())
    paired = interleave(lambda: plate.forced(current), lambda: plate.stepped(current), pairs)
    return 1 / paired.candidate, 1 / paired.reference
