"""Check the margins of the error observer's law at each level of the gain schedule, and lower its bandwidth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import ErrorLoop, FingerEstimate, Sampled
from hapticrender.control.margins import LEAST, LeastMargins, Margins
from hapticrender.errors import DesignError
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array

SPEEDS = 5  # of the finger, at which carriers locked to it are checked
STEPS = 2.0 ** (-np.arange(25) / 4)  # of the bandwidth tried, in turn: each a quarter octave lower, down to 1/64
SOFTER = (*STEPS[1:9].tolist(), 0.0)  # of the inner damper: down to a quarter, then off
ROOM = 0.25  # of the bandwidth of the rule: the inner damper is softened until this much holds
SCHEDULE = {"low": (0.0, 0.0), "medium": (0.0, 1.0), "high": (1.0, 0.0)}
"""Levels of the gain schedule: how far the fast and the slow detector have raised the gains."""
GROUPS = (  # levels that share an observer, and what is lowered for them
    (("low", "medium"), ("observer", "integral", "integral_medium"), "damper"),
    (("high",), ("observer_high", "integral_high"), "damper_high"),
)


class FreeDevice(NamedTuple):
    """Matrices of a free device, kg, N s/m, N/m."""

    mass: Array
    damping: Array
    stiffness: Array


@dataclass(frozen=True, kw_only=True)
class BankGains:
    """Gains of the error observer, its law and the inner damper at every level of the gain schedule.

    Names are those of `records.SETTINGS`.
    """

    rate: float  # Hz
    delay: int  # samples from a sensed sample to the moment its force acts, >= 1
    lead: float  # s, by which the law turns forces ahead: delay and half the hold
    observer: float  # gain g per sample, at low and medium
    observer_high: float
    integral: float  # 1/s, at low
    integral_medium: float
    integral_high: float
    dc: float  # of the DC estimate per sample, 1.6 w/rate
    dc_drift: float  # (w/rate)^2
    damper: float  # factor on the inner damper, 0..1, at low and medium
    damper_high: float
    crowd_speed: float  # m/s: below it the observer's gain falls in proportion, as locked carriers crowd; 0: none
    lowest: float  # Hz, range of finger-locked carriers
    highest: float
    highest_edge: float  # times `highest`, where they have faded out

    def at(self, level: str) -> tuple[float, float, float]:
        """Return observer gain, integral gain and inner damper at a level of the schedule."""
        fast, slow = SCHEDULE[level]
        integral = self.integral + slow * (self.integral_medium - self.integral)
        return (
            self.observer + fast * (self.observer_high - self.observer),
            integral + fast * (self.integral_high - integral),
            self.damper + fast * (self.damper_high - self.damper),
        )

    def scaled(self, names: tuple[str, ...], factor: float) -> BankGains:
        """Return the gains with some of them times `factor`."""
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def share(self, frequency: Array) -> Array:
        """Factor on the observer's gain of finger-locked carriers at `frequency` (Hz): they fade out of their range."""
        below = smoothstep(2.0 * frequency / self.lowest - 1.0)
        return below * smoothstep(4.0 * (self.highest_edge - frequency / self.highest))


class Checked(NamedTuple):
    """Gains whose margins hold."""

    gains: BankGains  # as given, or with lower bandwidths
    margins: dict[str, Margins]  # the smallest of every margin, by level of the schedule
    notes: tuple[str, ...]  # what was lowered and why; empty where nothing was


def error_loop(
    model: DeviceModel | FreeDevice,
    frequency: Array,
    gains: BankGains,
    level: str = "high",
    *,
    wavenumber: Array | None = None,
    taps: Array | None = None,
    speed: float = 0.0,
    plant: Sampled | None = None,
    delay: int | None = None,
    finger: FingerEstimate | None = None,
) -> ErrorLoop:
    """Linear loop of a design at one level of its gain schedule, on the free device `model` that the law inverts.

    `frequency` (Hz) and `wavenumber` (1/m, default: all fixed) are the parts of every carrier, shape (K,); `taps`
    (c, t) those of the inner damper, N/m; `speed` (m/s) and the estimate in the law the `finger`'s.  The loop closes on
    `plant` with `delay` samples where these differ from the free device and the design.
    """
    observer, integral, inner = gains.at(level)
    if gains.crowd_speed > 0.0:
        observer *= min(abs(speed) / gains.crowd_speed, 1.0)
    wavenumber = np.zeros(len(frequency)) if wavenumber is None else wavenumber
    frequency = np.abs(frequency + speed * wavenumber)
    order = np.argsort(frequency)
    frequency, share = frequency[order], np.where(wavenumber > 0.0, gains.share(frequency), 1.0)[order]
    jw = 2j * np.pi * frequency[:, None, None]
    law, slope = model.mass * jw**2 + model.damping * jw + model.stiffness, model.damping + 2 * jw * model.mass
    if finger is not None:
        arms = np.array([1.0, finger.lever])[: len(model.mass)]
        touched = np.outer(arms, arms)
        law = law + (finger.mass * jw**2 + finger.damping * jw + finger.stiffness) * touched
        slope = slope + (finger.damping + 2 * jw * finger.mass) * touched
    rho = np.exp(jw * gains.lead) / np.sinc(frequency / gains.rate)[:, None, None]
    return ErrorLoop(
        plant=plant or Sampled.free(model.mass, model.damping, model.stiffness, gains.rate),
        delay=gains.delay if delay is None else delay,
        frequency=frequency,
        observer=observer,
        integral=integral,
        dc=gains.dc,
        dc_drift=gains.dc_drift,
        inner=inner,
        taps=np.zeros((len(model.mass), 1)) if taps is None else taps,
        law=rho * law,
        slope=rho * slope,
        share=share,
    )


