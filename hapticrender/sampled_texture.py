"""A texture in memory as compiled code reads it: a ring of samples in time, and a profile along the surface.

`SampledTexture.fill` keeps the ring a few seconds ahead.  The profile is sampled once, `STEP` apart, and read by cubic
interpolation, whose error at 25 points a wavelength is 1e-4.  A sum of textures has both.  A texture in time and place
at once is an `EvaluatedTexture`: compiled code calls Python for it in every block.
"""

from __future__ import annotations

import ctypes
from functools import partial
from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender.jit import F8, Addressed, call, kernel, pointer, record, record_of
from hapticrender.protocols import Array, Rendering, Texture
from hapticrender.touch.composed import PLACES, SOON, SeparatedTexture

AHEAD = 2.0  # s: samples in time that are computed ahead; of a program that is later the texture fades out
CHUNK = 4096  # samples computed at once
STEP, REACH = 2e-6, 0.15  # m: of the profile, and to either side of the surface's middle
FADE = 0.04  # s: of one texture into another, and of what ends

TEXTURE = np.dtype(
    [
        *((name, np.int64) for name in ("samples_at", "length", "written", "begun", "profile_at", "points", "control")),
        *((name, np.int64) for name in ("evaluate", "values_at", "follows")),
        *((name, np.float64) for name in ("start", "spacing", "fade")),
    ]
)
"""Ring of samples, how many were ever written, the sample at which the texture began; profile from `start` (m) on; the
record of the controller that plays it (`realtime_kernel.CONTROL`).  Function that evaluates it, values of the block at
its samples and the look-ahead later, whether they are 0 while the finger is away."""
READER = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)
TEXTURE_T = numba.from_dtype(TEXTURE)


@kernel
def smoothstep(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def in_time(texture, sample):
    """Its function of time, at a sample of the device's clock; fades out where nothing has been written yet."""
    v = record(texture, TEXTURE_T, 0)
    k = sample - v.begun
    if v.length == 0 or k < 0 or k >= v.written:
        return 0.0
    return smoothstep((v.written - k) / v.fade) * carray(pointer(v.samples_at, F8), v.length)[k % v.length]


@kernel
def along_surface(texture, position):
    """Its function of position, at a position (m): cubic interpolation; the ends of the profile go on."""
    v = record(texture, TEXTURE_T, 0)
    if v.points == 0 or not abs(position) < 1e3:
        return 0.0
    profile = carray(pointer(v.profile_at, F8), v.points)
    place = min(max((position - v.start) / v.spacing, 1.0), v.points - 3.0)
    i = int(place)
    x = place - i
    low, high = (x + 1.0) * (2.0 - x) / 2.0, x * (1.0 - x) / 6.0
    inner = low * ((1.0 - x) * profile[i] + x * profile[i + 1])
    return inner - high * ((2.0 - x) * profile[i - 1] + (1.0 + x) * profile[i + 2])


@kernel
def evaluate(texture, sample):
    """Let Python evaluate it for the block that begins at a sample of the device's clock, if it is one in both."""
    if texture != 0:
        v = record(texture, TEXTURE_T, 0)
        if v.evaluate != 0:
            call(v.evaluate, (sample - v.begun,))


@kernel
def value_at(texture, sample, position, touch, index):
    """Texture at a sample and a position (m), with the share of touch; `index` of the values that are evaluated."""
    v = record(texture, TEXTURE_T, 0)
    if v.evaluate != 0:
        return (touch if v.follows > 0 else 1.0) * carray(pointer(v.values_at, F8), index + 1)[index]
    return in_time(texture, sample) + touch * along_surface(texture, position)


class SampledTexture(Addressed):
    """A texture in memory at `rate` (Hz); a ValueError where `SeparatedTexture` refuses it, or it is not finite."""

    def __init__(self, texture: Texture, rate: float, waveform_of: Any = None) -> None:
        self.rate, self._parts = rate, SeparatedTexture(texture, waveform_of)
        self.control: Any = None  # keeps the controller that plays it alive
        self._samples = np.zeros(2 * round(AHEAD * rate) if self._parts.timed else 0)
        places = np.arange(-REACH, REACH, STEP) if self._parts.spatial else np.zeros(0)
        self._profile = self._parts.along_surface(places)
        arrays = {"samples_at": self._samples, "profile_at": self._profile}
        sizes = {"length": len(self._samples), "points": len(self._profile)}
        self.record = record_of(TEXTURE, **arrays, **sizes, start=-REACH, spacing=STEP, fade=FADE * rate)
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


class EvaluatedTexture(Addressed):
    """The texture of a rendering, a function of time and place at once, evaluated by Python in every block.

    `places` (m, shape (2, block)) is where the finger is, and where it will be `ahead` samples later, with the last
    place while it is lifted; `position` (m, shape (block,)) is the first row of it with NaN then.  What evaluating
    raises is in `error`; the texture is 0 from then on.  A ValueError where it is not the same when it is evaluated
    twice, or not finite.
    """

    def __init__(self, rendering: Rendering, ahead: int, places: Array, position: Array) -> None:
        bands, name = rendering.bands, type(rendering.scene.texture).__name__
        self._waveform = partial(bands.checked, name, rendering.waveform)
        tried = np.repeat(SOON, len(PLACES)), np.tile(PLACES, len(SOON))
        if (self._waveform(*tried) != self._waveform(*tried)).any():
            raise ValueError(f"{name}: must not change with a reading")
        self._places, self._position, self._follows = places, position, bands.follows_finger
        steps = np.arange(len(position))
        self._later = np.concatenate([steps, ahead + steps]) / rendering.driver.rate
        self._rate, self._values = rendering.driver.rate, np.zeros(places.size)
        self.control: Any = None  # keeps the controller that plays it alive
        self.error: BaseException | None = None
        self._read = READER(self._evaluate)
        address = ctypes.cast(self._read, ctypes.c_void_p).value
        self.record = record_of(TEXTURE, evaluate=address, values_at=self._values, follows=self._follows)
        self.address = int(self.record.ctypes.data)

    def _evaluate(self, sample: int) -> int:
        try:
            if self.error is None:
                position = self._places.copy()
                if not self._follows:
                    position[:, np.isnan(self._position)] = np.nan
                time = np.maximum(sample / self._rate + self._later, 0.0)
                self._values[:] = self._waveform(time, position.ravel())
        except BaseException as error:
            self.error, self._values[:] = error, 0.0
        return 0

    def fill(self, now: int) -> None:
        """Nothing is computed ahead."""
