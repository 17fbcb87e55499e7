"""Accuracy against cost: every method at several settings, on one fixed set of scenes, and where each stops holding.

Accuracy is the worst error over `SCENES` at the finger, at the centre of the plate; cost is what the controller takes
for a sample of a band, and how much faster than real time the whole simulation runs.  Costs are measured in turns, so
that what the machine does meanwhile meets all settings alike; they are this machine's, their order is not.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.accuracy.plate import SLIDING, pressing, rms, tones
from hapticrender.bands import Bands
from hapticrender.charts.figures import save
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.bank.controller import design_bank
from hapticrender.control.blocks.controller import BlockController
from hapticrender.control.methods import METHODS
from hapticrender.control.methods.boxcar import Boxcar
from hapticrender.control.methods.inverse import DynamicStiffness, StaticInverse
from hapticrender.control.methods.paper import CommonMode, PerSide
from hapticrender.control.methods.resonant import Resonant
from hapticrender.control.methods.stiffness import ERROR, ERROR_CROWDED, SIGNAL
from hapticrender.errors import HapticError
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.protocols import Array, Controller, Sensed
from hapticrender.recordings.formats import replacing
from hapticrender.recordings.judge import fit
from hapticrender.touch.finger import Finger
from hapticrender.touch.mechanics import HEAVY, LIGHT

Design = Callable[[BandModel, Bands], Controller]

TONES = (47.0, 111.0, 178.0, 261.0)  # Hz
COMB = np.arange(50.0, 401.0, 50.0)  # Hz
SECONDS = 4.0
LOST = 1.0  # a larger relative error counts as no rendering at all
ALIKE = 0.9  # a smaller gain in error than a tenth is not worth any cost
RESTLESS, OFF = 0.03, 0.05  # 2 s after a touch a stable loop is at rest at its target: what wanders more (rms), or is
# further off, is not
FREE, HELD = (0.6, 1.0), (1.6, SECONDS)  # s: before the finger, and sliding under it
MAP = np.geomspace(20.0, 400.0, 27)  # Hz: carriers of the panel of stability
TOUCHES = (  # finger, load in N, place in m
    ("light, in the middle", LIGHT, 0.3, 0.0),
    ("heavy, in the middle", HEAVY, 0.8, 0.0),
    ("heavy, at the edge", HEAVY, 0.8, 27.5e-3),
)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One point of the chart.

    Parameters
    ----------
    method : str
        Name of the method.
    what : str
        How it is set, in words.
    design : callable
        From band model and bands to a controller.
    rate : float, Hz
    block : int, samples
        Of the device; 1 is sample by sample.
    """

    method: str
    what: str
    design: Design
    rate: float = 5000.0
    block: int = 1

    def parameters(self) -> PlateParameters:
        """The plate at the setting's rate."""
        delay = self.block if self.block > 1 else 1
        return replace(PlateParameters(), rate=self.rate, delay=delay)

    def controller(self, bands: Bands) -> Controller:
        """A controller at rest."""
        parameters = self.parameters()
        return self.design(replace(parameters.band_model(self.rate, parameters.delay), block=self.block), bands)


@dataclass(frozen=True, kw_only=True)
class Point:
    """What was found of a setting.

    Parameters
    ----------
    setting : Setting
    error : float
        Worst of `scenes`, relative; infinite where one is not rendered at all.
    nanoseconds : float
        Time of the controller for a sample of a band, of eight.
    speed : float
        Simulated seconds a second, plant and finger included.
    scenes : dict
        Error of each scene.
    refused : str
        Why the setting could not be designed.
    """

    setting: Setting
    error: float = np.inf
    nanoseconds: float = np.inf
    speed: float = 0.0
    scenes: dict[str, float] = field(default_factory=dict)
    refused: str = ""

    @property
    def stable(self) -> bool:
        """Whether every scene was rendered at all."""
        return self.error < LOST


def _bank(method: str, change: Callable[[Any], Any] = lambda rules: rules, precision: str = "double") -> Design:
    """H or H2 with changed rules, sample by sample or in the blocks of the model."""

    def design(model: BandModel, bands: Bands) -> Controller:
        crowded = len(bands) > 1 and np.diff(np.sort(bands.frequency)).min() < 40.0
        rules = change(SIGNAL if method == "h" else ERROR_CROWDED if crowded else ERROR)
        bank = design_bank(method, model, bands, rules)
        return BlockController(bank, model.block, precision) if model.block > 1 else bank.in_precision(precision)

    return design


