"""Wire protocol between host and board: frames, messages, and their check values; ``docs/protocol.md`` explains them.

A frame is ``COBS(kind, sequence, payload, CRC-16), 0``; everything is little-endian and of fixed width.  The payload of
a command, from host to board, ends with a CRC-32 that starts from the session (`check_value`).
"""

import struct
from binascii import crc32, crc_hqx
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

from hapticrender.protocols import Flag

VERSION = 6
MOST_BODY = 254  # bytes of kind, sequence, payload and CRC: one COBS group at most
MOST_PAYLOAD = MOST_BODY - 5
CRC_START = 0xFFFF
DELIMITER = b"\0"
WRAP = 2**32  # of times, and of numbers of samples


class Kind(IntEnum):
    """Kinds of frames; those of the board have the highest bit set."""

    HELLO = 0x01
    HEARTBEAT = 0x02
    FINGER = 0x03
    SETPOINT = 0x04
    COMMIT = 0x05
    GAIN = 0x06
    LIMITS = 0x07
    START = 0x08
    STOP = 0x09
    LINE = 0x0A
    IDENTIFY = 0x0B
    DRIVE = 0x0C
    TEXTURE = 0x0D
    PROFILE = 0x0E
    SAMPLES = 0x0F
    PLAY = 0x10
    CAPABILITIES = 0x81
    ACK = 0x82
    REFUSE = 0x83
    TELEMETRY = 0x84
    STREAM = 0x85


LAYOUT = {  # payloads, without the check value of commands; some go on with rows
    Kind.HELLO: "<BI",  # version, nonce (not 0)
    Kind.HEARTBEAT: "<IHH",  # host's time, us; application: its beat, and its watchdog, ms, 0: none
    Kind.FINGER: "<IHHfff",  # the same; position, m, NaN: lifted; velocity, m/s; load, N
    Kind.SETPOINT: "<Bfffff",  # band; frequency, Hz; wavenumber, 1/m; phase, turns; target re, im, m
    Kind.COMMIT: "<BI",  # bands; CRC-32 of their set-points
    Kind.GAIN: "<f",  # 0 to 1
    Kind.LIMITS: "<ffff",  # peak, A; rms, A; time constant, s; displacement, m
    Kind.START: "<HH",  # samples between rows of the stream, and between telemetry; 0: none
    Kind.STOP: "<",
    Kind.LINE: "<BBfff",  # line; channel; frequency, Hz; amplitude, A; phase, turns
    Kind.IDENTIFY: "<BIHI",  # lines, 0: DRIVE frames; samples; samples between rows of the stream; CRC-32 of the lines
    Kind.DRIVE: "<I",  # number of the first row; then rows of drive, A
    Kind.TEXTURE: "<BBHfff",  # number; 1: samples follow; points of its profile; first, step, m; m per unit of a point
    Kind.PROFILE: "<H",  # number of the first point; then points, i16
    Kind.SAMPLES: "<BIf",  # number of the texture; of the first sample; m per unit; then samples, i16
    Kind.PLAY: "<I",  # CRC-32 of TEXTURE and all points
    Kind.CAPABILITIES: "<BIIfffIHHBBBBBHHBB",
    Kind.ACK: "<BI",  # kind; sample
    Kind.REFUSE: "<BBI",  # kind; reason; sample
    Kind.TELEMETRY: "<IIIIBBHIIIIIfIffBB",
    Kind.STREAM: "<IH",  # sample of the first row; samples between rows; then the rows
}
BAND = struct.Struct("<ffff")  # of TELEMETRY: target re, im; measured re, im (m)


class Reason(IntEnum):
    """Why a command was refused."""

    VERSION = 1  # of the protocol
    CHECK = 2  # the check value does not hold: another session, or a damaged frame
    KIND = 3  # unknown
    LENGTH = 4
    VALUE = 5  # out of range
    DIGEST = 6  # the board holds other set-points or lines than those of the digest
    STATE = 7  # not now: nothing has been set, or something plays


class State(IntEnum):
    """What the board is doing."""

    IDLE = 0
    PLAYING = 1
    IDENTIFYING = 2
    DRIVING = 3


