"""Supervision: a compiled step around a controller's that stops the drive where the device does not do as it is told.

Every sample it compares what is sensed with the drive that acts, at a cost that does not grow with the bands.  With the
coordinates q (heave, rocking) and the force F = B u, the mean of the samples before and after the moment of sensing,
both behind the same filter H (one-pole high-pass and low-pass, then a Butterworth low-pass of second order, trapezoidal
rule), the residual force

    r = H F - (M H s^2 q + C H s q + K H q)

is what the device model lacks: a finger, its load, noise, or a fault.  Energies E are one-pole means of squares.

=== ============ ================================================================================ ====================
no  test         condition                                                                        for
=== ============ ================================================================================ ====================
1   invalid      share of samples that are not finite or not inside the range > 0.3               50 ms (mean)
2   frozen       a sensor repeats a value for 10 samples and 2 ms while the drive moves           at once
3   inconsistent E_r > finger + load + model + delay + noise, and E_r < 6 E_F                     15 to 60 ms
4   active       -mean(r v) > 0.6 sqrt(E_F E_v), E_r < 6 E_F, in danger only                      5 ms
5   drive        mean of u^2 > (1.5 B + A/2.4)^2/2: more than any finger takes                    30 ms (mean) + 60 ms
6   ringing      inner damper's force beyond 500 Hz and 1.5 times the carriers > 4 times its noise   8 ms
7   overmotion   motion of an end > 3 R + 5.4 sag                                                 5 samples
=== ============ ================================================================================ ====================

R (m) and B (drive unit) are what the scene needs at most with the worst finger, A the drive of a hard press, `sag` the
static displacement under 5 N.  *Danger* is a motion > 4 R + 1.36 sag or a drive above 0.9 of its limit.  The drive
fades out in 10 ms, in danger in 2 ms, on overmotion in 0.2 ms, and stays at zero.  A ringing damper is turned down to
0.4, then to 0; the drive stops where it rings all the same for 150 ms.

Tests 3 to 5 and 7 need a `Demand`; 6 a controller with an inner damper.  Without them a controller has tests 1 and 2.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import carray

from hapticrender.control.controller import BankController
from hapticrender.control.device_model import Demand, DeviceModel
from hapticrender.control.records import CONTROLLER, CONTROLLER_T, MOST_CHANNELS, MOST_SENSORS
from hapticrender.jit import F8, I8, SIGNALS_T, CFunction, call, kernel, pointer, record, step
from hapticrender.protocols import Array, Controller, Flag

INVALID, FROZEN, INCONSISTENT, ACTIVE, DRIVE, RINGING, OVERMOTION = range(1, 8)
STOPPED = int(Flag.STOPPED)
FADE_OUT, FADE_DANGER, FADE_NOW = 10e-3, 2e-3, 0.2e-3  # s
ROOT2 = math.sqrt(2.0)

INVALID_TIME, INVALID_SHARE = 50e-3, 0.3
FROZEN_SAMPLES, FROZEN_TIME = 10, 2e-3  # s; noise of 1 um in steps of 0.12 um repeats a sample with p = 0.034
FROZEN_SIGMAS = 4 * 1.3  # of the noise: the drive must have moved the sensor by so much
LEAST_NOISE = 1e-4  # of a sensor's range: told noise may be none, and steps are not told
FINGER_STIFFNESS, FINGER_DAMPING, LEVER = 8e3, 10.0, 2.0  # N/m, N s/m, |p/a|: no finger has more
MODEL_ERROR, DELAY_ERROR, LOAD = 0.1, 1.2, 1.15  # of D; samples; of K: a pressing hand shows r = -K x
NOISE_VARIANCES = 12.0
BY_DRIVE = 6.0  # E_r over E_F: in a fault the residual is the drive, in a load step it is not
POWER_TIME, POWER = 12e-3, 0.6
DRIVE_TIME, PRESS_TIME, FASTEST_PACE = 30e-3, 60e-3, 6.0  # s, s; times of a faster device are shorter
PRESS, PRESS_LOAD = 9.0, 5.0  # N: 1.5 times the force that a press of 5 N in a millisecond takes; its load
RINGING_FROM, RINGING_VARIANCES, RINGING_STEP = 500.0, 16.0, 0.4  # Hz, 4 sigma
RINGING_MEAN, RINGING_TIME = 3e-3, 8e-3  # s: what a sudden lift-off leaves behind falls in this time from 15 sigma
RINGING_WAIT, RINGING_STOP, SATURATED_WAIT = 10e-3, 150e-3, 0.5  # s
DANGER_DRIVE = 0.9  # of the drive limit
UNLIMITED = 1e300

_SETTINGS = """
sensor_limit invalid_pole frozen_drive low high corner shape omega energy_pole power_pole drive_pole
ring_corner ring_shape ring_pole lever danger_motion danger_drive most_motion most_drive large_drive
fade_out fade_danger fade_now
""".split()
_TIMES = "frozen inconsistent active drive ring ring_wait ring_stop suspension".split()  # samples
SETTINGS = np.dtype(
    [
        *((name, np.float64) for name in _SETTINGS),
        *((name, np.float64, (2, 2)) for name in ("mass", "damping", "stiffness")),
        ("coordinate_from_sensor", np.float64, (2, MOST_SENSORS)),
        ("force_from_drive", np.float64, (2, MOST_CHANNELS)),
        ("bound", np.float64, (2, 8)),  # of E_r, of each coordinate, per energy of q, v, a, dF in both
        ("noise", np.float64, (2,)),  # of E_r (N2)
        ("ringing", np.float64, (2,)),  # N2, of the damper's force; 0: no test
        *((f"{name}_time", np.int64) for name in _TIMES),
        *((name, np.int64) for name in ("step", "state", "controller", "modelled", "sensors", "channels", "block")),
        *((name, np.int64) for name in ("delay", "needs_contact", "forces_at")),
    ]
)
"""Settings of a supervisor, as `design_supervisor` derives them; poles and fades are per sample, times in samples."""
SUPERVISOR = np.dtype(
    [
        ("p", SETTINGS),
        *(
            (name, np.float64)
            for name in ("fade", "fade_step", "invalid", "damper_scale", "motion", "peak", "position")
        ),
        *((name, np.float64, (4,)) for name in ("input", "low", "high", "band", "level", "value", "rate", "change")),
        *((name, np.float64, (4,)) for name in ("ring_band", "ring_level")),
        *((name, np.float64, (2,)) for name in ("force", "power", "ring_energy")),
        ("energy", np.float64, (12,)),  # of q, v, a, dF, F, r in both coordinates
        ("drive_energy", np.float64, (MOST_CHANNELS,)),
        *((name, np.float64, (MOST_SENSORS,)) for name in ("last", "least", "most")),
        ("repeats", np.int64, (MOST_SENSORS,)),
        *((f"{name}_count", np.int64) for name in ("inconsistent", "active", "drive", "motion", "ring", "ring_wait")),
        *((name, np.int64) for name in ("suspended", "sample", "now", "sensors", "cause", "stopped")),
    ]
)
SUPERVISOR_T = numba.from_dtype(SUPERVISOR)


@kernel
def check_sensors(supervisor, sensed, n, drive, acts):
    """Convert a sample's sensors to coordinates, an invalid one held; tests 1 and 2 against the sum of the drive.

    A drive that does not act (on a surface without a sliding finger) moves no sensor.
    """
    s = record(supervisor, SUPERVISOR_T, 0)
    p, cause, invalid, frozen = s.p, 0, 0, 0
    q0 = q1 = 0.0
    for i in range(p.sensors):
        value = sensed[n * p.sensors + i]
        if not abs(value) < p.sensor_limit:
            invalid |= 1 << i
        elif value == s.last[i] and acts:
            s.repeats[i] += 1
            s.least[i], s.most[i] = min(s.least[i], drive), max(s.most[i], drive)
            if s.repeats[i] >= p.frozen_time and s.most[i] - s.least[i] > p.frozen_drive:
                frozen |= 1 << i
        else:
            s.last[i], s.repeats[i], s.least[i], s.most[i] = value, 1, drive, drive
        q0 += p.coordinate_from_sensor[0, i] * s.last[i]
        q1 += p.coordinate_from_sensor[1, i] * s.last[i]
    s.input[0], s.input[1] = q0, q1
    s.invalid += p.invalid_pole * ((1.0 if invalid > 0 else 0.0) - s.invalid)
    if invalid > 0 and s.invalid > INVALID_SHARE:
        cause = INVALID
    elif frozen > 0:
        cause = FROZEN
    if cause > 0 and s.cause == 0:
        s.sensors = invalid if cause == INVALID else frozen
    return cause


@kernel
def filter_signals(supervisor):
    """Filter coordinates and forces by H; the state-variable low-pass gives H x, H s x and H s^2 x at once."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, g = s.p, s.p.corner
    for i in range(4):
        step = p.low * (s.input[i] - s.low[i])
        x = s.low[i] + step
        s.low[i] = x + step
        step = p.high * (x - s.high[i])
        mean = s.high[i] + step
        s.high[i] = mean + step
        top = p.shape * (x - mean - s.level[i] - (g + ROOT2) * s.band[i])
        band = s.band[i] + g * top
        level = s.level[i] + g * band
        s.band[i], s.level[i] = band + g * top, level + g * band
        s.value[i], s.rate[i], s.change[i] = level, p.omega * band, p.omega * p.omega * top


