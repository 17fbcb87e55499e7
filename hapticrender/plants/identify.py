"""Knowing the plate: what it is made of, found through any driver while no finger is on it.

A second of multi-sine (`multisine.py`) is played, and the sampled plate is
fitted to the spectra of what was sent and sensed (`fitting.py`).

A common gain error c of both sensors cannot be told from a plate that is
1/(1 + c) times as heavy, stiff and damped: motion knows force only through
the drive.  It is a scale, which no control law could notice either.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from hapticrender.control.bandmodel import BandModel
from hapticrender.errors import DesignError, PlateMismatch
from hapticrender.plants.fitting import (
    DELAY,
    GAIN,
    MECHANICAL,
    ROUNDING,
    Fit,
    Record,
    equation_error,
    gains,
    measured_lines,
    output_error,
    spectra,
    static_load,
    variances,
)
from hapticrender.plants.multisine import PATTERNS, Multisine, design_multisine
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array, Driver, Flag

NAMES = (*MECHANICAL, "delay", "gain_difference")
UNITS = dict(zip(NAMES, ("kg", "kg m2", "N/m", "N/m", "N s/m", "N s/m", "samples", "1"), strict=True))
RAMP = 0.05  # s: the drive grows and fades this long
SIGMAS_95 = 1.96
CLEAR = 10.0  # amplitude of the lines over what lies between them: below it there is nothing to fit
UNEXPLAINED = 0.01  # of the motion: beyond it this is no free plate
CONTACT = 0.05  # N
DIFFERS = 2.0  # half-widths of the 95 % interval: a chance of 1e-4 for each number
ABSORBED = MappingProxyType(  # relative, delay in samples: what the controller takes without a loss worth a warning
    {
        **dict.fromkeys(MECHANICAL[:4], 0.01),
        **dict.fromkeys(MECHANICAL[4:], 0.1),
        "delay": 0.25,
        "gain_difference": 0.01,
    }
)


class Estimate(NamedTuple):
    """A number and the half-width of its 95 % interval, in the same unit."""

    value: float
    interval: float


class Difference(NamedTuple):
    """A number that differs by more than chance; `interval` is the half-width of 95 % around the difference."""

    name: str
    met: float
    designed: float
    interval: float

    def __str__(self) -> str:
        change = self.met - self.designed
        if self.name in MECHANICAL and self.designed:
            relative = 100 / self.designed
            return f"{self.name} {change * relative:+.2f} +- {abs(self.interval * relative):.2f} %"
        return f"{self.name} {change:+.4f} +- {self.interval:.4f} {UNITS[self.name]}".removesuffix(" 1")


@dataclass(frozen=True, kw_only=True)
class Identified:
    """The plate as it was found.

    Parameters
    ----------
    parameters : PlateParameters
        The plate with the found numbers in it; `delay` in whole samples, sensors alike.
    estimates : mapping of str to Estimate
        Every name of `NAMES`: mass (kg), inertia (kg m2), stiffness_1 and _2 (N/m), damping_1 and _2 (N s/m), delay
        (samples, of the whole loop, fractions included) and gain_difference (sensor 2 less sensor 1, over their mean).
        The scale of both sensors is taken for right: it cannot be found.
    frequency : ndarray, shape (n,), Hz
        Lines of the multi-sine.
    coordinate : ndarray of int, shape (n,)
        What each line drove: 0 heave (both coils alike), 1 rocking (coils against each other).
    lines : ndarray of complex, shape (n, 2), m/A
        Measured heave and rocking per coil current, hold and delay taken out.
    noise : float, m rms
        White noise of a sensor, measured between the lines.
    residual : float, m rms
        Motion of an end that the model leaves unexplained beyond the noise.
    misfit : float
        Residual on the lines over the noise between them; 1 where the model explains all.
    misfit_bound : float
        What chance alone would not exceed.
    load : float, N
        Static load on the plate.
    """

    parameters: PlateParameters
    estimates: Mapping[str, Estimate]
    frequency: Array
    coordinate: Array
    lines: Array
    noise: float
    residual: float
    misfit: float
    misfit_bound: float
    load: float

    @property
    def explained(self) -> bool:
        """Whether what the model leaves is no more than noise."""
        return self.misfit <= self.misfit_bound

    def band_model(self, rate: float | None = None, delay: int | None = None) -> BandModel:
        """What the controller may know of this plate, its sensors made equal; as identified unless told otherwise."""
        parameters = self.parameters
        model = parameters.band_model(rate or parameters.rate, parameters.delay if delay is None else delay)
        difference = self.estimates["gain_difference"].value
        return replace(model, coordinate_from_sensed=model.coordinate_from_sensed / gains(difference))

    def response(self, frequency: Array) -> Array:
        """Look-up table of the plate as measured: heave and rocking per coil current, without hold and delay.

        Between the lines it follows the found plate, shifted by what the
        measured lines differ from it; at each line it is the measured one in
        what that line drove, and beyond the first and the last it is the found
        plate's.

        Parameters
        ----------
        frequency : array_like, shape (...), Hz
            Where to read it.

        Returns
        -------
        ndarray of complex, shape (..., 2, 2), m/A
            Coordinates (rows) per coil (columns), as `BandModel.response`.
        """
        model = self.band_model()
        found = model.response(self.frequency) @ PATTERNS
        columns = []
        for pattern in range(2):
            driven = self.coordinate == pattern
            off = self.lines[driven] - found[driven, :, pattern]
            where = self.frequency[driven]
            columns.append(
                np.stack([np.interp(frequency, where, each, left=0.0, right=0.0) for each in off.T], axis=-1)
            )
        return model.response(frequency) + np.stack(columns, axis=-1) @ np.linalg.inv(PATTERNS)

    def text(self) -> str:
        """Every number with its interval, and how well the model explains what was sensed."""
        rows = [
            f"{name:<16} {estimate.value:>12.6g} +- {estimate.interval:.2g} {UNITS[name]}".removesuffix(" 1")
            for name, estimate in self.estimates.items()
        ]
        modes, _ = self.parameters.modes()
        verdict = "no more than noise" if self.explained else f"more than noise ({self.misfit_bound:.2f})"
        return "\n".join(
            [
                *rows,
                f"{'modes':<16} {modes[0]:.2f} Hz, {modes[1]:.2f} Hz",
                f"{'sensor noise':<16} {1e6 * self.noise:.3f} um rms",
                f"{'unexplained':<16} {1e6 * self.residual:.3f} um rms, misfit {self.misfit:.2f}: {verdict}",
                "intervals are 95 %; a gain error common to both sensors scales all of them and cannot be seen",
            ]
        )


def identify(
    driver: Driver,
    parameters: PlateParameters,
    *,
    seconds: float = 1.0,
    wait: float = 0.3,
    amplitude: float = 100e-6,
    find_gains: bool = True,
    contact: float = CONTACT,
    unexplained: float = UNEXPLAINED,
) -> Identified:
    """Find what the plate behind a driver is made of, while no finger is on it.

    The driver must be open, so call this inside its ``with`` statement; it
    stays open, at zero drive.

    Parameters
    ----------
    driver : Driver
        Any driver of a plate: two coils, two sensors.
    parameters : PlateParameters
        The plate as it is believed to be, from which the drive is made; electronics, geometry and the bending of the
        glass are taken as known.
    seconds : float, s
        Length of the record, enough to resolve the narrowest mode.
    wait : float, s, >= 2 * 0.05
        From the first drive to the record; delays up to wait - 0.05 s are found.
    amplitude : float, m, > 0
        Largest displacement of a glass end, on the plate as believed.
    find_gains : bool
        Whether to look for a gain difference of the sensors; without, they are taken to be equal.
    contact : float, N, > 0
        Static load from which on the plate counts as touched.
    unexplained : float, > 0
        Share of the motion from which on what the model leaves says that something touches, or that this is no such
        plate.

    Returns
    -------
    Identified
        Numbers, intervals, and the measured response.

    Raises
    ------
    ValueError
        Too short a record, too large a motion, or a driver that is no plate's; nothing has been played.
    DesignError
        What was sensed is no free plate's answer: a finger on it, samples lost, clipped or not finite, hardly any
        motion, or motion that the model cannot explain.
    DriverError
        The device failed; zero drive was sent if it still took any.

    Notes
    -----
    Gauss-Newton on the output error, begun from the equation error, which is linear in m, I, k and b and is tried at
    every whole delay.  With 1 um of noise at 5 kHz, 1 s of 100 um gives m, I and k to 0.05 %, b to 0.25 %, the delay
    to 0.002 samples and the gain difference to 0.001 (95 % intervals); they shrink as 1/amplitude and as
    1/sqrt(seconds).

    What the model cannot tell shows in `misfit`: gains of +-2 % taken for equal leave 2 % of the motion, a bending
    mode at 1.2 kHz taken for rigid leaves 0.8 % (and moves m, I and k by 0.25 %), a command of 10 bits taken for 12
    leaves 1 %.
    """
    rate = float(driver.rate)
    parameters = replace(parameters, rate=rate)
    samples = _samples(driver, seconds, wait)
    sine = design_multisine(parameters, rate, samples, amplitude)
    start, fade = round(wait * rate), round(RAMP * rate)
    sensed = _play(driver, _whole_drive(sine, start, fade))[start : start + samples]
    _check_sensed(sensed, parameters)
    record = spectra(rate, sine, sensed)
    _check_moved(record, amplitude)
    plate, late = equation_error(parameters, record, round((wait - RAMP) * rate))
    try:
        fit = output_error(plate, late, record, find_gains=find_gains)
    except np.linalg.LinAlgError as error:
        raise DesignError(f"{seconds=:g} s: the record does not tell all that is looked for") from error
    return _judged(fit, record, sine, block=driver.block, contact=contact, unexplained=unexplained)


def _samples(driver: Driver, seconds: float, wait: float) -> int:
    """Length of the record in samples, after the checks of what was asked."""
    for name in ("drive_channels", "sensed_channels"):
        if getattr(driver, name) != 2:
            raise ValueError(f"{type(driver).__name__}: {name}={getattr(driver, name)}: must be 2, a plate's")
    for name, value, least in (("seconds", seconds, 0.0), ("wait", wait, 2 * RAMP)):
        if not (math.isfinite(value) and value >= least):
            raise ValueError(f"{name} = {value!r}: must be >= {least:g} s")
    return round(seconds * driver.rate)


def _whole_drive(sine: Multisine, start: int, fade: int) -> Array:
    """Drive with a smooth beginning, a record from sample `start` on, and a smooth end (A, shape (n, 2))."""
    samples = len(sine.drive)
    turn = np.arange(-start, samples + fade)
    envelope = np.ones(len(turn))
    envelope[:fade] = np.sin(0.5 * np.pi * np.arange(fade) / fade) ** 2
    envelope[len(turn) - fade :] = envelope[:fade][::-1]
    return sine.drive[turn % samples] * envelope[:, None]


def _play(driver: Driver, drive: Array) -> Array:
    """Play all of it in the driver's blocks, zero to the end of the last one and one more; return what was sensed."""
    block = driver.block
    rest = np.zeros((block, 2))
    padded = np.concatenate([drive, np.zeros((-len(drive) % block + block, 2))])
    sensed = []
    try:
        for start in range(0, len(padded), block):
            answer = driver.play(padded[start : start + block])
            flags = 0 if answer.flags is None else np.bitwise_or.reduce(np.asarray(answer.flags, np.int64))
            if flags & (Flag.SATURATED | Flag.SENSOR_CLIPPED | Flag.OVERRUN):
                raise DesignError(
                    f"sample {start}: the device reports {Flag(int(flags))!r}: nothing can be told from it"
                )
            sensed.append(np.array(answer.sensed, float))
    except BaseException as error:
        try:
            driver.play(rest)
        except Exception as late:
            error.add_note(f"and while sending zero drive: {late}")
        raise
    return np.concatenate(sensed)


