"""Design of the waveform law: filters, prior knowledge of fingers, and the settings of `inverse_kernel`."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.controller import LEAST_TARGET, BankController, device_settings, padded, shared_settings
from hapticrender.control.controller_design import design_controller, rules_for
from hapticrender.control.damping import Damping
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.inverse_kernel import REVERSION, SCALED, inverse_step
from hapticrender.control.inverse_records import (
    COUPLING,
    FINGER,
    HEAVE,
    INITIAL,
    LAW,
    LOAD,
    PARAMETERS,
    RING,
    TAPS,
)
from hapticrender.control.load_damper import choose_load_damping
from hapticrender.control.records import MOST_CHANNELS, aligned
from hapticrender.control.supervisor import damper_settings
from hapticrender.defaults import FADE_IN, LOSS_TIME
from hapticrender.mathx import foh
from hapticrender.protocols import Array

HIGHEST = 0.2  # of the rate: up to here the derivatives' filters are good to 5e-5
OMEGA_N = 2 * math.pi * 200.0  # rad/s: derivatives are divided by its powers, so that parameters are in N/m
POLE, POLE_DAMPING = 2 * math.pi * 200.0, 0.8  # the finger's pair of poles
FINGERS, SEED = 300, 1  # fingers of the prior, and the seed that draws them
REVERSION_RATES = {FINGER: 0.03, HEAVE: 0.003, COUPLING: 0.01, LOAD: 0.6}  # 1/sqrt(s), from each parameter on
FRICTION_REVERSION = 1.0  # 1/sqrt(s), of a finger's own friction, which stands for the load
LEARNING_DELAY, RELEARNING_DELAY = 2e-3, 0.1  # s after a contact begins or ends: learning begins, and once more
DAMPER_TIME, GATE_CLOSING = 0.1, 0.05  # s after it the damper's gate stays open; then it closes within
INITIAL_TIME = 60e-3  # s, from the second start of learning on: the deviation at that start is a parameter
MODEL_ERROR = 0.1  # of what the drive explains of a deviation: part that no parameter explains
INNOVATIONS = 10.0  # weight of their mean square, times MODEL_ERROR^2: a tenth; on friction devices 0, and dev's is 1
LEAST_NOISE = 5e-5  # of the sensors' range
REPORT_DELAY = 10e-3  # s: a contact is reported within this
HOLD, DECAY = (50e-3, 2e-3), (20e-3, 2e-3)  # s, of the largest need; on friction a finger that turns makes it a spike
DAMPER_LIMIT = 2.0  # N, of the inner damper in each coordinate: more than a touch takes
GATE_SIGMAS = 2.0  # of the sensors' noise: a larger deviation (rms over 4 ms) opens the inner damper
INITIAL_FRICTION = (1.0, 1e3)  # N and N/s: deviation and its rate at a contact
INITIAL_MOTION = (15e-6, 0.02)  # m and m/s: deviation and its velocity at a contact
FRICTION = np.array([0.4, 0.4, 0.3, 0.1])  # of stiffness, damping and mass of a friction device; and samples of delay
FRICTION_NOISE = 0.05  # N: of a friction that no model explains; a filter surer than that follows its own mistakes
LOAD_OF_FRICTION = 3.0  # N: of the attraction that a finger's own friction amounts to
LOAD_SIZE = (0.6, 0.1)  # N: of the load, and of the moment beside it over a


@lru_cache(maxsize=32)
def derivative_filters(rate: float, top: float, first: int = 0, count: int = 4, ahead: float = 0.5) -> Array:
    """Filters for derivatives of a signal from the `first` on, `ahead` samples from now, shape (count, TAPS).

    Least squares of ``sum_m c_i[m] exp(j w (m - 5) T) = (j w)^i exp(j w ahead T)`` up to `top` (Hz), with a light
    penalty on what lies above.  Half a sample ahead is the middle of the hold, which is undone: over sinc(w T/2).
    """
    offsets, frequency = np.arange(TAPS) - (TAPS // 2 - 1), np.linspace(0.0, top, 400)
    above = np.linspace(min(1.4 * top, 0.45 * rate), 0.5 * rate, 100)
    inside, outside = (np.exp(2j * np.pi / rate * np.multiply.outer(each, offsets)) for each in (frequency, above))
    omega = 2 * np.pi * frequency
    turn = np.exp(1j * omega * ahead / rate) / (np.sinc(frequency / rate) if count > 1 else 1.0)
    found = np.empty((count, TAPS))
    for i in range(count):
        order = first + i
        weight = np.maximum(omega, 2 * np.pi * 20.0) ** -order
        rows = np.vstack([inside * weight[:, None], 1e-6 * outside / (2 * np.pi * top) ** order]) * rate**order
        exact = np.concatenate([(1j * omega) ** order * turn * weight, np.zeros(len(above))])
        fit = np.linalg.lstsq(np.vstack([rows.real, rows.imag]), np.r_[exact.real, exact.imag], rcond=None)[0]
        found[i] = rate**order * fit
    return found


def share_driven(model: DeviceModel, frequency: Array) -> Array:
    """Share of a waveform's acceleration at `frequency` (Hz, shape (n,)) that the filters pass on to the drive."""
    top, omega = min(model.highest_frequency, HIGHEST * model.rate), 2 * np.pi * frequency
    second = derivative_filters(float(model.rate), float(top))[2]
    passed = abs(np.polyval(second, np.exp(1j * omega / model.rate)))
    return np.where(frequency > top, passed / np.maximum(omega, 1.0) ** 2, 1.0)


