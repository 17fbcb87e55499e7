"""The ring: scene -> renderer -> controller -> driver -> device, file or plant, and back; it counts samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.methods import method_named
from hapticrender.protocols import Array, Controller, Driver, Renderer, Sensed
from hapticrender.recording import Recorder, Recording
from hapticrender.touch.scene import Scene

CHUNK = 0.25  # s of signal between two writes of the journal

Progress = Callable[[float, float], None]


@dataclass(frozen=True, kw_only=True)
class Session:
    """Everything that a run needs, designed and checked; nothing has been played yet."""

    scene: Scene
    method: str
    seed: int
    driver: Driver
    model: BandModel
    bands: Bands
    controller: Controller

    @property
    def samples(self) -> int:
        """Length of the run in samples."""
        return max(int(round(self.scene.duration * self.driver.rate)), 1)


def registered(group: str, name: str) -> Any:
    """Load what the entry-point `group` (renderers, drivers) registers under `name`."""
    found = {point.name: point for point in entry_points(group=f"hapticrender.{group}")}
    if name not in found:
        raise ValueError(
            f"{group[:-1]} {name!r} is not installed: must be one of {', '.join(sorted(found)) or '(none)'}"
        )
    return found[name].load()


def prepare(scene: Scene, *, driver: Driver | None = None, method: str = "paper", seed: int = 0) -> Session:
    """Do all the design-time work of a run and check it; see `render` for the parameters and errors."""
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"seed = {seed!r}: must be an integer >= 0")
    chosen = method_named(method)
    renderer: Renderer = registered("renderers", scene.device)()
    if driver is None:
        driver = registered("drivers", "simulated")(renderer.plant(scene, seed))
    model = renderer.band_model(scene, driver)
    bands = renderer.bands(scene, model)
    controller = chosen.design(model, bands, feedback=driver.sensed_channels > 0)
    return Session(
        scene=scene, method=method, seed=seed, driver=driver, model=model, bands=bands, controller=controller
    )


def render(
    scene: Scene,
    *,
    driver: Driver | None = None,
    method: str = "paper",
    seed: int = 0,
    journal: str | Path | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Render a scene in closed loop and return what happened.

    Parameters
    ----------
    scene : Scene
        What is touched, by what, on which kind of device.
    driver : Driver, optional
        Any object that follows the protocol of `hapticrender.drivers.base`; the simulated device by default.
    method : str
        Name of the control method (`hapticrender.control.methods.METHODS`).
    seed : int
        Of the simulated sensor noise, >= 0.
    journal : path, optional
        File (.au) that keeps every sample while it happens; a killed process leaves it readable.
    progress : callable, optional
        Called as ``progress(done, total)`` in seconds of signal.

    Returns
    -------
    Recording
        Drive (A), sensed and true motion (m), position (m), targets (m) and flags, sample by sample.

    Raises
    ------
    ValueError, TypeError
        The scene asks for what the device cannot do; nothing has been played or written.
    DesignError
        The loop cannot be made stable enough.
    DriverError
        The device failed; it was left at zero drive, and the journal holds what happened until then.
    """
    return run(prepare(scene, driver=driver, method=method, seed=seed), journal=journal, progress=progress)


def run(session: Session, *, journal: str | Path | None = None, progress: Progress | None = None) -> Recording:
    """Play a prepared session to its end; see `render`."""
    driver = session.driver
    total = session.samples
    recorder = Recorder(
        journal,
        scene=session.scene,
        method=session.method,
        seed=session.seed,
        rate=driver.rate,
        bands=session.bands,
        drive_channels=driver.drive_channels,
        sensed_channels=driver.sensed_channels,
        places=session.model.places,
        drive_limit=session.model.drive_limit,
    )
    with recorder, driver:
        done = 0
        for block in _blocks(session, total):
            recorder.append(**block._asdict())
            done += len(block.drive)
            if progress is not None:
                progress(done / driver.rate, total / driver.rate)
    return recorder.finish()


class _Block(NamedTuple):
    """What happened over some samples, complete: the columns of a recording; `drive` as handed to the device."""

    drive: Array
    sensed: Array
    motion: Array
    position: Array
    normal_load: Array
    target: Array
    flags: Array


def _blocks(session: Session, total: int) -> Iterator[_Block]:
    """Everything that happens in a run, about `CHUNK` seconds at a time."""
    block = session.driver.block
    size = block * max(int(CHUNK * session.driver.rate / block), 1)
    plant = getattr(session.driver, "plant", None)
    advance = _advance_compiled if plant is not None and block == 1 else _Ring(session).advance
    for start in range(0, total, size):
        yield advance(session, start, min(size, total - start))


def _wanted(session: Session, start: int, position: Array) -> Array:
    """Waveform of the texture over a block, where the controller has to analyse it."""
    if session.bands.envelope is not None:
        return np.zeros(len(position))
    return np.ascontiguousarray(session.scene.texture.waveform(_time(session, start, len(position)), position), float)


def _time(session: Session, start: int, count: int) -> Array:
    return (start + np.arange(count)) / session.driver.rate


def _advance_compiled(session: Session, start: int, count: int) -> _Block:
    """Plant and controller closed in compiled code, sample by sample."""
    plant = session.driver.plant  # type: ignore[attr-defined]
    wanted = _wanted(session, start, plant.finger_position(count))
    drive, target, flags, sensed = plant.closed_loop(session.controller, wanted)
    return _complete(session, start, sensed)._replace(drive=drive, target=target, flags=flags)


class _Ring:
    """Driver and controller handing blocks to each other."""

    def __init__(self, session: Session) -> None:
        driver = session.driver
        self.drive = np.zeros((driver.block, driver.drive_channels))

    def advance(self, session: Session, start: int, count: int) -> _Block:
        """Play as many blocks as `count` samples need; the last one is cut in the record, not on the device."""
        step = session.driver.block
        blocks = [self._turn(session, at) for at in range(start, start + count, step)]
        return _Block(*(np.concatenate(column)[:count] for column in zip(*blocks, strict=True)))

    def _turn(self, session: Session, at: int) -> _Block:
        """One block round the ring."""
        block = _complete(session, at, session.driver.play(self.drive))
        wanted = _wanted(session, at, block.position)
        played = self.drive
        self.drive, target, flags = session.controller.run(block.sensed, block.position, wanted)
        return block._replace(drive=played, target=target, flags=flags | block.flags)


def _complete(session: Session, at: int, sensed: Sensed) -> _Block:
    """Fill in what the device cannot tell: the scene's finger, and motion as the sensors see it."""
    finger, model = session.scene.finger, session.model
    values = np.ascontiguousarray(sensed.sensed, float)
    time = _time(session, at, len(values))
    motion = sensed.motion
    if motion is None and session.driver.sensed_channels:
        with np.errstate(invalid="ignore"):  # a sensor gone mad is the controller's to judge
            motion = values @ (model.place_from_coordinate @ model.coordinate_from_sensed).T
    elif motion is None:
        motion = np.full((len(time), len(model.places)), np.nan)
    return _Block(
        drive=values[:, :0],
        sensed=values,
        motion=motion,
        position=finger.position(time) if sensed.position is None else np.ascontiguousarray(sensed.position, float),
        normal_load=finger.load(time)
        if sensed.normal_load is None
        else np.ascontiguousarray(sensed.normal_load, float),
        target=values[:, :0],
        flags=np.zeros(len(time), np.int64) if sensed.flags is None else np.asarray(sensed.flags, np.int64),
    )
