"""A conversation with a board, without port and clock: bytes in and bytes out, at times that the caller states."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Capabilities, Frame, Kind, Reason, Stream, Telemetry
from hapticrender.errors import ProtocolError

WORDS = 0.01  # s between two words, FINGER or HEARTBEAT: eight of them fit into the board's 80 ms of silence
MICROSECOND = 1e-6  # s: times that differ by less are the same
FASTEST = 0.005  # s between two words of the finger at least
RESEND = 0.03  # s after which a command without a reply is sent again
STRANGE = 3  # answers for another session in a row after which ours has ended
MOST_STREAM = 4096  # frames of the stream that wait for the caller

Finger = tuple[float, float, float, float]  # time (s), position (m, NaN: lifted), velocity (m/s), load (N)


@dataclass
class Request:
    """A command and what became of it."""

    kind: Kind
    payload: bytes
    sequence: int = 0
    sent: float = -math.inf  # s, when it was last sent
    reply: Frame | None = None

    @property
    def refused(self) -> Reason | None:
        """Why the board refused it; None where it did not."""
        if self.reply is None or self.reply.kind != Kind.REFUSE:
            return None
        return Reason(self.reply.payload[1])

    @property
    def sample(self) -> int:
        """Sample of the board's clock at which it was done."""
        return int.from_bytes(self.reply.payload[-4:], "little") if self.reply else 0


class Link:
    """One session with a board: greets it, sends commands one after another until each is answered, and words.

    Parameters
    ----------
    nonce : int
        Any number from 1 to 2**32 - 1 that the board has not heard before.
    now : float, s
        Time at which it begins, on the clock of all later calls.
    """

    def __init__(self, nonce: int, now: float) -> None:
        self.nonce = nonce
        self.capabilities: Capabilities | None = None
        self.telemetry: Telemetry | None = None
        self.stream: deque[Stream] = deque(maxlen=MOST_STREAM)
        self.finger: Finger | None = None  # not sent yet
        self.application = 0, 0  # changes with every call of it; ms without one after which the board stops, 0: never
        self.received = now  # s, of the last good frame
        self.sent_bytes = self.received_bytes = 0
        self._began, self._spoken = now, -math.inf
        self._reader = protocol.Reader()
        self._sequence = nonce & 0xFFFF
        self._waiting: deque[Request] = deque()
        self._strange = 0
        self._begun: Telemetry | None = None  # more bands than a frame holds
        self.greeting = self.submit(Kind.HELLO, protocol.pack(Kind.HELLO, protocol.VERSION, nonce))

    @property
    def bad(self) -> int:
        """Frames from the board with a wrong CRC."""
        return self._reader.bad

    @property
    def ended(self) -> bool:
        """Whether the board no longer has this session: it was reset, or another host said hello."""
        return self._strange >= STRANGE

    def submit(self, kind: Kind, payload: bytes) -> Request:
        """Queue a command; its `reply` comes with a later `receive`."""
        self._waiting.append(Request(kind, payload))
        return self._waiting[-1]

    def withdraw(self) -> None:
        """Forget the commands that wait."""
        self._waiting.clear()

    def due(self, now: float) -> bytes:
        """Bytes to be sent at `now` (s)."""
        out = b""
        if self._waiting and now - self._waiting[0].sent >= RESEND:
            first = self._waiting[0]
            if first.sent == -math.inf:
                first.sequence = self._next()
            first.sent = now
            out += self._command(first.kind, first.sequence, first.payload)
        since = now - self._spoken + MICROSECOND
        if self.capabilities is not None and since >= (WORDS if self.finger is None else FASTEST):
            self._spoken = now
            out += self._word(now)
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

    def _word(self, now: float) -> bytes:
        """Where the finger is, if that is new, or a sign of life."""
        finger, self.finger = self.finger, None
        time = round(((now if finger is None else finger[0]) - self._began) * 1e6) & 0xFFFFFFFF
        kind, fields = (Kind.HEARTBEAT, ()) if finger is None else (Kind.FINGER, finger[1:])
        return self._command(kind, self._next(), protocol.pack(kind, time, *self.application, *fields))

    def _take(self, frame: Frame, now: float) -> None:
        try:
            kind = Kind(frame.kind)
        except ValueError:
            return
        if kind in (Kind.ACK, Kind.REFUSE, Kind.CAPABILITIES):
            self._take_reply(kind, frame)
        elif kind == Kind.TELEMETRY:
            self._take_telemetry(protocol.telemetry(frame.payload))
        elif kind == Kind.STREAM and self.capabilities is not None:
            channels = self.capabilities.drive_channels, self.capabilities.sensed_channels
            self.stream.append(protocol.stream(frame.payload, *channels))
        self.received = now

    def _take_reply(self, kind: Kind, frame: Frame) -> None:
        request = self._waiting[0] if self._waiting else None
        if request is None or frame.sequence != request.sequence or request.sent == -math.inf:
            return
        if kind == Kind.CAPABILITIES:
            found = protocol.capabilities(frame.payload)
            if request.kind != Kind.HELLO or found.nonce != self.nonce:
                return
            self.capabilities = found
        elif not frame.payload or frame.payload[0] != request.kind:
            return
        elif kind == Kind.REFUSE and (len(frame.payload) < 2 or frame.payload[1] not in set(Reason)):
            return  # of another version
        elif kind == Kind.REFUSE and frame.payload[1] == Reason.CHECK:
            self._strange += 1
            return
        elif kind == Kind.REFUSE and frame.payload[1] == Reason.VERSION:
            raise ProtocolError(f"the board refuses version {protocol.VERSION} of the protocol: update one of the two")
        request.reply = frame
        self._waiting.popleft()

    def _take_telemetry(self, found: Telemetry) -> None:
        if self.capabilities is None:
            return
        if found.session != self.capabilities.session:
            self._strange += 1
            return
        self._strange = 0
        begun = self._begun
        if found.first and begun is not None and (begun.sample, len(begun.bands)) == (found.sample, found.first):
            found = begun._replace(bands=begun.bands + found.bands)
        self._begun = found
        if len(found.bands) == found.total:
            self.telemetry = found

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _command(self, kind: Kind, sequence: int, payload: bytes) -> bytes:
        session = 0 if self.capabilities is None else self.capabilities.session
        return protocol.command(session, kind, sequence, payload)
