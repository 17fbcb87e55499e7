"""A board on an open serial port: its session, the commands, and errors that name port, operation and bytes."""

import math
import secrets
import time
from binascii import crc32
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import serial

from hapticrender.bands import Bands
from hapticrender.drivers import protocol
from hapticrender.drivers.board_texture import LIFTED, BoardTexture
from hapticrender.drivers.protocol import Capabilities, Frame, Kind, Reason, Stream, Telemetry
from hapticrender.errors import DeviceLost, DeviceNotFound, DeviceTimeout, DriverError, ProtocolError

BAUD = 230_400  # of a UART; a board on USB or a pseudo-terminal does not care
PAUSE = 1e-3  # s between two looks at the line
SILENCE = 0.5  # s without a valid frame from the board after which it counts as lost
FADING = 0.2  # s: longest fade of what a command has to wait for
KEEP_ALIVE = 0.01  # s between two keep-alives, FINGER or HEARTBEAT: eight fit into the board's 80 ms of silence
FINGER_PERIOD = 0.005  # s between two FINGER frames at least
MICROSECOND = 1e-6  # s: times that differ by less are the same
RESEND = 0.03  # s after which a command without a reply is sent again
FOREIGN = 3  # replies for another session in a row after which ours has ended
MOST_STREAM = 4096  # frames of the stream that wait for the caller
SHOWN = 16  # bytes of a command in an error


class Line(NamedTuple):
    """A line of a multisine: amplitude (A) * cos(2 pi (frequency t + phase)) on a channel; phase in turns, 0 to 1."""

    channel: int
    frequency: float
    amplitude: float
    phase: float = 0.0


@dataclass
class Request:
    """A command and what became of it."""

    kind: Kind
    payload: bytes
    sequence: int = 0
    sent: float = -math.inf  # s, when it was last sent
    answered: bool = False
    refused: Reason | None = None
    sample: int = 0  # of the board's clock, at which it was done or refused


def open_port(port: str, baud: int) -> Any:
    """Open a serial port that never waits for bytes."""
    return serial.Serial(port, baud, timeout=0, write_timeout=1.0)


