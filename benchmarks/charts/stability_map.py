"""Map where each method is stable on the plate with a finger, from the linear models of its loop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from benchmarks.charts.polar_loop import PolarLoop
from benchmarks.charts.poles import loop_poles
from hapticrender.control.damping import damping_taps, oscillators
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import DiscretePlant, ErrorLoop
from hapticrender.control.load_damper import choose_load_damping
from hapticrender.control.margin_check import error_loop
from hapticrender.control.margins import sensitivity
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import NONE, FingerMechanics

PLATE = PlateParameters()
MODEL = PLATE.device_model(PLATE.rate, PLATE.delay)  # what every controller is designed for
DELAYS, FACTORS = np.arange(1, 9), np.geomspace(0.25, 8.0, 61)  # samples; on the inner damper
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
) -> DiscretePlant:
    """Plate with a finger resting on it, in the coordinates of the controller and per force that it demands.

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
    return DiscretePlant(
        rate=parameters.rate,
        a=a,
        b=b[:, :-1] @ np.linalg.pinv(model.force_from_drive),
        c=np.pad(shown, ((0, 0), (0, shown.shape[1]))),
    )


@dataclass(frozen=True)
class Case:
    """What rests on the plate, or differs from the plate of the design."""

    title: str
    mechanics: FingerMechanics
    load: float  # N
    position: float  # m

    def plant(self) -> DiscretePlant:
        """The plate with it."""
        strength = float(self.mechanics.load_factor(np.asarray(self.load)))
        return loaded_plate(PLATE, MODEL, self.mechanics, position=self.position, strength=strength)


class StabilityMap(NamedTuple):
    """Stability over two quantities."""

    x: Array
    y: Array
    growth: Array  # 1/s, of the slowest-decaying pole, (len(x), len(y)); >= 0 is unstable
    modulus: Array  # modulus margin, 0 where unstable


def polar_map(case: Case, common: bool, carriers: Array, widths: Array) -> StabilityMap:
    """Map the paper's loop, per side or in common mode, over carriers and bandwidths fT (Hz); fL = 2 fT."""
    carrier, width = (grid.ravel() for grid in np.meshgrid(carriers, widths, indexing="ij"))
    loop = PolarLoop.on(case.plant(), MODEL, carrier, width, common=common)
    poles = loop.poles()
    near = width[:, None] * np.geomspace(0.02, 50.0, OFFSETS)
    offset = np.concatenate([near, np.abs(poles.imag) / (2 * np.pi)], axis=1)
    peak = sensitivity(loop.loop(np.clip(offset, 1e-3, 0.49 * PLATE.rate))).max(axis=1)
    growth = poles.real.max(axis=1)
    modulus = np.where(growth < 0, 1 / peak, 0.0)
    return StabilityMap(carriers, widths, *(each.reshape(len(carriers), -1) for each in (growth, modulus)))


def error_map(case: Case, inner: float, carriers: Array, widths: Array) -> StabilityMap:
    """Map the error observer's loop over carriers and bandwidths b (Hz), its finger not learnt.

    Its pole is at 2 b, its integral 3.4 b 1/s; no rule lowers them here.  `inner` (0..1) is the inner damper's factor.
    """
    plant, taps = case.plant(), damping_taps(oscillators(MODEL), QUALITY)
    near = np.geomspace(0.02, 20.0, OFFSETS // 2)
    modes = (plant.modes()[:, None] + MODE_OFFSETS).ravel()
    afar = np.append(np.linspace(1.0, 0.499 * plant.rate, OFFSETS), modes)
    growth, modulus = np.zeros((2, len(carriers), len(widths)))
    for at in np.ndindex(growth.shape):
        f, b = float(carriers[at[0]]), float(widths[at[1]])
        loop = replace(error_loop(MODEL, np.array([f]), settings_of(f, b, inner), taps=taps), plant=plant)
        poles = loop_poles(loop)
        grid = np.concatenate([f - b * near, f + b * near, afar, np.abs(poles.imag) / (2 * np.pi)])
        growth[at], modulus[at] = _growth_and_modulus(loop, poles, np.clip(grid, 0.1, 0.499 * plant.rate))
    return StabilityMap(carriers, widths, growth, modulus)


def damper_map(case: Case) -> StabilityMap:
    """Map the loop of the inner damper that `inverse` has, over the true delay (`DELAYS`) and a factor (`FACTORS`).

    The loop is that of the error observer with a band that has faded out, and a DC estimate, which the damper does not
    use: their poles, at -50 1/s and beyond, are the only ones that are not the damper's.
    """
    plant, taps, nothing = case.plant(), choose_load_damping(MODEL).taps, np.zeros((1, 2, 2))
    grid = np.concatenate([np.linspace(1.0, 0.499 * plant.rate, 300), plant.modes()])
    growth, modulus = np.zeros((2, len(DELAYS), len(FACTORS)))
    for at in np.ndindex(growth.shape):
        loop = ErrorLoop(
            plant=plant, delay=int(DELAYS[at[0]]), frequency=np.array([100.0]), observer=0.0, integral=0.0, dc=0.5,
            dc_drift=0.05, inner=float(FACTORS[at[1]]), taps=taps, law=nothing, slope=nothing, share=np.zeros(1),
        )  # fmt: skip
        growth[at], modulus[at] = _growth_and_modulus(loop, loop_poles(loop), grid)
    return StabilityMap(DELAYS, FACTORS, growth, modulus)


def _growth_and_modulus(loop: ErrorLoop, poles: Array, frequency: Array) -> tuple[float, float]:
    """Growth (1/s), and modulus margin on a grid (Hz)."""
    growth = float(poles.real.max())
    peak = sensitivity(loop.loop(np.exp(2j * np.pi * frequency / PLATE.rate))).max() if growth < 0 else math.inf
    return growth, 1 / peak


def settings_of(carrier: float, width: float, inner: float) -> dict[str, float]:
    """Settings of one band of bandwidth `width` (Hz) at every level, `inner` (0..1) the factor on the inner damper."""
    observer, integral = 2 * 2 * math.pi * 2 * width / MODEL.rate, INTEGRAL * width
    dc = 2 * math.pi * min(6.0, carrier / 8) / MODEL.rate
    return {
        "lead": (MODEL.delay + 0.5) / MODEL.rate,
        **dict.fromkeys(("observer", "observer_high"), observer),
        **dict.fromkeys(("integral", "integral_medium", "integral_high"), integral),
        "dc": 1.6 * dc,
        "dc_drift": dc**2,
        **dict.fromkeys(("damper", "damper_high"), inner),
        "crowd_speed": 0.0,
        "lowest": MODEL.lowest_frequency,
        "highest": MODEL.highest_frequency,
        "highest_edge": MODEL.highest_edge,
    }