class Cause(IntEnum):
    """Why the board last came to rest."""

    NONE = 0
    COMMAND = 1
    SILENCE = 2  # no valid keep-alive from the host for 80 ms
    LIMIT = 3  # the drive's mean square
    SENSOR = 4  # invalid for 10 ms
    DONE = 5  # an identification has ended
    SESSION = 6  # another host greeted the board
    APPLICATION = 7  # no beat of the application for the time of the watchdog
    INVALID = 17  # the supervisor of the law, from here on: see docs/safety.md
    FROZEN = 18
    INCONSISTENT = 19
    ACTIVE = 20
    DRIVE = 21
    RINGING = 22
    OVERMOTION = 23
    BEYOND = 24
    SENSOR_GAIN = 25
    ACTUATOR_GAIN = 26
    SWAPPED = 27


class Frame(NamedTuple):
    """A frame whose CRC-16 holds."""

    kind: int
    sequence: int
    payload: bytes


class Capabilities(NamedTuple):
    """Sizes, limits and rates that a board states when it is greeted."""

    version: int
    nonce: int  # the host's
    session: int  # from which check values start
    rate: float  # Hz
    drive_limit: float  # A
    sensor_limit: float  # m
    cycle_rate: int  # Hz of the cycles in telemetry
    delay: int  # samples
    queue: int  # rows of drive that it holds
    drive_channels: int
    sensed_channels: int
    bands: int  # at most
    lines: int  # of a multisine, at most
    silence: int  # ms after which the drive is zero
    ring: int  # samples of a texture that it holds
    points: int  # of a texture's profile, at most
    lookahead: int  # samples after PLAY with which a texture begins
    friction: int  # 1: it drives the carrier of a screen, and textures are impulses (N s); 0: a plate


class BandTelemetry(NamedTuple):
    """Envelopes of a band (m)."""

    target: complex
    measured: complex


class Telemetry(NamedTuple):
    """State of the board as of a sample."""

    sample: int  # of the board's clock, since its reset
    time: int  # us, of the board's clock
    echo: int  # us, host's time in the last keep-alive
    session: int
    state: State
    cause: Cause
    flags: Flag  # raised since the telemetry before
    cycles: int  # a sample, mean
    cycles_most: int
    bad: int  # frames with a wrong CRC
    refused: int  # commands
    dropped: int  # frames not sent, as the line was full
    position: float  # m, of the finger; NaN: none
    commits: int
    mismatch: float  # force learned on the untouched device over that of its model, 0: not known; see `differences`
    damper_scale: float  # of the inner damper, 1 unless the supervisor has turned it down
    first: int  # number of the first band here
    total: int  # bands that play
    bands: tuple[BandTelemetry, ...]


class Stream(NamedTuple):
    """Samples as they were played and sensed."""

    first: int  # sample of the first row
    stride: int  # samples between rows
    rows: tuple[tuple[float, ...], ...]  # as of `board_client.Rows`


def cobs_encode(data: bytes) -> bytes:
    """Encode at most 254 bytes so that no zero is left (consistent overhead byte stuffing); without delimiter."""
    return b"".join(bytes([len(group) + 1]) + group for group in data.split(DELIMITER))


def cobs_decode(data: bytes) -> bytes:
    """Decode what `cobs_encode` gave; a ValueError where it is malformed."""
    groups, at = [], 0
    while at < len(data):
        code = data[at]
        group = data[at + 1 : at + code]
        if not code or len(group) < code - 1 or 0 in group:
            raise ValueError(f"COBS group of {code} at byte {at} of {len(data)}: must be whole and without zeros")
        groups.append(group)
        at += code
    return DELIMITER.join(groups)


def encode(frame: Frame) -> bytes:
    """Bytes of a frame on the wire, with the delimiter behind it; a ValueError where its payload is too long."""
    if len(frame.payload) > MOST_PAYLOAD:
        raise ValueError(f"payload of {len(frame.payload)} bytes: must be <= {MOST_PAYLOAD}")
    body = struct.pack("<BH", frame.kind, frame.sequence) + frame.payload
    return cobs_encode(body + struct.pack("<H", crc_hqx(body, CRC_START))) + DELIMITER


