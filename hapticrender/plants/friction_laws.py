"""Friction of a finger on a surface that vibrates at ultrasonic frequency, as a function of amplitude: three laws.

They give mu/mu0 over the amplitude a (m, peak) of the surface, the normal load W (N) and the sliding speed v (m/s); the
literature does not agree on one of them (docs/theory.md, "Friction laws").  Inside kernels a law is a record of `LAW`.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hapticrender.checks import Validated, parameter
from hapticrender.jit import kernel
from hapticrender.protocols import Array

FIT, FILM, BOUNCE = 0, 1, 2  # kinds of law
LEAST_SHARE = 1e-6  # of the removable friction: the least that is requested, as laws end in exp(-...)
CONVERGED = 1e-15  # relative step at which Newton's iteration ends

LAW = np.dtype(
    [
        ("kind", "i8"),
        ("floor", "f8"),  # r
        ("scale", "f8"),  # a0 or u0, m; 1/(c mu0 f), s
        ("exponent", "f8"),  # p
        ("contact", "f8"),  # pc A, N
        ("film", "f8"),  # 1.25 p0 A, N
    ],
    align=True,
)
"""A law as kernels take it; what a kind does not use is 1 (0 for `floor`)."""


@kernel
def _film_exponent(gap_0, lift):
    """Y = -ln(mu/mu0) on a squeeze film: the root of ``e^-y + lift/(gap_0 + y)^2 = 1``, the gap being gap_0 + y in u0.

    The left side is convex and falls, so Newton's steps from where the film alone would carry all never pass the root.
    """
    y = max(math.sqrt(lift) - gap_0, 0.0)
    for _ in range(50):
        gap = gap_0 + y
        film = lift / (gap * gap)
        step = (math.expm1(-y) + film) / (math.exp(-y) + 2.0 * film / gap)
        if not step > CONVERGED * gap:
            break
        y += step
    return y


@kernel
def friction_ratio(law, amplitude, load, speed):
    """mu/mu0 at an `amplitude` (m); 1 without load on a film, or beyond what its asperities carry."""
    if amplitude <= 0.0:
        return 1.0
    if law.kind == FIT:
        return law.floor + (1.0 - law.floor) * math.exp(-((amplitude / law.scale) ** law.exponent))
    if law.kind == BOUNCE:
        return math.exp(-amplitude / (law.scale * abs(speed)))
    if not 0.0 < load < law.contact:
        return 1.0
    gap = amplitude / law.scale
    return math.exp(-_film_exponent(math.log(law.contact / load), law.film / load * gap * gap))


@kernel
def reference_amplitude(law, ratio, load, speed):
    """Amplitude (m) that leaves `ratio` of the friction: the nearest that a law reaches; 0 for NaN."""
    share = (ratio - law.floor) / (1.0 - law.floor)
    if not share < 1.0:
        return 0.0
    y = -math.log(max(share, LEAST_SHARE))
    if law.kind == FIT:
        return law.scale * y ** (1.0 / law.exponent)
    if law.kind == BOUNCE:
        return law.scale * abs(speed) * y
    if not 0.0 < load < law.contact:
        return 0.0
    gap = math.log(law.contact / load) + y
    return law.scale * gap * math.sqrt(-math.expm1(-y) * load / law.film)


friction_ratios = np.vectorize(friction_ratio, otypes=[float], excluded={0})
reference_amplitudes = np.vectorize(reference_amplitude, otypes=[float], excluded={0})
"""The same over arrays, which are broadcast."""


class FrictionLaw(Validated):
    """Base of the laws: checks arguments and broadcasts them over the kernels; a law adds its values."""

    floor = 0.0
    _heaviest = math.inf  # N: a law holds up to this load
    _unloaded = True  # whether a law holds without load

    def _values(self) -> tuple[float, ...]:
        """Values of the fields of `LAW`."""
        raise NotImplementedError

    @property
    def numbers(self) -> Any:
        """The law as kernels take it: a record of `LAW`."""
        return np.array(self._values(), LAW)[()]

    def ratio(self, amplitude: Any, load: Any, speed: Any) -> Array:
        """mu/mu0 at an `amplitude` (m, >= 0), a normal `load` (N) and a sliding `speed` (m/s, its sign ignored)."""
        amplitude = _checked("amplitude", amplitude, 0.0, math.inf, "m")
        return self._each(friction_ratios, amplitude, load, speed)

    def amplitude(self, ratio: Any, load: Any, speed: Any) -> Array:
        """Amplitude (m) that leaves `ratio` of the friction, which must be in the law's reach, at most 1."""
        least = self.floor + LEAST_SHARE * (1.0 - self.floor)
        return self._each(reference_amplitudes, _checked("ratio", ratio, least, 1.0), load, speed)

    def _each(self, law_of_arrays: Any, first: Array, load: Any, speed: Any) -> Array:
        load = _checked("load", load, 0.0, self._heaviest, "N")
        if load.size and not self._unloaded and load.min() == 0.0:
            raise ValueError("load = 0.0: must be > 0 N")
        speed = _checked("speed", speed, -math.inf, math.inf, "m/s")
        return np.asarray(law_of_arrays(self.numbers, first, load, speed))


