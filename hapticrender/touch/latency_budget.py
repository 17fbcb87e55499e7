"""Phase error of a grating, end to end: from a late, noisy sensor of the finger to the texture that is played.

A texture over position is played at 2 pi x/wavelength, so an error dx of the position is a phase error of
360 degrees dx/wavelength.  The estimator of `hapticrender.touch.motion_estimator` has settled on samples every T with
the gain k.  Its estimate and the correction that is still being faded in (two poles of tau, `PanelReader`) are linear::

    z[n] = A z[n-1] + B y[n],   z = [x, v, a, c1, c2],   x_played(t_n + h) = C(h) z[n]

so a swipe X sin(w t), X = V/w, leaves the error X (C(h) (e^{jwT} I - A)^-1 e^{jwT} B - e^{jwh}), and white noise of
variance R the variance R C(h) S C(h)^T, S = A S A^T + B B^T.  h runs from the latency over a sample's time, and longer
after a lost one.  Both are exact for the filter at its constant gain; gate, irregular times and lifts are left out.
"""

import math
from itertools import product

import numpy as np

from hapticrender.checks import number, require
from hapticrender.protocols import Array
from hapticrender.touch.motion_estimator import FREQUENCY, SPEED, MotionEstimator, jerk_covariance, transition
from hapticrender.touch.touch_panel import SMOOTHING, TouchPanel

AGES = (np.arange(16) + 0.5) / 16  # of a sample's time: ages over which errors are averaged
MOST_LOST = 1e-4  # longer runs of lost samples, of a smaller share, are left out


def settled_gain(estimator: MotionEstimator, rate: float, speed: float = 0.0) -> Array:
    """Gain k, shape (3,), after many samples at `rate` (Hz) at `speed` (m/s rms).

    In units of T and of the samples' standard deviation, in which the Riccati equation is well conditioned.
    """
    from scipy.linalg import solve_discrete_are

    step, variance = 1.0 / number("rate", rate, "Hz", above=0.0), estimator.variance + (speed * estimator.jitter) ** 2
    jerk = jerk_covariance(1.0, estimator.density * step**5 / variance)
    predicted = solve_discrete_are(transition(1.0).T, np.eye(3)[:, :1], jerk, np.eye(1))
    return np.asarray(predicted[:, 0] / (predicted[0, 0] + 1.0) / step ** np.arange(3))


def _system(gain: Array, step: float, latency: float = 0.0) -> tuple[Array, Array]:
    """A (5, 5) and B (5,) of the module."""
    a, b = np.zeros((5, 5)), np.zeros(5)
    a[:3, :3], b[:3] = (np.eye(3) - np.outer(gain, [1.0, 0.0, 0.0])) @ transition(step), gain
    jump = -transition(latency)[0] @ gain  # of the position that is played, per innovation, at the sample's arrival
    a[3:, :3], b[3:] = -jump * transition(step)[0], jump
    a[3:, 3:] = math.exp(-step / SMOOTHING) * np.array([[1.0, 0.0], [step / SMOOTHING, 1.0]])
    return a, b


def position_error(
    panel: TouchPanel,
    speed: float = SPEED,
    *,
    frequency: float = FREQUENCY,
    delay: float = 0.0,
    predicted: bool = True,
) -> float:
    """Error of the position at which a texture is played (m rms), for a swipe and all its reversals.

    `speed` (m/s, >= 0) is the peak of a sinusoidal swipe of `frequency` (Hz, > 0); `delay` (s, >= 0) is that behind the
    sensor, from an estimate to the surface, as far as the device's own loop does not predict it.  Where it is not
    `predicted`, the last sample is played as it is, without an estimator.
    """
    require(isinstance(panel, TouchPanel), "panel", panel, "a TouchPanel", TypeError)
    speed = number("speed", speed, "m/s", least=0.0)
    omega, step = 2 * math.pi * number("frequency", frequency, "Hz", above=0.0), 1.0 / panel.rate
    late = panel.latency + number("delay", delay, "s", least=0.0)
    amplitude, rms = speed / omega, speed / math.sqrt(2.0)
    estimator, square, weight = panel.estimator(), 0.0, 0.0
    variance = estimator.variance + (rms * panel.jitter) ** 2
    if predicted:
        from scipy.linalg import solve_discrete_lyapunov

        a, b = _system(settled_gain(estimator, panel.rate, rms), step, late)
        turn = np.exp(1j * omega * step)
        played = np.linalg.solve(turn * np.eye(5) - a, turn * b)
        spread = solve_discrete_lyapunov(a, np.outer(b, b), method="bilinear")  # the direct one warns of units
    shares = [1.0 - panel.dropouts]  # of the time, by the samples that were lost since the last one
    while shares[-1] * panel.dropouts > MOST_LOST:
        shares.append(shares[-1] * panel.dropouts)
    for (lost, share), part in product(enumerate(shares), AGES):
        age = (lost + part) / panel.rate  # of the last sample (s), beside its latency
        u = age / SMOOTHING
        row = np.r_[transition(late + age)[0], u * math.exp(-u), math.exp(-u)]  # C(h)
        found, noise = (row @ played, row @ spread @ row) if predicted else (1.0, 1.0)
        bias = 0.5 * (amplitude * abs(found - np.exp(1j * omega * (late + age)))) ** 2
        square, weight = square + share * (bias + variance * noise), weight + share
    return math.sqrt(square / weight)


def phase_error(panel: TouchPanel, speed: float, wavelength: float, **path: float) -> float:
    """Phase error of a grating of `wavelength` (m), in degrees rms; `speed` and `path` as for `position_error`."""
    turn = number("wavelength", wavelength, "m", above=0.0)
    return 360.0 * position_error(panel, speed, **path) / turn  # type: ignore[arg-type]


def finest_wavelength(panel: TouchPanel, speed: float, *, degrees: float = 30.0, **path: float) -> float:
    """Finest grating (m) with a phase error of `degrees` rms at the peak `speed` (m/s)."""
    return position_error(panel, speed, **path) / (number("degrees", degrees, above=0.0) / 360.0)  # type: ignore[arg-type]
