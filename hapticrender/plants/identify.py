"""Identify the parameters of a free plate through any driver.

A multi-sine of a second (`multisine.py`) is played, and the sampled plate is fitted to the spectra of drive and
measurement (`fitting.py`), at first as rigid.  Where that leaves a bending mode, all is fitted once more with it.

A gain error c common to both sensors cannot be separated from a plate that is 1/(1 + c) times as heavy, stiff and
damped, since the force is known through the drive alone.  Every control law scales in the same way.
"""

import math
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from hapticrender.checks import require
from hapticrender.devices import naming_driver, open_driver, registered
from hapticrender.driver_checks import check_channels, check_driver, check_sensed
from hapticrender.errors import DesignError, noted_on
from hapticrender.plants.fitting import (
    BENDING,
    DELAY,
    GAIN,
    MECHANICAL,
    Fit,
    Record,
    fit_plate,
    sensor_gains,
    spectra,
    static_load,
    variances,
)
from hapticrender.plants.multisine import Multisine, design_multisine
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.process_signals import stopped_by_signal
from hapticrender.protocols import Array, Driver, Flag, Sensed
from hapticrender.touch.device_profile import Limits
from hapticrender.touch.finger import Finger

NAMES = (*MECHANICAL, "delay", "gain_difference")  # and `BENDING` where a mode was found
UNITS = {each.name: each.metadata["bounds"]["unit"] for each in fields(PlateParameters)} | {"gain_difference": ""}
RAMP = 0.05  # s: fade-in and fade-out of the drive
WAIT, LEAST_WAIT = 0.3, 0.25  # s, from the first drive to the record; from the first motion, behind a long delay
SIGMAS_95 = 1.96
STRANGE = 0.5  # of the limit of displacement, on the expected plate: the plate may be another one
CLEAR = 10.0  # least amplitude of the lines over the noise between them
UNEXPLAINED = 0.01  # largest share of the motion that the model may leave
TRIES = 10  # where samples are lost
CONTACT = 0.05  # N: largest static load
SIGNIFICANT = 2.0  # half-widths of the 95 % interval: exceeded by chance once in 10 000 numbers


class SamplesLost(DesignError):
    """Samples were lost on the way."""


class Estimate(NamedTuple):
    """An estimated value and the half-width of its 95 % interval, in the same unit."""

    value: float
    interval: float


