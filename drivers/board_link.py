"""A conversation with a board, without port and clock: bytes in and bytes out, at times that the caller states."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Capabilities, Frame, Kind, Reason, Stream, Telemetry
from hapticrender.errors import ProtocolError

KEEP_ALIVE = 0.01  # s between two keep-alives, FINGER or HEARTBEAT: eight fit into the board's 80 ms of silence
FINGER_PERIOD = 0.005  # s between two FINGER frames at least
MICROSECOND = 1e-6  # s: times that differ by less are the same
RESEND = 0.03  # s after which a command without a reply is sent again
FOREIGN = 3  # replies for another session in a row after which ours has ended
MOST_STREAM = 4096  # frames of the stream that wait for the caller

Finger = tuple[float, float, float, float]  # time (s), position (m, NaN: lifted), velocity (m/s), load (N)


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


class Link:
    """One session with a board: greets it, sends keep-alives, and one command at a time until its reply.

    Parameters
    ----------
    nonce : int
        A random number from 1 to 2**32 - 1, which sets this session apart from earlier ones.
    now : float, s
        Time at which it begins, on the clock of all later calls.
    """

    capabilities: Capabilities  # from the reply to HELLO on

    def __init__(self, nonce: int, now: float) -> None:
        self.nonce, self.session = nonce, 0  # 0: not greeted yet
        self.telemetry: Telemetry | None = None
        self.streamed: deque[Stream] = deque(maxlen=MOST_STREAM)
        self.finger: Finger | None = None  # not sent yet
        self.application = 0, 0  # changes with every call of it; ms without one after which the board stops, 0: never
        self.received = now  # s, of the last valid frame
        self.sent_bytes = self.received_bytes = 0
        self._began, self._kept_alive = now, -math.inf
        self._reader = protocol.Reader()
        self._sequence = nonce & 0xFFFF
        self._request: Request | None = None  # no reply yet
        self._foreign = 0  # replies for another session, in a row
        self._partial: Telemetry | None = None  # of more bands than a frame holds
        self.greeting = self.submit(Kind.HELLO, protocol.pack(Kind.HELLO, protocol.VERSION, nonce))

    def submit(self, kind: Kind, payload: bytes) -> Request:
        """Queue a command, a later `receive` takes its reply."""
        self._request = Request(kind, payload)
        return self._request

    def withdraw(self) -> None:
        """Send the command that waits no more."""
        self._request = None

    def due(self, now: float) -> bytes:
        """Bytes to be sent at `now` (s)."""
        out, request = b"", self._request
        if request is not None and now - request.sent >= RESEND:
            if request.sent == -math.inf:
                request.sequence = self._next()
            request.sent = now
            out += protocol.command(self.session, request.kind, request.sequence, request.payload)
        since = now - self._kept_alive + MICROSECOND
        if self.session and since >= (KEEP_ALIVE if self.finger is None else FINGER_PERIOD):
            self._kept_alive = now
            out += self._keep_alive(now)
        self.sent_bytes += len(out)
        return out

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that have arrived; a `ProtocolError` where the board speaks another version."""
        self.received_bytes += len(data)
        for frame in self._reader.feed(data):
            try:
                self._take(frame, now)
            except ValueError:  # a CRC that holds by chance
                self._reader.bad += 1

    def _keep_alive(self, now: float) -> bytes:
        """Frame of the finger's position, if that is new, or a HEARTBEAT."""
        finger, self.finger = self.finger, None
        time = round(((now if finger is None else finger[0]) - self._began) * 1e6) & 0xFFFFFFFF
        kind, fields = (Kind.HEARTBEAT, ()) if finger is None else (Kind.FINGER, finger[1:])
        payload = protocol.pack(kind, time, *self.application, *fields)
        return protocol.command(self.session, kind, self._next(), payload)

    def _take(self, frame: Frame, now: float) -> None:
        if frame.kind in (Kind.ACK, Kind.REFUSE, Kind.CAPABILITIES):
            self._take_reply(frame)
        elif frame.kind == Kind.TELEMETRY and self.session:
            self._take_telemetry(protocol.telemetry(frame.payload))
        elif frame.kind == Kind.STREAM and self.session:
            channels = self.capabilities.drive_channels, self.capabilities.sensed_channels
            self.streamed.append(protocol.stream(frame.payload, *channels))
        self.received = now

    def _take_reply(self, frame: Frame) -> None:
        request = self._request
        if request is None or frame.sequence != request.sequence or request.sent == -math.inf:
            return
        if frame.kind == Kind.CAPABILITIES:
            found = protocol.capabilities(frame.payload)
            if request.kind != Kind.HELLO or found.nonce != self.nonce:
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
