"""Boards behind a serial line: the controller runs on the board; the host sends its textures and the finger's position.

`BoardClient` is the live device: set-points, finger and gain from any thread, telemetry back.  `SerialDriver` puts it
behind the driver protocol, so that ``hapticrender.render`` plays a scene on the board and judges what it streams back.
The protocol is in ``docs/protocol.md``; ``drivers/firmware`` is the board's part.
"""

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from typing import Any

import numpy as np
from serial.tools import list_ports

from hapticrender.bands import Bands
from hapticrender.drivers.base import BaseDriver
from hapticrender.drivers.board_client import BoardClient as BoardClient
from hapticrender.drivers.board_line import Line as Line
from hapticrender.drivers.board_texture import BoardTexture as BoardTexture
from hapticrender.drivers.protocol import Telemetry
from hapticrender.errors import DeviceFault, DriverError, HapticError, WatchdogTimeout
from hapticrender.protocols import Array, Controller, DeviceLoop, Flag, Rendering, Sensed

LIST_TIMEOUT = 0.3  # s that a board has to answer where boards are listed
HOST_BLOCK = 100  # samples of drive from the host
TELEMETRY = 0.05  # s between two frames of telemetry
JUDGED = 0.25  # s of signal that the figures of a texture are of
LONGEST_MEAN = 1000.0  # s, of a board; a mean over a shorter time has the larger peaks, and so stops no later