@dataclass(frozen=True, kw_only=True)
class Identified:
    """An identified plate."""

    parameters: PlateParameters  # identified, `noise` too; `delay` in whole samples, sensor gains of the expected mean
    estimates: Mapping[str, Estimate]  # of `NAMES`, in `UNITS`; the delay is of the whole loop, fractions included
    bending_top: float  # Hz: up to here a bending mode was searched
    noise: float  # m rms: white noise of a sensor, from the median between the lines
    residual: float  # m rms: motion of an end that the model leaves unexplained beyond the noise
    misfit: float  # residual on the lines over the noise between them; 1 where the model explains all
    misfit_bound: float  # largest misfit by chance
    load: float  # N, static
    driver_delay: int  # samples, as the driver states it

    @property
    def explained(self) -> bool:
        """Whether the model leaves no more than noise."""
        return self.misfit <= self.misfit_bound

    def shortened(self, samples: int) -> "Identified":
        """Return this for a loop whose delay is so many samples shorter, such as that of a board without the host."""
        delay = self.estimates["delay"]
        return replace(
            self,
            parameters=replace(self.parameters, delay=max(self.parameters.delay - samples, 1)),
            estimates={**self.estimates, "delay": delay._replace(value=delay.value - samples)},
            driver_delay=self.driver_delay - samples,
        )

    def profile(self) -> dict[str, float]:
        """Return the identified parameters, and the others that differ from the defaults, for `Scene.profile`."""
        default = PlateParameters()
        bending = BENDING if "bending_coil" in self.estimates else BENDING[:1]
        identified = (*MECHANICAL, "delay", "sensor_gain_1", "sensor_gain_2", "sensor_noise", *bending)
        values = {each.name: getattr(self.parameters, each.name) for each in fields(PlateParameters)}
        return {name: value for name, value in values.items() if name in identified or value != getattr(default, name)}

    def uncertainty(self) -> dict[str, float]:
        """Return the standard uncertainties of identified parameters, in their units, for a `DeviceProfile`."""
        gain = self.estimates["gain_difference"].interval / 2 * sensor_gains(self.parameters)[0]
        intervals = {name: each.interval for name, each in self.estimates.items() if name != "gain_difference"}
        intervals |= {"sensor_gain_1": gain, "sensor_gain_2": gain}
        return {name: interval / SIGMAS_95 for name, interval in intervals.items()}

    def text(self) -> str:
        """Return every estimate with its interval, and how much the model explains of the measurement."""
        rows = [
            f"{name:<17} {estimate.value:>12.6g} +- {estimate.interval:.2g} {UNITS[name]}".rstrip()
            for name, estimate in self.estimates.items()
        ]
        modes, clear = self.parameters.modes()[0], self.significance
        clear_at = f"bending clear by {clear:.0f} standard deviations, at {self.parameters.bending_mass:g} kg"
        bending = clear_at if clear else f"no bending found up to {self.bending_top:.0f} Hz"
        verdict = "no more than noise" if self.explained else f"more than noise ({self.misfit_bound:.2f})"
        rows += [
            f"{'modes':<17} {modes[0]:.2f} Hz, {modes[1]:.2f} Hz; {bending}",
            f"{'sensor noise':<17} {1e6 * self.noise:.3f} um rms",
            f"{'unexplained':<17} {1e6 * self.residual:.3f} um rms, misfit {self.misfit:.2f}: {verdict}",
            "intervals are 95 %; a gain error common to both sensors scales all of them and cannot be identified",
        ]
        if self.parameters.delay != self.driver_delay:
            rows.append(
                f"driver.delay = {self.driver_delay} samples: measured {self.estimates['delay'].value:.2f}, set it to "
                f"{self.parameters.delay}"
            )
        return "\n".join(rows)

    @property
    def significance(self) -> float:
        """Shape at the coils of the bending mode over its standard deviation; 0 where none was found."""
        coil = self.estimates.get("bending_coil", Estimate(0.0, 1.0))
        return abs(coil.value) / coil.interval * SIGMAS_95

    def differences(self, designed: PlateParameters) -> tuple[str, ...]:
        """State every estimate that differs from `designed` by more than twice its interval, and by how much."""
        expected = {name: float(getattr(designed, name)) for name in (*MECHANICAL, "delay", *BENDING)}
        expected["gain_difference"] = sensor_gains(designed)[1]
        found = []
        for name, (value, interval) in self.estimates.items():
            change, known = value - expected[name], expected[name]
            if abs(change) > SIGNIFICANT * interval:
                share = known != 0.0 and name in (*MECHANICAL, *BENDING)
                scale, digits, unit = (100.0 / known, 2, "%") if share else (1.0, 4, UNITS[name])
                text = f"{name} {change * scale:+.{digits}f} +- {abs(interval * scale):.{digits}f} {unit}"
                found.append(text.rstrip())
        return tuple(found)


def identify(
    driver: Driver | str,
    parameters: PlateParameters,
    *,
    seconds: float = 1.0,
    amplitude: float = 100e-6,
    limits: Limits = Limits(),  # noqa: B008 - frozen
) -> Identified:
    """Identify the free plate behind a driver from the response to a multi-sine.

    A driver must be open, so call this inside its ``with`` statement; it stays open, at zero drive.

    Parameters
    ----------
    driver : Driver or str
        Any driver of a plate: two coils, two sensors; or a text as ``--driver`` takes it, opened and closed here.
    parameters : PlateParameters
        Expected plate; electronics, geometry, the mean of the sensor gains and the modal mass of a bending mode, which
        only scales its shape at the coils, are taken as given.
    seconds : float, s
        Length of the record, enough to resolve the narrowest mode.  It begins 0.3 s after the first drive, later where
        the driver's delay is above 0.05 s: delays of 0.25 s are identified, and of 0.2 s beyond that stated.
    amplitude : float, m, > 0
        Largest displacement of a glass end, on the expected plate; less where the driver's `drive_limit` allows less.
    limits : Limits
        Of the device: of peak and rms drive (of the record), and of displacement, of which half is used, as the plate
        may not be the expected one.

    Raises
    ------
    ValueError
        Too short a record, too large a motion, one coil, or a driver of another device; nothing has been played.
    DesignError
        The measurement is not that of a free plate: a finger on it, sensors or coils swapped, inverted or without
        effect, samples lost, clipped or not finite.
    DriverError
        The device failed; zero drive was sent if it still took any.

    Notes
    -----
    Intervals shrink as 1/amplitude and as 1/sqrt(seconds).  A symmetric bending mode below 2.2 kHz (0.44 times the
    rate) is found from a shape at the coils of about 0.003 on; what lies below 5 standard deviations is taken for none.
    Errors of the model show in `misfit`: a command of 10 bits taken for 12 leaves 1 % of the motion.
    """
    if isinstance(driver, str):
        made = open_driver(driver) or registered("drivers", "simulated")(Plate(parameters, Finger.absent(), seed=0))
        with stopped_by_signal(), naming_driver(driver), made as opened:
            found = identify(opened, parameters, seconds=seconds, amplitude=amplitude, limits=limits)
        return found.shortened(getattr(made, "host_delay", 0))
    with driver.by_host() if hasattr(driver, "by_host") else nullcontext(driver) as player:
        found = _fitted(player, parameters, seconds, amplitude, limits)
    return found.shortened(player.delay - driver.delay)


