"""The margins of a designed bank, in each of its speeds, and a bandwidth that keeps them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hapticrender.control.bank_kernels import BankNumbers, BankTables
from hapticrender.control.bank_loop import BankLoop, KnownFinger, Structure
from hapticrender.control.kernels import FREQUENCY, WAVENUMBER
from hapticrender.control.margins import Margins
from hapticrender.errors import DesignError
from hapticrender.protocols import Array

SPEEDS = 5  # of the finger, at which carriers locked to it are checked
TOGETHER = 12  # neighbouring bands that are checked as one loop; the residual's coupling falls with their distance
STEPS = 2.0 ** (-np.arange(25) / 4)  # of the bandwidth tried, in turn: each a quarter octave lower, down to 1/64
STATES = {"quiet": (0.0, 0.0), "stirred": (0.0, 1.0), "awake": (1.0, 1.0)}  # openings of the fast and slow detector


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Least margins of a design.

    Parameters
    ----------
    modulus : float
        1/Ms, 0..1; 0.5 is Ms = 2.
    delay : float, samples
    phase : float, rad
    gain : float
        Factor, >= 1.
    """

    modulus: float = 0.5
    delay: float = 1.0
    phase: float = math.radians(30.0)
    gain: float = 2.0

    def complaint(self, found: Margins, rate: float) -> str:
        """Say which margin falls short, with value, bound and unit; empty where all hold."""
        checks = (
            (found.stable, "the loop is unstable"),
            (
                found.modulus >= self.modulus,
                f"modulus margin {found.modulus:.2f} at {found.worst_frequency:.4g} Hz is below {self.modulus:.2f}",
            ),
            (
                found.delay * rate >= self.delay,
                f"delay margin {found.delay * rate:.2f} samples is below {self.delay:.2f}",
            ),
            (
                found.phase >= self.phase,
                f"phase margin {math.degrees(found.phase):.1f} deg is below {math.degrees(self.phase):.1f} deg",
            ),
            (found.gain >= self.gain, f"gain margin {found.gain:.2f} is below {self.gain:.2f}"),
        )
        return next((text for kept, text in checks if not kept), "")


@dataclass(frozen=True, kw_only=True)
class Checked:
    """A bank whose margins hold.

    Parameters
    ----------
    tables : BankTables
        As given, or with lower bandwidths.
    margins : dict of Margins
        The smallest of every margin, state by state: "quiet", "stirred", "awake".
    notes : tuple of str
        What was lowered and why; empty where nothing was.
    """

    tables: BankTables
    margins: dict[str, Margins]
    notes: tuple[str, ...]


def bank_loop(
    tables: BankTables,
    state: str = "awake",
    *,
    speed: float = 0.0,
    bands: slice = slice(None),
    plant: Structure | None = None,
    delay: int | None = None,
    finger: KnownFinger | None = None,
) -> BankLoop:
    """Linear loop of a designed bank.

    Parameters
    ----------
    tables : BankTables
    state : {"quiet", "stirred", "awake"}
        Which of its detectors stand open.
    speed : float, m/s
        Of the finger, for carriers that are locked to it.
    bands : slice
        Which of its bands, by ascending frequency at this speed.
    plant : Structure, optional
        What it meets; by default the device that it was designed for.
    delay : int, optional
        Samples that the loop really has; by default what it was designed for.
    finger : KnownFinger, optional
        What it has learnt of the finger.
    """
    numbers = tables.numbers
    if state not in STATES:
        raise ValueError(f"{state=} must be one of {', '.join(STATES)}")
    known = Structure.free(tables.mass, tables.damping, tables.stiffness)
    observer, integral, inner = _opened(numbers, *STATES[state])
    calm = min(abs(speed) / numbers.crowd_speed, 1.0) if numbers.crowd_speed > 0 else 1.0
    frequency = np.sort(np.abs(tables.tone[FREQUENCY] + speed * tables.tone[WAVENUMBER]))[bands]
    return BankLoop.on(
        (plant or known).sampled(numbers.rate),
        known,
        frequency[None],
        delay=round(numbers.lead * numbers.rate - 0.5) if delay is None else delay,
        lead=numbers.lead,
        observer=np.array([calm * observer]),
        integral=np.array([integral]),
        dc=np.array([numbers.dc]),
        dc_drift=np.array([numbers.dc_drift]),
        inner=np.array([inner]),
        taps=tables.taps,
        finger=finger,
    )


