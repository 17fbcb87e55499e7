"""Inner damper: taps on the deviation at sample rate that act like a viscous damper at each mode, delay included.

The loop of a coordinate is ``L(z) = P(z) z^-delay sum_i c_i z^-i``, P its mode behind a zero-order hold, and beside it
what a bending mode of the surface adds to what the sensors show (docs/theory.md, "Inner damper").  The coupling between
coordinates is left out; no finger raises Ms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.margins import LEAST, LeastMargins, Margins, margins_of, unstable_poles
from hapticrender.protocols import Array

TAPS = 3
LEAST_RATIO = 1e-4  # damping ratio that margins assume at least, so that an ideal mode has a finite peak
QUALITY, QUALITY_UNMEASURED = 1.4, 2.0  # the least Q, with the bending mode known and while it is not
QUALITY_STEP = 0.1
WORTH = 4.0  # the damper is off where it cannot add so many times the mode's own damping
REACHES = (0.6, 0.7, 0.8, 0.9, 1.0)  # of a bending period: how long notched taps may reach back
LOOSE = LeastMargins(modulus=0.2, delay=0.0, phase=0.0, gain=1.0)  # with the bending mode at an end of its spread


@dataclass(frozen=True, kw_only=True)
class BendingMode:
    """A mode of the surface beyond the controlled coordinates, as the loop sees it.

    Parameters
    ----------
    frequency : float, Hz
        Of the mode, > 0.
    damping : float
        Its damping ratio, >= 0.
    coupling : tuple of float, 1/kg
        For each coordinate, acceleration that the sensors show per force, short of the restoring force: mode shape at
        the sensors times mode shape at the drive over modal mass.  Negative where sensors and drive move apart.
    spread : float, Hz
        How far off `frequency` it may lie, >= 0.
    measured : bool
        False for an estimate: then the coupling may have either sign, and Q stays at 2 or above.
    """

    frequency: float
    damping: float
    coupling: tuple[float, ...]
    spread: float = 100.0
    measured: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.frequency) and self.frequency > 0):
            raise ValueError(f"frequency = {self.frequency!r}: must be > 0 Hz")
        if not (math.isfinite(self.damping) and self.damping >= 0):
            raise ValueError(f"damping = {self.damping!r}: must be >= 0")
        if not 0 <= self.spread < self.frequency:
            raise ValueError(f"spread = {self.spread!r}: must be between 0 and {self.frequency:g} Hz")

    def corners(self) -> tuple[BendingMode, ...]:
        """Return the mode at either end of its spread, and with either sign where it is an estimate."""
        return tuple(
            replace(self, frequency=self.frequency + shift, coupling=tuple(sign * each for each in self.coupling))
            for sign in ((1,) if self.measured else (1, -1))
            for shift in (-self.spread, self.spread)
        )


@dataclass(frozen=True, kw_only=True)
class Damping:
    """An inner damper, or the reason why there is none; `choose_damping` makes it.

    Attributes
    ----------
    taps : ndarray, shape (coordinates, n), N/m
        Zero where the damper is off.
    added_damping : ndarray, shape (coordinates,), N s/m
        Damping that the taps add at each mode.
    quality : float
        Q of each mode with its damper; inf where the damper is off.
    margins : tuple of Margins
        One for each coordinate; none where the damper is off.
    noise : tuple of float
        Motion that white noise of the sensors causes, rms of each coordinate per rms of each sensor.
    note : str
        What was chosen, and why.
    """

    taps: Array
    added_damping: Array
    quality: float
    margins: tuple[Margins, ...]
    noise: tuple[float, ...]
    note: str

    @property
    def grip(self) -> Array:  # removed with the old kernels
        """Return `added_damping`."""
        return self.added_damping

    def text(self) -> str:
        """Return the note and a line of margins for each coordinate."""
        lines = [
            f"  coordinate {i}: {margins}, noise {noise:.2f} um per um of sensor noise"
            for i, (margins, noise) in enumerate(zip(self.margins, self.noise, strict=True), start=1)
        ]
        return "\n".join([f"inner damper {self.note}", *lines])


class Oscillator(NamedTuple):
    """One coordinate of a device on its own, behind the hold and the delay of its loop."""

    rate: float  # Hz
    delay: int  # samples
    mass: float
    omega: float  # rad/s
    ratio: float  # of damping
    sensor_gain: float  # rms of the coordinate per rms of each sensor


def oscillators(model: DeviceModel) -> tuple[Oscillator, ...]:
    """Coordinates of a device, each taken alone."""
    mass, damping, stiffness = (part.diagonal() for part in (model.mass, model.damping, model.stiffness))
    omega = np.sqrt(stiffness / mass)
    gain = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1))
    columns = zip(mass.tolist(), omega.tolist(), (damping / (2 * mass * omega)).tolist(), gain.tolist(), strict=True)
    return tuple(Oscillator(float(model.rate), model.delay, *column) for column in columns)


def damping_taps(
    model: DeviceModel, quality: float, *, bending: BendingMode | None = None, count: int | None = None
) -> tuple[Array, Array]:
    """Solve for the taps of the inner damper and the damping that they add.

    Parameters
    ----------
    model : DeviceModel
        The free device with its rate and delay.
    quality : float
        Q that the damper alone gives each mode, > 0; 1.4 wherever the bending mode of the surface is spared.
    bending : BendingMode, optional
        The taps then have zeros there; only coordinates that it couples into.
    count : int, optional
        Taps; by default the model's, and five with a bending mode.

    Returns
    -------
    taps : ndarray, shape (coordinates, count), N/m
        ``F[n] = -sum_i taps_i deviation[n - i]``, zeros at the end where fewer are of use.
    added_damping : ndarray, shape (coordinates,), N s/m
        b_a = m w1/Q.

    Notes
    -----
    The taps of least norm with ``sum c_i = 0`` (no static force), a damper of b_a at the mode w1 with the delay of d
    samples and the hold made up for, ``sum c_i e^{-j w1 i T} = j w1 b_a e^{j w1 (d + 1/2) T}/sinc(w1 T/2)``, and zeros
    at the bending mode where it is given.
    """
    least = TAPS if bending is None else TAPS + 2
    count = (model.taps if bending is None else least) if count is None else count
    if not quality > 0:
        raise ValueError(f"{quality=} must be > 0")
    if count < least:
        raise ValueError(f"{count=} taps: must be >= {least}, one for each equation")
    parts = oscillators(model)
    taps = [_taps(part, quality, bending, c, count, min(model.taps, count)) for c, part in enumerate(parts)]
    return np.array(taps), np.array([part.mass * part.omega / quality for part in parts])


def _taps(part: Oscillator, quality: float, bending: BendingMode | None, c: int, count: int, plain: int) -> Array:
    """Taps of one coordinate; as many as `plain` where the bending mode does not couple into it."""
    angle = part.omega / part.rate
    hold_and_delay = np.sinc(angle / (2 * np.pi)) * np.exp(-1j * angle * (part.delay + 0.5))
    equations = [(0.0, 0.0), (angle, 1j * part.omega * part.mass * part.omega / quality / hold_and_delay)]
    if bending is not None and bending.coupling[c] != 0.0:
        equations.append((2 * np.pi * bending.frequency / part.rate, 0.0))
        plain = count
    turns = np.exp(-1j * np.outer([each[0] for each in equations], np.arange(plain)))
    values = np.array([each[1] for each in equations])
    rows = np.stack([turns.real, turns.imag], axis=1).reshape(-1, plain)
    taps = np.zeros(count)
    taps[:plain] = np.linalg.lstsq(rows, np.stack([values.real, values.imag], axis=1).ravel(), rcond=None)[0]
    return taps


def damping_margins(model: DeviceModel, taps: Array, *, bending: BendingMode | None = None) -> tuple[Margins, ...]:
    """Margins of the inner damper, one for each coordinate.

    Parameters
    ----------
    model : DeviceModel
        The free device.
    taps : ndarray, shape (coordinates, n), N/m
        Of `damping_taps`.
    bending : BendingMode, optional
        A mode of the surface in the loop, at its `frequency`.
    """
    return tuple(_DamperLoop(part, taps[c], bending, c).margins() for c, part in enumerate(oscillators(model)))


def damping_noise(model: DeviceModel, taps: Array, *, bending: BendingMode | None = None) -> tuple[float, ...]:
    """Motion that white sensor noise causes through the damper, rms of each coordinate per rms of each sensor."""
    return tuple(_DamperLoop(part, taps[c], bending, c).noise() for c, part in enumerate(oscillators(model)))


class _DamperLoop:
    """Loop of one coordinate with its damper, exact in discrete time."""

    def __init__(self, part: Oscillator, taps: Array, bending: BendingMode | None, c: int) -> None:
        self.part, self.taps = part, taps
        self.modes = [(part.omega, max(part.ratio, LEAST_RATIO), 1.0 / part.mass)]
        if bending is not None and bending.coupling[c] != 0.0:
            ratio = max(bending.damping, LEAST_RATIO)
            self.modes.append((2 * np.pi * bending.frequency, ratio, bending.coupling[c]))

    def response(self, frequency: Array) -> Array:
        """L at `frequency` (Hz), shape (n, 1, 1)."""
        z = np.exp(2j * np.pi * frequency / self.part.rate)
        plant = sum(_held_mode(z, self.part.rate, *mode) for mode in self.modes)
        return (plant * z**-self.part.delay * np.polyval(self.taps[::-1], 1 / z))[:, None, None]

    def grid(self) -> Array:
        """Frequencies (Hz) from 0 to half the rate, dense at each mode and fine enough for the delay."""
        rate = self.part.rate
        parts = [np.linspace(0.0, rate / 2, max(4096, 8 * (self.part.delay + 1)) + 1)]
        for omega, ratio, _ in self.modes:
            near = omega / (2 * np.pi) * (1 + ratio * np.sinh(np.linspace(-9.0, 9.0, 1201)))
            parts.append(abs(near - rate * np.round(near / rate)))  # beyond half the rate it folds back
        return np.unique(np.concatenate(parts))

    def margins(self) -> Margins:
        """Margins; L has no pole outside the unit circle."""
        grid = self.grid()
        if unstable_poles(lambda frequency: 1 + self.response(frequency)[:, 0, 0], grid):
            return Margins.unstable()
        return margins_of(self.response, grid[grid > 0])

    def noise(self) -> float:
        """Rms of the coordinate per rms of each sensor."""
        grid = self.grid()
        loop = self.response(grid)[:, 0, 0]
        power = np.abs(loop / (1 + loop)) ** 2
        mean = np.sum((power[1:] + power[:-1]) / 2 * np.diff(grid)) / (self.part.rate / 2)
        return self.part.sensor_gain * math.sqrt(mean)


def _held_mode(z: Array, rate: float, omega: float, ratio: float, gain: float) -> Array:
    """Response at z of ``gain/(s^2 + 2 ratio omega s + omega^2)`` behind a zero-order hold.

    By residues: each pole l gives r (e^(l T) - 1)/(l (z - e^(l T))) with r the residue of the continuous mode.
    """
    apart = np.sqrt(complex(ratio * ratio - 1.0)) or 1e-9  # a double pole is parted by a hair
    poles = omega * (-ratio + apart * np.array([1.0, -1.0]))
    residues = gain / (poles - poles[::-1])
    grown = np.exp(poles / rate)
    return sum(r * (e - 1) / (pole * (z - e)) for r, e, pole in zip(residues, grown, poles, strict=True))


def choose_damping(
    model: DeviceModel, *, bending: BendingMode | None = None, least: LeastMargins = LEAST["damper"]
) -> Damping:
    """Design the inner damper: the most damping whose margins hold, or none, and why.

    Parameters
    ----------
    model : DeviceModel
        The free device with its rate and delay.
    bending : BendingMode, optional
        The bending mode of the surface, which the taps then spare; once it is measured Q may go down to 1.4.
        Without it Q stays at 2 or above, unless the model is known to be rigid.
    least : LeastMargins

    Returns
    -------
    Damping

    Notes
    -----
    Q rises in steps of 0.1 until every coordinate keeps `least`, with the bending mode where it was measured, and Ms
    stays below 5 with that mode at both ends of its spread.  Where even a damper of four times the modes' own damping
    would not, the damper is off.  Notched taps reach back 0.6 to 1 bending period; the reach with the least noise is
    taken.
    """
    if not (model.mass.diagonal() > 0.0).all():
        return _off(len(model.mass), "off: the device has no mode")
    known = model.rigid if bending is None else bending.measured
    parts, least_quality = oscillators(model), QUALITY if known else QUALITY_UNMEASURED
    largest = 1 / (2 * WORTH * max(*(part.ratio for part in parts), LEAST_RATIO))
    lag = f"a delay of {model.delay} sample{'s' * (model.delay != 1)} at {model.rate:g} Hz"
    if largest < least_quality:
        return _off(len(parts), f"off: the modes damp themselves (Q {WORTH * largest:.1f})")
    if not within_a_turn(model):
        fastest = max(part.omega for part in parts) / (2 * np.pi)
        return _off(len(parts), f"off: {lag} is longer than a period of the mode at {fastest:.0f} Hz")
    complaint = raised = ""
    for step in range(int((largest - least_quality) / QUALITY_STEP) + 1):
        quality = round(least_quality + step * QUALITY_STEP, 1)
        count, complaint = _quietest(parts, quality, bending, model.taps, least)
        if not complaint:
            taps, added = damping_taps(model, quality, bending=bending, count=count)
            return Damping(
                taps=taps,
                added_damping=added,
                quality=quality,
                margins=damping_margins(model, taps, bending=bending),
                noise=damping_noise(model, taps, bending=bending),
                note=f"on: Q {quality:g}{raised}; {_spared(count, bending)}",
            )
        raised = f" (at Q {quality:g}, with {lag}, {complaint})"
    return _off(len(parts), f"off: with {lag}, {complaint} even at Q {quality:g}")


def within_a_turn(model: DeviceModel) -> bool:
    """Whether delay and hold are no longer than a period of the fastest mode."""
    return bool(max(part.omega for part in oscillators(model)) * (model.delay + 0.5) / model.rate <= 2 * np.pi)


@lru_cache(maxsize=4096)
def _quietest(
    parts: tuple[Oscillator, ...], quality: float, bending: BendingMode | None, plain: int, least: LeastMargins
) -> tuple[int, str]:
    """Number of taps that keeps `least` with the least noise; or the last complaint where none does."""
    kept, complaint = [], ""
    for count in _counts(parts[0].rate, bending, plain):
        taps = [_taps(part, quality, bending, c, count, min(plain, count)) for c, part in enumerate(parts)]
        complaint = _complaint(parts, taps, bending, least)
        if not complaint:
            kept.append((max(_DamperLoop(part, taps[c], bending, c).noise() for c, part in enumerate(parts)), count))
    return (min(kept)[1], "") if kept else (0, complaint)


def _counts(rate: float, bending: BendingMode | None, plain: int) -> list[int]:
    """Numbers of taps worth trying."""
    if bending is None or not any(bending.coupling):
        return [plain if bending is None else TAPS + 2]
    return sorted({max(TAPS + 2, 1 + round(span * rate / bending.frequency)) for span in REACHES})


def _complaint(
    parts: tuple[Oscillator, ...], taps: list[Array], bending: BendingMode | None, least: LeastMargins
) -> str:
    """First margin that falls short, with the bending mode at its place and at the ends of its spread."""
    cases = [(bending, least, "")]
    if bending is not None:
        cases += [(corner, LOOSE, f" with the bending mode at {corner.frequency:g} Hz") for corner in bending.corners()]
    for mode, bound, where in cases:
        for c, part in enumerate(parts):
            if complaint := bound.complaint(_DamperLoop(part, taps[c], mode, c).margins(), part.rate):
                return complaint + where
    return ""


def _spared(count: int, bending: BendingMode | None) -> str:
    """Say how the taps spare the bending mode."""
    if bending is None:
        return "no bending mode is known"
    known = "measured" if bending.measured else "estimated"
    return f"{count} taps spare the bending mode {known} at {bending.frequency:.0f} +-{bending.spread:.0f} Hz"


def _off(coordinates: int, note: str) -> Damping:
    """No damper."""
    return Damping(
        taps=np.zeros((coordinates, TAPS)),
        added_damping=np.zeros(coordinates),
        quality=math.inf,
        margins=(),
        noise=(),
        note=note,
    )
