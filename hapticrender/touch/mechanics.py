"""Mechanical impedance of a fingertip on a moving surface, and how its skin and phalanx share the motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hapticrender.checks import Validated, choice, frequencies, parameter, require
from hapticrender.protocols import Array

LIGHT_BELOW = 0.5  # N: Table 1 parts its two columns here
LIGHT_LOAD, HEAVY_LOAD = 0.3, 0.8  # N: engineering defaults for what "light" and "heavy" were measured at


PARTS = ("mass", "damping", "stiffness", "phalanx_mass", "phalanx_damping", "phalanx_stiffness")


@dataclass(frozen=True, kw_only=True)
class FingerMechanics(Validated):
    """Lumped mechanics of a finger on a surface.

    With s = 2 pi j f and ``Z(m, b, k) = m s + b + k/s``:

    * order 0: no mechanics, Z_f = 0;
    * order 2: one mass on the surface, ``Z_f = Z(mass, damping, stiffness)``;
    * order 4: skin (mass on the surface, `damping` and `stiffness` to the
      phalanx) in series with the phalanx on the hand,
      ``Z_f = m_s s + Z_t Z_p/(Z_t + Z_p)``, ``Z_t = b_s + k_s/s``,
      ``Z_p = Z(phalanx_mass, phalanx_damping, phalanx_stiffness)``.

    `mass`, `damping` and `stiffness` (kg, N s/m, N/m, >= 0) are of the part that is rigidly at the surface: the skin,
    or for order 2 the whole finger; those of the phalanx are for order 4 only.  They hold at `reference_load` (N), for
    scaling with W**(1/3).

    References
    ----------
    Grigorii, Li, Peshkin, Colgate: Comparison of wide-band vibrotactile and
    friction modulation surface gratings, 2021, Table 1 and its equations of the finger, one of
    them corrected (docs/theory.md, section 3).

    Examples
    --------
    >>> from hapticrender.touch.mechanics import LIGHT
    >>> abs(LIGHT.skin_velocity_per_force(np.array([170.0]))).round(3).tolist()
    [0.545]
    """

    order: int = parameter(0, most=4)
    mass: float = parameter(0.0, "kg", most=1.0)
    damping: float = parameter(0.0, "N s/m", most=1e4)
    stiffness: float = parameter(0.0, "N/m", most=1e6)
    phalanx_mass: float = parameter(0.0, "kg", most=1.0)
    phalanx_damping: float = parameter(0.0, "N s/m", most=1e4)
    phalanx_stiffness: float = parameter(0.0, "N/m", most=1e6)
    reference_load: float = parameter(LIGHT_BELOW, "N", above=0, most=20)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.order in (0, 2, 4), "order", self.order, "0, 2 or 4")
        for key in PARTS[{0: 0, 2: 3, 4: 6}[self.order] :]:
            require(getattr(self, key) == 0.0, key, getattr(self, key), f"0 where order = {self.order}")
        if self.order and not any(getattr(self, key) for key in PARTS[:3]):
            raise ValueError(f"mass, damping, stiffness = 0: one must be > 0 where order = {self.order}")

    def impedance(self, frequency: Array) -> Array:
        """Z_f = F/V_s (complex, N s/m) at `frequency` (Hz, > 0)."""
        s = 2j * np.pi * frequencies(frequency, zero=False)
        if self.order == 0:
            return np.zeros_like(s)
        if self.order == 2:
            return self.mass * s + self.damping + self.stiffness / s
        tissue = self.damping + self.stiffness / s
        phalanx = self.phalanx_mass * s + self.phalanx_damping + self.phalanx_stiffness / s
        return self.mass * s + tissue * (phalanx / (phalanx + tissue))

    def skin_velocity_per_force(self, frequency: Array) -> Array:
        """V_s/F (complex, m/(N s)): the surface, and the skin on it, per newton."""
        bound = "2 or 4: a finger without mechanics gives no velocity per force"
        require(self.order != 0, "order", self.order, bound)
        return 1 / self.impedance(frequency)

    def load_factor(self, normal_load: Array) -> Array:
        """(W/W_ref)**(1/3), the growth of |Z_f| with `normal_load` W (N), 0 without load."""
        return np.cbrt(np.maximum(np.asarray(normal_load, float), 0.0) / self.reference_load)


# Table 1 of the paper: whole finger, and skin with the phalanx at the whole finger's numbers.
NONE = FingerMechanics()
LIGHT_SECOND = FingerMechanics(order=2, mass=4e-3, damping=1.0, stiffness=200.0, reference_load=LIGHT_LOAD)
HEAVY_SECOND = FingerMechanics(order=2, mass=4e-3, damping=1.5, stiffness=300.0, reference_load=HEAVY_LOAD)


def _fourth(whole: FingerMechanics, mass: float, damping: float, stiffness: float) -> FingerMechanics:
    phalanx = {f"phalanx_{key}": getattr(whole, key) for key in PARTS[:3]}
    return replace(whole, order=4, mass=mass, damping=damping, stiffness=stiffness, **phalanx)


LIGHT = _fourth(LIGHT_SECOND, 2e-4, 1.5, 1e3)
HEAVY = _fourth(HEAVY_SECOND, 2e-4, 8.0, 8e3)

NAMED = {"none": NONE, "light": LIGHT, "heavy": HEAVY, "light-2nd-order": LIGHT_SECOND, "heavy-2nd-order": HEAVY_SECOND}


def read_mechanics(value: Any, normal_load: Callable[[], float]) -> FingerMechanics:
    """Mechanics from a name, a table of numbers, or mechanics; "auto" chooses by `normal_load` (N)."""
    if isinstance(value, FingerMechanics | Mapping):
        return FingerMechanics.read("mechanics", value)
    choice("mechanics", value, ("auto", *NAMED))
    if value == "auto":
        return LIGHT if normal_load() < LIGHT_BELOW else HEAVY
    return NAMED[value]
