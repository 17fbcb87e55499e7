"""The vibrotactile plate of Grigorii et al. 2021: two coils, a sheet of glass, Hall sensors at its ends, a finger.

Equations, with q = [x_c, a theta], a = coil_spacing/2, side 1 at -a, finger at p::

    (M s^2 + C s + K) q = force_constant [[1, 1], [-1, 1]] i - F_f [1, p/a]
    M = diag(m, I/a^2), K = [[k1+k2, k2-k1], [k2-k1, k1+k2]], C alike
    F_f = W + Z_f(s) s (x_c + p theta)

The paper's own force equations carry (m/2) x_i'' -+ (I/2) theta'', which is
dimensionally wrong; the form above is (m/2) x_c'' -+ (I/d) theta''.

As a further level the glass bends: a displacement e of the sensors in the
first free-free bending mode, of shape phi (1 at the sensors), adds phi(x) e at
x and obeys, with the damping ratio zeta and m_b its modal mass::

    m_b (e'' + 2 zeta w_b e' + w_b^2 e) = phi_coil force_constant (i_1 + i_2) - phi(p) F_f

and the finger feels x_c + p theta + phi(p) e.  Frequency and damping are those
measured on the free plate, its suspension included, so nothing but the finger
couples the mode to heave and rocking.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.damping_margins import BendingMode
from hapticrender.plants.base import TouchedPlant
from hapticrender.plants.bounds import Validated, number
from hapticrender.plants.closed import CLOSED
from hapticrender.plants.kernels import PlateState, plate_run
from hapticrender.plants.plate_tables import plate_state, plate_tables
from hapticrender.protocols import Array, Controller, Sensed

if TYPE_CHECKING:
    from hapticrender.touch.finger import Finger

PLACES = ("centre", "end 1", "end 2")
EXPECTED_BENDING = BendingMode(  # FACTS section 3 A: 1.1-1.4 kHz, either sign [E]; for a plate that was not measured
    frequency=1250.0, damping=0.01, coupling=(0.1 / 9.5e-3, 0.0), spread=150.0, measured=False
)
FREE_FREE = 2.365020372431352  # half of the first root of cos(x) cosh(x) = 1: the first even mode of a free bar


@dataclass(frozen=True, kw_only=True)
class PlateParameters(Validated):
    """Everything that describes the plate, its electronics and how finely it is modelled.

    Parameters
    ----------
    mass, inertia : float, kg, kg m2
        Moving mass and its inertia about the middle, > 0.
    stiffness_1, stiffness_2 : float, N/m
        Coil suspensions, > 0.
    damping_1, damping_2 : float, N s/m
        Coil dampings, >= 0.
    force_constant : float, N/A
        Of each coil, > 0.
    coil_spacing, glass_length : float, m
        Distance between the coils; length of the glass, the sensors sit at its ends.
    amplifier_r1, amplifier_r2, amplifier_rp : float, ohm
        Transconductance amplifier, i = V/R1 (1 - R2/Rp).  Drive is asked for in A, as the paper's parts would give it;
        other parts give another current.
    current_limit : float, A
        Of each coil, > 0 (engineering default).
    current_bits : int
        Resolution of the command over +- current_limit; 0 is ideal.
    sensor_range : float, m
        Full range of a sensor.
    sensor_bits : int
        Resolution over sensor_range; 0 is ideal.
    sensor_noise : float, m rms
        White noise of each sensor, >= 0.
    sensor_gain_1, sensor_gain_2 : float
        Reading per displacement of each sensor, 1 when calibrated, > 0; the controller takes them for calibrated.
    rate : float, Hz
        Sampling rate of the embedded loop.
    delay : int, samples
        Loop delay, >= 1: from a sensed sample to the drive computed from it.
    coils : int
        2: each at its suspension; 1: in the middle, which moves heave alone.
    degrees_of_freedom : int
        2: heave and rocking; 1: heave only.
    finger_dynamics : int
        1: the finger's mechanics as the scene gives them; 0: only its static load.
    bending_frequency : float, Hz
        First bending mode of the glass, at most `rate`; 0: the glass is rigid.
    bending_damping : float
        Damping ratio of that mode, >= 0.
    bending_mass : float, kg
        Its modal mass, the shape being 1 at the sensors; > 0.
    bending_coil : float
        Its shape at the coils, -1 to 1.  The coils sit near its nodes, so the sign has to be measured.

    Notes
    -----
    Defaults are the paper's printed values; current and sensor ranges are engineering defaults (FACTS section 1), so
    are the numbers of the bending mode (FACTS section 3 A: 1.1-1.4 kHz, 9.5 g, 0.01, about +-0.1).
    """

    mass: float = number(32e-3, "kg", above=0.0)
    inertia: float = number(4e-5, "kg m2", above=0.0)
    stiffness_1: float = number(22.4e3, "N/m", above=0.0)
    stiffness_2: float = number(22.9e3, "N/m", above=0.0)
    damping_1: float = number(0.85, "N s/m")
    damping_2: float = number(0.85, "N s/m")
    force_constant: float = number(7.4, "N/A", above=0.0)
    coil_spacing: float = number(55e-3, "m", above=0.0)
    glass_length: float = number(110e-3, "m", above=0.0)
    amplifier_r1: float = number(10e3, "ohm", above=0.0)
    amplifier_r2: float = number(2e3, "ohm", above=0.0)
    amplifier_rp: float = number(1.0, "ohm", above=0.0)
    current_limit: float = number(3.0, "A", above=0.0)
    current_bits: int = number(12, most=24)
    sensor_range: float = number(2e-3, "m", above=0.0)
    sensor_bits: int = number(14, most=24)
    sensor_noise: float = number(1e-6, "m")
    sensor_gain_1: float = number(1.0, above=0.0)
    sensor_gain_2: float = number(1.0, above=0.0)
    rate: float = number(5000.0, "Hz", least=500.0, most=1000000.0)
    delay: int = number(1, "samples", least=1, most=100_000)
    coils: int = number(2, least=1, most=2)
    degrees_of_freedom: int = number(2, least=1, most=2)
    finger_dynamics: int = number(1, most=1)
    bending_frequency: float = number(0.0, "Hz")
    bending_damping: float = number(0.01)
    bending_mass: float = number(9.5e-3, "kg", above=0.0)
    bending_coil: float = number(-0.1, least=-1.0, most=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bending_frequency > self.rate:
            raise ValueError(f"bending_frequency = {self.bending_frequency!r}: must be <= rate = {self.rate:g} Hz")

    @property
    def half_spacing(self) -> float:
        """Half the coil spacing a (m)."""
        return self.coil_spacing / 2

    @property
    def amplifier_gain(self) -> float:
        """Coil current per command voltage (A/V): (1 - R2/Rp)/R1, about -1/5."""
        return (1 - self.amplifier_r2 / self.amplifier_rp) / self.amplifier_r1

    @property
    def current_step(self) -> float:
        """Resolution of the coil current (A); 0 is ideal."""
        return 2 * self.current_limit / 2**self.current_bits if self.current_bits else 0.0

    @property
    def sensor_step(self) -> float:
        """Resolution of a sensor (m); 0 is ideal."""
        return self.sensor_range / 2**self.sensor_bits if self.sensor_bits else 0.0

    @property
    def mass_matrix(self) -> Array:
        """M (kg, shape (2, 2)) in heave and rocking."""
        return np.diag([self.mass, self.inertia / self.half_spacing**2])

    @property
    def damping_matrix(self) -> Array:
        """C (N s/m, shape (2, 2))."""
        return _pair(self.damping_1, self.damping_2)

    @property
    def stiffness_matrix(self) -> Array:
        """K (N/m, shape (2, 2))."""
        return _pair(self.stiffness_1, self.stiffness_2)

    @property
    def force_from_drive(self) -> Array:
        """Generalised forces per coil current (N/A, shape (2, coils))."""
        if self.coils == 1:
            return self.force_constant * np.array([[1.0], [0.0]])
        return self.force_constant * np.array([[1.0, 1.0], [-1.0, 1.0]])

    @property
    def bending(self) -> BendingMode | None:
        """The bending mode as the sensors and coils see it, in heave and rocking; None where the glass is rigid."""
        if self.bending_frequency == 0.0:
            return None
        return BendingMode(
            frequency=self.bending_frequency,
            damping=self.bending_damping,
            coupling=(self.bending_coil / self.bending_mass, 0.0),
        )

    def bending_shape(self, position: Array | float) -> Array:
        """Shape of the bending mode at `position` (m from the middle), that of a free bar: 1 at the ends, -0.61 there.

        The coils have a number of their own, `bending_coil`: a free bar would give -0.099 at the quarter points.
        """
        wavenumber, grow, wave = self._bar()
        angle = wavenumber * np.asarray(position, float)
        return grow * np.cosh(angle) + wave * np.cos(angle)

    def _bar(self) -> tuple[float, float, float]:
        """Wavenumber (rad/m) of the bending mode and the weights of its cosh and cos."""
        return 2 * FREE_FREE / self.glass_length, 0.5 / math.cosh(FREE_FREE), 0.5 / math.cos(FREE_FREE)

    def modes(self) -> tuple[Array, Array]:
        """Undamped-equivalent frequencies (Hz, ascending) and damping ratios of the free, rigid plate's two modes."""
        inverse = np.linalg.inv(self.mass_matrix)
        system = np.block(
            [[np.zeros((2, 2)), np.eye(2)], [-inverse @ self.stiffness_matrix, -inverse @ self.damping_matrix]]
        )
        poles = np.linalg.eigvals(system)
        poles = poles[poles.imag > 0]
        poles = poles[np.argsort(abs(poles))]
        return abs(poles) / (2 * np.pi), -poles.real / abs(poles)

    def static_load(self, side_1: float, side_2: float) -> tuple[float, float]:
        """Normal load (N) and finger position (m from the middle, towards side 2) from the slow sag of the sides (m).

        W = -(k1 x1 + k2 x2); the distance from transducer 2 towards 1 is d k1 x1/(k1 x1 + k2 x2), which the
        paper prints as d (k2 x2/(k1 x1) + 1)^-1 and so divides by zero where side 1 does not sag.
        """
        carried_1, carried_2 = self.stiffness_1 * side_1, self.stiffness_2 * side_2
        load = -(carried_1 + carried_2)
        if load == 0.0:
            raise ValueError(f"{side_1=}, {side_2=}: the sides carry no net load, so it has no position")
        return load, self.half_spacing + self.coil_spacing * carried_1 / load

    def dynamic_stiffness(self, frequency: Array, finger: Array | complex = 0.0, position: float = 0.0) -> Array:
        """D(j w) in heave and rocking (N/m, shape (..., 2, 2)) under a finger impedance (N s/m) at `position` (m).

        The glass counts as rigid, also where it bends: near and above `bending_frequency` this is no longer the plate.
        """
        s = 2j * np.pi * np.asarray(frequency, float)[..., None, None]
        lever = np.array([1.0, position / self.half_spacing])
        load = np.asarray(finger, complex)[..., None, None] * s * np.outer(lever, lever)
        return self.mass_matrix * s**2 + self.damping_matrix * s + self.stiffness_matrix + load

    def band_model(self, rate: float, delay: int) -> BandModel:
        """What the controller may know of this plate, in a loop of `rate` (Hz) and `delay` (samples)."""
        reach, n = self.glass_length / self.coil_spacing, self.coils  # one coil moves one coordinate
        return BandModel(
            rate=rate,
            delay=delay,
            mass=self.mass_matrix[:n, :n],
            damping=self.damping_matrix[:n, :n],
            stiffness=self.stiffness_matrix[:n, :n],
            force_from_drive=self.force_from_drive[:n],
            coordinate_from_sensed=np.linalg.inv(np.array([[1.0, -reach], [1.0, reach]]))[:n],
            side_from_coordinate=np.array([[1.0, -1.0], [1.0, 1.0]])[:n, :n],
            place_from_coordinate=np.array([[1.0, 0.0], [1.0, -reach], [1.0, reach]])[:, :n],
            places=PLACES,
            drive_limit=self.current_limit,
            sensed_limit=self.sensor_range / 2,
            drive_step=self.current_step,
            sensed_noise=self.sensor_noise,
            bending=self.bending,
            rigid=self.bending is None,
        )


