"""An electroadhesive screen: a current on a carrier, the circuit of screen and skin, attraction, friction, tribometer.

In series, per area: insulator, stratum corneum (C || R), sliding gap (C = eps0/d || R_g); and the body, R.  With the
charge q of the gap under a contact of area A::

    F_e = kappa q^2/(2 eps0 A)
    friction F: see `sliding`, with the steady friction mu (W + F_e)

Under a current of peak I at the carrier w the attraction is, on average, ``g I^2`` with::

    g = kappa L/(4 w^2 eps0 A),   L = (w tau)^2/(1 + (w tau)^2),   tau = R_g C

whatever the gap's thickness: the reason for driving current.  Under a voltage it goes as (Z_gap/Z)^2/d^2, and the same
finger spreads 11 times over gaps of 0.5 to 3 um.  A finger that rests shorts its gap with sweat and is not attracted.

Two levels: "carrier" integrates the circuit over every substep exactly, with the offset of the current source, its
servo and its compliance; "envelope" takes ``g I^2``.  They agree but for what a step of the envelope leaves in the gap
for a few of its time constants.

References
----------
Shultz, Peshkin, Colgate 2018 (series model and sliding gap); Grigorii et al. 2021 (20 kHz, 6 mA, tribometer);
Balasubramanian, Pool, Vardar 2025 (lag of friction); Yamamoto and Yamamoto 1976 (stratum corneum).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.control.gap import VACUUM, GapEstimator, gap_state
from hapticrender.control.square_root import SquareRoot, SquareRootTables
from hapticrender.plants.base import TouchedPlant
from hapticrender.plants.bounds import choice, number
from hapticrender.plants.electroadhesion_kernels import (
    LOAD,
    POSITION,
    SPEED,
    Element,
    ScreenState,
    ScreenTables,
    closed_screen_run,
    element,
    screen_run,
)
from hapticrender.plants.sliding import SlidingParameters, sliding_state, sliding_tables
from hapticrender.protocols import Array, Controller, Sensed

if TYPE_CHECKING:
    from hapticrender.touch.finger import Finger

PLACES = ("friction",)
DRY, NORMAL, MOIST = 100.0, 4.0, 0.5  # ohm m2: leakage of the gap (engineering defaults: L = 1.0, 0.90, 0.12)
BLOCKING = 1e6  # s: time constant of a capacitor that does not leak
LEAST_SUBSTEPS = 4  # in a turn of the carrier


@dataclass(frozen=True, kw_only=True)
class ElectroadhesionParameters(SlidingParameters):
    """Everything that describes the screen, a finger's electrical side, and how finely they are modelled.

    Parameters
    ----------
    rate, friction_coefficient, memory_length, least_speed : float
        See `SlidingParameters`; `rate` is that of the drive's envelope.
    tribometer_frequency, tribometer_damping, force_noise, force_range, force_bits : float or int
        See `SlidingParameters`.
    level : {"envelope", "carrier"}
    drive_kind : {"current", "voltage"}
        Drive in A or V, peak of the carrier; a voltage is turned into the current that it drives in steady state.
    sensor : {"tribometer", "impedance"}
        Friction (N), or the attraction (N) that `control.gap` reads from voltage and current; level "carrier" only.
    carrier_frequency : float, Hz
        A whole multiple of `rate`.
    oversampling : int
        Substeps a sample, at least 4 a turn of the carrier.
    contact_area : float, m2
        Apparent area at 1 N, > 0; grows with the load to the power `area_exponent` (0.33-0.67).
    area_exponent : float
        0 to 1.
    electrical_share : float
        Of the apparent area, > 0 and <= 1.
    area_scale : float
        Of this finger against the nominal one, > 0.
    insulator_capacitance : float, F/m2
        > 0 (1-3.5e-5).
    corneum_capacitance : float, F/m2
        Of the stratum corneum, > 0.
    corneum_resistance : float, ohm m2
        > 0.
    gap_thickness : float, m
        While sliding, > 0 (0.5-3 um).
    gap_resistance : float, ohm m2
        Leakage of the sliding gap, > 0: `DRY`, `NORMAL` or `MOIST`.
    gap_short : float, ohm m2
        The same while the finger rests, >= 0 (to 0.1).
    ripple : float
        The gap varies by this share of its thickness with the position, 0 to 0.9.
    ripple_wavelength : float, m
        > 0.
    body_resistance : float, ohm
        Body and return, >= 0 (0.5-2 kohm).
    unevenness : float
        kappa = <d^-2>/<d^-1>^2 of the gap, 1 to 10 (1-3).
    current_limit : float, A
        Largest peak that is asked of the source, where its drive is a current, > 0.
    voltage_limit : float, V
        Its compliance, peak, > 0 (150-300); also the largest drive where that is a voltage.
    current_offset : float, A
        Direct current that the source leaks, -1 to 1 mA.
    servo_conductance : float, S
        The source bleeds this times the mean voltage of the last sample, >= 0; 0: no servo.
    voltage_noise, current_noise : float, V and A rms
        White noise of the two channels at every substep, >= 0.
    skew : float, s
        The current's channel is late by this, -10 to 10 us.
    estimator_bandwidth, estimator_smoothing : float, Hz and s
        See `control.gap.GapEstimator`.
    least_leakage : float
        L below which a finger counts as moist and is not sensed, 0 to 1.
    open_loop_gain : float, N/A^2
        g of a finger that is not sensed, > 0; a renderer takes that of a nominal finger, unless its scene tells.

    Notes
    -----
    Electrical defaults: FACTS section 5 with its sources [M], [E]; per m2 where it tabulates per cm2.  Offset and
    servo act at the level "carrier" only.
    """

    level: str = choice("envelope", "envelope", "carrier")
    drive_kind: str = choice("current", "current", "voltage")
    sensor: str = choice("tribometer", "tribometer", "impedance")
    carrier_frequency: float = number(20e3, "Hz", above=0.0)
    oversampling: int = number(20, "substeps", least=1, most=10_000)
    contact_area: float = number(1.2e-4, "m2", above=0.0)
    area_exponent: float = number(0.5, most=1.0)
    electrical_share: float = number(0.6, above=0.0, most=1.0)
    area_scale: float = number(1.0, above=0.0)
    insulator_capacitance: float = number(3.45e-5, "F/m2", above=0.0)
    corneum_capacitance: float = number(2.95e-5, "F/m2", above=0.0)
    corneum_resistance: float = number(1.2, "ohm m2", above=0.0)
    gap_thickness: float = number(1.5e-6, "m", above=0.0)
    gap_resistance: float = number(NORMAL, "ohm m2", above=0.0)
    gap_short: float = number(0.0, "ohm m2", most=0.1)
    ripple: float = number(0.0, most=0.9)
    ripple_wavelength: float = number(0.5e-3, "m", above=0.0)
    body_resistance: float = number(1e3, "ohm")
    unevenness: float = number(1.0, least=1.0, most=10.0)
    current_limit: float = number(10e-3, "A", above=0.0)
    voltage_limit: float = number(300.0, "V", above=0.0)
    current_offset: float = number(0.0, "A", least=-1e-3, most=1e-3)
    servo_conductance: float = number(1e-7, "S")
    voltage_noise: float = number(0.5, "V")
    current_noise: float = number(20e-6, "A")
    skew: float = number(0.0, "s", least=-1e-5, most=1e-5)
    estimator_bandwidth: float = number(1500.0, "Hz", above=0.0)
    estimator_smoothing: float = number(5e-3, "s", above=0.0)
    least_leakage: float = number(0.5, most=1.0)
    open_loop_gain: float = number(2.2e4, "N/A^2", above=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        turns = self.carrier_frequency / self.rate
        if turns != round(turns):
            raise ValueError(
                f"carrier_frequency = {self.carrier_frequency!r}: must be a whole multiple of rate = {self.rate:g} Hz"
            )
        if self.oversampling < LEAST_SUBSTEPS * turns:
            raise ValueError(
                f"oversampling = {self.oversampling!r}: must be >= {LEAST_SUBSTEPS * turns:g} substeps, "
                f"{LEAST_SUBSTEPS} a turn of the carrier"
            )
        if self.sensor == "impedance" and self.level == "envelope":
            raise ValueError("sensor = 'impedance': must be 'tribometer' where level = 'envelope': no carrier")
        _ = self.estimator  # refuses a bad bandwidth or smoothing

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
    def estimator(self) -> GapEstimator:
        """Estimator of the attraction for a finger with these numbers, its area aside."""
        return GapEstimator(
            rate=self.rate,
            carrier_frequency=self.carrier_frequency,
            series_impedance=self.series_impedance,
            open_loop_gain=self.open_loop_gain,
            bandwidth=self.estimator_bandwidth,
            smoothing=self.estimator_smoothing,
            body_resistance=self.body_resistance,
            unevenness=self.unevenness,
            least_speed=self.least_speed,
            least_share=self.least_leakage,
        )

    def area(self, normal_load: Any) -> Any:
        """Electrical contact area (m2) under `normal_load` (N)."""
        return self.area_scale * self.electrical_share * self.contact_area * np.power(normal_load, self.area_exponent)

    def impedance(self, normal_load: float, *, sliding: bool = True) -> complex:
        """Voltage per current at the carrier (ohm) under `normal_load` (N)."""
        resistance = self.gap_resistance if sliding else self.gap_short
        gap = resistance / (1 + 1j * self.omega * resistance * VACUUM / self.gap_thickness)
        return complex(self.body_resistance + (self.series_impedance + gap) / self.area(normal_load))

    def gain(self, normal_load: float) -> float:
        """Return g of ``F_e = g I^2`` while sliding (N/A^2, I the peak) under `normal_load` (N)."""
        return float(self.unevenness * self.leakage / (4 * self.omega**2 * VACUUM * self.area(normal_load)))

    def attraction(self, drive: Any, normal_load: float) -> Any:
        """Steady attraction (N) while sliding under `drive` (A, or V where that is driven), peak; no limits."""
        drive = np.asarray(drive, float)
        current = drive / abs(self.impedance(normal_load)) if self.drive_kind == "voltage" else drive
        return self.gain(normal_load) * current**2

    def sensed_response(self, frequency: Any, speed: float) -> Any:
        """Change of what is sensed per change of attraction (complex) at `frequency` (Hz), finger at `speed` (m/s)."""
        if self.sensor == "tribometer":
            return self.friction_coefficient * self.frequency_response(frequency, speed)
        return self.estimator.frequency_response(frequency) / self._shift(frequency)

    def sensor_response(self, frequency: Any, speed: float) -> Any:
        """Return what is sensed, as friction, per friction (complex) at `frequency` (Hz), finger at `speed` (m/s)."""
        if self.sensor == "tribometer":
            return self.tribometer_response(frequency)
        return self.sensed_response(frequency, speed) / self.lag_response(frequency, speed)


class ElectroadhesionScreen(TouchedPlant):
    """The screen in discrete time, behind the `Plant` protocol.

    Parameters
    ----------
    parameters : ElectroadhesionParameters
        The screen and its levels of modelling.
    finger : Finger
        Where the finger is, how hard it presses, and its lateral mechanics.
    seed : int
        Of the noise.
    compensation : SquareRoot, optional
        Makes the drive an attraction around its bias (N), by a gain in N/A^2, or N/V^2 where a voltage is driven; by
        default the drive is the peak of the carrier (A or V).

    Attributes
    ----------
    skin_velocity : ndarray, shape (n,), m/s
        Of the skin under friction, against the motion, over the samples of the last run.
    attraction : ndarray, shape (n,), N
        Mean over each of those samples.
    """

    delay = block = 1
    drive_channels = sensed_channels = 1

    def __init__(
        self,
        parameters: ElectroadhesionParameters,
        finger: Finger,
        seed: int = 0,
        compensation: SquareRoot | None = None,
    ) -> None:
        super().__init__(finger, parameters.rate)
        self.parameters = parameters
        self.compensation = compensation
        self.skin_velocity = self.attraction = np.zeros(0)
        self._rng = np.random.default_rng(seed)
        self._tables = screen_tables(parameters, finger, compensation)
        self._state = screen_state()
        self._last = np.zeros(1)

    def _next(self, n: int) -> tuple[Array, Array, Array]:
        """Finger rows, noise and sample flags of the next n samples."""
        finger = finger_rows(self.finger, self._samples, n, self.rate)
        self._samples += n
        width = 1 + 2 * self.parameters.oversampling if self._tables.sensing else 1
        return finger, self._rng.standard_normal((n, width)), np.zeros(n, np.int64)

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (shape (n, 1)); row i acts from sample i on, sensed at its start."""
        n = len(drive)
        finger, noise, flags = self._next(n)
        sensed, motion, felt = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 2))
        drive = np.ascontiguousarray(drive, float)
        screen_run(self._tables, self._state, drive, finger, noise, sensed, motion, felt, flags)
        self.skin_velocity, self.attraction = felt.T
        return Sensed(sensed, finger[:, POSITION], motion, finger[:, LOAD], flags)

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance screen and controller together, sample by sample, over `wanted` (N, shape (n,))."""
        n = len(wanted)
        finger, noise, flags = self._next(n)
        sensed, motion, drive = (np.zeros((n, 1)) for _ in range(3))
        felt = np.zeros((n, 2))
        target = np.zeros((n, controller.n_bands), complex)
        closed_screen_run(
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
            felt,
            drive,
            target,
            flags,
        )
        self.skin_velocity, self.attraction = felt.T
        return drive, target, flags, Sensed(sensed, finger[:, POSITION], motion, finger[:, LOAD], flags)


def finger_rows(finger: Finger, first: int, n: int, rate: float) -> Array:
    """Position (m), load (N), strength and speed (m/s) of samples `first` to `first` + n - 1, shape (n, 4).

    The speed over a sample is the way to the next one; a finger that is lifted there keeps that of the sample before,
    one that touches for a single sample rests.  NaN while lifted, as a finger without load is.
    """
    touch = finger.touch(np.arange(max(first - 1, 0), first + n + 1) / rate)
    touch[~(touch[:, 1] > 0.0), 0] = np.nan
    way = rate * np.diff(touch[:, 0])
    if first == 0:
        way = np.r_[np.nan, way]
    rows = np.empty((n, 4))
    rows[:, :SPEED] = touch[-n - 1 : -1]
    after, before = way[1:], way[:-1]
    speed = np.where(np.isfinite(after), after, np.where(np.isfinite(before), before, 0.0))
    rows[:, SPEED] = np.where(np.isfinite(rows[:, POSITION]), speed, np.nan)
    return rows


def screen_state() -> ScreenState:
    """A screen at rest, the carrier at its crest."""
    return ScreenState(np.zeros(3), np.zeros(1), np.zeros(3), np.zeros(6), gap_state(), sliding_state())


def screen_tables(
    parameters: ElectroadhesionParameters, finger: Finger, compensation: SquareRoot | None
) -> ScreenTables:
    """Numbers of the compiled screen with this finger on it."""
    p = parameters
    substep = 1.0 / (p.rate * p.oversampling)
    series = p.series_impedance
    return ScreenTables(
        carrier=p.level == "carrier",
        voltage=p.drive_kind == "voltage",
        sensing=p.sensor == "impedance",
        compensated=compensation is not None,
        compensation=SquareRootTables(0.0, 0.0, 1.0, False) if compensation is None else compensation.tables,
        substeps=int(p.oversampling),
        substep=substep,
        omega=p.omega,
        turn=_turn(p.omega * substep),
        skew=_turn(p.omega * p.skew),
        turns=float(p.carrier_frequency / p.rate),
        current_limit=float(p.current_limit),
        voltage_limit=float(p.voltage_limit),
        offset=float(p.current_offset),
        servo=float(p.servo_conductance),
        insulator=_element(p, substep, BLOCKING),
        corneum=_element(p, substep, p.corneum_resistance * p.corneum_capacitance),
        capacitance=(float(p.insulator_capacitance), float(p.corneum_capacitance)),
        series=(series.real, series.imag),
        body=float(p.body_resistance),
        gap=float(p.gap_thickness),
        gap_resistance=float(p.gap_resistance),
        gap_short=float(p.gap_short),
        ripple=float(p.ripple),
        wavenumber=2 * math.pi / p.ripple_wavelength,
        kappa=float(p.unevenness),
        area=float(p.area(1.0)),
        exponent=float(p.area_exponent),
        voltage_noise=float(p.voltage_noise),
        current_noise=float(p.current_noise),
        friction=float(p.friction_coefficient),
        estimator=p.estimator.tables,
        sliding=sliding_tables(p, finger.mechanics),
    )


def _turn(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def _element(parameters: ElectroadhesionParameters, substep: float, tau: float) -> Element:
    """What a substep does to a capacitor that leaks with the time constant `tau` (s)."""
    return element.py_func(tau, substep, parameters.omega, _turn(parameters.omega * substep))
