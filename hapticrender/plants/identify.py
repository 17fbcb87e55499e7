"""Knowing the plate: what it is made of, found through any driver while no finger is on it.

A second of multi-sine (`multisine.py`) is played and the motion of both glass
ends compared, bin by bin of its spectrum, with the sampled plate

    Y = G S (z - Phi)^-1 ((Gamma_0 + Gamma_1/z) z^-d U + z x)

U is the drive that was sent; Phi, Gamma the plate discretised exactly for a
held drive that comes d + e samples late, so that the images of the hold, 7e-4
of the motion at 400 Hz and 5 kHz, and any fraction of a sample are in it.
S takes states to the ends, G = diag(1 - g/2, 1 + g/2) holds the gain
difference g of the sensors, and x, four numbers, is the free motion that the
record began with less the one it ended with.

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
from hapticrender.plants.multisine import PATTERNS, Multisine, design_multisine
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array, Driver, Flag

MECHANICAL = ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2")
NAMES = (*MECHANICAL, "delay", "gain_difference")
UNITS = dict(zip(NAMES, ("kg", "kg m2", "N/m", "N/m", "N s/m", "N s/m", "samples", "1"), strict=True))
RAMP = 0.05  # s: the drive grows and fades this long
SIGMAS_95 = 1.96
LEAST_RATIO = 0.1  # of what a parameter is believed to be: where the search for it starts at the latest
TURNS = 30  # of the search
LONGEST_STEP = 0.5  # of a logarithm or a sample, in one turn
CLEAR = 10.0  # amplitude of the lines over what lies between them: below it there is nothing to fit
CHANCE = 5.0  # sigmas of the misfit's own spread beyond which it is not chance
UNEXPLAINED = 0.02  # of the motion: beyond it this is no free plate
CONTACT = 0.05  # N
ROUNDING = 1e-9  # of the motion: what no sensor resolves, and the least noise that is believed
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
        return replace(model, coordinate_from_sensed=model.coordinate_from_sensed / _gains(difference))

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
    gains: bool = True,
    contact: float = CONTACT,
) -> Identified:
    """Find what the plate behind a driver is made of, while no finger is on it.

    The driver must be open, so call this inside its ``with`` statement; it
    stays open, at zero drive.

    Parameters
    ----------
    driver : Driver
        Any driver of a plate: two coils, two sensors.
    parameters : PlateParameters
        The plate as it is believed to be, from which the drive is made; electronics and geometry are taken as known.
    seconds : float, s
        Length of the record, enough to resolve the narrowest mode.
    wait : float, s, >= 2 * 0.05
        From the first drive to the record; delays up to wait - 0.05 s are found.
    amplitude : float, m, > 0
        Largest displacement of a glass end, on the plate as believed.
    gains : bool
        Whether to look for a gain difference of the sensors; without, they are taken to be equal.
    contact : float, N, > 0
        Static load from which on the plate counts as touched.

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
    every whole delay.  With 1 um of noise at 5 kHz, 1 s of 100 um gives m, I and k to 0.1 %, b to 0.4 % and the delay
    to 0.002 samples (one sigma or better).
    """
    rate = float(driver.rate)
    samples = _samples(driver, seconds, wait)
    sine = design_multisine(parameters, rate, samples, amplitude)
    start, fade = round(wait * rate), round(RAMP * rate)
    sensed = _play(driver, _whole_drive(sine, start, fade))[start : start + samples]
    _check_sensed(sensed, parameters)
    record = _spectra(parameters, rate, sine, sensed)
    _check_moved(record, amplitude)
    plate, late = _equation_error(parameters, record, round((wait - RAMP) * rate))
    fit = _output_error(plate, late, record, gains)
    return _judged(fit, driver, record, sine, contact)


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


@dataclass(frozen=True, kw_only=True)
class _Record:
    """Spectra of drive and motion (amplitudes: A, m) at bins 0 and from below the first line to above the last."""

    rate: float
    samples: int
    ends: Array  # (2, 2): sensors from coordinates
    turn: Array  # (n,) cycles a sample
    drive: Array  # (n, 2)
    sensed: Array  # (n, 2)
    on_line: Array  # (n,) bool

    @property
    def counted(self) -> Array:
        """Bins that the fit looks at: all but the static one."""
        return self.turn > 0


def _spectra(parameters: PlateParameters, rate: float, sine: Multisine, sensed: Array) -> _Record:
    samples = len(sensed)
    margin = max(int(sine.bins[0]) // 2, 1)
    bins = np.r_[0, sine.bins[0] - margin : sine.bins[-1] + margin + 1]
    return _Record(
        rate=rate,
        samples=samples,
        ends=np.linalg.inv(parameters.band_model(rate, 1).coordinate_from_sensed),
        turn=bins / samples,
        drive=np.fft.rfft(sine.drive, axis=0)[bins] * (2 / samples),
        sensed=np.fft.rfft(sensed, axis=0)[bins] * (2 / samples),
        on_line=np.isin(bins, sine.bins),
    )


def _check_moved(record: _Record, amplitude: float) -> None:
    """Refuse a record in which the lines do not stand out."""
    between = record.counted & ~record.on_line
    moved, noise = (math.sqrt((abs(record.sensed[bins]) ** 2).mean()) for bins in (record.on_line, between))
    if not moved > CLEAR * noise:
        raise DesignError(
            f"{amplitude=:g} m: the lines stand {moved:.3g} m high, must be > {CLEAR * noise:.3g} m, {CLEAR:g} times "
            "what lies between them: the plate does not answer, or moves by itself"
        )


def _gains(difference: float) -> Array:
    """Gains of the two sensors, mean 1."""
    return np.array([1 - difference / 2, 1 + difference / 2])


def _held(plate: PlateParameters, period: float, share: float) -> tuple[Array, Array]:
    """State and input matrix over `share` of a period of held drive; states are q and period q' (m)."""
    from scipy.linalg import expm

    inverse = np.linalg.inv(plate.mass_matrix)
    generator = np.zeros((6, 6))
    generator[:2, 2:4] = np.eye(2)
    generator[2:4, :2] = -(period**2) * inverse @ plate.stiffness_matrix
    generator[2:4, 2:4] = -period * inverse @ plate.damping_matrix
    generator[2:4, 4:] = period**2 * inverse @ plate.force_from_drive
    moved = expm(share * generator)
    return moved[:4, :4], moved[:4, 4:]