def checked_gains(
    model: DeviceModel | FreeDevice,
    frequency: Array,
    gains: BankGains,
    *,
    wavenumber: Array | None = None,
    taps: Array | None = None,
    least: LeastMargins = LEAST["law"],
) -> Checked:
    """Lower the bandwidth until the margins on the free device hold at every level of the gain schedule.

    The arguments are those of `error_loop`.  Observer and integral are lowered together, a quarter octave at a time;
    low and medium share their observer and go down together.  Where not even a quarter of the bandwidth would hold, the
    inner damper is softened first.  Carriers locked to the finger are checked at five of its speeds, frozen.

    Raises
    ------
    DesignError
        Where even 1/64 of the bandwidth leaves a margin too small: names margin, value and bound.
    """
    wavenumber = np.zeros(len(frequency)) if wavenumber is None else wavenumber
    taps = np.zeros((len(model.mass), 1)) if taps is None else taps
    arrays = [np.array(a, float) for a in (model.mass, model.damping, model.stiffness, frequency, wavenumber, taps)]
    return _checked(tuple((each.shape, each.tobytes()) for each in arrays), gains, least)


@lru_cache(maxsize=256)
def _checked(arrays: tuple[tuple[tuple[int, ...], bytes], ...], gains: BankGains, least: LeastMargins) -> Checked:
    """Lower the bandwidth; mass, damping, stiffness, frequency, wavenumber and taps by their contents."""
    mass, damping, stiffness, frequency, wavenumber, taps = (np.frombuffer(b).reshape(shape) for shape, b in arrays)
    model, locked = FreeDevice(mass, damping, stiffness), wavenumber[wavenumber > 0]
    plant, speeds = Sampled.free(*model, gains.rate), _speeds(gains, locked)
    highest = float(frequency.max(initial=gains.highest if locked.size else 0.0))
    known: dict[tuple[float, float, float], Margins] = {}

    def worst(gains: BankGains, level: str) -> Margins:
        """Smallest of every margin at a level over all speeds of the finger."""
        key = gains.at(level)
        if key not in known:
            options: dict[str, Any] = {"wavenumber": wavenumber, "taps": taps, "plant": plant}
            loops = [error_loop(model, frequency, gains, level, speed=speed, **options) for speed in speeds]
            known[key] = Margins.smallest([loop.margins() for loop in loops])
        return known[key]

    def complaint(gains: BankGains, levels: tuple[str, ...]) -> str:
        """Name the first margin that falls short at these levels; empty where all hold."""
        found = (least.complaint(worst(gains, level), gains.rate, highest) for level in levels)
        return next((text for text in found if text), "")

    notes: list[str] = []
    for levels, rates, damper in GROUPS:
        gains, lowered = _lowered(complaint, gains, levels, rates, damper)
        notes += lowered
    return Checked(gains, {level: worst(gains, level) for level in SCHEDULE}, tuple(notes))


def _lowered(
    complaint: Callable[[BankGains, tuple[str, ...]], str],
    gains: BankGains,
    levels: tuple[str, ...],
    rates: tuple[str, ...],
    damper: str,
) -> tuple[BankGains, list[str]]:
    """Lower the gains of a group of levels until their margins hold; say what was lowered."""
    first = complaint(gains, levels)
    if not first:
        return gains, []
    name, notes = " and ".join(levels), []
    cramped = complaint(gains.scaled(rates, ROOM), levels)
    if cramped and getattr(gains, damper) > 0.0:
        for soft in SOFTER:
            softer = gains.scaled((damper,), soft)
            if not complaint(softer.scaled(rates, ROOM), levels):
                gains = softer
                notes.append(
                    f"inner damper ({name}) softened to {soft:.0%}: even at {ROOM:.0%} of the bandwidth {cramped}"
                )
                break
    for step in STEPS.tolist():
        tried = gains.scaled(rates, step)
        short = complaint(tried, levels)
        if not short:
            if step < 1.0:
                notes.append(f"bandwidth ({name}) lowered to {step:.0%} of the rule: at the rule {first}")
            return tried, notes
    raise DesignError(
        f"{short} ({name}) even at 1/64 of the bandwidth of the rule: lower the delay, leave the highest or "
        "closest carriers out, or allow a smaller margin"
    )


def _speeds(gains: BankGains, locked: Array) -> Array:
    """Speeds (m/s) from which on all finger-locked carriers are in range, to where the fastest leaves it.

    In a range that never holds all of them at once, to where the slowest leaves it.
    """
    if not locked.size:
        return np.zeros(1)
    first, last = gains.lowest / locked.min(), gains.highest / locked.max()
    return np.geomspace(first, last if last >= first else gains.highest / locked.min(), SPEEDS)
