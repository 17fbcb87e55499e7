"""A texture in memory as compiled code reads it: a ring of samples in time, and a profile along the surface.

`SampledTexture.fill` keeps the ring a few seconds ahead.  The profile is sampled once, `STEP` apart, and read by cubic
interpolation, whose error at 25 points a wavelength is 1e-4.  A sum of textures has both.

A texture in time and place at once fills the ring, too.  Where Python runs the device it is an `EvaluatedTexture`:
compiled code calls Python for it in every block.  Of a `ForeseenTexture` Python evaluates a piece of `PIECE` seconds
again and again, for where the finger will be, and hands it over through a triple buffer; compiled code lets it fade in
over what it replaces.
"""

import ctypes
from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender.defaults import FADE as FADE
from hapticrender.jit import F8, Addressed, call, entry, kernel, pointer, record, record_of, swap
from hapticrender.protocols import Array, Rendering, Texture
from hapticrender.touch.composed import SeparatedTexture, evaluated

AHEAD = 2.0  # s: samples in time that are computed ahead; of a program that is later the texture fades out
CHUNK = 4096  # samples computed at once
STEP, REACH = 2e-6, 0.15  # m: of the profile, and to either side of the surface's middle
PIECE, BLEND = 0.2, 5e-3  # s: evaluated at once of a texture in time and place; in which it fades over the one before
SLOTS, FRESH = 3, 4  # pieces; bit beside the number of the one in the middle: not yet read

TEXTURE = np.dtype(
    [
        *((name, np.int64) for name in ("samples_at", "length", "written", "begun", "back", "profile_at", "points")),
        *((name, np.int64) for name in ("control", "follows", "evaluate", "pieces_at", "width", "middle", "slot")),
        *((name, np.float64) for name in ("start", "spacing", "fade", "blend")),
    ]
)
"""Ring of samples, how many were ever written, the sample at which the texture began, the one from which on it fades in
again after none was there; profile from `start` (m) on; the record of the controller that plays it
(`realtime_kernel.CONTROL`); whether its samples are 0 while the finger is away.  Function that evaluates a block of
them; or pieces of `width` numbers: which sample is the first, then the samples."""
READER = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)
TEXTURE_T = numba.from_dtype(TEXTURE)
MIDDLE_AT = TEXTURE.fields["middle"][1] if TEXTURE.fields else 0
FOREVER = 2**61  # samples: longer than anything plays


@entry
def publish(middle, back):
    """Swap the writer's slot `back` for the one in the middle, whose number is at an address; returns the next one."""
    return swap(middle, back | FRESH) & (FRESH - 1)


@kernel
def smoothstep(x):
    """Third-order step from 0 to 1 over 0..1."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def in_time(texture, sample):
    """Its function of time, at a sample of the device's clock; fades out where nothing is written yet, and back."""
    v = record(texture, TEXTURE_T, 0)
    k = sample - v.begun
    if v.length == 0 or k < 0 or k >= v.written:
        return 0.0
    return (
        smoothstep(min(v.written - k, k - v.back) / v.fade) * carray(pointer(v.samples_at, F8), v.length)[k % v.length]
    )


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
def runs_out(texture, sample, block):
    """Whether its function of time fades out at the sample that begins a block, as no more has been written.

    What is written meanwhile fades in from the next block on, from the share that is left by then.
    """
    v = record(texture, TEXTURE_T, 0)
    after = sample + block - v.begun
    out = v.length > 0 and v.written - (sample - v.begun) < v.fade
    if out and v.width == 0:
        v.back = after - max(v.written - after, 0)
    return out


