"""How much of its friction a finger keeps on a surface that vibrates at ultrasonic frequency: three laws.

mu/mu0 as a function of the amplitude a (m, peak) of the surface, the normal load W (N) and the sliding speed v (m/s):

* `FitLaw`: ``r + (1 - r) exp(-(a/a0)^p)``, whatever the load and the speed.
* `LoadSharing`: asperities and a squeeze film of mean gap u carry the load together,
  ``W/A = pc exp(-u/u0) + 1.25 p0 (a/u)^2`` and ``mu/mu0 = pc exp(-u/u0) A/W``: loses authority with load.
* `IntermittentContact`: the skin bounces, ``exp(-c mu0 a f/v)``: depends on speed, not on load.

The literature does not agree on one of them, so the law is a parameter.  Inside kernels a law is its `LawNumbers`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.plants.bounds import Validated, number
from hapticrender.protocols import Array

FIT, FILM, BOUNCE = 0, 1, 2  # kinds of law
LEAST_SHARE = 1e-6  # of the friction that amplitude can take away: less is never asked for, as laws end in exp(-...)
SETTLED = 1e-15  # relative step at which Newton's iteration ends


class LawNumbers(NamedTuple):
    """A law as kernels take it; what a kind does not use is 1 (0 for `floor`)."""

    kind: int
    floor: float  # r
    scale: float  # a0 or u0, m; 1/(c mu0 f), s
    exponent: float  # p
    contact: float  # pc A, N
    film: float  # 1.25 p0 A, N


@kernel
def film_fall(flat, lift):
    """Fall y = -ln(mu/mu0): the root of ``e^-y + lift/(flat + y)^2 = 1``, the gap being ``flat + y`` in u0.

    The left side is convex and falls, so Newton's steps from where the film alone would carry all never pass the root.
    """
    fall = math.sqrt(lift) - flat
    if not fall > 0.0:
        fall = 0.0
    for _ in range(50):
        gap = flat + fall
        film = lift / (gap * gap)
        excess = math.expm1(-fall) + film
        step = excess / (math.exp(-fall) + 2.0 * film / gap)
        if not step > SETTLED * gap:
            break
        fall += step
    return fall


@kernel
def friction_ratio(law_numbers, amplitude, load, speed):
    """mu/mu0 at an `amplitude` (m); 1 without load on a film, or beyond what its asperities carry."""
    law = law_numbers
    if amplitude <= 0.0:
        return 1.0
    if law.kind == FIT:
        return law.floor + (1.0 - law.floor) * math.exp(-((amplitude / law.scale) ** law.exponent))
    if law.kind == BOUNCE:
        return math.exp(-amplitude / (law.scale * abs(speed)))
    if not 0.0 < load < law.contact:
        return 1.0
    gap = amplitude / law.scale
    return math.exp(-film_fall(math.log(law.contact / load), law.film / load * gap * gap))


@kernel
def wanted_amplitude(law_numbers, ratio, load, speed):
    """Amplitude (m) that leaves `ratio` of the friction; beyond what a law reaches, the nearest; NaN asks for 0."""
    law = law_numbers
    share = (ratio - law.floor) / (1.0 - law.floor)
    if not share < 1.0:
        return 0.0
    fall = -math.log(share if share > LEAST_SHARE else LEAST_SHARE)
    if law.kind == FIT:
        return law.scale * fall ** (1.0 / law.exponent)
    if law.kind == BOUNCE:
        return law.scale * abs(speed) * fall
    if not 0.0 < load < law.contact:
        return 0.0
    gap = math.log(law.contact / load) + fall
    return law.scale * gap * math.sqrt(-math.expm1(-fall) * load / law.film)


@kernel
def friction_ratios(law_numbers, amplitude, load, speed, ratio):
    """`friction_ratio` for every element of flat arrays."""
    for n in range(ratio.size):
        ratio[n] = friction_ratio(law_numbers, amplitude[n], load[n], speed[n])


@kernel
def wanted_amplitudes(law_numbers, ratio, load, speed, amplitude):
    """`wanted_amplitude` for every element of flat arrays."""
    for n in range(ratio.size):
        amplitude[n] = wanted_amplitude(law_numbers, ratio[n], load[n], speed[n])


class FrictionLaw(Protocol):
    """What a law of friction reduction offers."""

    @property
    def numbers(self) -> LawNumbers:
        """The law as kernels take it."""
        ...

    def ratio(self, amplitude: Any, load: Any, speed: Any) -> Array:
        """mu/mu0, from 0 to 1, at an amplitude (m), normal load (N) and sliding speed (m/s)."""
        ...

    def amplitude(self, ratio: Any, load: Any, speed: Any) -> Array:
        """Amplitude (m) that leaves `ratio` of the friction."""
        ...


class _Law(Validated):
    """Checks and broadcasts for the kernels above; laws add their numbers."""

    _heaviest = math.inf  # N: a law holds below this load
    _unloaded = True  # whether a law holds without load

    @property
    def numbers(self) -> LawNumbers:
        """The law as kernels take it."""
        raise NotImplementedError

    def ratio(self, amplitude: Any, load: Any, speed: Any) -> Array:
        """mu/mu0 at an `amplitude` (m, >= 0), a normal `load` (N) and a sliding `speed` (m/s, its sign ignored)."""
        amplitude = _checked("amplitude", amplitude, 0.0, math.inf, "m")
        return self._each(friction_ratios, amplitude, load, speed)

    def amplitude(self, ratio: Any, load: Any, speed: Any) -> Array:
        """Amplitude (m) that leaves `ratio` of the friction, which must be in the law's reach, at most 1."""
        least = self.numbers.floor + LEAST_SHARE * (1.0 - self.numbers.floor)
        return self._each(wanted_amplitudes, _checked("ratio", ratio, least, 1.0), load, speed)

    def _each(self, kernel_of_arrays: Any, first: Array, load: Any, speed: Any) -> Array:
        load = _checked("load", load, 0.0, self._heaviest, "N")
        if load.size and not self._unloaded and load.min() == 0.0:
            raise ValueError("load = 0.0: must be > 0 N")
        speed = _checked("speed", speed, -math.inf, math.inf, "m/s")
        first, load, speed = np.broadcast_arrays(first, load, speed)
        result = np.empty(first.size)
        kernel_of_arrays(self.numbers, first.ravel(), load.ravel(), speed.ravel(), result)
        return result.reshape(first.shape)


