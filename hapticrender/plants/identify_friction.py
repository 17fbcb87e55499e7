"""Identify a friction device through any driver: the resonance of an ultrasonic plate, the gain of a screen.

The resonance is fitted to the free plate's response to lines of equal voltage around the expected one (output error)::

    X = N e^(-jw tau)/(m (w0^2 - w^2 + j w w0/Q)) sinc(w T/2) U

A screen's friction under a sliding finger of known load W is a linear regression on that load and on the current::

    F = mu W + mu g I^2 - c dI^2/dt,  I^2 = I0^2 (1 + cos w t)/2

in which c stands for delay and contact lag.  Intervals of the resonance are those of white residuals.  What a screen's
model leaves (turns of the finger, skin) is not white: its intervals come from the scatter of the scores of whole
periods of the modulation (the cluster-robust covariance of Liang & Zeger 1986).
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from hapticrender.checks import require
from hapticrender.driver_checks import check_channels, check_driver
from hapticrender.errors import DesignError
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.fitting import as_real
from hapticrender.plants.identify import SIGMAS_95, Estimate, check_range, play
from hapticrender.plants.ultrasonic_surface import SurfaceParameters
from hapticrender.protocols import Array, Driver
from hapticrender.touch.finger import Finger

REACH, GRID = 0.02, 10.0  # share of the expected resonance, Hz: range and spacing of the lines
RING = 10.0  # time constants of the expected mode that the drive lasts before the record
SHARE = 0.2  # of the drive's limit: largest drive of the lines
MODULATION = 5.0  # Hz: of the current of a screen; what c leaves of a lag of 0.4 ms is 1e-4 of the gain (20 Hz: 1e-3)
ONE = {1: "to identify a friction device"}  # channel
UNKNOWNS = 3  # of a screen: mu, mu g, c
LATE = 0.5  # samples: largest difference of the delay from the driver's
UNEXPLAINED = 0.1  # largest share of the response that the model may leave


class IdentifiedDevice(NamedTuple):
    """Identified parameters of a friction device, each with its 95 % interval."""

    estimates: Mapping[str, Estimate]
    unexplained: float  # share of the measurement that the model leaves, noise included

    def profile(self) -> dict[str, float]:
        """Return the identified parameters for `Scene.profile`."""
        return {name: each.value for name, each in self.estimates.items()}

    def uncertainty(self) -> dict[str, float]:
        """Return the standard uncertainties of the parameters, in their units, for a `DeviceProfile`."""
        return {name: each.interval / SIGMAS_95 for name, each in self.estimates.items()}

    def text(self) -> str:
        """Return every estimate with its interval, and what the model leaves of the measurement."""
        rows = [f"{name:<21} {each.value:>12.6g} +- {each.interval:.2g}" for name, each in self.estimates.items()]
        return "\n".join([*rows, f"{'unexplained':<21} {100 * self.unexplained:.2g} %"])


def identify_resonance(driver: Driver, parameters: SurfaceParameters, seconds: float = 0.2) -> IdentifiedDevice:
    """Identify frequency (Hz), Q and force per volt (N/V, at the expected modal mass) of a plate without a finger.

    The open driver takes V and senses m at the carrier's rate; a resonance within 2 % of the expected one is found.
    """
    mode, rate = parameters.mode, float(driver.rate)
    check_driver(driver)
    check_channels(driver, ONE, ONE)
    if rate <= (least := 2 * (1 + REACH) * mode.frequency):
        raise ValueError(
            f"driver.rate = {rate:g} Hz: must be > {least:g} Hz, twice the highest line around the resonance"
        )
    samples, start = round(seconds * rate), round(RING * mode.quality / (math.pi * mode.frequency) * rate)
    base = rate / samples
    bins = np.arange((1 - REACH) * mode.frequency, (1 + REACH) * mode.frequency, GRID) / base
    bins = np.unique(np.round(bins).astype(int))
    phase = -np.pi * np.arange(len(bins)) ** 2 / len(bins)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[bins] = np.exp(1j * phase)
    drive = np.fft.irfft(spectrum, samples)
    drive *= SHARE * mode.drive_limit / abs(drive).max()
    played = play(driver, drive[np.arange(-start, samples) % samples, None]).sensed[start:]
    check_range(played, mode.sensor_range / 2, "m")
    u, y = (np.fft.rfft(signal)[bins] * (2 / samples) for signal in (drive, played[:, 0]))
    w = 2 * np.pi * bins * base
    u = u * np.sinc(w / rate / (2 * np.pi)) * np.exp(-1j * w * (driver.delay - driver.block + 0.5) / rate)

    expected = np.array([2 * np.pi * mode.frequency, mode.quality, mode.force_constant])

    def response(x: Array) -> Array:
        w0, quality, force = expected * np.exp(x[:3])
        return force / mode.modal_mass / (w0**2 - w**2 + 1j * w * w0 / quality) * np.exp(-1j * w * x[3] / rate)

    scale = abs(y).max()
    if scale == 0.0:
        raise DesignError("sensed no motion at any line of the drive: check the sensor's connection")
    begin = np.array([math.log(w[abs(y / u).argmax()] / expected[0]), 0.0, 0.0, 0.0])
    begin[2] = math.log(abs(y / u).max() / abs(response(begin)).max())
    peak = abs(y).argmax()
    begin[3] = np.angle(response(begin) * u / y)[peak] / w[peak] * rate
    fit = least_squares(lambda x: as_real(response(x) * u - y) / scale, begin, xtol=1e-12, ftol=1e-12)
    spread = _spread(fit.jac, fit.fun, np.arange(len(fit.fun)))
    values = np.exp(fit.x[:3]) * [mode.frequency, mode.quality, mode.force_constant]
    names = ("frequency", "quality", "force_constant")
    found = _found(type(parameters), names, values, values * spread[:3], fit.fun, as_real(y) / scale)
    turn, late = rate / values[0], fit.x[3]
    if not abs(late) <= LATE:
        raise DesignError(
            f"sensed {abs(late):.2g} samples {'later' if late > 0 else 'earlier'} than driver.delay = {driver.delay} "
            f"says: must be within {LATE:g}; state its delay (which may differ by whole turns of the carrier, "
            f"{turn:.3g} samples); or, at about {turn / 2:.2g}, half a turn, the sensor may be inverted"
        )
    return found


def identify_screen(
    driver: Driver, parameters: ElectroadhesionParameters, finger: Finger, seconds: float = 2.0
) -> IdentifiedDevice:
    """Identify friction coefficient and gain g (N/A^2) of a screen under a finger that slides over it.

    The open driver takes the envelope of the current (A, peak) and senses friction (N, of any sign);
    `finger` gives load and position where it does not measure them.
    """
    rate, most = float(driver.rate), parameters.current_limit / 2
    for name, known in (("sensor", "tribometer"), ("drive_kind", "current")):
        value = getattr(parameters, name)
        require(value == known, f"device.{name}", value, f"{known!r} to identify a screen")
    check_driver(driver)
    check_channels(driver, ONE, ONE)
    time = np.arange(round(seconds * rate)) / rate
    phase = 2 * np.pi * MODULATION * (time - (driver.delay - driver.block) / rate)
    drive = most * np.sqrt((1 + np.cos(2 * np.pi * MODULATION * time)) / 2)
    sensed = play(driver, drive[:, None])
    position = finger.position(time) if sensed.position is None else sensed.position
    load = finger.load(time) if sensed.normal_load is None else sensed.normal_load
    sliding = abs(np.gradient(position, 1 / rate)) >= parameters.least_speed  # NaN, lifted, is not
    sliding[: round(rate / MODULATION)] = False
    period = np.flatnonzero(sliding) // round(rate / MODULATION)
    if not sliding.any():
        raise DesignError(f"finger: must slide faster than {parameters.least_speed:g} m/s while the screen is measured")
    if len(np.unique(period)) <= UNKNOWNS:  # scores of the periods add to zero: of one there would be no scatter
        enough = f"more than {UNKNOWNS} periods of {1 / MODULATION:g} s, of which the first does not count"
        raise DesignError(f"finger: must slide in {enough}, for intervals of what is found")
    columns = np.column_stack([load, most**2 * (1 + np.cos(phase)) / 2, most**2 * np.sin(phase)])[sliding]
    check_range(np.where(sliding[:, None], sensed.sensed, 0.0), parameters.force_range, "N")
    friction = abs(sensed.sensed[sliding, 0])  # as `render` takes it: it may keep the sign of the lateral force
    found = np.linalg.lstsq(columns, friction, rcond=None)[0]
    residual = friction - columns @ found
    mu, gain = found[0], found[1] / found[0]
    spread = _spread(columns, residual, period)
    values = np.array([mu, gain])
    halves = np.array([spread[0], gain * math.hypot(spread[1] / found[1], spread[0] / mu)])
    changing = columns[:, 1:] @ found[1:]
    names = ("friction_coefficient", "open_loop_gain")
    return _found(type(parameters), names, values, halves, residual, changing - changing.mean())


def _spread(jacobian: Array, residual: Array, group: Array) -> Array:
    """Half-widths of the 95 % intervals of a least-squares fit; residuals may depend on each other within a `group`."""
    inverse, groups = np.linalg.inv(jacobian.T @ jacobian), np.unique(group)
    scores = np.stack([(jacobian[group == each] * residual[group == each, None]).sum(axis=0) for each in groups])
    covariance = inverse @ (scores.T @ scores) @ inverse
    return SIGMAS_95 * np.sqrt(np.diagonal(covariance) * len(groups) / max(len(groups) - jacobian.shape[1], 1))


def _found(
    parameters: type[SurfaceParameters | ElectroadhesionParameters],
    names: tuple[str, ...],
    values: Array,
    halves: Array,
    residual: Array,
    signal: Array,
) -> IdentifiedDevice:
    """Estimates, unless the model leaves too much of the signal, or no device has such `parameters`."""
    unexplained = float(np.sqrt((residual**2).mean() / (signal**2).mean()))
    if not unexplained <= UNEXPLAINED:
        raise DesignError(
            f"unexplained response = {100 * unexplained:.3g} %: must be <= {100 * UNEXPLAINED:g} %; check connections "
            "and [device]"
        )
    pairs = (Estimate(float(value), float(half)) for value, half in zip(values, halves, strict=True))
    found = IdentifiedDevice(dict(zip(names, pairs, strict=True)), unexplained)
    try:
        parameters.with_overrides(found.profile())
    except ValueError as error:
        raise DesignError(f"identified {error}; check connections and [device]") from error
    return found
