"""Design of the supervision: thresholds from a device model and the scene's demand, and what a stop is called.

The tests themselves, and their conditions, are in `supervisor_kernel`.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.controller import BankController, padded
from hapticrender.control.damping import Damping
from hapticrender.control.device_model import Demand, DeviceModel
from hapticrender.control.gain_faults import GAINS, design_gains
from hapticrender.control.records import CONTROLLER, MOST_CHANNELS, MOST_SENSORS, MOST_TAPS
from hapticrender.control.supervisor_kernel import (
    ACTIVE,
    ACTUATOR_GAIN,
    BEYOND,
    DRIVE,
    FROZEN,
    INCONSISTENT,
    INVALID,
    INVALID_SHARE,
    JUMP,
    OVERMOTION,
    RINGING,
    ROOT2,
    SENSOR_GAIN,
    SUPERVISOR,
    SWAPPED,
    supervised_step,
)
from hapticrender.defaults import LOSS_TIME
from hapticrender.jit import Addressed, CFunction
from hapticrender.protocols import Array, Controller

FADE_OUT, FADE_NOW = 2e-3, 0.2e-3  # s
INVALID_TIME = 20e-3  # s: samples that are all invalid stop the drive after 7.1 ms
FROZEN_SAMPLES, FROZEN_TIME = 10, 2e-3  # s; noise of 1 um in steps of 0.12 um repeats a sample with p = 0.034
FROZEN_SIGMAS = 4 * 1.3  # of the noise: the drive must have moved the sensor by so much
LEAST_NOISE = 1e-4  # of a sensor's range: a model may state no noise, and no steps
FINGER_STIFFNESS, FINGER_DAMPING = 8e3, 10.0  # N/m, N s/m: no finger has more
MODEL_ERROR, DELAY_ERROR, LOAD = 0.1, 1.2, 1.15  # of D; samples; of K: a pressing hand shows r = -K x
NOISE_VARIANCES = 12.0
POWER_TIME = 12e-3  # s
DRIVE_TIME, PRESS_TIME, FASTEST_PACE = 30e-3, 60e-3, 6.0  # s, s; times of a faster device are shorter
PRESS, PRESS_LOAD = 9.0, 5.0  # N: 1.5 times the force that a press of 5 N in a millisecond takes; its load
SLIDE = 0.2  # m/s: a load that slides so fast is a moment that grows, and may be held against
RINGING_FROM, RINGING_VARIANCES = 500.0, 16.0  # Hz, 4 sigma
RINGING_MEAN, RINGING_TIME = 3e-3, 12e-3  # s: what a sudden lift-off leaves behind falls below 4 sigma in this time
BEYOND_LIMIT, LIMIT_TIME = 2.5, 15e-3  # of its limit, s: what 5 N in a millisecond near an end take lasts 2 ms
RINGING_WAIT, RINGING_STOP, SATURATED_WAIT = 10e-3, 150e-3, 0.5  # s
SLOW_MEAN, SLOW_TIME = 0.2, 0.3  # s
BEYOND_TIME = 10e-3  # s: three samples in it are no spikes
FRICTION_TIME, FRICTION_SIGMAS = 20e-3, 20.0  # s, of the mean friction; of the noise: a smaller one is not judged
DANGER_DRIVE = 0.9  # of the drive limit
UNLIMITED = 1e300


class Fault(NamedTuple):
    """Why a supervisor has stopped the drive."""

    cause: int  # INVALID to JUMP
    sample: int  # at which the test failed; the drive fades out from it on
    sensors: int  # bit i: sensor i + 1; of INVALID, FROZEN, BEYOND, SENSOR_GAIN and SWAPPED; actuator of ACTUATOR_GAIN
    gains: tuple[float, ...] = ()  # of all sensors or actuators, over those before; of SENSOR_GAIN and ACTUATOR_GAIN

    @property
    def text(self) -> str:
        """What was found, the most likely reason, and what to check."""
        found, check = CAUSES[self.cause]
        named = [i for i in range(MOST_SENSORS) if self.sensors >> i & 1]
        names, gains = (" and ".join(each) for each in ([str(i + 1) for i in named], self._gains(named)))
        return f"{found.format(sensor=names, gain=gains)}: check {check}"

    def _gains(self, sensors: list[int]) -> list[str]:
        return [f"{self.gains[i]:.2g}" for i in sensors if self.gains]


CAUSES = {
    INVALID: (
        "sensor {sensor}: samples are no numbers, or at the end of the range",
        "cable and supply, and that the surface stays within the range",
    ),
    FROZEN: (
        "sensor {sensor}: one value repeats, or one block, while the drive moves; most likely frozen or disconnected",
        "cable, supply and converter",
    ),
    INCONSISTENT: (
        "the motion does not follow from the drive; most likely a sensor or an actuator is dead, inverted or swapped, "
        "or its gain is wrong",
        "wiring and polarity of all sensors and actuators, the unit of the sensors, and [device]",
    ),
    ACTIVE: (
        "the motion grows with the drive; most likely a sensor or an actuator is inverted or swapped",
        "wiring and polarity of all sensors and actuators",
    ),
    DRIVE: (
        "the drive stayed above what any finger needs; most likely a sensor or an actuator is dead, or its gain wrong",
        "wiring, the amplifier, the unit of the sensors, and [device]",
    ),
    RINGING: (
        "the surface rings above 500 Hz with the inner damper turned off",
        "the delay of the loop, and [device] with the bending mode and the sensors' noise that `hapticrender identify` "
        "finds",
    ),
    OVERMOTION: (
        "the surface moved farther than the scene and a press can move it; most likely the loop is unstable",
        "wiring and polarity of all sensors and actuators, the delay, and [device]",
    ),
    BEYOND: (
        "sensor {sensor}: more than [limits] displacement",
        "what the scene asks for, how hard the finger presses, and the sensor's offset",
    ),
    SENSOR_GAIN: (
        "sensor {sensor}: the samples are suddenly {gain} times the motion; most likely inverted, swapped, "
        "disconnected, or its gain has changed",
        "wiring, polarity and gain of all sensors",
    ),
    ACTUATOR_GAIN: (
        "actuator {sensor}: the motion is that of {gain} times its drive; most likely it is inverted, or sensors are",
        "wiring and polarity of all actuators and sensors",
    ),
    SWAPPED: (
        "sensor {sensor}: each shows the motion of the other; most likely they are swapped, or the actuators",
        "wiring of all sensors and actuators",
    ),
    JUMP: (
        "the friction or vibration jumped from one sample to the next, as none can; most likely the sensor is "
        "disconnected, or its gain has changed",
        "cable, supply, range and gain of the sensor",
    ),
}


class SupervisedController(Addressed):
    """A controller with a compiled step, supervised, behind the `Controller` protocol.

    All that is not named here is the controller's own; `fault` says why the drive has been stopped, None while it
    has not.  A stop is permanent: design a new controller to start again.
    """

    step = supervised_step

    def __init__(self, controller: Any, model: DeviceModel) -> None:
        self.controller, self.method, self.n_bands = controller, controller.method, controller.n_bands
        self.state = np.zeros(1, SUPERVISOR)
        supervised_step.expect()
        self._forces = np.zeros((model.delay + 1, 3))
        self._frame = np.full((model.block, MOST_SENSORS, 2), np.nan)
        settings = design_supervisor(controller, model)
        found = design_gains(model, sensor_noise(model)) if settings.get("modelled") else None
        self.gains = np.zeros(1, GAINS) if found is None else found
        settings |= {
            "step": controller.step.address,
            "state": controller.state.ctypes.data,
            "forces_at": self._forces.ctypes.data,
            "frame_at": self._frame.ctypes.data,
            "gains": 0 if found is None else self.gains.ctypes.data,
        }
        for name, value in settings.items():
            self.state["p"][name] = value
        self.state["fade"] = self.state["damper_scale"] = 1.0
        self.state["last"], self.state["away"] = 0.0, settings["loss_time"] + 1
        self.channels, self.sensors = int(settings["channels"]), int(settings["sensors"])

    def __getattr__(self, name: str) -> Any:
        if name == "controller":  # not made yet
            raise AttributeError(name)
        return getattr(self.controller, name)

    @property
    def fault(self) -> Fault | None:
        """Why and when the drive has been stopped."""
        cause, sample, sensors = (int(self.state[name][0]) for name in ("cause", "stopped", "sensors"))
        known = self.gains["gain"][0, cause - SENSOR_GAIN].tolist() if cause in (SENSOR_GAIN, ACTUATOR_GAIN) else ()
        return Fault(cause, sample, sensors, tuple(known)) if cause else None

    @property
    def damper_scale(self) -> float:
        """Gain to which a ringing inner damper has been turned down, 1: it did not ring."""
        return float(self.state["damper_scale"][0])

    def unplayed(self, samples: Array) -> None:
        """Compare motion with no drive where that which acts so many samples from now on was not played."""
        self._forces[(self.state["now"] + samples) % len(self._forces)] = 0.0
        self.state["friction"] = 0.0  # what is sensed next may be later than a sample

    run = BankController.run
    _kept: Any = None  # by it, not by the controller's own


def supervised(controller: Controller, model: DeviceModel, *, feedback: bool = True) -> Any:
    """Return a controller under supervision; as it is where it has no compiled step.

    Without `feedback` nothing is sensed, and the limit of rms drive is all that there is to hold.
    """
    compiled = isinstance(getattr(controller, "step", None), CFunction)
    if not compiled or not (feedback or model.rms_limit < model.drive_limit):
        return controller
    if not feedback:
        model = replace(model, demand=None, coordinate_from_sensed=model.coordinate_from_sensed[:, :0])
    return SupervisedController(controller, model)


def sensor_noise(model: DeviceModel) -> float:
    """Noise of each sensor (rms) that the tests allow for."""
    return max(model.sensed_noise, LEAST_NOISE * model.sensed_limit)


def governed(model: DeviceModel, demand: Demand) -> DeviceModel:
    """Return the model with the demand of a scene, and the drive limit that the scene needs: 3 B + A."""
    return replace(model, demand=demand, drive_limit=min(model.drive_limit, 3.0 * demand.drive + press_drive(model)))


def press_drive(model: DeviceModel) -> float:
    """A (drive unit): drive of all channels alike that a hard press takes of the loop."""
    return PRESS / float(abs(model.force_from_drive[0].sum()))


def drive_per_target(model: DeviceModel, frequency: Array) -> Array:
    """B/R (drive unit per coordinate's): most drive that a target takes at `frequency` (Hz) with the worst finger."""
    stiffness = model.dynamic_stiffness(frequency)
    finger = abs(FINGER_STIFFNESS + 2j * np.pi * np.asarray(frequency, float) * FINGER_DAMPING)
    coupling = abs(model.stiffness[0, 1:]).sum()
    slope = 1.0 + 2.0 * abs(np.array(model.pattern[1:])).sum()
    total = 1.2 * abs(stiffness[..., 0, 0]) + coupling + 3.0 * finger
    return np.asarray(slope * total / abs(model.force_from_drive[0].sum()))


def design_supervisor(controller: Any, model: DeviceModel) -> dict[str, Any]:
    """Settings of a supervisor for a controller and the model that it was designed for; see the module."""
    rate, sensors, channels = model.rate, model.coordinate_from_sensed.shape[1], model.force_from_drive.shape[1]
    noise = sensor_noise(model)
    demand, stiffness, total = model.demand, float(model.stiffness[0, 0]), float(abs(model.force_from_drive[0].sum()))
    top = abs(model.dynamic_stiffness(np.array(demand.highest if demand else 0.0))[0, 0])
    moved = FROZEN_SIGMAS * noise * max(stiffness, top) * channels / total  # sum of the channels
    settings: dict[str, Any] = {
        "sensors": sensors,
        "channels": channels,
        "block": getattr(controller, "block", 1),
        "frame": model.block,
        "delay": model.delay,
        "needs_contact": model.finger.needs_contact,
        "loss_time": max(round(LOSS_TIME * rate), 1),
        "sensor_limit": model.sensed_limit,
        "most_drive": UNLIMITED,
        "coordinate_from_sensor": padded(model.coordinate_from_sensed, 2, MOST_SENSORS),
        "force_from_drive": padded(model.force_from_drive, 2, MOST_CHANNELS),
        "invalid_smoothing": _smoothing(INVALID_TIME, rate),
        "invalid_time": math.ceil(-INVALID_TIME * math.log1p(-INVALID_SHARE) * rate),
        "frozen_time": max(FROZEN_SAMPLES, round(FROZEN_TIME / model.pace * rate)),
        "frozen_drive": UNLIMITED if model.inferred else moved,
        "fade_out": min(model.pace / (FADE_OUT * rate), 1.0),
        "fade_now": min(model.pace / (FADE_NOW * rate), 1.0),
        **_limit_settings(controller, model),
    }
    if model.contact_damping > 0.0 and model.sensor_delay * rate >= 1.0:  # a sensor behind the contact, with a mass
        settings |= {"least_friction": FRICTION_SIGMAS * noise, "friction_smoothing": _smoothing(FRICTION_TIME, rate)}
    if demand is None:
        return settings
    modelled = demand.lowest < rate / 10  # beyond it neither trapezoidal rule nor hold are the device's
    pressed = model.finger.contact is not None
    press, pace = press_drive(model) if pressed else 0.0, min(model.pace, FASTEST_PACE)
    settings |= {
        "drive_smoothing": _smoothing(DRIVE_TIME / pace, rate),
        "drive_time": PRESS_TIME / pace * rate if pressed else 0.0,  # else no press is there to be waited for
        "most_drive": (1.5 * demand.drive + press / 2.4) ** 2 / 2.0,
    }
    if not modelled:
        return settings
    return settings | _motion_settings(model, demand, noise) | _ringing(controller, model, demand)


def _limit_settings(controller: Any, model: DeviceModel) -> dict[str, Any]:
    """Settings of test 8 and of the limit of rms drive, which is passed on to a controller with a drive limit."""
    settings = {
        "sensed_bound": min(model.sensed_bound, UNLIMITED),
        "beyond_time": max(round(BEYOND_TIME * model.rate), 3),
    }
    if not model.rms_limit < model.drive_limit:
        return settings
    heating = _smoothing(model.rms_time, model.rate)
    peak = min(model.drive_limit, model.rms_limit / math.sqrt(heating))  # a single sample passes no limit of the heat
    own = getattr(controller.state, "dtype", None) == CONTROLLER
    return settings | {
        "drive_limit": peak,
        "heat_smoothing": heating,
        "heat_gain": (peak / model.rms_limit) ** 2 - 1.0,
        "limited": controller.state.ctypes.data if own else 0,
    }


def _motion_settings(model: DeviceModel, demand: Demand, noise: float) -> dict[str, Any]:
    """Settings of tests 3, 4 and 7, which compare motion and drive; `noise` (rms) is that of each sensor."""
    rate, stiffness = model.rate, float(model.stiffness[0, 0])
    sag, shared = PRESS_LOAD / stiffness, DELAY_ERROR**2
    corner = float(np.clip(1.4 * demand.highest, 250.0, max(rate / 10, 250.0)))
    low_end = float(np.clip(0.75 * demand.lowest, 15.0, 60.0))
    g, omega = _trapezoidal(corner, rate), 2.0 * rate * _trapezoidal(corner, rate)
    high = _trapezoidal(low_end, rate)
    bound, floor = np.zeros((2, 8)), np.zeros(2)
    for i in range(len(model.mass)):
        finger = 2.0 * (1.0, 4.0)[i]
        bound[i, :4] = finger * np.array([1.0, 4.0, 0.0, 0.0]) * FINGER_STIFFNESS**2
        bound[i, 2:4] = finger * np.array([1.0, 4.0]) * FINGER_DAMPING**2
        bound[i, i] += (MODEL_ERROR**2 + LOAD**2) * model.stiffness[i, i] ** 2
        bound[i, 4 + i] = MODEL_ERROR**2 * model.mass[i, i] ** 2
        bound[i, 6 + i] = shared
        floor[i] = NOISE_VARIANCES * noise**2 * _residual_noise(model, i, corner, low_end)
    floor[1] += (PRESS_LOAD * SLIDE * model.lever_per_metre / (2 * np.pi * low_end)) ** 2  # a ramp behind the high-pass
    return {
        "modelled": 1,
        **{name: padded(getattr(model, name), 2, 2) for name in ("mass", "damping", "stiffness")},
        "corner": g,
        "top_gain": 1.0 / (1.0 + g * (g + ROOT2)),
        "omega": omega,
        "low": g / (1.0 + g),
        "high": high / (1.0 + high),
        "energy_smoothing": _smoothing(float(np.clip(0.36 / demand.lowest, 5e-3, 10e-3)), rate),
        "power_smoothing": _smoothing(POWER_TIME, rate),
        "bound": bound,
        "noise": floor,
        "inconsistent_time": rate * float(np.clip(1.2 / demand.lowest, 15e-3, 60e-3)),
        "active_time": 5e-3 * rate,
        "lever": abs(model.place_from_coordinate[:, 1:]).max(initial=0.0),
        "danger_motion": 4.0 * demand.motion + 1.36 * sag,
        "most_motion": 3.0 * demand.motion + 5.4 * sag,
        "slow_smoothing": _smoothing(SLOW_MEAN, rate),
        "slow_time": SLOW_TIME * rate,
        "danger_drive": DANGER_DRIVE * model.drive_limit,
    }


def _ringing(controller: Any, model: DeviceModel, demand: Demand) -> dict[str, Any]:
    """Settings of test 6, for a controller whose record names the noise of its inner damper."""
    state = controller.state
    if getattr(state, "dtype", None) != CONTROLLER or not state["p"]["damper_noise"].any():
        return {}
    rate, g = model.rate, _trapezoidal(ringing_from(model), model.rate)
    needs_all = demand.drive > 0.7 * model.drive_limit
    times = {"ring": RINGING_TIME, "ring_wait": RINGING_WAIT, "ring_stop": RINGING_STOP}
    times |= {"suspension": SATURATED_WAIT, "limit": LIMIT_TIME}
    return {
        "controller": state.ctypes.data,
        "ringing": RINGING_VARIANCES * state["p"]["damper_noise"][0] ** 2,
        "most_damping": (BEYOND_LIMIT * state["p"]["damper_limit"][0]) ** 2,
        "ring_corner": g,
        "ring_top_gain": 1.0 / (1.0 + g * (g + ROOT2)),
        "ring_smoothing": _smoothing(RINGING_MEAN, rate),
        "large_drive": 0.6 * model.drive_limit if needs_all else UNLIMITED,
        **{f"{name}_time": time * rate for name, time in times.items()},
    }


def ringing_from(model: DeviceModel) -> float:
    """Frequency (Hz) from which on the inner damper's force counts as ringing: well above the carriers."""
    return min(max(RINGING_FROM, 1.5 * model.demand.highest if model.demand else 0.0), model.rate / 5)


def damper_settings(model: DeviceModel, damping: Damping | None) -> dict[str, Any]:
    """Settings of a controller's inner damper, None where it has none.

    ``damper_noise`` is its force beyond `ringing_from` (N rms, shape (2,)) by the sensors' noise.
    """
    taps, stride = (damping.taps, damping.stride) if damping else (np.zeros((len(model.mass), 1)), 1)
    turn = np.pi * (np.arange(512) + 0.5) / 512
    s = 1j * np.tan(turn / 2) / _trapezoidal(ringing_from(model), model.rate)
    passed = abs(s * s / (s * s + ROOT2 * s + 1.0)) ** 4
    response = np.exp(-1j * np.outer(turn, stride * np.arange(taps.shape[1]))) @ taps.T  # (512, c)
    power = (passed[:, None] * abs(response) ** 2).mean(axis=0) * (model.coordinate_from_sensed**2).sum(axis=1)
    noise = np.append(sensor_noise(model) * np.sqrt(power), [0.0, 0.0])[:2]
    padded_taps = padded(taps, 2, MOST_TAPS)
    return {"n_taps": taps.shape[1], "tap_stride": stride, "taps": padded_taps, "damper_noise": noise}


def _residual_noise(model: DeviceModel, i: int, corner: float, low_end: float) -> float:
    """Variance (N2) of the residual force of coordinate i per variance of each sensor."""
    turn = np.pi * (np.arange(2048) + 0.5) / 2048
    z = 1j * np.tan(turn / 2)
    s, low, high = z / _trapezoidal(corner, model.rate), z / _trapezoidal(low_end, model.rate), 2.0 * model.rate * z
    passed = abs(low / (1.0 + low) / (1.0 + s) / (s * s + ROOT2 * s + 1.0)) ** 2
    terms = (model.mass[i], model.damping[i], model.stiffness[i])
    stiffness = np.stack([high**2, high, np.ones_like(high)], axis=1) @ np.array(terms)  # (2048, c)
    return float((passed[:, None] * abs(stiffness @ model.coordinate_from_sensed) ** 2).mean(axis=0).sum())


def _trapezoidal(frequency: float, rate: float) -> float:
    """Corner of a trapezoidal filter: tan(pi f/rate)."""
    return math.tan(math.pi * frequency / rate)


def _smoothing(time: float, rate: float) -> float:
    """Smoothing factor (a sample) of a mean over `time` (s)."""
    return -math.expm1(-1.0 / (time * rate))
