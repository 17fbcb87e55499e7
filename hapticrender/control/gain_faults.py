"""Supervision of gains: whether a sensor shows, or an actuator gives, a multiple of what it did, or another's.

A stationary Kalman filter of x = (q, q', d), the device's coordinates, their rates and a force that wanders, has
innovations e that are white but for fingers; a change of gain adds a multiple of a known signal w to them, which least
squares find (docs/theory.md, "Supervision").  Sensors are judged over the 3 ms after an innovation above 4.5 times its
noise; actuators by means over 3 ms, while e is large.  Sensors that were swapped while both showed the same look like
actuators that are, where both are symmetrical about the middle.

References
----------
Willsky and Jones, IEEE Transactions on Automatic Control 21, 1976 (generalized likelihood ratio).
Anderson, International Journal of Control 28, 1978 (the Riccati equation by doubling).
"""

import math

import numba
import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.jit import kernel, record
from hapticrender.mathx import state_space, zoh
from hapticrender.protocols import Array

MOST = 2  # sensors, and actuators
CHANGES, SWAP = MOST + 1, MOST  # that add to e: of the one, of the other, and a swap of the two
# numpy's integers: a kernel is compiled anew for each value of Python's
SENSOR, ACTUATOR = np.arange(2)  # kinds of gains
STATE, MOTION, RESPONSE = np.arange(3)  # models: x; p; xi_1, xi_2, xi_3, zeta_1, zeta_2, zeta_3
LEAST_INVERTED, MOST_INVERTED = -1.6, -0.4  # gains of a sensor or an actuator that is inverted
DEAD, MOST_GAIN = 0.25, 2.0  # of a sensor: a smaller magnitude, a larger gain is a fault
HEALTHY = 0.35  # of a sensor's gain about 1: one that is neither that nor a fault says that the change is none of gains
LEAST_SWAPPED, MOST_SWAPPED = 0.8, 1.4  # eta; less: a drive that bears more than 0.62 of the moment of a finger
UNEXPLAINED, UNEXPLAINED_INVERTED = 0.1, 0.13  # of the energy of e; the latter of inverted or swapped sensors
CERTAIN, LIKELY, JUMP = 25.0, 9.0, 20.0  # variances: 5 and 3 sigma of a gain; 4.5 sigma of an innovation
WATCHED, LARGE = 4.0, 20.0  # variances of e: actuators are followed, judged
WANDER = 3.5  # N/sqrt(s), of d
TRIAL, LEAST_TRIAL, MEAN, WINDOW = 3e-3, 8, 20e-3, 3e-3  # s, samples, s, s

GAINS = np.dtype(
    [
        ("step_state", np.float64, (4, 4)),  # A of q and q' ...
        ("step_force", np.float64, (4, 2)),  # ... and B, with the force held over a sample
        ("filter_gain", np.float64, (6, MOST)),  # K
        ("sensor_from_coordinate", np.float64, (MOST, 2)),  # of C
        ("force_of_actuator", np.float64, (CHANGES, 2, 2)),  # F_j per F
        ("scale", np.float64),  # 1/m: e and C are in units of the sensors' noise
        ("innovation", np.float64),  # variance of e of each sensor by noise, as a multiple of its own
        *((name, np.float64) for name in ("mean_smoothing", "window_smoothing")),  # a sample
        ("duration", np.int64),  # samples of a trial
        ("models", np.float64, (2 + 2 * CHANGES, 6)),
        ("w", np.float64, (CHANGES, MOST)),  # of both sensors
        *((name, np.float64, (MOST,)) for name in ("e", "mean", "energy")),  # mean of e^2 of a sensor; sums of e^2
        ("weights", np.float64, (2, CHANGES, CHANGES)),  # sums of w_i w_j of sensors, of actuators
        ("weighted", np.float64, (2, CHANGES)),  # sums of w_i e
        ("gain", np.float64, (2, MOST)),  # g
        *((name, np.int64) for name in ("left", "watched")),  # samples: to go in the trial; with actuators followed
    ]
)
"""Settings and state of the tests of gains; kernels take it as `s`, by reference."""
GAINS_T = numba.from_dtype(GAINS)


