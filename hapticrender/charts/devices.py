"""Every kind of device in one chart: accuracy against the speed of its simulation, and over the frequency.

Accuracy is the worst error of any band over `scenes` at the finger, the first judged place of a device; speed is how
many seconds are simulated in one of this thread's own, controller, device and finger together, measured in turns.  The
level "envelope" is judged on itself, not against the carrier that it leaves out, so each level has a front of its own.
Speeds are this machine's, their order is not.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender import defaults
from hapticrender.accuracy.friction import EACH, FINGER, VELOCITY, texture
from hapticrender.charts.figures import save
from hapticrender.errors import HapticError
from hapticrender.loop import Session, prepare, run
from hapticrender.protocols import Plant
from hapticrender.recordings.formats import replacing
from hapticrender.touch.grating import Grating
from hapticrender.touch.scene import Scene

LEVELS = {"vt-plate": ("",), "electroadhesion": ("envelope", "carrier"), "ultrasonic": ("envelope", "carrier")}
METHODS = ("h2", "h", "static", "stiffness", "paper-common")
TONES = (47.0, 120.0, 261.0)  # Hz
PARTIALS = (50.0, 120.0, 250.0)  # Hz
SECONDS = 2.5  # of a scene; judged from 1 s on
SWEEP = tuple(np.geomspace(20.0, 400.0, 14).tolist())  # Hz: tones of the panel over frequency
LOST = 0.5  # a larger relative error counts as no rendering at all
ALIKE = 0.9  # a smaller gain in error than a tenth is not worth any speed


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One point of the chart.

    Parameters
    ----------
    device : str
        Kind of device, the name of its renderer.
    level : str
        Of its simulation; "" where there is but one.
    method : str
        Name of the control method, as it comes.
    """

    device: str
    level: str
    method: str

    @property
    def model(self) -> tuple[str, str]:
        """Device and level."""
        return self.device, self.level

    def scene(self, touched: Grating) -> Scene:
        """A texture under the sliding finger, every band of it."""
        plant = {"level": self.level} if self.level else {}
        return Scene(
            texture=touched, finger=FINGER, device=self.device, duration=SECONDS, plant=plant, keep_unfelt=True
        )


@dataclass(frozen=True, kw_only=True)
class Point:
    """What was found of a setting.

    Parameters
    ----------
    setting : Setting
    error : float
        Worst of `scenes`, relative; infinite where one is not rendered at all.
    speed : float
        Simulated seconds a second.
    scenes : dict
        Error of each scene.
    refused : str
        Why the method could not be designed.
    """

    setting: Setting
    error: float = np.inf
    speed: float = 0.0
    scenes: dict[str, float] = field(default_factory=dict)
    refused: str = ""

    @property
    def stable(self) -> bool:
        """Whether every scene was rendered at all."""
        return self.error < LOST


def every_setting() -> list[Setting]:
    """All points of the chart."""
    kinds = [(device, level) for device, levels in LEVELS.items() for level in levels]
    return [Setting(device=device, level=level, method=name) for (device, level), name in product(kinds, METHODS)]


def scenes() -> dict[str, Grating]:
    """The fixed textures: three tones, and three partials together."""
    found = {f"{frequency:g} Hz": Grating(frequency=frequency, velocity=VELOCITY) for frequency in TONES}
    return found | {"3 partials": texture(PARTIALS, EACH)}


def found_error(setting: Setting, touched: Grating) -> float:
    """Largest rms error of any band at the finger over what is wanted; infinite where it is `LOST`."""
    summary = run(prepare(setting.scene(touched), method=setting.method)).summary()
    place = next(key for key in summary["bands"][0] if key.startswith("rms_error_"))
    values = [band[place] for band in summary["bands"]]
    worst = max(np.inf if value is None else float(value) for value in values)
    return worst if worst < LOST else np.inf


