"""The compiled callback of a sound card: it holds no lock, allocates nothing and never waits.

`_relay` is what PortAudio calls.  It gathers the chosen input channels, calls another function with PortAudio's
signature, cuts what that returns to full scale and scatters it over the chosen output channels; all others get zeros,
and so do these while there is no function.  It is that of a ``RealtimeEntry``, or `_queue`, which exchanges numbered
blocks with Python.
"""

from typing import Any

import numba
import numpy as np
from numba import carray, types

from hapticrender.jit import CALLBACK, I8, CFunction, call, entry, fetch_add, kernel, pointer, record, record_of
from hapticrender.protocols import Array, Flag

SLOTS = 64  # blocks that wait in either direction
AHEAD = 2  # blocks of drive that wait to be played while Python computes the next one, by default
CONTINUE = 0  # result of PortAudio's callback
LOST = 0b1111  # PortAudio's status: input or output under- or overflow
OVERRUN = int(Flag.OVERRUN)
F4 = types.float32

RELAY = np.dtype(
    [
        *((name, np.int64) for name in ("function", "argument", "block", "sensors", "channels", "wide_in", "wide_out")),
        *((name, np.int64) for name in ("inputs_at", "outputs_at", "sensed_at", "drive_at")),
        *((name, np.int64) for name in ("calls", "blocks", "overruns", "clipped")),
    ]
)
RELAY_T = numba.from_dtype(RELAY)
QUEUE = np.dtype(
    [(name, np.int64) for name in ("blocks", "first", "sensors", "channels", "sensed_at", "drive_at", "number_at")]
    + [("flags_at", np.int64)]
)
QUEUE_T = numba.from_dtype(QUEUE)
FUNCTION_AT = RELAY.fields["function"][1] if RELAY.fields else 0
BLOCKS_AT = QUEUE.fields["blocks"][1] if QUEUE.fields else 0


@entry
def counted(address, value):
    """Add to a counter that two threads share; returns what it was."""
    return fetch_add(address, value)


@kernel
def within(value):
    """Sample cut to full scale; 0 where it is not a number."""
    if value != value:
        return np.float32(0.0)
    return min(max(value, np.float32(-1.0)), np.float32(1.0))


@kernel
def gather(relay, given, count):
    """Copy the chosen input channels; without an input they stay 0."""
    r = record(relay, RELAY_T, 0)
    columns, sensed = carray(pointer(r.inputs_at, I8), r.sensors), carray(pointer(r.sensed_at, F4), count * r.sensors)
    if given != 0:
        source = carray(pointer(given, F4), count * r.wide_in)
        for n in range(count):
            for i in range(r.sensors):
                sensed[n * r.sensors + i] = source[n * r.wide_in + columns[i]]


@kernel
def scatter(relay, played, count):
    """Copy the drive to the chosen output channels, cut to full scale."""
    r = record(relay, RELAY_T, 0)
    columns, drive = carray(pointer(r.outputs_at, I8), r.channels), carray(pointer(r.drive_at, F4), count * r.channels)
    out = carray(pointer(played, F4), count * r.wide_out)
    for n in range(count):
        for i in range(r.channels):
            value = drive[n * r.channels + i]
            held = within(value)
            r.clipped += held != value
            out[n * r.wide_out + columns[i]] = held


def _relay(given, played, frames, time, status, relay):
    """PortAudio's callback: the chosen channels in, the other function, the chosen channels out."""
    r, count = record(relay, RELAY_T, 0), int(frames)
    out = carray(pointer(played, F4), count * r.wide_out)
    out[:] = np.float32(0.0)
    r.calls += 1
    function = fetch_add(relay + FUNCTION_AT, 0)
    if count == r.block and function != 0:
        r.overruns += (status & LOST) != 0
        gather(relay, given, count)
        call(function, (r.sensed_at, r.drive_at, frames, time, status, r.argument))
        scatter(relay, played, count)
        r.blocks += 1
    return CONTINUE


