"""The sliding contact that every friction device shares, and a tribometer.

The equations are those of docs/theory.md, "Sliding contact" (Balasubramanian, Pool and Vardar 2025).  Below
`least_speed` the contact sticks and keeps its friction; a lifted finger has none.  Friction is positive against the
motion, in either direction.  A step outputs the state at the start of a sample, then advances: exactly for a steady
friction and a speed that are constant over the sample, and a friction that changes linearly within it (tribometer).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hapticrender.checks import Validated, parameter, require
from hapticrender.jit import kernel, record_of
from hapticrender.mathx import foh
from hapticrender.plants.compiled import quantise, resolution
from hapticrender.protocols import Array

SLIDING = np.dtype(
    [(name, "f8") for name in ("least_speed", "force_noise", "force_step", "force_range")]  # as in `SlidingParameters`
    + [
        ("renewal", "f8"),  # T/delta, s/m: share of the contact's memory that is renewed in a sample, per speed
        ("tribometer_step", "f8", (2, 4)),  # of a sample: Phi, then the input columns of friction at its start and end
        ("friction", "f8"),  # state: N
        ("tribometer", "f8", (2,)),  # state: force (N) and its rate over w0 (N)
    ],
    align=True,
)


@dataclass(frozen=True, kw_only=True)
class SlidingParameters(Validated):
    """Parameters of the sliding contact and of the tribometer under it.

    Notes
    -----
    Memory length and tribometer are those of docs/theory.md, "Sliding contact"; friction coefficient, damping, noise
    and range are engineering defaults.
    """

    rate: float = parameter(10e3, "Hz", "sampling rate of the surface", least=1e3, most=1e6)
    friction_coefficient: float = parameter(0.8, about="mu; dry to moist glass: 0.3 to 2", above=0.0)
    memory_length: float = parameter(11.5e-6, "m", "delta, sliding distance that renews the contact", above=0.0)
    least_speed: float = parameter(1e-3, "m/s", "a slower contact sticks", above=0.0)
    tribometer_frequency: float = parameter(1300.0, "Hz", "resonance f0, at most half the rate", above=0.0)
    tribometer_damping: float = parameter(0.65, about="damping ratio; >= 0.44: flat within 0.5 dB to 400 Hz", above=0.0)
    force_noise: float = parameter(1e-3, "N", "white noise of the tribometer, rms")
    force_range: float = parameter(20.0, "N", "it measures forces within +- this", above=0.0)
    force_bits: int = parameter(0, about="resolution over +- force_range, 0 is ideal", least=0, most=24)

    def __post_init__(self) -> None:
        super().__post_init__()
        bound = f"<= {self.rate / 2:g} Hz, half the rate"
        require(self.tribometer_frequency <= self.rate / 2, "tribometer_frequency", self.tribometer_frequency, bound)

    force_step = resolution("force_bits", "force_range", 2.0, "the tribometer (N)")

    @property
    def sensor_delay(self) -> float:
        """Delay of what is sensed (s) at low frequencies: 2 zeta/w0 of the tribometer."""
        return 2 * self.tribometer_damping / (2 * math.pi * self.tribometer_frequency)

    def lag_response(self, frequency: Any, speed: float) -> Any:
        """Friction per steady friction (complex) at `frequency` (Hz), the hold and the sampling included.

        (1 - a)/(z - a) with a = exp(-|v| T/delta); 0 where the contact sticks.
        """
        kept = math.exp(-abs(speed) / (self.rate * self.memory_length)) if abs(speed) >= self.least_speed else 1.0
        return (1 - kept) / (self._shift(frequency) - kept)

    def tribometer_response(self, frequency: Any) -> Any:
        """Sensed friction per friction (complex) at `frequency` (Hz): (z - Phi)^-1 (G_0 + z G_1)."""
        step, z = _tribometer_step(self), self._shift(frequency)[..., None, None]
        return np.linalg.solve(z * np.eye(2) - step[:, :2], step[:, 2:3] + z * step[:, 3:])[..., 0, 0]

    def _shift(self, frequency: Any) -> Any:
        """Return z = exp(j w T)."""
        return np.exp(2j * np.pi * np.asarray(frequency, float) / self.rate)


def sliding_record(parameters: SlidingParameters) -> Array:
    """Return the record (`SLIDING`, shape (1,)) of a contact at rest, without friction."""
    renewal = 1.0 / (parameters.rate * parameters.memory_length)
    return record_of(SLIDING, parameters, renewal=renewal, tribometer_step=_tribometer_step(parameters))


def _tribometer_step(parameters: SlidingParameters) -> Array:
    """One sample of the tribometer's force and of its rate over w0 (first-order hold), shape (2, 4)."""
    w = 2 * math.pi * parameters.tribometer_frequency
    a = w * np.array([[0.0, 1.0], [-1.0, -2 * parameters.tribometer_damping]])
    return foh(a, np.array([[0.0], [w]]), 1.0 / parameters.rate)


@kernel
def sliding_step(s, steady_friction, speed, noise):
    """Advance the contact by a sample; return friction and measured friction (N) at its start.

    `s` is a record of `SLIDING`; `steady_friction` (N) and `speed` (m/s, NaN: lifted) hold over the sample; `noise` is
    of unit variance.
    """
    before = after = s.friction
    if math.isnan(speed):
        after = 0.0
    elif abs(speed) >= s.least_speed:
        after = steady_friction + (before - steady_friction) * math.exp(-abs(speed) * s.renewal)
    s.friction = after
    phi, x = s.tribometer_step, s.tribometer
    x0, x1 = x[0], x[1]
    measured = quantise(x0 + s.force_noise * noise, s.force_step, s.force_range)
    for i in range(2):
        x[i] = phi[i, 0] * x0 + phi[i, 1] * x1 + phi[i, 2] * before + phi[i, 3] * after
    return before, measured
