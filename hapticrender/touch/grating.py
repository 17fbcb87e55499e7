"""Gratings: textures of a few partials, in time or in space."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import Validated, checked, exactly_one, keep, number, option, parameter, require
from hapticrender.protocols import Array
from hapticrender.touch import perception
from hapticrender.touch.composed import Composable

MOST_AMPLITUDE = 0.01  # m: ten times the travel of any plate, so it catches a wrong unit
MOST_PARTIALS = 4096
PARTIALS = "order (need not be whole), relative amplitude and phase (rad) of each, instead of a shape"

Partial = tuple[float, float, float]


SHAPES: dict[str, Callable[[int], Partial]] = {  # partial n of a Fourier series of height 1 that is +1 at phase 0
    "sine": lambda n: (1.0, 1.0, 0.0),  # which has one
    "square": lambda n: (2.0 * n + 1, 4 / (np.pi * (2 * n + 1)), np.pi * (n % 2)),
    "triangle": lambda n: (2.0 * n + 1, 8 / (np.pi * (2 * n + 1)) ** 2, 0.0),
}


def _read_partials(key: str, partials: Any) -> tuple[Partial, ...]:
    bound = f"1 to {MOST_PARTIALS} entries of order, amplitude, phase"
    require(isinstance(partials, list | tuple | np.ndarray), key, partials, bound, TypeError)
    require(1 <= len(partials) <= MOST_PARTIALS, key, partials, bound)
    found = []
    for at, entry in ((f"{key}[{index}]", entry) for index, entry in enumerate(partials)):
        good = isinstance(entry, list | tuple | np.ndarray) and len(entry) == 3
        require(good, at, entry, "order, amplitude, phase", TypeError)
        order = number(f"{at}.order", entry[0], "", above=0, most=1e4)
        amplitude = number(f"{at}.amplitude", entry[1], "times the grating's", least=-100, most=100)
        found.append((order, amplitude, number(f"{at}.phase", entry[2], "rad", least=-1e6, most=1e6)))
    return tuple(found)


@dataclass(frozen=True)
class Grating(Validated, Composable):
    """A periodic texture, ``amplitude * sum_n a_n cos(n p + phase_n)``.

    In time ``p = 2 pi frequency t + phase``, in space ``p = 2 pi x / wavelength + phase`` at the finger's position x;
    exactly one of `frequency` and `wavelength` is given.

    Exactly one of `amplitude`, `velocity` and `level` is given, too; the others are those of a sine at the
    fundamental's frequency f, and converted at once: a grating keeps metres only.  In space f is speed/wavelength.

    Examples
    --------
    >>> tone = Grating(amplitude=10e-6, frequency=100.0)
    >>> float(tone.waveform(np.array([0.0]), np.array([np.nan]))[0])
    1e-05
    >>> ridges = Grating(amplitude=10e-6, wavelength=1e-3, shape="square", harmonics=2)
    >>> ridges.bands(rate=5000.0).wavenumber.round(6).tolist()
    [1000.0, 3000.0]
    >>> Grating(velocity=0.01, wavelength=1e-3, speed=0.1) == Grating(amplitude=0.01 / (200 * np.pi), wavelength=1e-3)
    True
    >>> f"{Grating(level=20.0, frequency=250.0).amplitude:.3g} m"
    '1.1e-06 m'
    """

    kind: ClassVar[str] = "grating"

    amplitude: float = parameter(None, "m", "peak of a sine, height of another shape", above=0, most=MOST_AMPLITUDE)
    frequency: float | None = parameter(None, "Hz", "of the fundamental", above=0, most=1e6)
    wavelength: float | None = parameter(None, "m", "of the fundamental", least=1e-6, most=0.5)
    shape: str = option("sine", *SHAPES, about="of the wave")
    harmonics: int = parameter(5, about="odd Fourier partials of a square or triangle", least=1, most=MOST_PARTIALS)
    partials: tuple[Partial, ...] | None = checked(_read_partials, None, about=PARTIALS)
    phase: float = parameter(0.0, "rad", "of the fundamental at t = 0, x = 0", least=-1e6, most=1e6)
    velocity: float | None = parameter(None, "m/s", "of the skin, 2 pi f times the amplitude", least=1e-9, most=10)
    level: float | None = parameter(None, "dB", "over the classic threshold, f 1 to 1000 Hz", least=-100, most=100)
    speed: float | None = parameter(None, "m/s", "of the finger, for the two above in space", least=1e-6, most=10)

    def __post_init__(self) -> None:
        super().__post_init__()
        exactly_one(frequency=self.frequency, wavelength=self.wavelength)
        key = exactly_one(amplitude=self.amplitude, velocity=self.velocity, level=self.level)
        usable = self.spatial and key != "amplitude"
        bound = "left out but where velocity or level of a grating in space is given"
        require(usable or self.speed is None, "speed", self.speed, bound)
        if key != "amplitude":
            require(not self.spatial or self.speed is not None, "speed", None, "a finite number >= 1e-06 m/s")
            frequency = self.frequency or self.speed / self.wavelength  # type: ignore[operator]
            amplitude = _in_metres(key, getattr(self, key), frequency)
            keep(self, amplitude=amplitude, velocity=None, level=None, speed=None)

    @property
    def spatial(self) -> bool:
        """Whether it is read at the finger's position."""
        return self.wavelength is not None

    def spectrum(self) -> tuple[Array, Array]:
        """Order (1) and complex amplitude (m) of every partial, the fundamental's phase included."""
        count = 1 if self.shape == "sine" else self.harmonics
        order, relative, own_phase = np.array(self.partials or [SHAPES[self.shape](n) for n in range(count)]).T
        return order, self.amplitude * relative * np.exp(1j * (own_phase + order * self.phase))

    def bands(self, rate: float) -> Bands:
        """One band a partial, with a constant envelope (`rate` in Hz is not needed)."""
        order, envelope = self.spectrum()
        none = np.zeros(order.size)
        frequency = none if self.frequency is None else order * self.frequency
        wavenumber = none if self.wavelength is None else order / self.wavelength
        return Bands(frequency=frequency, wavenumber=wavenumber, phase=none.copy(), envelope=envelope)

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,)); a spatial grating is still where `position` (m) is NaN."""
        if self.frequency is not None:
            turns = np.asarray(time, float) * self.frequency
        else:
            turns = np.asarray(position, float) / self.wavelength
        total = np.zeros(turns.shape)
        for order, envelope in zip(*self.spectrum(), strict=True):
            total += (envelope * np.exp(2j * np.pi * (order * turns % 1.0))).real
        return np.where(np.isfinite(turns), total, 0.0)


def _in_metres(key: str, value: float, frequency: float) -> float:
    """Amplitude (m) of a velocity (m/s) or level (dB) at `frequency` (Hz)."""
    low, high = perception.LOWEST, perception.HIGHEST
    bound = f"stated at {low:g} to {high:g} Hz, where the threshold is known; it is at {frequency:.4g} Hz"
    require(key == "velocity" or low <= frequency <= high, key, value, bound)
    convert = perception.from_velocity if key == "velocity" else perception.displacement
    with np.errstate(over="ignore", under="ignore"):
        amplitude = float(convert(value, frequency))
    bound = f"<= {MOST_AMPLITUDE} m as an amplitude; at {frequency:.4g} Hz it is {amplitude:.3g} m"
    require(amplitude <= MOST_AMPLITUDE, key, value, bound)
    return amplitude