def _queue(sensed, drive, frames, time, status, address):
    """Exchange block number n with Python: keep what was sensed, play what was left for it, zeros where it is late."""
    q, count = record(address, QUEUE_T, 0), int(frames)
    number = q.blocks
    slot = number % SLOTS
    given, kept = carray(pointer(sensed, F4), count * q.sensors), count * q.sensors
    place = carray(pointer(q.sensed_at + 4 * slot * kept, F4), kept)
    for i in range(kept):
        place[i] = given[i]
    width = count * q.channels
    source, out = carray(pointer(q.drive_at + 4 * slot * width, F4), width), carray(pointer(drive, F4), width)
    ready = fetch_add(q.number_at + 8 * slot, 0) == number
    for i in range(width):
        out[i] = source[i] if ready else np.float32(0.0)
    flags = carray(pointer(q.flags_at, I8), SLOTS)
    flags[slot] = OVERRUN if status & LOST or (not ready and number >= q.first) else 0
    fetch_add(address + BLOCKS_AT, 1)
    return CONTINUE


RELAY_FUNCTION = CFunction(_relay, CALLBACK)
QUEUE_FUNCTION = CFunction(_queue, CALLBACK)


class Relay:
    """What `_relay` reads and writes: channels, the function that it calls, and counts.

    `inputs` and `outputs` are columns of the stream that are used, from 0 on, in the order of sensors and drive
    channels; `block` is in samples.
    """

    def __init__(self, inputs: tuple[int, ...], outputs: tuple[int, ...], block: int) -> None:
        wide_in, wide_out = (max(columns, default=-1) + 1 for columns in (inputs, outputs))
        self._arrays = {
            "inputs": np.array([*inputs, 0], np.int64),  # an array of length 0 may have no address
            "outputs": np.array(outputs, np.int64),
            "sensed": np.zeros((block, max(len(inputs), 1)), np.float32),
            "drive": np.zeros((block, len(outputs)), np.float32),
        }
        values = {"block": block, "sensors": len(inputs), "channels": len(outputs)}
        values |= {"wide_in": wide_in, "wide_out": wide_out}
        self._record = record_of(RELAY, **values, **{f"{name}_at": each for name, each in self._arrays.items()})
        self.address, self.user_data = RELAY_FUNCTION.address, int(self._record.ctypes.data)  # for PortAudio

    def call(self, function: int, argument: int) -> None:
        """Set the function that fills every block from now on, where there was none."""
        self._record["argument"] = argument
        counted(self.user_data + FUNCTION_AT, function - self.count("function"))

    def rest(self) -> None:
        """Play zeros from the next call on; the function may still be in its last one."""
        counted(self.user_data + FUNCTION_AT, -self.count("function"))

    def count(self, name: str) -> int:
        """Calls (`calls`), `blocks` filled, `overruns` before them, samples cut (`clipped`)."""
        return int(self._record[name][0])


class BlockQueue:
    """Numbered blocks between Python and the callback: drive block n is played in call n, or not at all.

    The time from a sensed sample to the drive that Python computes from it is therefore always the same, `ahead` + 1
    blocks and what the card adds; where Python is late, the device gets zeros and the block is flagged.  `ahead`, less
    than SLOTS - 1, is the number of blocks of drive that wait to be played.
    """

    def __init__(self, block: int, sensors: int, channels: int, ahead: int = AHEAD) -> None:
        self._sensed = np.zeros((SLOTS, block, max(sensors, 1)), np.float32)[:, :, :sensors]
        self._drive = np.zeros((SLOTS, block, channels), np.float32)
        self._numbers = np.full(SLOTS, -1, np.int64)
        self._flags = np.zeros(SLOTS, np.int64)
        arrays: dict[str, Any] = {"sensed_at": self._sensed, "drive_at": self._drive}
        arrays |= {"number_at": self._numbers, "flags_at": self._flags}
        self._record = record_of(QUEUE, first=ahead, sensors=sensors, channels=channels, **arrays)
        self.address, self.user_data = QUEUE_FUNCTION.address, int(self._record.ctypes.data)  # as of a callback

    @property
    def blocks(self) -> int:
        """Calls so far: sensed blocks with lower numbers are complete."""
        return int(counted(self.user_data + BLOCKS_AT, 0))

    def put(self, number: int, drive: Array) -> None:
        """Leave the drive of call `number` (full scale 1, shape (block, channels))."""
        slot = number % SLOTS
        self._drive[slot] = drive
        counted(self._numbers.ctypes.data + 8 * slot, number - int(self._numbers[slot]))

    def take(self, number: int) -> tuple[Array, int]:
        """Return what call `number` sensed (full scale 1) and its flags."""
        slot = number % SLOTS
        return self._sensed[slot].astype(float), int(self._flags[slot])
