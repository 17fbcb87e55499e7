"""A board that plays textures, live: set-points, finger and gain from any thread, and what came of them."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Self, TypeVar

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import integer, number, require
from hapticrender.drivers import protocol
from hapticrender.drivers.base import OpenedInWith, carry_through
from hapticrender.drivers.board_line import BAUD, PAUSE, BoardLine, Line, open_port
from hapticrender.drivers.board_texture import BoardTexture, Pointed
from hapticrender.drivers.protocol import WRAP, Capabilities, Cause, Kind, State, Stream, Telemetry
from hapticrender.errors import DeviceFault, DeviceLost, DeviceTimeout, DriverError, HapticError, WatchdogTimeout
from hapticrender.protocols import Array, Flag

RETRY = 0.05  # s between two attempts to reach the board anew
LEAST_WATCHDOG, MOST_WATCHDOG = 0.05, 65.0  # s
DRIVE_ROWS = 24  # of drive in a frame
LONGEST_GAP = 2**16  # rows
FAULTS = {
    Cause.LIMIT: "the mean square of the drive is above its limit: lower the amplitude, or raise [limits] rms_drive",
    Cause.SENSOR: "a sensor was invalid for 10 ms: check its cable and its range",
    Cause.INVALID: "samples of a sensor are no numbers, or at the end of its range: check its cable and its range",
    Cause.FROZEN: "a sensor repeats one value while the drive moves: check its cable, supply and converter",
    Cause.INCONSISTENT: "the motion does not follow from the drive: check the wiring and polarity of sensors and coils",
    Cause.ACTIVE: "the motion grows with the drive: check the polarity of sensors and coils",
    Cause.DRIVE: "the drive stayed above what any finger needs: check wiring and amplifier, and that the board's "
    "sources were exported for the scene that needs most",
    Cause.RINGING: "the surface rings above 500 Hz: check the delay, and identify bending mode and sensor noise",
    Cause.OVERMOTION: "the surface moved too far: check the polarity of sensors and coils, and the delay",
    Cause.BEYOND: "a sensor shows more than [limits] displacement: press less, and check its unit and offset",
    Cause.SENSOR_GAIN: "a sensor is suddenly inverted, disconnected, or its gain has changed: check its wiring",
    Cause.ACTUATOR_GAIN: "the motion is that of the inverted drive: check the wiring and polarity of coils and sensors",
    Cause.SWAPPED: "each sensor shows the motion of the other: check the wiring of sensors and coils",
}
Result = TypeVar("Result")


class Rows:
    """Rows of a run: drive (A), sensed (m), position (m), load (N), reference (m) and flags.

    A row that was lost on the line repeats the one before, with `Flag.OVERRUN`.  `first` is the sample of the board's
    clock from which on it streams, that of the first row that comes unless given; `stride` the samples between two
    rows, 0 where none are streamed.
    """

    def __init__(self, first: int | None = None, stride: int = 1) -> None:
        self._next, self._stride = first, stride or 1  # sample of the next row, or one up to a stride before it
        self._rows: list[Array] = []
        self._last: Array | None = None
        self._broken = False  # rows were lost; their number is unknown

    def __len__(self) -> int:
        return len(self._rows)

    def restart(self, first: int) -> None:
        """Go on with the same rows after the board began anew at sample `first`, on a clock that may be another."""
        if self._missing(first) >= LONGEST_GAP:
            self._next, self._broken = first, True

    def _missing(self, first: int) -> int:
        return 0 if self._next is None else (first - self._next) % WRAP // self._stride

    def add(self, block: Stream) -> None:
        """Append the rows of a frame, after those that were lost before it."""
        rows, missing = np.array(block.rows), self._missing(block.first)
        if missing >= LONGEST_GAP or not len(rows):
            return  # of an earlier run
        if self._broken:
            rows[0, -1], self._broken = int(rows[0, -1]) | Flag.OVERRUN, False
        if missing:
            lost = np.array(rows[0] if self._last is None else self._last)
            lost[-1] = int(lost[-1]) | Flag.OVERRUN
            self._rows += [lost] * missing
        self._rows += list(rows)
        self._last = rows[-1]
        self._next = (block.first + len(rows) * self._stride) % WRAP

    def take(self, count: int | None = None) -> Array:
        """Remove and return the first `count` rows, all unless given; shape (n, columns)."""
        found, self._rows = self._rows[:count], self._rows[count:] if count is not None else []
        return np.array(found)


class BoardClient(OpenedInWith):
    """A board that plays textures, live.

    While it is open a thread sends the finger's position, or a heartbeat every 10 ms, and takes what the board sends.
    Methods may be called from any thread; a failure of the line is raised by the next of them.  A process that pauses
    for 80 ms stops the board.

    Parameters
    ----------
    port : str
        Name of the serial port, as ``/dev/ttyACM0`` or ``COM3``.
    baud : int
        Of a UART, 230 400 unless given.
    timeout : float, s
        Longest time to an answer.
    reconnect : float, s
        For how long to look for a board that is gone, or was reset; it is then set up as before.  0: `DeviceLost`.
    background : bool
        False: no thread; `step` is to be called at least every 10 ms.
    clock : module or object
        With `monotonic` and `sleep`; the module `time` unless given.
    connect : callable
        Opens the port, ``connect(port, baud)``: an object with `read`, `write` and `close` that never waits.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        timeout: float = 1.0,
        reconnect: float = 0.0,
        background: bool = True,
        clock: Any = time,
        connect: Callable[[str, int], Any] = open_port,
    ) -> None:
        self.port, self.clock = port, clock
        self.timeout = number("timeout", timeout, "s", least=0.0)
        integer("baud", baud, "Bd", least=1)
        self.reconnect = number("reconnect", reconnect, "s", least=0.0)
        self.reconnections = 0
        self.started = 0  # sample of the board's clock at which it last began to play
        self._connect = lambda: BoardLine(port, baud, timeout=timeout, clock=clock, connect=connect)
        self._line: BoardLine | None = None
        self._settings: dict[Kind, tuple[float, ...]] = {}  # fields of GAIN and LIMITS; sent again to a board that was
        self._bands: Bands | None = None  # lost, and so are these,
        self._texture: BoardTexture | None = None  # and what plays beside them
        self._start: tuple[int, int] | None = None  # fields of START; None: at rest
        self._runs = False  # something has been started
        self._rows, self._queued = Rows(), 0  # streamed back in this run; rows of drive that were sent in it
        self._error: HapticError | None = None
        self._beats = self._watchdog = 0  # of the application: its calls; ms, 0: none
        self._background, self._thread = background, threading.Thread()
        self._lock, self._ending = threading.RLock(), threading.Event()

    def open(self) -> Self:
        """Open the port and greet the board; see `BoardLine` for the errors."""
        with self._lock:
            self._line, self._error = self._connect(), None
            self._settings, self._bands, self._texture, self._start = {}, None, None, None
        self._ending.clear()
        if self._background:
            self._thread = threading.Thread(target=self._run, name=f"board {self.port}", daemon=True)
            self._thread.start()
        return self

    def close(self) -> None:
        """Stop the board and close the port; the board comes to rest by itself where it cannot be reached."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._line is not None:
            carry_through(*([self.stop] if self._runs and not self._error else []), self._close_line)

    @property
    def failure(self) -> HapticError | None:
        """The error with which the client has ended, if it has."""
        return self._error

    @property
    def capabilities(self) -> Capabilities:
        """Sizes, limits and rates that the board states."""
        return self._open_line().capabilities

    def set_bands(self, bands: Bands, texture: BoardTexture | None = None) -> int:
        """Set what the board plays: bands, all at the same sample, and beside them a texture that is no sum of bands.

        While it plays it glides to the bands within 20 ms, and fades over to the texture, or from it, within 40 ms.
        Samples of the texture are sent ahead of play by the client's thread, or `step`; where they come too late the
        texture fades out, with `Flag.OVERRUN`, and in again.  Returns the sample of the board's clock at which it took
        the bands.

        A ValueError where the targets are no constant envelopes, there are too many bands, or it refuses a number.
        """
        most = self.capabilities.bands
        if bands.envelope is None and (texture is None or len(bands)):
            raise ValueError("the targets are a waveform: must be constant envelopes, or a BoardTexture")
        if len(bands) > most:
            raise ValueError(f"{len(bands)} bands: must be <= {most} on {self.port}; export the scene with more")

        def put(line: BoardLine) -> int:
            if self._start is not None and (texture or self._texture):  # at rest `start` sends it
                line.play(texture, self._texture)
            return line.set_bands(bands)

        sample = self._steadily(put)
        self._bands, self._texture = bands, texture
        return sample

    def finger(self, position: float, velocity: float = 0.0, load: float = 0.0, time: float | None = None) -> None:
        """Set the finger's position (m from the middle, NaN: lifted), velocity (m/s) and load (N).

        `time` (s, of the client's clock) is when it was there: now unless given, which is late if the process pauses.
        Never waits; the last one counts, sent at most every 5 ms.  The board follows the velocity for 50 ms, then
        holds, and after 200 ms without another takes the finger for lifted.
        """
        time = self.clock.monotonic() if time is None else time
        if self._line is None and self._error is None and self._runs:
            return  # the board is being looked for
        self._open_line().finger = Pointed(time, float(position), float(velocity), float(load))

    @property
    def gain(self) -> float:
        """Factor on all targets, 0 to 1; faded over 20 ms."""
        return self._settings.get(Kind.GAIN, (1.0,))[0]

    @gain.setter
    def gain(self, value: float) -> None:
        self._set(Kind.GAIN, number("gain", value, least=0.0, most=1.0))

    def limits(
        self, peak: float, rms: float | None = None, seconds: float = 1.0, displacement: float = math.inf
    ) -> None:
        """Limit the drive of a channel: `peak` (A) is cut, `rms` (A) over a time constant of `seconds` stops the board.

        Both are at most the limit of the board's design; rms is `peak` unless given.  So does a sensor beyond
        `displacement` (m) while it plays; the bound of the design holds besides.
        """
        self._set(Kind.LIMITS, peak, peak if rms is None else rms, seconds, displacement)

    def _set(self, kind: Kind, *fields: float) -> None:
        self._steadily(lambda line: line.command(kind, *fields))
        self._settings[kind] = fields

    def watch(self, seconds: float | None) -> None:
        """Let the board stop permanently where the application is silent for so long, 0.05 to 65 s; None: never.

        It has to call `beat`, or `watch` again: the heartbeats of the client's thread do not count.  Never waits.
        """
        if seconds is not None and not LEAST_WATCHDOG <= seconds <= MOST_WATCHDOG:
            bound = f"{LEAST_WATCHDOG} to {MOST_WATCHDOG:g} s on a board, or None"
            raise ValueError(f"watchdog = {seconds!r} s: must be {bound}")
        self._watchdog = round(1e3 * (seconds or 0.0))
        self.beat()

    def beat(self) -> None:
        """Note a call of the application, see `watch`; never waits."""
        self._beats += 1
        if (line := self._line) is not None:
            line.application = self._beats & 0xFFFF, self._watchdog

    def start(self, *, stream: int = 0, telemetry: float = 0.02) -> int:
        """Start to play the bands, or the texture, from rest; return the sample of the board's clock at which it began.

        It streams a row back every `stream` samples, 0: none, and telemetry every `telemetry` s, 0.2 ms to 13 s at
        5 kHz.
        """
        period = round(telemetry * self.capabilities.rate)
        start = integer("stream", stream, "samples", least=0, most=0xFFFF), period
        integer("telemetry", period, "samples", least=1, most=0xFFFF)
        self.started = self._steadily(lambda line: self._begin(line, start))
        self._rows = Rows(self.started, stream)
        self._start, self._runs = start, True
        return self.started

    def _begin(self, line: BoardLine, start: tuple[int, int]) -> int:
        if self._texture is not None:
            line.play(self._texture)
        sample = line.begin(Kind.START, *start)
        if self._texture is not None:
            self._texture.begin(sample, self.clock.monotonic())
        return sample

    def stop(self) -> None:
        """Fade out within 10 ms."""
        self._start = None
        self._steadily(lambda line: line.command(Kind.STOP))
        self._runs = False

    def telemetry(self) -> Telemetry:
        """Return the latest telemetry; wait for the first.

        A `DeviceLost` where line or board are gone and did not come back within `reconnect`, a `DeviceFault` where the
        board stopped by itself, a `WatchdogTimeout` where it stopped as the application was silent (`watch`).
        """

        def wait(line: BoardLine) -> Telemetry:
            line.wait(lambda: line.telemetry is not None, "telemetry")
            return line.telemetry  # type: ignore[return-value]

        return self._steadily(wait)

    def rows(self, count: int | None = None, meanwhile: Callable[[], None] = lambda: None) -> Array:
        """Return rows that the board streamed back, see `Rows`: the next `count`, or those that have arrived.

        While rows are awaited `meanwhile` is called again and again.  A `DeviceTimeout` where none come.  After an
        error those that had arrived are there, without `count`, before it is raised again.
        """
        end = self.clock.monotonic() + self.timeout
        while True:
            with self._lock:
                line, rows = self._line, self._rows
                while line is not None and line.streamed:
                    rows.add(line.streamed.popleft())
                    end = self.clock.monotonic() + self.timeout
                if len(rows) >= (count or 1):
                    return rows.take(count)
                self._open_line()
                if count is None:
                    return rows.take()
            if self.clock.monotonic() >= end:
                raise DeviceTimeout(f"{self.port}: stream: {len(rows)} of {count} rows in {self.timeout:g} s")
            meanwhile()
            if not self._background:
                self.step()
            self.clock.sleep(PAUSE)

    def identify(self, lines: Sequence[Line], duration: float, stream: int = 1) -> Array:
        """Let the board play a multisine for `duration` (s); return drive (A) and sensed (m), shape (n, channels).

        One row for every `stream` samples, from the first one of the multisine on; the drive fades in and out within
        10 ms.  Rows that were lost on the line repeat the one before.
        """
        require(len(lines) > 0, "lines", lines, "1 or more")
        samples = round(duration * self.capabilities.rate)
        first = self._steadily(lambda line: line.identify(lines, samples, stride=stream))
        self._runs, self._rows = True, Rows(first, stream)
        columns = self.capabilities.drive_channels + self.capabilities.sensed_channels
        return self.rows(samples // stream)[:, :columns]

    def begin_queue(self) -> None:
        """Let the board play what `queue` sends it, from the first row on, and stream back every sample."""
        self._steadily(lambda line: line.identify([], 0, stride=1))
        with self._lock:
            self._open_line().streamed.clear()  # of a run before this one: no row has been queued yet
            self._runs, self._rows, self._queued = True, Rows(), 0

    def queue(self, drive: Array) -> None:
        """Append rows of drive (A, shape (n, channels))."""
        line = self._open_line()
        with self._lock:
            for start in range(0, len(drive), DRIVE_ROWS):
                rows = np.asarray(drive[start : start + DRIVE_ROWS], "<f4")
                line.send(Kind.DRIVE, protocol.pack(Kind.DRIVE, self._queued) + rows.tobytes())
                self._queued += len(rows)

    def step(self) -> None:
        """Take what has arrived and send what is due; for clients without a thread, at least every 10 ms."""
        with self._lock:
            line = self._open_line()
            try:
                line.carry()
                self._compare(line)
                if self._start is not None and self._texture is not None:
                    line.supply(self._texture)
            except (DeviceFault, WatchdogTimeout) as error:
                self._error = error
                raise
            except (DeviceLost, DeviceTimeout) as error:
                self._recover(error)

    def _run(self) -> None:
        while not self._ending.is_set() and self._error is None:
            try:
                self.step()
            except HapticError as error:
                self._error = error
            except Exception as error:  # an unforeseen frame: the board must not play on while nobody reads it
                self._error = DriverError(f"{self.port}: {type(error).__name__}: {error}")
            self.clock.sleep(PAUSE)

    def _compare(self, line: BoardLine) -> None:
        """Compare what the board does with what it is to do."""
        found = line.telemetry
        if found is None or not self._runs or found.state != State.IDLE:
            return
        if found.cause in FAULTS:
            raise DeviceFault(f"{self.port}: play: the board stopped: {FAULTS[found.cause]}")
        if found.cause == Cause.APPLICATION:
            raise WatchdogTimeout((found.sample - self.started) % WRAP / self.capabilities.rate)
        if found.cause == Cause.SILENCE:
            raise line.lost("play", "the board received no valid frame for 80 ms, and stopped")

    def _steadily(self, do: Callable[[BoardLine], Result]) -> Result:
        """Do it; where the board is lost meanwhile, find it again, set it up as before, and do it once more."""
        with self._lock:
            try:
                return do(self._open_line())
            except (DeviceLost, DeviceTimeout) as error:
                if self._error is None:
                    self._recover(error)
                return do(self._open_line())

    def _recover(self, error: DriverError) -> None:
        """Find the board again and set it up as before; raise `error` where that fails for `reconnect` seconds."""
        end = self.clock.monotonic() + self.reconnect
        for each in self._line.streamed if self._line is not None else ():
            self._rows.add(each)
        while self.clock.monotonic() < end and not self._ending.is_set():
            try:
                self._close_line()
                self._line = self._connect()
                self.beat()
                self._restore(self._line)
                self.reconnections += 1
                return
            except (DriverError, ValueError):
                self.clock.sleep(RETRY)
        self._error = error
        raise error

    def _restore(self, line: BoardLine) -> None:
        for kind, fields in self._settings.items():
            line.command(kind, *fields)
        if self._bands is not None:
            line.set_bands(self._bands)
        if self._start is not None:
            self.started = self._begin(line, self._start)
            self._rows.restart(self.started)

    def _open_line(self) -> BoardLine:
        if self._error is not None:
            raise self._error
        if self._line is None:
            raise DriverError(f"{self.port}: it is not open; use it in a with statement")
        return self._line

    def _close_line(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()
