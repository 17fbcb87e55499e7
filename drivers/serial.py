"""Boards behind a serial line: the controller runs on the board; the host sets what it plays and where the finger is.

`BoardClient` is the live device: set-points, finger and gain from any thread, telemetry back.  `SerialDriver` puts it
behind the driver protocol, so that ``hapticrender.render`` plays a scene on the board and judges what it streams back.
The protocol is in ``docs/protocol.md``; ``drivers/firmware`` is the board's part.
"""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
import serial

from hapticrender.bands import Bands
from hapticrender.drivers import protocol
from hapticrender.drivers.base import BaseDriver, carry_through
from hapticrender.drivers.board_link import Link, Request
from hapticrender.drivers.protocol import Capabilities, Cause, Kind, Reason, State, Telemetry
from hapticrender.errors import DeviceFault, DeviceLost, DeviceNotFound, DeviceTimeout, DriverError
from hapticrender.protocols import Array, Controller, Exchange, Flag, Sensed

BAUD = 230_400  # of a UART; a board on USB or a pseudo-terminal does not care
Result = TypeVar("Result")
PAUSE = 1e-3  # s between two looks at the line
SILENCE = 0.5  # s without a good frame from the board after which it counts as lost
RETRY = 0.05  # s between two attempts to open the port anew
COMING_TO_REST = 0.2  # s: longest fade-out of a board that is asked to start
ROWS = 24  # of drive in a frame
FAULTS = {
    Cause.LIMIT: "the mean square of the drive is above its limit: lower the amplitude, or raise limits(rms=)",
    Cause.SENSOR: "a sensor was invalid for 10 ms: check its cable and its range",
}


class Clock(Protocol):
    """What of the module `time` is used; tests bring a clock of their own."""

    def monotonic(self) -> float:
        """Return the time in s."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Let time pass."""
        ...


class Line(NamedTuple):
    """A line of a multisine: amplitude (A) * cos(2 pi (frequency t + phase)) on a channel; phase in turns, 0 to 1."""

    channel: int
    frequency: float
    amplitude: float
    phase: float = 0.0


class _Wanted(NamedTuple):
    """What the board is to do, to be told again after a reconnection."""

    bands: Bands | None = None
    gain: float = 1.0
    limits: tuple[float, float, float] | None = None
    start: tuple[int, int] | None = None  # samples between rows of the stream, and between telemetry; None: at rest


def open_port(port: str, baud: int) -> serial.SerialBase:
    """Open a serial port that never waits."""
    return serial.Serial(port, baud, timeout=0, write_timeout=1.0)