def _check_sensed(sensed: Array, parameters: PlateParameters) -> None:
    """Refuse what no sensor shows, or what a sensor shows at the end of its range."""
    bound = parameters.sensor_range / 2
    with np.errstate(invalid="ignore"):
        bad = np.argwhere(~(abs(sensed) < bound))
    if len(bad):
        sample, channel = bad[0]
        raise DesignError(
            f"sensor {channel + 1}: {sensed[sample, channel]:g} m at sample {sample}: must be within +-{bound:g} m"
        )


def _check_moved(record: Record, amplitude: float) -> None:
    """Refuse a record in which the lines do not stand out."""
    moved, noise = (math.sqrt((abs(record.sensed[bins]) ** 2).mean()) for bins in (record.on_line, record.between))
    if not moved > CLEAR * noise:
        raise DesignError(
            f"{amplitude=:g} m: the lines stand {moved:.3g} m high, must be > {CLEAR * noise:.3g} m, {CLEAR:g} times "
            "what lies between them: the plate does not answer, or moves by itself"
        )


def _judged(fit: Fit, record: Record, sine: Multisine, *, block: int, contact: float, unexplained: float) -> Identified:
    """Noise, intervals and load of a fit; refuses what is no free plate."""
    lines = record.on_line
    load = static_load(fit)
    on_lines, noise, bound = variances(fit, record)
    misfit = math.sqrt(on_lines / noise)
    excess = 2 * max(on_lines - noise, 0.0)
    share = math.sqrt(excess / (abs(record.sensed[lines]) ** 2).mean())
    if not (abs(load) <= contact and (misfit <= bound or share <= unexplained)):
        raise DesignError(
            f"static load = {load:.3g} N: must be within +-{contact:g} N, and unexplained motion = "
            f"{100 * share:.3g} %: must be <= {100 * unexplained:g} %; a finger is on the plate, or it is no such plate"
        )
    return Identified(
        parameters=replace(fit.plate, delay=max(round(fit.unknown[DELAY]) + block, 1)),
        estimates=_estimates(fit, block, max(on_lines, noise)),
        frequency=record.turn[lines] * record.rate,
        coordinate=sine.coordinate,
        lines=measured_lines(fit, record, sine),
        noise=math.sqrt(noise * record.samples / 2),
        residual=math.sqrt(excess * lines.sum() / 2),
        misfit=misfit,
        misfit_bound=bound,
        load=load,
    )


