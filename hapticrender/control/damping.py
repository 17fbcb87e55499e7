"""Inner damper: taps on the deviation at sample rate that act like a viscous damper at each mode, delay included.

The loop of a coordinate is ``L(z) = P(z) z^-delay sum_i c_i z^-i``, P its mode behind a zero-order hold, and beside it
what a bending mode of the surface adds to what the sensors show (docs/theory.md, "Inner damper").  Left out are the
coupling between coordinates and the finger: one of 12 kN/m takes Ms from 1.7 to 1.8 with a delay of 3 samples at 5 kHz,
and to 3.0 in blocks of 25 (``tests/test_load_damper.py``).
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hapticrender.checks import require
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import DiscretePlant
from hapticrender.control.margins import LEAST, Margins, margins_of, unstable_poles
from hapticrender.control.records import MOST_TAPS
from hapticrender.protocols import Array

TAPS, REACH = 3, 0.4e-3  # at least; s: more reach as far back as three at 5 kHz, or noise would grow with the rate
LEAST_RATIO = 1e-4  # damping ratio that margins assume at least, so that an ideal mode has a finite peak
QUALITY, QUALITY_UNMEASURED = 1.4, 2.0  # the least Q, with the bending mode known and while it is not
QUALITY_STEP = 0.1
WORTH = 3.5  # the damper is off where it cannot add so many times the mode's own damping
REACHES = (0.6, 0.7, 0.8, 0.9, 1.0)  # of a bending period: how long notched taps may reach back


@dataclass(frozen=True, kw_only=True)
class BendingMode:
    """A mode of the surface beyond the controlled coordinates, as the loop sees it."""

    frequency: float  # Hz, > 0
    damping: float  # ratio, >= 0
    # 1/kg, for each coordinate: mode shape at the sensors times that at the drive over modal mass, that is acceleration
    # at the sensors per force short of the restoring force; negative where sensors and drive move apart
    coupling: tuple[float, ...]
    spread: float = 100.0  # Hz, >= 0: how far off `frequency` it may lie
    measured: bool = True  # False for an estimate: then the coupling may have either sign, and Q stays at 2 or above

    def __post_init__(self) -> None:
        require(0 <= self.spread < self.frequency, "spread", self.spread, f"between 0 and {self.frequency:g} Hz")

    def corners(self) -> tuple["BendingMode", ...]:
        """Return the mode at either end of its spread, and with either sign where it is an estimate."""
        return tuple(
            replace(
                self, frequency=self.frequency + shift, coupling=tuple(sign * each for each in self.coupling), spread=0
            )
            for sign in ((1,) if self.measured else (1, -1))
            for shift in (-self.spread, self.spread)
        )


class Damping(NamedTuple):
    """An inner damper; `choose_damping` and `load_damper.choose_load_damping` make it."""

    taps: Array  # (coordinates, n), N/m; zero where the damper is off
    quality: float = math.inf  # Q of each mode with a viscous damper; inf where it is off, or of another kind
    stride: int = 1  # samples from one tap to the next

    @property
    def on(self) -> bool:
        """Whether any coordinate has a damper."""
        return bool(self.taps.any())


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


def added_damping(parts: tuple[Oscillator, ...], quality: float) -> Array:
    """Damping b_a = m w1/Q (N s/m, shape (coordinates,)) that gives each mode a `quality` Q."""
    return np.array([part.mass * part.omega / quality for part in parts])


def damping_taps(
    parts: tuple[Oscillator, ...],
    quality: float,
    bending: BendingMode | None = None,
    count: int | None = None,
    plain: int = TAPS,
) -> Array:
    """Solve for the taps (coordinates, n), N/m, that add `added_damping`.

    ``F[n] = -sum_i taps_i deviation[n - i]`` with b_a = m w1/Q, `quality` Q > 0 being what the damper alone gives each
    mode.  There are `plain` taps; with a `bending` mode `count` (five), and those of the coordinates that it couples
    into have zeros there.

    Notes
    -----
    The taps of least norm with ``sum c_i = 0`` (no static force), a damper of b_a at the mode w1 with the delay of d
    samples and the hold made up for, ``sum c_i e^{-j w1 i T} = j w1 b_a e^{j w1 (d + 1/2) T}/sinc(w1 T/2)``, and zeros
    at the bending mode where it is given.
    """
    count = count or (plain if bending is None else TAPS + 2)
    taps = np.zeros((len(parts), count))
    for c, part in enumerate(parts):
        angle, used = part.omega / part.rate, min(plain, count)
        hold_and_delay = np.sinc(angle / (2 * np.pi)) * np.exp(-1j * angle * (part.delay + 0.5))
        equations = [(0.0, 0.0), (angle, 1j * part.omega * part.mass * part.omega / quality / hold_and_delay)]
        if bending is not None and bending.coupling[c] != 0.0:
            equations.append((2 * np.pi * bending.frequency / part.rate, 0.0))
            used = count
        angles, values = np.array(equations).T
        turns = np.exp(-1j * np.outer(angles.real, np.arange(used)))
        rows = np.stack([turns.real, turns.imag], axis=1).reshape(-1, used)
        taps[c, :used] = np.linalg.lstsq(rows, np.stack([values.real, values.imag], axis=1).ravel(), rcond=None)[0]
    return taps


class DamperLoop:
    """Loop of one coordinate with its damper, exact in discrete time; a bending mode lies at its `frequency`."""

    def __init__(self, part: Oscillator, taps: Array, bending: BendingMode | None, c: int, stride: int = 1) -> None:
        self.part, self.taps, self.stride = part, taps, stride
        self.modes = [(part.omega, max(part.ratio, LEAST_RATIO), part.mass)]
        if bending is not None and bending.coupling[c] != 0.0:
            ratio = max(bending.damping, LEAST_RATIO)
            self.modes.append((2 * np.pi * bending.frequency, ratio, 1.0 / bending.coupling[c]))
        omega, ratio, mass = np.array(self.modes).T
        diagonal = np.diag(mass), np.diag(2 * ratio * omega * mass), np.diag(omega**2 * mass)
        free = DiscretePlant.free(*diagonal, part.rate)  # one force drives all modes, the sensors show their sum
        self.plant = replace(free, b=free.b.sum(axis=1, keepdims=True), c=free.c.sum(axis=0, keepdims=True))

    def response(self, frequency: Array) -> Array:
        """L at `frequency` (Hz), shape (n, 1, 1)."""
        z = np.exp(2j * np.pi * frequency / self.part.rate)
        plant = self.plant.response(z)[:, 0, 0]
        return (plant * z**-self.part.delay * np.polyval(self.taps[::-1], z**-self.stride))[:, None, None]

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
        """Motion that white sensor noise causes through the damper, rms of the coordinate per rms of each sensor."""
        grid = self.grid()
        loop = self.response(grid)[:, 0, 0]
        power = np.abs(loop / (1 + loop)) ** 2
        mean = np.sum((power[1:] + power[:-1]) / 2 * np.diff(grid)) / (self.part.rate / 2)
        return float(self.part.sensor_gain * math.sqrt(mean))


def damper_loops(
    parts: tuple[Oscillator, ...], taps: Array, bending: BendingMode | None = None
) -> tuple[DamperLoop, ...]:
    """Loops of all coordinates with their taps (N/m, shape (coordinates, n))."""
    return tuple(DamperLoop(part, taps[c], bending, c) for c, part in enumerate(parts))


def choose_damping(model: DeviceModel) -> Damping:
    """Design the inner damper: the most damping whose margins hold, or none.

    Q rises in steps of 0.1 until every coordinate keeps the damper's least margins, with the bending mode where it was
    measured, and Ms stays below 5 with that mode at both ends of its tolerance.  Q starts at 1.4 where that mode is
    measured or the model is rigid, else at 2.  Where even a damper of 3.5 times the modes' own damping would not do,
    the damper is off.  Notched taps reach back 0.6 to 1 bending period; the reach with the least noise is taken.
    """
    if not (model.mass.diagonal() > 0.0).all():
        return no_damping(len(model.mass))
    bending, parts = model.bending, oscillators(model)
    known = model.rigid if bending is None else bending.measured
    plain = model.taps or min(max(TAPS, 1 + round(REACH * model.rate)), MOST_TAPS)
    least = QUALITY if known else QUALITY_UNMEASURED
    return _chosen(parts, least, bending, plain)


def turns(parts: tuple[Oscillator, ...]) -> float:
    """Periods of the fastest mode in delay and hold."""
    return max(part.omega * (part.delay + 0.5) / (2 * np.pi * part.rate) for part in parts)


@lru_cache(maxsize=256)
def _chosen(parts: tuple[Oscillator, ...], least_quality: float, bending: BendingMode | None, plain: int) -> Damping:
    """Raise Q until the margins hold; `plain` taps where no bending mode is known."""
    largest = 1 / (2 * WORTH * max(*(part.ratio for part in parts), LEAST_RATIO))
    if largest < least_quality or turns(parts) > 1.0:  # the modes damp themselves, or the damper comes too late
        return no_damping(len(parts))
    counts = [plain]  # numbers of taps worth trying
    if bending is not None:
        rate = parts[0].rate
        spans = (1 + round(span * rate / bending.frequency) for span in REACHES) if any(bending.coupling) else (0,)
        counts = sorted({min(max(TAPS + 2, each), MOST_TAPS) for each in spans})
    for step in range(int((largest - least_quality) / QUALITY_STEP) + 1):
        quality = round(least_quality + step * QUALITY_STEP, 1)
        designs = (damping_taps(parts, quality, bending, count, plain) for count in counts)
        kept = [taps for taps in designs if _holds(parts, taps, bending)]
        if kept:
            noises = [max(loop.noise() for loop in damper_loops(parts, taps, bending)) for taps in kept]
            return Damping(kept[int(np.argmin(noises))], quality)
    return no_damping(len(parts))


def _holds(parts: tuple[Oscillator, ...], taps: Array, bending: BendingMode | None) -> bool:
    """Whether all margins hold, with the bending mode at its place and at the ends of its tolerance."""
    corners = () if bending is None else bending.corners()
    cases = [(bending, LEAST["damper"]), *((corner, LEAST["spread"]) for corner in corners)]
    loops = ((loop, bound) for mode, bound in cases for loop in damper_loops(parts, taps, mode))
    return not any(bound.complaint(loop.margins(), loop.part.rate) for loop, bound in loops)


def no_damping(coordinates: int) -> Damping:
    """Return a damper that is off."""
    return Damping(np.zeros((coordinates, TAPS)), math.inf)