def design_gains(model: DeviceModel, noise: float) -> Array | None:
    """Record of the tests; None but for one or two actuators, and sensors of `noise` (rms), that show all motion."""
    sensors, n, actuators = model.coordinate_from_sensed.shape[1], len(model.mass), model.force_from_drive.shape[1]
    seen = sensors > 0 and np.linalg.matrix_rank(model.coordinate_from_sensed) == n
    moves = math.isfinite(noise) and np.linalg.matrix_rank(model.mass) == n
    if max(sensors, actuators) > MOST or not (seen and moves):
        return None
    force_map = model.force_from_drive
    a, b = zoh(*state_space(model.mass, model.damping, model.stiffness, np.eye(n)), 1.0 / model.rate)
    whole = np.block([[a, b], [np.zeros((n, 2 * n)), np.eye(n)]])
    show = np.hstack([np.linalg.pinv(model.coordinate_from_sensed) / noise, np.zeros((sensors, 2 * n))])
    gain, variance = _filter(whole, show, WANDER / math.sqrt(model.rate))
    found = np.zeros(1, GAINS)
    rows = np.r_[0:n, 2 : 2 + n, 4 : 4 + n]  # of a device of one coordinate
    found["step_state"][0][np.ix_(rows[: 2 * n], rows[: 2 * n])] = a
    found["step_force"][0][rows[: 2 * n], :n] = b
    found["filter_gain"][0][rows, :sensors] = gain
    found["sensor_from_coordinate"][0][:sensors, :n] = show[:, :n]
    shares = np.einsum("aj,jb->jab", force_map, np.linalg.pinv(force_map))
    found["force_of_actuator"][0][:actuators, :n, :n] = shares
    if actuators == MOST:
        swapped = force_map @ np.eye(MOST)[::-1] @ np.linalg.pinv(force_map)
        found["force_of_actuator"][0][SWAP, :n, :n] = swapped - shares.sum(axis=0)
    found["scale"], found["innovation"] = 1.0 / noise, variance
    found["mean_smoothing"], found["window_smoothing"] = (-math.expm1(-1.0 / (t * model.rate)) for t in (MEAN, WINDOW))
    found["duration"] = max(round(TRIAL * model.rate), LEAST_TRIAL)
    return found