def _observers(fast: float) -> Callable[[Any], Any]:
    return lambda rules: replace(rules, observer=(fast, max(fast, rules.observer[1]) if fast >= 10 else fast))


def _plain(method: Any, **options: Any) -> Design:
    return lambda model, bands: method.design(model, bands, **options)


def _heave_only(method: Any) -> Design:
    """The least model of the plate: it moves up and down, and both coils push alike."""

    def design(model: BandModel, bands: Bands) -> Controller:
        rows = ("force_from_drive", "coordinate_from_sensed")
        columns = ("side_from_coordinate", "place_from_coordinate")
        parts = {name: getattr(model, name)[:1, :1] for name in ("mass", "damping", "stiffness")}
        parts |= {name: getattr(model, name)[:1] for name in rows}
        parts |= {name: getattr(model, name)[:, :1] for name in columns}
        return method.design(replace(model, **parts), bands)

    return design


def every_setting() -> list[Setting]:
    """All points of the chart."""
    found = []
    for name, kind in (("paper", PerSide), ("paper-common", CommonMode), ("boxcar", Boxcar)):
        for width in (2.5, 5.0, 10.0):
            found.append(Setting(method=name, what=f"{width:g} Hz", design=_plain(kind(bandwidths=(width, 2 * width)))))
        found.append(Setting(method=name, what="by rule, single", design=_plain(METHODS[name], precision="single")))
    for name, inverse in (("static", StaticInverse), ("stiffness", DynamicStiffness)):
        for form in ("reduced", "integrator"):
            found.append(Setting(method=name, what=f"{form} loop", design=_plain(inverse(form=form))))
        found.append(
            Setting(method=name, what="with feed-forward", design=_plain(inverse(form="integrator", feed_forward=True)))
        )
    for gain in (5.0, 15.0):
        found.append(Setting(method="resonant", what=f"{gain:g} 1/s", design=_plain(Resonant(gain=gain))))
    for name in ("h", "h2"):
        for width in (5.0, 10.0, 20.0):
            found.append(Setting(method=name, what=f"observer {width:g} Hz", design=_bank(name, _observers(width))))
        found.append(Setting(method=name, what="as it comes, single", design=_plain(METHODS[name], precision="single")))
        found.append(Setting(method=name, what="knows heave only", design=_heave_only(METHODS[name])))
    found.append(Setting(method="h2", what="as it comes", design=_plain(METHODS["h2"])))
    for rate, block in ((5000.0, 10), (5000.0, 25), (48000.0, 32), (48000.0, 64)):
        for precision in ("double", "single"):
            what = f"blocks of {block} at {rate / 1000:g} kHz, {precision}"
            found.append(
                Setting(method="h2", what=what, design=_bank("h2", precision=precision), rate=rate, block=block)
            )
    return found


def scenes() -> dict[str, Bands]:
    """The fixed scenes: four tones of 50 um and a comb of eight of 10 um, each free and then under a sliding finger."""
    found = {f"{frequency:g} Hz": tones([frequency], 50e-6) for frequency in TONES}
    found["8 bands"] = tones(COMB, 10e-6, np.random.default_rng(1).uniform(0, 2 * np.pi, COMB.size))
    return found


def play(setting: Setting, bands: Bands, finger: Finger, seconds: float) -> Array:
    """True motion at the centre (m, shape (samples,)) in closed loop on the whole plate, sensor noise included."""
    plate = Plate(setting.parameters(), finger, block=setting.block)
    seen = closed(setting, setting.controller(bands), plate, seconds)
    return np.concatenate([np.asarray(each.motion)[:, 0] for each in seen])


