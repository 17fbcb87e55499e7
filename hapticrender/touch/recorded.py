"""Recorded textures: samples, or a sound file."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import Validated, checked, exactly_one, file_name, keep, numbers, parameter, require, show
from hapticrender.errors import SceneError, naming
from hapticrender.protocols import Array
from hapticrender.touch.composed import Composable
from hapticrender.touch.curve import Curve, strongest_carriers
from hapticrender.touch.grating import MOST_AMPLITUDE
from hapticrender.touch.motion import MOST_SPEED

MOST_FRAMES = 1 << 24
MOST_SAMPLES = 1 << 26  # in all channels: what is decoded
MOST_RATE = 768e3  # Hz
LOUDEST = 1e6  # times full scale
BLOCK = 1 << 16  # frames read at once
MOST_CARRIERS = 512
MOST_POINTS = 1 << 24  # of a curve
WHOLE = 0.99  # of a sound file: the length that a header gives for compressed sound may be an estimate
STREAMED = 2**31 - 2**16  # bytes: a length from here on was not known when the header was written
_PART = re.compile(r"^ *(?:RIFF|riff|Riff size|data|FORM|SSND|Data Size) *: (\d+) \(should be (\d+)\)", re.MULTILINE)
FELT = (20.0, 1000.0)  # Hz: what is played by default, up to where vibration is felt, or
CARRIED = (20.0, 400.0)  # where carriers are chosen
ENDS = 3.0  # periods of the lowest frequency: so far a kink where a recording is reflected reaches (a sine's: 0.3 %)


def _peak(values: Array, ends: int = 0) -> float:
    """Peak of what is not constant, but for `ends` samples at each end."""
    return float(np.abs(values[ends : max(values.size - ends, 0)] - values.mean()).max(initial=0.0))


@dataclass(frozen=True, kw_only=True)
class Recorded(Validated, Composable):
    """Recorded samples as a texture, in time or in space; beyond its ends it runs back and forth (reflection).

    Parameters
    ----------
    file : str or Path
        Whatever soundfile reads: WAV, FLAC, W64, ...; at most 2**24 frames.  Or instead:
    samples, rate : array_like, shape (n,), n >= 2, and float, Hz
        Numbers within 1e6 and their sampling rate.
    amplitude, gain : float, m, or m per full scale of the file
        Target peak, or scale; exactly one, > 0; the peak must be <= 0.01 m.  What the filter adds where the recording
        is reflected is not part of the peak: a sine that begins at phase 0 is up to 14 % larger there.  The gain that
        plays a recording exactly often feels too weak: about 3 times as much suits fine textures, 5 times coarse ones.
    channel : int
        Counted from 0.
    speed : float, m/s, or None
        At which a finger recorded it: then it is read at the finger's position,
        its middle at the middle of the surface.  None: played in time.
    carriers : int or None
        How many of the strongest peaks of its spectrum are followed, 1 to 512.  None: the whole waveform is played,
        which methods that work band by band refuse.
    spacing, passband : float, (float, float), Hz
        Least distance of the carriers, and what is played, at the recorded speed: by default 20 to 400 Hz with
        carriers, 20 to 1000 Hz without.

    Examples
    --------
    >>> denim = Recorded(file="denim.wav", amplitude=20e-6, speed=0.1)
    >>> denim.speed
    0.1
    """

    kind: ClassVar[str] = "recorded"

    file: str | None = checked(file_name, None)
    samples: tuple[float, ...] | None = checked(numbers, None, least=-LOUDEST, most=LOUDEST)
    rate: float | None = parameter(None, "Hz", least=1.0, most=MOST_RATE)
    channel: int = parameter(0, least=0, most=1023)
    speed: float | None = parameter(None, "m/s", above=1e-6, most=MOST_SPEED)
    amplitude: float | None = parameter(None, "m", above=0, most=MOST_AMPLITUDE)
    gain: float | None = parameter(None, "m per unit of the file", above=0, most=1e3)
    carriers: int | None = parameter(None, least=1, most=MOST_CARRIERS)
    spacing: float = parameter(40.0, "Hz", least=0.1, most=1e5)
    passband: tuple[float, float] | None = checked(numbers, None, unit="Hz", least=1.0, most=1e5, count=2)

    def __post_init__(self) -> None:
        super().__post_init__()
        exactly_one(amplitude=self.amplitude, gain=self.gain)
        if self.passband is None:
            keep(self, passband=FELT if self.carriers is None else CARRIED)
        low, high = self.passband or FELT
        require(low < high, "passband", self.passband, "two rising frequencies in Hz")
        exactly_one(file=self.file, samples=self.samples)
        require(self.samples is None or len(self.samples) >= 2, "samples", self.samples, ">= 2 numbers")
        bound = "left out, as the file has one" if self.samples is None else f"a number of Hz <= {MOST_RATE:g}"
        require((self.rate is None) == (self.samples is None), "rate", self.rate, bound)

    @cached_property
    def curve(self) -> Curve:
        """The recording inside its passband, in m over recorded seconds; reads the file at the first use."""
        if self.samples is not None and self.rate is not None:
            values, step = np.array(self.samples), 1 / self.rate
        else:
            values, step = _read_sound(str(self.file), self.channel)
        low, high = self.passband or FELT
        if 0.5 / step <= low:
            raise SceneError(f"passband = {self.passband} Hz: must start < {0.5 / step:g} Hz, half the file's rate")
        high = min(high, 0.5 / step)
        size = Curve.size(values.size, step, high)
        if size > MOST_POINTS:
            raise SceneError(
                f"passband = {self.passband} Hz: {values.size * step:.3g} s up to {high:g} Hz take {size} points: must "
                f"be <= {MOST_POINTS}; shorten the recording or lower the passband"
            )
        curve = Curve.band_limited(values, step, low, high)
        peak = float(np.abs(curve.values).max())
        if self.amplitude is None:
            scale = float(self.gain or 0.0)
            bound = f"m per unit of the file makes a peak of {scale * peak:.3g} m: must be <= {MOST_AMPLITUDE} m"
            if scale * peak > MOST_AMPLITUDE:
                raise SceneError(f"gain = {scale:g} {bound}")
        elif peak <= 1e-9 * max(np.abs(values).max(), 1e-300):
            raise SceneError(f"amplitude = {self.amplitude} m: nothing to scale between {low:g} and {high:g} Hz")
        else:
            scale = self.amplitude / min(peak, max(_peak(values), _peak(curve.values, round(ENDS / low / curve.step))))
        return Curve(curve.values * scale, curve.step)

    @property
    def spatial(self) -> bool:
        """Whether it is read at the finger's position."""
        return self.speed is not None

    def check(self) -> None:
        """Read the file, so that a bad one is refused before anything plays."""
        self.curve  # noqa: B018
        self.bands(rate=np.inf)

    def bands(self, rate: float) -> Bands:
        """Carriers at the strongest peaks of the spectrum; their envelopes are to be analysed.

        Over time they are below rate/2 (`rate` in Hz).  None without `carriers`: the whole waveform is played.
        """
        if self.carriers is None:
            return Bands.none(spatial=self.spatial)
        curve, chosen = self.curve, {"count": self.carriers, "spacing": self.spacing, "passband": self.passband}
        frequency = strongest_carriers(curve.values, 1 / curve.step, **chosen)  # type: ignore[arg-type]
        if self.speed is not None:
            return Bands(frequency=0 * frequency, wavenumber=frequency / self.speed, phase=0 * frequency)
        frequency = frequency[frequency < rate / 2]
        return Bands(frequency=frequency, wavenumber=0 * frequency, phase=0 * frequency)

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,)); a spatial recording is still where `position` (m) is NaN."""
        if self.speed is None:
            return self.curve.at(time)
        touching = np.isfinite(position)
        recorded = np.where(touching, position, 0.0) / self.speed + self.curve.length / 2
        return np.where(touching, self.curve.at(recorded), 0.0)


def _read_sound(file: str, channel: int) -> tuple[Array, float]:
    """One channel of a sound file, and its step (s); memory is bounded by the channel's length; raises `SceneError`."""
    import soundfile

    with naming(f"file = {show(file)}"):
        if not Path(file).is_file():
            raise ValueError("must be an existing sound file")
        try:
            with soundfile.SoundFile(file) as sound:
                problem = _header_problem(sound, channel)
                blocks, rate = [np.zeros(0)], sound.samplerate
                while not problem and len(block := sound.read(BLOCK, dtype="float64", always_2d=True)):
                    blocks.append(block[:, channel].copy())
                values = np.concatenate(blocks)
                # bytes that a part holds and that its header states, where libsndfile's log shows both
                parts = [(int(held), int(stated)) for stated, held in _PART.findall(sound.extra_info)]
                lengths = [(values.size, sound.frames), *(each for each in parts if 0 < each[1] < STREAMED)]
        except (soundfile.SoundFileError, OSError, ValueError, TypeError) as error:
            raise ValueError(f"must be a readable sound file ({show(str(error))})") from error
        if problem:
            raise ValueError(problem)
        share = min(held / stated for held, stated in lengths)
        if share < WHOLE:
            raise ValueError(f"ends after {100 * share:.3g} % of what its header says: must be whole")
        for bad in np.flatnonzero(~(np.abs(values) <= LOUDEST))[:1]:  # NaN included
            bound = f"must be a finite number within {LOUDEST:g} times full scale"
            raise ValueError(f"sample {bad} of channel {channel} = {values[bad]}: {bound}")
        return values, 1 / rate


def _header_problem(sound: Any, channel: int) -> str:
    """Reason why a file is too long or too fast by its header, before anything is read; empty where it is not."""
    frames, channels = sound.frames, sound.channels
    if not 2 <= frames <= MOST_FRAMES:
        return f"has {frames} samples: must be >= 2 and <= {MOST_FRAMES} samples"
    if frames * channels > MOST_SAMPLES:
        return f"has {frames} samples in each of {channels} channels: must be <= {MOST_SAMPLES} samples together"
    if not 1 <= sound.samplerate <= MOST_RATE:
        return f"has a rate of {sound.samplerate} Hz: must be >= 1 and <= {MOST_RATE:g} Hz"
    return "" if channel < channels else f"channel = {channel}: must be < {channels}, its number of channels"
