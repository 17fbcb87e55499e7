"""The loop: scene -> renderer -> controller -> driver -> device, file or plant, and back; it counts samples."""

import inspect
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.analysis.two_touches import TouchWatch
from hapticrender.control.controller import PositionPredictor
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.supervisor import FADE_OUT, Fault
from hapticrender.control.supervisor_kernel import STOPPED
from hapticrender.devices import check_calibration, open_driver
from hapticrender.devices import registered as registered
from hapticrender.driver_checks import check_sensed, opened_once
from hapticrender.errors import DeviceFault, PlateMismatch, noted_on
from hapticrender.inferred import ContactLag
from hapticrender.mathx import on_time
from hapticrender.process_signals import ended_with_program, stopped_by_signal
from hapticrender.protocols import Array, Controller, DeviceLoop, Driver, Flag, Renderer, Rendering, Sensed
from hapticrender.recordings.recording import Recorder, Recording
from hapticrender.touch.composed import is_in_time, refuse_to_overwrite
from hapticrender.touch.scene import Scene

LOST = "lost, which may be all that is wrong: free the computer, or take larger blocks"
MISMATCH = 0.03  # of what the model asks for: most that the controller may have to add on the untouched device
RECENT = 0.1  # s before a stop, of which it is said how many samples were lost
CHUNK = 0.25  # s of signal between two writes of the journal
PIECE = 0.02  # s of signal that is looked through and recorded at once, where blocks are shorter

Progress = Callable[[float, float], None]


def prepare(
    scene: Scene | str | os.PathLike[str],
    *,
    driver: Driver | str | None = None,
    method: str | None = None,
    seed: int | None = None,
    renderer: Renderer | None = None,
    compiled: bool = True,
) -> Rendering:
    """Do all the design-time work of a run and check it; see `render` for the parameters and errors.

    What a run needs is compiled here, unless `compiled` is false.
    """
    if isinstance(scene, str | os.PathLike):
        scene = Scene.from_toml(scene)
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: must be a Scene or the name of a scene file, not {type(scene).__name__}")
    changes: dict[str, Any] = {"method": method, "seed": seed}
    scene = replace(scene, **{key: value for key, value in changes.items() if value is not None})
    if isinstance(driver, str):
        driver = open_driver(driver, scene.device_profile)
    elif driver is not None:
        check_calibration(driver, scene.device_profile)
    if driver is not None and getattr(driver, "finger", driver) is None:
        driver.finger = scene.finger  # type: ignore[attr-defined]
    refuse_to_overwrite(scene.texture, getattr(driver, "path", None))
    kind = getattr(driver, "device_kind", scene.device)
    if kind != scene.device:
        cure = "export this scene to it, or take another driver"
        raise ValueError(f"device = {scene.device!r}: {driver} has the law of {kind!r} on it: {cure}")
    renderer = registered("renderers", scene.device)() if renderer is None else renderer
    if inspect.isclass(renderer) or not callable(getattr(renderer, "open", None)):
        kind = f"class {renderer.__name__}" if inspect.isclass(renderer) else type(renderer).__name__
        raise TypeError(f"renderer: must be an object with open(scene, driver), such as a BaseRenderer(), not {kind}")
    rendering = renderer.open(scene, driver)
    if not isinstance(rendering, Rendering):
        kinds = type(renderer).__name__, type(rendering).__name__
        raise TypeError(f"{kinds[0]}.open returned {kinds[1]}: must be hapticrender.Rendering")
    if driver is not None and getattr(driver, "rendering", driver) is None:
        driver.rendering = rendering  # type: ignore[attr-defined]
    if compiled:
        _warm_up(rendering)
    return rendering