def sampled_response(plate: PlateParameters, rate: float, late: float, turn: Array) -> tuple[Array, Array]:
    """Coordinates of the free plate in discrete time, per drive and per free motion.

    Parameters
    ----------
    plate : PlateParameters
        The plate.
    rate : float, Hz
        Sampling rate.
    late : float, samples
        Delay of the held drive, any fraction.
    turn : ndarray, shape (n,)
        Frequency over rate.

    Returns
    -------
    driven : ndarray of complex, shape (n, 2, 2), m/A
        Heave and rocking per coil current, all images of the hold in it.
    free : ndarray of complex, shape (n, 2, 4)
        The same per state (m) that the record began with less the one it ended with.
    """
    whole = math.floor(late)
    first, push_first = _held(plate, 1 / rate, late - whole)
    second, push_second = _held(plate, 1 / rate, 1 - (late - whole))
    z = np.exp(2j * np.pi * turn)[:, None, None]
    free = np.linalg.inv(z * np.eye(4) - second @ first)[:, :2]
    return (free @ (push_second + second @ push_first / z)) * z**-whole, free * z


def _equation_error(parameters: PlateParameters, record: _Record, latest: int) -> tuple[PlateParameters, int]:
    """First idea of the plate and of the whole samples by which its drive comes late, up to `latest`."""
    line = record.on_line
    s = 2j * np.pi * record.rate * record.turn[line]
    heave, rocking = np.linalg.solve(record.ends, record.sensed[line].T)
    force = parameters.force_from_drive @ record.drive[line].T * np.sinc(record.turn[line])
    none = np.zeros_like(heave)
    columns = np.array(
        [
            [s * s * heave, none, s * heave, s * rocking, heave, rocking],
            [none, s * s * rocking, s * rocking, s * heave, rocking, heave],
        ]
    )
    mass, stiffness = parameters.mass_matrix.diagonal(), parameters.stiffness_matrix.diagonal()
    weight = 1 / (mass[:, None] * abs(s) ** 2 + stiffness[:, None])
    turned = np.exp(-2j * np.pi * np.outer(record.turn[line], np.arange(latest + 1) + 0.5))
    unknown = _stacked((columns * weight[:, None]).transpose(0, 2, 1).reshape(-1, 6))
    forces = _stacked(((force * weight)[:, :, None] * turned).reshape(-1, latest + 1))
    basis, triangle = np.linalg.qr(unknown)
    shares = basis.T @ forces
    late = int((shares**2).sum(axis=0).argmax())  # what is not explained is least
    solved = np.linalg.lstsq(triangle, shares[:, late], rcond=None)[0]
    m, turning, damping, tilt, hold, skew = solved
    found = (
        m,
        turning * parameters.half_spacing**2,
        (hold - skew) / 2,
        (hold + skew) / 2,
        (damping - tilt) / 2,
        (damping + tilt) / 2,
    )
    critical = math.sqrt(mass[0] * stiffness[0])
    least = [max(getattr(parameters, name), 1e-2 * critical if "damping" in name else 0.0) for name in MECHANICAL]
    kept = {name: max(float(x), LEAST_RATIO * y) for name, x, y in zip(MECHANICAL, found, least, strict=True)}
    return replace(parameters, **kept), late