@dataclass(frozen=True, kw_only=True)
class FitLaw(FrictionLaw):
    """mu/mu0 = floor + (1 - floor) exp(-(a/scale)^exponent).

    Notes
    -----
    Engineering defaults for 30 kHz and 0.5 N.  With p from 1.5 to 2 the law is close to `LoadSharing` at 0.5 to 1 N.

    Examples
    --------
    >>> FitLaw().ratio([0.0, 1e-6, 3e-6], load=0.5, speed=0.05).round(2).tolist()
    [1.0, 0.48, 0.11]
    """

    floor: float = parameter(0.10, about="least mu/mu0, r (0.05 to 0.3)", most=0.999)
    scale: float = parameter(1.1e-6, "m", "amplitude a0 (0.7e-6 to 1.8e-6)", above=0.0)
    exponent: float = parameter(1.5, about="p (1 to 2)", above=0.0)

    def _values(self) -> tuple[float, ...]:
        return FIT, self.floor, self.scale, self.exponent, 1.0, 1.0


@dataclass(frozen=True, kw_only=True)
class LoadSharing(FrictionLaw):
    """Asperities and a squeeze film carry the load together: W/A = pc exp(-u/u0) + 1.25 p0 (a/u)^2.

    Notes
    -----
    Film: Salbu's limit of a large squeeze number; asperities after Wiertlewski et al. 2016.
    """

    contact_pressure: float = parameter(200e3, "Pa", "asperities at zero gap, pc; load < pc A", above=0.0)
    decay: float = parameter(1.5e-6, "m", "gap u0 over which their share falls by 1/e", above=0.0)
    pressure: float = parameter(101e3, "Pa", "of the air around, p0", above=0.0)
    area: float = parameter(1e-4, "m2", "of the contact, A (0.6e-4 to 2e-4)", above=0.0)

    _unloaded = False

    @property
    def _heaviest(self) -> float:  # type: ignore[override]
        return math.nextafter(self.contact_pressure * self.area, 0.0)

    def _values(self) -> tuple[float, ...]:
        return FILM, 0.0, self.decay, 1.0, self.contact_pressure * self.area, 1.25 * self.pressure * self.area


@dataclass(frozen=True, kw_only=True)
class IntermittentContact(FrictionLaw):
    """mu/mu0 = exp(-c mu0 a f/v): a bouncing skin touches for a part of each cycle.

    Notes
    -----
    After Vezzoli et al. 2017; the form of the group is uncertain.  A finger that stands has no friction
    left at any amplitude > 0, so the law holds while it slides.
    """

    coefficient: float = parameter(2.0, about="c (0.5 to 5)", above=0.0)
    friction: float = parameter(0.8, about="mu0 without vibration (0.3 to 1.2)", above=0.0)
    frequency: float = parameter(30e3, "Hz", "of the vibration, f (20e3 to 70e3)", above=0.0)

    def _values(self) -> tuple[float, ...]:
        return BOUNCE, 0.0, 1.0 / (self.coefficient * self.friction * self.frequency), 1.0, 1.0, 1.0


LAWS: dict[str, type[FrictionLaw]] = {"fit": FitLaw, "load-sharing": LoadSharing, "intermittent": IntermittentContact}


def _checked(name: str, value: Any, least: float, most: float, unit: str = "") -> Array:
    """Numbers that are finite and from `least` to `most`."""
    array = np.asarray(value, float)
    wrong = ~(np.isfinite(array) & (array >= least) & (array <= most))
    if wrong.any():
        bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", least), ("<=", most)) if math.isfinite(bound)]
        bound = " and ".join(bounds) or "finite"
        raise ValueError(f"{name} = {array[wrong].flat[0]:g}: must be {bound} {unit}".rstrip())
    return array