def _estimates(fit: Fit, block: int, variance: float) -> Mapping[str, Estimate]:
    """Values and intervals at a `variance` (m2) of every real number of the spectra."""
    mechanical = [getattr(fit.plate, name) for name in MECHANICAL]
    values = [*mechanical, fit.unknown[DELAY] + block, fit.unknown[GAIN]]
    spread = SIGMAS_95 * np.sqrt(np.diagonal(fit.covariance) * variance) * [*mechanical, 1.0, 1.0]
    pairs = (Estimate(float(value), float(half)) for value, half in zip(values, spread, strict=True))
    return MappingProxyType(dict(zip(NAMES, pairs, strict=True)))


def _numbers(plate: BandModel | PlateParameters, half_spacing: float) -> dict[str, float]:
    """Write the eight numbers of `NAMES` as a design holds them."""
    model = plate.band_model(plate.rate, plate.delay) if isinstance(plate, PlateParameters) else plate
    damping, tilt = model.damping[0]
    hold, skew = model.stiffness[0]
    gain = np.linalg.inv(model.coordinate_from_sensed)[:, 0]
    values = (
        model.mass[0, 0],
        model.mass[1, 1] * half_spacing**2,
        (hold - skew) / 2,
        (hold + skew) / 2,
        (damping - tilt) / 2,
        (damping + tilt) / 2,
        model.delay,
        2 * (gain[1] - gain[0]) / (gain[1] + gain[0]),
    )
    return {name: float(value) for name, value in zip(NAMES, values, strict=True)}