def _stacked(values: Array) -> Array:
    """Complex rows as twice as many real ones."""
    return np.concatenate([values.real, values.imag])


class _Fit(NamedTuple):
    """Where the search ended: logarithms of the six, delay and gain difference, with their covariance at unit noise."""

    plate: PlateParameters
    vector: Array
    covariance: Array
    difference: Array  # (n, 2) sensed less predicted at all bins, the static one included


def _plate_at(plate: PlateParameters, vector: Array) -> PlateParameters:
    return replace(
        plate, **{name: float(getattr(plate, name) * math.exp(x)) for name, x in zip(MECHANICAL, vector, strict=False)}
    )


def _predicted(plate: PlateParameters, record: _Record, vector: Array) -> Array:
    """Motion of the ends (m, shape (n, 2)) for six logarithms, delay, gain difference and four numbers of free motion."""
    driven, free = sampled_response(_plate_at(plate, vector), record.rate, vector[6], record.turn)
    moved = (driven @ record.drive[:, :, None])[..., 0] + free @ vector[8:]
    return moved @ record.ends.T * _gains(vector[7])


def _output_error(plate: PlateParameters, late: float, record: _Record, gains: bool) -> _Fit:
    """Gauss-Newton with step halving; the scales make every unknown about 1 where it matters."""
    counted = record.counted
    scale = np.r_[np.ones(8), np.full(4, abs(record.sensed[counted]).max())]
    searched = np.array([index for index in range(12) if gains or index != 7])
    vector = np.r_[np.zeros(6), late, np.zeros(5)]

    def error(at: Array) -> Array:
        return _stacked((record.sensed - _predicted(plate, record, at))[counted].ravel())

    def slopes(at: Array, here: Array) -> Array:
        return np.stack([(here - error(at + 1e-7 * scale * unit)) / 1e-7 for unit in np.eye(12)[searched]], axis=1)

    here = error(vector)
    for _ in range(TURNS):
        jacobian = slopes(vector, here)
        step = np.zeros(12)
        step[searched] = np.linalg.lstsq(jacobian, here, rcond=None)[0] * scale[searched]
        share = min(1.0, LONGEST_STEP / max(abs(step[:8]).max(), LONGEST_STEP))
        while share > 1e-6 and not (there := error(vector + share * step)) @ there < here @ here:
            share /= 2
        gained = 1 - there @ there / (here @ here)
        if not gained > 0:
            break
        vector, here = vector + share * step, there
        if gained < 1e-9:
            break
    covariance = np.zeros((12, 12))
    jacobian = slopes(vector, here)
    covariance[np.ix_(searched, searched)] = np.linalg.inv(jacobian.T @ jacobian)
    return _Fit(plate, vector, covariance[:8, :8], record.sensed - _predicted(plate, record, vector))


