"""The ring: scene -> renderer -> controller -> driver -> device, file or plant, and back; it counts samples."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticrender import defaults
from hapticrender.bands import Bands
from hapticrender.contract import check_driver, check_sensed
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.methods import method_named
from hapticrender.errors import HapticError, PlateMismatch
from hapticrender.protocols import Array, Controller, Driver, Plant, Renderer, Sensed
from hapticrender.recordings.recording import Recorder, Recording
from hapticrender.touch.scene import Scene

MISMATCH = 0.03  # largest share of a target that the integral part may have to add on the untouched device
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
    design: Callable[..., Controller]
    waveform: Callable[[Array, Array], Array]

    def controller(self) -> Controller:
        """Return a controller at rest, designed for this session."""
        return self.design(self.model, self.bands, feedback=self.driver.sensed_channels > 0)

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
    try:
        return found[name].load()
    except Exception as error:
        raise HapticError(f"{group[:-1]} {name!r} cannot be loaded: {type(error).__name__}: {error}") from error


def prepare(
    scene: Scene,
    *,
    driver: Driver | None = None,
    method: str = defaults.METHOD,
    seed: int = 0,
    renderer: Renderer | None = None,
) -> Session:
    """Do all the design-time work of a run and check it; see `render` for the parameters and errors."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed = {seed!r}: must be an integer >= 0")
    chosen = method_named(method)
    renderer = renderer or registered("renderers", scene.device)()
    if driver is None:
        driver = registered("drivers", "simulated")(renderer.plant(scene, seed))
    else:
        check_driver(driver)
        driver = renderer.connect(scene, driver)
    check_driver(driver)
    model = renderer.band_model(scene, driver)
    bands = renderer.bands(scene, model)
    session = Session(
        scene=scene,
        method=method,
        seed=int(seed),
        driver=driver,
        model=model,
        bands=bands,
        design=partial(renderer.design, chosen),
        waveform=renderer.waveform(scene),
    )
    _warm_up(session)
    return session


def render(
    scene: Scene,
    *,
    driver: Driver | None = None,
    method: str = defaults.METHOD,
    seed: int = 0,
    renderer: Renderer | None = None,
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
    renderer : Renderer, optional
        Of the device's kind; by default the installed one that `scene.device` names.
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
    session = prepare(scene, driver=driver, method=method, seed=seed, renderer=renderer)
    return run(session, journal=journal, progress=progress)


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
        drive_limit=session.model.drive_limit if np.isfinite(session.model.drive_limit) else None,
        unit=session.model.unit,
        drive_unit=session.model.drive_unit,
        profile=session.model.profile,
    )
    with recorder, driver:
        done = 0
        for block in _blocks(session, total):
            recorder.append(**block._asdict())
            done += len(block.drive)
            if progress is not None:
                progress(done / driver.rate, total / driver.rate)
    return recorder.finish()


def _warm_up(session: Session) -> None:
    """Compile before the device is live: a block through a controller that is thrown away.

    Where controller and plant are closed in compiled code nothing is live, and nothing would use what was compiled.
    """
    closes = getattr(session.driver, "compiled_with", None)
    if closes is not None and closes(session.controller()) is not None:
        return
    block = session.driver.block
    nothing = np.zeros(block)
    session.controller().run(np.zeros((block, session.driver.sensed_channels)), nothing, nothing)


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
    controller = session.controller()
    compiled_with = getattr(session.driver, "compiled_with", None)
    plant = compiled_with(controller) if compiled_with is not None else None
    ring = _Ring(session, controller) if plant is None else _CompiledRing(session, controller, plant)
    for start in range(0, total, size):
        yield ring.advance(start, min(size, total - start))
    _compare(controller)


def _wanted(session: Session, start: int, position: Array) -> Array:
    """Waveform of the texture over a block, where the controller has to analyse it."""
    if session.bands.envelope is not None:
        return np.zeros(len(position))
    wanted = np.asarray(session.waveform(_time(session, start, len(position)), position), float)
    if wanted.shape != position.shape:
        kind = type(session.scene.texture).__name__
        raise ValueError(f"{kind}.waveform returned shape {wanted.shape}: must be {position.shape}, one a sample")
    away = np.isnan(position) if (session.bands.wavenumber > 0.0).all() else False
    return np.where(away, 0.0, wanted)  # nothing is wanted of a finger that is away


def _asked(session: Session, target: Array) -> Array:
    """Return what is wanted of the device, from what its sensors are to show."""
    shown = session.bands.shown
    return target if shown is None else target / shown


def _time(session: Session, start: int, count: int) -> Array:
    return (start + np.arange(count)) / session.driver.rate


def _compare(controller: Controller) -> None:
    """Warn where a controller that can tell has met another device than it was designed for."""
    mismatch = getattr(controller, "mismatch", 0.0)
    if mismatch > MISMATCH:
        warnings.warn(
            f"the device is not the one designed for: the integral part makes up for {100 * mismatch:.1f} % of a "
            f"target (bound {100 * MISMATCH:g} %); identify it (hapticrender.plants.identify)",
            PlateMismatch,
            stacklevel=2,
        )


class _CompiledRing:
    """Plant and controller closed in compiled code, sample by sample."""

    def __init__(self, session: Session, controller: Controller, plant: Plant) -> None:
        self.session, self.controller, self.plant = session, controller, plant

    def advance(self, start: int, count: int) -> _Block:
        """Play `count` samples."""
        wanted = _wanted(self.session, start, self.plant.finger_position(count))
        drive, target, flags, sensed = self.plant.closed_loop(self.controller, wanted)
        target = _asked(self.session, target)
        return _complete(self.session, start, sensed)._replace(drive=drive, target=target, flags=flags)


class _Ring:
    """Driver and controller handing blocks to each other."""

    def __init__(self, session: Session, controller: Controller) -> None:
        self.session, self.controller = session, controller
        self.drive = np.zeros((session.driver.block, session.driver.drive_channels))

    def advance(self, start: int, count: int) -> _Block:
        """Play as many blocks as `count` samples need; the last one is cut in the record, not on the device."""
        step = self.session.driver.block
        blocks = [self._turn(at) for at in range(start, start + count, step)]
        return _Block(*(np.concatenate(column)[:count] for column in zip(*blocks, strict=True)))

    def _turn(self, at: int) -> _Block:
        """One block round the ring."""
        session, played = self.session, self.drive
        sensed = check_sensed(session.driver, session.driver.play(played), len(session.model.places))
        block = _complete(session, at, sensed)
        wanted = _wanted(session, at, block.position)
        self.drive, target, flags = self.controller.run(block.sensed, block.position, wanted)
        return block._replace(drive=played, target=_asked(session, target), flags=flags | block.flags)


def _complete(session: Session, at: int, sensed: Sensed) -> _Block:
    """Fill in what the device cannot tell: the scene's finger, and motion as the sensors see it."""
    finger, model = session.scene.finger, session.model
    values = sensed.sensed
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
        position=finger.position(time) if sensed.position is None else sensed.position,
        normal_load=finger.load(time) if sensed.normal_load is None else sensed.normal_load,
        target=values[:, :0],
        flags=np.zeros(len(time), np.int64) if sensed.flags is None else sensed.flags,
    )