class SerialDriver(BaseDriver):
    """Plays a scene on a board whose firmware was exported for its device, in closed loop on the board.

    The board has its own law, of method "inverse"; `render` sends it the bands of the scene and records what it streams
    back, every sample: 160 kB/s at 5 kHz, as USB carries.  On a slower line samples are missing, with `Flag.OVERRUN`.
    A texture that is no sum of bands is sent as samples and as a table along the surface, see `BoardTexture`.  A board
    senses no finger: the host sends it the positions of `finger`.

    Parameters
    ----------
    port : str
        Name of the serial port.
    finger : object with ``position(time)`` (m, NaN: lifted) and ``load(time)`` (N), optional
        Such as ``hapticrender.Finger``, from the start of the run on; `render` sets it to the scene's unless given.
    **options
        Of `BoardClient`.
    """

    device_kind: str  # of which the firmware has the law

    def __init__(self, port: str, *, finger: Any = None, **options: Any) -> None:
        known = list(inspect.signature(BoardClient).parameters)[1:]
        if not port:
            raise ValueError(f"{port=}: must be the name of a serial port, such as serial:/dev/ttyACM0 or serial:COM3")
        for name in options.keys() - known:
            raise TypeError(f"option {name!r} of SerialDriver: must be one of finger, {', '.join(known)}")
        self.client = BoardClient(port, **options)
        self.finger, self._begun, self._last = finger, False, np.full(1, np.nan)
        self._state: str
        self._started = math.inf  # s, of the client's clock
        self.rendering: Rendering | None = None  # set by `prepare`
        with self.client as client:
            found = self.capabilities = client.capabilities
            self.drive_limit = found.drive_limit
            self.device_kind = "electroadhesion" if found.friction else "vt-plate"
        super().__init__(
            rate=found.rate,
            drive_channels=found.drive_channels,
            sensed_channels=found.sensed_channels,
            delay=found.delay,
        )

    @contextmanager
    def by_host(self) -> Iterator["SerialDriver"]:
        """Let the open board play the drive of the host, which acts two blocks later, and leave it at rest."""
        board = copy(self)
        board.block, board.delay = HOST_BLOCK, self.delay + 2 * HOST_BLOCK
        try:
            yield board
        finally:
            self.client.stop()

    @classmethod
    def found(cls) -> list[str]:
        """Serial ports that are there now, and the boards that answer there."""
        return [f"{port.device}  {port.description}; {cls._board(port.device)}" for port in list_ports.comports()]

    @classmethod
    def _board(cls, port: str) -> str:
        try:
            board = cls(port, timeout=LIST_TIMEOUT)
        except (OSError, HapticError) as error:
            return f"no board answers ({type(error).__name__})"
        return f"a board of {board.rate:g} Hz, {board.drive_channels} out, {board.sensed_channels} in"

    def device_loop(self, controller: Controller) -> DeviceLoop:
        """Return the board's own loop, with the scene's texture.

        A `DriverError` where the method is not that of the board's law; a ValueError where it cannot play the texture.
        """
        inner: Any = getattr(controller, "controller", controller)
        rendering = self.rendering
        if rendering is None or inner.method != "inverse":
            raise DriverError(
                f"{self}: device_loop: method {inner.method!r} of this scene cannot run on a board: must be 'inverse'"
            )
        loop = BoardLoop(rendering, self)
        if loop.texture is not None and inner.n_bands and not self.capabilities.friction:
            raise ValueError(f"texture: carriers = {inner.n_bands}: must be left out on a board, which plays it whole")

        def advance(count: int, reference: Callable[[Array], Array]) -> tuple[Array, Array, Array, Sensed]:
            if not self._begun:
                self._begun = True
                loop.start()
                self._started = self.client.clock.monotonic()
            try:
                rows = self.client.rows(count, self._point)
            except DeviceFault:
                rows = self.client.rows()  # until it stopped, `fault` says why
            found = self.signals(rows)
            target = self._targets(rendering, found["position"])
            names = ("sensed", "position", "normal_load", "flags")
            return found["drive"], target, found["flags"], Sensed(**{name: found[name] for name in names})

        return advance

    def _targets(self, rendering: Rendering, position: Array) -> Array:
        """Envelopes of the scene's bands (n, bands), for a finger at `position` (m, shape (n,))."""
        bands, away = rendering.bands, np.isnan(position)[:, None]
        envelope = np.zeros(0) if bands.envelope is None else bands.envelope
        target = np.tile(np.asarray(envelope, complex), (len(position), 1))
        if bands.differentiated:
            speed = np.nan_to_num(np.diff(position, prepend=self._last) * self.rate)  # 0 as the finger touches
            self._last = position[-1:]
            target *= 2j * np.pi * (bands.frequency + np.multiply.outer(speed, bands.wavenumber))
        return np.where(away & ((bands.wavenumber > 0.0) | bool(self.capabilities.friction)), 0.0, target)

    def loop(self, rendering: Rendering) -> "BoardLoop":
        """Return a loop of the board's own for live play, see `hapticrender.Player`."""
        return BoardLoop(rendering, self)

    def protect(self, rendering: Rendering) -> None:
        """Send the limits of the device, where they are below those of the board's design."""
        model, most = rendering.model, self.capabilities.drive_limit
        peak, step = rendering.scene.device_profile.limits.peak_drive or most, model.drive_step
        if step > 0.0 and peak < most:
            peak = step * math.floor(peak / step)  # what the converter rounds up would pass it
        peak, rms, time = min(peak, most), model.rms_limit, model.rms_time
        if self.capabilities.friction and (limits := rendering.scene.device_profile.limits).rms_drive:
            rms, time = math.sqrt(2.0) * limits.rms_drive, limits.rms_time  # the board's is that of the carrier's peak
        self.client.limits(peak, min(rms, peak), min(time, LONGEST_MEAN), model.sensed_bound)

    @property
    def learned(self) -> Telemetry | None:
        """What the board's law has learned of its device, as `hapticrender.loop.differences` takes it; None: lost."""
        with suppress(HapticError):  # what was played before stays
            return self.client.telemetry()
        return None

    @property
    def fault(self) -> DeviceFault | None:
        """Why the board has stopped by itself, if it has said so."""
        return self.client.failure if isinstance(self.client.failure, DeviceFault) else None

    def _point(self) -> None:
        if self.finger is None:
            return
        clock = self.client.clock.monotonic()
        now = np.array([0.0, 1e-4]) + clock - self._started
        here, there = self.finger.position(now)
        velocity = (there - here) * 1e4
        self.client.finger(here, velocity if np.isfinite(velocity) else 0.0, self.finger.load(now[:1])[0], clock)

    def signals(self, rows: Array) -> dict[str, Array]:
        """Signals of rows (n, columns), see `Rows`, by their names in a recording."""
        a, b = self.drive_channels, self.drive_channels + self.sensed_channels
        rows = rows.reshape(-1, b + 4)
        signals = dict(zip(("position", "normal_load", "reference", "flags"), rows[:, b:].T, strict=True))
        return signals | {"drive": rows[:, :a], "sensed": rows[:, a:b], "flags": signals["flags"].astype(np.int64)}

    def _open(self) -> None:
        self.client.open()

    def _play(self, drive: Array) -> Sensed:
        """Queue a block on the board, one block ahead of what it plays, and return what was sensed in the block."""
        client = self.client
        if self.block == 1:
            raise DriverError(f"{self}: play: the loop runs on the board; for drive from the host use by_host()")
        if not self._begun:
            self._begun = True
            client.begin_queue()
            client.queue(np.zeros_like(drive))
        client.queue(drive)
        found = self.signals(client.rows(self.block))
        return Sensed(found["sensed"], flags=found["flags"])

    def close(self) -> None:
        """Stop the board and close the port; once closed it stays so."""
        was, self._state = self._state, "closed"
        if was == "open":
            self.client.close()

    def __str__(self) -> str:
        return f"SerialDriver({self.client.port})"