def closed(setting: Setting, controller: Controller, plate: Plate, seconds: float) -> list[Sensed]:
    """What is sensed meanwhile, with controller and plate given; both go on from where they are."""
    samples = int(seconds * setting.rate) // setting.block * setting.block
    if setting.block == 1:
        return [plate.closed_loop(controller, np.zeros(samples))[3]]
    drive, nothing, found = np.zeros((setting.block, 2)), np.zeros(setting.block), []
    for _ in range(0, samples, setting.block):
        found.append(plate.run(drive))
        drive = controller.run(found[-1].sensed, np.asarray(found[-1].position), nothing)[0]
    return found


def envelopes(motion: Array, bands: Bands, rate: float) -> tuple[Array, Array, float]:
    """Middles (s, shape (w,)) of windows of 0.1 s, or two periods, envelopes (m, shape (w, bands)), and that length."""
    length = max(0.02, 2 / float(bands.frequency.min())) if len(bands) == 1 else 0.1
    size = int(round(length * rate))
    start = np.arange(0, len(motion) - size + 1, size // 2)
    index = start[:, None] + np.arange(size)
    phase = bands.carrier_phase(np.arange(len(motion)) / rate, np.zeros(len(motion)))
    return (start + size / 2) / rate, fit(phase[index], motion[index, None])[0][:, 0], length


def found_error(motion: Array, bands: Bands, rate: float, windows: Sequence[tuple[float, float]]) -> float:
    """Largest rms over the windows (s) of the envelopes' error over what is wanted; infinite where it is `LOST`."""
    if not np.isfinite(motion).all():
        return np.inf
    middle, found, length = envelopes(motion, bands, rate)
    wanted = np.asarray(bands.envelope)
    off = abs(abs(found) / abs(wanted) - 1.0) if len(bands) == 1 else abs(found - wanted) / abs(wanted)
    whole = [(middle - length / 2 > begin) & (middle + length / 2 <= end + 1e-9) for begin, end in windows]
    worst = max(float(rms(rms(off[each]))) for each in whole)
    return worst if worst < LOST else np.inf


def wandering(motion: Array, bands: Bands, rate: float) -> float:
    """How far the envelope of the only carrier strays from its mean over the last second, rms over what is wanted."""
    if not np.isfinite(motion).all():
        return np.inf
    middle, found, _ = envelopes(motion, bands, rate)
    last = found[middle > len(motion) / rate - 1.0]
    return float(rms(last[:, 0] - last[:, 0].mean()) / abs(np.asarray(bands.envelope)[0]))


def measure(settings: Sequence[Setting], rounds: int = 5, progress: Callable[[str], None] | None = None) -> list[Point]:
    """Accuracy of every setting, then its cost, in turns.

    Parameters
    ----------
    settings : sequence of Setting
    rounds : int
        Of timing; the median counts.
    progress : callable, optional
        Told what is done next.

    Returns
    -------
    list of Point
    """
    wanted, points = scenes(), []
    for setting in settings:
        if progress is not None:
            progress(f"{setting.method}, {setting.what}")
        try:
            errors = {
                name: found_error(play(setting, bands, SLIDING, SECONDS), bands, setting.rate, (FREE, HELD))
                for name, bands in wanted.items()
            }
        except (HapticError, ValueError) as error:
            points.append(Point(setting=setting, refused=str(error)))
            continue
        points.append(Point(setting=setting, error=max(errors.values()), scenes=errors))
    able = [index for index, point in enumerate(points) if not point.refused]
    if progress is not None:
        progress("timing")
    clocks = {index: _clock(points[index].setting) for index in able}
    spent: dict[int, list[tuple[float, float]]] = {index: [] for index in able}
    for _ in range(rounds):
        for index in able:
            spent[index].append(clocks[index]())
    for index in able:
        each, whole = (float(value) for value in np.median(spent[index], axis=0))
        points[index] = replace(points[index], nanoseconds=1e9 * each, speed=1.0 / whole)
    return points


def _clock(setting: Setting) -> Callable[[], tuple[float, float]]:
    """A function that times a band-sample of the controller alone, and a simulated second, for the comb of eight.

    By itself the controller is shown what it saw in the loop, where a second is like any other: carriers and finger
    are back where they were.  Each run that is timed follows one of its own, as both go on and on where they are used.
    """
    bands, seconds = scenes()["8 bands"], 1.0
    alone, within = setting.controller(bands), setting.controller(bands)
    plate = Plate(setting.parameters(), replace(SLIDING, touches=((0.0, 1e5),)), block=setting.block)
    closed(setting, within, plate, SECONDS)
    seen = closed(setting, within, plate, seconds)
    sensed = np.concatenate([each.sensed for each in seen])
    position, nothing = np.concatenate([np.asarray(each.position) for each in seen]), np.zeros(len(sensed))

    def spent(run: Callable[[], object]) -> float:
        run()
        start = time.perf_counter()
        run()
        return time.perf_counter() - start

    def clock() -> tuple[float, float]:
        each = spent(lambda: alone.run(sensed, position, nothing)) / len(sensed) / len(bands)
        return each, spent(lambda: closed(setting, within, plate, seconds)) / seconds

    clock()
    return clock


def front(points: Sequence[Point], cost: Callable[[Point], float]) -> list[Point]:
    """Points that no other beats in both error and cost, the cheapest first; `ALIKE` errors count as the same."""
    found: list[Point] = []
    for point in sorted((each for each in points if each.stable), key=lambda each: (cost(each), each.error)):
        if not found or point.error < ALIKE * found[-1].error:
            found.append(point)
    return found


def stability(progress: Callable[[str], None] | None = None) -> dict[str, Array]:
    """How every method holds a carrier 2 s after a touch, the worst of `TOUCHES`, shape (2, carriers) each.

    First the relative error, infinite where nothing is rendered, then how much the envelope still wanders, rms over
    what is wanted; NaN where the method refuses the carrier.  Each is played alone, 50 um, the method as it comes.
    """
    found = {}
    for name, method in METHODS.items():
        if progress is not None:
            progress(f"stability: {name}")
        setting = Setting(method=name, what="as it comes", design=_plain(method))
        found[name] = np.zeros((2, len(MAP)))
        for at, frequency in enumerate(MAP):
            bands = tones([float(frequency)], 50e-6)
            for _, mechanics, load, place in TOUCHES:
                finger = pressing(mechanics, load, place, on=1.0, off=10.0)
                try:
                    motion = play(setting, bands, finger, SECONDS)
                except HapticError:
                    found[name][:, at] = np.nan
                    continue
                seen = (
                    found_error(motion, bands, setting.rate, ((3.0, SECONDS),)),
                    wandering(motion, bands, setting.rate),
                )
                found[name][:, at] = np.maximum(found[name][:, at], seen)
    return found


def pareto(
    path: str | os.PathLike[str],
    *,
    settings: Sequence[Setting] | None = None,
    rounds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> list[Point]:
    """Measure and draw the chart, and write the data beside the picture.

    Parameters
    ----------
    path : path-like
        PNG to write; the data go into a .json of the same name.
    settings : sequence of Setting, optional
        By default `every_setting`.
    rounds : int
        Of timing.
    progress : callable, optional

    Returns
    -------
    list of Point

    Raises
    ------
    MissingExtra
        matplotlib is not installed; the data are written all the same.
    """
    points = measure(every_setting() if settings is None else settings, rounds, progress)
    held = stability(progress)
    path = Path(path)
    with replacing(path.with_suffix(".json")) as scratch:
        scratch.write_text(json.dumps(as_data(points, held), indent=2) + "\n", encoding="utf-8")
    from hapticrender.charts.pareto_picture import draw

    save(draw(points, held), path)
    return points


def as_data(points: Sequence[Point], held: dict[str, Array]) -> dict[str, Any]:
    """Everything that the chart shows, as plain data; what is not finite is null."""
    cheapest = front(points, lambda each: each.nanoseconds)

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "points": [
            {
                "method": each.setting.method,
                "setting": each.setting.what,
                "rate": each.setting.rate,
                "block": each.setting.block,
                "error": number(each.error),
                "scenes": {name: number(value) for name, value in each.scenes.items()},
                "ns_per_band_sample": number(each.nanoseconds),
                "simulated_seconds_per_second": each.speed,
                "front": each in cheapest,
                "refused": each.refused,
            }
            for each in points
        ],
        "stability": {
            "carrier": MAP.tolist(),
            "error": {name: [number(value) for value in rows[0]] for name, rows in held.items()},
            "wandering": {name: [number(value) for value in rows[1]] for name, rows in held.items()},
        },
    }