@dataclass(frozen=True, kw_only=True)
class FitLaw(_Law):
    """mu/mu0 = floor + (1 - floor) exp(-(a/scale)^exponent).

    Parameters
    ----------
    floor : float
        Least mu/mu0, r: 0.05 to 0.3 in the literature's spread; >= 0 and < 1.
    scale : float, m
        Amplitude a0: 0.7e-6 to 1.8e-6; > 0.
    exponent : float
        p: 1 to 2; > 0.

    Notes
    -----
    Engineering defaults for 30 kHz and 0.5 N; the spread over devices is that of the ranges.  With p from 1.5 to 2
    the law mimics `LoadSharing` at 0.5 to 1 N down to the floor.

    Examples
    --------
    >>> FitLaw().ratio([0.0, 1e-6, 3e-6], load=0.5, speed=0.05).round(2).tolist()
    [1.0, 0.48, 0.11]
    """

    floor: float = number(0.10, most=0.999)
    scale: float = number(1.1e-6, "m", above=0.0)
    exponent: float = number(1.5, above=0.0)

    @property
    def numbers(self) -> LawNumbers:
        """The law as kernels take it."""
        return LawNumbers(FIT, float(self.floor), float(self.scale), float(self.exponent), 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class LoadSharing(_Law):
    """Asperities and a squeeze film carry the load together: W/A = pc exp(-u/u0) + 1.25 p0 (a/u)^2.

    Parameters
    ----------
    contact_pressure : float, Pa
        Of the asperities at no gap, pc; the load must stay below pc A.
    decay : float, m
        Gap u0 over which they let go; about the height of their roughness.
    pressure : float, Pa
        Of the air around, p0.
    area : float, m2
        Of the contact, A: 0.6e-4 to 2e-4.

    Notes
    -----
    Film: Salbu's limit of a large squeeze number; asperities after Wiertlewski et al. 2016 [recalled, not read].

    Examples
    --------
    >>> LoadSharing().ratio(1e-6, load=[0.25, 0.5, 1.0], speed=0.05).round(2).tolist()
    [0.29, 0.45, 0.56]
    """

    contact_pressure: float = number(200e3, "Pa", above=0.0)
    decay: float = number(1.5e-6, "m", above=0.0)
    pressure: float = number(101e3, "Pa", above=0.0)
    area: float = number(1e-4, "m2", above=0.0)

    _unloaded = False

    @property
    def _heaviest(self) -> float:  # type: ignore[override]
        return math.nextafter(self.numbers.contact, 0.0)

    @property
    def numbers(self) -> LawNumbers:
        """The law as kernels take it."""
        contact, film = self.contact_pressure * self.area, 1.25 * self.pressure * self.area
        return LawNumbers(FILM, 0.0, float(self.decay), 1.0, float(contact), float(film))


@dataclass(frozen=True, kw_only=True)
class IntermittentContact(_Law):
    """mu/mu0 = exp(-c mu0 a f/v): a bouncing skin touches for a part of each cycle.

    Parameters
    ----------
    coefficient : float
        c: 0.5 to 5; with 2, mu0 0.8 and 30 kHz, 1.04 um take the friction to 1/e at 50 mm/s, as `FitLaw` has it.
    friction : float
        Friction coefficient mu0 without vibration: 0.3 to 1.2; > 0.
    frequency : float, Hz
        Of the vibration, f: 20e3 to 70e3.

    Notes
    -----
    After Vezzoli et al. 2017 [recalled: the form of the group is uncertain].  A finger that stands has no friction
    left at any amplitude > 0, so the law holds while it slides.

    Examples
    --------
    >>> IntermittentContact().ratio(1e-6, load=0.5, speed=[0.025, 0.05, 0.1]).round(2).tolist()
    [0.15, 0.38, 0.62]
    """

    coefficient: float = number(2.0, above=0.0)
    friction: float = number(0.8, above=0.0)
    frequency: float = number(30e3, "Hz", above=0.0)

    @property
    def numbers(self) -> LawNumbers:
        """The law as kernels take it."""
        return LawNumbers(BOUNCE, 0.0, 1.0 / (self.coefficient * self.friction * self.frequency), 1.0, 1.0, 1.0)


LAWS: dict[str, type[_Law]] = {"fit": FitLaw, "load-sharing": LoadSharing, "intermittent": IntermittentContact}


def _checked(name: str, value: Any, least: float, most: float, unit: str = "") -> Array:
    """Numbers that are finite and from `least` to `most`."""
    array = np.asarray(value, float)
    wrong = ~(np.isfinite(array) & (array >= least) & (array <= most))
    if wrong.any():
        bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", least), ("<=", most)) if math.isfinite(bound)]
        told = " and ".join(bounds) or "finite"
        raise ValueError(f"{name} = {array[wrong].flat[0]:g}: must be {told} {unit}".rstrip())
    return array