@lru_cache
def sample_fingers() -> tuple[Array, Array]:
    """Frequencies (Hz, shape (f,)) and dynamic stiffnesses z(j w) of `FINGERS` fingers (N/m, shape (FINGERS, f)).

    Log-uniform: 1-10 g, 0.3-4 N s/m, 60-900 N/m; three in four behind a skin of 0.1-0.5 g, 0.5-12 N s/m and
    400-12000 N/m.
    """
    random, frequency = np.random.default_rng(SEED), np.linspace(20.0, 500.0, 97)
    s = 2j * np.pi * frequency

    def drawn(low: float, high: float) -> Array:
        return np.exp(random.uniform(np.log(low), np.log(high), (FINGERS, 1)))

    whole = drawn(1e-3, 1e-2) * s**2 + drawn(0.3, 4.0) * s + drawn(60.0, 900.0)
    mass, skin = drawn(1e-4, 5e-4) * s**2, drawn(0.5, 12.0) * s + drawn(400.0, 12e3)
    behind = random.uniform(size=(FINGERS, 1)) < 0.75
    return frequency, np.where(behind, mass + skin * whole / (skin + whole), whole)


def finger_prior(model: DeviceModel) -> tuple[Array, Array]:
    """Mean and covariance of the finger's five parameters over `sample_fingers`, best where the device is soft."""
    frequency, stiffness = sample_fingers()
    s = 2j * np.pi * frequency
    low = s**2 + 2 * POLE_DAMPING * POLE * s + POLE**2
    basis = np.stack([np.ones_like(s), s / OMEGA_N, (s / OMEGA_N) ** 2, POLE**2 / low, POLE * s / low], axis=1)
    weight = 1.0 / abs(model.dynamic_stiffness(frequency)[:, 0, 0])
    rows = basis * weight[:, None]
    exact = (stiffness * weight).T
    solve = np.linalg.pinv(np.vstack([rows.real, rows.imag]))
    found = np.einsum("ij,jk", solve, np.vstack([exact.real, exact.imag]))  # `lstsq` starts BLAS's threads: 20 ms
    covariance = np.cov(found)
    return found.mean(axis=1), covariance + np.diag(0.02 * covariance.diagonal())


def prior(model: DeviceModel) -> tuple[Array, Array]:
    """Mean (PARAMETERS,) and covariance of all parameters: fingers, the device's own errors, and the load."""
    mean, sigma = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    k, m = model.stiffness[0, 0], model.mass[0, 0] * OMEGA_N**2
    c = max(0.3 * model.damping[0, 0], 0.02 * math.sqrt(model.stiffness[0, 0] * model.mass[0, 0])) * OMEGA_N
    sigma[HEAVE : HEAVE + 4] = 0.05 * k, c, 0.05 * m, 1.0
    sigma[LOAD] = LOAD_SIZE[0]
    if len(model.mass) > 1:
        k, m = model.stiffness[1, 1], model.mass[1, 1] * OMEGA_N**2  # c is heave's
        sigma[COUPLING : COUPLING + 3] = 0.03 * k, c, 0.05 * m
        sigma[LOAD + 1] = LOAD_SIZE[1]
    if model.finger.contact is None:  # friction: the device is what is not known, and no finger adds to it
        sigma[HEAVE : HEAVE + 4] = FRICTION * np.array([k, model.damping[0, 0] * OMEGA_N, m, 1.0])
        sigma[LOAD] = LOAD_OF_FRICTION
        return mean, np.diag(sigma**2)
    covariance = np.diag(sigma**2)
    mean[FINGER:HEAVE], covariance[FINGER:HEAVE, FINGER:HEAVE] = finger_prior(model)
    return mean, covariance


def pole_step(rate: float) -> Array:
    """Step over a sample of x'' = u - 2 z w x' - w^2 x with u running linearly; x, x', u now and next, shape (2, 4)."""
    return foh(np.array([[0.0, 1.0], [-(POLE**2), -2 * POLE_DAMPING * POLE]]), np.array([[0.0], [1.0]]), 1.0 / rate)


