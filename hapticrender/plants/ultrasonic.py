"""An ultrasonic plate: one flexural mode, driven through its resonance, whose amplitude takes friction away.

Equation, with the modal displacement q and the drive u::

    m q'' + (b + b_f) q' + m w^2 q = N u

The finger adds the damping b_f and shifts the resonance, both with the cube root of its load.  What is judged is the
mode's displacement; the friction that it leaves is that of `friction_laws`.

The carrier need not be simulated where it is.  With x = Re a e^(j w_d t) and u alike, the complex envelope obeys::

    a' = -(s0 - j dw) a + N/(2 j m w) u,    s0 = b/2m,  dw = w - w_d

up to the order W/w of its own frequency W.  A mode moved down to w_i with m_i = m w/w_i and b_i = b w/w_i, resonance
shifts kept in Hz and N kept, has the same envelope: D_i(j w_i) = j w b = D(j w), and s0 and m w are the same.
That is the level "envelope": still a mode on a carrier, for the same controller, at a fraction of the rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.base import TouchedPlant
from hapticrender.plants.bounds import Validated, choice, number
from hapticrender.plants.ultrasonic_kernels import (
    STEP,
    UltrasonicState,
    UltrasonicTables,
    closed_ultrasonic_run,
    ultrasonic_run,
)
from hapticrender.protocols import Array, Controller, Sensed

if TYPE_CHECKING:
    from hapticrender.touch.finger import Finger

PLACES = ("amplitude",)
LEVELS = ("carrier", "envelope")
NOMINAL_LOAD = 0.5  # N: at which `finger_damping` and `finger_shift` hold
NOMINAL_AMPLITUDE = 3e-6  # m: what `headroom` is told against
MOST_LOAD = 20.0  # N: hardest that a finger presses
MOST_DAMPING_RATIO = 0.5  # beyond it a mode is none
MOST_SHIFT = 0.25  # of the carrier
NYQUIST_MARGIN = 0.45  # of the rate: the carrier must lie below
RAMPS = 1000  # steps a second in which the temperature rises


@dataclass(frozen=True, kw_only=True)
class UltrasonicParameters(Validated):
    """Everything that describes the mode, its electronics and how finely it is modelled.

    Parameters
    ----------
    frequency : float, Hz
        Undamped resonance of the free, cold plate: 20e3 to 70e3.
    modal_mass : float, kg
        3e-3 to 8e-3 in the literature; > 0.
    quality : float
        Of the free plate: 100 to 400; >= 5.
    finger_damping : float, N s/m
        That a finger of 0.5 N adds; grows with the cube root of the load; >= 0.
    finger_shift : float, Hz
        Of the resonance under a finger of 0.5 N, growing alike: -60 to -10.
    temperature_coefficient : float, 1/K
        Of the resonance: -200e-6 to -50e-6.
    temperature_rise : float, K
        That the plate reaches, within +-100.
    temperature_time : float, s
        In which it does, linearly (in steps of 1 ms); > 0.
    drive_limit : float, V
        Largest drive, > 0.
    force_constant : float, N/V
        Modal force per drive, > 0.  The default drives the plate under a 0.5 N finger to twice 3 um (peak) at its
        resonance, F = b w a: 2 * 3 um * 15.7 N s/m * 2 pi 30 kHz / 10 V; see `headroom`.
    sensor_range : float, m
        Full range of the sensor.
    sensor_bits, drive_bits : int
        Resolution over `sensor_range` and over +- `drive_limit`; 0 is ideal.
    sensor_noise : float, m rms
        White noise of each sample at `rate`, >= 0; at another rate its density stays.
    rate : float, Hz
        Sampling rate of the loop; the default is what a sound card can do.
    delay : int, samples
        Loop delay, >= 1: from a sensed sample to the drive computed from it.
    level : {"carrier", "envelope"}
        Whether the mode is simulated where it is, or moved down to `envelope_frequency`.
    envelope_frequency : float, Hz
        Carrier at level "envelope"; >= 500 and below `frequency`.

    Notes
    -----
    Engineering defaults throughout (FACTS section 6): none is a measurement.

    Examples
    --------
    >>> plate = UltrasonicParameters()
    >>> [round(float(plate.pole(load)), 1) for load in (0.0, 0.5)], round(plate.headroom, 2)
    ([75.0, 250.1], 2.0)
    """

    frequency: float = number(30e3, "Hz", least=20e3, most=70e3)
    modal_mass: float = number(5e-3, "kg", above=0.0)
    quality: float = number(200.0, least=5.0, most=1e5)
    finger_damping: float = number(11.0, "N s/m")
    finger_shift: float = number(-30.0, "Hz", least=-1e4, most=1e4)
    temperature_coefficient: float = number(-100e-6, "1/K", least=-1e-3, most=1e-3)
    temperature_rise: float = number(0.0, "K", least=-100.0, most=100.0)
    temperature_time: float = number(1.0, "s", above=0.0)
    drive_limit: float = number(10.0, "V", above=0.0)
    force_constant: float = number(1.777, "N/V", above=0.0)
    sensor_range: float = number(50e-6, "m", above=0.0)
    sensor_bits: int = number(16, least=0, most=24)
    drive_bits: int = number(16, least=0, most=24)
    sensor_noise: float = number(2e-9, "m")
    rate: float = number(192e3, "Hz", least=500.0, most=1e7)
    delay: int = number(1, "samples", least=1, most=100_000)
    level: str = choice("carrier", *LEVELS)
    envelope_frequency: float = number(6e3, "Hz", least=500.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.envelope_frequency >= self.frequency:
            raise ValueError(
                f"envelope_frequency = {self.envelope_frequency!r}: must be < frequency = {self.frequency:g} Hz"
            )
        self._check_carrier()

    def _check_carrier(self) -> None:
        """Refuse a carrier that the rate cannot carry, or that a finger or the heat leaves nothing of."""
        if self.carrier > NYQUIST_MARGIN * self.rate:
            raise ValueError(
                f"rate = {self.rate!r}: must be >= {self.carrier / NYQUIST_MARGIN:g} Hz for a carrier of "
                f"{self.carrier:g} Hz"
            )
        ratio = float(self.pole(MOST_LOAD)) / self.carrier
        if ratio > MOST_DAMPING_RATIO:
            raise ValueError(
                f"finger_damping = {self.finger_damping!r}: damping ratio {ratio:.3g} at {MOST_LOAD:g} N on a carrier "
                f"of {self.carrier:g} Hz, must be <= {MOST_DAMPING_RATIO:g}"
            )
        for name, load, rise in (("finger_shift", MOST_LOAD, 0.0), ("temperature_rise", 0.0, self.temperature_rise)):
            shift = float(self.resonance(load, rise)) - self.carrier
            if abs(shift) > MOST_SHIFT * self.carrier:
                raise ValueError(
                    f"{name} = {getattr(self, name)!r}: shifts the resonance by up to {shift:g} Hz, "
                    f"must be within {MOST_SHIFT * self.carrier:g} Hz of a carrier of {self.carrier:g} Hz"
                )

    def sampled(self, rate: float) -> UltrasonicParameters:
        """Return the same plate at `rate` (Hz); the sensor's noise keeps its density."""
        return replace(self, rate=rate, sensor_noise=self._noise_at(rate))

    def transposed(self, frequency: float, rate: float) -> UltrasonicParameters:
        """Return the same plate at level "envelope": its mode on a carrier of `frequency` (Hz) at `rate` (Hz).

        The sensor's noise keeps its density, so that it disturbs the envelope alike; its resolution stays, and with
        it grows the density of rounding.  The delay stays in samples: at a lower rate it is a longer one.
        """
        noise = self._noise_at(rate)
        return replace(self, level="envelope", envelope_frequency=frequency, rate=rate, sensor_noise=noise)

    def _noise_at(self, rate: float) -> float:
        """Noise of a sample (m rms) at `rate` (Hz), of the same density."""
        return self.sensor_noise * math.sqrt(rate / self.rate) if rate > 0.0 else self.sensor_noise

    @property
    def carrier(self) -> float:
        """Where the free, cold mode is simulated (Hz)."""
        return self.envelope_frequency if self.level == "envelope" else self.frequency

    @property
    def mass(self) -> float:
        """Mass of the mode as simulated (kg)."""
        return self.modal_mass * self.frequency / self.carrier

    def damping(self, normal_load: Array | float = 0.0) -> Array:
        """Damping of the mode as simulated (N s/m) under a finger of `normal_load` (N); 0: free."""
        free = 2 * math.pi * self.frequency * self.modal_mass / self.quality
        return (free + self.finger_damping * _grip(normal_load)) * (self.frequency / self.carrier)

    def resonance(self, normal_load: Array | float = 0.0, temperature_rise: Array | float = 0.0) -> Array:
        """Undamped resonance of the mode as simulated (Hz)."""
        drift = self.frequency * self.temperature_coefficient * np.asarray(temperature_rise, float)
        return self.carrier + self.finger_shift * _grip(normal_load) + drift

    def pole(self, normal_load: Array | float = 0.0) -> Array:
        """Corner of the envelope's low pass, s0/(2 pi) = b/(4 pi m) (Hz), at either level."""
        return self.damping(normal_load) / (4 * math.pi * self.mass)

    def dynamic_stiffness(
        self, frequency: Array | float, normal_load: Array | float = 0.0, temperature_rise: Array | float = 0.0
    ) -> Array:
        """D(j w) of the mode as simulated (N/m, complex) at `frequency` (Hz)."""
        omega = 2 * np.pi * np.asarray(frequency, float)
        resonance = 2 * np.pi * self.resonance(normal_load, temperature_rise)
        return self.mass * (resonance - omega) * (resonance + omega) + 1j * omega * self.damping(normal_load)

    def envelope_error(self, frequency_offset: Array | float, normal_load: Array | float = 0.0) -> Array:
        """Relative difference of the transposed D_i(j(w_i + W)) against D(j(w + W)), complex.

        Parameters
        ----------
        frequency_offset : float or ndarray, Hz
            W/(2 pi): where in the envelope's spectrum.
        normal_load : float or ndarray, N
            Of the finger.

        Notes
        -----
        With S the resonance's shift under the finger,
        ``D(j(w + W)) = -m (W - S)(2 w + W + S) + j b (w + W)``, so that far beyond the pole the difference is
        ``(W + S)(1/w_i - 1/w)/2``, and at the carrier itself ``W (1/w_i - 1/w)``.  The target and the drive being the
        same, the amplitudes differ by as much.
        """
        low = replace(self, level="envelope", rate=max(self.rate, self.envelope_frequency / NYQUIST_MARGIN))
        high = replace(self, level="carrier", rate=max(self.rate, self.frequency / NYQUIST_MARGIN))
        offset = np.asarray(frequency_offset, float)
        moved = low.dynamic_stiffness(low.carrier + offset, normal_load)
        return moved / high.dynamic_stiffness(high.carrier + offset, normal_load) - 1.0

    def drive_for(self, amplitude: float, modulation: float = 0.0, normal_load: float = 0.0) -> float:
        """Drive amplitude (V) that vibrates a tuned mode at `amplitude` (m) under a `modulation` (Hz) of it.

        ``a b w/N sqrt(1 + (f/pole)^2)``: the envelope's low pass is what flat modulation has to make up for.
        """
        tuned = amplitude * float(self.damping(normal_load)) * 2 * math.pi * self.carrier / self.force_constant
        return tuned * math.hypot(1.0, modulation / float(self.pole(normal_load)))

    @property
    def headroom(self) -> float:
        """Amplitude at full drive under a 0.5 N finger, over 3 um."""
        return self.drive_limit / self.drive_for(NOMINAL_AMPLITUDE, normal_load=NOMINAL_LOAD)

    @property
    def drive_step(self) -> float:
        """Resolution of the drive (V); 0 is ideal."""
        return 2 * self.drive_limit / 2**self.drive_bits if self.drive_bits else 0.0

    @property
    def sensor_step(self) -> float:
        """Resolution of the sensor (m); 0 is ideal."""
        return self.sensor_range / 2**self.sensor_bits if self.sensor_bits else 0.0

    def band_model(self, rate: float, delay: int) -> BandModel:
        """What the controller may know of this plate, free and cold, in a loop of `rate` (Hz) and `delay` (samples)."""
        omega = 2 * math.pi * self.carrier
        return BandModel(
            rate=rate,
            delay=delay,
            mass=np.array([[self.mass]]),
            damping=np.array([[float(self.damping())]]),
            stiffness=np.array([[self.mass * omega**2]]),
            force_from_drive=np.array([[self.force_constant]]),
            coordinate_from_sensed=np.eye(1),
            side_from_coordinate=np.eye(1),
            place_from_coordinate=np.eye(1),
            places=PLACES,
            drive_limit=self.drive_limit,
            sensed_limit=self.sensor_range / 2,
            drive_step=self.drive_step,
            sensed_noise=self.sensor_noise,
            rigid=True,
        )


def _grip(normal_load: Array | float) -> Array:
    """(W/0.5 N)^(1/3), 0 without load: how much of the nominal finger is on the plate."""
    return np.cbrt(np.maximum(np.asarray(normal_load, float), 0.0) / NOMINAL_LOAD)


class UltrasonicPlate(TouchedPlant):
    """The mode in discrete time, behind the `Plant` protocol.

    Parameters
    ----------
    parameters : UltrasonicParameters
        The plate and its level of modelling.
    finger : Finger
        Where the finger is and how hard it presses; its own mechanics are too slow for the mode to feel.
    seed : int
        Of the sensor noise.
    block : int
        Samples a `run` call plays before the controller can answer; the rest of the delay is queued inside.
    """

    def __init__(self, parameters: UltrasonicParameters, finger: Finger, seed: int = 0, block: int = 1) -> None:
        if not 1 <= block <= parameters.delay:
            raise ValueError(f"block = {block}: must be between 1 and the loop's delay of {parameters.delay} samples")
        super().__init__(finger, parameters.rate)
        self.parameters = parameters
        self.delay = parameters.delay
        self.block = block
        self.drive_channels = self.sensed_channels = 1
        self._rng = np.random.default_rng(seed)
        self._tables = ultrasonic_tables(parameters)
        self._state = ultrasonic_state(parameters.delay - block)
        self._last = np.zeros(1)

    def _next(self, n: int) -> tuple[Array, Array, Array, Array]:
        """Finger rows, mode rows, noise and sample flags of the next n samples."""
        time = self._time(n)
        self._samples += n
        finger = self.finger.touch(time)
        load = np.where(finger[:, 2] > 0.0, finger[:, 1], 0.0)
        noise = self._rng.standard_normal((n, 1)) if self._tables.sensor_noise > 0.0 else np.zeros((n, 1))
        return finger, mode_rows(self.parameters, time, load), noise, np.zeros(n, np.int64)

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (V, shape (n, 1)); row i acts from sample i on, sensed at its start."""
        n = len(drive)
        finger, mode, noise, flags = self._next(n)
        sensed, motion = np.zeros((n, 1)), np.zeros((n, 1))
        drive = np.ascontiguousarray(drive, float)
        ultrasonic_run(self._tables, self._state, drive, mode, noise, sensed, motion, flags)
        return Sensed(sensed, finger[:, 0], motion, finger[:, 1], flags)

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance plate and controller together, sample by sample, over `wanted` (m, shape (n,))."""
        n = len(wanted)
        finger, mode, noise, flags = self._next(n)
        sensed, motion, drive = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 1))
        target = np.zeros((n, controller.n_bands), complex)
        closed_ultrasonic_run(
            self._tables,
            self._state,
            controller.tables,
            controller.state,
            self._last,
            np.ascontiguousarray(finger[:, 0]),
            mode,
            noise,
            wanted,
            sensed,
            motion,
            drive,
            target,
            flags,
        )
        return drive, target, flags, Sensed(sensed, finger[:, 0], motion, finger[:, 1], flags)


def mode_rows(parameters: UltrasonicParameters, time: Array, load: Array) -> Array:
    """Damping (N s/m) and resonance (rad/s) at each `time` (s) under a `load` (N), shape (n, 2)."""
    steps = np.floor(time * RAMPS * (1 + 1e-12)) / RAMPS
    rise = parameters.temperature_rise * np.minimum(steps / parameters.temperature_time, 1.0)
    return np.stack([parameters.damping(load), 2 * np.pi * parameters.resonance(load, rise)], axis=1)


def ultrasonic_state(latency: int) -> UltrasonicState:
    """A mode at rest whose drive takes `latency` samples to act."""
    return UltrasonicState(
        z=np.zeros(2),
        step=np.zeros(STEP),
        frozen=np.full(2, np.nan),
        pending=np.zeros(latency),
        cursor=np.zeros(1, np.int64),
        force=np.zeros(1),
    )


def ultrasonic_tables(parameters: UltrasonicParameters) -> UltrasonicTables:
    """Numbers of the compiled mode."""
    return UltrasonicTables(
        period=float(1.0 / parameters.rate),
        mass=float(parameters.mass),
        force_constant=float(parameters.force_constant),
        drive_limit=float(parameters.drive_limit),
        drive_step=float(parameters.drive_step),
        sensor_limit=float(parameters.sensor_range / 2),
        sensor_step=float(parameters.sensor_step),
        sensor_noise=float(parameters.sensor_noise),
    )