def measure(settings: Sequence[Setting], rounds: int = 5, progress: Callable[[str], None] | None = None) -> list[Point]:
    """Accuracy of every setting, then its speed, in turns.

    Parameters
    ----------
    settings : sequence of Setting
    rounds : int
        Of timing; the fastest counts, the rest is the machine's other work.
    progress : callable, optional
        Told what is done next.

    Returns
    -------
    list of Point
    """
    points = []
    for setting in settings:
        if progress is not None:
            progress(" ".join(filter(None, (setting.device, setting.level, setting.method))))
        points.append(_judged(setting))
    if progress is not None:
        progress("timing")
    clocks = {index: _clock(point.setting) for index, point in enumerate(points) if not point.refused}
    spent: dict[int, list[float]] = {index: [] for index in clocks}
    for _ in range(rounds):
        for index, clock in clocks.items():
            spent[index].append(clock())
    for index, times in spent.items():
        points[index] = replace(points[index], speed=1.0 / min(times))
    return points


def _judged(setting: Setting) -> Point:
    try:
        errors = {name: found_error(setting, touched) for name, touched in scenes().items()}
    except (HapticError, ValueError) as error:
        return Point(setting=setting, refused=str(error))
    return Point(setting=setting, error=max(errors.values()), scenes=errors)


def _clock(setting: Setting) -> Callable[[], float]:
    """A function that times a simulated second of three partials, in this thread's own time, from where it is."""
    session = prepare(setting.scene(scenes()["3 partials"]), method=setting.method)
    controller, plant = session.controller(), _plant(session)
    wanted = np.zeros(int(session.driver.rate))

    def clock() -> float:
        start = time.thread_time()
        plant.closed_loop(controller, wanted)
        return time.thread_time() - start

    return clock


def _plant(session: Session) -> Plant:
    """The simulated device itself, which closes the loop in compiled code."""
    found: Plant | None = getattr(session.driver, "plant", None)
    if found is None:
        raise ValueError(f"device = {session.scene.device!r}: must be simulated by one plant to be timed")
    return found


def front(points: Sequence[Point]) -> list[Point]:
    """Points of one device and level that none beats in both error and speed, fastest first; `ALIKE` errors are one."""
    found: list[Point] = []
    for point in sorted((each for each in points if each.stable), key=lambda each: (-each.speed, each.error)):
        if not found or point.error < ALIKE * found[-1].error:
            found.append(point)
    return found


def over_frequency(
    devices: Sequence[str] = tuple(LEVELS), progress: Callable[[str], None] | None = None
) -> dict[str, list[float]]:
    """Error of a tone of each frequency of `SWEEP` on every device, the default method at the device's own level."""
    found = {}
    for device in devices:
        if progress is not None:
            progress(f"over frequency: {device}")
        setting = Setting(device=device, level="", method=defaults.METHOD)
        found[device] = [found_error(setting, Grating(frequency=each, velocity=VELOCITY)) for each in SWEEP]
    return found


def device_chart(
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
    swept = over_frequency(tuple(dict.fromkeys(each.setting.device for each in points)), progress)
    path = Path(path)
    with replacing(path.with_suffix(".json")) as scratch:
        scratch.write_text(json.dumps(as_data(points, swept), indent=2) + "\n", encoding="utf-8")
    from hapticrender.charts.devices_picture import draw

    save(draw(points, swept), path)
    return points


def fronts(points: Sequence[Point]) -> dict[tuple[str, str], list[Point]]:
    """The front of every device and level, each of which is judged on itself."""
    models = dict.fromkeys(each.setting.model for each in points)
    return {model: front([each for each in points if each.setting.model == model]) for model in models}


def as_data(points: Sequence[Point], swept: dict[str, list[float]]) -> dict[str, Any]:
    """Everything that the chart shows, as plain data; what is not finite is null."""
    best = [point for found in fronts(points).values() for point in found]

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "points": [
            {
                "device": each.setting.device,
                "level": each.setting.level or None,
                "method": each.setting.method,
                "error": number(each.error),
                "scenes": {name: number(value) for name, value in each.scenes.items()},
                "simulated_seconds_per_second": each.speed,
                "front": each in best,
                "refused": each.refused or None,
            }
            for each in points
        ],
        "over_frequency": {
            "frequency": list(SWEEP),
            "method": defaults.METHOD,
            "error": {device: [number(value) for value in values] for device, values in swept.items()},
        },
    }