class WaveformController(BankController):
    """The waveform law behind the `Controller` protocol."""

    @property
    def law(self) -> Any:
        """Settings and state of the law (a record, see `LAW`)."""
        return self._arrays["law"][0]

    @property
    def least_scale(self) -> float:
        """Least factor that has scaled the reference, so that the drive stays within its limit; 1: the whole of it."""
        return float(self.law["least_scale"])

    @property
    def mismatch(self) -> float:
        """Force that was learned on the untouched device over that of its model, rms over about a second, else 0."""
        law = self.law
        known = law["contact"] == 0.0 and law["smooth_scale"] > SCALED and law["learns"] and law["nominal_power"] > 0.0
        known = known and np.sqrt(2.0 * law["reference_power"]) > LEAST_TARGET * self.settings["sensor_limit"]
        known = known and min(law["sample"], law["since"]) >= self.rate  # in less than a second little is learned
        return float(np.sqrt(law["learned_power"] / law["nominal_power"])) if known else 0.0


@dataclass(frozen=True)
class AdaptiveInverse:
    """The default method: exact inverse dynamics of the waveform, adapted by a Kalman filter; a damper at contacts."""

    name: str = "inverse"

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> BankController:
        """Design the law for a device of 1 or 2 coordinates.

        A grating on a friction device, which has itself to be estimated, the amplitude of a resonance, a recording on
        chosen carriers, and bands beyond the filters are controlled by bands; see `design_controller`.
        """
        if (
            bands.whole and model.mass[0, 0] == 0.0
        ):  # friction without a sensor: of first order, but for the law's equations
            model = replace(model, mass=model.stiffness / (2.0 * math.pi * model.rate) ** 2)
        known = model.finger.contact is not None or (bands.whole and model.mass[0, 0] > 0.0)
        beyond = bands.frequency.max(initial=0.0) > 1.2 * HIGHEST * model.rate  # of the filters' range
        if not known or beyond or (bands.envelope is None and len(bands)):
            return design_controller(self.name, model, bands, rules_for(bands), feedback=feedback)
        damping = choose_load_damping(model) if feedback else None
        if damping is not None and not (damping.on and quiet_enough(damping, model)):
            damping = None
        settings = controller_settings(model, bands, damping, feedback)
        state = aligned(1, LAW)
        rings = {"ring": np.zeros((model.delay + 1, RING)), "reference": np.zeros(model.delay)}
        for name, value in law_settings(model, bands, feedback).items():
            state[name] = value
        for name, array in rings.items():
            state[f"{name}_at"] = array.ctypes.data
        memory = {"law": state, **rings}
        return WaveformController(self.name, inverse_step, settings, bands, arrays=memory, lookahead=lookahead(model))


def lookahead(model: DeviceModel) -> int:
    """Samples by which a whole waveform is read ahead."""
    return model.delay + TAPS // 2


def quiet_enough(damping: Damping, model: DeviceModel) -> bool:
    """Whether the damper makes of the sensors' noise a drive of which 3 sigma are within a third of the limit."""
    noise = model.sensed_noise * np.sqrt((model.coordinate_from_sensed**2).sum(axis=1) * (damping.taps**2).sum(axis=1))
    drive = np.sqrt((np.linalg.pinv(model.force_from_drive) ** 2) @ noise**2)
    return bool(drive.max() < model.drive_limit / 9.0)


def controller_settings(model: DeviceModel, bands: Bands, damping: Damping | None, feedback: bool) -> dict[str, Any]:
    """Settings that the waveform law shares with the others."""
    period = 1.0 / model.rate
    sensor_map, drive_map = model.coordinate_from_sensed, np.linalg.pinv(model.force_from_drive)
    return {
        **shared_settings(model, bands, sensor_map, drive_map, feedback),
        **device_settings(model),
        "contact_length": contact_length(model),
        "typical_speed": model.typical_speed,
        "fade_in": period / FADE_IN,
        "highest_edge": model.highest_edge,
        "lowest": 0.0,
        "drive_step": model.drive_step,
        "damper_high": 1.0 if damping else 0.0,
        "damper_limit": DAMPER_LIMIT,
        **damper_settings(model, damping),
        "release": period / GATE_CLOSING,
    }


