"""Square root that makes a force which goes with current squared linear in the drive.

Electroadhesion attracts with ``F = g I^2``, so an attraction u around a bias asks for the current envelope::

    I = sqrt(max(bias + u, floor)/g)

Without it the envelope goes straight from nothing to the same peak, and squaring leaves a second harmonic::

    I = sqrt(2 bias/g) (1 + u/bias)/2,   g I^2 = bias/2 + u + u^2/(2 bias)

which is 25 % of the first at u = bias sin(2 pi f t) (FACTS section 5); Grigorii et al. 2021 drive
6 mA sqrt((sin(2 pi f t) + 1)/2).  That envelope has cusps where it touches zero; the floor rounds them off.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel


class SquareRootTables(NamedTuple):
    """Numbers of the compiled square root."""

    bias: float  # N
    floor: float  # N
    gain: float  # N/A^2
    straight: bool


@dataclass(frozen=True, kw_only=True)
class SquareRoot:
    """Attraction around a bias (N) to the peak of the envelope of the current (A), or of a voltage (V).

    Parameters
    ----------
    bias : float, N
        Attraction at zero drive, > `floor`; the drive can take away bias - floor.
    floor : float, N
        Least attraction that is asked for, >= 0.  The slope of the current is that of a drive at the floor,
        1/(2 sqrt(floor gain)): a floor of 0 has no bound to it.
    gain : float, N/A^2 (or N/V^2)
        g of ``F = g I^2``, > 0.
    straight : bool
        Leave the square root out, for comparison: the envelope is straight in the drive, of the same peak at
        a drive of `bias`, and of the same slope of attraction at none.

    Examples
    --------
    >>> SquareRoot(bias=0.32, floor=0.01, gain=17.8e3)(np.array([0.0, 0.32])).round(5).tolist()
    [0.00424, 0.006]
    """

    bias: float
    floor: float
    gain: float
    straight: bool = False

    def __post_init__(self) -> None:
        for name, bound, unit in (("bias", self.floor, "N"), ("gain", 0.0, "N/A^2")):
            value = getattr(self, name)
            if not (isfinite(value) and value > bound):
                raise ValueError(f"{name} = {value!r}: must be > {bound:g} {unit}")
        if not (isfinite(self.floor) and self.floor >= 0.0):
            raise ValueError(f"floor = {self.floor!r}: must be >= 0 N")

    def __call__(self, drive: Any) -> Any:
        """Current envelope (A, peak) for a `drive` (N of attraction around the bias)."""
        wanted = np.maximum(self.bias + np.asarray(drive, float), self.floor)
        if self.straight:
            return wanted / np.sqrt(2 * self.bias * self.gain)
        return np.sqrt(wanted / self.gain)

    @property
    def tables(self) -> SquareRootTables:
        """Numbers of the compiled square root."""
        return SquareRootTables(float(self.bias), float(self.floor), float(self.gain), bool(self.straight))


@kernel
def square_root_step(tables, drive):
    """Current envelope (A, peak) of a finite drive (N)."""
    wanted = max(tables.bias + drive, tables.floor)
    if tables.straight:
        return wanted / sqrt(2.0 * tables.bias * tables.gain)
    return sqrt(wanted / tables.gain)