def compare(met: Identified | PlateParameters, designed: BandModel | PlateParameters) -> tuple[Difference, ...]:
    """Whether the plate that the controller meets is the one it was designed for.

    Parameters
    ----------
    met : Identified or PlateParameters
        The plate as found, or as it is known to be.
    designed : BandModel or PlateParameters
        What the controller was, or will be, designed from; the coils' spacing is taken from `met`.

    Returns
    -------
    tuple of Difference
        Numbers that differ by more than chance, twice the half-width of their 95 % interval (one in a thousand
        comparisons of equal plates names one); empty where the plate is the one.

    Warns
    -----
    PlateMismatch
        A difference is beyond chance even after what the controller absorbs without a loss worth a warning
        (`ABSORBED`: 1 % of m, I, k and gain, 10 % of b, a quarter of a sample).
    """
    own = met if isinstance(met, PlateParameters) else met.parameters
    if isinstance(met, PlateParameters):
        found: Mapping[str, Estimate] = {
            name: Estimate(value, ROUNDING * abs(value)) for name, value in _numbers(met, own.half_spacing).items()
        }
    else:
        found = met.estimates
    known = _numbers(designed, own.half_spacing)
    differences = tuple(
        Difference(name, estimate.value, known[name], estimate.interval)
        for name, estimate in found.items()
        if abs(estimate.value - known[name]) > DIFFERS * estimate.interval
    )
    grave = [each for each in differences if _beyond_absorbed(each)]
    if grave:
        warnings.warn(
            f"the plate is not the one that the controller was designed for: {'; '.join(map(str, grave))}",
            PlateMismatch,
            stacklevel=2,
        )
    return differences


def require_delay(met: Identified, designed: BandModel | PlateParameters) -> None:
    """Refuse a delay that the design does not know: two samples too many already make the loop diverge at 400 Hz.

    Parameters
    ----------
    met : Identified
        The plate as found.
    designed : BandModel or PlateParameters
        What the controller was, or will be, designed from.

    Raises
    ------
    DesignError
        The delays lie more than a quarter of a sample, and more than chance, apart.
    """
    found, known = met.estimates["delay"], float(designed.delay)
    if abs(found.value - known) > ABSORBED["delay"] + DIFFERS * found.interval:
        raise DesignError(
            f"delay = {found.value:.2f} samples: the controller is designed for {known:g}, must be within "
            f"{ABSORBED['delay']:g}; give the driver a delay of {round(found.value)}"
        )


def _beyond_absorbed(difference: Difference) -> bool:
    relative = abs(difference.designed) if difference.name in MECHANICAL else 1.0
    change = abs(difference.met - difference.designed)
    return change > ABSORBED[difference.name] * relative + DIFFERS * difference.interval