@kernel
def check_motion(supervisor, drive_in_danger):
    """Tests 3, 4 and 7: whether the motion follows from the drive; returns the cause and whether there is danger."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, e = s.p, s.energy
    last0, last1 = s.value[2], s.value[3]
    filter_signals(supervisor)
    s.motion = abs(s.value[0]) + p.lever * abs(s.value[1])
    danger = drive_in_danger or s.motion > p.danger_motion
    pole, wrong, active = p.energy_pole, False, False
    for i in range(2):
        r = s.value[2 + i]
        for j in range(2):
            r -= p.mass[i, j] * s.change[j] + p.damping[i, j] * s.rate[j] + p.stiffness[i, j] * s.value[j]
        change = s.value[2 + i] - (last0 if i == 0 else last1)
        e[i] += pole * (s.value[i] * s.value[i] - e[i])
        e[2 + i] += pole * (s.rate[i] * s.rate[i] - e[2 + i])
        e[4 + i] += pole * (s.change[i] * s.change[i] - e[4 + i])
        e[6 + i] += pole * (change * change - e[6 + i])
        e[8 + i] += pole * (s.value[2 + i] * s.value[2 + i] - e[8 + i])
        e[10 + i] += pole * (r * r - e[10 + i])
        s.power[i] += p.power_pole * (-r * s.rate[i] - s.power[i])
    for i in range(2):
        bound = p.noise[i]
        for j in range(8):
            bound += p.bound[i, j] * e[j]
        by_drive = e[10 + i] < BY_DRIVE * e[8 + i]
        wrong |= by_drive and e[10 + i] > bound
        power = s.power[i]
        active |= by_drive and power > 0.0 and power * power > POWER * POWER * e[8 + i] * e[2 + i]
    s.inconsistent_count = s.inconsistent_count + (4 if danger else 1) if wrong else max(s.inconsistent_count - 2, 0)
    s.active_count = s.active_count + 1 if active and danger else 0
    s.motion_count = s.motion_count + 1 if s.motion > p.most_motion else 0
    if s.motion_count >= 5:
        return OVERMOTION, danger
    if s.active_count >= p.active_time:
        return ACTIVE, danger
    return INCONSISTENT if s.inconsistent_count >= p.inconsistent_time else 0, danger


@kernel
def check_drive(supervisor, drive, n):
    """Test 5, on the drive of the last sample; returns whether it failed, and the largest drive."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, large, peak = s.p, False, 0.0
    for i in range(p.channels):
        value = drive[n, i]
        peak = max(peak, abs(value))
        s.drive_energy[i] += p.drive_pole * (value * value - s.drive_energy[i])
        large |= s.drive_energy[i] > p.most_drive
    s.drive_count = s.drive_count + 1 if large else 0
    s.peak = peak
    return s.drive_count > p.drive_time


