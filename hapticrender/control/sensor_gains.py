"""Supervision of the sensors' gains: whether one shows, from one sample to the next, a multiple of the motion.

A Kalman filter has the device's coordinates q, their rates, and a force d that wanders, by which it follows fingers and
loads.  Its innovations e are white but for what wanders faster.  A sensor i that shows g_i times the motion p that
device and drive give, from now on, adds (g_i - 1) w_i to them::

    x[n+1] = A (x[n] + K e[n]) + B F[n],     e = y - C x,     x = (q, q', d)
    w_i = c_i p - C xi_i,                    xi_i[n+1] = A (xi_i[n] + K w_i[n])

with c_i the row of C of sensor i alone, and p the filter's state, from now on without its corrections.  Once an
innovation is above 4.5 times its noise, and its mean square before, p and w are computed for 2 ms, and least squares of
e on w find g.  A finger's force makes no jump: what it adds to e is no multiple of w.

References
----------
Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems,
IEEE Transactions on Automatic Control 21, 1976.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.jit import kernel, record
from hapticrender.mathx import zoh
from hapticrender.protocols import Array

SENSORS = 2  # at most
LEAST_GAIN, MOST_GAIN = 0.4, 2.0  # over that of a moment before
UNEXPLAINED = 0.15  # of the energy of e: fingers that press or lift 5 N in 1 ms leave 0.24 and more, faults below 0.1
CERTAIN, JUMP = 25.0, 20.0  # variances: 5 sigma of a gain; 4.5 sigma of an innovation
WANDER = 3.5  # N/sqrt(s), of d
TRIAL, LEAST_TRIAL, MEAN = 2e-3, 8, 20e-3  # s, samples, s

SENSOR_GAINS = np.dtype(
    [
        ("step_state", np.float64, (4, 4)),  # A of q and q' ...
        ("step_force", np.float64, (4, 2)),  # ... and B, with the force held over a sample
        ("filter_gain", np.float64, (6, SENSORS)),  # K
        ("sensor_from_coordinate", np.float64, (SENSORS, 2)),  # of C
        ("innovation", np.float64),  # variance of e of each sensor by noise
        ("mean_pole", np.float64),  # a sample
        ("duration", np.int64),  # samples of a trial
        ("models", np.float64, (4, 6)),  # x, p, xi_1, xi_2
        ("advanced", np.float64, (4,)),
        *((name, np.float64, (SENSORS,)) for name in ("e", "mean", "weighted", "gain")),  # mean of e^2; sums of w_i e
        ("weights", np.float64, (SENSORS, SENSORS)),  # sums of w_i w_j
        ("energy", np.float64),  # sum of e^2
        ("left", np.int64),  # samples of the trial that is going on
    ]
)
"""Settings and state of the test of gains."""
SENSOR_GAINS_T = numba.from_dtype(SENSOR_GAINS)


def design_gains(model: DeviceModel, noise: float) -> Array | None:
    """Record of the test for a device whose sensors have `noise` (rms); None for more than two sensors."""
    sensors, n = model.coordinate_from_sensed.shape[1], len(model.mass)
    if sensors > SENSORS:
        return None
    inverse = np.linalg.inv(model.mass)
    a, b = np.zeros((2 * n, 2 * n)), np.vstack([np.zeros((n, n)), inverse])
    a[:n, n:], a[n:, :n], a[n:, n:] = np.eye(n), -inverse @ model.stiffness, -inverse @ model.damping
    a, b = zoh(a, b, 1.0 / model.rate)
    show = np.hstack([np.linalg.pinv(model.coordinate_from_sensed), np.zeros((sensors, 2 * n))])
    gain, variance = _filter(
        np.block([[a, b], [np.zeros((n, 2 * n)), np.eye(n)]]), show / noise, WANDER / model.rate**0.5
    )
    found = np.zeros(1, SENSOR_GAINS)
    rows = np.r_[0:n, 2 : 2 + n, 4 : 4 + n]  # of a device of one coordinate
    found["step_state"][0][np.ix_(rows[: 2 * n], rows[: 2 * n])] = a
    found["step_force"][0][rows[: 2 * n], :n] = b
    found["filter_gain"][0][rows, :sensors] = gain / noise
    found["sensor_from_coordinate"][0][:sensors, :n] = show[:, :n]
    found["innovation"] = noise**2 * variance
    found["mean_pole"] = -math.expm1(-1.0 / (MEAN * model.rate))
    found["duration"] = max(round(TRIAL * model.rate), LEAST_TRIAL)
    return found


def _filter(a: Array, c: Array, wander: float) -> tuple[Array, float]:
    """Stationary Kalman gain before the step, and largest variance of an innovation, for sensors of unit noise."""
    from scipy.linalg import solve_discrete_are  # only designs need it

    n = len(a) // 3
    process = np.diag(np.r_[np.zeros(2 * n), np.full(n, wander**2)])
    covariance = solve_discrete_are(a.T, c.T, process, np.eye(len(c)))
    innovation = c @ covariance @ c.T + np.eye(len(c))
    return covariance @ c.T @ np.linalg.inv(innovation), float(innovation.diagonal().max())


@kernel
def advance_model(gains, k, force0, force1):
    """Advance model k by a sample, under the force that acts."""
    s = record(gains, SENSOR_GAINS_T, 0)
    force0, force1 = force0 + s.models[k, 4], force1 + s.models[k, 5]
    for i in range(4):
        s.advanced[i] = s.step_force[i, 0] * force0 + s.step_force[i, 1] * force1
        for j in range(4):
            s.advanced[i] += s.step_state[i, j] * s.models[k, j]
    for i in range(4):
        s.models[k, i] = s.advanced[i]


@kernel
def correct_model(gains, k, error0, error1):
    """Correct model k by the innovations of both sensors."""
    s = record(gains, SENSOR_GAINS_T, 0)
    for i in range(6):
        s.models[k, i] += s.filter_gain[i, 0] * error0 + s.filter_gain[i, 1] * error1


@kernel
def model_sensor(gains, k, i):
    """What sensor i shows of model k."""
    s = record(gains, SENSOR_GAINS_T, 0)
    return s.sensor_from_coordinate[i, 0] * s.models[k, 0] + s.sensor_from_coordinate[i, 1] * s.models[k, 1]


@kernel
def start_trial(gains):
    """Start a trial: p goes on from the filter's state, whatever the sensors show."""
    s = record(gains, SENSOR_GAINS_T, 0)
    s.left, s.energy = s.duration, 0.0
    for i in range(6):
        s.models[1, i], s.models[2, i], s.models[3, i] = s.models[0, i], 0.0, 0.0
    for i in range(SENSORS):
        s.weighted[i] = s.weights[i, 0] = s.weights[i, 1] = 0.0


