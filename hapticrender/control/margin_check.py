"""Check the margins of the error observer's law at each level of the gain schedule, and lower its bandwidth."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import DiscretePlant, ErrorLoop
from hapticrender.control.margins import LEAST, LeastMargins, Margins
from hapticrender.errors import DesignError
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array

Settings = Mapping[str, Any]  # of a controller, by the names of `records.SETTINGS`
SPEEDS = 5  # of the finger, at which carriers locked to it are checked
STEPS = 2.0 ** (-np.arange(25) / 4)  # of the bandwidth tried, in turn: each a quarter octave lower, down to 1/64
SOFTER = (*STEPS[1:9].tolist(), 0.0)  # of the inner damper: down to a quarter, then off
LEAST_SHARE = 0.25  # of the bandwidth of the rule: the inner damper is softened until this much holds
SCHEDULE = {"low": (0.0, 0.0), "medium": (0.0, 1.0), "high": (1.0, 0.0)}
"""Levels of the gain schedule: how far the fast and the slow detector have raised the gains."""
GROUPS = (  # levels that share an observer, and what is lowered for them
    (("low", "medium"), ("observer", "integral", "integral_medium"), "damper"),
    (("high",), ("observer_high", "integral_high"), "damper_high"),
)
LOWERED = [name for _, rates, damper in GROUPS for name in (*rates, damper)]
OF_LOOP = (*LOWERED, "lead", "dc", "dc_drift", "crowd_speed", "lowest", "highest", "highest_edge")
"""Settings that `error_loop` takes."""


CHECKED: dict[tuple[Any, ...], Settings] = {}
"""What was found before, by all that it follows from: a check takes 0.2 s, the rest of a render of 1 s 0.03 s."""
MOST_CHECKED = 256


def scheduled(settings: Settings, level: str) -> tuple[float, float, float]:
    """Return observer gain (per sample), integral gain (1/s) and inner damper (0..1) at a level of the schedule."""
    fast, slow = SCHEDULE[level]
    integral = settings["integral"] + slow * (settings["integral_medium"] - settings["integral"])
    return (
        settings["observer"] + fast * (settings["observer_high"] - settings["observer"]),
        integral + fast * (settings["integral_high"] - integral),
        settings["damper"] + fast * (settings["damper_high"] - settings["damper"]),
    )


def error_loop(
    model: DeviceModel,
    frequency: Array,
    settings: Settings,
    level: str = "high",
    *,
    wavenumber: Array | None = None,
    taps: Array | None = None,
    speed: float = 0.0,
) -> ErrorLoop:
    """Linear loop of a controller's settings at one level of its gain schedule, on the free device of the `model`.

    `frequency` (Hz) and `wavenumber` (1/m, default: all fixed) are the parts of every carrier, shape (K,); `taps`
    (c, t) those of the inner damper, N/m; `speed` (m/s) the finger's.
    """
    observer, integral, inner = scheduled(settings, level)
    if settings["crowd_speed"] > 0.0:
        observer *= min(abs(speed) / settings["crowd_speed"], 1.0)
    wavenumber = np.zeros(len(frequency)) if wavenumber is None else wavenumber
    frequency = np.abs(frequency + speed * wavenumber)
    order = np.argsort(frequency)
    below = smoothstep(2.0 * frequency / settings["lowest"] - 1.0)
    inside = below * smoothstep(4.0 * (settings["highest_edge"] - frequency / settings["highest"]))
    frequency, share = frequency[order], np.where(wavenumber > 0.0, inside, 1.0)[order]
    jw = 2j * np.pi * frequency[:, None, None]
    rho = np.exp(jw * settings["lead"]) / np.sinc(frequency / model.rate)[:, None, None]
    return ErrorLoop(
        plant=DiscretePlant.free(model.mass, model.damping, model.stiffness, model.rate),
        delay=model.delay,
        frequency=frequency,
        observer=observer,
        integral=integral,
        dc=settings["dc"],
        dc_drift=settings["dc_drift"],
        inner=inner,
        taps=np.zeros((len(model.mass), 1)) if taps is None else taps,
        law=rho * model.dynamic_stiffness(frequency),
        slope=rho * (model.damping + 2 * jw * model.mass),
        share=share,
    )


def checked_settings(
    model: DeviceModel,
    frequency: Array,
    settings: Settings,
    *,
    wavenumber: Array | None = None,
    taps: Array | None = None,
    least: LeastMargins = LEAST["bands"],
) -> Settings:
    """Lower the bandwidth until the margins on the free device hold at every level of the gain schedule.

    The arguments are those of `error_loop`.  Observer and integral are lowered together, a quarter octave at a time;
    low and medium share their observer and go down together.  Where not even a quarter of the bandwidth would hold, the
    inner damper is softened first.  Carriers locked to the finger are checked at five of its speeds, frozen.  Where
    even 1/64 of the bandwidth leaves a margin too small a `DesignError` names it, its value and its bound.
    """
    wavenumber = np.zeros(len(frequency)) if wavenumber is None else wavenumber
    taps = np.zeros((len(model.mass), 1)) if taps is None else taps
    arrays = (model.mass, model.damping, model.stiffness, frequency, wavenumber, taps)
    numbers = (model.rate, model.delay, least, *(settings[name] for name in OF_LOOP))
    key = (*(each.tobytes() for each in arrays), *numbers)
    found = CHECKED.get(key)  # other threads may leave it out again
    if found is None:
        found = CHECKED[key] = _checked(model, frequency, settings, wavenumber, taps, least)
    for oldest in list(CHECKED)[:-MOST_CHECKED]:
        CHECKED.pop(oldest, None)
    return {**settings, **{name: found[name] for name in LOWERED}}


def _checked(
    model: DeviceModel, frequency: Array, settings: Settings, wavenumber: Array, taps: Array, least: LeastMargins
) -> Settings:
    locked = wavenumber[wavenumber > 0.0]
    speeds = _speeds(settings, locked)
    highest = float(frequency.max(initial=settings["highest"] if locked.size else 0.0))
    known: dict[tuple[float, float, float], list[Margins]] = {}

    def complaint(settings: Settings, levels: tuple[str, ...]) -> str:
        """Name the first margin that falls short at these levels, at any speed of the finger; empty where all hold."""
        for level in levels:
            gains = scheduled(settings, level)
            if gains not in known:
                moved = [{"wavenumber": wavenumber, "taps": taps, "speed": speed} for speed in speeds]
                known[gains] = [error_loop(model, frequency, settings, level, **each).margins() for each in moved]
            found = (least.complaint(margins, model.rate, highest) for margins in known[gains])
            if text := next(filter(None, found), ""):
                return text
        return ""

    for levels, rates, damper in GROUPS:
        settings = _lowered(complaint, settings, levels, rates, damper)
    return settings


def _scaled(settings: Settings, names: tuple[str, ...], factor: float) -> Settings:
    return {**settings, **{name: factor * settings[name] for name in names}}


def _lowered(
    complaint: Callable[[Settings, tuple[str, ...]], str],
    settings: Settings,
    levels: tuple[str, ...],
    rates: tuple[str, ...],
    damper: str,
) -> Settings:
    """Lower the gains of a group of levels until their margins hold."""
    if complaint(settings, levels) and settings[damper] > 0.0:
        softer = (settings, *(_scaled(settings, (damper,), soft) for soft in SOFTER))
        holds = (each for each in softer if not complaint(_scaled(each, rates, LEAST_SHARE), levels))
        settings = next(holds, settings)
    for step in STEPS.tolist():
        tried = _scaled(settings, rates, step)
        short = complaint(tried, levels)
        if not short:
            return tried
    cure = "lower the delay, leave the highest or closest carriers out, or allow a smaller margin"
    raise DesignError(f"{short} ({' and '.join(levels)}) even at 1/64 of the bandwidth of the rule: {cure}")


def _speeds(settings: Settings, locked: Array) -> Array:
    """Speeds (m/s) from which on all finger-locked carriers are in range, to where the fastest leaves it.

    In a range that never holds all of them at once, to where the slowest leaves it.
    """
    if not locked.size:
        return np.zeros(1)
    first, last = settings["lowest"] / locked.min(), settings["highest"] / locked.max()
    return np.geomspace(first, last if last >= first else settings["highest"] / locked.min(), SPEEDS)
