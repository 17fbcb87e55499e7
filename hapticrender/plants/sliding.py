"""What every surface that modulates friction shares: the sliding contact, the skin it pulls along, the tribometer.

A device makes a steady friction force F_s, that which would stand in the end.  The friction F that a finger sliding
at v feels follows it once the contact has moved on by about its memory length delta; a tribometer under the surface
shows it through its own resonance; and it drags the skin, whose impedance is Z_f::

    (delta/|v|) F' + F = F_s
    F_t'' + 2 zeta w0 F_t' + w0^2 F_t = w0^2 F
    v_skin = F/Z_f(s)

A contact that moves slower than `least_speed` sticks and keeps its friction; a finger that is lifted has none.
Friction counts as positive against the motion, whichever way the finger goes.

Every sample is read at its start, then advanced: exactly for a steady friction and a speed held over it, where the
skin and the tribometer follow a friction that goes in a straight line from sample to sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hapticrender.compiled.jit import kernel
from hapticrender.plants.bounds import Validated, number
from hapticrender.plants.kernels import quantise
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.touch.mechanics import FingerMechanics

SKIN_STATES = 4  # displacements of skin and phalanx, then their velocities
SKIN_VELOCITY = 2


@dataclass(frozen=True, kw_only=True)
class SlidingParameters(Validated):
    """The sliding contact and the tribometer under it.

    Parameters
    ----------
    rate : float, Hz
        Sampling rate of the surface, 1000 to 1e6.
    friction_coefficient : float
        mu, of friction over normal force, > 0 (dry to moist glass: 0.3 to 2).
    memory_length : float, m
        delta, the way after which the contact has renewed itself, > 0.
    least_speed : float, m/s
        Slower than this the contact sticks, > 0.
    tribometer_frequency : float, Hz
        Resonance f0 of the tribometer, > 0 and at most half the rate.
    tribometer_damping : float
        Its damping ratio zeta, > 0; 0.44 or more keeps it flat within 0.5 dB up to 400 Hz.
    force_noise : float, N rms
        White noise of the tribometer, >= 0.
    force_range : float, N
        It shows forces of +- this, > 0.
    force_bits : int
        Resolution over +- force_range; 0 is ideal.

    Notes
    -----
    delta is 11.5 um where the cut-off v/(2 pi delta) grows by 13.8 Hz per mm/s, as measured over 20-100 mm/s and
    0.2-0.6 N (Balasubramanian, Pool and Vardar 2025).  The tribometer is that of Grigorii et al. 2021: resonance at
    1.3 kHz, flat within +-0.5 dB over 20-400 Hz.  Friction coefficient, damping, noise and range are engineering
    defaults.
    """

    rate: float = number(10e3, "Hz", least=1e3, most=1e6)
    friction_coefficient: float = number(0.8, above=0.0)
    memory_length: float = number(11.5e-6, "m", above=0.0)
    least_speed: float = number(1e-3, "m/s", above=0.0)
    tribometer_frequency: float = number(1300.0, "Hz", above=0.0)
    tribometer_damping: float = number(0.65, above=0.0)
    force_noise: float = number(1e-3, "N")
    force_range: float = number(20.0, "N", above=0.0)
    force_bits: int = number(0, least=0, most=24)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tribometer_frequency > self.rate / 2:
            raise ValueError(
                f"tribometer_frequency = {self.tribometer_frequency!r}: must be <= {self.rate / 2:g} Hz, half the rate"
            )

    @property
    def force_step(self) -> float:
        """Resolution of the tribometer (N); 0 is ideal."""
        return 2 * self.force_range / 2**self.force_bits if self.force_bits else 0.0

    def cutoff(self, speed: Any) -> Any:
        """Cut-off of the friction's lag at `speed` (m/s), Hz: |v|/(2 pi delta)."""
        return np.abs(speed) / (2 * np.pi * self.memory_length)

    def lag_response(self, frequency: Any, speed: float) -> Any:
        """Friction per steady friction (complex) at `frequency` (Hz), the hold and the sampling included.

        (1 - a)/(z - a) with a = exp(-|v| T/delta); 0 where the contact sticks.
        """
        kept = math.exp(-abs(speed) / (self.rate * self.memory_length)) if abs(speed) >= self.least_speed else 1.0
        return (1 - kept) / (self._shift(frequency) - kept)

    def tribometer_response(self, frequency: Any) -> Any:
        """Sensed friction per friction (complex) at `frequency` (Hz)."""
        return _ramp_response(_tribometer_step(self), 0, self._shift(frequency))

    def skin_response(self, frequency: Any, mechanics: FingerMechanics) -> Any:
        """Skin velocity per friction (complex, m/(N s)) at `frequency` (Hz)."""
        return _ramp_response(_skin_step(self, mechanics), SKIN_VELOCITY, self._shift(frequency))

    def frequency_response(self, frequency: Any, speed: float) -> Any:
        """Sensed friction per steady friction (complex) at `frequency` (Hz) for a finger at `speed` (m/s)."""
        return self.lag_response(frequency, speed) * self.tribometer_response(frequency)

    def _shift(self, frequency: Any) -> Any:
        """Return z = exp(j w T)."""
        return np.exp(2j * np.pi * np.asarray(frequency, float) / self.rate)