class BoardClient:
    """A board that plays textures, live.

    While it is open a thread sends the finger's words, or a sign of life every 10 ms, and takes what the board sends.
    Methods may be called from any thread; a failure of the line is raised by the next of them.

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
    clock : Clock
        The module `time` unless given.
    connect : callable
        Opens the line, ``connect(port, baud)``: an object with `read`, `write` and `close` that never waits.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        timeout: float = 1.0,
        reconnect: float = 0.0,
        background: bool = True,
        clock: Clock = time,
        connect: Callable[[str, int], Any] = open_port,
    ) -> None:
        for name, value in (("timeout", timeout), ("reconnect", reconnect)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} = {value!r}: must be finite and >= 0 s")
        self.port, self.baud, self.timeout, self.reconnect = port, baud, timeout, reconnect
        self.reconnections = 0
        self.clock, self._background, self._connect = clock, background, connect
        self._lock = threading.RLock()
        self._line: Any = None
        self._link = Link(1, 0.0)
        self._wanted = _Wanted()
        self._error: DriverError | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._runs = False  # something has been started

    def open(self) -> Self:
        """Open the port and greet the board.

        Raises
        ------
        DeviceNotFound
            There is no such port.
        DeviceTimeout
            Nothing answers in the protocol.
        """
        with self._lock:
            self._greet()
        if self._background:
            self._ending.clear()
            self._thread = threading.Thread(target=self._run, name=f"board {self.port}", daemon=True)
            self._thread.start()
        return self

    def close(self) -> None:
        """Stop the board and close the port; the board comes to rest by itself where it cannot be reached."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._line is None:
            return
        carry_through(*([self.stop] if self._runs and not self._error else []), self._close_line)

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close; where the body has failed already, a failure to close is noted on the body's error."""
        try:
            self.close()
        except Exception as second:
            if error is None:
                raise
            error.add_note(f"and while closing: {second}")

    @property
    def capabilities(self) -> Capabilities:
        """What the board said of itself."""
        if self._link.capabilities is None:
            raise DriverError(f"{self.port}: capabilities: it is not open; use it in a with statement")
        return self._link.capabilities

    def set_bands(self, bands: Bands) -> None:
        """Set what the board plays, all bands at the same sample; it glides there within 20 ms while it plays.

        Raises
        ------
        ValueError
            The targets are no constant envelopes, there are too many bands, or the board refuses a number.
        """
        most = self.capabilities.bands
        if bands.envelope is None:
            raise ValueError("the targets are a waveform: must be constant envelopes, which a board can play")
        if len(bands) > most:
            raise ValueError(f"{len(bands)} bands: must be <= {most} on {self.port}; export the scene with more")
        self._steadily(lambda: self._send_bands(bands))
        self._wanted = self._wanted._replace(bands=bands)

    def finger(self, position: float, velocity: float = 0.0, load: float = 0.0) -> None:
        """Say where the finger is now: position (m from the middle, NaN: lifted), velocity (m/s) and load (N).

        Never waits; the last one counts, sent at most every 5 ms.  The board follows the velocity for 50 ms, then
        holds, and after 200 ms without another takes the finger for lifted.
        """
        self._raise_error()
        self._link.finger = self.clock.monotonic(), float(position), float(velocity), float(load)

    @property
    def gain(self) -> float:
        """Factor on all targets, 0 to 1; faded over 20 ms."""
        return self._wanted.gain

    @gain.setter
    def gain(self, value: float) -> None:
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"gain = {value!r}: must be 0 to 1")
        self._steadily(lambda: self._do(Kind.GAIN, value))
        self._wanted = self._wanted._replace(gain=value)

    def limits(self, peak: float, rms: float | None = None, seconds: float = 1.0) -> None:
        """Limit the drive of a channel: `peak` (A) is cut, `rms` (A) over a time constant of `seconds` stops the board.

        Both are at most the limit of the board's design; rms is `peak` unless given.
        """
        limits = (peak, peak if rms is None else rms, seconds)
        self._steadily(lambda: self._do(Kind.LIMITS, *limits))
        self._wanted = self._wanted._replace(limits=limits)

    def start(self, *, stream: int = 0, telemetry: float = 0.02) -> int:
        """Start to play the bands, from rest; return the sample of the board's clock at which it began.

        Parameters
        ----------
        stream : int
            Samples between two rows that the board streams back; 0: none.
        telemetry : float, s
            Time between two frames of telemetry, 0.2 ms to 65 s at 5 kHz.
        """
        period = round(telemetry * self.capabilities.rate)
        for name, value, least in (("stream", stream, 0), ("telemetry", period, 1)):
            if not least <= value <= 0xFFFF:
                raise ValueError(f"{name} = {value!r} samples: must be {least} to 65535")
        sample = self._steadily(lambda: self._begin(Kind.START, stream, period))
        self._wanted = self._wanted._replace(start=(stream, period))
        return sample

    def stop(self) -> None:
        """Fade out within 10 ms."""
        self._wanted = self._wanted._replace(start=None)
        self._steadily(lambda: self._do(Kind.STOP))
        self._runs = False

    def telemetry(self) -> Telemetry:
        """Return what the board last said.

        Raises
        ------
        DeviceLost
            The line or the board is gone, and did not come back within `reconnect`.
        DeviceFault
            The board stopped by itself: the drive, or a sensor.
        """
        return self._steadily(self._latest)

    def rows(self) -> list[protocol.Stream]:
        """Return what has been streamed back since the last call."""
        self._raise_error()
        with self._lock:
            found = list(self._link.stream)
            self._link.stream.clear()
        return found

    def identify(self, lines: Sequence[Line], duration: float, stream: int = 1) -> Array:
        """Let the board play a multisine for `duration` (s); return drive (A) and sensed (m), shape (n, channels).

        One row for every `stream` samples, from the first one of the multisine on; the drive fades in and out within
        10 ms.  A `DeviceLost` where rows were lost on the line.
        """
        if not lines:
            raise ValueError("lines = []: must be 1 or more")
        samples = round(duration * self.capabilities.rate)
        first = self._steadily(lambda: self._send_lines(lines, samples, stream))
        columns = self.capabilities.drive_channels + self.capabilities.sensed_channels
        return RowReader(self, first, stream).take(samples // stream)[:, :columns]

    def begin_queue(self) -> None:
        """Let the board play what `queue` sends it, from the first row on, and stream back every sample."""
        self._steadily(lambda: self._begin(Kind.IDENTIFY, 0, 0, 1, protocol.digest([])))

    def queue(self, first: int, drive: Array) -> None:
        """Append rows of drive (A, shape (n, channels)), the first one of which is number `first` of the queue."""
        self._raise_error()
        with self._lock:
            for start in range(0, len(drive), ROWS):
                rows = np.asarray(drive[start : start + ROWS], "<f4")
                payload = protocol.pack(Kind.DRIVE, first + start) + rows.tobytes()
                self._done(self._link.submit(Kind.DRIVE, payload))

    def pause(self) -> None:
        """Let a millisecond pass, as one does between two looks at what has arrived."""
        if not self._background:
            self.step()
        self.clock.sleep(PAUSE)

    def step(self) -> None:
        """Take what has arrived and send what is due; for clients without a thread, at least every 10 ms."""
        self._raise_error()
        with self._lock:
            self._step()

    def _run(self) -> None:
        while not self._ending.is_set() and self._error is None:
            with self._lock:
                try:
                    self._step()
                except DriverError as error:
                    self._error = error
            self.clock.sleep(PAUSE)

    def _step(self) -> None:
        try:
            self._carry()
            self._look()
        except DeviceFault as error:
            self._error = error
            raise
        except (DeviceLost, DeviceTimeout) as error:
            self._recover(error)

    def _carry(self) -> None:
        """Carry bytes both ways; a `DeviceLost` where the line is gone or the board silent."""
        link, now = self._link, self.clock.monotonic()
        try:
            link.receive(self._line.read(65536), now)
            if due := link.due(now):
                self._line.write(due)
        except (OSError, TypeError) as error:  # pyserial: SerialException is an OSError; TypeError once it is closed
            raise self._lost("line", error) from error
        if link.ended:
            raise self._lost("session", "the board has another session: it was reset, or another host greeted it")
        if now - link.received > SILENCE and link.capabilities is not None:
            raise self._lost("listen", f"no good frame for {SILENCE:g} s")

    def _lost(self, operation: str, reason: object) -> DeviceLost:
        link = self._link
        carried = f"{link.sent_bytes} bytes sent, {link.received_bytes} received, {link.bad} bad frames"
        return DeviceLost(f"{self.port}: {operation}: {reason} ({carried})")

    def _look(self) -> None:
        """Compare what the board does with what it is to do."""
        found = self._link.telemetry
        if found is None or self._wanted.start is None or found.state != State.IDLE:
            return
        if found.cause in FAULTS:
            raise DeviceFault(f"{self.port}: play: the board stopped: {FAULTS[found.cause]}")
        if found.cause == Cause.SILENCE:
            raise self._lost("play", "the board heard no good word for 80 ms, and stopped")

    def _recover(self, error: DriverError) -> None:
        """Find the board again and set it up as before; raise `error` where that fails for `reconnect` seconds."""
        end = self.clock.monotonic() + self.reconnect
        while self.clock.monotonic() < end and not self._ending.is_set():
            try:
                self._greet()
                self._restore()
                self.reconnections += 1
                return
            except (DriverError, ValueError):
                self.clock.sleep(RETRY)
        self._error = error
        raise error

    def _restore(self) -> None:
        wanted = self._wanted
        if wanted.limits is not None:
            self._do(Kind.LIMITS, *wanted.limits)
        self._do(Kind.GAIN, wanted.gain)
        if wanted.bands is not None:
            self._send_bands(wanted.bands)
        if wanted.start is not None:
            self._begin(Kind.START, *wanted.start)

    def _greet(self) -> None:
        self._close_line()
        try:
            self._line = self._connect(self.port, self.baud)
        except (OSError, ValueError) as error:
            raise DeviceNotFound(f"{self.port}: open: {error}") from error
        self._link = Link(secrets.randbelow(2**32 - 1) + 1, self.clock.monotonic())
        self._error = None
        try:
            self._done(self._link.greeting)
        except DriverError:
            self._close_line()
            raise

    def _close_line(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error
        if self._line is None:
            raise DriverError(f"{self.port}: it is not open; use it in a with statement")

    def _send_bands(self, bands: Bands) -> None:
        envelope = np.zeros(0) if bands.envelope is None else bands.envelope
        turns = np.remainder(bands.phase / (2 * np.pi), 1.0)
        rows = zip(bands.frequency, bands.wavenumber, turns, envelope.real, envelope.imag, strict=True)
        payloads = [protocol.pack(Kind.SETPOINT, index, *row) for index, row in enumerate(rows)]
        for payload in payloads:
            self._done(self._link.submit(Kind.SETPOINT, payload))
        self._do(Kind.COMMIT, len(payloads), protocol.digest(payloads))

    def _send_lines(self, lines: Sequence[Line], samples: int, stream: int) -> int:
        payloads = [protocol.pack(Kind.LINE, index, *line) for index, line in enumerate(lines)]
        for payload in payloads:
            self._done(self._link.submit(Kind.LINE, payload))
        return self._begin(Kind.IDENTIFY, len(lines), samples, stream, protocol.digest(payloads))

    def _begin(self, kind: Kind, *fields: float) -> int:
        """Start something, once the board has come to rest; return its sample."""
        self._link.stream.clear()
        end = self.clock.monotonic() + COMING_TO_REST
        while True:
            request = self._answer(self._link.submit(kind, protocol.pack(kind, *fields)))
            if request.refused != Reason.STATE or self.clock.monotonic() >= end:
                self._link.telemetry, self._runs = None, True
                return self._checked(request).sample

    def _latest(self) -> Telemetry:
        self._wait(lambda: self._link.telemetry is not None, "telemetry")
        found = self._link.telemetry
        if found is None:
            raise DeviceTimeout(f"{self.port}: telemetry: none in {self.timeout:g} s")
        return found

    def _steadily(self, do: Callable[[], Result]) -> Result:
        """Do it; where the board is lost meanwhile, find it again, set it up as before, and do it once more."""
        self._raise_error()
        with self._lock:
            try:
                return do()
            except (DeviceLost, DeviceTimeout) as error:
                self._recover(error)
                return do()

    def _do(self, kind: Kind, *fields: float) -> Request:
        return self._done(self._link.submit(kind, protocol.pack(kind, *fields)))

    def _done(self, request: Request) -> Request:
        return self._checked(self._answer(request))

    def _answer(self, request: Request) -> Request:
        """Wait until a command has been answered."""
        try:
            self._wait(lambda: request.reply is not None, request.kind.name)
        except DriverError:
            self._link.withdraw()
            raise
        return request

    def _checked(self, request: Request) -> Request:
        """Return a command that was done; a `ValueError` or a `DriverError` where it was refused."""
        if request.refused is None:
            return request
        text = f"{self.port}: {request.kind.name}: refused by the board: {request.refused.name.lower()}"
        if request.refused == Reason.VALUE:
            raise ValueError(f"{text}: a number is out of its range ({request.payload.hex(' ')})")
        raise DriverError(f"{text} ({request.payload.hex(' ')})")

    def _wait(self, done: Callable[[], bool], operation: str) -> None:
        end = self.clock.monotonic() + self.timeout
        while not done():
            self._carry()
            if done():
                return
            if self.clock.monotonic() >= end:
                link = self._link
                carried = f"{link.sent_bytes} bytes sent, {link.received_bytes} received"
                raise DeviceTimeout(f"{self.port}: {operation}: no answer in {self.timeout:g} s ({carried})")
            self.clock.sleep(PAUSE)


class RowReader:
    """Rows that a board streams back, in order, those that were lost on the line filled in.

    Parameters
    ----------
    client : BoardClient
    first : int, optional
        Sample of the board's clock of the first row; of the first one that comes unless given.
    stride : int
        Samples between two rows.
    finger : callable, optional
        Called again and again while rows are awaited.
    """

    def __init__(
        self,
        client: BoardClient,
        first: int | None = None,
        stride: int = 1,
        finger: Callable[[], None] = lambda: None,
    ) -> None:
        self._client, self._stride, self._finger = client, stride, finger
        self._next = None if first is None else -(-first // stride) * stride
        self._rows: list[Array] = []
        self._last: Array | None = None

    def take(self, count: int) -> Array:
        """Return the next rows: drive (A), sensed (m), position (m), load (N) and flags, shape (count, columns).

        A lost row repeats the one before, with `Flag.OVERRUN`.  A `DeviceTimeout` where none come.
        """
        client, clock = self._client, self._client.clock
        end = clock.monotonic() + client.timeout
        while len(self._rows) < count:
            self._finger()
            for block in client.rows():
                self._append(block)
                end = clock.monotonic() + client.timeout
            if clock.monotonic() >= end:
                raise DeviceTimeout(f"{client.port}: stream: {len(self._rows)} of {count} rows in {client.timeout:g} s")
            client.pause()
        found, self._rows = self._rows[:count], self._rows[count:]
        return np.array(found)

    def _append(self, block: protocol.Stream) -> None:
        rows = np.array(block.rows)
        missing = 0 if self._next is None else (block.first - self._next) // self._stride
        if not 0 <= missing < 2**16 or not len(rows):
            return  # of an earlier run
        if missing:
            lost = np.array(rows[0] if self._last is None else self._last)
            lost[-1] = int(lost[-1]) | Flag.OVERRUN
            self._rows += [lost] * missing
        self._rows += list(rows)
        self._last = rows[-1]
        self._next = block.first + len(rows) * self._stride


class Trajectory(Protocol):
    """A finger whose position and load are known beforehand, such as ``hapticrender.Finger``."""

    def position(self, time: Array) -> Array:
        """Position (m from the middle, NaN: lifted) at `time` (s)."""
        ...

    def load(self, time: Array) -> Array:
        """Load (N) at `time` (s)."""
        ...


class SerialDriver(BaseDriver):
    """Plays a scene on a board whose firmware was exported for its device, in closed loop on the board.

    The board has its own law, of method "inverse"; `render` sends it the bands of the scene and records what it streams
    back.  A board senses no finger: `finger` is where the host says it is.

    Parameters
    ----------
    port : str
        Name of the serial port.
    finger : Trajectory, optional
        Where the finger is, from the start of the run on; lifted unless given.
    block : int, >= 1
        1: closed loop on the board.  More: drive from the host, a block a call, for identification; what it computes
        from a block acts two blocks later.
    options
        Of `BoardClient`.
    """

    probe = False  # the law on the board is the board's; its own guards are in docs/protocol.md

    def __init__(self, port: str, *, finger: Trajectory | None = None, block: int = 1, **options: Any) -> None:
        self.client = BoardClient(port, **options)
        self._finger, self._sent = finger, 0
        self._reader: RowReader | None = None
        with self.client as client:
            found = client.capabilities
        self._limit = found.drive_limit
        super().__init__(
            rate=found.rate,
            drive_channels=found.drive_channels,
            sensed_channels=found.sensed_channels,
            block=block,
            delay=found.delay if block == 1 else 2 * block + found.delay,
        )

    def exchange(self, controller: Controller) -> Exchange | None:
        """Return the exchange that runs the board's own loop with the bands of `controller`; None for a block device.

        Raises
        ------
        DriverError
            The board cannot play this: it has the law of method "inverse", and plays constant envelopes.
        """
        if self.block != 1:
            return None
        inner = getattr(controller, "controller", controller)
        bands = getattr(inner, "bands", None)
        if bands is None or inner.method != "inverse" or bands.envelope is None or not len(bands):
            raise DriverError(
                f"{self}: exchange: method {inner.method!r} of this scene cannot run on a board: must be 'inverse', "
                "with a texture of constant amplitudes"
            )

        def advance(count: int, reference: Callable[[Array], Array]) -> tuple[Array, Array, Array, Sensed]:
            if self._reader is None:
                self._begin(bands)
            return self._taken(count, bands)

        return advance

    def _begin(self, bands: Bands) -> None:
        client = self.client
        client.set_bands(bands)
        self._started = client.clock.monotonic()
        self._point()
        first = client.start(stream=1)
        self._started = client.clock.monotonic()
        self._reader = RowReader(client, first, finger=self._point)

    def _point(self) -> None:
        """Send where the finger is now."""
        if self._finger is None:
            return
        now = np.array([0.0, 1e-4]) + max(self.client.clock.monotonic() - self._started, 0.0)
        here, there = self._finger.position(now)
        velocity = (there - here) * 1e4
        self.client.finger(here, velocity if np.isfinite(velocity) else 0.0, self._finger.load(now[:1])[0])

    def _taken(self, count: int, bands: Bands) -> tuple[Array, Array, Array, Sensed]:
        reader = self._reader
        if reader is None:
            raise DriverError(f"{self}: exchange: it has not begun")
        drive, sensed, position, load, flags = self._columns(reader.take(count))
        target = np.tile(np.asarray(bands.envelope, complex), (count, 1))
        target[np.isnan(position)[:, None] & (bands.wavenumber > 0.0)] = 0.0
        return drive, target, flags, Sensed(sensed, position=position, normal_load=load, flags=flags)

    def _columns(self, rows: Array) -> tuple[Array, Array, Array, Array, Array]:
        a, b = self.drive_channels, self.drive_channels + self.sensed_channels
        return rows[:, :a], rows[:, a:b], rows[:, b], rows[:, b + 1], rows[:, b + 2].astype(np.int64)

    def _open(self) -> None:
        self.client.open()

    def _play(self, drive: Array) -> Sensed:
        """Queue a block on the board, one block ahead of what it plays, and return what was sensed in the block."""
        client = self.client
        if self.block == 1:
            raise DriverError(f"{self}: play: the loop runs on the board; for drive from the host set block > 1")
        if self._reader is None:
            client.begin_queue()
            self._reader = RowReader(client)
            client.queue(0, np.zeros_like(drive))
            self._sent = len(drive)
        client.queue(self._sent, drive)
        self._sent += len(drive)
        _, sensed, _, _, flags = self._columns(self._reader.take(self.block))
        return Sensed(sensed, flags=flags)

    def close(self) -> None:
        """Stop the board and close the port; once closed it stays so."""
        was, self._state = self._state, "closed"
        if was == "open":
            self.client.close()

    def __str__(self) -> str:
        return f"SerialDriver({self.client.port})"