@kernel
def check_ringing(supervisor):
    """Test 6: turn a ringing inner damper down to 0.4, then to 0; returns whether it rings all the same."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p, c, g, over = s.p, record(s.p.controller, CONTROLLER_T, 0), s.p.ring_corner, False
    if c.damping_gain == 0.0 and s.damper_scale == 1.0:  # off by its schedule
        return False
    s.suspended = p.suspension_time if s.peak > p.large_drive else max(s.suspended - 1, 0)
    for i in range(2):
        top = c.damper_force[i]
        for j in (i, 2 + i):
            top = p.ring_shape * (top - s.ring_level[j] - (g + ROOT2) * s.ring_band[j])
            band = s.ring_band[j] + g * top
            s.ring_band[j], s.ring_level[j] = band + g * top, s.ring_level[j] + 2.0 * g * band
        s.ring_energy[i] += p.ring_pole * (top * top - s.ring_energy[i])
        over |= s.ring_energy[i] > p.ringing[i] > 0.0
    s.ring_wait_count = max(s.ring_wait_count - 1, 0)
    s.ring_count = s.ring_count + 1 if over and s.suspended == 0 and s.ring_wait_count == 0 else 0
    if s.damper_scale > 0.0 and s.ring_count >= p.ring_time:
        s.damper_scale = RINGING_STEP if s.damper_scale == 1.0 else 0.0
        s.ring_count, s.ring_wait_count, c.damper_scale = 0, p.ring_wait_time, s.damper_scale
    return s.ring_count >= p.ring_stop_time


@kernel
def supervise(supervisor, sensed, position, drive, flags, n):
    """Run the tests on a sample, and fade its drive out once one has failed."""
    s = record(supervisor, SUPERVISOR_T, 0)
    p = s.p
    forces = carray(pointer(p.forces_at, F8), (p.delay + 1, 3))
    now, later = s.now, s.now - 1 if s.now > 0 else p.delay  # the drive that acts from this sample on; this sample's
    s.now = now + 1 if now < p.delay else 0
    for i in range(2):
        s.input[2 + i], s.force[i] = 0.5 * (s.force[i] + forces[now, i]), forces[now, i]
    acts = p.needs_contact == 0 or (position[n] == position[n] and position[n] != s.position)
    s.position = position[n]
    cause, danger = check_sensors(supervisor, sensed, n, forces[now, 2], acts), False
    if check_drive(supervisor, drive, n) and cause == 0:
        cause = DRIVE
    if p.modelled > 0:
        if s.sample == 0:  # a steady load is no motion
            for i in range(2):
                s.low[i] = s.high[i] = s.input[i]
        found, danger = check_motion(supervisor, s.peak > p.danger_drive)
        cause = found if cause == 0 or found == OVERMOTION else cause
        if p.controller != 0 and check_ringing(supervisor) and cause == 0:
            cause = RINGING
    if cause != 0 and s.cause == 0:
        s.cause, s.stopped = cause, s.sample
    if s.cause != 0:
        step = p.fade_now if cause == OVERMOTION else p.fade_danger if danger else p.fade_out
        s.fade_step = max(s.fade_step, step)
        s.fade = max(s.fade - s.fade_step, 0.0)
        flags[n] |= STOPPED
    force0 = force1 = total = 0.0
    for i in range(p.channels):
        value = s.fade * drive[n, i]
        drive[n, i] = value
        force0 += p.force_from_drive[0, i] * value
        force1 += p.force_from_drive[1, i] * value
        total += value
    forces[later, 0], forces[later, 1], forces[later, 2] = force0, force1, total
    s.sample += 1


@step
def supervised_step(state, signals, start, count):
    """Advance the supervised controller by `count` samples, block by block, and supervise every sample."""
    s, io, stop = record(state, SUPERVISOR_T, 0), record(signals, SIGNALS_T, 0), start + count
    p = s.p
    sensed, position, flags = pointer(io.sensed, F8), pointer(io.position, F8), carray(pointer(io.flags, I8), stop)
    drive = carray(pointer(io.drive, F8), (stop, p.channels))
    for first in range(start, stop, p.block):
        if s.fade > 0.0:
            call(p.step, (p.state, signals, first, p.block))
        else:
            drive[first : first + p.block] = 0.0
        for n in range(first, first + p.block):
            supervise(state, sensed, position, drive, flags, n)
    return 0


class Fault(NamedTuple):
    """Why a supervisor has stopped the drive."""

    cause: int  # INVALID to OVERMOTION
    sample: int  # at which the test failed; the drive fades out from it on
    sensors: int  # bit i: sensor i + 1; of INVALID and FROZEN

    @property
    def text(self) -> str:
        """What was found, the most likely reason, and what to check."""
        found, check = CAUSES[self.cause]
        names = " and ".join(str(i + 1) for i in range(MOST_SENSORS) if self.sensors >> i & 1)
        return f"{found.format(sensor=names)}: check {check}"


CAUSES = {
    INVALID: (
        "sensor {sensor}: samples are no numbers, or at the end of the range",
        "cable and supply, and that the surface stays within the range",
    ),
    FROZEN: (
        "sensor {sensor}: one value repeats while the drive moves; most likely frozen or disconnected",
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
        "the delay of the loop, and [device] with the bending mode that `hapticrender identify` finds",
    ),
    OVERMOTION: (
        "the surface moved farther than the scene and a press can move it; most likely the loop is unstable",
        "wiring and polarity of all sensors and actuators, the delay, and [device]",
    ),
}


class SupervisedController:
    """A controller with a compiled step, supervised, behind the `Controller` protocol.

    All that is not named here is the controller's own; `fault` says why the drive has been stopped, None while it
    has not.  A stop is for good: design a new controller to start again.
    """

    step = supervised_step

    def __init__(self, controller: Any, model: DeviceModel) -> None:
        self.controller, self.method, self.n_bands = controller, controller.method, controller.n_bands
        self.state = np.zeros(1, SUPERVISOR)
        self._forces = np.zeros((model.delay + 1, 3))
        settings = design_supervisor(controller, model) | {
            "step": controller.step.address,
            "state": controller.state.ctypes.data,
            "forces_at": self._forces.ctypes.data,
        }
        for name, value in settings.items():
            self.state["p"][name] = value
        self.state["fade"] = self.state["damper_scale"] = 1.0
        self.state["last"] = 0.0
        self.channels, self.sensors = int(settings["channels"]), int(settings["sensors"])

    def __getattr__(self, name: str) -> Any:
        if name == "controller":  # not made yet
            raise AttributeError(name)
        return getattr(self.controller, name)

    @property
    def fault(self) -> Fault | None:
        """Why and when the drive has been stopped."""
        cause, sample, sensors = (int(self.state[name][0]) for name in ("cause", "stopped", "sensors"))
        return Fault(cause, sample, sensors) if cause else None

    @property
    def damper_scale(self) -> float:
        """Gain to which a ringing inner damper has been turned down, 1: it did not ring."""
        return float(self.state["damper_scale"][0])

    run = BankController.run


def supervised(controller: Controller, model: DeviceModel) -> Any:
    """Return a controller under supervision; as it is where it has no compiled step, or nothing is sensed."""
    compiled = isinstance(getattr(controller, "step", None), CFunction)
    return SupervisedController(controller, model) if compiled else controller


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
    n, noise = len(model.mass), max(model.sensed_noise, LEAST_NOISE * model.sensed_limit)
    demand, stiffness, total = model.demand, float(model.stiffness[0, 0]), float(abs(model.force_from_drive[0].sum()))
    top = abs(model.dynamic_stiffness(np.array(demand.highest if demand else 0.0))[0, 0])
    moved = FROZEN_SIGMAS * noise * max(stiffness, top) * channels / total  # sum of the channels
    settings: dict[str, Any] = {
        "sensors": sensors,
        "channels": channels,
        "block": getattr(controller, "block", 1),
        "delay": model.delay,
        "needs_contact": model.finger.needs_contact,
        "sensor_limit": model.sensed_limit,
        "most_drive": UNLIMITED,
        "coordinate_from_sensor": _padded(model.coordinate_from_sensed, 2, MOST_SENSORS),
        "force_from_drive": _padded(model.force_from_drive, 2, MOST_CHANNELS),
        "invalid_pole": _pole(INVALID_TIME, rate),
        "frozen_time": max(FROZEN_SAMPLES, round(FROZEN_TIME / model.pace * rate)),
        "frozen_drive": UNLIMITED if model.inferred else moved,
        **{f"fade_{name}": min(model.pace / (time * rate), 1.0) for name, time in FADES.items()},
    }
    if demand is None:
        return settings
    modelled = demand.lowest < rate / 10  # beyond it neither trapezoidal rule nor hold are the device's
    pressed = modelled or model.finger.contact is not None
    press, pace = press_drive(model) if pressed else 0.0, min(model.pace, FASTEST_PACE)
    settings |= {
        "drive_pole": _pole(DRIVE_TIME / pace, rate),
        "drive_time": PRESS_TIME / pace * rate,
        "most_drive": (1.5 * demand.drive + press / 2.4) ** 2 / 2.0,
    }
    if not modelled:
        return settings
    sag, shared = PRESS_LOAD / stiffness, DELAY_ERROR**2
    corner = float(np.clip(1.4 * demand.highest, 250.0, max(rate / 10, 250.0)))
    low_end = float(np.clip(0.75 * demand.lowest, 15.0, 60.0))
    g, omega = _trapezoidal(corner, rate), 2.0 * rate * _trapezoidal(corner, rate)
    high = _trapezoidal(low_end, rate)
    bound, floor = np.zeros((2, 8)), np.zeros(2)
    for i in range(n):
        finger = 2.0 * (1.0, 4.0)[i]
        bound[i, :4] = finger * np.array([1.0, 4.0, 0.0, 0.0]) * FINGER_STIFFNESS**2
        bound[i, 2:4] = finger * np.array([1.0, 4.0]) * FINGER_DAMPING**2
        bound[i, i] += (MODEL_ERROR**2 + LOAD**2) * model.stiffness[i, i] ** 2
        bound[i, 4 + i] = MODEL_ERROR**2 * model.mass[i, i] ** 2
        bound[i, 6 + i] = shared
        floor[i] = NOISE_VARIANCES * noise**2 * _residual_noise(model, i, corner, low_end)
    return (
        settings
        | _ringing(controller, model, demand)
        | {
            "modelled": 1,
            **{name: _padded(getattr(model, name), 2, 2) for name in ("mass", "damping", "stiffness")},
            "corner": g,
            "shape": 1.0 / (1.0 + g * (g + ROOT2)),
            "omega": omega,
            "low": g / (1.0 + g),
            "high": high / (1.0 + high),
            "energy_pole": _pole(float(np.clip(0.36 / demand.lowest, 5e-3, 10e-3)), rate),
            "power_pole": _pole(POWER_TIME, rate),
            "bound": bound,
            "noise": floor,
            "inconsistent_time": rate * float(np.clip(1.2 / demand.lowest, 15e-3, 60e-3)),
            "active_time": 5e-3 * rate,
            "lever": abs(model.place_from_coordinate[:, 1:]).max(initial=0.0),
            "danger_motion": 4.0 * demand.motion + 1.36 * sag,
            "most_motion": 3.0 * demand.motion + 5.4 * sag,
            "danger_drive": DANGER_DRIVE * model.drive_limit,
        }
    )


FADES = {"out": FADE_OUT, "danger": FADE_DANGER, "now": FADE_NOW}  # s


def _ringing(controller: Any, model: DeviceModel, demand: Demand) -> dict[str, Any]:
    """Settings of test 6, for a controller whose record names the noise of its inner damper."""
    state = controller.state
    if getattr(state, "dtype", None) != CONTROLLER or not state["p"]["damper_noise"].any():
        return {}
    rate, g = model.rate, _trapezoidal(ringing_from(model), model.rate)
    needs_all = demand.drive > 0.7 * model.drive_limit
    times = {"ring": RINGING_TIME, "ring_wait": RINGING_WAIT, "ring_stop": RINGING_STOP, "suspension": SATURATED_WAIT}
    return {
        "controller": state.ctypes.data,
        "ringing": RINGING_VARIANCES * state["p"]["damper_noise"][0] ** 2,
        "ring_corner": g,
        "ring_shape": 1.0 / (1.0 + g * (g + ROOT2)),
        "ring_pole": _pole(RINGING_MEAN, rate),
        "large_drive": 0.6 * model.drive_limit if needs_all else UNLIMITED,
        **{f"{name}_time": time * rate for name, time in times.items()},
    }


def ringing_from(model: DeviceModel) -> float:
    """Frequency (Hz) from which on the inner damper's force counts as ringing: well above the carriers."""
    return min(max(RINGING_FROM, 1.5 * model.demand.highest if model.demand else 0.0), model.rate / 5)


def damper_noise(model: DeviceModel, taps: Array) -> Array:
    """Inner damper's force beyond `ringing_from` (N rms, shape (2,)) by the sensors' noise, for taps (c, t) in N/m."""
    noise = max(model.sensed_noise, LEAST_NOISE * model.sensed_limit)
    turn = np.pi * (np.arange(512) + 0.5) / 512
    s = 1j * np.tan(turn / 2) / _trapezoidal(ringing_from(model), model.rate)
    passed = abs(s * s / (s * s + ROOT2 * s + 1.0)) ** 4
    response = np.exp(-1j * np.outer(turn, np.arange(taps.shape[1]))) @ taps.T  # (512, c)
    power = (passed[:, None] * abs(response) ** 2).mean(axis=0) * (model.coordinate_from_sensed**2).sum(axis=1)
    return np.append(noise * np.sqrt(power), [0.0, 0.0])[:2]


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


def _pole(time: float, rate: float) -> float:
    """Gain of a one-pole mean over `time` (s)."""
    return -math.expm1(-1.0 / (time * rate))


def _padded(matrix: Array, rows: int, columns: int) -> Array:
    return np.pad(matrix, ((0, rows - matrix.shape[0]), (0, columns - matrix.shape[1])))
