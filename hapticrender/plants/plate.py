"""The vibrotactile plate of Grigorii et al. 2021: two coils, a sheet of glass, Hall sensors at its ends, a finger.

The equations of motion, corrected, are those of docs/theory.md, section 3: q = [x_c, a theta], a = coil_spacing/2, and
the displacement e of the sensors in the first free-free bending mode.  Frequency and damping of that mode are those
measured on the free plate, its suspension included, so that the finger alone couples it to heave and rocking.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hapticrender.checks import Validated, parameter, require
from hapticrender.control.damping import BendingMode
from hapticrender.control.device_model import DeviceModel
from hapticrender.jit import record_of
from hapticrender.mathx import state_space, zoh
from hapticrender.plants.compiled import CompiledPlant, resolution
from hapticrender.plants.plate_kernels import COLUMNS, FUNCTIONS, NODES, PLATE, plate_step
from hapticrender.protocols import Array
from hapticrender.touch.finger import Finger
from hapticrender.touch.mechanics import NONE, FingerMechanics

PLACES = ("centre", "end 1", "end 2")
SIDES = np.array([[1.0, -1.0], [1.0, 1.0]])  # displacement of sides 1 and 2, and their currents, by heave and rocking
EXPECTED_BENDING = BendingMode(  # estimate for a plate that was not measured: 1.1-1.4 kHz, either sign
    frequency=1250.0, damping=0.01, coupling=(0.1 / 9.5e-3, 0.0), spread=150.0, measured=False
)
FREE_FREE = 2.365020372431352  # half of the first root of cos(x) cosh(x) = 1: the first even mode of a free bar


@dataclass(frozen=True, kw_only=True)
class PlateParameters(Validated):
    """Everything that describes the plate, its electronics and how finely it is modelled.

    Notes
    -----
    Defaults are the printed values of Grigorii et al. 2021; the limits of current and sensors are engineering
    defaults, the numbers of the bending mode are estimates for such a sheet of glass (1.1-1.4 kHz, 9.5 g, 0.01, +-0.1).
    """

    mass: float = parameter(32e-3, "kg", "moving mass", above=0.0)
    inertia: float = parameter(4e-5, "kg m2", "about the middle", above=0.0)
    stiffness_1: float = parameter(22.4e3, "N/m", "coil suspension", above=0.0)
    stiffness_2: float = parameter(22.9e3, "N/m", "coil suspension", above=0.0)
    damping_1: float = parameter(0.85, "N s/m", "of a coil")
    damping_2: float = parameter(0.85, "N s/m", "of a coil")
    force_constant: float = parameter(7.4, "N/A", "of each coil", above=0.0)
    coil_spacing: float = parameter(55e-3, "m", "distance between the coils", above=0.0)
    glass_length: float = parameter(110e-3, "m", "the sensors sit at its ends", above=0.0)
    current_limit: float = parameter(3.0, "A", "of each coil", above=0.0)
    current_bits: int = parameter(12, about="resolution over +- current_limit, 0 is ideal", most=24)
    sensor_range: float = parameter(2e-3, "m", "full range of a sensor", above=0.0)
    sensor_bits: int = parameter(14, about="resolution over sensor_range, 0 is ideal", most=24)
    sensor_noise: float = parameter(1e-6, "m", "white noise of a sensor, rms")
    sensor_gain_1: float = parameter(1.0, about="reading per displacement", above=0.0)
    sensor_gain_2: float = parameter(1.0, about="reading per displacement", above=0.0)
    rate: float = parameter(5000.0, "Hz", "of the embedded loop", least=500.0, most=1000000.0)
    delay: int = parameter(1, "samples", "from a sensed sample to the drive computed from it", least=1, most=100_000)
    coils: int = parameter(2, about="2: at the suspensions, 1: in the middle, for heave alone", least=1, most=2)
    degrees_of_freedom: int = parameter(2, about="2: heave and rocking, 1: heave only", least=1, most=2)
    finger_dynamics: int = parameter(1, about="1: the finger's mechanics act, 0: only its static load", most=1)
    bending_frequency: float = parameter(0.0, "Hz", "of the first bending mode, at most rate; 0: rigid glass")
    bending_damping: float = parameter(0.01, about="damping ratio of that mode")
    bending_mass: float = parameter(9.5e-3, "kg", "modal mass, the shape being 1 at the sensors", above=0.0)
    bending_coil: float = parameter(-0.1, about="shape at the coils; its sign must be measured", least=-1.0, most=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        bending, rate = self.bending_frequency, self.rate
        require(bending <= rate, "bending_frequency", bending, f"<= rate = {rate:g} Hz")

    @property
    def half_spacing(self) -> float:
        """Half the coil spacing a (m)."""
        return self.coil_spacing / 2

    current_step = resolution("current_bits", "current_limit", 2.0, "the coil current (A)")
    sensor_step = resolution("sensor_bits", "sensor_range", 1.0, "a sensor (m)")

    @property
    def mass_matrix(self) -> Array:
        """M (kg, shape (2, 2)) in heave and rocking."""
        return np.diag([self.mass, self.inertia / self.half_spacing**2])

    @property
    def damping_matrix(self) -> Array:
        """C (N s/m, shape (2, 2))."""
        return SIDES.T @ np.diag([self.damping_1, self.damping_2]) @ SIDES

    @property
    def stiffness_matrix(self) -> Array:
        """K (N/m, shape (2, 2))."""
        return SIDES.T @ np.diag([self.stiffness_1, self.stiffness_2]) @ SIDES

    @property
    def force_from_drive(self) -> Array:
        """Generalised forces per coil current (N/A, shape (2, coils))."""
        return self.force_constant * (SIDES.T if self.coils == 2 else np.eye(2)[:, :1])

    @property
    def ends(self) -> tuple[float, float]:
        """Positions of the sensors (m from the middle)."""
        return -self.glass_length / 2, self.glass_length / 2

    @property
    def bending(self) -> BendingMode | None:
        """The bending mode as the sensors and coils see it, in heave and rocking; None where the glass is rigid."""
        if self.bending_frequency == 0.0:
            return None
        return BendingMode(
            frequency=self.bending_frequency,
            damping=self.bending_damping,
            coupling=(self.bending_coil / self.bending_mass, 0.0),
            spread=min(BendingMode.spread, self.bending_frequency / 2),
        )

    def displacement(self, position: ArrayLike) -> Array:
        """Displacement of the glass at `position` (m) per heave, rocking and bending, shape (..., 3).

        The bending mode has the shape of a free bar: 1 at the ends, -0.61 in the middle.  The coils have a number of
        their own, `bending_coil`: a free bar would give -0.099 at the quarter points.
        """
        position = np.asarray(position, float)
        wavenumber, of_cosh, of_cos = self.bending_bar
        bending = of_cosh * np.cosh(wavenumber * position) + of_cos * np.cos(wavenumber * position)
        return np.stack([np.ones_like(position), position / self.half_spacing, bending], axis=-1)

    @property
    def bending_bar(self) -> tuple[float, float, float]:
        """Wavenumber (rad/m) of the bending mode and the weights of its cosh and cos."""
        return 2 * FREE_FREE / self.glass_length, 0.5 / math.cosh(FREE_FREE), 0.5 / math.cos(FREE_FREE)

    def modes(self) -> tuple[Array, Array]:
        """Undamped-equivalent frequencies (Hz, ascending) and damping ratios of the free, rigid plate's two modes."""
        matrices = self.mass_matrix, self.damping_matrix, self.stiffness_matrix
        poles = np.linalg.eigvals(state_space(*matrices, np.eye(2))[0])
        poles = poles[poles.imag > 0]
        poles = poles[np.argsort(abs(poles))]
        return abs(poles) / (2 * np.pi), -poles.real / abs(poles)

    def dynamic_stiffness(self, frequency: Array, finger: Array | complex = 0.0, position: ArrayLike = 0.0) -> Array:
        """D(j w) in heave and rocking (N/m, shape (..., 2, 2)) under a finger impedance (N s/m) at `position` (m).

        The glass counts as rigid, also where it bends: near and above `bending_frequency` this is no longer the plate.
        """
        s = 2j * np.pi * np.asarray(frequency, float)[..., None, None]
        lever = self.displacement(position)[..., :2]
        load = np.asarray(finger)[..., None, None] * s * lever[..., :, None] * lever[..., None, :]
        return self.mass_matrix * s**2 + self.damping_matrix * s + self.stiffness_matrix + load

    def device_model(self, rate: float, delay: int) -> DeviceModel:
        """Device model of this plate without a finger, in a loop of `rate` (Hz) and `delay` (samples)."""
        n = self.coils  # one coil moves one coordinate
        places = self.displacement([0.0, *self.ends])[:, :2]
        sensors = np.linalg.inv(places[1:]) / (self.sensor_gain_1, self.sensor_gain_2)  # heave and rocking per sensor
        return DeviceModel(
            rate=rate,
            delay=delay,
            mass=self.mass_matrix[:n, :n],
            damping=self.damping_matrix[:n, :n],
            stiffness=self.stiffness_matrix[:n, :n],
            force_from_drive=self.force_from_drive[:n],
            coordinate_from_sensed=sensors[:n],
            side_from_coordinate=SIDES[:n, :n],
            place_from_coordinate=places[:, :n],
            places=PLACES,
            drive_limit=self.current_limit,
            sensed_limit=self.sensor_range / 2,
            drive_step=self.current_step,
            sensed_noise=self.sensor_noise,
            bending=self.bending,
            rigid=self.bending is None,
            lever_per_metre=(n - 1) / self.half_spacing,
            shown=places @ sensors if n < len(sensors) else None,  # one coil does not move the rocking
        )


