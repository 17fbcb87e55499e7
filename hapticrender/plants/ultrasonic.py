"""An ultrasonic plate: one flexural mode, driven at its resonance, whose amplitude reduces friction.

The finger adds damping and shifts the resonance, both with the cube root of its load; the friction that it leaves is
that of `ultrasonic_surface`.  At level "envelope" the mode is moved down, with the same envelope for the same
controller at a fraction of the rate (docs/theory.md, "Ultrasonic mode").
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hapticrender.bands import NYQUIST_MARGIN
from hapticrender.checks import Validated, option, parameter, require
from hapticrender.jit import record_of
from hapticrender.plants.compiled import LOAD, STRENGTH, CompiledPlant, resolution
from hapticrender.plants.ultrasonic_kernels import MODE, ultrasonic_step
from hapticrender.protocols import Array
from hapticrender.touch.finger import Finger

LEVELS = ("carrier", "envelope")
NOMINAL_LOAD = 0.5  # N: at which `finger_damping` and `finger_shift` hold
MOST_LOAD = 20.0  # N: largest load
MOST_DAMPING_RATIO = 0.5
MOST_SHIFT = 0.25  # of the carrier
WARMING = 1000  # steps a second in which the temperature rises


@dataclass(frozen=True, kw_only=True)
class UltrasonicParameters(Validated):
    """Parameters of the mode, of its electronics and of the model's level.

    Notes
    -----
    The defaults are engineering values (docs/theory.md), not measurements.

    Examples
    --------
    >>> plate = UltrasonicParameters()
    >>> [round(float(plate.pole(load)), 1) for load in (0.0, 0.5)]
    [75.0, 250.1]
    """

    frequency: float = parameter(30e3, "Hz", "undamped resonance of the free, cold plate", least=16e3, most=100e3)
    modal_mass: float = parameter(5e-3, "kg", "3e-3 to 8e-3 in the literature", above=0.0)
    quality: float = parameter(200.0, about="of the free plate: 100 to 400", least=5.0, most=1e5)
    finger_damping: float = parameter(11.0, "N s/m", "under 0.5 N, growing with the cube root of the load")
    finger_shift: float = parameter(-30.0, "Hz", "of the resonance, alike: -60 to -10", least=-1e4, most=1e4)
    temperature_coefficient: float = parameter(
        -100e-6, "1/K", "of the resonance (-200e-6 to -50e-6)", least=-1e-3, most=1e-3
    )
    temperature_rise: float = parameter(0.0, "K", "that the plate reaches", least=-100.0, most=100.0)
    temperature_time: float = parameter(1.0, "s", "in which it does so, linearly (in steps of 1 ms)", above=0.0)
    drive_limit: float = parameter(10.0, "V", "largest drive", above=0.0)
    force_constant: float = parameter(1.777, "N/V", "modal force per drive", above=0.0)
    sensor_range: float = parameter(50e-6, "m", "full range of the sensor", above=0.0)
    sensor_bits: int = parameter(16, about="resolution over sensor_range, 0 is ideal", least=0, most=24)
    drive_bits: int = parameter(16, about="resolution over +- drive_limit, 0 is ideal", least=0, most=24)
    sensor_noise: float = parameter(2e-9, "m", "white noise of each sample, rms; at another rate its density stays")
    rate: float = parameter(192e3, "Hz", "of the loop; the default is what a sound card can do", least=500.0, most=1e7)
    delay: int = parameter(1, "samples", "from a sensed sample to the drive computed from it", least=1, most=100_000)
    level: str = option("carrier", *LEVELS, about="mode simulated where it is, or moved down to `envelope_frequency`")
    envelope_frequency: float = parameter(6e3, "Hz", 'carrier at level "envelope", below `frequency`', least=500.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.envelope_frequency, self.frequency
        require(low < high, "envelope_frequency", low, f"< frequency = {high:g} Hz")
        bound = f">= {self.carrier / NYQUIST_MARGIN:g} Hz for a carrier of {self.carrier:g} Hz"
        require(self.carrier <= NYQUIST_MARGIN * self.rate, "rate", self.rate, bound)
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

    def sampled(self, rate: float, level: str | None = None) -> "UltrasonicParameters":
        """Return the same plate at `rate` (Hz) and another level of the model, where one is given.

        The sensor's noise keeps its density, so that it disturbs the envelope alike; its resolution stays, and with it
        grows the density of rounding.  The delay stays in samples: at a lower rate it is a longer one.
        """
        noise = self.sensor_noise * math.sqrt(max(rate, 0.0) / self.rate)
        return replace(self, rate=rate, level=level or self.level, sensor_noise=noise)

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
        return (free + self.finger_damping * _finger_scale(normal_load)) * (self.frequency / self.carrier)

    def resonance(self, normal_load: Array | float = 0.0, temperature_rise: Array | float = 0.0) -> Array:
        """Undamped resonance of the mode as simulated (Hz)."""
        drift = self.frequency * self.temperature_coefficient * np.asarray(temperature_rise, float)
        return self.carrier + self.finger_shift * _finger_scale(normal_load) + drift

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
        """Relative difference of the transposed D_i(j(w_i + W)) against D(j(w + W)) at W/(2 pi) (Hz), complex.

        With S the resonance's shift under the finger, ``D(j(w + W)) = -m (W - S)(2 w + W + S) + j b (w + W)``: far
        beyond the pole the difference is ``(W + S)(1/w_i - 1/w)/2``, at the carrier ``W (1/w_i - 1/w)``.  For the same
        target and drive the amplitudes differ by as much.
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

    drive_step = resolution("drive_bits", "drive_limit", 2.0, "the drive (V)")
    sensor_step = resolution("sensor_bits", "sensor_range", 1.0, "the sensor (m)")


