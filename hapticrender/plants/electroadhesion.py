"""An electroadhesive screen: a current on a carrier, the circuit of screen and skin, attraction, friction, tribometer.

The equations are those of docs/theory.md, "Electroadhesion".  A resting finger shorts its gap with sweat and is not
attracted.  Two levels: "carrier" integrates the circuit over every substep exactly, with the compliance of the current
source; "envelope" takes ``g I^2``.  They agree but for what a step of the envelope leaves in the gap for a few of its
time constants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hapticrender.checks import Validated, option, parameter, require
from hapticrender.control.demodulator import StarSTDFT
from hapticrender.defaults import FADE
from hapticrender.jit import record_of
from hapticrender.plants.compiled import CompiledPlant
from hapticrender.plants.electroadhesion_kernels import SCREEN, element, screen_step
from hapticrender.plants.gap_estimator import VACUUM, gap_record
from hapticrender.plants.sliding_contact import SlidingParameters, sliding_record
from hapticrender.touch.finger import Finger

DRY, NORMAL, MOIST = 100.0, 4.0, 0.5  # ohm m2: leakage of the gap (engineering defaults: L = 1.0, 0.90, 0.12)
BLOCKING = 1e6  # s: time constant of a capacitor that does not leak
LEAST_SUBSTEPS = 4  # in a turn of the carrier


@dataclass(frozen=True, kw_only=True)
class SquareRoot(Validated):
    """Square root that makes an attraction, which goes with current squared, linear in the drive.

    An attraction u (N) around a bias takes the current envelope ``I = sqrt(max(bias + u, floor)/g)``, whose slope is at
    most 1/(2 sqrt(floor g)).  `straight` omits the square root, for comparison: ``I = sqrt(2 bias/g) (1 + u/bias)/2``,
    with the same peak at u = bias and the same slope of attraction at zero.

    Examples
    --------
    >>> SquareRoot(bias=0.32, floor=0.01, gain=17.8e3)(np.array([0.0, 0.32])).round(5).tolist()
    [0.00424, 0.006]
    """

    bias: float = parameter(unit="N", above=0.0)  # attraction at zero drive, > floor
    floor: float = parameter(unit="N")  # least attraction
    gain: float = parameter(unit="N/A^2", above=0.0)  # g of F = g I^2; N/V^2 where a voltage is driven
    straight: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.bias > self.floor, "bias", self.bias, f"> floor = {self.floor:g} N")

    def __call__(self, drive: Any) -> Any:
        """Current envelope (A, peak) for a `drive` (N of attraction around the bias)."""
        attraction = np.maximum(self.bias + np.asarray(drive, float), self.floor)
        if self.straight:
            return attraction / np.sqrt(2 * self.bias * self.gain)
        return np.sqrt(attraction / self.gain)


@dataclass(frozen=True, kw_only=True)
class ElectroadhesionParameters(SlidingParameters):
    """Parameters of the screen, of the finger's electrical side, and of the model's level.

    Notes
    -----
    Electrical defaults per m2 from docs/theory.md; gap, leakage and body are engineering values.
    """

    level: str = option("envelope", "envelope", "carrier", about="of the model")
    drive_kind: str = option("current", "current", "voltage", about="peak of the carrier (A or V)")
    sensor: str = option(
        "tribometer", "tribometer", "impedance", about='of friction, or of attraction (level "carrier")'
    )
    carrier_frequency: float = parameter(20e3, "Hz", "a whole multiple of `rate`", above=0.0)
    oversampling: int = parameter(20, "substeps", "a sample, at least 4 a turn of the carrier", least=1, most=10_000)
    contact_area: float = parameter(1.2e-4, "m2", "apparent area at 1 N", above=0.0)
    area_exponent: float = parameter(0.5, about="of the load, with which the area grows (0.33-0.67)", most=1.0)
    electrical_share: float = parameter(0.6, about="of the apparent area", above=0.0, most=1.0)
    area_scale: float = parameter(1.0, about="of this finger against the nominal one", above=0.0)
    insulator_capacitance: float = parameter(3.45e-5, "F/m2", "per area (1-3.5e-5)", above=0.0)
    corneum_capacitance: float = parameter(2.95e-5, "F/m2", "of the stratum corneum", above=0.0)
    corneum_resistance: float = parameter(1.2, "ohm m2", "of the stratum corneum", above=0.0)
    gap_thickness: float = parameter(1.5e-6, "m", "while sliding (0.5-3 um)", above=0.0)
    gap_resistance: float = parameter(NORMAL, "ohm m2", "leakage of the sliding gap: DRY, NORMAL or MOIST", above=0.0)
    gap_short: float = parameter(0.0, "ohm m2", "the same while the finger rests", most=0.1)
    body_resistance: float = parameter(1e3, "ohm", "body and return (0.5-2 kohm)")
    unevenness: float = parameter(1.0, about="kappa = <d^-2>/<d^-1>^2 of the gap (1-3)", least=1.0, most=10.0)
    current_limit: float = parameter(10e-3, "A", "largest peak of the source where the drive is a current", above=0.0)
    voltage_limit: float = parameter(300.0, "V", "its compliance, peak (150-300); largest drive in V", above=0.0)
    stray_capacitance: float = parameter(0.0, "F", "across the source")
    voltage_noise: float = parameter(0.5, "V", "white noise at every substep, rms")
    current_noise: float = parameter(20e-6, "A", "white noise at every substep, rms")
    estimator_bandwidth: float = parameter(1500.0, "Hz", "of the estimator's STDFT*, < rate/2", above=0.0)
    estimator_smoothing: float = parameter(5e-3, "s", "for the impedance's average, at least a sample", above=0.0)
    least_leakage: float = parameter(0.5, about="L below which a gap leaks too much to be measured", most=1.0)
    open_loop_gain: float = parameter(
        2.2e4, "N/A^2", "g where the gap cannot be measured; by default a nominal finger's", above=0.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        turns = self.carrier_frequency / self.rate
        bound = f"a whole multiple of rate = {self.rate:g} Hz"
        require(turns == round(turns), "carrier_frequency", self.carrier_frequency, bound)
        bound = f">= {LEAST_SUBSTEPS * turns:g} substeps, {LEAST_SUBSTEPS} a turn of the carrier"
        require(self.oversampling >= LEAST_SUBSTEPS * turns, "oversampling", self.oversampling, bound)
        known = self.sensor != "impedance" or self.level != "envelope"
        require(known, "sensor", self.sensor, "'tribometer' where level = 'envelope': no carrier")
        smoothing = self.estimator_smoothing
        require(smoothing * self.rate >= 1.0, "estimator_smoothing", smoothing, f">= {1 / self.rate:g} s")
        _ = self.estimator_filter  # refuses a bad bandwidth

    @property
    def omega(self) -> float:
        """Angular frequency of the carrier (rad/s)."""
        return 2 * math.pi * self.carrier_frequency

    @property
    def leakage(self) -> float:
        """L of the sliding gap: 1 where it does not leak."""
        lag = self.omega * self.gap_resistance * VACUUM / self.gap_thickness
        return lag**2 / (1 + lag**2)

    @property
    def series_impedance(self) -> complex:
        """Insulator and stratum corneum at the carrier (ohm m2)."""
        corneum = self.corneum_resistance / (1 + 1j * self.omega * self.corneum_resistance * self.corneum_capacitance)
        return 1 / (1j * self.omega * self.insulator_capacitance) + corneum

    @property
    def estimator_filter(self) -> StarSTDFT:
        """The STDFT* of the estimator, which is also its response to a small change of |I|^2."""
        return StarSTDFT(bandwidth=self.estimator_bandwidth, rate=self.rate)

    @property
    def sensor_delay(self) -> float:
        """Delay of what is sensed (s): of the tribometer, or of the estimator."""
        return self.estimator_filter.delay if self.sensor == "impedance" else super().sensor_delay

    def area(self, normal_load: Any) -> Any:
        """Electrical contact area (m2) under `normal_load` (N)."""
        return self.area_scale * self.electrical_share * self.contact_area * np.power(normal_load, self.area_exponent)

    def impedance(self, normal_load: float, *, sliding: bool = True) -> complex:
        """Voltage per current at the carrier (ohm) under `normal_load` (N)."""
        resistance = self.gap_resistance if sliding else self.gap_short
        gap = resistance / (1 + 1j * self.omega * resistance * VACUUM / self.gap_thickness)
        return complex(self.body_resistance + (self.series_impedance + gap) / self.area(normal_load))

    def gain(self, normal_load: float) -> float:
        """Return g of ``F_e = g I^2`` while sliding (N/A^2, I the finger's peak) under `normal_load` (N)."""
        return float(self.unevenness * self.leakage / (4 * self.omega**2 * VACUUM * self.area(normal_load)))

    def attraction(self, drive: Any, normal_load: float) -> Any:
        """Steady attraction (N) while sliding under `drive` (A, or V where that is driven), peak; no limits."""
        impedance = self.impedance(normal_load)
        shunted = 1 + 1j * self.omega * self.stray_capacitance * impedance
        current = np.asarray(drive, float) / abs(impedance if self.drive_kind == "voltage" else shunted)
        return self.gain(normal_load) * current**2

    def sensor_response(self, frequency: Any, speed: float) -> Any:
        """Sensed friction per friction (complex) at `frequency` (Hz), finger at `speed` (m/s)."""
        if self.sensor == "tribometer":
            return self.tribometer_response(frequency)
        attraction = self.estimator_filter.frequency_response(frequency) / self._shift(frequency)
        return attraction / self.lag_response(frequency, speed)


class ElectroadhesionScreen(CompiledPlant):
    """The screen in discrete time, behind the `Plant` protocol.

    The drive is the peak of the carrier (A or V); a `compensation` makes it an attraction around its bias (N), by a
    gain in N/A^2, or N/V^2 where a voltage is driven.  An impedance sensor estimates the attraction by the parameters
    `assumed`, else the screen's own.  `motion`: friction (N), and the mean attraction of each sample (N).
    """

    step = screen_step
    motion_channels = 2

    def __init__(
        self,
        parameters: ElectroadhesionParameters,
        finger: Finger,
        seed: int = 0,
        compensation: SquareRoot | None = None,
        assumed: ElectroadhesionParameters | None = None,
    ) -> None:
        super().__init__(finger, parameters.rate, seed=seed)
        self.parameters = parameters
        self.noise_channels = 1 + 2 * parameters.oversampling if parameters.sensor == "impedance" else 1
        p, substep = parameters, 1.0 / (parameters.rate * parameters.oversampling)
        turn, corneum = np.exp(1j * p.omega * substep), p.corneum_resistance * p.corneum_capacitance
        elements = [element.py_func(tau, substep, p.omega, turn) for tau in (BLOCKING, corneum, corneum)]
        self.state = record_of(
            SCREEN,
            p,
            compensation,
            carrier=p.level == "carrier",
            voltage=p.drive_kind == "voltage",
            sensing=p.sensor == "impedance",
            goal=compensation.bias if compensation else 0.0,
            substep=substep,
            turn=turn,
            area=p.area(1.0),
            capacitance=(p.insulator_capacitance, p.corneum_capacitance, VACUUM / p.gap_thickness),
            retention=[each[0] for each in elements],
            alternating=[each[1] for each in elements],
            gap=gap_record(assumed or p)[0],
            sliding=sliding_record(p)[0],
        )

    def reshape(self, root: SquareRoot) -> None:
        """Let the bias rise to that of another compensation within `FADE`; a smaller one is not taken."""
        self.state["floor"], self.state["gain"], self.state["straight"] = root.floor, root.gain, root.straight
        self.state["goal"], self.state["rise"] = root.bias, (root.bias - self.state["bias"]) / round(FADE * self.rate)
