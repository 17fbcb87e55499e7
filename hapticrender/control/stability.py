"""The margins of a designed bank, in each of its speeds, and a bandwidth that keeps them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from hapticrender.control.bank.loop import BankLoop, KnownFinger, Sampled, Structure
from hapticrender.control.bank.state import BankNumbers, BankTables
from hapticrender.control.kernels import FREQUENCY, WAVENUMBER
from hapticrender.control.margins import Margins
from hapticrender.errors import DesignError
from hapticrender.protocols import Array

SPEEDS = 5  # of the finger, at which carriers locked to it are checked
STEPS = 2.0 ** (-np.arange(25) / 4)  # of the bandwidth tried, in turn: each a quarter octave lower, down to 1/64
SOFTER = (*STEPS[1:9].tolist(), 0.0)  # of the inner loop: down to a quarter, then off
ROOM = 0.25  # of the wanted bandwidth: the inner loop is softened until this much holds
STATES = {"quiet": (0.0, 0.0), "stirred": (0.0, 1.0), "awake": (1.0, 1.0)}  # openings of the fast and slow detector
SMALLEST = ("delay", "phase", "gain", "bandwidth")  # margins of which the smallest counts, each for itself
GROUPS = (  # states that share an observer, and what is lowered for them
    (("quiet", "stirred"), ("observer", "integral", "integral_stirred"), "inner"),
    (("awake",), ("observer_awake", "integral_awake"), "inner_awake"),
)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Least margins of a design.

    Parameters
    ----------
    modulus : float
        1/Ms, 0..1; 0.5 is Ms = 2.
    delay : float, samples
        No more is asked than the time in which the highest carrier turns by `phase`: above 400 Hz a sample at 5 kHz
        is a larger angle than any loop that follows a carrier bears.
    phase : float, rad
    gain : float
        Factor, >= 1.
    """

    modulus: float = 0.5
    delay: float = 1.0
    phase: float = math.radians(30.0)
    gain: float = 2.0

    def complaint(self, found: Margins, rate: float, highest: float) -> str:
        """Say which margin falls short, with value, bound and unit; empty where all hold.

        `rate` and the `highest` carrier are in Hz.
        """
        delay = min(self.delay, self.phase * rate / (2 * math.pi * max(highest, 1.0)))
        checks = (
            (found.stable, "the loop is unstable"),
            (
                found.modulus >= self.modulus,
                f"modulus margin {found.modulus:.2f} at {found.worst_frequency:.4g} Hz is below {self.modulus:.2f}",
            ),
            (
                found.delay * rate >= delay,
                f"delay margin {found.delay * rate:.2f} samples is below {delay:.2f}",
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
    plant: Structure | Sampled | None = None,
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
    plant : Structure or Sampled, optional
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
    frequency = np.abs(tables.tone[FREQUENCY] + speed * tables.tone[WAVENUMBER])
    share = np.where(tables.tone[WAVENUMBER] > 0.0, _faded(numbers, frequency), 1.0)
    order = np.argsort(frequency)
    return BankLoop.on(
        plant if isinstance(plant, Sampled) else (plant or known).sampled(numbers.rate),
        known,
        frequency[None, order],
        delay=round(numbers.lead * numbers.rate - 0.5) if delay is None else delay,
        lead=numbers.lead,
        observer=np.array([calm * observer]),
        integral=np.array([integral]),
        dc=np.array([numbers.dc]),
        dc_drift=np.array([numbers.dc_drift]),
        inner=np.array([inner]),
        taps=tables.taps,
        finger=finger,
        share=share[None, order],
    )


def _faded(numbers: BankNumbers, frequency: Array) -> Array:
    """Share of the observer that carriers which follow the finger have at `frequency` (Hz), as in the compiled step."""
    ends = 2.0 * frequency / numbers.lowest - 1.0, 4.0 * (numbers.highest_edge - frequency / numbers.highest)
    below, above = (np.clip(end, 0.0, 1.0) for end in ends)
    return np.asarray(below**2 * (3.0 - 2.0 * below) * above**2 * (3.0 - 2.0 * above))


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
    and go down together.  Where not even a quarter of the bandwidth would hold, the inner loop is softened first.
    Carriers locked to the finger are checked at five of its speeds, frozen.
    """
    free = Structure.free(tables.mass, tables.damping, tables.stiffness)
    trials = _Trials(
        limits=limits or Limits(),
        plants=[plant.sampled(tables.numbers.rate) for plant in plants or (free,)],
        speeds=_speeds(tables),
        highest=_highest(tables),
    )
    notes: list[str] = []
    for states, fields, inner in GROUPS:
        tables, said = _lowered(trials, tables, states, fields, inner)
        notes += said
    return Checked(tables=tables, margins={state: trials.worst(tables, state) for state in STATES}, notes=tuple(notes))


@dataclass(frozen=True, kw_only=True)
class _Trials:
    """Margins of everything that was tried, each computed once."""

    limits: Limits
    plants: list[Sampled]
    speeds: Array
    highest: float
    known: dict[tuple[float, float, float], Margins] = field(default_factory=dict)

    def worst(self, tables: BankTables, state: str) -> Margins:
        """Smallest of every margin of a state over all plants and speeds of the finger."""
        key = _opened(tables.numbers, *STATES[state])
        if key not in self.known:
            found = [
                bank_loop(tables, state, speed=speed, plant=plant).margins()
                for plant in self.plants
                for speed in self.speeds
            ]
            self.known[key] = replace(
                min(found, key=lambda margins: margins.modulus),
                stable=all(margins.stable for margins in found),
                **{name: min(getattr(margins, name) for margins in found) for name in SMALLEST},
            )
        return self.known[key]

    def complaint(self, tables: BankTables, states: tuple[str, ...]) -> str:
        """First complaint about these states; empty where all hold."""
        rate = tables.numbers.rate
        found = (self.limits.complaint(self.worst(tables, state), rate, self.highest) for state in states)
        return next((text for text in found if text), "")


def _lowered(
    trials: _Trials, tables: BankTables, states: tuple[str, ...], rates: tuple[str, ...], inner: str
) -> tuple[BankTables, list[str]]:
    """Tables of a group of states whose margins hold, and what was lowered for them."""
    first = trials.complaint(tables, states)
    if not first:
        return tables, []
    name, notes = " and ".join(states), []
    cramped = trials.complaint(_scaled(tables, rates, ROOM), states)
    if cramped and getattr(tables.numbers, inner) > 0.0:
        soft, softer = next(
            (
                (soft, each)
                for soft, each in _softer(tables, inner)
                if not trials.complaint(_scaled(each, rates, ROOM), states)
            ),
            (1.0, tables),
        )
        if soft < 1.0:
            tables = softer
            notes.append(f"inner loop ({name}) softened to {soft:.0%}: even at {ROOM:.0%} of the bandwidth {cramped}")
    for step in STEPS:
        tried = _scaled(tables, rates, float(step))
        complaint = trials.complaint(tried, states)
        if not complaint:
            lowered = (
                [f"bandwidth ({name}) lowered to {step:.0%} of the rule: at the rule {first}"] if step < 1.0 else []
            )
            return tried, notes + lowered
    raise DesignError(
        f"{complaint} ({name}) even at 1/64 of the wanted bandwidth: lower the delay, leave the highest or closest "
        "carriers out, or allow a smaller margin"
    )


def _softer(tables: BankTables, inner: str) -> Iterator[tuple[float, BankTables]]:
    """Ever softer inner loops."""
    for soft in SOFTER:
        yield soft, _scaled(tables, (inner,), soft)


def _scaled(tables: BankTables, names: tuple[str, ...], factor: float) -> BankTables:
    """Tables with some of their numbers times `factor`."""
    numbers = tables.numbers
    return tables._replace(numbers=numbers._replace(**{name: factor * getattr(numbers, name) for name in names}))


def _highest(tables: BankTables) -> float:
    """Highest frequency (Hz) that a carrier may have."""
    fixed = tables.tone[FREQUENCY].max()
    return float(max(fixed, tables.numbers.highest) if (tables.tone[WAVENUMBER] > 0).any() else fixed)


def _speeds(tables: BankTables) -> Array:
    """Speeds (m/s) from which on all finger-locked carriers are in range, to where the fastest leaves it.

    In a range that never holds all of them at once, to where the slowest leaves it.
    """
    wavenumber = tables.tone[WAVENUMBER]
    locked = wavenumber[wavenumber > 0]
    if not locked.size:
        return np.zeros(1)
    first, highest = tables.numbers.lowest / locked.min(), tables.numbers.highest
    last = highest / locked.max()
    return np.geomspace(first, last if last >= first else highest / locked.min(), SPEEDS)