def _judged(fit: _Fit, driver: Driver, record: _Record, sine: Multisine, contact: float) -> Identified:
    """Noise, intervals and load of a fit; refuses what is no free plate."""
    plate, power = _plate_at(fit.plate, fit.vector), abs(fit.difference) ** 2
    lines, between = record.on_line, record.counted & ~record.on_line
    free_numbers = int((np.diagonal(fit.covariance) > 0).sum())
    freedom = power[lines].size * 2 - free_numbers, power[between].size * 2
    floor = (ROUNDING * abs(record.sensed[lines]).max()) ** 2
    variance = [
        max(float(power[bins].sum()) / count, floor) for bins, count in zip((lines, between), freedom, strict=True)
    ]  # of a real number
    misfit = math.sqrt(variance[0] / variance[1])
    bound = math.sqrt(1 + CHANCE * math.sqrt(2 / freedom[0] + 2 / freedom[1]))
    excess = max(variance[0] - variance[1], 0.0) * 2
    unexplained = math.sqrt(excess / (abs(record.sensed[lines]) ** 2).mean())
    load = -float((plate.stiffness_matrix @ np.linalg.solve(record.ends, fit.difference[0].real / 2))[0])
    if abs(load) > contact:
        raise DesignError(f"static load = {load:.3g} N: must be within +-{contact:g} N; take the finger off the plate")
    if misfit > bound and unexplained > UNEXPLAINED:
        raise DesignError(
            f"unexplained motion = {100 * unexplained:.3g} % of what was sensed: must be <= {100 * UNEXPLAINED:g} %; "
            "something touches the plate, or it is no plate of this kind"
        )
    extra = driver.block
    values = [getattr(plate, name) for name in MECHANICAL] + [fit.vector[6] + extra, fit.vector[7]]
    spread = SIGMAS_95 * np.sqrt(np.diagonal(fit.covariance) * max(variance))
    spread[:6] *= values[:6]
    return Identified(
        parameters=replace(plate, rate=record.rate, delay=max(round(fit.vector[6]) + extra, 1)),
        estimates=MappingProxyType(
            {name: Estimate(float(x), float(y)) for name, x, y in zip(NAMES, values, spread, strict=True)}
        ),
        frequency=record.turn[lines] * record.rate,
        coordinate=sine.coordinate,
        lines=_measured(fit, plate, record, sine),
        noise=math.sqrt(variance[1] * record.samples / 2),
        residual=math.sqrt(excess * lines.sum() / 2),
        misfit=misfit,
        misfit_bound=bound,
        load=load,
    )


def _measured(fit: _Fit, plate: PlateParameters, record: _Record, sine: Multisine) -> Array:
    """Heave and rocking per coil current at the lines: the found plate's, and what was measured besides."""
    lines = record.on_line
    frequency = record.turn[lines] * record.rate
    off = np.linalg.solve(record.ends, (fit.difference[lines] / _gains(fit.vector[7])).T).T
    current = (record.drive[lines] @ PATTERNS / 2)[np.arange(len(frequency)), sine.coordinate]
    hold = np.sinc(record.turn[lines]) * np.exp(-2j * np.pi * record.turn[lines] * (fit.vector[6] + 0.5))
    model = plate.band_model(record.rate, plate.delay).response(frequency) @ PATTERNS
    return model[np.arange(len(frequency)), :, sine.coordinate] + off / (current * hold)[:, None]


def _numbers(model: BandModel, half_spacing: float) -> dict[str, float]:
    """Write the eight numbers of `NAMES` as a band model holds them."""
    stiffness, damping = model.stiffness, model.damping
    gain = np.linalg.inv(model.coordinate_from_sensed)[:, 0]
    values = (
        model.mass[0, 0],
        model.mass[1, 1] * half_spacing**2,
        (stiffness[0, 0] - stiffness[0, 1]) / 2,
        (stiffness[0, 0] + stiffness[0, 1]) / 2,
        (damping[0, 0] - damping[0, 1]) / 2,
        (damping[0, 0] + damping[0, 1]) / 2,
        model.delay,
        2 * (gain[1] - gain[0]) / (gain[1] + gain[0]),
    )
    return {name: float(value) for name, value in zip(NAMES, values, strict=True)}


def compare(met: Identified, designed: BandModel | PlateParameters) -> tuple[Difference, ...]:
    """Whether the plate that the controller meets is the one it was designed for.

    Parameters
    ----------
    met : Identified
        The plate as found.
    designed : BandModel or PlateParameters
        What the controller was, or will be, designed from.

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
    half_spacing = met.parameters.half_spacing
    if isinstance(designed, PlateParameters):
        half_spacing, designed = designed.half_spacing, designed.band_model(designed.rate, designed.delay)
    known = _numbers(designed, half_spacing)
    differences = tuple(
        Difference(name, estimate.value, known[name], estimate.interval)
        for name, estimate in met.estimates.items()
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


def _beyond_absorbed(difference: Difference) -> bool:
    relative = abs(difference.designed) if difference.name in MECHANICAL else 1.0
    change = abs(difference.met - difference.designed)
    return change > ABSORBED[difference.name] * relative + DIFFERS * difference.interval