def _fitted(
    driver: Driver, parameters: PlateParameters, seconds: float, amplitude: float, limits: Limits
) -> Identified:
    """As `identify`, by the open driver's `play`."""
    rate = float(driver.rate)
    samples = _samples(driver, parameters, seconds)
    wait = max(WAIT, driver.delay / rate + LEAST_WAIT)
    parameters = replace(parameters, rate=rate)
    amplitude = min(amplitude, STRANGE * (limits.displacement or math.inf))
    sine = design_multisine(parameters, rate, samples, amplitude)
    bounds = (getattr(driver, "drive_limit", math.inf), limits.peak_drive or math.inf, limits.rms_drive or math.inf)
    drives = *[abs(sine.drive).max()] * 2, np.sqrt((sine.drive**2).mean(axis=0)).max()
    share = min((bound - parameters.current_step) / drive for bound, drive in zip(bounds, drives, strict=True))
    if share < 1.0:
        amplitude *= max(share, 0.0)
        sine = design_multisine(parameters, rate, samples, amplitude)
    start, fade = round(wait * rate), round(RAMP * rate)
    sensed = play(driver, _whole_drive(sine, start, fade)).sensed[start : start + samples]
    check_range(sensed, parameters.sensor_range / 2, "m")
    record = spectra(rate, sine, sensed)
    _check_response(record, amplitude)
    latest = round((wait - RAMP) * rate)
    try:
        fit = fit_plate(parameters, record, latest)
    except np.linalg.LinAlgError as error:
        raise DesignError(f"{seconds=:g} s: does not determine all parameters; lengthen the record") from error
    found = _identified(fit, record, driver)
    _check_free(found, record)
    return found


def _samples(driver: Driver, parameters: PlateParameters, seconds: float) -> int:
    """Check the arguments and return the length of the record in samples."""
    check_driver(driver)
    check_channels(driver, {2: "both coils, to identify a plate"}, {2: "a displacement sensor at each end of it"})
    for name in ("coils", "degrees_of_freedom"):
        found = getattr(parameters, name)
        require(found == 2, name, found, "2 to identify heave and rocking")
    require(0.0 <= seconds < math.inf, "seconds", seconds, ">= 0 s")
    return round(seconds * driver.rate)


def _whole_drive(sine: Multisine, start: int, fade: int) -> Array:
    """Drive with a fade-in, a record from sample `start` on, and a fade-out (A, shape (n, 2))."""
    samples = len(sine.drive)
    turn = np.arange(-start, samples + fade)
    envelope = np.ones(len(turn))
    envelope[:fade] = np.sin(0.5 * np.pi * np.arange(fade) / fade) ** 2
    envelope[len(turn) - fade :] = envelope[:fade][::-1]
    return sine.drive[turn % samples] * envelope[:, None]


@stopped_by_signal()
def play(driver: Driver, drive: Array) -> Sensed:
    """Play `drive` (n, channels) in blocks, then at least a block of zeros; return what was sensed of it.

    It is played again, up to `TRIES` times, where samples are lost.  A `DesignError` where they were lost every time,
    or the device reports a saturated drive or a clipped sensor, a `DriverError` where it failed; after either, or a
    signal, zero drive was sent if it still took any.
    """
    for _ in range(TRIES - 1):
        with suppress(SamplesLost):
            return _play_once(driver, drive)
    return _play_once(driver, drive)


