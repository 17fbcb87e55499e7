"""Textures made of textures: sums, multiples and playlists; and the chirp."""

import math
import os
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from hapticrender.bands import NYQUIST_MARGIN, Bands
from hapticrender.checks import Validated, checked, number, parameter, require
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array, Texture

MOST_PARTS = 4096
MOST_GAIN = 1e6
LONGEST_PART = 360_000.0  # s
MOST_CHIRP = 0.01  # m
READINGS, PLACES = 0.0123 * 10.0 ** np.arange(6), np.linspace(-0.15, 0.15, 1001)  # s, m: where a texture is tried
SOON = READINGS[:3]  # s
NOMINAL_RATE = 5000.0  # Hz

Parts = tuple[tuple[Texture, float], ...]


class Composable:
    """Base of the library's textures: ``a + b``, ``a - b``, ``0.5 * a`` and ``sum([a, b])`` are `Sum`s."""

    def __add__(self, other: Any) -> "Sum":
        return Sum((*_terms(self), *_terms(other))) if isinstance(other, Texture) else NotImplemented

    def __mul__(self, gain: float) -> "Sum":
        return Sum(tuple((each, gain * own) for each, own in _terms(self)))

    __rmul__ = __mul__

    def __neg__(self) -> "Sum":
        return self * -1.0

    def __sub__(self, other: Any) -> "Sum":
        return self + -Sum(_terms(other)) if isinstance(other, Texture) else NotImplemented

    def __radd__(self, other: Any) -> Any:  # the 0 that `sum` begins with
        return self if isinstance(other, int) and other == 0 else NotImplemented


def _terms(texture: Any) -> Parts:
    return texture.parts if isinstance(texture, Sum) else ((texture, 1.0),)


def is_spatial(texture: Texture) -> bool:
    """Whether a texture is read at the finger's position: its `spatial` says so; without that, its bands do."""
    stated = getattr(texture, "spatial", None)
    return bool(texture.bands(NOMINAL_RATE).follows_finger if stated is None else stated)


def is_in_time(texture: Texture) -> bool:
    """Whether a texture, or every part of it, states that it is not read at the finger's position."""
    if isinstance(texture, _Composed):
        return all(is_in_time(part) for part, _ in texture.parts)
    return getattr(texture, "spatial", None) is False


def refuse_to_overwrite(texture: Texture, path: Any) -> None:
    """Refuse to write to `path` where a texture, or a part of it, is read from that file."""
    for part, _ in texture.parts if isinstance(texture, _Composed) else ():
        refuse_to_overwrite(part, path)
    files: tuple[Any, Any] = getattr(texture, "file", None), path
    if all(isinstance(each, str | os.PathLike) and os.path.exists(each) for each in files) and os.path.samefile(*files):
        raise ValueError(f"{path}: would overwrite the scene's texture: choose another name")


class InseparableTexture(ValueError):
    """A texture that is no sum of functions of time and of position."""


class SeparatedTexture:
    """A texture, parted into functions of time (`timed`: any part) and of position (`spatial`).

    It is in time, along the surface (see `is_spatial`), or a `Sum` of both; `waveform_of` a part is its waveform in the
    device's quantity, by default its own.  An `InseparableTexture` where its parts are in time and along the surface,
    and it is no sum; or a function of position is not the same at all `READINGS`, or one of time not at all `PLACES`.
    """

    def __init__(self, texture: Texture, waveform_of: Any = None) -> None:
        terms, name, here = _terms(texture), type(texture).__name__, " on a board"
        for each, _ in terms:
            kinds = {is_spatial(part) for part, _ in getattr(each, "parts", ())}
            if kinds == {True, False} or (True in kinds and not isinstance(each, Sum)):
                problem = f"{type(each).__name__} with a part along the surface"
                raise InseparableTexture(f"{problem}: play its parts one after another")
        self._terms = [
            (each, is_spatial(each), waveform_of(each) if waveform_of else each.waveform, gain) for each, gain in terms
        ]
        self.timed, self.spatial = (any(along == kind for _, along, _, _ in self._terms) for kind in (False, True))
        if self.spatial and self._varies(True, READINGS, 0):
            raise InseparableTexture(f"{name}: must not change with time{here}: it is a function of position")
        if self.timed and (
            self._varies(False, SOON, 1) or (self.in_time(SOON) != self._sum(False, SOON, 0.0 * SOON)).any()
        ):
            kept = f"the finger's position or contact{here}, or a reading"
            raise InseparableTexture(f"{name}: must not change with {kept}: it is a function of time")

    def _varies(self, spatial: bool, times: Array, axis: int) -> bool:
        """Whether a part changes over `times` (axis 0, s), or over `PLACES` (axis 1)."""
        found = np.stack([self._sum(spatial, np.full(len(PLACES), seconds), PLACES) for seconds in times])
        return bool(np.ptp(found, axis=axis).max() > 1e-6 * abs(found).max())

    def in_time(self, time: Array) -> Array:
        """Sum of the functions of time, at `time` (s, shape (n,)); a ValueError where it is not finite."""
        return self._sum(False, time, np.full(len(time), np.nan))

    def along_surface(self, position: Array) -> Array:
        """Sum of the functions of position, at `position` (m, shape (n,); 0 where it is NaN)."""
        return self._sum(True, np.zeros(len(position)), position)

    def _sum(self, spatial: bool, time: Array, position: Array) -> Array:
        bands, total = Bands.none(spatial=spatial), np.zeros(len(time))
        for texture, along, waveform, gain in self._terms:
            if along == spatial:
                total += gain * bands.checked(type(texture).__name__, waveform, time, position)
        return total