def _finger_scale(normal_load: Array | float) -> Array:
    """(W/0.5 N)^(1/3): damping and shift of a finger over those of the nominal one; 0 without load."""
    return np.cbrt(np.maximum(np.asarray(normal_load, float), 0.0) / NOMINAL_LOAD)


class UltrasonicPlate(CompiledPlant):
    """The mode in discrete time, behind the `Plant` protocol; `block` samples a call of `run`, the rest queued inside.

    Of the finger only the load acts; its own mechanics are too slow to matter.
    """

    step = ultrasonic_step

    def __init__(self, parameters: UltrasonicParameters, finger: Finger, seed: int = 0, block: int = 1) -> None:
        super().__init__(finger, parameters.rate, delay=parameters.delay, block=block, seed=seed)
        self.parameters = parameters
        self.state, queue = mode_record(parameters, parameters.delay - block)
        self.buffers = (queue,)

    def inputs(self, first: int, n: int) -> Array:
        """Inputs of the finger, then damping (N s/m) and resonance (rad/s) of the mode, shape (n, 6)."""
        return mode_inputs(self.parameters, super().inputs(first, n), first, self.rate)


def mode_inputs(parameters: UltrasonicParameters, finger: Array, first: int, rate: float) -> Array:
    """Append damping (N s/m) and resonance (rad/s) under load and heat to inputs of the finger, from sample `first`."""
    time = (first + np.arange(len(finger))) / rate
    load = np.where(finger[:, STRENGTH] > 0.0, finger[:, LOAD], 0.0)
    warming = np.floor(time * WARMING * (1 + 1e-12)) / WARMING
    rise = parameters.temperature_rise * np.minimum(warming / parameters.temperature_time, 1.0)
    return np.column_stack([finger, parameters.damping(load), 2 * np.pi * parameters.resonance(load, rise)])


def mode_record(parameters: UltrasonicParameters, latency: int) -> tuple[Array, Array]:
    """Return the record (`MODE`, shape (1,)) of a mode at rest, and the queue (latency, 1) of its drive."""
    queue, limit = np.zeros((latency, 1)), parameters.sensor_range / 2
    values = {"period": 1.0 / parameters.rate, "sensor_limit": limit, "queue": queue, "latency": latency}
    return record_of(MODE, parameters, damping=np.nan, **values), queue  # no propagator yet
