"""Map where each method is stable on the plate with a finger, from the linear models of its loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hapticrender.control.damping import damping_taps
from hapticrender.control.device_model import FingerRange
from hapticrender.control.linear import ErrorLoop, FingerEstimate, Structure
from hapticrender.control.margins import sensitivity
from hapticrender.control.polar_loop import PolarLoop
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.touch.mechanics import FingerMechanics

OFFSETS = 60  # frequencies around a carrier at which a map looks for the peak of S
MODE_OFFSETS = np.linspace(-6.0, 6.0, 9)  # Hz: and around each mode of the plant
INTEGRAL = 3.4  # 1/s per Hz of bandwidth: 17 1/s at 5 Hz
QUALITY = 1.4  # of the modes under the inner loop


def loaded_plate(
    parameters: PlateParameters,
    mechanics: FingerMechanics | None = None,
    *,
    position: float = 0.0,
    strength: float = 1.0,
) -> Structure:
    """Structure of the plate, both its coordinates and its bending mode, with a finger resting on it.

    Parameters
    ----------
    parameters : PlateParameters
    mechanics : FingerMechanics, optional
        Order 0, 2 or 4; none is order 0.  A phalanx becomes a coordinate of its own and needs a mass.
    position : float, m
        Of the finger, from the middle.
    strength : float
        Factor on the finger's impedance, >= 0; 0 is no finger.
    """
    arms = np.array([1.0, position / parameters.half_spacing])
    mass, damping, stiffness = parameters.mass_matrix, parameters.damping_matrix, parameters.stiffness_matrix
    inputs = outputs = np.eye(2)
    if parameters.bending_frequency > 0:
        omega, modal = 2 * math.pi * parameters.bending_frequency, parameters.bending_mass
        arms = np.append(arms, parameters.bending_shape(position))
        mass = _joined(mass, modal)
        damping = _joined(damping, 2 * parameters.bending_damping * omega * modal)
        stiffness = _joined(stiffness, omega**2 * modal)
        inputs, outputs = np.vstack([inputs, [parameters.bending_coil, 0.0]]), np.column_stack([outputs, [1.0, 0.0]])
    if mechanics is not None and mechanics.order and strength > 0:
        across = arms
        if mechanics.order == 4:
            if not mechanics.phalanx_mass > 0:
                raise ValueError(f"phalanx_mass = {mechanics.phalanx_mass!r} kg: must be > 0")
            mass = _joined(mass, strength * mechanics.phalanx_mass)
            damping = _joined(damping, strength * mechanics.phalanx_damping)
            stiffness = _joined(stiffness, strength * mechanics.phalanx_stiffness)
            arms, across = np.append(arms, 0.0), np.append(arms, -1.0)
            inputs, outputs = np.pad(inputs, ((0, 1), (0, 0))), np.pad(outputs, ((0, 0), (0, 1)))
        mass = mass + strength * mechanics.mass * np.outer(arms, arms)
        damping = damping + strength * mechanics.damping * np.outer(across, across)
        stiffness = stiffness + strength * mechanics.stiffness * np.outer(across, across)
    return Structure(mass=mass, damping=damping, stiffness=stiffness, input=inputs, output=outputs)


def _joined(matrix: Array, value: float) -> Array:
    """Matrix with one more, independent coordinate."""
    larger = np.pad(matrix, (0, 1))
    larger[-1, -1] = value
    return larger


@dataclass(frozen=True, kw_only=True)
class StabilityMap:
    """Growth and modulus margin of one method over finger, load, position, frequency and bandwidth.

    Parameters
    ----------
    method : str
    fingers : tuple of str
        Their names.
    loads, positions, frequencies, bandwidths : ndarray, N, m, Hz, Hz
    adapted : bool
        Whether the law has the settled finger estimate.
    growth : ndarray, shape (fingers, loads, positions, frequencies, bandwidths), 1/s
        Of the slowest-decaying pole; >= 0 is unstable.
    modulus : ndarray, same shape
        Modulus margin, 0 where unstable.
    """

    method: str
    fingers: tuple[str, ...]
    loads: Array
    positions: Array
    frequencies: Array
    bandwidths: Array
    adapted: bool
    growth: Array
    modulus: Array

    def boundary(self, least: float = 0.0) -> Array:
        """Bandwidth (Hz, shape (fingers, loads, positions, frequencies)) up to which every one tried holds.

        Stable, and with a modulus margin of at least `least`; 0 where the lowest does not hold, inf where all do.
        """
        held = (self.growth < 0) & (self.modulus >= least)
        count = np.cumprod(held, axis=-1).sum(axis=-1)
        return np.concatenate([[0.0], self.bandwidths[:-1], [np.inf]])[count]


class _Touch(NamedTuple):
    """One finger resting on a plate."""

    parameters: PlateParameters
    mechanics: FingerMechanics
    position: float
    strength: float
    adapted: bool

    def structure(self) -> Structure:
        return loaded_plate(self.parameters, self.mechanics, position=self.position, strength=self.strength)


def stability_map(
    method: str,
    frequencies: Array,
    *,
    bandwidths: Array,
    fingers: Mapping[str, FingerMechanics],
    loads: tuple[float, ...] = (0.3, 0.8),
    positions: tuple[float, ...] = (0.0, 15e-3, 27.5e-3),
    parameters: PlateParameters | None = None,
    adapted: bool = False,
) -> StabilityMap:
    """Evaluate one method's loop, one carrier at a time, from the model.

    Parameters
    ----------
    method : {"paper", "paper-common", "h", "h2"}
        The paper's polar loops, per side or in common mode; the error observer without and with its inner damper.
    frequencies, bandwidths : ndarray, Hz
        Carriers, and loop bandwidths b: the paper's fT with fL = 2 b; for the error observer a pole at 2 b and an
        integral of 3.4 b 1/s.  No rule lowers them here.
    fingers : mapping of str to FingerMechanics
        Such as ``touch.mechanics.NAMED``, Table 1 and no finger.
    loads : tuple of float, N
        Normal loads; the impedance grows with (W/reference load)**(1/3).
    positions : tuple of float, m
        Of the finger.
    parameters : PlateParameters, optional
    adapted : bool
        The law has the finger estimate at which its adaptation comes to rest; otherwise none.

    Returns
    -------
    StabilityMap
    """
    if method not in LOOPS:
        raise ValueError(f"{method=} must be one of {', '.join(LOOPS)}")
    parameters = parameters or PlateParameters()
    frequencies, bandwidths = np.asarray(frequencies, float), np.asarray(bandwidths, float)
    shape = (len(fingers), len(loads), len(positions), len(frequencies), len(bandwidths))
    growth, modulus = np.empty(shape), np.empty(shape)
    carrier, width = (grid.ravel() for grid in np.meshgrid(frequencies, bandwidths, indexing="ij"))
    known = list(fingers.values())
    for at in np.ndindex(shape[:3]):
        mechanics = known[at[0]]
        if not mechanics.order and at[1:] != (0, 0):  # without mechanics neither load nor place matter
            growth[at], modulus[at] = growth[at[0], 0, 0], modulus[at[0], 0, 0]
            continue
        strength = float(mechanics.load_factor(np.asarray(loads[at[1]])))
        touch = _Touch(parameters, mechanics, positions[at[2]], strength, adapted)
        rates, least = LOOPS[method](touch, carrier, width)
        growth[at], modulus[at] = rates.reshape(shape[3:]), least.reshape(shape[3:])
    return StabilityMap(
        method=method,
        fingers=tuple(fingers),
        loads=np.asarray(loads, float),
        positions=np.asarray(positions, float),
        frequencies=frequencies,
        bandwidths=bandwidths,
        adapted=adapted,
        growth=growth,
        modulus=modulus,
    )


def _polar(touch: _Touch, carrier: Array, width: Array, common: bool) -> tuple[Array, Array]:
    """Growth and modulus margin of the paper's loop for every carrier and bandwidth."""
    parameters = touch.parameters
    model = parameters.device_model(parameters.rate, parameters.delay)
    loop = PolarLoop.on(touch.structure().sampled(parameters.rate), model, carrier, width, common=common)
    poles = loop.poles()
    near = width[:, None] * np.geomspace(0.02, 50.0, OFFSETS)
    offset = np.concatenate([near, np.abs(poles.imag) / (2 * np.pi)], axis=1)
    peak = sensitivity(loop.loop(np.clip(offset, 1e-3, 0.49 * parameters.rate))).max(axis=1)
    growth = poles.real.max(axis=1)
    return growth, np.where(growth < 0, 1 / peak, 0.0)