def evaluated(name: str, bands: Bands, waveform: Any) -> Any:
    """Return the waveform of time (s) and position (m), checked; a ValueError where two readings of it differ."""
    checked = partial(bands.checked, name, waveform)
    tried = np.repeat(SOON, len(PLACES)), np.tile(PLACES, len(SOON))
    if (checked(*tried) != checked(*tried)).any():
        raise ValueError(f"{name}: must not change with a reading")
    return checked


def _read_parts(key: str, value: Any, **bounds: Any) -> Parts:
    bound = f"1 to {MOST_PARTS} pairs of a texture and a number"
    require(isinstance(value, list | tuple) and 1 <= len(value) <= MOST_PARTS, key, value, bound, TypeError)
    for index, pair in enumerate(value):
        good = isinstance(pair, list | tuple) and len(pair) == 2 and isinstance(pair[0], Texture)
        require(good, f"{key}[{index}]", pair, bound, TypeError)
    return tuple((pair[0], number(f"{key}[{i}][1]", pair[1], **bounds)) for i, pair in enumerate(value))


class _Composed(Composable):
    """What sums and playlists share."""

    parts: Parts

    @property
    def spatial(self) -> bool:
        """Whether any part is read at the finger's position."""
        return any(is_spatial(texture) for texture, _ in self.parts)

    @property
    def _follows_finger(self) -> bool:
        return all(is_spatial(texture) for texture, _ in self.parts)

    def _bands_of_parts(self, rate: float) -> list[Bands]:
        """Bands of every part; a ValueError where `rate` (Hz) carries none of a part's, not even the lowest."""
        found = [texture.bands(rate) for texture, _ in self.parts]
        lowest = max(float(bands.frequency.min()) if len(bands) else 0.0 for bands in found)
        bound = f"<= {NYQUIST_MARGIN * rate:g} Hz, {NYQUIST_MARGIN} of the rate of {rate:g} Hz"
        require(lowest <= NYQUIST_MARGIN * rate, "texture.frequency", lowest, bound)
        return found

    def check(self) -> None:
        """Read the files of all parts."""
        for texture, _ in self.parts:
            if hasattr(texture, "check"):
                texture.check()