class SlidingTables(NamedTuple):
    """Numbers of the compiled contact."""

    renewal: float  # T/delta, s/m: share of the contact's memory that is renewed in a sample, per speed
    least_speed: float  # m/s
    skin: Array  # (4, 6) what a sample does to the skin: Phi, then what friction at its start and at its end adds
    tribometer: Array  # (2, 4) the same for the tribometer's force and its rate
    force_noise: float  # N rms
    force_step: float  # N, 0: not quantised
    force_range: float  # N


class SlidingState(NamedTuple):
    """State of the contact; changed in place."""

    friction: Array  # (1,) N
    skin: Array  # (4,) displacements of skin and phalanx (m), velocities (m/s)
    tribometer: Array  # (2,) force (N) and its rate over w0 (N)
    scratch: Array  # (4,)


def sliding_tables(parameters: SlidingParameters, mechanics: FingerMechanics) -> SlidingTables:
    """Numbers of the compiled contact under a finger of order 0, 2 or 4.

    Parameters
    ----------
    parameters : SlidingParameters
    mechanics : FingerMechanics
        Its lateral mechanics; the masses that its order uses must be > 0.
    """
    return SlidingTables(
        renewal=1.0 / (parameters.rate * parameters.memory_length),
        least_speed=float(parameters.least_speed),
        skin=_skin_step(parameters, mechanics),
        tribometer=_tribometer_step(parameters),
        force_noise=float(parameters.force_noise),
        force_step=float(parameters.force_step),
        force_range=float(parameters.force_range),
    )


def sliding_state() -> SlidingState:
    """A contact at rest, without friction."""
    return SlidingState(np.zeros(1), np.zeros(SKIN_STATES), np.zeros(2), np.zeros(SKIN_STATES))


def _skin_step(parameters: SlidingParameters, mechanics: FingerMechanics) -> Array:
    """One sample of the skin under friction, shape (4, 6); what an order leaves out stays at zero."""
    system, push = np.zeros((SKIN_STATES, SKIN_STATES)), np.zeros(SKIN_STATES)
    if mechanics.order:
        k, b, m = mechanics.stiffness, mechanics.damping, _mass("mass", mechanics.mass, mechanics.order)
        system[0, 2], push[2] = 1.0, 1 / m
        system[2] = np.array([-k, k, -b, b]) / m
        if mechanics.order == 4:
            m = _mass("phalanx_mass", mechanics.phalanx_mass, 4)
            system[1, 3] = 1.0
            system[3] = np.array([k, -k - mechanics.phalanx_stiffness, b, -b - mechanics.phalanx_damping]) / m
    return _ramp_step(system, push, 1 / parameters.rate)


def _mass(name: str, value: float, order: int) -> float:
    if not value > 0.0:
        raise ValueError(f"mechanics.{name} = {value!r}: must be > 0 kg where order = {order}")
    return value


def _tribometer_step(parameters: SlidingParameters) -> Array:
    """One sample of the tribometer's force and of its rate over w0, shape (2, 4)."""
    w = 2 * math.pi * parameters.tribometer_frequency
    system = w * np.array([[0.0, 1.0], [-1.0, -2 * parameters.tribometer_damping]])
    return _ramp_step(system, np.array([0.0, w]), 1 / parameters.rate)


def _ramp_step(system: Array, push: Array, period: float) -> Array:
    """Phi and what an input at the start and at the end of a sample adds, for one that goes straight in between.

    From the exponential of [[A T, B T, 0], [0, 0, 1], [0, 0, 0]]: Phi, and the parts of the start and of the rise.
    """
    from scipy.linalg import expm

    n = len(push)
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n], whole[n, n + 1] = system * period, push * period, 1.0
    grown = expm(whole)[:n]
    grown[:, n] -= grown[:, n + 1]
    return np.ascontiguousarray(grown)


def _ramp_response(step: Array, row: int, z: Any) -> Any:
    """Response of state `row` to the input of a `_ramp_step` at complex `z`: (z - Phi)^-1 (G_0 + z G_1)."""
    n = len(step)
    z = np.asarray(z)[..., None, None]
    return np.linalg.solve(z * np.eye(n) - step[:, :n], step[:, n : n + 1] + z * step[:, n + 1 :])[..., row, 0]


@kernel
def _follow(step, state, scratch, before, after):
    """One sample of a linear system whose input goes straight from `before` to `after`."""
    n = state.shape[0]
    for i in range(n):
        total = step[i, n] * before + step[i, n + 1] * after
        for j in range(n):
            total += step[i, j] * state[j]
        scratch[i] = total
    for i in range(n):
        state[i] = scratch[i]


@kernel
def sliding_step(tables, state, steady_friction, speed, noise):
    """Friction (N), sensed friction (N) and skin velocity (m/s) at the start of a sample, which then passes.

    `steady_friction` (N) and `speed` (m/s, NaN: lifted) hold over the sample; `noise` is of unit variance.
    """
    friction = state.friction[0]
    sensed = quantise(state.tribometer[0] + tables.force_noise * noise, tables.force_step, tables.force_range)
    skin_velocity = state.skin[SKIN_VELOCITY]
    after = friction
    if math.isnan(speed):
        after = 0.0
    elif abs(speed) >= tables.least_speed:
        after = steady_friction + (friction - steady_friction) * math.exp(-abs(speed) * tables.renewal)
    state.friction[0] = after
    _follow(tables.tribometer, state.tribometer, state.scratch, friction, after)
    _follow(tables.skin, state.skin, state.scratch, friction, after)
    return friction, sensed, skin_velocity
