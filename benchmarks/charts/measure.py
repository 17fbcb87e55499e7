"""Measure accuracy against cost: methods, settings and devices on fixed scenes under a sliding finger.

Accuracy is the worst relative rms error of any band at the first judged place, over all scenes of a device. Cost is the
time of the controller alone for a sample of a band, and the simulated seconds a second of controller, device and finger
together, over the first second of a touch, without supervision (a loop that it stops would cost nothing). Times are
measured in turns, so that other work of the machine affects all settings alike; they are this machine's, their order is
not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hapticrender import Finger, Grating, Scene
from hapticrender.control.methods import METHODS
from hapticrender.control.supervisor import supervised
from hapticrender.errors import HapticError
from hapticrender.loop import prepare, run
from hapticrender.plants.plate import Plate
from hapticrender.protocols import Rendering

TONES = (47.0, 120.0, 178.0, 261.0)  # Hz
PARTIALS = tuple(np.arange(50.0, 401.0, 50.0))  # Hz
VELOCITY, EACH = 10e-3, 4e-3  # m/s: skin velocity of a tone, and of each of the partials of a friction device
AMPLITUDE = 10e-6  # m: of each of the partials on the plate
SECONDS = 3.0  # of a scene; judged from 1 s on
SWEEP = np.geomspace(20.0, 400.0, 27)  # Hz
LOST = 0.5  # a larger relative error counts as no rendering at all
EQUAL = 0.9  # an error smaller by less than a tenth is not worth any cost
HEAVY = Finger.sliding(speed=0.1, span=0.05, normal_load=0.8, mechanics="heavy")
LIGHT = Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
LEVELS = {"vt-plate": ("",), "electroadhesion": ("envelope", "carrier"), "ultrasonic": ("envelope", "carrier")}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One point of a chart: a method, how it is set, and on what."""

    method: str
    what: str = "default"  # name of what follows; "default" as the method comes
    options: dict[str, Any] = field(default_factory=dict)  # parameters of the method's class that differ from its own
    heave_only: bool = False  # whether the device model is reduced to heave
    device: str = "vt-plate"
    level: str = ""  # of the device's simulation; "" for the only one
    rate: float = 5000.0  # Hz
    block: int = 1  # samples; 1 is sample by sample

    @property
    def law(self) -> Any:
        """Control method with its options."""
        known: Any = METHODS[self.method]
        return replace(known, **self.options)

    def session(self, texture: Grating, finger: Finger) -> Rendering:
        """Prepare a texture under a finger."""
        level: dict[str, Any] = {"level": self.level} if self.level else {}
        plate = {"rate": self.rate, "delay": self.block} if self.device == "vt-plate" else {}
        scene = Scene(
            texture=texture,
            finger=finger,
            device=self.device,
            duration=SECONDS,
            profile=plate,
            simulation=level,
            keep_unfelt=True,
        )
        session = prepare(scene, method=self.method)
        model = _heave_only(session.model) if self.heave_only else session.model
        if self.options or self.heave_only or self.block > 1:
            model, bands = replace(model, block=self.block), session.bands
            session = replace(session, model=model, controller=lambda: supervised(self.law.design(model, bands), model))
        return session


def _heave_only(model: Any) -> Any:
    """Reduce a model of the plate to heave; both coils push equally."""
    parts = {name: getattr(model, name)[:1, :1] for name in ("mass", "damping", "stiffness")}
    parts |= {name: getattr(model, name)[:1] for name in ("force_from_drive", "coordinate_from_sensed")}
    parts |= {name: getattr(model, name)[:, :1] for name in ("side_from_coordinate", "place_from_coordinate")}
    return replace(model, **parts)


@dataclass(frozen=True, kw_only=True)
class Point:
    """Result of a setting: worst error (1), controller time (ns a band-sample), speed (s/s), error of each scene."""

    setting: Setting
    error: float = np.inf
    nanoseconds: float = np.inf
    speed: float = 0.0
    scenes: dict[str, float] = field(default_factory=dict)
    refused: str = ""

    @property
    def held(self) -> bool:
        """Whether every scene was rendered at all."""
        return self.error < LOST


def methods_and_settings() -> list[Setting]:
    """Settings of the Pareto chart: every method on the plate, with what a user can set."""
    found = [Setting(method=name) for name in METHODS]
    for name in ("paper", "paper-common", "boxcar"):
        found += [
            Setting(method=name, what=f"{width:g} Hz", options={"bandwidths": (width, 2 * width)})
            for width in (2.5, 10)
        ]
    for name in ("static", "stiffness"):
        found.append(Setting(method=name, what="feedforward", options={"feed_forward": True}))
    found.append(Setting(method="resonant", what="5 1/s", options={"gain": 5.0}))
    found += [Setting(method=name, what="heave only", heave_only=True) for name in ("h", "h2")]
    found += [
        Setting(method=name, what=f"blocks of {block} at {rate / 1000:g} kHz", rate=rate, block=block)
        for name in ("h2", "inverse")
        for rate, block in ((5000.0, 10), (5000.0, 25), (48000.0, 32), (48000.0, 64))
    ]
    return found


def devices_and_levels() -> list[Setting]:
    """Settings of the device chart: five methods on every device and level."""
    return [
        Setting(method=name, device=device, level=level)
        for device, levels in LEVELS.items() for level in levels
        for name in ("inverse", "h", "static", "stiffness", "paper-common")
    ]  # fmt: skip


