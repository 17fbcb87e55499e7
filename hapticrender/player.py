"""Live play: textures, finger and gain change while a device plays.

    with hr.Player("vt-plate") as player:
        player.play(hr.Grating(wavelength=1e-3, amplitude=10e-6))
        player.finger(position=0.01, velocity=0.08, load=0.4)

Controller and renderers are those of `render`; a `LiveLoop` advances them block by block.  A driver that calls back
(`start`, `stop`) is handed it as its callback; one whose controller runs on the device (`loop`) brings its own; any
other is played by a thread.

A texture fades into the next one under the same controller, which keeps what it has learned of finger and device.
Where the controller works by bands (hybrids) each texture has one, which goes on from the state of the one before.
"""

import atexit
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from hapticrender.checks import flag, number, require
from hapticrender.control.carriers import FASTEST
from hapticrender.devices import open_driver
from hapticrender.errors import DeviceTimeout, HapticError, WatchdogTimeout, noted_on
from hapticrender.jit import Addressed
from hapticrender.live_loop import LiveLoop, LiveMotion
from hapticrender.live_threads import LiveThreads, foresee, hold_to_clock
from hapticrender.loop import FADE_OUT, differences, import_early, opened, play_zeros, prepare, recorder_of, warn_of
from hapticrender.player_scene import scenes_of
from hapticrender.player_state import BandState, PlayerState
from hapticrender.process_signals import stopped_by_signal
from hapticrender.protocols import Driver, Flag, Rendering, Texture
from hapticrender.recordings.recording import Recorder, Recording
from hapticrender.sampled_texture import REACH
from hapticrender.touch.composed import Playlist
from hapticrender.touch.finger import MOST_LOAD, Finger
from hapticrender.touch.scene import Scene

MOST_GAIN = 10.0
LONGEST_WATCHDOG = 60.0  # s
SHORTEST = 1e-3  # s: duration of a scene that has no end, as a recording says
SERVICE = 0.05  # s between two looks: what comes next is computed, what was is recorded, faults are seen
LEAST_PART = 0.1  # s, of a playlist along the surface: twice the time between two looks at what is due
UPDATES = 0.2  # s: two positions within this time show a velocity
END_FADE = 0.05  # s: five time constants of the gain; and the longest that zeros are waited for
POINTING, INSTANT = 0.01, 1e-4  # s between two positions of a scene's finger; over which its velocity is found
TIMEOUT = 5.0  # s without a sample, after which a paced device is given up; without a call, an application