def _play_once(driver: Driver, drive: Array) -> Sensed:
    """As `play`; a `SamplesLost` where samples were lost."""
    n, block = len(drive), driver.block
    padded = np.concatenate([drive, np.zeros((-n % block + block, drive.shape[1]))])
    kept = []
    try:
        for start in range(0, len(padded), block):
            played = driver.play(padded[start : start + block])
            given = Sensed(played.sensed, played.position, normal_load=played.normal_load, flags=played.flags)
            sensed = check_sensed(driver, given, 0)
            raised = Flag(0 if sensed.flags is None else int(np.bitwise_or.reduce(sensed.flags)))
            if raised & (Flag.SATURATED | Flag.SENSOR_CLIPPED):
                raise DesignError(f"sample {start}: the device reports {raised.name}: decrease amplitude")
            if raised & Flag.OVERRUN:
                cure = (
                    "free the computer; take larger blocks of a sound card (--driver 'audio:NAME?block=1024', and of "
                )
                cure += "its server), or a faster line to a board ('serial:PORT?baud=921600', or USB)"
                raise SamplesLost(f"sample {start}: the device reports {raised.name}, in {TRIES} tries: {cure}")
            kept.append([None if each is None else each.copy() for each in sensed])
    except BaseException as error:
        with noted_on(error, "sending zero drive"):
            driver.play(np.zeros_like(padded[:block]))
        raise
    columns: Any = [None if each[0] is None else np.concatenate(each)[:n] for each in zip(*kept, strict=True)]
    return Sensed(*columns)


def check_range(sensed: Array, bound: float, unit: str) -> None:
    """Refuse samples (n, sensors) that are not finite or at the end of a sensor's range."""
    with np.errstate(invalid="ignore"):
        bad = np.argwhere(~(abs(sensed) < bound))
    if len(bad):
        sample, channel = bad[0]
        raise DesignError(
            f"sensor {channel + 1}: {sensed[sample, channel]:g} {unit} at sample {sample}: must be within +-{bound:g} "
            f"{unit}; check its unit and zero, or decrease amplitude"
        )


def _check_response(record: Record, amplitude: float) -> None:
    """Refuse a record in which the lines of a sensor do not stand out."""
    moved, noise = (np.sqrt((abs(record.sensed[bins]) ** 2).mean(axis=0)) for bins in (record.lines, record.between))
    for sensor in np.flatnonzero(~(moved > CLEAR * noise)):
        raise DesignError(
            f"sensor {sensor + 1}: response {moved[sensor]:.3g} m per line must be > {CLEAR * noise[sensor]:.3g} m, "
            f"{CLEAR:g} times the noise: check drive and sensor connections, or increase amplitude = {amplitude:g} m"
        )


def _identified(fit: Fit, record: Record, driver: Driver) -> Identified:
    """Estimates, intervals, noise and load of a fit."""
    on_lines, noise, bound = variances(fit, record)
    names = (*NAMES, *BENDING)[: len(fit.unknown)]
    given = {name: getattr(fit.plate, name) for name in names if name not in NAMES[DELAY:]}
    found = given | {"delay": float(fit.unknown[DELAY]) + driver.block, "gain_difference": float(fit.unknown[GAIN])}
    values = [found[name] for name in names]
    scale = [abs(given.get(name, 1.0)) for name in names]
    spread = SIGMAS_95 * np.sqrt(np.diagonal(fit.covariance) * max(on_lines, noise)) * scale
    pairs = (Estimate(float(value), float(half)) for value, half in zip(values, spread, strict=True))
    hidden = np.median(abs(fit.left[record.between]) ** 2) / (2 * math.log(2))  # variance; a hum leaves it alone
    white = round(math.sqrt(hidden * record.samples / 2), 12)  # to 1 pm
    return Identified(
        parameters=replace(fit.plate, delay=max(round(found["delay"]), 1), sensor_noise=white),
        estimates=MappingProxyType(dict(zip(names, pairs, strict=True))),
        bending_top=float(record.turn[-1] * record.rate) if record.above.any() else 0.0,
        noise=white,
        residual=math.sqrt(max(on_lines - noise, 0.0) * record.on_line.sum()),
        misfit=math.sqrt(on_lines / noise),
        misfit_bound=bound,
        load=static_load(fit),
        driver_delay=int(driver.delay),
    )


def _check_free(found: Identified, record: Record) -> None:
    """Refuse a plate with a static load, and motion that the model does not explain."""
    if not abs(found.load) <= CONTACT:
        raise DesignError(
            f"static load = {found.load:.3g} N: must be within +-{CONTACT:g} N; remove the finger, or zero the sensors"
        )
    lines = record.sensed[record.lines]
    share = found.residual / math.sqrt((abs(lines) ** 2).mean() * len(lines) / 2)
    if not (found.explained or share <= UNEXPLAINED):
        raise DesignError(
            f"unexplained motion = {100 * share:.3g} %: must be <= {100 * UNEXPLAINED:g} %; remove the finger; if none "
            "touches, geometry or force constant in [device] do not match the plate"
        )