def _error_loop(touch: _Touch, carrier: Array, width: Array, inner: float) -> tuple[Array, Array]:
    """Growth and modulus margin of the error observer's loop for every carrier and bandwidth."""
    loop = scaled_loop(
        touch.parameters,
        touch.structure(),
        carrier,
        width,
        inner=inner,
        finger=settled_estimate(touch.parameters, touch.mechanics, carrier, touch.position, touch.strength)
        if touch.adapted
        else None,
    )
    rate, poles = touch.parameters.rate, loop.poles()
    near = np.geomspace(0.02, 20.0, OFFSETS // 2)
    beside = np.concatenate([-near[::-1], near]) * width[:, None] + carrier[:, None]
    modes = (loop.plant.modes()[:, None] + MODE_OFFSETS).ravel()
    afar = np.append(np.linspace(1.0, 0.499 * rate, OFFSETS), modes) * np.ones((len(carrier), 1))
    peak = np.zeros(len(carrier))
    for grid in (beside, afar, np.abs(poles.imag) / (2 * np.pi)):
        z = np.exp(2j * np.pi * np.clip(grid, 0.1, 0.499 * rate) / rate)
        peak = np.maximum(peak, sensitivity(loop.loop(z)).max(axis=1))
    growth = poles.real.max(axis=1)
    return growth, np.where(growth < 0, 1 / peak, 0.0)


def scaled_loop(
    parameters: PlateParameters,
    plant: Structure,
    carrier: Array,
    width: Array,
    *,
    inner: float,
    finger: FingerEstimate | None = None,
) -> ErrorLoop:
    """Stack of loops of one band each on one plant, for `carrier` and bandwidth `width` (Hz, shape (B,)).

    `parameters` are those of the free plate that the law inverts, `inner` (0..1) is the factor on the inner damper.
    """
    model = parameters.device_model(parameters.rate, parameters.delay)
    level = 2 * math.pi * np.minimum(6.0, carrier / 8) / model.rate
    return ErrorLoop.on(
        plant.sampled(model.rate),
        Structure.of(model),
        carrier[:, None],
        delay=model.delay,
        lead=(model.delay + 0.5) / model.rate,
        observer=2 * 2 * math.pi * 2 * width / model.rate,
        integral=INTEGRAL * width,
        dc=1.6 * level,
        dc_drift=level**2,
        inner=np.full(len(width), inner),
        taps=damping_taps(model, QUALITY)[0],
        finger=finger,
    )


def settled_estimate(
    parameters: PlateParameters, mechanics: FingerMechanics, frequency: Array, position: float, strength: float = 1.0
) -> FingerEstimate | None:
    """Finger estimate at which the adaptation settles on a single carrier (Hz, shape (B,)); None without a finger.

    With z = j w Z_f(j w): Re z is shared between stiffness and mass by how far each may be expected from zero; the
    imaginary part is damping.  `strength` is a factor on the finger's impedance.
    """
    if not mechanics.order or strength == 0.0:
        return None
    omega = 2 * np.pi * frequency
    z = 1j * omega * mechanics.impedance(frequency) * strength
    known = FingerRange()
    heavy = omega**2 * known.typical_mass**2
    share = z.real / (known.typical_stiffness**2 + omega**2 * heavy)
    numbers = (
        np.clip(-heavy * share, *known.mass),
        np.clip(z.imag / omega, *known.damping),
        np.clip(known.typical_stiffness**2 * share, *known.stiffness),
    )
    mass, damping, stiffness = (number[:, None, None, None] for number in numbers)
    return FingerEstimate(mass, damping, stiffness, position / parameters.half_spacing)


LOOPS: dict[str, Callable[[_Touch, Array, Array], tuple[Array, Array]]] = {
    "paper": lambda touch, carrier, width: _polar(touch, carrier, width, False),
    "paper-common": lambda touch, carrier, width: _polar(touch, carrier, width, True),
    "h": lambda touch, carrier, width: _error_loop(touch, carrier, width, 0.0),
    "h2": lambda touch, carrier, width: _error_loop(touch, carrier, width, 1.0),
}