class BoardLoop:
    """A rendering that plays on a board; what `hapticrender.live_loop.LiveLoop` is for a controller of this process.

    A ValueError where a board cannot play its texture, which must be of displacements.
    """

    senses = False  # the host sends the finger's position

    def __init__(self, rendering: Rendering, driver: SerialDriver) -> None:
        self.rendering, self.driver, self.model = rendering, driver, rendering.model
        self.samples, self.flags = 0, Flag(0)
        self.motion_source = "sensors" if driver.sensed_channels else "unknown"
        self._client = client = driver.client
        self.finger, self.watch, self.alive, self.silence = client.finger, client.watch, client.beat, client.stop
        self._bands, self.texture = self.made(rendering)
        self._recent = np.zeros((0, 3))  # reference, motion and position, m
        self._reconnections = 0  # that have been noted

    def start(self) -> None:
        """Set the bands and play; the port is open."""
        self.driver.protect(self.rendering)
        self._client.set_bands(self._bands, self.texture)
        self._client.start(stream=1, telemetry=TELEMETRY)
        self._reconnections = self._client.reconnections

    def made(self, rendering: Rendering) -> tuple[Bands, BoardTexture | None]:
        """Return what the board plays of a rendering: bands, or none and a texture, which `BoardTexture` may refuse.

        A screen plays all as textures: its law makes friction of a waveform's derivative.
        """
        bands, board = rendering.bands, self.driver.capabilities
        if bands.envelope is not None and len(bands) and not (bands.modulated or board.friction):
            return bands, None
        texture = BoardTexture(rendering.scene.texture, board, rendering.model, rendering.waveform_of)
        return Bands.none(spatial=False), texture

    def replace(self, rendering: Rendering, bands: Bands, texture: BoardTexture | None) -> None:
        """Change to what was `made` of another rendering of the device: within 20 ms from bands to bands, else 40."""
        self._client.set_bands(bands, texture)
        self.rendering, self._bands, self.texture = rendering, bands, texture

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, 0 to 1."""
        self._client.gain = gain

    def fault(self) -> HapticError | None:
        """Check the telemetry; return why the board stopped the drive, if it did.

        A `DriverError` where board or line are gone.  A board that was lost and found again plays a new run, whose
        carriers begin anew; what was lost is not counted.
        """
        if self._client.reconnections != self._reconnections:
            self._reconnections = self._client.reconnections
            self.flags |= Flag.OVERRUN
        try:
            self.flags |= self._client.telemetry().flags
        except (DeviceFault, WatchdogTimeout) as fault:
            self.flags |= Flag.STOPPED
            return fault
        return None

    @property
    def learned(self) -> Telemetry | None:
        """What the board's law has learned of its device, unless that was stopped."""
        return None if self.flags & Flag.STOPPED else self.driver.learned

    def signals(self, start: int) -> tuple[int, dict[str, Array]]:
        """Return the number of the first sample and the signals that the board has streamed since the last call."""
        found = self.driver.signals(self._client.rows())
        first, count = self.samples, len(found["flags"])
        self.samples += count
        senses = self.driver.sensed_channels > 0
        motion = found["sensed"] @ self.model.place_from_sensed.T if senses else np.full((count, 1), np.nan)
        recent = np.vstack([self._recent, np.stack([found["reference"], motion[:, 0], found["position"]], axis=1)])
        self._recent = recent[-round(JUDGED * self.driver.rate) :]
        return first, {**found, "motion": motion, "target": np.zeros((count, 0), complex)}

    def figures(self) -> list[tuple[float, float, float, float]]:
        """Return frequency (Hz), target, achieved (m) and relative error of every band, from the latest telemetry.

        Of a texture that is no sum of bands the amplitudes are rms, over the last quarter of a second.
        """
        if self.texture is not None and len(self._recent):
            reference, motion, _ = (self._recent - self._recent.mean(axis=0)).T
            target, achieved, off = (float(np.sqrt(np.mean(x**2))) for x in (reference, motion, motion - reference))
            return [(0.0, target, achieved, off / target if target > 0.0 else math.nan)]
        speed = np.nan_to_num(abs(np.diff(self._recent[:, 2]))).sum() * self.driver.rate / max(len(self._recent) - 1, 1)
        rows, frequency = [], self._bands.frequency + self._bands.wavenumber * speed
        for hertz, band in zip(frequency, self._client.telemetry().bands, strict=False):
            moves = float(hertz > 0.0)  # a grating under a finger that rests has no amplitude
            size, error = moves * abs(band.target), abs(band.measured - band.target)
            rows.append((float(hertz), size, moves * abs(band.measured), error / size if size > 0.0 else math.nan))
        return rows