def render(
    scene: Scene | str | os.PathLike[str],
    *,
    driver: Driver | str | None = None,
    method: str | None = None,
    seed: int | None = None,
    renderer: Renderer | None = None,
    journal: str | Path | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Render a scene in closed loop and return what happened.

    Parameters
    ----------
    scene : Scene or path
        A scene, or the name of a scene file (TOML).
    driver : Driver or str, optional
        Any object that follows the protocol of `hapticrender.drivers.base`, or a text as ``--driver`` takes it
        ("audio:0", "package.module:callable"; see `hapticrender.devices.open_driver`); the simulated device by default.
    method : str, optional
        Name of the control method (`hapticrender.control.methods.METHODS`); default: that of the scene.
    seed : int, optional
        Of the simulated sensor noise, >= 0; default: that of the scene.
    renderer : Renderer, optional
        By default the installed one that `scene.device` names.
    journal : path, optional
        File (.au) that keeps every sample while it happens; a killed process leaves it readable.
    progress : callable, optional
        Called as ``progress(done, total)`` in seconds of signal.

    Raises
    ------
    ValueError, TypeError
        The scene asks for what the device cannot do; nothing has been played or written.
    DesignError
        The loop cannot be made stable enough.
    DriverError
        The device failed; it was left at zero drive, and the journal holds what happened until then.
    DeviceFault
        The device does not follow its drive; a DriverError that names the most likely cause (docs/safety.md).
    """
    rendering = prepare(scene, driver=driver, method=method, seed=seed, renderer=renderer)
    return run(rendering, journal=journal, progress=progress)


def run(rendering: Rendering, *, journal: str | Path | None = None, progress: Progress | None = None) -> Recording:
    """Play a prepared rendering to its end; see `render`.

    However it ends (an error, a signal as docs/safety.md says), every sample played is recorded and the device is left
    at zero drive.
    """
    driver, total = rendering.driver, rendering.samples
    recorder, lost = recorder_of(rendering, journal, requested=rendering.requested), 0

    def keep(*parts: Callable[[], dict[str, Any]]) -> None:
        nonlocal lost
        with stopped_by_signal(wait=True):  # else what was played since the last call is lost
            for part in parts:
                if len((signals := part())["flags"]):
                    lost += int(np.count_nonzero(signals["flags"] & Flag.OVERRUN))
                    recorder.append(**signals)

    device = rendering.device
    if rendering.plant is None:
        import_early()
    with stopped_by_signal(), recorder, ended_with_program() as ending, opened(driver, device):
        if rendering.probe is not None:
            rendering.probe(device)
        loop = _Loop(rendering)
        try:
            for start in range(0, total, loop.step):
                loop.advance(start, min(loop.step, total - start))
                keep(loop.known)
                if loop.faded:
                    break
                if ending.is_set():
                    raise SystemExit("the program has ended")
                if progress is not None:
                    progress(min(start + loop.step, total) / driver.rate, total / driver.rate)
        finally:
            keep(loop.known, loop.rest)
        if fault := loop.fault():
            fault.recording = recorder.finish()
            raise fault
        compared = differences(rendering, getattr(device, "learned", loop.controller), lost)
    recording = recorder.finish()
    recording.least_scale = getattr(loop.controller, "least_scale", 1.0)
    recording.warnings = compared
    warn_of(recording.warnings, recording)
    return recording


def import_early() -> None:
    """Import what would else be imported while a device plays, which waits for it: up to 0.1 s, a board 80 ms."""
    for name in ("scipy.fft", "scipy.ndimage", "scipy.signal", "scipy.special", "soundfile"):
        import_module(name)


def recorder_of(rendering: Rendering, journal: str | Path | None = None, **changes: Any) -> Recorder:
    """Return the writer of a recording of `rendering`; `changes` are arguments of `Recorder` in place of its own."""
    driver, model, scene = rendering.driver, rendering.model, rendering.scene
    refuse_to_overwrite(scene.texture, journal)
    calibration = getattr(rendering.device, "calibration", 0.0) or scene.device_profile.calibration.gain_uncertainty
    arguments = {
        "scene": scene,
        "duration": scene.duration if "requested" in changes else 0.0,  # a live session ends when it ends
        "method": scene.method,
        "seed": scene.seed,
        "rate": driver.rate,
        "bands": rendering.bands,
        "drive_channels": driver.drive_channels,
        "sensed_channels": driver.sensed_channels,
        "drive_limit": model.drive_limit if np.isfinite(model.drive_limit) else None,
        "sensed_noise": (model.sensed_noise * np.linalg.norm(model.place_from_sensed, axis=1)).tolist(),
        "calibration": float(calibration),
        **{name: getattr(model, name) for name in ("places", "unit", "drive_unit", "profile", "block", "delay")},
    }
    return Recorder(journal, **(arguments | changes))


def device_fault(rendering: Rendering, controller: Any, sample: int, flags: Array) -> DeviceFault:
    """Return the error of a drive that was stopped from `sample` on: what driver or controller have found.

    No `controller`: the device stopped itself.  `flags` are those of the samples before.
    """
    found = (getattr(owner, "fault", None) for owner in (rendering.driver, controller))
    text = next((each.text for each in found if isinstance(each, Fault)), "the device stopped itself")
    time, lost = sample / rendering.driver.rate, int(np.count_nonzero(flags & Flag.OVERRUN))
    if lost:
        text = f"{lost} of the {len(flags)} samples until then were {LOST}; found was: {text}"
    return DeviceFault(f"{type(rendering.device).__name__}: stopped at {time:.4g} s: {text}", time)


def stops_itself(sensed: Sensed, controller: Any) -> bool:
    """Whether a device says that it has stopped, and the controller has not stopped it."""
    return bool(
        sensed.flags is not None and (sensed.flags & STOPPED).any() and getattr(controller, "fault", None) is None
    )


def samples_late(driver: Driver, model: DeviceModel, stated: bool) -> float:
    """Samples after which motion is shown: by sensors, or `stated` by the driver, which may have a `motion_delay`."""
    delay = getattr(driver, "motion_delay", 0.0) if stated else model.sensor_delay if driver.sensed_channels else 0.0
    return max(delay, 0.0) * model.rate


def motion_of(driver: Driver, model: DeviceModel, signals: dict[str, Array], contact: ContactLag) -> Array:
    """Motion at the evaluation points (n, places) at the first n samples of `signals`, for which it is known by now.

    It is the ``motion`` that the driver states, that of the sensors, or NaN; friction is inferred behind `contact`.
    """
    stated = signals.get("motion")
    late = samples_late(driver, model, stated is not None)
    count = max(len(signals["flags"]) - math.ceil(late), 0)
    if stated is not None:
        return on_time(stated, count, late)
    if not driver.sensed_channels:
        return np.full((count, len(model.places)), np.nan)
    with np.errstate(invalid="ignore"):  # a faulty sensor is the controller's to flag
        motion = on_time(signals["sensed"] @ model.place_from_sensed.T, count, late)
        return contact.run(motion, signals["position"][:count]) if model.inferred else motion


def motion_source(driver: Driver, model: DeviceModel, stated: bool) -> str:
    """Where `motion_of` comes from."""
    if stated:
        return str(getattr(driver, "motion_source", "true"))
    return "unknown" if not driver.sensed_channels else "inferred" if model.inferred else "sensors"


def play_zeros(driver: Driver) -> None:
    """Play zeros until they have come through."""
    for _ in range(-(-driver.delay // driver.block)):
        driver.play(np.zeros((driver.block, driver.drive_channels)))


def _warm_up(rendering: Rendering) -> None:
    """Compile before the device is live: a block through a controller that is thrown away.

    Where controller and plant are closed in compiled code nothing is live, and what was compiled would not be used.
    """
    controller = rendering.controller()
    if _device_loop(rendering.driver, controller) is None:
        block = rendering.driver.block
        nothing = np.zeros(block)
        controller.run(np.zeros((block, rendering.driver.sensed_channels)), nothing, nothing)


@contextmanager
def opened(driver: Any, device: Driver, hangs: Callable[[], bool] = lambda: False) -> Iterator[Any]:
    """Open the driver of a device, once; however it ends, play zeros and close it, while signals wait.

    Zeros are not played where the device does so itself; where it `hangs`, they are not, and nothing is closed.
    """
    with opened_once(device), stopped_by_signal(), ExitStack() as waiting, ExitStack() as stack:
        entered = driver.__enter__()
        stack.push(partial(_close, driver, hangs))
        stack.push(lambda kind, error, _: _rest(device, error, hangs))
        stack.callback(lambda: waiting.enter_context(stopped_by_signal(wait=True)))
        yield entered


def _close(driver: Any, hangs: Callable[[], bool], *error: Any) -> None:
    """Close the driver; a failure is noted on the error that there is already, which no driver can suppress."""
    with noted_on(error[1]):
        if not hangs():
            driver.__exit__(*error)


def _rest(device: Driver, error: BaseException | None, hangs: Callable[[], bool]) -> None:
    """Play zeros until they have come through; a failure is noted on the error that there is already."""
    with noted_on(error, "the drive was set to zero"):
        if not (getattr(device, "zero_on_exit", False) or hangs()):
            play_zeros(device)


def _device_loop(driver: Driver, controller: Controller) -> DeviceLoop | None:
    """Loop of a driver that runs this controller itself, sample by sample; None where it takes blocks only."""
    offered = getattr(driver, "device_loop", None)
    return None if offered is None else offered(controller)


class _Loop:
    """Driver and controller in closed loop, `step` samples a call."""

    def __init__(self, rendering: Rendering) -> None:
        self.rendering, self.controller = rendering, rendering.controller()
        driver = rendering.driver
        self._device_loop = _device_loop(driver, self.controller)
        piece = PIECE if self._device_loop is None else CHUNK
        self.step = driver.block * max(int(piece * driver.rate / driver.block), 1)
        self._start, self._ahead = 0, int(getattr(self.controller, "lookahead", 0))
        self._predict = PositionPredictor(driver.rate, self._ahead)
        self._in_time = is_in_time(rendering.scene.texture)
        self._touches = TouchWatch(rendering.model, self.controller, active=rendering.plant is None)
        self._contact = ContactLag(rendering.model.contact_length)
        self._held: dict[str, Array] = {"flags": np.zeros(0, int)}  # of samples whose motion has not been shown yet
        self._has_motion = False  # whether the device states it
        self._recent = np.zeros(0, int)  # flags
        self._short = False  # whether a device that runs the loop has played less than it was to
        self._stopped, self._itself = -1, False  # sample from which on the drive fades out; whether by the device
        self._drive = np.zeros((driver.block, driver.drive_channels))
        self._played: list[dict[str, Array]] = []  # blocks since `known`
        self._first, self._next, self._count = 0, 0, 0  # their first sample, the one after, and how many are recorded

    def advance(self, start: int, count: int) -> None:
        """Play `count` samples from sample `start` on; an error leaves what was played until then to `known`."""
        self._start = self._first = start
        self._count = count
        if self._device_loop is not None:
            self._keep(*self._device_loop(count, self._reference))
            self._short = self._next < start + count
            return
        finger, block = self.rendering.scene.finger, self.rendering.driver.block
        time = self._time(-(-count // block) * block)  # whole blocks: a motion may end with the scene
        position, load = finger.position(time), finger.load(time)
        reference = self._reference(position) if self._in_time else None  # of the piece, as no driver changes it
        for first in range(0, count, block):
            self._start, here = start + first, slice(first, first + block)
            self._exchange(position[here], load[here], None if reference is None else reference[here])
            if self.faded:
                break

    def known(self) -> dict[str, Any]:
        """Signals of what was played, as far as its motion is known; a last block is cut here, not on the device."""
        if not self._played:
            return {"flags": np.zeros(0, int)}
        played, self._played = self._played, []
        signals = _joined(played)
        flags = signals["flags"]
        if self._stopped >= 0:
            flags = flags[: max(self._stopped + 1 - self._first, 0)]
        self._recent = np.append(self._recent, flags)[-round(RECENT * self.rendering.driver.rate) :]
        signals["flags"] = self._touches.update(signals)
        signals = _joined([self._held, {name: signal[: self._count] for name, signal in signals.items()}])
        found = self._moved(signals)
        count = len(found["motion"])
        self._held = {name: signal[count:] for name, signal in signals.items()}
        return {name: signal[:count] for name, signal in signals.items()} | found

    def rest(self) -> dict[str, Any]:
        """Signals of the samples that are held back for their motion, at the end: as if they went on as they came."""
        held, rendering = self._held, self.rendering
        late = math.ceil(samples_late(rendering.driver, rendering.model, "motion" in held))
        if not len(held["flags"]):
            return held
        ends = {name: [(0, late), (0, 0)][: signal.ndim] for name, signal in held.items()}
        on = {name: np.pad(each, ends[name], "reflect", reflect_type="odd") for name, each in held.items()}
        return held | self._moved(on)

    @property
    def faded(self) -> bool:
        """Whether the drive was stopped, and has faded out on the device; or it plays no more."""
        driver = self.rendering.driver
        return self._short or 0 <= self._stopped <= self._next - FADE_OUT * driver.rate - driver.delay

    def fault(self) -> DeviceFault | None:
        """Return why the drive was stopped, if it was."""
        stated = getattr(self.rendering.driver, "fault", None)
        if isinstance(stated, DeviceFault):
            stated.time = (self._next if self._stopped < 0 else self._stopped) / self.rendering.driver.rate
            return stated
        if self._stopped < 0:
            return None
        return device_fault(self.rendering, None if self._itself else self.controller, self._stopped, self._recent)

    def _exchange(self, position: Array, load: Array, reference: Array | None) -> None:
        """Exchange a block with the driver; the drive computed from it is played with the next one.

        `position` and `load` are the finger's by the scene, for a driver that states none; `reference` is None where it
        is read at the position.
        """
        driver: Any = self.rendering.driver
        played = self._drive
        if hasattr(driver, "resting"):
            driver.resting = self._stopped >= 0
        places = len(self.rendering.model.places)
        sensed = check_sensed(driver, driver.play(played.copy()), places, self._has_motion)
        self._has_motion = sensed.motion is not None
        self._itself |= stops_itself(sensed, self.controller)
        position = position if sensed.position is None else sensed.position
        load = load if sensed.normal_load is None else sensed.normal_load
        device: Any = self.rendering.device
        if sensed.flags is not None and hasattr(device, "host_delay") and hasattr(self.controller, "unplayed"):
            device_delay = self.rendering.model.delay - device.host_delay
            self.controller.unplayed(device_delay + np.flatnonzero(sensed.flags & Flag.OVERRUN))
        reference = self._reference(position) if reference is None else reference
        self._drive, target, flags = self.controller.run(sensed.sensed, position, reference)
        flags = flags if sensed.flags is None else flags | sensed.flags
        self._keep(played, target, flags, Sensed(sensed.sensed, position, sensed.motion, load))

    def _keep(self, drive: Array, target: Array, flags: Array, sensed: Sensed) -> None:
        """Keep what was played from sample `_start` on for `known`."""
        self._next = self._start + len(flags)
        if self._stopped < 0 and np.bitwise_or.reduce(flags) & STOPPED:
            self._stopped = self._start + int(np.argmax(flags & STOPPED))
        position, load, finger = sensed.position, sensed.normal_load, self.rendering.scene.finger
        signals = {"drive": drive, "sensed": sensed.sensed, "target": target, "flags": flags}
        signals["position"] = finger.position(self._time(len(flags))) if position is None else position
        signals["normal_load"] = finger.load(self._time(len(flags))) if load is None else load
        self._played.append(signals | ({} if sensed.motion is None else {"motion": sensed.motion}))

    def _reference(self, position: Array) -> Array:
        if self.rendering.bands.envelope is not None:
            return np.zeros(len(position))
        if self._ahead == 0:
            return self.rendering.reference(self._time(len(position)), position)
        time = self._time(len(position)) + self._ahead / self.rendering.driver.rate
        return self.rendering.reference(time, self._predict(position))

    def _time(self, count: int) -> Array:
        return (self._start + np.arange(count)) / self.rendering.driver.rate

    def _moved(self, signals: dict[str, Array]) -> dict[str, Any]:
        """Motion of the samples for which it is known, and its source."""
        driver, model = self.rendering.driver, self.rendering.model
        motion = motion_of(driver, model, signals, self._contact)
        return {"motion": motion, "motion_source": motion_source(driver, model, "motion" in signals)}


def _joined(blocks: list[dict[str, Array]]) -> dict[str, Array]:
    """Signals of blocks that follow each other; the first motion that is stated holds for what was played before."""
    signals = {name: np.concatenate([each[name] for each in blocks if name in each]) for name in blocks[-1]}
    if "motion" in signals:
        missing = len(signals["flags"]) - len(signals["motion"])
        signals["motion"] = np.pad(signals["motion"], [(missing, 0), (0, 0)], "edge")
    return signals


def differences(rendering: Rendering, controller: object, lost: int) -> tuple[str, ...]:
    """State where a device differs from its model, by what a controller, or its telemetry, has learned on it.

    `lost` samples were not played or not sensed, which a law in closed loop takes for a force.
    """
    scale, mismatch = getattr(controller, "damper_scale", 1.0), getattr(controller, "mismatch", 0.0)
    source, messages = rendering.scene.source, []
    if scale < 1.0:
        lacks = f", which profile {source} lacks" if source else ""
        cure = f"identify the bending mode, or the sensors' noise where there is none{lacks}"
        messages.append(f"the inner damper rang above 500 Hz and was turned down to {scale:g}: {cure}")
    if mismatch > MISMATCH:
        adds = f"the controller adds {100 * mismatch:.1f} % to what that asks for (bound {100 * MISMATCH:g} %)"
        cure = "correct [device]"
        if rendering.scene.device == "vt-plate":
            cure = "remove the finger and take the profile that `hapticrender identify --driver ... --scene ...` writes"
        first = f"of the samples {lost} were {LOST}; found was: " if lost else ""
        differs = f"the device differs from its model{f', profile {source}' if source else ''}"
        messages.append(f"{first}{differs}: {adds}; {cure}")
    return tuple(messages)


def warn_of(messages: tuple[str, ...], recording: Recording | None = None) -> None:
    """Warn of `differences`, in the name of the caller's caller; as an error it must not lose what was played."""
    for message in messages:
        try:
            warnings.warn(message, PlateMismatch, stacklevel=3)
        except PlateMismatch as error:
            error.recording = recording
            raise