def law_times(model: DeviceModel, noise: float) -> dict[str, Any]:
    """Fields of `LAW` that are times, in samples, or smoothing factors; `noise` (m rms) opens the damper's gate."""
    period, friction = 1.0 / model.rate, model.finger.contact is None
    return {
        "learning_delay": round(LEARNING_DELAY * model.rate),
        "relearning_delay": round(RELEARNING_DELAY * model.rate),
        "initial_end": round((RELEARNING_DELAY + INITIAL_TIME) * model.rate),
        "damper_time": round(DAMPER_TIME * model.rate),
        "loss_time": round(LOSS_TIME * model.rate),
        "model_error": MODEL_ERROR**2,
        "deviations": float(friction),
        "innovations": 0.0 if friction else INNOVATIONS,
        "report_delay": max(round(REPORT_DELAY * model.rate), 1),
        "gate_threshold": (GATE_SIGMAS * noise) ** 2,
        "high_pass_smoothing": -math.expm1(-2 * math.pi * 20.0 * period),
        "mean_square_smoothing": -math.expm1(-period / 4e-3),
        "hold": round(HOLD[friction] * model.rate),
        "decay": math.exp(-period / DECAY[friction]),
        "scale_smoothing": period / 2e-3,
        "power_smoothing": period / 1.0,
        "levelling_smoothing": period / 50e-3 if len(model.mass) > 1 else 0.0,
    }


def before_contact(model: DeviceModel) -> dict[str, Array]:
    """Mass, damping and stiffness without the lag of a sliding contact: M and C of (1 + lag s)(M s^2 + C s + K)."""
    lag = contact_length(model) / model.typical_speed if model.contact_damping > 0.0 else 0.0
    damping = model.damping - lag * model.stiffness
    return {"mass": model.mass - lag * damping, "damping": damping, "stiffness": model.stiffness}


def contact_length(model: DeviceModel) -> float:
    """Length (m) by which a sliding contact lags behind the drive, or behind the sensors where they precede it."""
    behind = model.contact_damping > 0.0
    return float(model.contact_damping / model.stiffness[0, 0]) if behind else model.contact_length


def law_settings(model: DeviceModel, bands: Bands, feedback: bool) -> dict[str, Any]:
    """Fields of `LAW`."""
    period, n = 1.0 / model.rate, len(model.mass)
    mean, covariance = prior(model)
    noise = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1))
    noise = np.resize(noise, 2) * max(model.sensed_noise, LEAST_NOISE * model.sensed_limit)
    factor, friction = np.ones(PARAMETERS), model.finger.contact is None
    variance = 6.0 * noise**2 + (FRICTION_NOISE**2 if friction else 0.0)
    for first, q in (REVERSION_RATES | ({LOAD: FRICTION_REVERSION} if friction else {})).items():
        factor[first:INITIAL] = 1.0 - 0.5 * q**2 * REVERSION * period
    matrices = {}
    for name, value in before_contact(model).items():
        matrices[name] = np.eye(2)
        matrices[name][:n, :n] = value
    top, order, late = min(model.highest_frequency, HIGHEST * model.rate), int(bands.differentiated), model.sensor_delay
    late *= model.rate  # what is sensed of the target is that of so many samples ago
    sensor = np.eye(TAPS)[TAPS // 2 - 1]
    sensor_rate = np.zeros(TAPS)
    if order or late:
        sensor = derivative_filters(float(model.rate), float(top), order, 1, -late)[0]
    if model.contact_length > 0.0:
        sensor_rate = derivative_filters(float(model.rate), float(top), order + 1, 1, -late)[0]
    return {
        "delay": model.delay,
        "spatial": (bands.wavenumber > 0.0).any() if len(bands) else bands.spatial,
        "learns": feedback,
        "lever_per_metre": model.lever_per_metre,
        "omega_n": OMEGA_N,
        "pole": POLE,
        "pole_damping": POLE_DAMPING,
        "fade_step": period / FADE_IN,
        "behind": float(model.contact_damping > 0.0),
        **law_times(model, noise[0]),
        "filters": derivative_filters(float(model.rate), float(top), order, 4, 0.5 - late),
        "sensor_filter": sensor,
        "sensor_rate_filter": sensor_rate,
        "pole_step": pole_step(model.rate),
        "force_from_drive": padded(model.force_from_drive, 2, MOST_CHANNELS),
        **matrices,
        "noise": variance,
        "noise_share": noise[0] ** 2 / variance[0] if friction else 0.0,
        "prior": mean,
        "prior_covariance": covariance,
        "covariance": covariance,
        "earlier": np.vstack([covariance[HEAVE:LOAD, HEAVE:LOAD], mean[HEAVE:LOAD]]),
        "theta": mean,
        "reversion_factor": factor,
        "initial_variance": np.repeat(INITIAL_FRICTION if friction else INITIAL_MOTION, 2) ** 2,
        "scale": 1.0,
        "smooth_scale": 1.0,
        "least_scale": 1.0,
        "since": 1e9,
        "fade": 0.0,
    }