class Player(Addressed):
    """Plays textures on a device while the application goes on; used in a `with` statement.

    Its methods may be called from any thread; `finger` never waits for the others.  Signals that end the process leave
    zero drive where the `with` is entered in the main thread; elsewhere the application handles them (docs/live.md).

    Parameters
    ----------
    device : str or Scene
        Kind of device, or a profile; or a scene, whose tables, method, seed and finger are used.  The finger of a scene
        moves by itself until `finger` is called; else there is the finger of `finger` only.
    driver : Driver or str, optional
        As for `render`; the simulated device by default.
    finger : Finger, optional
        For which the device is designed, and whose mechanics a simulated finger has; by default one that slides at
        0.08 m/s under 0.4 N, or that of the scene.
    paced : bool
        False: a simulation, or a driver that does not wait, plays only within `sleep`, as fast as it can, and a
        simulation reproducibly.
    watchdog : float, s, optional
        Where no method of this player is called for so long, the application counts as hung and the drive is stopped
        permanently, within 10 ms; 0.1 to 60, and at least two blocks of the driver; inf: never.  `sleep` counts as
        calls.  Unless it is given: 5 s (and two blocks) while a finger that `finger` has set touches the surface.
    **tables
        Further fields of the scene, in place of its own: profile, simulation, rendering, method, seed.  No touch_panel:
        that of a scene locates the finger that moves by itself; positions passed to `finger` are taken as they are.

    Raises
    ------
    ValueError, TypeError
        An argument is out of its bound.
    """

    _held = "a device and threads"

    def __init__(
        self,
        device: str | Scene = "vt-plate",
        driver: Driver | str | None = None,
        *,
        finger: Finger | None = None,
        paced: bool = True,
        watchdog: float | None = None,
        **tables: Any,
    ) -> None:
        if watchdog not in (None, math.inf):
            watchdog = number("watchdog", watchdog, "s", least=2.0 * SERVICE, most=LONGEST_WATCHDOG)
        self._scene = scenes_of(device, finger, tables)  # what is not there is refused at once
        self._of_scene = isinstance(device, Scene)
        self._driver, self._paced, self._watchdog = driver, flag("paced", paced), watchdog
        self._motion = LiveMotion()
        self._parts, self._until = deque[tuple[Rendering, float]](), math.inf  # the first plays until then (s)
        self._finger: tuple[float, float, float] | None = None  # position, velocity and load that were set,
        self._finger_time = 0.0  # and when
        self._loop: LiveLoop | Any = None  # or that of a board, with its interface; None: nothing plays yet
        self._gain, self._lost, self._raised = 1.0, 0, False
        self._error: BaseException | None = None
        self._recorder: Recorder | None = None
        self._unwritten: OSError | None = None  # that has ended the recording, such as a full disk
        self._calls, self._watched = 0, math.inf  # of the application under way; s: the watchdog's time at the moment
        self._entered, self._recorded = False, 0  # samples of this loop that were looked at
        self._stack, self._threads, self._lock = ExitStack(), LiveThreads(), threading.RLock()
        self._stopping, self._timeout = self._threads.stopping, TIMEOUT  # s; and two blocks of the driver
        self._changing = threading.RLock()  # of the texture; taken before `_lock`

    def __enter__(self) -> Self:
        self._entered = True
        self._stack.enter_context(stopped_by_signal())
        atexit.register(self.__exit__, None, None, None)  # where the program ends before its `with` does
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Zero drive, then close the device and the recording; a fault not seen yet is raised, later ones noted."""
        if not self._entered:  # a generator's `with`, after the program's end
            return
        first, compared = error or (None if self._raised else self._error), tuple[str, ...]()
        with stopped_by_signal(wait=True), noted_on(first), ExitStack() as last:  # last to first, whatever fails
            last.callback(atexit.unregister, self.__exit__)
            last.callback(self._close_recorder, kind is not None or self._error is not None)
            last.callback(self._leave, kind is None)
            if kind is not None and self._loop is not None:
                with suppress(Exception):  # zero drive at once: another thread may be in a long call, such as `state`
                    self._loop.silence()
            if not isinstance(self._error or error, Exception):  # which Ctrl-C is not; before the device is closed
                compared = self._compare()
        if kind is None and self._error is not None and not self._raised:
            raise self._error
        if kind is None and self._error is None and (slow := getattr(self._loop, "slow", "")):
            raise HapticError(slow)
        if self._unwritten is not None:
            if error is None:
                raise self._unwritten
            error.add_note(f"and the recording is not whole: {self._unwritten}")
        warn_of(compared)

    @property
    def time(self) -> float:
        """Time played so far (s)."""
        return 0.0 if self._loop is None else self._loop.samples / self._loop.driver.rate

    @property
    def gain(self) -> float:
        """Factor on every texture, 0 to 10 (on a board to 1); a new one is reached to 1 % within 50 ms."""
        return self._gain

    @gain.setter
    def gain(self, gain: float) -> None:
        with self._lock, self._busy():
            gain = number("gain", gain, least=0.0, most=MOST_GAIN)  # an amplitude belongs in the texture
            if self._loop is not None:
                self._loop.set_gain(gain)
            self._gain = gain

    def play(self, texture: Texture) -> None:
        """Play a texture until the next one, into which it fades; the first one starts the device.

        The parts of a `Playlist` follow each other in the same way, each up to 0.1 s late, where one lies along the
        surface; any other playlist is played to the sample.

        Raises
        ------
        ValueError, TypeError
            The device cannot play it; what plays goes on.
        DeviceFault, DriverError
            The device has failed.
        """
        parts = texture.parts if isinstance(texture, Playlist) and texture.spatial else ((texture, math.inf),)
        if (shortest := min(seconds for _, seconds in parts)) < LEAST_PART:
            raise ValueError(f"a part of {shortest:g} s of a playlist along the surface: must be >= {LEAST_PART:g} s")
        with self._changing, self._busy():  # the device goes on: a long recording takes seconds to prepare
            scenes, loop = [self._scene(texture=each) for each, _ in parts], self._loop
            renderings = [] if loop is None else [self._prepare(each) for each in scenes]
            made = [] if loop is None else [loop.made(each) for each in renderings]
            with self._lock:
                self._check()
                if loop is None:
                    renderings = self._begin(scenes)
                else:
                    loop.replace(renderings[0], *made[0])
                self._parts = deque(zip(renderings, (seconds for _, seconds in parts), strict=True))
                self._until = self.time + parts[0][1]

    def _prepare(self, scene: Scene) -> Rendering:
        """Return the rendering of a scene on the device that plays."""
        playing = self._loop.rendering
        return prepare(scene, driver=None if playing.plant is not None else playing.device, compiled=False)

    def _go_on(self) -> None:
        """Fade into the next part of a playlist where it is due."""
        if self.time >= self._until:
            self._parts.rotate(-1)
            rendering, seconds = self._parts[0]
            self._until += seconds
            self._loop.replace(rendering, *self._loop.made(rendering))

    def finger(self, position: float, velocity: float | None = None, load: float = 0.4) -> None:
        """Set where the finger is: position (m from the middle, NaN: lifted), velocity (m/s), normal load (N).

        At most 0.15 m, 10 m/s, 20 N.  Velocity (or that since the last call) holds for 50 ms, a spatial texture 0.25 s.
        """
        self._check()
        now, sane = time.monotonic() if self._paced else self.time, False
        with suppress(TypeError, ValueError, OverflowError):
            if velocity is None:
                moved, passed = position - (self._finger or (math.nan,))[0], now - self._finger_time
                velocity = moved / passed if 0.0 < passed < UPDATES and abs(moved) <= FASTEST * passed else 0.0
            position, velocity, load = (float(1.0 * each) for each in (position, velocity, load))
            sane = not abs(position) > REACH and abs(velocity) <= FASTEST and 0.0 <= load <= MOST_LOAD
        if velocity is None or not sane:
            bound = f"{REACH:g} m from the middle of the surface (NaN: lifted), {FASTEST:g} m/s, 0 to {MOST_LOAD:g} N"
            raise ValueError(f"{position=} m, {velocity=} m/s, {load=} N: must be at most {bound}")
        self._finger, self._finger_time = (position, velocity, load), now
        self._motion.update(position, velocity, load)
        if self._loop is not None:
            self._loop.finger(position, velocity, load)

    def record(self, path: str | Path) -> None:
        """Keep everything from now on in a journal (.au), until `end_recording` or the end; the device must play."""
        with self._lock, self._busy():
            loop = self._playing("record")
            require(isinstance(path, str | Path), "path", path, "the name of a journal, such as session.au", TypeError)
            if self._recorder is not None:
                raise ValueError(f"{path}: a recording is under way: call end_recording first")
            self._service()
            rendering = replace(loop.rendering, model=loop.model)
            scene = rendering.scene if self._of_scene else replace(rendering.scene, duration=SHORTEST)
            bands = replace(rendering.bands.select(np.zeros(0, int)), envelope=None, unfelt=())
            recorder = recorder_of(rendering, path, scene=scene, bands=bands)
            recorder.begin()
            self._recorder = recorder

    def end_recording(self) -> Recording:
        """End the recording and return it."""
        with self._lock:
            if self._loop is not None and self._error is None:
                self._loop.alive()
            if self._recorder is None:
                raise ValueError("nothing is being recorded: call record first")
            self._service()
            recorder, unwritten, self._recorder, self._unwritten = self._recorder, self._unwritten, None, None
            if unwritten is not None:
                raise unwritten
            recording = recorder.finish()
            recording.warnings = self._compare()
            return recording

    def _compare(self) -> tuple[str, ...]:
        loop = self._loop
        return () if loop is None else differences(loop.rendering, getattr(loop, "learned", None), self._lost)

    def state(self) -> PlayerState:
        """Return what plays at the moment, and what became of it."""
        with self._lock, self._busy():
            loop = self._playing("state")
            self._service()
            load = float(getattr(loop.rendering.device, "cpu_load", math.nan))
            bands = tuple(BandState(*row) for row in loop.figures())
            return PlayerState(self.time, loop.model.unit, bands, loop.flags, self._lost, load)

    def sleep(self, seconds: float) -> None:
        """Wait until the device has played for so long; one that is not paced plays meanwhile.

        A `DeviceFault` or `DriverError` where the device has failed.
        """
        seconds = number("seconds", seconds, "s", least=0.0)
        with self._lock:
            self._check()
            rate = self._playing("sleep").driver.rate
        end = self.time + seconds
        while self.time < end - 0.5 / rate:
            if self._paced:
                self._stopping.wait(min(end - self.time, SERVICE))
            else:
                self._advance(min(end - self.time, SERVICE))
            with self._lock:
                self._check()

    def _playing(self, what: str) -> LiveLoop | Any:
        if self._loop is None:
            raise ValueError(f"{what}: nothing plays yet: call play first")
        return self._loop

    def _check(self) -> None:
        """Raise what has gone wrong meanwhile; note that the application has called."""
        if self._error is not None:
            self._raised = True
            raise self._error
        if self._stopping.is_set():
            raise ValueError("the player has been closed: make a new one")
        if not self._entered:
            raise ValueError("the player is not open: use it in a with statement")
        if self._loop is not None:
            self._loop.alive()

    @contextmanager
    def _busy(self) -> Iterator[None]:
        """A call of the application that may take long: meanwhile the watchdog waits."""
        with self._lock:
            self._check()
            self._calls += 1
            self._watch()
        try:
            yield
        finally:
            with self._lock:
                self._calls -= 1
                self._watch()

    def _watch(self) -> None:
        """Set the watchdog: it waits while a call is under way and, unless it was given, while no finger is set."""
        unattended = self._timeout if self._finger and not math.isnan(self._finger[0]) else math.inf
        seconds = math.inf if self._calls else self._watchdog or unattended
        if self._loop is not None and seconds != self._watched:
            self._watched = seconds
            self._loop.watch(None if seconds == math.inf else seconds)

    def _begin(self, scenes: list[Scene]) -> list[Rendering]:
        """Make the driver, start the device with the first scene's texture, and prepare those of the others."""
        given = self._driver
        driver: Any = open_driver(given, scenes[0].device_profile) if isinstance(given, str) else given
        live = driver.live() if hasattr(driver, "live") and hasattr(driver, "start") else driver
        try:
            rendering = prepare(scenes[0], driver=live, compiled=False)
            return self._start(rendering, scenes[1:])
        except BaseException as error:
            with noted_on(error), self._stack:  # what has been opened is left at rest
                self._loop = None
            raise

    def _start(self, rendering: Rendering, others: list[Scene]) -> list[Rendering]:
        """Open the device at rest, probe it, prepare what plays later, and play."""
        import_early()
        device: Any = rendering.device
        stack, calls_back = self._stack, hasattr(device, "start")
        own = rendering.driver is device and hasattr(device, "loop")
        blocks = 2 * rendering.driver.block / rendering.driver.rate
        self._timeout = TIMEOUT + blocks
        if self._watchdog is not None and self._watchdog < blocks:
            raise ValueError(f"watchdog = {self._watchdog:g} s: must be >= {blocks:g} s, two blocks of the driver")
        if (calls_back or own) and not self._paced:
            raise ValueError("paced = False: must be True on a device with a clock of its own")
        scales = {name: getattr(device, name) for name in ("sensed_scale", "drive_scale")} if calls_back else {}
        loop: Any = device.loop(rendering) if own else LiveLoop(rendering, **scales)
        if not self._of_scene and rendering.plant is not None:
            self._motion.attach(rendering)
        stack.enter_context(opened(rendering.driver, device, self._threads.hanging.is_set))
        if rendering.probe is not None:
            rendering.probe(device)
        self._loop = loop
        loop.set_gain(self._gain)
        if self._finger is not None:
            loop.finger(*self._finger)
        later = [self._prepare(each) for each in others]
        for each in later:
            loop.made(each)
        if calls_back:
            device.start(loop)
            stack.callback(device.stop)
            self._run(lambda: foresee(loop, self._stopping), device, lambda: loop.evaluating)
        elif own:
            loop.start()
        elif self._paced:
            self._run(lambda: hold_to_clock(loop, self._block, self._stopping), device)
        if self._paced:
            self._run(self._serve, device, lambda: getattr(loop, "computing", ""))
        return [rendering, *later]

    def _run(self, target: Callable[[], None], device: object, busy: Callable[[], str] | None = None) -> None:
        """Run `target` in a thread until the player stops; what it raises is kept for the application."""

        def failed(error: BaseException) -> None:
            self._error = self._error or error
            with suppress(Exception):  # zero drive at once, on a device that may have failed
                self._loop.silence()
            if busy is None:  # the thread that plays: no other one may
                with suppress(Exception):
                    play_zeros(self._loop.rendering.device)

        self._stack.callback(self._threads.end, self._threads.start(target, failed), device, self._timeout, busy or str)

    def _block(self, late: bool = False, most: int = 0) -> int:
        """Play a block, see `LiveLoop.advance`."""
        return self._loop.advance(self._of_scene or self._finger is None, late, most)

    def _advance(self, seconds: float) -> None:
        """Play for so long in this thread."""
        loop = self._loop
        left = max(round(seconds * loop.driver.rate / loop.driver.block), 1) * loop.driver.block
        while left > 0 and not self._stopping.is_set():
            left -= self._block(most=left)
        with self._lock:
            self._watch()
            self._go_on()
            loop.fill()
            self._service()

    def _serve(self) -> None:
        loop, served, seen, idle = self._loop, 0.0, 0, 0.0  # s: last look; samples by then; s without a new one
        period = SERVICE if isinstance(loop, LiveLoop) else POINTING
        while not self._stopping.wait(POINTING):
            due = time.monotonic() - served >= period
            if due and isinstance(loop, LiveLoop):
                loop.fill_some()  # which may take long: others go on meanwhile
            with self._lock:
                if self._stopping.is_set():
                    return
                self._watch()
                self._point()
                self._go_on()
                if due:
                    served = time.monotonic()
                    self._service()
                    seen, idle = loop.samples, idle + period if loop.samples == seen else 0.0
                if idle > self._timeout:  # by looks: time during which this process stood still does not count
                    raise DeviceTimeout(f"the device has played no sample for {idle:.2g} s: check it and driver")

    def _point(self) -> None:
        """Send the position of the scene's finger to a device that does not sense it."""
        if self._of_scene and self._finger is None and not self._loop.senses:
            finger, now = self._loop.rendering.scene.finger, self.time + np.array([0.0, INSTANT])
            (here, there), load = finger.position(now), finger.load(now)[0]
            self._loop.finger(here, float(np.nan_to_num((there - here) / INSTANT)), load)

    def _service(self) -> None:
        """Record what was, see whether the device or the application has stopped."""
        loop = self._loop
        if hasattr(loop.rendering.device, "check"):
            loop.rendering.device.check()  # one that calls back cannot say that it is gone
        fault = loop.fault()  # before the signals are read, so that all of what led to it is recorded
        first, signals = loop.signals(self._recorded)
        gap, self._recorded = first - self._recorded, first + len(signals["flags"])
        if isinstance(loop, LiveLoop):
            loop.watch_touches(signals, gap)
        self._lost += gap + int(np.count_nonzero(signals["flags"] & Flag.OVERRUN))
        if self._recorder is not None and self._unwritten is None and len(signals["flags"]):
            try:
                self._recorder.append(motion_source=loop.motion_source, gap=gap, **signals)
            except OSError as error:
                self._unwritten = error
                self._close_recorder(stopped=False)
        if isinstance(fault, WatchdogTimeout):
            fault = WatchdogTimeout(fault.time, self._watchdog or self._timeout)
        self._error = self._error or fault

    def _leave(self, gently: bool) -> None:
        """Set zero drive and close the device, one that is being opened, too; no other is opened."""
        with self._lock:
            self._entered = False
            stack = self._stack.pop_all()
        with stack:
            try:
                self._rest(gently)
            finally:
                self._stopping.set()

    def _rest(self, gently: bool) -> None:
        """Set zero drive, after a fade where nothing has failed, and wait until a whole block of it has been played."""
        if (loop := self._loop) is None:
            return
        running = self._paced and self._error is None
        with self._lock:
            self._calls += 1  # the last one
            self._watch()
        if gently and running:
            loop.set_gain(0.0)
            time.sleep(END_FADE)
        with suppress(*[] if self._error is None else [HapticError]):  # one that is lost cannot be silenced
            loop.silence()
        end, limit = loop.samples + 2 * loop.driver.block + FADE_OUT * loop.driver.rate, time.monotonic() + END_FADE
        while running and loop.samples < end and time.monotonic() < limit:
            time.sleep(1e-3)
        with self._lock:
            if self._error is None:
                self._service()

    def _close_recorder(self, stopped: bool) -> None:
        try:
            if self._recorder is not None:
                self._recorder.close(stopped)
        except OSError as error:
            self._unwritten = self._unwritten or error
