"""Frames: one table for the Python and the C implementation, and whatever a line can make of them."""

import binascii
import re
import struct
import subprocess
from pathlib import Path

import pytest
from board import FIRMWARE, ROOT, SANITISED, compile_c
from hypothesis import given
from hypothesis import strategies as st

from hapticrender.drivers import protocol
from hapticrender.drivers.protocol import Frame, Kind, Reader
from hapticrender.protocols import Flag

TABLE = Path(__file__).parent / "frames.txt"
SESSION = 0x1A2B3C4D  # of the table


def table():
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            kind, sequence, payload, wire = line.split("#")[0].split()
            yield Frame(int(kind, 16), int(sequence, 16), bytes.fromhex(payload.strip("-"))), bytes.fromhex(wire)


FRAMES = list(table())


@pytest.fixture(scope="module")
def firmware(tmp_path_factory):
    """A function that asks the firmware's frames, under the sanitisers."""
    folder = tmp_path_factory.mktemp("frames")
    sources = [Path(__file__).parent / "frames_table.c", FIRMWARE / "frames.c"]
    program = compile_c(folder / "frames", sources, f"-I{FIRMWARE}", *SANITISED)

    def ask(lines):
        text = "".join(f"{line}\n" for line in lines)
        done = subprocess.run([program], input=text, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return ask


def as_text(frame):
    return f"{frame.kind:02x} {frame.sequence:04x} {frame.payload.hex() or '-'}"


@pytest.mark.parametrize(("frame", "wire"), FRAMES)
def test_the_table_holds_in_python(frame, wire):
    assert protocol.encode(frame) == wire
    assert list(Reader().feed(wire)) == [frame]


def test_the_table_holds_in_c(firmware):
    assert firmware(f"e {as_text(frame)}" for frame, _ in FRAMES) == [wire.hex() for _, wire in FRAMES]
    found = firmware(f"d {wire.hex()}" for _, wire in FRAMES)
    assert found == [line for frame, _ in FRAMES for line in (as_text(frame), ".")]


def test_the_table_has_every_command_with_its_check_value():
    commands = [frame for frame, _ in FRAMES if frame.kind in set(Kind) and frame.kind < 0x80]
    assert {frame.kind for frame in commands} == {kind for kind in Kind if kind < 0x80 and kind > 0}
    for kind, sequence, payload in commands:
        word = protocol.check_value(0 if kind == Kind.HELLO else SESSION, kind, sequence, payload[:-4])
        assert payload[-4:] == struct.pack("<I", word)
        rows = {Kind.PROFILE: 4 * 2, Kind.SAMPLES: 3 * 2, Kind.DRIVE: 2 * 2 * 4}.get(kind, 0)
        assert len(payload) - 4 == struct.calcsize(protocol.LAYOUT[kind]) + rows


def test_the_table_has_what_a_board_sends():
    """Every kind; telemetry and stream by the fields that the table's comments name."""
    frames = {frame.kind: frame.payload for frame, _ in FRAMES}
    assert {kind for kind in Kind if kind > 0x80} <= set(frames)
    telemetry, stream = protocol.telemetry(frames[Kind.TELEMETRY]), protocol.stream(frames[Kind.STREAM], 2, 2)
    assert (telemetry.sample, telemetry.session, telemetry.state) == (5051, SESSION, protocol.State.PLAYING)
    assert (telemetry.flags, telemetry.position) == (Flag.SENSOR_CLIPPED, pytest.approx(10e-3))
    assert (telemetry.mismatch, telemetry.damper_scale) == (0.0625, 1.0)
    assert [each.target for each in telemetry.bands] == pytest.approx([10e-6])
    assert (stream.first, stream.stride, len(stream.rows)) == (5051, 10, 2)


def test_the_page_explains_a_frame_of_the_table():
    page = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
    shown = re.search(r"^    ((?:[0-9a-f]{2} ?)+)$", page, re.MULTILINE).group(1)
    assert bytes.fromhex(shown) in [wire for _, wire in FRAMES]


def test_crc_and_cobs_are_the_published_ones(firmware):
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1  # CRC-16/CCITT-FALSE, catalogue of parametrised CRCs
    assert protocol.cobs_encode(bytes.fromhex("11220033")) == bytes.fromhex("0311220233")  # Cheshire and Baker 1999
    assert protocol.cobs_encode(bytes(range(1, 255))) == b"\xff" + bytes(range(1, 255))
    assert protocol.cobs_encode(b"\0") == b"\1\1"
    assert firmware(["e 31 3332 343536373839"]) == [protocol.encode(Frame(0x31, 0x3332, b"456789")).hex()]


frames = st.builds(
    Frame, st.integers(0, 255), st.integers(0, 0xFFFF), st.binary(min_size=0, max_size=protocol.MOST_PAYLOAD)
)


@given(st.lists(frames, min_size=1, max_size=5), st.integers(1, 50))
def test_frames_come_through_in_any_pieces(sent, piece):
    """COBS too: a zero within a frame would cut it, and what is not undone would be another payload."""
    reader, found = Reader(), []
    wire = b"".join(map(protocol.encode, sent))
    for start in range(0, len(wire), piece):
        found += reader.feed(wire[start : start + piece])
    assert found == sent
    assert reader.bad == 0


def test_c_and_python_find_the_same_in_a_damaged_stream(firmware, rng):
    """Both lose the same frames, and none with a wrong CRC is used; a frame that passes by chance must pass in both."""
    wire = bytearray(b"".join(wire for _, wire in FRAMES) * 30)
    for at in rng.choice(len(wire), len(wire) // 50, replace=False):
        wire[at] = rng.integers(256)
    wire += bytes(rng.integers(0, 256, 5000, dtype="u1")) + bytes(rng.integers(1, 256, 700, dtype="u1")) + b"\0"
    reader = Reader()
    found = list(reader.feed(bytes(wire)))
    lines = firmware([f"d {bytes(wire).hex()}"])
    assert [line for line in lines if line not in ("bad", ".")] == [as_text(frame) for frame in found]
    assert lines.count("bad") == reader.bad > 100
    sent = {frame for frame, _ in FRAMES}
    # of about 250 damaged frames one in 65 536 passes by chance: none at all with 99.6 %
    assert set(found) <= sent


@pytest.mark.parametrize(
    ("code", "match"),
    [
        ("", "frame of 0 bytes: must be 5 to 254"),
        ("05010203", "COBS group of 5 at byte 0 of 4"),
        ("027f0103a539", "CRC 0x39a5: must be 0x38a5"),
    ],
)
def test_what_is_no_frame_is_refused(code, match):
    with pytest.raises(ValueError, match=match):
        protocol.decode(bytes.fromhex(code))


@pytest.mark.parametrize("kind", [Kind.CAPABILITIES, Kind.TELEMETRY, Kind.STREAM])
def test_a_payload_of_a_wrong_length_is_refused(kind):
    size = struct.calcsize(protocol.LAYOUT[kind])
    parse = {
        Kind.CAPABILITIES: protocol.capabilities,
        Kind.TELEMETRY: protocol.telemetry,
        Kind.STREAM: lambda payload: protocol.stream(payload, 2, 2),
    }[kind]
    parse(bytes(size))
    for wrong in (size - 1, size + 1):
        with pytest.raises(ValueError, match=f"{kind.name}: payload of {wrong} bytes, must be {size} bytes"):
            parse(bytes(wrong))
