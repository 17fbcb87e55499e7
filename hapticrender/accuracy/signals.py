"""What the cases of plates play, seeded: waveforms of 5 um rms in time, a modulated tone, and the path of a finger."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hapticrender.protocols import Array
from hapticrender.touch.composed import Chirp, Playlist
from hapticrender.touch.grating import Grating
from hapticrender.touch.recorded import Recorded

FINE, RMS = 20e3, 5e-6  # Hz, m: of the samples


def recorded(values: Array, high: float = 500.0, exponent: float = 0.0) -> Recorded:
    """Samples without energy outside 20 to `high` (Hz), of a power spectrum f^exponent times theirs, as a texture."""
    frequency, spectrum = np.fft.rfftfreq(len(values), 1 / FINE), np.fft.rfft(values)
    inside = (frequency >= 20.0) & (frequency <= high)
    spectrum[inside] *= frequency[inside] ** (exponent / 2)
    values = np.fft.irfft(np.where(inside, spectrum, 0.0), len(values))
    return Recorded(samples=tuple(values.tolist()), rate=FINE, gain=RMS / float(np.sqrt(np.mean(values**2))))


def white(seed: int) -> Recorded:
    """White noise of 20 to 400 Hz."""
    return recorded(np.random.default_rng(seed).standard_normal(round(5 * FINE)), high=400.0)


def pink(seed: int) -> Recorded:
    """Pink noise."""
    return recorded(np.random.default_rng(seed).standard_normal(round(5 * FINE)), exponent=-1.0)


def clicks(seed: int) -> Recorded:
    """One unit impulse every 60 to 140 ms, of either sign."""
    rng, values = np.random.default_rng(seed), np.zeros(round(5 * FINE))
    at = np.cumsum(rng.uniform(0.06, 0.14, 35))
    values[np.round(FINE * at).astype(int)] = rng.choice([-1.0, 1.0], 35)
    return recorded(values)


def chirp(_: int) -> Chirp:
    """20 to 480 Hz in 3 s."""
    return Chirp(start=20.0, stop=480.0, duration=3.0, amplitude=RMS * 2**0.5)


def modulated(frequency: float, amplitude: float) -> Playlist:
    """A tone (Hz, m) with 30 % AM at 5 Hz; as a playlist it has no carriers, and all of it is played."""
    partials = (1.0, 1.0, 0.0), (1.0 - 5.0 / frequency, 0.15, 0.0), (1.0 + 5.0 / frequency, 0.15, 0.0)
    return Playlist(((Grating(frequency=frequency, amplitude=amplitude, partials=partials), 60.0),), fade=0.0)


class Path(NamedTuple):
    """A finger's path: position (m) over time (s)."""

    position: Callable[[Array], Array]


def sliding(time: Array) -> Array:
    """Positions of a finger at 0.1 m/s, to and fro over +-25 mm, turning within 50 ms (4 m/s2).

    Turned at once, the finger's load alone shakes the plate by 1.4 % of 5 um rms, whatever is played.
    """
    turn = np.round(2.0 * time)
    since = np.abs(time - 0.5 * turn)
    away = 0.1 * np.where(since < 0.025, since**2 / 0.05 + 0.0125, since)
    return np.asarray((-1.0) ** turn * (0.025 - away))