def _opened(numbers: BankNumbers, fast: float, slow: float) -> tuple[float, float, float]:
    """Observer gain, integral gain and share of the inner loop for the two openings, as in the compiled step."""
    integral = numbers.integral + slow * (numbers.integral_stirred - numbers.integral)
    return (
        numbers.observer + fast * (numbers.observer_awake - numbers.observer),
        integral + fast * (numbers.integral_awake - integral),
        numbers.inner + fast * (numbers.inner_awake - numbers.inner),
    )


def checked_bandwidth(
    tables: BankTables, limits: Limits | None = None, *, plants: tuple[Structure, ...] = ()
) -> Checked:
    """Lower the bandwidth of a bank until its margins hold, in quiet, stirred and awake.

    Parameters
    ----------
    tables : BankTables
        The bank as its rules would have it.
    limits : Limits, optional
        Least margins.
    plants : tuple of Structure
        Devices to hold on (fingers, errors of the model); by default the one that it was designed for.

    Returns
    -------
    Checked

    Raises
    ------
    DesignError
        Where even 1/64 of the wanted bandwidth leaves a margin too small: names margin, value and bound.

    Notes
    -----
    Observer and integral are lowered together, a quarter octave at a time; quiet and stirred share their observer
    and go down together.  Carriers locked to the finger are checked at five of its speeds, frozen; more than twelve
    bands a dozen neighbours at a time.
    """
    limits = limits or Limits()
    notes: list[str] = []
    for states, fields in (
        (("quiet", "stirred"), ("observer", "integral", "integral_stirred")),
        (("awake",), ("observer_awake", "integral_awake")),
    ):
        first = ""
        for step in STEPS:
            tried = tables._replace(numbers=_scaled(tables.numbers, fields, float(step)))
            complaint = _complaint(tried, states, limits, plants)
            first = first or complaint
            if not complaint:
                break
        else:
            raise DesignError(
                f"{complaint} ({states[-1]}) even at 1/64 of the wanted bandwidth: soften the inner loop (raise its "
                "quality) or lower the delay"
            )
        if step < 1.0:
            notes.append(f"bandwidth ({' and '.join(states)}) lowered to {step:.0%} of the rule: at the rule {first}")
        tables = tried
    return Checked(
        tables=tables, margins={state: _worst(tables, state, plants) for state in STATES}, notes=tuple(notes)
    )


def _scaled(numbers: BankNumbers, fields: tuple[str, ...], step: float) -> BankNumbers:
    return numbers._replace(**{field: step * getattr(numbers, field) for field in fields})


def _loops(tables: BankTables, state: str, plants: tuple[Structure, ...]) -> list[BankLoop]:
    """Every loop that has to hold: plants, speeds of the finger, groups of neighbours."""
    count = tables.tone.shape[1]
    starts = range(0, max(count - TOGETHER // 2, 1), TOGETHER // 2)
    return [
        bank_loop(tables, state, speed=speed, bands=slice(start, start + TOGETHER), plant=plant)
        for plant in plants or (None,)
        for speed in _speeds(tables)
        for start in starts
    ]


def _speeds(tables: BankTables) -> Array:
    """Speeds (m/s) that take the slowest of the finger-locked carriers from the lowest to the highest frequency."""
    wavenumber = tables.tone[WAVENUMBER]
    locked = wavenumber[wavenumber > 0]
    if not locked.size:
        return np.zeros(1)
    return np.geomspace(tables.numbers.lowest / locked.min(), tables.numbers.highest / locked.max(), SPEEDS)


def _complaint(tables: BankTables, states: tuple[str, ...], limits: Limits, plants: tuple[Structure, ...]) -> str:
    """First complaint about any loop of these states; empty where all hold."""
    for state in states:
        for loop in _loops(tables, state, plants):
            text = limits.complaint(loop.margins(), tables.numbers.rate)
            if text:
                return text
    return ""


def _worst(tables: BankTables, state: str, plants: tuple[Structure, ...]) -> Margins:
    """Smallest of every margin over all loops of a state."""
    found = [loop.margins() for loop in _loops(tables, state, plants)]
    peak = min(found, key=lambda margins: margins.modulus)
    return Margins(
        stable=all(margins.stable for margins in found),
        modulus=peak.modulus,
        worst_frequency=peak.worst_frequency,
        delay=min(margins.delay for margins in found),
        phase=min(margins.phase for margins in found),
        gain=min(margins.gain for margins in found),
        bandwidth=min(margins.bandwidth for margins in found),
    )
