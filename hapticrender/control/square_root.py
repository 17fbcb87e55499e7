"""Square root that makes a force which goes with current squared linear in the drive.

Electroadhesion attracts with ``F = g I^2``, so an attraction u around a bias asks for the current envelope::

    I = sqrt(max(bias + u, floor)/g)

Without it a sinusoidal envelope gives a second harmonic of 25 % in the friction (FACTS section 5); Grigorii et al.
2021 drive 6 mA sqrt((sin(2 pi f t) + 1)/2).  That envelope has cusps where it touches zero; the floor rounds them off.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

from hapticrender._jit import kernel


class SquareRootTables(NamedTuple):
    """Numbers of the compiled square root."""

    bias: float  # N
    floor: float  # N
    gain: float  # N/A^2


@dataclass(frozen=True, kw_only=True)
class SquareRoot:
    """Attraction around a bias (N) to the peak of the current's envelope (A).

    Parameters
    ----------
    bias : float, N
        Attraction at zero drive, > `floor`; the drive can take away bias - floor.
    floor : float, N
        Least attraction that is asked for, >= 0.  The slope of the current is that of a drive at the floor,
        1/(2 sqrt(floor gain)): a floor of 0 has no bound to it.
    gain : float, N/A^2
        g of ``F = g I^2``, > 0.

    Examples
    --------
    >>> SquareRoot(bias=0.32, floor=0.01, gain=17.8e3)(np.array([0.0, 0.32])).round(5).tolist()
    [0.00424, 0.006]
    """

    bias: float
    floor: float
    gain: float

    def __post_init__(self) -> None:
        for name, bound, unit in (("bias", self.floor, "N"), ("gain", 0.0, "N/A^2")):
            value = getattr(self, name)
            if not (isfinite(value) and value > bound):
                raise ValueError(f"{name} = {value!r}: must be > {bound:g} {unit}")
        if not (isfinite(self.floor) and self.floor >= 0.0):
            raise ValueError(f"floor = {self.floor!r}: must be >= 0 N")

    def __call__(self, drive: Any) -> Any:
        """Current envelope (A, peak) for a `drive` (N of attraction around the bias)."""
        return np.sqrt(np.maximum(self.bias + np.asarray(drive, float), self.floor) / self.gain)

    @property
    def tables(self) -> SquareRootTables:
        """Numbers of the compiled square root."""
        return SquareRootTables(float(self.bias), float(self.floor), float(self.gain))


@kernel
def square_root_step(tables, drive):
    """Current envelope (A, peak) of a finite drive (N)."""
    return sqrt(max(tables.bias + drive, tables.floor) / tables.gain)