def scenes(device: str) -> dict[str, Grating]:
    """The fixed textures: four tones, and eight partials together."""
    phases = np.random.default_rng(1).uniform(0.0, 2 * np.pi, len(PARTIALS))
    found = {f"{frequency:g} Hz": Grating(frequency=frequency, velocity=VELOCITY) for frequency in TONES}
    lowest, displaced = PARTIALS[0], device == "vt-plate"
    partials = tuple(
        (f / lowest, 1.0 if displaced else lowest / f, float(p)) for f, p in zip(PARTIALS, phases, strict=True)
    )
    size: dict[str, Any] = {"amplitude": AMPLITUDE} if displaced else {"velocity": EACH}
    return found | {"8 bands": Grating(frequency=lowest, partials=partials, **size)}


def error_of(setting: Setting, texture: Grating, finger: Finger) -> float:
    """Largest relative rms error of any band at the first judged place; infinite beyond `LOST`."""
    summary = run(_block_by_block(setting, texture, finger)).summary()
    place = next(key for key in summary["bands"][0] if key.startswith("rms_error_"))
    values = [np.inf if band[place] is None else float(band[place]) for band in summary["bands"]]
    return max(values) if max(values) < LOST else np.inf


def _block_by_block(setting: Setting, texture: Grating, finger: Finger) -> Rendering:
    """The session of a setting, on a driver that hands over its blocks."""
    session = setting.session(texture, finger)
    if setting.block > 1:
        simulated: Any = session.driver
        plate = Plate(simulated.plant.parameters, finger, 0, block=setting.block)
        driver = type(simulated)(plate)
        session = replace(session, driver=driver, device=driver, plant=None)
    return session


def measure(settings: Sequence[Setting], rounds: int = 5, progress: Callable[[str], None] = print) -> list[Point]:
    """Measure the accuracy of every setting, then its cost in turns; the fastest of `rounds` counts."""
    points = []
    for setting in settings:
        progress(" ".join(filter(None, (setting.device, setting.level, setting.method, setting.what))))
        finger = HEAVY if setting.device == "vt-plate" else LIGHT
        try:
            errors = {name: error_of(setting, texture, finger) for name, texture in scenes(setting.device).items()}
        except (HapticError, ValueError) as error:
            points.append(Point(setting=setting, refused=str(error)))
            continue
        points.append(Point(setting=setting, error=max(errors.values()), scenes=errors))
    progress("timing")
    clocks = {index: _clock(point.setting) for index, point in enumerate(points) if not point.refused}
    spent: dict[int, list[tuple[float, float]]] = {index: [] for index in clocks}
    for _ in range(rounds):
        for index, clock in clocks.items():
            spent[index].append(clock())
    for index, times in spent.items():
        each, whole = np.min(times, axis=0)
        points[index] = replace(points[index], nanoseconds=1e9 * float(each), speed=1 / float(whole))
    return points


def _clock(setting: Setting) -> Callable[[], tuple[float, float]]:
    """Return a function that times a band-sample of the controller, and a simulated second, for eight bands."""
    session = _block_by_block(
        setting, scenes(setting.device)["8 bands"], HEAVY if setting.device == "vt-plate" else LIGHT
    )
    plant = session.driver.plant  # type: ignore[attr-defined]
    recorded = run(session)
    count = int(session.driver.rate) // setting.block * setting.block
    sensed, position = np.asarray(recorded.sensed)[:count], np.asarray(recorded.position)[:count]
    silence = np.zeros(count)

    def spent(work: Callable[[], object]) -> float:
        start = time.thread_time()
        work()
        return time.thread_time() - start

    def loop(within: Any) -> None:
        if setting.block == 1:
            plant.closed_loop(within, silence)
            return
        drive, nothing = np.zeros((setting.block, session.driver.drive_channels)), np.zeros(setting.block)
        for _ in range(0, count, setting.block):
            seen = plant.run(drive)
            drive = within.run(seen.sensed, seen.position, nothing)[0]

    def clock() -> tuple[float, float]:
        alone, within = (setting.law.design(session.model, session.bands) for _ in range(2))
        each = spent(lambda: alone.run(sensed, position, silence)) / len(sensed) / len(session.bands)
        return each, spent(lambda: loop(within)) / (count / session.driver.rate)

    clock()
    return clock


def front(points: Sequence[Point], cost: Callable[[Point], float]) -> list[Point]:
    """Points that no other beats in both error and cost, the cheapest first."""
    found: list[Point] = []
    for point in sorted((each for each in points if each.held), key=lambda each: (cost(each), each.error)):
        if not found or point.error < EQUAL * found[-1].error:
            found.append(point)
    return found


def over_frequency(settings: Sequence[Setting], progress: Callable[[str], None] = print) -> dict[str, list[float]]:
    """Error of a tone of each frequency of `SWEEP` with every setting, by method and device."""
    found = {}
    for setting in settings:
        progress(f"over frequency: {setting.device} {setting.method}")
        finger = HEAVY if setting.device == "vt-plate" else LIGHT
        errors = []
        for frequency in SWEEP:
            try:
                errors.append(error_of(setting, Grating(frequency=float(frequency), velocity=VELOCITY), finger))
            except (HapticError, ValueError):
                errors.append(np.nan)
        found[f"{setting.device} {setting.method}"] = errors
    return found