@dataclass(frozen=True)
class Sum(Validated, _Composed):
    """Sum of textures, each times a gain: what ``a + 0.5 * b`` makes.

    Notes
    -----
    It has the bands of all parts where every part has constant envelopes, those of its only part where it has one;
    else none, so that only methods that play a whole waveform take it.

    Examples
    --------
    >>> from hapticrender.touch.grating import Grating
    >>> both = Grating(amplitude=1e-6, frequency=50.0) + 0.5 * Grating(amplitude=1e-6, frequency=80.0)
    >>> both.bands(5000.0).frequency.tolist(), abs(both.bands(5000.0).envelope).tolist()
    ([50.0, 80.0], [1e-06, 5e-07])
    """

    kind: ClassVar[str] = "sum"

    parts: Parts = checked(_read_parts, about="textures and their gains, -1e6 to 1e6", least=-MOST_GAIN, most=MOST_GAIN)

    def bands(self, rate: float) -> Bands:
        """Bands of all parts for sampling at `rate` (Hz), equal carriers as one."""
        gains = [gain for _, gain in self.parts]
        found = list(zip(self._bands_of_parts(rate), gains, strict=True))
        if len(found) == 1 and found[0][0].envelope is None:
            return found[0][0]
        if any(bands.envelope is None for bands, _ in found):
            return Bands.none(spatial=self._follows_finger)
        carriers = np.concatenate([np.stack([bands.frequency, bands.wavenumber]) for bands, _ in found], axis=1)
        turned = [gain * bands.envelope * np.exp(1j * bands.phase) for bands, gain in found]  # type: ignore[operator]
        (frequency, wavenumber), which = np.unique(carriers, axis=1, return_inverse=True)
        envelope = np.zeros(len(frequency), complex)
        np.add.at(envelope, which.ravel(), np.concatenate(turned))
        return Bands(frequency=frequency, wavenumber=wavenumber, phase=np.zeros(len(frequency)), envelope=envelope)

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,)) at `time` (s) with the finger at `position` (m)."""
        values = [gain * texture.waveform(np.array(time), np.array(position)) for texture, gain in self.parts]
        return np.sum(values, axis=0)


@dataclass(frozen=True)
class Playlist(Validated, _Composed):
    """Textures one after another, each from its own t = 0; after the last the first again.

    Examples
    --------
    >>> played = Playlist([(Chirp(start=50.0, stop=200.0, duration=1.0, amplitude=1e-6), 1.0)])
    >>> len(played.bands(5000.0))
    0
    """

    kind: ClassVar[str] = "playlist"

    parts: Parts = checked(_read_parts, about="textures and durations, > 0", unit="s", above=0.0, most=LONGEST_PART)
    fade: float = parameter(5e-3, unit="s", about="in which each comes and goes (half of a shorter part); 0: at once")

    def bands(self, rate: float) -> Bands:
        """No carriers: the whole waveform is played; a ValueError where `rate` (Hz) does not carry a part's."""
        self._bands_of_parts(rate)
        return Bands.none(spatial=self._follows_finger)

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,)) at `time` (s) with the finger at `position` (m)."""
        ends = np.cumsum([seconds for _, seconds in self.parts])
        own, position = np.mod(np.asarray(time, float), ends[-1]), np.asarray(position, float)
        which, values = np.searchsorted(ends, own, side="right"), np.zeros(own.shape)
        for index, (texture, seconds) in enumerate(self.parts):
            here = which == index
            since = own[here] - (ends[index] - seconds)
            values[here] = texture.waveform(since, position[here])
            if self.fade > 0.0:
                values[here] *= smoothstep(np.minimum(since, seconds - since) / min(self.fade, seconds / 2))
        return values


@dataclass(frozen=True, kw_only=True)
class Chirp(Validated, Composable):
    """A sine whose frequency rises or falls steadily in time; after its end it goes back, and so on.

    Examples
    --------
    >>> chirp = Chirp(start=20.0, stop=400.0, duration=2.0, amplitude=5e-6)
    >>> chirp.waveform(np.array([0.0, 4.0]), np.full(2, np.nan)).round(9).tolist()
    [5e-06, 5e-06]
    """

    kind: ClassVar[str] = "chirp"
    spatial: ClassVar[bool] = False

    start: float = parameter(unit="Hz", about="first frequency", above=0, most=1e5)
    stop: float = parameter(unit="Hz", about="last frequency", above=0, most=1e5)
    duration: float = parameter(unit="s", about="from the one to the other", above=0, most=LONGEST_PART)
    amplitude: float = parameter(unit="m", about="peak", above=0, most=MOST_CHIRP)

    def bands(self, rate: float) -> Bands:
        """No carriers: the whole waveform is played; a ValueError where `rate` (Hz) does not carry it."""
        bound = f"<= {NYQUIST_MARGIN * rate:g} Hz, {NYQUIST_MARGIN} of the rate of {rate:g} Hz"
        for name, frequency in (("start", self.start), ("stop", self.stop)):
            require(frequency <= NYQUIST_MARGIN * rate, f"texture.{name}", frequency, bound)
        return Bands.none(spatial=False)

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,)): ``A cos 2 pi (f_0 t + (f_1 - f_0) t^2/(2 T))`` until T."""
        whole = 0.5 * (self.start + self.stop) * self.duration  # turns of a pass
        back, forth = np.divmod(np.asarray(time, float), 2.0 * self.duration)
        there = np.minimum(forth, 2.0 * self.duration - forth)
        turns = self.start * there + (self.stop - self.start) / (2.0 * self.duration) * there**2
        turns = 2.0 * whole * back + np.where(forth > self.duration, 2.0 * whole - turns, turns)
        return self.amplitude * np.cos(2.0 * math.pi * (turns % 1.0))