class BoardLine:
    """A session with a board, on a port of its own; not for several threads at once.

    It greets the board, sends keep-alives, and one command at a time until its reply.  Its parameters are those of
    `BoardClient`.  A `DeviceNotFound` where the port cannot be opened, a `DeviceTimeout` where no reply in the
    protocol comes, a `ProtocolError` where the board has another version of it.
    """

    capabilities: Capabilities  # from the reply to HELLO on

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
            raise DeviceNotFound(f"{port}: open: {error}; `hapticrender devices` lists the ports") from error
        self._nonce, self.session = secrets.randbelow(2**32 - 1) + 1, 0  # apart from earlier ones; 0: not greeted
        self.telemetry: Telemetry | None = None
        self.streamed: deque[Stream] = deque(maxlen=MOST_STREAM)
        self.finger = self._pointed = LIFTED  # as it was set; as it was sent
        self.application = 0, 0  # changes with every call of it; ms without one after which the board stops, 0: never
        self._began = self._received = clock.monotonic()  # s; of the last valid frame
        self._kept_alive = -math.inf  # s
        self.sent_bytes = self.received_bytes = 0
        self._reader = protocol.Reader()
        self._sequence = self._nonce & 0xFFFF
        self._request: Request | None = None  # no reply yet
        self._foreign = 0  # replies for another session, in a row
        self._partial: Telemetry | None = None  # of more bands than a frame holds
        self._textures = 0  # that were sent
        try:
            self.request(Kind.HELLO, protocol.pack(Kind.HELLO, protocol.VERSION, self._nonce))
        except DeviceTimeout as error:
            self.close()
            cure = f"check that the board runs the firmware of `hapticrender export`, its UART at {baud} baud"
            raise DeviceTimeout(f"{error}: {cure}") from error
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
        if now - self._received > SILENCE and self.session:
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
                raise DeviceTimeout(f"{self.port}: {operation}: no answer in {self.timeout:g} s ({self._carried()})")
            self.clock.sleep(PAUSE)

    def command(self, kind: Kind, *fields: float) -> Request:
        """Send a command and return its reply; a ValueError or `DriverError` where it is refused."""
        return self.send(kind, protocol.pack(kind, *fields))

    def send(self, kind: Kind, payload: bytes) -> Request:
        """Do the same with a payload, again and again until what the command waits for has faded out."""
        end = self.clock.monotonic() + FADING
        while True:
            request = self.request(kind, payload)
            if request.refused != Reason.STATE or self.clock.monotonic() >= end:
                return self._checked(request)

    def request(self, kind: Kind, payload: bytes) -> Request:
        """Send a command and return its reply, a refusal too."""
        request = self._request = Request(kind, payload)
        try:
            self.wait(lambda: request.answered, kind.name)
        except DriverError:
            self._request = None
            raise
        return request

    def begin(self, kind: Kind, *fields: float) -> int:
        """Start something, once the board has come to rest; return the sample at which it began."""
        self.streamed.clear()
        sample = self.command(kind, *fields).sample
        self.telemetry = None  # what comes from now on is of this run
        return sample

    def set_bands(self, bands: Bands) -> int:
        """Send set-points, which act together at the end; return the sample at which the board took them."""
        return self.command(Kind.COMMIT, len(bands), self._staged(Kind.SETPOINT, bands.set_points())).sample

    def play(self, texture: BoardTexture | None, meanwhile: BoardTexture | None = None) -> None:
        """Send a texture, and fade into it; `meanwhile` goes on until then.  None: fade out what plays."""
        self._textures = (self._textures + 1) % 256
        none = protocol.pack(Kind.TEXTURE, self._textures, 0, 0, 0.0, 0.0, 0.0)
        frames: Iterable[tuple[Kind, bytes]]
        frames = (Kind.TEXTURE, none), (Kind.PLAY, protocol.pack(Kind.PLAY, crc32(none)))
        if texture is not None:
            frames = texture.frames(self._textures, self.clock.monotonic(), self.finger)
        for kind, payload in frames:
            request = self.send(kind, payload)
            if meanwhile is not None:
                self.supply(meanwhile)
        if texture is not None:
            ahead = self.capabilities.lookahead
            texture.begin(request.sample + ahead, self.clock.monotonic() + ahead / self.capabilities.rate)

    def supply(self, texture: BoardTexture) -> None:
        """Send the frame of samples that is due; a board at rest takes none."""
        sent = self.clock.monotonic()
        samples = texture.samples(sent, self._pointed)
        if samples is None:
            return
        request = self.request(Kind.SAMPLES, samples)
        texture.arrived(request.sample, sent, self.clock.monotonic())
        if request.refused != Reason.STATE:
            self._checked(request)
            texture.taken()

    def identify(self, lines: Sequence[Line], samples: int, stride: int) -> int:
        """Start a multisine, or without lines a queue; return the sample at which it began."""
        return self.begin(Kind.IDENTIFY, len(lines), samples, stride, self._staged(Kind.LINE, lines))

    def _staged(self, kind: Kind, rows: Iterable[Iterable[float]]) -> int:
        """Send set-points or lines, which act with a later command; return the digest of what the board then holds."""
        payloads = [protocol.pack(kind, index, *row) for index, row in enumerate(rows)]
        for payload in payloads:
            self.send(kind, payload)
        return protocol.digest(payloads)

    def _carried(self) -> str:
        return f"{self.sent_bytes} bytes sent, {self.received_bytes} received"

    def _checked(self, request: Request) -> Request:
        """Return a command that was done; raise where it was refused."""
        if request.refused is None:
            return request
        text = f"{self.port}: {request.kind.name}: refused by the board: {request.refused.name.lower()}"
        payload = f"{request.payload[:SHOWN].hex(' ')}, {len(request.payload)} bytes"
        if request.refused == Reason.VALUE:
            raise ValueError(f"{text}: a number is out of its range ({payload})")
        if request.refused == Reason.STATE:
            text += ": nothing is set, it plays already, or is at rest after 80 ms without a frame: begin again"
        raise DriverError(f"{text} ({payload})")

    def due(self, now: float) -> bytes:
        """Bytes to be sent at `now` (s)."""
        out, request = b"", self._request
        if request is not None and now - request.sent >= RESEND:
            if request.sent == -math.inf:
                request.sequence = self._next()
            request.sent = now
            out += protocol.command(self.session, request.kind, request.sequence, request.payload)
        since = now - self._kept_alive + MICROSECOND
        finger = self.finger  # once: another thread may set it meanwhile
        moved = finger is not self._pointed
        if self.session and since >= (FINGER_PERIOD if moved else KEEP_ALIVE):
            self._kept_alive, self._pointed = now, finger
            time = round(((finger.time if moved else now) - self._began) * 1e6) & 0xFFFFFFFF
            kind, fields = (Kind.FINGER, finger[1:]) if moved else (Kind.HEARTBEAT, ())
            payload = protocol.pack(kind, time, *self.application, *fields)
            out += protocol.command(self.session, kind, self._next(), payload)
        self.sent_bytes += len(out)
        return out

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that have arrived; a `ProtocolError` where the board has another version."""
        self.received_bytes += len(data)
        for frame in self._reader.feed(data):
            try:
                self._take(frame, now)
            except ValueError:  # a CRC that holds by chance
                self._reader.bad += 1

    def _take(self, frame: Frame, now: float) -> None:
        if frame.kind in (Kind.ACK, Kind.REFUSE, Kind.CAPABILITIES):
            self._take_reply(frame)
        elif frame.kind == Kind.TELEMETRY and self.session:
            self._take_telemetry(protocol.telemetry(frame.payload))
        elif frame.kind == Kind.STREAM and self.session:
            channels = self.capabilities.drive_channels, self.capabilities.sensed_channels
            self.streamed.append(protocol.stream(frame.payload, *channels))
        self._received = now

    def _take_reply(self, frame: Frame) -> None:
        request = self._request
        if request is None or frame.sequence != request.sequence or request.sent == -math.inf:
            return
        if frame.kind == Kind.CAPABILITIES:
            found = protocol.capabilities(frame.payload)
            if request.kind != Kind.HELLO or found.nonce != self._nonce:
                return
            self.capabilities, self.session = found, found.session
        else:
            kind, refused, sample = protocol.reply(frame)
            if kind != request.kind:
                return
            if refused == Reason.CHECK:
                self._foreign += 1
                return
            if refused == Reason.VERSION:
                text = f"the board refuses version {protocol.VERSION} of the protocol: update one of the two"
                raise ProtocolError(text)
            request.refused, request.sample = refused, sample
        request.answered, self._request = True, None

    def _take_telemetry(self, found: Telemetry) -> None:
        if found.session != self.session:
            self._foreign += 1
            return
        self._foreign = 0
        begun = self._partial
        if found.first and begun is not None and (begun.sample, len(begun.bands)) == (found.sample, found.first):
            found = begun._replace(bands=begun.bands + found.bands)
        self._partial = found
        if len(found.bands) == found.total:
            self.telemetry = found

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence
