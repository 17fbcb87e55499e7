"""An ultrasonic surface: the resonant plate, its amplitude loop, and the friction of a finger that slides on it.

Levels: "carrier" simulates the mode where it is; "envelope" moves it down to a low carrier (see `ultrasonic`), with
the same amplitude loop on a fraction of the samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel, FingerRange
from hapticrender.control.bank.controller import PROMPT, BankController
from hapticrender.control.damping import within_a_turn
from hapticrender.plants.base import TouchedPlant
from hapticrender.plants.bounds import check_names, choice, number
from hapticrender.plants.electroadhesion import finger_rows
from hapticrender.plants.friction_laws import LAWS, FrictionLaw
from hapticrender.plants.sliding import SlidingParameters, sliding_state, sliding_tables
from hapticrender.plants.surface_kernels import (
    LOAD,
    POSITION,
    STRENGTH,
    SurfaceState,
    SurfaceTables,
    closed_surface_run,
    surface_run,
)
from hapticrender.plants.ultrasonic import LEVELS, UltrasonicParameters, mode_rows, ultrasonic_state, ultrasonic_tables
from hapticrender.protocols import Array, Controller, Sensed

if TYPE_CHECKING:
    from hapticrender.touch.finger import Finger

PLACES = ("friction",)
PACED_DELAY = 3e-3  # s, of pace times the delay and a sample more, where the inner loop takes its share of the phase
PACED_DELAY_ALONE = 1 / 40  # s, of pace times the delay, where there is none: see `resonant` for both
TAPS = 6  # of the inner loop: at 384 kHz three need a drive eight times as noisy for a sixth more of damping
DRIVEN = 0.9  # of the drive's limit: what an amplitude may ask for, as feedback asks for some on top
MOST_DETUNING = 0.015  # of the resonance: as far as the amplitude loop looks for it
TYPICAL_DETUNING = 1e-3
MOST_DAMPING = 20.0  # times that of the nominal finger
LEARNING = 1.5e3  # 1/s: three times as fast, noise at the least amplitude feigns a quarter of a free plate's damping
LEAST_AMPLITUDE = 0.05e-6  # m: below it a resonance is not told [FACTS 6]


@dataclass(frozen=True, kw_only=True)
class SurfaceParameters(SlidingParameters):
    """Everything that describes the surface, and how finely it is modelled.

    Parameters
    ----------
    rate, friction_coefficient, memory_length, least_speed : float
        See `SlidingParameters`; `rate` is that of the friction.
    tribometer_frequency, tribometer_damping, force_noise, force_range, force_bits : float or int
        See `SlidingParameters`.
    level : {"carrier", "envelope"}
        Whether the mode is simulated where it is.
    sensor : {"amplitude", "tribometer"}
        Whether the friction loop listens to the friction that the sensed amplitude must leave, or to a tribometer.
    law : {"fit", "load-sharing", "intermittent"}
        Of friction over amplitude; its own numbers are those of `friction_laws`.
    bias : float
        Friction without a texture, mu/mu0: 0.1 to 0.95.
    lock : float, Hz
        Bandwidth of the resonance lock, 0 to 100 (1-20); 0: none.
    oversampling, envelope_oversampling : int
        Samples of the carrier in one of the friction, at either level.
    mode : UltrasonicParameters
        The plate; its rate and level follow from those above.
    law_parameters : mapping
        Numbers of the law that differ from its defaults.

    Notes
    -----
    Bias, lock and oversampling are engineering defaults.  The mode's sensor keeps the density of its noise whatever the
    oversampling; see `UltrasonicParameters`.
    """

    rate: float = number(12e3, "Hz", least=1e3, most=1e6)
    level: str = choice("carrier", *LEVELS)
    sensor: str = choice("amplitude", "amplitude", "tribometer")
    law: str = choice("fit", *LAWS)
    bias: float = number(0.55, least=0.1, most=0.95)
    lock: float = number(20.0, "Hz", most=100.0)
    oversampling: int = number(32, "samples", least=1, most=1000)
    envelope_oversampling: int = number(4, "samples", least=1, most=1000)
    mode: UltrasonicParameters = field(default_factory=UltrasonicParameters, metadata={"free": True})
    law_parameters: Mapping[str, float] = field(default_factory=dict, hash=False, metadata={"free": True})

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.carrier_mode  # refuses what does not fit together
        if self.bias <= self.least_ratio:
            raise ValueError(f"bias = {self.bias!r}: must be > {self.least_ratio:.3g}, the least that the law leaves")

    @classmethod
    def with_overrides(cls, overrides: Mapping[str, Any], also: Iterable[str] = ()) -> Self:
        """Defaults with some parameters replaced, of the surface, its mode or its law; see `Validated`."""
        own, mode = cls.names(), UltrasonicParameters.names() - cls.names()
        law = LAWS.get(overrides.get("law", "fit"), LAWS["fit"])
        of_law = law.names() - own - mode
        check_names(overrides, own | mode | of_law, also)
        parts = [{name: overrides[name] for name in overrides if name in known} for known in (own, mode, of_law)]
        try:
            return cls(**parts[0], mode=UltrasonicParameters(**parts[1]), law_parameters=parts[2])
        except (ValueError, TypeError) as error:
            raise type(error)(f"plant.{error}") from None

    @cached_property
    def friction_law(self) -> FrictionLaw:
        """The law of friction over amplitude."""
        return LAWS[self.law](**self.law_parameters)

    @cached_property
    def carrier_mode(self) -> UltrasonicParameters:
        """The mode as it is simulated."""
        if self.level == "carrier":
            return self.mode.sampled(self.rate * self.substeps)
        return self.mode.transposed(self.mode.envelope_frequency, self.rate * self.substeps)

    @property
    def substeps(self) -> int:
        """Samples of the carrier in one of the friction."""
        return self.oversampling if self.level == "carrier" else self.envelope_oversampling

    @property
    def least_ratio(self) -> float:
        """Least mu/mu0 that is asked for: near its floor a law takes ever more amplitude for ever less."""
        floor = self.friction_law.numbers.floor
        return floor + 0.01 * (1.0 - floor)

    def sensor_response(self, frequency: Any, speed: float) -> Any:
        """Return what is sensed per friction (complex) at `frequency` (Hz) under a finger at `speed` (m/s).

        The tribometer's response; or what the sensed amplitude says before the contact's lag, at the middle of the
        sample at whose end friction is felt.
        """
        if self.sensor == "tribometer":
            return self.tribometer_response(frequency)
        return 1.0 / (self.lag_response(frequency, speed) * self._shift(np.asarray(frequency, float) / 2))

    def amplitude_model(self) -> BandModel:
        """Band model of the mode with what a finger and the heat can make of it, for its amplitude loop."""
        mode = self.carrier_mode
        return resonant(mode.band_model(mode.rate, mode.delay), mode, self.lock)

    def amplitude_bands(self) -> Bands:
        """Return the carrier, whose amplitude (m) is the waveform that is asked for."""
        carrier = np.array([self.carrier_mode.carrier])
        none = np.zeros(1)
        return Bands(frequency=carrier, wavenumber=none, phase=none, envelope=none + 1.0, modulated=True)


def resonant(model: BandModel, mode: UltrasonicParameters, lock: float) -> BandModel:
    """Band model of a mode that is to be found and held where it is resonant, by a lock of `lock` (Hz).

    Observer and integral grow with the pace, what they lose by being late with the delay.  With an inner loop the
    pace leaves 45 degrees of phase, as measured with delays of 1 to 4 samples at 192 and 384 kHz; where the margins
    allow none though it would answer in time (96 kHz, 70 kHz at 192 kHz), a touch costs several times as much.
    Without one (a block device) it leaves a modulus margin of 0.35 (Ms 2.9), what is learnt of a finger being part
    of the loop: thin, but at two thirds of it a texture of 400 Hz behind the longest delay is 12 % off in place of
    3 %.
    """
    stiffness, damping = float(model.stiffness[0, 0]), float(model.damping[0, 0])
    detuned = 2 * MOST_DETUNING * stiffness * mode.frequency / mode.carrier  # shifts are kept in Hz at either level
    finger = MOST_DAMPING * mode.finger_damping * mode.frequency / mode.carrier
    return replace(
        model,
        pace=_pace(model),
        lock=lock,
        taps=TAPS,
        held=True,
        finger=FingerRange(
            mass=(0.0, 0.0),
            damping=(-0.9 * damping, finger),
            stiffness=(-detuned, detuned),
            typical_mass=1e-12,
            typical_stiffness=detuned * TYPICAL_DETUNING / MOST_DETUNING,
            least_motion=LEAST_AMPLITUDE,
            fastest=LEARNING,
            contact=None,
        ),
    )


def _pace(model: BandModel) -> float:
    """How many times as fast as the rules of a plate the amplitude may be followed."""
    if model.delay <= PROMPT and within_a_turn(model):
        return PACED_DELAY * model.rate / (model.delay + 1)
    return PACED_DELAY_ALONE * model.rate / model.delay


def full_slew(mode: UltrasonicParameters) -> float:
    """How far the drive, but for what feedback needs of it, moves an amplitude of nothing within a sample (m).

    a' = F/(2 m w) - b/(2 m) a, F behind its hold; see `ultrasonic`.
    """
    turn = 2 * np.pi * mode.carrier
    force = DRIVEN * mode.drive_limit * mode.force_constant * float(np.sinc(mode.carrier / mode.rate))
    return force / (2 * mode.mass * turn * mode.rate)


class UltrasonicSurface(TouchedPlant):
    """The surface in discrete time, behind the `Plant` protocol.

    Parameters
    ----------
    parameters : SurfaceParameters
        The surface and its level of modelling.
    amplitude : BankController
        The amplitude loop, designed for `parameters.amplitude_model()` and `parameters.amplitude_bands()`.
    finger : Finger
        Where the finger is, how hard it presses, and its lateral mechanics.
    seed : int
        Of the noise.
    nominal : (float, float), N and m/s
        Load and speed that the amplitude is held for while no finger is there.

    Attributes
    ----------
    amplitude, skin_velocity : ndarray, shape (n,), m and m/s
        True amplitude of the mode, and velocity of the skin under friction, over the samples of the last run.
    """

    delay = block = 1
    drive_channels = sensed_channels = 1

    def __init__(
        self,
        parameters: SurfaceParameters,
        amplitude: BankController,
        finger: Finger,
        seed: int = 0,
        nominal: tuple[float, float] = (0.5, 0.05),
    ) -> None:
        super().__init__(finger, parameters.rate)
        self.parameters = parameters
        self.amplitude = self.skin_velocity = np.zeros(0)
        self.loop = amplitude
        self._rng = np.random.default_rng(seed)
        self._tables = surface_tables(parameters, amplitude, finger, nominal)
        self._state = surface_state(parameters, amplitude)
        self._last = np.zeros(1)

    def _next(self, n: int) -> tuple[Array, Array, Array, Array]:
        """Finger rows, mode rows, noise and sample flags of the next n samples."""
        finger = finger_rows(self.finger, self._samples, n, self.rate)
        time = self._time(n)
        self._samples += n
        mode = mode_rows(self.parameters.carrier_mode, time, np.where(finger[:, STRENGTH] > 0.0, finger[:, LOAD], 0.0))
        noise = self._rng.standard_normal((n, 1 + self._tables.substeps))
        return finger, mode, noise, np.zeros(n, np.int64)

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (N, shape (n, 1)); row i acts from sample i on, sensed at its start."""
        n = len(drive)
        finger, mode, noise, flags = self._next(n)
        outputs = tuple(np.zeros((n, 1)) for _ in range(4))
        drive = np.ascontiguousarray(drive, float)
        surface_run(self._tables, self._state, drive, finger, mode, noise, *outputs, flags)
        return self._sensed(finger, outputs, flags)

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance surface and controller together, sample by sample, over `wanted` (N, shape (n,))."""
        n = len(wanted)
        finger, mode, noise, flags = self._next(n)
        outputs, drive = tuple(np.zeros((n, 1)) for _ in range(4)), np.zeros((n, 1))
        target = np.zeros((n, controller.n_bands), complex)
        tables, state = controller.tables, controller.state
        closed_surface_run(
            self._tables,
            self._state,
            tables,
            state,
            self._last,
            finger,
            mode,
            noise,
            wanted,
            outputs,
            drive,
            target,
            flags,
        )
        return drive, target, flags, self._sensed(finger, outputs, flags)

    def _sensed(self, finger: Array, outputs: tuple[Array, ...], flags: Array) -> Sensed:
        sensed, motion, skin, amplitude = outputs
        self.skin_velocity, self.amplitude = skin[:, 0], amplitude[:, 0]
        return Sensed(sensed, finger[:, POSITION], motion, finger[:, LOAD], flags)


def surface_state(parameters: SurfaceParameters, amplitude: BankController) -> SurfaceState:
    """A surface at rest."""
    return SurfaceState(
        mode=ultrasonic_state(parameters.carrier_mode.delay - 1),
        control=amplitude.state,
        sliding=sliding_state(),
        wanted=np.zeros(1),
        asked=np.full(1, -1.0),
        estimate=np.zeros(1),
        heard=np.zeros(1),
        motion=np.zeros(1),
        drive=np.zeros(1),
        target=np.zeros(1, complex),
    )


def surface_tables(
    parameters: SurfaceParameters, amplitude: BankController, finger: Finger, nominal: tuple[float, float]
) -> SurfaceTables:
    """Numbers of the compiled surface with this finger on it."""
    numbers = parameters.friction_law.numbers
    load, speed = nominal
    return SurfaceTables(
        substeps=int(parameters.substeps),
        friction=float(parameters.friction_coefficient),
        bias=float(parameters.bias),
        least=float(parameters.least_ratio),
        load=float(load),
        speed=float(speed),
        slew=full_slew(parameters.carrier_mode),
        estimating=parameters.sensor == "amplitude",
        law=numbers,
        mode=ultrasonic_tables(parameters.carrier_mode),
        control=amplitude.tables,
        sliding=sliding_tables(parameters, finger.mechanics),
    )