@kernel
def judge_gains(gains):
    """Find both gains; sensors out of bounds, as bits, if they explain the innovations of the trial."""
    s = record(gains, SENSOR_GAINS_T, 0)
    w, b, noise, outside = s.weights, s.weighted, s.innovation, 0
    w00, w11 = w[0, 0] + noise, w[1, 1] + noise  # a sensor that shows nothing keeps its gain
    scale = 1.0 / (w00 * w11 - w[0, 1] * w[0, 1])
    g0, g1 = scale * (w11 * b[0] - w[0, 1] * b[1]), scale * (w00 * b[1] - w[0, 1] * b[0])
    rest = s.energy - 2.0 * (g0 * b[0] + g1 * b[1])
    rest += g0 * g0 * w[0, 0] + 2.0 * g0 * g1 * w[0, 1] + g1 * g1 * w[1, 1]
    s.gain[0], s.gain[1] = 1.0 + g0, 1.0 + g1
    if g0 * g0 > CERTAIN * scale * w11 * noise and not LEAST_GAIN < s.gain[0] < MOST_GAIN:
        outside |= 1
    if g1 * g1 > CERTAIN * scale * w00 * noise and not LEAST_GAIN < s.gain[1] < MOST_GAIN:
        outside |= 2
    return outside if rest < UNEXPLAINED * s.energy else 0


@kernel
def follow_trial(gains):
    """Add a sample to the sums of a trial."""
    s = record(gains, SENSOR_GAINS_T, 0)
    w00, w01 = model_sensor(gains, 1, 0) - model_sensor(gains, 2, 0), -model_sensor(gains, 2, 1)
    w10, w11 = -model_sensor(gains, 3, 0), model_sensor(gains, 1, 1) - model_sensor(gains, 3, 1)
    correct_model(gains, 2, w00, w01)
    correct_model(gains, 3, w10, w11)
    s.weights[0, 0] += w00 * w00 + w01 * w01
    s.weights[0, 1] += w00 * w10 + w01 * w11
    s.weights[1, 1] += w10 * w10 + w11 * w11
    s.weighted[0] += w00 * s.e[0] + w01 * s.e[1]
    s.weighted[1] += w10 * s.e[0] + w11 * s.e[1]
    s.energy += s.e[0] * s.e[0] + s.e[1] * s.e[1]
    s.left -= 1


@kernel
def check_gains(gains, sensed, sensors, force0, force1):
    """Sensors whose gain has changed, as bits; `force0` and `force1` (N) act from this sample on."""
    s = record(gains, SENSOR_GAINS_T, 0)
    jump, changed = False, 0
    for i in range(sensors):
        s.e[i] = sensed[i] - model_sensor(gains, 0, i)
        square = s.e[i] * s.e[i]
        jump |= square > JUMP * max(s.innovation, s.mean[i])
        s.mean[i] += s.mean_pole * (square - s.mean[i])
    if jump and s.left == 0:
        start_trial(gains)
    if s.left > 0:
        follow_trial(gains)
        changed = judge_gains(gains) if s.left == 0 else 0
        advance_model(gains, 1, force0, force1)
        advance_model(gains, 2, 0.0, 0.0)
        advance_model(gains, 3, 0.0, 0.0)
    correct_model(gains, 0, s.e[0], s.e[1])
    advance_model(gains, 0, force0, force1)
    return changed


@kernel
def start_gains(gains, heave, rocking, force0, force1):
    """Start the filter at rest at the coordinates that the sensors show, under `force0` and `force1` (N)."""
    s = record(gains, SENSOR_GAINS_T, 0)
    s.models[0, 0], s.models[0, 1], s.models[0, 4], s.models[0, 5] = heave, rocking, force0, force1
