"""A texture as compiled code reads it while it plays: samples in time, and a profile along the surface.

What lies in time is a ring of samples, which `Voice.fill` keeps a few seconds ahead; what lies along the surface is
sampled once, `STEP` apart, and read in between by cubic interpolation, whose error at 25 points a wavelength is 1e-4.
A texture's sum has both.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender.jit import F8, kernel, pointer, record
from hapticrender.protocols import Texture
from hapticrender.touch.composed import SeparatedTexture

AHEAD = 2.0  # s: samples in time that are computed ahead; a busy process that is later hears its texture fade out
CHUNK = 4096  # samples computed at once
STEP, REACH = 2e-6, 0.15  # m: of the profile, and to either side of the surface's middle
FADE = 0.04  # s: of one texture into another, and of what ends

VOICE = np.dtype(
    [
        *((name, np.int64) for name in ("samples_at", "length", "written", "begun", "profile_at", "points")),
        *((name, np.int64) for name in ("step", "controller", "signals", "analysed", "shared")),
        *((name, np.float64) for name in ("start", "spacing", "fade")),
    ]
)
"""Ring of samples, how many were ever written, the sample at which the texture began; profile from `start` (m) on.

Then the controller that plays it: its step, state and signals, whether it takes a waveform (else a factor), and the
table of the state that it shares with others (see `control.state_transfer`).
"""
VOICE_T = numba.from_dtype(VOICE)


@kernel
def eased(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def in_time(voice, sample):
    """What lies in time, at a sample of the device's clock; fades out where nothing has been written yet."""
    v = record(voice, VOICE_T, 0)
    k = sample - v.begun
    if v.length == 0 or k < 0 or k >= v.written:
        return 0.0
    return eased((v.written - k) / v.fade) * carray(pointer(v.samples_at, F8), v.length)[k % v.length]


@kernel
def along_surface(voice, position):
    """What lies along the surface, at a position (m): cubic interpolation; the ends of the profile go on."""
    v = record(voice, VOICE_T, 0)
    if v.points == 0 or not abs(position) < 1e3:
        return 0.0
    profile = carray(pointer(v.profile_at, F8), v.points)
    place = min(max((position - v.start) / v.spacing, 1.0), v.points - 3.0)
    i = int(place)
    x = place - i
    low, high = (x + 1.0) * (2.0 - x) / 2.0, x * (1.0 - x) / 6.0
    inner = low * ((1.0 - x) * profile[i] + x * profile[i + 1])
    return inner - high * ((2.0 - x) * profile[i - 1] + (1.0 + x) * profile[i + 2])


class Voice:
    """A texture in memory.

    Parameters
    ----------
    texture : Texture
        In time, along the surface (`spatial` is true), or a `Sum` of both.
    rate : float, Hz
    waveform : callable, optional
        In place of the texture's own, in the device's quantity.

    Raises
    ------
    ValueError
        Its parts are in time and along the surface, and it is no sum; or a sample is not finite.
    """

    def __init__(self, texture: Texture, rate: float, waveform: Any = None) -> None:
        self.texture, self.rate, self._parts = texture, rate, SeparatedTexture(texture, waveform)
        self.law: Any = None  # keeps the controller that plays it, and its signals, alive
        self._samples = np.zeros(2 * round(AHEAD * rate) if self._parts.timed else 0)
        places = np.arange(-REACH, REACH, STEP) if self._parts.spatial else np.zeros(0)
        self._profile = self._parts.along_surface(places)
        self.record = np.zeros(1, VOICE)
        values = {
            "samples_at": self._samples.ctypes.data,
            "length": len(self._samples),
            "profile_at": self._profile.ctypes.data,
            "points": len(self._profile),
            "start": -REACH,
            "spacing": STEP,
            "fade": FADE * rate,
        }
        for name, value in values.items():
            self.record[name] = value
        self.address = int(self.record.ctypes.data)
        self.fill(0)

    def fill(self, now: int) -> None:
        """Compute samples until `AHEAD` seconds beyond sample `now` of the texture."""
        written = int(self.record["written"][0])
        end = max(now, 0) + round(AHEAD * self.rate)
        while self._parts.timed and written < end:
            count = min(CHUNK, end - written)
            index = written + np.arange(count)
            self._samples[index % len(self._samples)] = self._parts.in_time(index / self.rate)
            written += count
            self.record["written"] = written