def _pair(side_1: float, side_2: float) -> Array:
    """Two equal-kind elements at the coils, in heave and rocking."""
    return np.array([[side_1 + side_2, side_2 - side_1], [side_2 - side_1, side_1 + side_2]])


class Plate(TouchedPlant):
    """The plate in discrete time, behind the `Plant` protocol.

    Parameters
    ----------
    parameters : PlateParameters
        The plate and its levels of modelling.
    finger : Finger
        Where the finger is, how hard it presses, and its mechanics.
    seed : int
        Of the sensor noise.
    block : int
        Samples a `run` call plays before the controller can answer; the rest of the delay is queued inside.
    """

    def __init__(self, parameters: PlateParameters, finger: Finger, seed: int = 0, block: int = 1) -> None:
        if not 1 <= block <= parameters.delay:
            raise ValueError(f"block = {block}: must be between 1 and the loop's delay of {parameters.delay} samples")
        super().__init__(finger, parameters.rate)
        self.parameters = parameters
        self.delay = parameters.delay
        self.block = block
        self.drive_channels, self.sensed_channels = parameters.coils, 2
        self._rng = np.random.default_rng(seed)
        self._tables = plate_tables(parameters, finger)
        self._last = np.zeros(2)

    @cached_property
    def _state(self) -> PlateState:
        return plate_state(self.delay - self.block)

    def _next(self, n: int) -> tuple[Array, Array, Array]:
        """Finger rows, noise and sample flags of the next n samples."""
        time = self._time(n)
        self._samples += n
        noise = self._rng.standard_normal((n, 2)) if self._tables.sensor_noise > 0.0 else np.zeros((n, 2))
        return self.finger.touch(time), noise, np.zeros(n, np.int64)

    def closes(self, controller: Controller) -> bool:
        """Whether `closed_loop` has compiled code for this controller."""
        return super().closes(controller) and self.drive_channels == 2

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (A, shape (n, coils)); row i acts from sample i, sensed at its start."""
        n = len(drive)
        finger, noise, flags = self._next(n)
        sensed, motion = np.zeros((n, 2)), np.zeros((n, 3))
        each = np.repeat(drive, 2 // self.drive_channels, axis=1)  # a coil in the middle acts like two that share it
        plate_run(self._tables, self._state, np.ascontiguousarray(each, float), finger, noise, sensed, motion, flags)
        return Sensed(sensed, finger[:, 0], motion, finger[:, 1], flags)

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance plate and controller together, sample by sample, over `wanted` (m, shape (n,))."""
        n = len(wanted)
        finger, noise, flags = self._next(n)
        sensed, motion, drive = np.empty((n, 2)), np.empty((n, 3)), np.empty((n, 2))
        target = np.empty((n, controller.n_bands), complex)
        CLOSED[type(controller.tables)](
            self._tables,
            self._state,
            controller.tables,
            controller.state,
            self._last,
            finger,
            noise,
            wanted,
            sensed,
            motion,
            drive,
            target,
            flags,
        )
        return drive, target, flags, Sensed(sensed, finger[:, 0], motion, finger[:, 1], flags)
