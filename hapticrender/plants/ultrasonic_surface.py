"""An ultrasonic surface: the resonant plate, its amplitude loop, and the friction of a finger that slides on it.

Levels: "carrier" simulates the mode where it is; "envelope" moves it down to a low carrier (see `ultrasonic`), with
the same amplitude loop on a fraction of the samples.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import check_names, option, parameter, require
from hapticrender.control.controller import BankController
from hapticrender.control.damping import oscillators, turns
from hapticrender.control.device_model import DeviceModel, FingerRange
from hapticrender.jit import record_of
from hapticrender.plants.compiled import CompiledPlant
from hapticrender.plants.friction_laws import LAWS, FrictionLaw
from hapticrender.plants.sliding_contact import SlidingParameters, sliding_record
from hapticrender.plants.ultrasonic import LEVELS, UltrasonicParameters, mode_inputs, mode_record
from hapticrender.plants.ultrasonic_kernels import AMPLITUDE, SURFACE, surface_step
from hapticrender.protocols import Array
from hapticrender.touch.finger import Finger

MOST_INNER_DELAY = 8  # samples: with a longer delay there is no inner loop
PACED_DELAY = 3e-3  # s, of pace times the delay and a sample more, where the inner loop takes its share of the phase
PACED_DELAY_ALONE = 1 / 40  # s, of pace times the delay, where there is none: see `amplitude_model`
TAPS = 6  # of the inner loop: fewer make the drive noisier for little more of damping
DRIVEN = 0.9  # of the drive's limit: what an amplitude may need, as feedback adds to it
MOST_DETUNING = 0.015  # of the resonance: range of the amplitude loop
TYPICAL_DETUNING = 1e-3
MOST_DAMPING = 20.0  # times that of the nominal finger
LEARNING = 1.5e3  # 1/s: three times as fast, noise at the least amplitude adds a quarter of a free plate's damping
LEAST_AMPLITUDE = 0.05e-6  # m: below it a resonance cannot be detected


@dataclass(frozen=True, kw_only=True)
class SurfaceParameters(SlidingParameters):
    """Parameters of the surface, of its mode and friction law, and of the model's level.

    Notes
    -----
    Bias, lock and oversampling are engineering defaults.  The mode's sensor keeps the density of its noise whatever the
    oversampling; see `UltrasonicParameters`.
    """

    rate: float = parameter(12e3, "Hz", "of the friction", least=1e3, most=1e6)
    level: str = option("carrier", *LEVELS, about="whether the mode is simulated where it is")
    sensor: str = option("amplitude", "amplitude", "tribometer", about="what gives friction")
    law: str = option("fit", *LAWS, about="of friction over amplitude, see `friction_laws`")
    bias: float = parameter(0.55, about="friction without a texture, mu/mu0", least=0.1, most=0.95)
    lock: float = parameter(20.0, "Hz", "bandwidth of the resonance lock (1-20), 0: none", most=100.0)
    oversampling: int = parameter(32, "samples", "samples of the carrier in one of the friction", least=1, most=1000)
    envelope_oversampling: int = parameter(4, "samples", 'the same at level "envelope"', least=1, most=1000)
    mode: UltrasonicParameters = field(
        default_factory=UltrasonicParameters, metadata={"about": "rate and level are set"}
    )
    law_parameters: Mapping[str, float] = field(
        default_factory=dict, hash=False, metadata={"about": "that differ from defaults"}
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.carrier_mode  # refuses what does not fit together
        bound = f"> {self.least_ratio:.3g}, the least that the law leaves"
        require(self.bias > self.least_ratio, "bias", self.bias, bound)

    @classmethod
    def with_overrides(cls, overrides: Mapping[str, Any]) -> Self:
        """Defaults with some parameters replaced, of the surface, its mode or its law; see `Validated`."""
        own, mode = cls.names(), UltrasonicParameters.names() - cls.names()
        law = LAWS.get(overrides.get("law", "fit"), LAWS["fit"])
        of_law = law.names() - own - mode
        check_names(overrides, own | mode | of_law)
        parts = [{name: overrides[name] for name in overrides if name in known} for known in (own, mode, of_law)]
        return cls(**parts[0], mode=UltrasonicParameters(**parts[1]), law_parameters=parts[2])

    @cached_property
    def friction_law(self) -> FrictionLaw:
        """The law of friction over amplitude."""
        return LAWS[self.law](**self.law_parameters)

    @cached_property
    def carrier_mode(self) -> UltrasonicParameters:
        """The mode as it is simulated."""
        return self.mode.sampled(self.rate * self.substeps, self.level)

    @property
    def substeps(self) -> int:
        """Samples of the carrier in one of the friction."""
        return self.oversampling if self.level == "carrier" else self.envelope_oversampling

    @property
    def least_ratio(self) -> float:
        """Least mu/mu0 of the reference: near its floor a law takes ever more amplitude for ever less."""
        floor = self.friction_law.floor
        return floor + 0.01 * (1.0 - floor)

    def sensor_response(self, frequency: Any, speed: float) -> Any:
        """Sensed friction per friction (complex) at `frequency` (Hz) under a finger at `speed` (m/s).

        The tribometer's response; or that of the sensed amplitude, ahead of the contact's lag and at the middle of the
        sample at whose end friction acts.
        """
        if self.sensor == "tribometer":
            return self.tribometer_response(frequency)
        return 1.0 / (self.lag_response(frequency, speed) * self._shift(np.asarray(frequency, float) / 2))

    def amplitude_model(self) -> DeviceModel:
        """Device model of the mode for its amplitude loop, with the range of fingers and temperatures.

        Observer and integral grow with the pace, what they lose by delay with the delay.  Without an inner loop
        (a block device) the finger estimate is part of the loop and the margin thin; a slower pace follows worse.
        """
        mode = self.carrier_mode
        stiffness, damping = mode.mass * (2 * np.pi * mode.carrier) ** 2, float(mode.damping())
        free = DeviceModel(
            rate=mode.rate,
            delay=mode.delay,
            mass=np.array([[mode.mass]]),
            damping=np.array([[damping]]),
            stiffness=np.array([[stiffness]]),
            force_from_drive=np.array([[mode.force_constant]]),
            coordinate_from_sensed=np.eye(1),
            side_from_coordinate=np.eye(1),
            place_from_coordinate=np.eye(1),
            places=("amplitude",),
            drive_limit=mode.drive_limit,
            sensed_limit=mode.sensor_range / 2,
            drive_step=mode.drive_step,
            sensed_noise=mode.sensor_noise,
            rigid=True,
            lock=self.lock,
            taps=TAPS,
            always_damped=True,
        )
        detuned = 2 * MOST_DETUNING * stiffness * mode.frequency / mode.carrier  # shifts are in Hz at either level
        finger = FingerRange(
            mass=(0.0, 0.0),
            damping=(-0.9 * damping, MOST_DAMPING * mode.finger_damping * mode.frequency / mode.carrier),
            stiffness=(-detuned, detuned),
            typical_mass=1e-12,
            typical_stiffness=detuned * TYPICAL_DETUNING / MOST_DETUNING,
            least_motion=LEAST_AMPLITUDE,
            fastest=LEARNING,
            contact=None,
        )
        inner = free.delay <= MOST_INNER_DELAY and turns(oscillators(free)) <= 1.0
        paced, delay = (PACED_DELAY, free.delay + 1) if inner else (PACED_DELAY_ALONE, free.delay)
        return replace(free, pace=paced * free.rate / delay, finger=finger)

    def amplitude_bands(self) -> Bands:
        """Return the band of the carrier, whose amplitude (m) is the waveform of the reference."""
        carrier = np.array([self.carrier_mode.carrier])
        none = np.zeros(1)
        return Bands(frequency=carrier, wavenumber=none, phase=none, envelope=none + 1.0, modulated=True)


def full_slew(mode: UltrasonicParameters) -> float:
    """Change (m) of a zero amplitude within a sample under the drive's limit, but for the share of feedback.

    a' = F/(2 m w) - b/(2 m) a, F behind its hold; see the module.
    """
    turn = 2 * np.pi * mode.carrier
    force = DRIVEN * mode.drive_limit * mode.force_constant * float(np.sinc(mode.carrier / mode.rate))
    return force / (2 * mode.mass * turn * mode.rate)


class UltrasonicSurface(CompiledPlant):
    """The surface in discrete time, behind the `Plant` protocol.

    `amplitude` is the amplitude loop, designed for `amplitude_model()` and `amplitude_bands()` of the surface that is
    `assumed` (by default that of `parameters`), with a compiled step that takes single samples; it holds the `nominal`
    load (N) and speed (m/s) while no finger is there.  By the assumed law the amplitude's reference is computed, and
    the friction that the sensed amplitude leaves.  `motion`: friction (N), and the amplitude (m).
    """

    step = surface_step
    motion_channels = 2

    def __init__(
        self,
        parameters: SurfaceParameters,
        amplitude: Any,
        finger: Finger,
        seed: int = 0,
        nominal: tuple[float, float] = (0.5, 0.05),
        assumed: SurfaceParameters | None = None,
    ) -> None:
        super().__init__(finger, parameters.rate, seed=seed)
        self.parameters, self.loop = parameters, amplitude
        self.noise_channels = 1 + parameters.substeps
        p, mode, ours = parameters, parameters.carrier_mode, isinstance(amplitude, BankController)
        assumed = assumed or parameters
        inner, queue = mode_record(mode, mode.delay - 1)
        if p.sensor == "amplitude" and not ours:
            raise TypeError(
                f"amplitude is a {type(amplitude).__name__}: must be a BankController, which observes the amplitude"
            )
        self.buffers = (queue,)
        self.state = record_of(
            SURFACE,
            assumed,
            true_coefficient=p.friction_coefficient,
            load=nominal[0],
            speed=nominal[1],
            slew=full_slew(mode),
            free_damping=float(mode.damping()),
            estimating=p.sensor == "amplitude",
            controller=amplitude.step.address,
            controller_state=amplitude.state,
            finger_damping=amplitude.state["finger_damping"].ctypes.data if ours else 0,
            position=np.nan,
            starting=1,
            law=assumed.friction_law.numbers,
            true_law=p.friction_law.numbers,
            mode=inner[0],
            sliding=sliding_record(p)[0],
        )
        for name in ("drive", "sensed", "position", "waveform", "target", "flags"):
            self.state["signals"][name] = self.state[name].ctypes.data
        self.state["signals_at"] = self.state["signals"].ctypes.data

    def inputs(self, first: int, n: int) -> Array:
        """Inputs of the finger, then damping (N s/m) and resonance (rad/s) of the mode, shape (n, 6)."""
        return mode_inputs(self.parameters.carrier_mode, super().inputs(first, n), first, self.rate)

    @property
    def amplitude(self) -> Array:
        """True amplitude of the mode (m, shape (n,)) in each sample of the last run."""
        return self.motion[:, AMPLITUDE]