class Structure(NamedTuple):
    """Plate and finger as M q'' + C q' + K q = inputs u, y = outputs q.

    Coordinates q (m): heave, rocking (displacement at the coils; unless it is locked), bending (displacement of the
    sensors; where the glass bends) and the phalanx (of order 4).  Inputs u: coil currents (A), normal load (N).
    Outputs y (m): displacement of centre, end 1, end 2 and of the glass under the finger.
    """

    mass: Array
    damping: Array
    stiffness: Array
    inputs: Array
    outputs: Array

    def zero_order_hold(self, rate: float) -> tuple[Array, Array]:
        """Phi (2n, 2n) and Gamma (2n, inputs) of [q, q'] from sample to sample (Hz) under held inputs, exactly."""
        return zoh(*state_space(self.mass, self.damping, self.stiffness, self.inputs), 1.0 / rate)


def structure(
    parameters: PlateParameters, mechanics: FingerMechanics = NONE, position: float = 0.0, strength: float = 1.0
) -> Structure:
    """Assemble mass, damping and stiffness matrices of the plate with a finger at `position` (m from the middle).

    `mechanics` of order 0 add nothing but the normal load, of 2 their impedance, of 4 the phalanx as a coordinate of
    its own, which needs a mass (ValueError).  `strength` is a factor on the impedance, >= 0; 0: the finger is lifted.
    """
    p, order = parameters, mechanics.order if parameters.finger_dynamics and strength > 0.0 else 0
    if order == 4 and not mechanics.phalanx_mass > 0.0:
        raise ValueError(f"phalanx_mass = {mechanics.phalanx_mass!r} kg: must be > 0")
    omega, modal = 2 * math.pi * p.bending_frequency, p.bending_mass
    output = np.pad(p.displacement([0.0, *p.ends, position]), ((0, 0), (0, 1)))
    tissue = output[-1] - [0.0, 0.0, 0.0, order == 4]
    matrices = []
    for plate, bending, phalanx, finger, acting in (
        (p.mass_matrix, modal, mechanics.phalanx_mass, mechanics.mass, output[-1]),
        (p.damping_matrix, 2 * p.bending_damping * omega * modal, mechanics.phalanx_damping, mechanics.damping, tissue),
        (p.stiffness_matrix, omega**2 * modal, mechanics.phalanx_stiffness, mechanics.stiffness, tissue),
    ):
        matrix = np.pad(plate, (0, 2)) + np.diag([0.0, 0.0, bending, strength * phalanx])
        matrices.append(matrix + strength * finger * np.outer(acting, acting) if order else matrix)
    forces = np.vstack([p.force_from_drive, np.full(p.coils, p.force_constant * p.bending_coil), np.zeros(p.coils)])
    kept = np.flatnonzero([True, p.degrees_of_freedom == 2, omega > 0.0, order == 4])
    mass, damping, stiffness = (matrix[np.ix_(kept, kept)] for matrix in matrices)
    inputs = np.column_stack([forces, -output[-1]])[kept]
    return Structure(mass, damping, stiffness, inputs, output[:, kept])