def decode(code: bytes) -> Frame:
    """Frame from its bytes without the delimiter; a ValueError where they are no frame or the CRC is wrong."""
    if len(code) > MOST_BODY + 1:
        raise ValueError(f"code of {len(code)} bytes: must be <= {MOST_BODY + 1}")
    body = cobs_decode(code)
    if not 5 <= len(body) <= MOST_BODY:
        raise ValueError(f"frame of {len(body)} bytes: must be 5 to {MOST_BODY}")
    (crc,) = struct.unpack("<H", body[-2:])
    if crc != crc_hqx(body[:-2], CRC_START):
        raise ValueError(f"CRC {crc:#06x}: must be {crc_hqx(body[:-2], CRC_START):#06x}")
    kind, sequence = struct.unpack_from("<BH", body)
    return Frame(kind, sequence, body[3:-2])


class Reader:
    """Frames out of a stream of bytes; `bad` counts what was no frame."""

    def __init__(self) -> None:
        self.bad = 0
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Take bytes and yield the frames that they complete."""
        *codes, rest = (self._rest + data).split(DELIMITER)
        self._rest = rest[: MOST_BODY + 3]  # of an endless frame no more than shows that it is too long
        for code in codes:
            if code:
                try:
                    yield decode(bytes(code))
                except ValueError:
                    self.bad += 1


def check_value(session: int, kind: int, sequence: int, payload: bytes) -> int:
    """CRC-32 that ends a command's payload; session 0 for HELLO."""
    return crc32(payload, crc32(struct.pack("<IBH", session, kind, sequence)))


def command(session: int, kind: Kind, sequence: int, payload: bytes) -> bytes:
    """Bytes on the wire of a command of a session."""
    check = check_value(0 if kind == Kind.HELLO else session, kind, sequence, payload)
    return encode(Frame(kind, sequence, payload + struct.pack("<I", check)))


def pack(kind: Kind, *fields: float) -> bytes:
    """Payload of a command, without its check value."""
    return struct.pack(LAYOUT[kind], *fields)


def digest(payloads: Sequence[bytes]) -> int:
    """CRC-32 of set-points or lines as their payloads have them, without their numbers."""
    return crc32(b"".join(payload[1:] for payload in payloads))


def capabilities(payload: bytes) -> Capabilities:
    """Parse a CAPABILITIES frame; a `ValueError` where its length is wrong."""
    return Capabilities(*_fields(Kind.CAPABILITIES, payload)[0])


def reply(frame: Frame) -> tuple[int, Reason | None, int]:
    """Kind of the command that an ACK or REFUSE belongs to, reason of a refusal, and sample; or a `ValueError`."""
    kind, *reason, sample = _fields(Kind(frame.kind), frame.payload)[0]
    return kind, Reason(reason[0]) if reason else None, sample


def telemetry(payload: bytes) -> Telemetry:
    """Parse a TELEMETRY frame; a `ValueError` where its length or a value is wrong."""
    fields, rest = _fields(Kind.TELEMETRY, payload, BAND.size)
    state, cause, flags = State(fields[4]), Cause(fields[5]), Flag(fields[6])
    bands = (BandTelemetry(complex(*each[:2]), complex(*each[2:])) for each in BAND.iter_unpack(rest))
    return Telemetry._make([*fields[:4], state, cause, flags, *fields[7:], tuple(bands)])


def stream(payload: bytes, drive_channels: int, sensed_channels: int) -> Stream:
    """Parse a STREAM frame; a `ValueError` where its length is wrong."""
    row = struct.Struct(f"<{drive_channels + sensed_channels + 3}fH")
    (first, stride), rest = _fields(Kind.STREAM, payload, row.size)
    return Stream(first, stride, tuple(row.iter_unpack(rest)))


def _fields(kind: Kind, payload: bytes, row: int | None = None) -> tuple[tuple, bytes]:
    """Fields of a payload, and the rows of `row` bytes behind them."""
    size = struct.calcsize(LAYOUT[kind])
    rest = payload[size:]
    if len(payload) < size or (len(rest) % row if row else rest):
        bound = f"{size} bytes" + (f" and rows of {row}" if row else "")
        raise ValueError(f"{kind.name}: payload of {len(payload)} bytes, must be {bound}: {payload.hex(' ')}")
    return struct.unpack(LAYOUT[kind], payload[:size]), rest
