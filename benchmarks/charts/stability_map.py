"""Map where each method is stable on the plate with a finger, from the linear models of its loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.charts.polar_loop import PolarLoop
from hapticrender.control.damping import damping_taps
from hapticrender.control.device_model import DeviceModel, FingerRange
from hapticrender.control.linear import FingerEstimate, Sampled
from hapticrender.control.margin_check import BankGains, error_loop
from hapticrender.control.margins import sensitivity
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import NONE, FingerMechanics

OFFSETS = 60  # frequencies around a carrier at which a map looks for the peak of S
MODE_OFFSETS = np.linspace(-6.0, 6.0, 9)  # Hz: and around each mode of the plant
INTEGRAL = 3.4  # 1/s per Hz of bandwidth: 17 1/s at 5 Hz
QUALITY = 1.4  # of the modes under the inner loop


def loaded_plate(
    parameters: PlateParameters,
    model: DeviceModel,
    mechanics: FingerMechanics = NONE,
    *,
    position: float = 0.0,
    strength: float = 1.0,
) -> Sampled:
    """Plate with a finger resting on it, in the coordinates of the controller and per force that it asks for.

    Parameters
    ----------
    parameters : PlateParameters
    model : DeviceModel
        What the controller is designed for; it may differ from the plate.
    mechanics : FingerMechanics
    position : float, m
        Of the finger, from the middle.
    strength : float
        Factor on the finger's impedance, >= 0; 0 is no finger.
    """
    loaded = structure(parameters, mechanics, position, strength)
    a, b = loaded.zero_order_hold(parameters.rate)
    shown = model.coordinate_from_sensed @ loaded.outputs[1:3]
    return Sampled(
        rate=parameters.rate,
        a=a,
        b=b[:, :-1] @ np.linalg.pinv(model.force_from_drive),
        c=np.pad(shown, ((0, 0), (0, shown.shape[1]))),
    )


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

    def plant(self) -> Sampled:
        return loaded_plate(
            self.parameters, self.model(), self.mechanics, position=self.position, strength=self.strength
        )

    def model(self) -> DeviceModel:
        return self.parameters.device_model(self.parameters.rate, self.parameters.delay)


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
    loop = PolarLoop.on(touch.plant(), touch.model(), carrier, width, common=common)
    poles = loop.poles()
    near = width[:, None] * np.geomspace(0.02, 50.0, OFFSETS)
    offset = np.concatenate([near, np.abs(poles.imag) / (2 * np.pi)], axis=1)
    peak = sensitivity(loop.loop(np.clip(offset, 1e-3, 0.49 * loop.plant.rate))).max(axis=1)
    growth = poles.real.max(axis=1)
    return growth, np.where(growth < 0, 1 / peak, 0.0)


def _error_loop(touch: _Touch, carrier: Array, width: Array, inner: float) -> tuple[Array, Array]:
    """Growth and modulus margin of the error observer's loop for every carrier and bandwidth."""
    plant, model = touch.plant(), touch.model()
    near = np.geomspace(0.02, 20.0, OFFSETS // 2)
    modes = (plant.modes()[:, None] + MODE_OFFSETS).ravel()
    afar, taps = np.append(np.linspace(1.0, 0.499 * plant.rate, OFFSETS), modes), damping_taps(model, QUALITY)[0]
    growths, margins = [], []
    for f, b in zip(carrier.tolist(), width.tolist(), strict=True):
        finger = None
        if touch.adapted:
            finger = settled_estimate(touch.parameters, touch.mechanics, f, touch.position, touch.strength)
        loop = error_loop(model, np.array([f]), gains_of(model, f, b, inner), taps=taps, plant=plant, finger=finger)
        poles = loop.poles()
        grid = np.concatenate([f - b * near, f + b * near, afar, np.abs(poles.imag) / (2 * np.pi)])
        peak = sensitivity(loop.loop(np.exp(2j * np.pi * np.clip(grid, 0.1, 0.499 * plant.rate) / plant.rate))).max()
        growths.append(poles.real.max())
        margins.append(1 / peak if growths[-1] < 0 else 0.0)
    return np.array(growths), np.array(margins)


def gains_of(model: DeviceModel, carrier: float, width: float, inner: float) -> BankGains:
    """Gains of one band of bandwidth `width` (Hz) at every level, `inner` (0..1) the factor on the inner damper."""
    observer, integral = 2 * 2 * math.pi * 2 * width / model.rate, INTEGRAL * width
    dc = 2 * math.pi * min(6.0, carrier / 8) / model.rate
    return BankGains(
        rate=model.rate,
        delay=model.delay,
        lead=(model.delay + 0.5) / model.rate,
        observer=observer,
        observer_high=observer,
        integral=integral,
        integral_medium=integral,
        integral_high=integral,
        dc=1.6 * dc,
        dc_drift=dc**2,
        damper=inner,
        damper_high=inner,
        crowd_speed=0.0,
        lowest=model.lowest_frequency,
        highest=model.highest_frequency,
        highest_edge=model.highest_edge,
    )


def settled_estimate(
    parameters: PlateParameters, mechanics: FingerMechanics, frequency: float, position: float, strength: float = 1.0
) -> FingerEstimate | None:
    """Finger estimate at which the adaptation settles on a single carrier (Hz); None without a finger.

    With z = j w Z_f(j w): Re z is shared between stiffness and mass by how far each may be expected from zero; the
    imaginary part is damping.  `strength` is a factor on the finger's impedance.
    """
    if not mechanics.order or strength == 0.0:
        return None
    omega = 2 * np.pi * frequency
    z = complex(1j * omega * mechanics.impedance(frequency) * strength)
    known = FingerRange()
    heavy = omega**2 * known.typical_mass**2
    share = z.real / (known.typical_stiffness**2 + omega**2 * heavy)
    return FingerEstimate(
        float(np.clip(-heavy * share, *known.mass)),
        float(np.clip(z.imag / omega, *known.damping)),
        float(np.clip(known.typical_stiffness**2 * share, *known.stiffness)),
        position / parameters.half_spacing,
    )


LOOPS: dict[str, Callable[[_Touch, Array, Array], tuple[Array, Array]]] = {
    "paper": lambda touch, carrier, width: _polar(touch, carrier, width, False),
    "paper-common": lambda touch, carrier, width: _polar(touch, carrier, width, True),
    "h": lambda touch, carrier, width: _error_loop(touch, carrier, width, 0.0),
    "h2": lambda touch, carrier, width: _error_loop(touch, carrier, width, 1.0),
}