def _filter(a: Array, c: Array, wander: float) -> tuple[Array, float]:
    """Stationary Kalman gain before the step, and largest variance of an innovation, for sensors of unit noise.

    The Riccati equation is doubled: 2^k steps of it in k [Anderson 1978].
    """
    step, information = a.T, c.T @ c
    covariance = np.diag(np.repeat([0.0, 0.0, wander**2], len(a) // 3))
    for _ in range(60):
        if abs(step).max() < 1e-12:  # what is left of the state before
            break
        half = np.linalg.inv(np.eye(len(a)) + information @ covariance)
        information = information + step @ half @ information @ step.T
        covariance, step = covariance + step.T @ covariance @ half @ step, step @ half @ step
    innovation = c @ covariance @ c.T + np.eye(len(c))
    return covariance @ c.T @ np.linalg.inv(innovation), float(innovation.diagonal().max())


@kernel
def advance_model(s, k, force0, force1):
    """Advance model k by a sample, under the force that acts."""
    x, a, b = s.models[k], s.step_state, s.step_force
    force0, force1 = force0 + x[4], force1 + x[5]
    x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
    for i in range(4):
        x[i] = b[i, 0] * force0 + b[i, 1] * force1 + a[i, 0] * x0 + a[i, 1] * x1 + a[i, 2] * x2 + a[i, 3] * x3


@kernel
def correct_model(s, k, error0, error1):
    """Correct model k by the innovations of both sensors."""
    for i in range(6):
        s.models[k, i] += s.filter_gain[i, 0] * error0 + s.filter_gain[i, 1] * error1


@kernel
def model_sensors(s, k):
    """What both sensors show of model k, over their noise."""
    c, heave, rocking = s.sensor_from_coordinate, s.models[k, 0], s.models[k, 1]
    return c[0, 0] * heave + c[0, 1] * rocking, c[1, 0] * heave + c[1, 1] * rocking


@kernel
def clear_sums(s, kind):
    """Set the sums of a kind of gains, and the models behind its w, to zero."""
    for j in range(CHANGES):
        s.weighted[kind, j] = 0.0
        for i in range(CHANGES):
            s.weights[kind, j, i] = 0.0
        for i in range(6):
            s.models[RESPONSE + CHANGES * kind + j, i] = 0.0


@kernel
def add_sums(s, kind, smoothing):
    """Add a sample of w to the sums; with a `smoothing` below 1 these are means."""
    w, b, x, e, kept = s.weights[kind], s.weighted[kind], s.w, s.e, 1.0 if kind == SENSOR else 1.0 - smoothing
    for i in range(CHANGES):
        for j in range(i, CHANGES):
            w[i, j] = kept * w[i, j] + smoothing * (x[i, 0] * x[j, 0] + x[i, 1] * x[j, 1])
        b[i] = kept * b[i] + smoothing * (x[i, 0] * e[0] + x[i, 1] * e[1])


@kernel
def is_fault(kind, gain, rest):
    """Whether a gain is that of a fault, with `rest` the share of the energy of e that it leaves unexplained."""
    if LEAST_INVERTED < gain < MOST_INVERTED:
        return rest < (UNEXPLAINED_INVERTED if kind == SENSOR else UNEXPLAINED)
    return kind == SENSOR and rest < UNEXPLAINED and (abs(gain) < DEAD or gain > MOST_GAIN)


@kernel
def judge_gains(s, kind, noise):
    """Find gains and swap, from innovations of variance `noise`: gains that are faults, as bits; whether it is a swap.

    A swap has to explain more than the gains do, where these are faults.
    """
    w, b, energy, faults = s.weights[kind], s.weighted[kind], s.energy[kind], 0
    w00, w11, w22 = w[0, 0] + noise, w[1, 1] + noise, w[SWAP, SWAP] + noise  # what shows nothing keeps its gain
    scale = 1.0 / (w00 * w11 - w[0, 1] * w[0, 1])
    g0, g1, eta = scale * (w11 * b[0] - w[0, 1] * b[1]), scale * (w00 * b[1] - w[0, 1] * b[0]), b[SWAP] / w22
    rest = energy - 2.0 * (g0 * b[0] + g1 * b[1])
    rest += g0 * g0 * w[0, 0] + 2.0 * g0 * g1 * w[0, 1] + g1 * g1 * w[1, 1]
    s.gain[kind, 0], s.gain[kind, 1] = 1.0 + g0, 1.0 + g1
    other = False
    for j in range(2):
        g, variance = (g0, w11) if j == 0 else (g1, w00)
        variance *= scale * noise
        if g * g > CERTAIN * variance and is_fault(kind, 1.0 + g, rest / energy):
            faults |= 1 << j
        elif kind == SENSOR and g * g > LIKELY * variance and abs(g) > HEALTHY:
            other = True  # a hard press: one gain of -1 beside another of -2, 0.35 or 0.52
    if other:
        faults = 0
    if faults == 0:
        rest = (UNEXPLAINED_INVERTED if kind == SENSOR else UNEXPLAINED) * energy
    certain = eta * eta * w22 > CERTAIN * noise and LEAST_SWAPPED < eta < MOST_SWAPPED
    return faults, certain and energy - 2.0 * eta * b[SWAP] + eta * eta * w[SWAP, SWAP] < rest


@kernel
def leave_out(s, j, invalid):
    """A change shows nothing in a sample that is invalid."""
    for i in range(2):
        if invalid & 1 << i:
            s.w[j, i] = 0.0


@kernel
def follow_sensors(s, invalid, force0, force1):
    """Add a sample to a trial; at its end the sensors whose gain has changed, as bits, and whether they are swapped."""
    p0, p1 = model_sensors(s, MOTION)
    for j in range(CHANGES):
        known0, known1 = model_sensors(s, RESPONSE + j)
        s.w[j, 0] = (p0 if j == 0 else p1 - p0 if j == SWAP else 0.0) - known0
        s.w[j, 1] = (p1 if j == 1 else p0 - p1 if j == SWAP else 0.0) - known1
        leave_out(s, j, invalid)
    add_sums(s, SENSOR, 1.0)
    s.energy[SENSOR] += s.e[0] * s.e[0] + s.e[1] * s.e[1]
    advance_model(s, MOTION, force0, force1)
    for j in range(CHANGES):
        correct_model(s, RESPONSE + j, s.w[j, 0], s.w[j, 1])
        advance_model(s, RESPONSE + j, 0.0, 0.0)
    s.left -= 1
    return judge_gains(s, SENSOR, s.innovation) if s.left == 0 else (0, False)


@kernel
def follow_actuators(s, invalid, force0, force1):
    """Add a sample to the means; the actuators that are inverted, as bits, and whether they are swapped."""
    first = RESPONSE + CHANGES * ACTUATOR
    for j in range(CHANGES):
        s.w[j, 0], s.w[j, 1] = model_sensors(s, first + j)
        leave_out(s, j, invalid)
    if s.watched > s.duration // 2:  # by then w no longer depends on where it began
        add_sums(s, ACTUATOR, s.window_smoothing)
    for j in range(CHANGES):
        f = s.force_of_actuator[j]
        correct_model(s, first + j, -s.w[j, 0], -s.w[j, 1])
        advance_model(s, first + j, f[0, 0] * force0 + f[0, 1] * force1, f[1, 0] * force0 + f[1, 1] * force1)
    known = 2 * s.watched > 3 * s.duration and s.energy[ACTUATOR] > LARGE * s.innovation
    return judge_gains(s, ACTUATOR, s.window_smoothing * s.innovation) if known else (0, False)


@kernel
def note_innovations(s, sensed, sensors, invalid):
    """Find the innovations and their mean squares; whether one has jumped.  An `invalid` sample (a bit) has none."""
    jump, energy = False, 0.0
    known0, known1 = model_sensors(s, STATE)
    for i in range(sensors):
        s.e[i] = 0.0
        if invalid & 1 << i:
            continue
        s.e[i] = s.scale * sensed[i] - (known0 if i == 0 else known1)
        square = s.e[i] * s.e[i]
        jump |= square > JUMP * max(s.innovation, s.mean[i])
        s.mean[i] += s.mean_smoothing * (square - s.mean[i])
        energy += square
    s.energy[ACTUATOR] += s.window_smoothing * (energy - s.energy[ACTUATOR])
    return jump


@kernel
def check_gains(gains, sensed, sensors, invalid, force0, force1):
    """Sensors and actuators whose gain has changed, as bits, and whether two are swapped.

    `invalid` has the sensors whose sample is none, as bits; `force0` and `force1` (N) act from this sample on.
    """
    s = record(gains, GAINS_T, 0)
    sensor_faults = actuator_faults = 0
    sensors_swapped = actuators_swapped = False
    if note_innovations(s, sensed, sensors, invalid) and s.left == 0:
        clear_sums(s, SENSOR)
        s.left, s.energy[SENSOR] = s.duration, 0.0
        for i in range(6):
            s.models[MOTION, i] = s.models[STATE, i]
    if s.left > 0:
        sensor_faults, sensors_swapped = follow_sensors(s, invalid, force0, force1)
    if s.energy[ACTUATOR] > WATCHED * s.innovation:
        s.watched += 1
        actuator_faults, actuators_swapped = follow_actuators(s, invalid, force0, force1)
    elif s.watched > 0:
        clear_sums(s, ACTUATOR)
        s.watched = 0
    correct_model(s, STATE, s.e[0], s.e[1])
    advance_model(s, STATE, force0, force1)
    return sensor_faults, actuator_faults, sensors == MOST and (sensors_swapped or actuators_swapped)


@kernel
def start_gains(gains, heave, rocking, force0, force1):
    """Start the filter at rest at the coordinates that the sensors show, under `force0` and `force1` (N)."""
    s = record(gains, GAINS_T, 0)
    state = s.models[STATE]
    state[0], state[1], state[4], state[5] = heave, rocking, force0, force1