class Plate(CompiledPlant):
    """The plate in discrete time, behind the `Plant` protocol; `block` samples a call of `run`, the rest queued inside.

    `motion` holds the displacements at `PLACES` (m) and, in a fourth column, the velocity of the glass under the
    finger (m/s).
    """

    step = plate_step
    sensed_channels = noise_channels = 2
    motion_channels, places = 4, len(PLACES)

    def __init__(self, parameters: PlateParameters, finger: Finger, seed: int = 0, block: int = 1) -> None:
        self.drive_channels = parameters.coils
        super().__init__(finger, parameters.rate, delay=parameters.delay, block=block, seed=seed)
        self.parameters = parameters
        self.buffers = (np.zeros((self.delay - block, parameters.coils)),)
        structure(parameters, finger.mechanics)  # refuses what cannot be
        for function in FUNCTIONS.values():
            function.expect()

    @cached_property
    def state(self) -> Array:  # type: ignore[override]
        """Record of the step, made with the first sample: its compiled functions are expected until then."""
        p, mechanics, (queue,), period = self.parameters, self.finger.mechanics, self.buffers, 1.0 / self.rate
        free = structure(p)
        kept = np.flatnonzero([True, p.degrees_of_freedom == 2, p.bending_frequency > 0.0])
        s = record_of(
            PLATE,
            p,
            columns=COLUMNS,
            channels=p.coils,
            queue=queue,
            latency=len(queue),
            held=np.nan,
            bent_at=np.nan,
            lever=np.nan,
            strength=np.nan,
            period=period,
            lever_per_metre=1.0 / p.half_spacing,
            reach=p.glass_length / p.coil_spacing,
            nodes_per_lever=(NODES - 1) / (2.0 * (p.glass_length / p.coil_spacing)),
            sensor_limit=p.sensor_range / 2,
            sensor_gain=(p.sensor_gain_1, p.sensor_gain_2),
            **{name: function.address for name, function in FUNCTIONS.items()},
        )
        for first, matrix, scale in (0, free.stiffness, -(period**2)), (4, free.damping, -period):
            s["free"][0, first + kept[:, None], kept] = scale * matrix
        s["free"][0, 8 : 8 + p.coils][:, kept] = period**2 * free.inputs[:, :-1].T
        s["inverse_mass"][0, kept] = 1.0 / free.mass.diagonal()
        if p.finger_dynamics and mechanics.order:
            s["skin"] = period**2 * mechanics.stiffness, period * mechanics.damping, mechanics.mass
        if p.finger_dynamics and mechanics.order == 4:
            s["inverse_mass"][0, 3] = 1.0 / mechanics.phalanx_mass
            s["phalanx"] = period**2 * mechanics.phalanx_stiffness, period * mechanics.phalanx_damping
        s["outputs"][0][:, kept] = free.outputs[:3]
        s["system"][0, 4:8, :4] = np.eye(4)
        if p.bending_frequency > 0.0:
            wavenumber, *weights = p.bending_bar
            s["shape"] = wavenumber * p.half_spacing, *weights
        return s

    def inputs(self, first: int, n: int) -> Array:
        """Position (m), load (N) and strength of the finger; the plate does not use its speed."""
        return self.finger.touch((first + np.arange(n)) / self.rate)

    def noise(self, n: int) -> Array:
        """Draw the noise of both sensors; nothing is drawn where they have none."""
        return super().noise(n) if self.parameters.sensor_noise > 0.0 else np.zeros((n, 2))
