"""Runs of an ultrasonic plate under its own amplitude loop, for the tests of either."""

from typing import NamedTuple

import numpy as np
from scipy.signal import hilbert

import hapticrender as hr
from hapticrender.control.controller import BankController
from hapticrender.plants.surface import SurfaceParameters
from hapticrender.plants.ultrasonic import UltrasonicParameters, UltrasonicPlate
from hapticrender.protocols import Array, Flag
from hapticrender.renderers.ultrasonic import amplitude_loop

FREE = hr.Finger.absent()
ASKED = 1e-6  # m
NOISE = 5e-3  # of 1 um: the loop leaves 1.1 nm of the sensor's noise, at 4.5 sigma


class Run(NamedTuple):
    """What a plate under its amplitude loop did; envelopes by Hilbert's transform, which spoils both ends."""

    time: Array
    wanted: Array
    amplitude: Array
    drive: Array  # V
    flags: Array
    loop: BankController
    mode: UltrasonicParameters

    def between(self, start, end):
        """The same from `start` to `end` (s)."""
        part = slice(*(round(each * self.mode.rate) for each in (start, end)))
        return Run(*(each[part] for each in self[:5]), self.loop, self.mode)

    @property
    def error(self):
        """Amplitude error as a share of what is wanted."""
        return self.amplitude / self.wanted - 1

    def settled_after(self, tolerance):
        """Time (s) from the first sample to the last one whose error is larger."""
        wrong = np.flatnonzero(abs(self.error) > tolerance)
        return (wrong[-1] + 1) / self.mode.rate if wrong.size else 0.0

    @property
    def longest_unlocked(self):
        """Longest time (s) without lock."""
        edges = np.flatnonzero(np.diff(np.r_[0, (self.flags & Flag.UNLOCKED) != 0, 0]))
        return max(edges[1::2] - edges[::2], default=0) / self.mode.rate


def held(load):
    return hr.Finger.still(normal_load=load) if load else FREE


def ran(wanted, seconds, finger=FREE, settings=None, **plant):
    """The plate under its own loop; `wanted` (m) over time (s); `settings` of the loop that differ."""
    parameters = SurfaceParameters.with_overrides(plant)
    mode, loop = parameters.carrier_mode, amplitude_loop(parameters)
    for name, value in (settings or {}).items():
        loop.state["p"][name] = value
    time = np.arange(round(seconds * mode.rate)) / mode.rate
    asked = np.broadcast_to(np.asarray(wanted(time) if callable(wanted) else wanted, float), time.shape).copy()
    drive, _, flags, sensed = UltrasonicPlate(mode, finger).closed_loop(loop, asked)
    return Run(time, asked, abs(hilbert(sensed.motion[:, 0])), drive[:, 0], flags, loop, mode)


def modulated(amplitude, frequency=400.0):
    return lambda t: amplitude * (1 + 0.5 * np.cos(2 * np.pi * frequency * t))
