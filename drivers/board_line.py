"""A board on an open serial port: its session, the commands, and errors that name port, operation and bytes."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import serial

from hapticrender.bands import Bands
from hapticrender.drivers import protocol
from hapticrender.drivers.board_link import FOREIGN, Link, Request
from hapticrender.drivers.board_texture import ROWS, BoardTexture, no_texture
from hapticrender.drivers.protocol import WRAP, Kind, Reason
from hapticrender.errors import DeviceLost, DeviceNotFound, DeviceTimeout, DriverError

BAUD = 230_400  # of a UART; a board on USB or a pseudo-terminal does not care
PAUSE = 1e-3  # s between two looks at the line
SILENCE = 0.5  # s without a valid frame from the board after which it counts as lost
FADING = 0.2  # s: longest fade of what a command has to wait for


class Line(NamedTuple):
    """A line of a multisine: amplitude (A) * cos(2 pi (frequency t + phase)) on a channel; phase in turns, 0 to 1."""

    channel: int
    frequency: float
    amplitude: float
    phase: float = 0.0


def open_port(port: str, baud: int) -> Any:
    """Open a serial port that never waits for bytes."""
    return serial.Serial(port, baud, timeout=0, write_timeout=1.0)


class BoardLine(Link):
    """A board that has been greeted, on a port of its own; not for several threads at once.

    Its parameters are those of `BoardClient`; `connect` is called with port and baud rate.

    Raises
    ------
    DeviceNotFound
        There is no such port, or it cannot be opened.
    DeviceTimeout
        Nothing answers in the protocol.
    ProtocolError
        What answers speaks another version of it.
    """

    def __init__(
        self,
        port: str,
        baud: int = BAUD,
        *,
        timeout: float = 1.0,
        clock: Any = time,
        connect: Callable[[str, int], Any] = open_port,
    ) -> None:
        self.port, self.timeout, self.clock = port, timeout, clock
        try:
            self._port = connect(port, baud)
        except (OSError, ValueError) as error:
            raise DeviceNotFound(f"{port}: open: {error}") from error
        self._textures = 0  # that were sent
        super().__init__(secrets.randbelow(2**32 - 1) + 1, clock.monotonic())
        try:
            self._wait_for(self.greeting)
        except DriverError:
            self.close()
            raise

    def close(self) -> None:
        """Close the port; the board comes to rest by itself."""
        self._port.close()

    def carry(self) -> None:
        """Take what has arrived and send what is due; a `DeviceLost` where line or session are gone."""
        now = self.clock.monotonic()
        try:
            self.receive(self._port.read(65536), now)
            if due := self.due(now):
                self._port.write(due)
        except (OSError, TypeError) as error:  # pyserial's are OSErrors; TypeError where the port was closed meanwhile
            raise self.lost("line", error) from error
        if self._foreign >= FOREIGN:
            raise self.lost("session", "the board has another session: it was reset, or another host greeted it")
        if now - self.received > SILENCE and self.session:
            raise self.lost("listen", f"no valid frame for {SILENCE:g} s")

    def lost(self, operation: str, reason: object) -> DeviceLost:
        """Error that states what the line has carried."""
        return DeviceLost(f"{self.port}: {operation}: {reason} ({self._carried()}, {self._reader.bad} bad frames)")

    def wait(self, done: Callable[[], bool], operation: str) -> None:
        """Carry bytes until it is done; a `DeviceTimeout` where it takes too long."""
        end = self.clock.monotonic() + self.timeout
        while not done():
            self.carry()
            if done():
                return
            if self.clock.monotonic() >= end:
                text = f"{self.port}: {operation}: no answer in {self.timeout:g} s ({self._carried()})"
                raise DeviceTimeout(text)
            self.clock.sleep(PAUSE)

    def command(self, kind: Kind, *fields: float) -> Request:
        """Send a command and return its reply; a ValueError or `DriverError` where it is refused."""
        return self.send(kind, protocol.pack(kind, *fields))

    def send(self, kind: Kind, payload: bytes) -> Request:
        """Do the same with a payload."""
        return self._checked(self.request(kind, payload))

    def request(self, kind: Kind, payload: bytes) -> Request:
        """Send a command and return its reply, a refusal too."""
        return self._wait_for(self.submit(kind, payload))

    def begin(self, kind: Kind, *fields: float) -> int:
        """Start something, once the board has come to rest; return the sample at which it began."""
        self.streamed.clear()
        sample = self._patiently(kind, protocol.pack(kind, *fields)).sample
        self.telemetry = None  # what comes from now on is of this run
        return sample

    def set_bands(self, bands: Bands) -> int:
        """Send set-points, which act together at the end; return the sample at which the board took them."""
        payloads = [protocol.pack(Kind.SETPOINT, index, *row) for index, row in enumerate(bands.set_points())]
        for payload in payloads:
            self.send(Kind.SETPOINT, payload)
        return self.command(Kind.COMMIT, len(payloads), protocol.digest(payloads)).sample

    def play(self, texture: BoardTexture | None, meanwhile: BoardTexture | None = None) -> None:
        """Send a texture, and fade into it; `meanwhile` goes on until then.  None: fade out what plays."""
        self._textures = (self._textures + 1) % 256
        number = self._textures
        for kind, payload in no_texture(number) if texture is None else texture.frames(number):
            request = self._patiently(kind, payload)
            if meanwhile is not None:
                self.supply(meanwhile)
        if texture is not None:
            texture.began = (request.sample + self.capabilities.lookahead) % WRAP

    def supply(self, texture: BoardTexture) -> None:
        """Send a frame of the samples that come next, where they are due; a board at rest takes none."""
        now = self.telemetry
        played = 0 if now is None or texture.began is None else (now.sample - texture.began) % WRAP
        samples = texture.samples(played if played < WRAP // 2 else 0)
        if samples is None:
            return
        request = self.request(Kind.SAMPLES, samples)
        if request.refused != Reason.STATE:
            self._checked(request)
            texture.written += ROWS

    def identify(self, lines: Sequence[Line], samples: int, stride: int) -> int:
        """Start a multisine, or without lines a queue; return the sample at which it began."""
        payloads = [protocol.pack(Kind.LINE, index, *line) for index, line in enumerate(lines)]
        for payload in payloads:
            self.send(Kind.LINE, payload)
        return self.begin(Kind.IDENTIFY, len(lines), samples, stride, protocol.digest(payloads))

    def _carried(self) -> str:
        return f"{self.sent_bytes} bytes sent, {self.received_bytes} received"

    def _wait_for(self, request: Request) -> Request:
        try:
            self.wait(lambda: request.answered, request.kind.name)
        except DriverError:
            self.withdraw()
            raise
        return request

    def _patiently(self, kind: Kind, payload: bytes) -> Request:
        """Send a command again and again until what it waits for has faded out."""
        end = self.clock.monotonic() + FADING
        while True:
            request = self.request(kind, payload)
            if request.refused != Reason.STATE or self.clock.monotonic() >= end:
                return self._checked(request)

    def _checked(self, request: Request) -> Request:
        """Return a command that was done; raise where it was refused."""
        if request.refused is None:
            return request
        text = f"{self.port}: {request.kind.name}: refused by the board: {request.refused.name.lower()}"
        if request.refused == Reason.VALUE:
            raise ValueError(f"{text}: a number is out of its range ({request.payload.hex(' ')})")
        raise DriverError(f"{text} ({request.payload.hex(' ')})")
