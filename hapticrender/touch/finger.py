"""The finger: trajectory, normal load, touches and mechanics."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from hapticrender.checks import Validated, checked, flag, keep, number, numbers, require, rising
from hapticrender.protocols import Array, Motion
from hapticrender.touch.mechanics import NONE, FingerMechanics, read_mechanics
from hapticrender.touch.motion import LONGEST_TIME, Nowhere, Sampled, SineMotion, Still, TriangleMotion

MOST_LOAD = 20.0  # N

Touches = tuple[tuple[float, float], ...]
LoadCurve = tuple[tuple[float, ...], tuple[float, ...]]


def _read_touches(key: str, value: Any) -> Touches:
    bound = "pairs of on < off in s, each after the one before"
    require(isinstance(value, list | tuple), key, value, bound, TypeError)
    last, touches = 0.0, []
    for index, pair in enumerate(value):
        on, off = numbers(f"{key}[{index}]", pair, "s", least=0, most=LONGEST_TIME, count=2)
        require(last <= on < off, f"{key}[{index}]", pair, bound)
        touches.append((on, off))
        last = off
    return tuple(touches)


def _read_load(value: Any, motion: Motion) -> float | LoadCurve | None:
    if value is None:
        known = callable(getattr(motion, "load", None))
        require(known, "normal_load", None, "a finite number >= 0 and <= 20 N, as this motion records none")
        return None
    if not isinstance(value, list | tuple):
        return number("normal_load", value, "N", least=0, most=MOST_LOAD)
    require(len(value) == 2, "normal_load", value, "two lists: times in s, loads in N")
    loads = numbers("normal_load[1]", value[1], "N", least=0, most=MOST_LOAD)
    return rising("normal_load[0]", value[0], len(loads)), loads


@dataclass(frozen=True)
class Finger(Validated):
    """A finger on the surface.

    Parameters
    ----------
    motion : Motion
        `Still`, `TriangleMotion`, `SineMotion`, `Sampled`, `Nowhere`, or any
        object with ``position(time)``; NaN means lifted.
    normal_load : float, N, or (times in s, loads in N), or None
        >= 0 and <= 20; a curve is joined by straight lines and held at both
        ends.  None: that of the motion, which has a method ``load(time)``.
    touches : sequence of (on, off), s, or None
        The finger touches while on <= t < off; None: whenever its motion has a position.
    mechanics : FingerMechanics, or a name, or a table of its numbers
        "none", "light", "heavy" (4th order, Table 1), "light-2nd-order",
        "heavy-2nd-order"; "auto" is light below a mean load of 0.5 N, else heavy.
    load_scaling : bool
        Impedance grows with (W / reference load)**(1/3).

    Examples
    --------
    >>> finger = Finger.sliding(speed=0.1, normal_load=0.8, touches=[(0.0, 1.0)], mechanics="heavy")
    >>> finger.position(np.array([0.2, 1.0])).round(6).tolist(), finger.load(np.array([0.2, 1.0])).tolist()
    ([0.02, nan], [0.8, 0.0])
    """

    motion: Motion
    normal_load: float | LoadCurve | None = 0.0
    touches: Touches | None = checked(_read_touches, None)
    mechanics: FingerMechanics = NONE
    load_scaling: bool = checked(flag, False)

    def __post_init__(self) -> None:
        known = isinstance(self.motion, Motion)
        require(known, "motion", self.motion, "a motion with position(time)", TypeError)
        keep(self, normal_load=_read_load(self.normal_load, self.motion))
        super().__post_init__()
        keep(self, mechanics=read_mechanics(self.mechanics, self._typical_load))

    @classmethod
    def absent(cls) -> Self:
        """No finger: never touches."""
        return cls(Nowhere())

    @classmethod
    def still(cls, position: float = 0.0, normal_load: Any = 0.4, **touch: Any) -> Self:
        """Return a finger that rests at `position` (m); `touch` holds touches, mechanics, load_scaling."""
        return cls(Still(position), normal_load, **touch)

    @classmethod
    def sliding(
        cls, speed: float, normal_load: Any = 0.4, span: float = 0.05, centre: float = 0.0, **touch: Any
    ) -> Self:
        """Return a finger that moves at `speed` (m/s), back and forth over `span` (m) around `centre` (m)."""
        return cls(TriangleMotion(speed, span, centre), normal_load, **touch)

    @classmethod
    def swiping(
        cls,
        frequency: float,
        speed: float | None = None,
        stroke: float | None = None,
        normal_load: Any = 0.4,
        centre: float = 0.0,
        **touch: Any,
    ) -> Self:
        """Return a finger that swipes sinusoidally, by peak `speed` (m/s) or by `stroke` (m)."""
        return cls(SineMotion(frequency, speed, stroke, centre), normal_load, **touch)

    @classmethod
    def sampled(
        cls, positions: Any, rate: float | None = None, times: Any = None, normal_load: Any = 0.4, **touch: Any
    ) -> Self:
        """Return a finger at given `positions` (m), at `rate` (Hz) or at `times` (s)."""
        return cls(Sampled(positions, rate, times), normal_load, **touch)

    def position(self, time: Array) -> Array:
        """Position (m from the middle of the surface, shape (n,)), NaN while lifted."""
        time = np.asarray(time, float)
        position = np.array(self.motion.position(time.copy()), float)
        if self.touches is None:
            return position
        inside = np.searchsorted(np.ravel(self.touches), time, side="right") % 2 == 1
        return np.where(inside, position, np.nan)

    def load(self, time: Array) -> Array:
        """Return the normal load (N, shape (n,)), 0 while lifted."""
        return self.touch(time)[:, 1]

    def touch(self, time: Array) -> Array:
        """Position (m), load (N) and factor on the impedance, shape (n, 3); NaN, 0 and 0 while lifted.

        The factor is 1 nominally, (W/W_ref)**(1/3) where it scales with the load.
        """
        time = np.asarray(time, float)
        touch = np.empty((time.size, 3))
        touch[:, 0] = self.position(time)
        known = self.normal_load is not None
        touch[:, 1] = np.interp(time, *self._load_curve) if known else self.motion.load(time.copy())  # type: ignore[attr-defined]
        touch[:, 2] = self.mechanics.load_factor(touch[:, 1]) if self.load_scaling else 1.0
        touch[np.isnan(touch[:, 0]), 1:] = 0.0
        return touch

    @cached_property
    def _load_curve(self) -> Array:
        """Times (s) and loads (N) that are joined by lines, shape (2, n); of a constant load there is one."""
        return np.array(self.normal_load if isinstance(self.normal_load, tuple) else ((0.0,), (self.normal_load,)))

    def _typical_load(self) -> float:
        """Mean load (N) while something presses."""
        if self.normal_load is None:
            loads = np.asarray(self.motion.load(np.arange(0.0, 60.0, 0.01)))  # type: ignore[attr-defined]
        else:
            loads = self._load_curve[1]
        return float(loads[loads > 0].mean()) if (loads > 0).any() else 0.0