@kernel
def evaluate(texture, sample, ahead):
    """Take up what Python evaluates of a texture in time and place, for the block that begins at a sample.

    Python is called, or what it has evaluated meanwhile fades in over what it replaces, from the first sample on that
    has not been read; more slowly where that was fading out.  Those before it are read again, for the log.
    """
    v = record(texture, TEXTURE_T, 0)
    if v.evaluate != 0:
        call(v.evaluate, (sample - v.begun,))
    if v.middle & FRESH:
        v.slot = swap(texture + MIDDLE_AT, v.slot) & (FRESH - 1)
        piece = carray(pointer(v.pieces_at, F8), (SLOTS, v.width))[v.slot]
        ring, first, unread = carray(pointer(v.samples_at, F8), v.length), int(piece[0]), sample + ahead - v.begun
        over = v.blend if v.written - unread > v.fade else v.fade
        for k in range(unread - ahead, first + v.width - 1):
            before, share = in_time(texture, v.begun + k), smoothstep((k - unread) / over) if k >= first else 0.0
            ring[k % v.length] = before + share * (piece[1 + max(k - first, 0)] - before)
        v.written = max(v.written, first + v.width - 1)


@kernel
def value_at(texture, sample, position, touch):
    """Texture at a sample and a position (m), with the share of touch."""
    share = touch if record(texture, TEXTURE_T, 0).follows > 0 else 1.0
    return share * in_time(texture, sample) + touch * along_surface(texture, position)


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
        numbers = {"start": -REACH, "spacing": STEP, "fade": FADE * rate, "back": -FOREVER}
        self.record = record_of(TEXTURE, **arrays, **sizes, **numbers)
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
        self._places, self._position, steps = places, position, np.arange(len(position))
        self._later = np.concatenate([steps, ahead + steps])
        self.error: BaseException | None = None
        self._read = READER(self._evaluate)
        address = ctypes.cast(self._read, ctypes.c_void_p).value
        self._describe(rendering, ahead + len(position), evaluate=address, written=FOREVER)

    def _describe(self, rendering: Rendering, length: int, **values: Any) -> None:
        """Make the record, with a ring of `length` samples that are 0."""
        bands, name = rendering.bands, type(rendering.scene.texture).__name__
        self._waveform = evaluated(name, bands, rendering.waveform)
        self._rate, self._follows, self._samples = rendering.driver.rate, bands.follows_finger, np.zeros(length)
        self.control: Any = None  # keeps the controller that plays it alive
        self.record = record_of(
            TEXTURE, samples_at=self._samples, length=length, back=-FOREVER, follows=self._follows, **values
        )
        self.address = int(self.record.ctypes.data)

    def _values(self, samples: Array, places: Array, position: Array) -> Array:
        """Texture at its samples with the finger at `places` (m); lifted where `position` is NaN."""
        if not self._follows:
            places = np.where(np.isnan(position), np.nan, places)
        return np.asarray(self._waveform(np.maximum(samples / self._rate, 0.0), places))

    def _evaluate(self, sample: int) -> int:
        try:
            index, values = sample + self._later, np.zeros(len(self._later))
            if self.error is None:
                values = self._values(index, self._places.ravel(), np.tile(self._position, 2))
        except BaseException as error:
            self.error = error
        self._samples[index % len(self._samples)] = values
        return 0

    def fill(self, now: int) -> None:
        """Nothing is computed ahead."""


class ForeseenTexture(EvaluatedTexture):
    """As an `EvaluatedTexture`, but evaluated ahead of a callback that holds no lock: `PIECE` beyond the look-ahead.

    `path` (m, shape (2, ahead + n)) is where the finger will be from the next sample on, and with NaN while lifted.
    """

    def __init__(self, rendering: Rendering, ahead: int, path: Array) -> None:
        self._ahead, count = ahead, path.shape[1] - ahead
        self._pieces, self._back = np.zeros((SLOTS, 1 + count)), 0
        buffer = {"pieces_at": self._pieces, "width": 1 + count, "middle": 1, "slot": 2}
        fades = {"fade": FADE * rendering.driver.rate, "blend": BLEND * rendering.driver.rate}
        self._describe(rendering, 2 * (ahead + count), written=count, **fades, **buffer)
        self._samples[:count] = self._values(np.arange(count), *path[:, :count])

    def foresee(self, sample: int, path: Array) -> None:
        """Evaluate it again for a path that begins at `sample` of the device's clock."""
        first, piece = sample + self._ahead - int(self.record["begun"][0]), self._pieces[self._back]
        piece[0], piece[1:] = first, self._values(first + np.arange(len(piece) - 1), *path[:, self._ahead :])
        self._back = int(publish(self.address + MIDDLE_AT, self._back))
