"""The compiled real-time entry: a controller as a C function and one pointer, for an audio library to call.

A callback written in Python waits for Python's lock and misses its deadline whenever another thread is busy.  This one
holds no lock, allocates nothing and never waits: targets and the finger's place reach it through slots that change
hands in one atomic step (`hapticrender.compiled.exchange`)::

    entry = RealtimeEntry(controller, sensed_scale=2e-4, drive_scale=0.5)   # m and 1/A of full scale
    stream = open_audio(callback=entry.address, user_data=entry.user_data, frames=entry.block)
    entry.send(bands)                  # other targets, from any thread of the application, one at a time
    entry.finger(0.01, velocity=0.05)  # m, m/s; it is followed at this speed until the next word
    entry.samples, entry.flags         # what has happened
    entry.silence()                    # zero drive, before the stream is closed
"""

from __future__ import annotations

import sys
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numba import types

from hapticrender.bands import Bands
from hapticrender.compiled.exchange import FRESH, SLOTS, behind, bytes_of, empty, place, swap
from hapticrender.compiled.jit import callback, kernel
from hapticrender.compiled.records import as_record
from hapticrender.control.bank.rows import TONE_ROWS
from hapticrender.control.blocks.controller import BlockController
from hapticrender.control.blocks.kernels import block_step
from hapticrender.control.blocks.state import BlockState, BlockTables
from hapticrender.protocols import Array, Flag

HORIZON = 0.05  # s: a finger that is not heard of stays where it was bound for by then
CONTINUE, ABORT = 0, 2  # what PortAudio takes for an answer
OVERRUN = int(Flag.OVERRUN)
LOST = 0b1111  # PortAudio's status: input or output under- or overflow
UNSIGNED_LONG = types.uint32 if sys.platform == "win32" else types.uint64
# entries of a slot: the finger's place and speed, whether anything is played, how often finger and tones have changed,
# then the tones, row by row
POSITION, VELOCITY, PLAYING, FINGER_NEWS, TONE_NEWS = range(5)
HEAD = 5
# entries of RealtimeParts.meter: samples, flags of all of them, blocks refused, and what was last taken up: slot, age
# of the finger in samples, news of finger and tones
SAMPLES, FLAGS, REFUSED, SLOT, AGE, FINGER_HEARD, TONE_HEARD = range(7)
METERS = 7


class RealtimeParts(NamedTuple):
    """All that the compiled entry reads and writes; the user data points to it."""

    tables: BlockTables
    state: BlockState
    slot: Array  # (SLOTS, HEAD + TONE_ROWS * bands)
    middle: Array  # (1,) integer: number of the slot in the middle, and FRESH
    meter: Array  # (METERS,) integer
    scale: Array  # (2,) m of full scale sensed; full scale of A driven
    sensed: Array  # scratch of a block: (M, sensors)
    position: Array  # (M,)
    wanted: Array  # (M,), zero
    drive: Array  # (M, channels)
    target: Array  # (bands,)
    flags: Array  # (M,)


class RealtimeEntry:
    """A controller in blocks behind a C function with one user-data pointer.

    Parameters
    ----------
    controller : BlockController
        Its state goes on here; do not run it elsewhere meanwhile.
    sensed_scale : float, m of full scale, > 0
        What a float sample of 1.0 means at the input.
    drive_scale : float, 1/A of full scale, > 0
        Float sample at the output for a drive of 1 A.

    Attributes
    ----------
    address : int
        Of ``int (const void *input, void *output, unsigned long frames, const void *time, unsigned long status, void
        *user_data)``, PortAudio's callback, with interleaved float samples.  It answers 2 (abort) and writes zeros
        where `frames` is no whole number of blocks or a buffer is missing.
    plain_address : int
        Of ``int (const double *sensed, double *drive, uint64_t frames, void *user_data)`` in m and A, which returns
        the block's `Flag` bits, or -1 where it refuses.
    user_data : int
        The pointer that belongs to both.  The entry has to outlive whoever calls them.
    block : int, samples
        Frames a call, or a multiple.

    Raises
    ------
    TypeError
        The controller does not run in blocks.
    ValueError
        A scale is out of its bound, or the targets are no constant envelopes: a waveform cannot be handed over.
    """

    def __init__(self, controller: BlockController, *, sensed_scale: float = 1.0, drive_scale: float = 1.0) -> None:
        if not isinstance(controller, BlockController):
            raise TypeError(f"controller of type {type(controller).__name__}: must be a BlockController")
        for name, value in (("sensed_scale (m)", sensed_scale), ("drive_scale (1/A)", drive_scale)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name}={value!r}: must be finite and > 0")
        if controller.tables.bank.numbers.analysed:
            raise ValueError("the targets are a waveform: must be constant envelopes (`Bands.envelope`)")
        self.controller, self.block = controller, controller.block
        self.rate = float(controller.tables.sample.rate)
        tone, sensors = controller.tables.bank.tone, controller.tables.bank.listen.shape[1]
        channels = len(controller.tables.bank.speak)
        self._now = np.concatenate([[np.nan, 0.0, 1.0, 0.0, 0.0], tone.ravel()])
        self._back = 0
        self._parts = RealtimeParts(
            tables=controller.tables,
            state=controller.state,
            slot=np.tile(self._now, (SLOTS, 1)),
            middle=np.array([1]),
            meter=np.array([0, 0, 0, 2, 0, 0, 0]),
            scale=np.array([sensed_scale, drive_scale], float),
            sensed=np.zeros((self.block, sensors)),
            position=np.zeros(self.block),
            wanted=np.zeros(self.block),
            drive=np.zeros((self.block, channels)),
            target=np.zeros(controller.n_bands, complex),
            flags=np.zeros(self.block, np.int64),
        )
        self._memory = np.zeros(_size(self._parts) // 8 + 8)
        self.user_data = int(self._memory.ctypes.data) // 64 * 64 + 64
        _settle(self.user_data, self._parts)
        self._pointer = types.CPointer(as_record(numba.typeof(self._parts)))

    @cached_property
    def address(self) -> int:
        """Address of the callback for PortAudio; compiled when first asked for."""
        floats = types.CPointer(types.float32)
        taken = (floats, floats, UNSIGNED_LONG, types.voidptr, UNSIGNED_LONG, self._pointer)
        return int(callback(_audio, types.int32, *taken).address)

    @cached_property
    def plain_address(self) -> int:
        """Address of the plain function; compiled when first asked for."""
        doubles = types.CPointer(types.float64)
        return int(callback(_plain, types.int32, doubles, doubles, types.uint64, self._pointer).address)

    def send(self, bands: Bands) -> None:
        """Hand over other targets, for the next block; see `BlockController.fitting` for the errors."""
        self._now[HEAD:] = self.controller.fitting(bands).ravel()
        self._now[TONE_NEWS] += 1
        self._hand_over()

    def finger(self, position: float, velocity: float = 0.0) -> None:
        """Tell where the finger is (m, NaN: lifted) and how fast it moves (m/s), at the start of the next block.

        Raises
        ------
        ValueError
            A number is infinite, or the velocity is NaN.
        """
        if np.isinf(position) or not np.isfinite(velocity):
            raise ValueError(f"{position=} m, {velocity=} m/s: must be finite (position may be NaN: lifted)")
        self._now[[POSITION, VELOCITY]] = position, velocity
        self._now[FINGER_NEWS] += 1
        self._hand_over()

    def silence(self, quiet: bool = True) -> None:
        """Drive nothing from the next block on, whatever is sensed.

        With ``quiet=False`` the controller goes on where it was, at once; its carriers have waited meanwhile.
        """
        self._now[PLAYING] = 0.0 if quiet else 1.0
        self._hand_over()

    @property
    def samples(self) -> int:
        """Samples that have been answered, silent ones included."""
        return int(self._parts.meter[SAMPLES])

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return Flag(int(self._parts.meter[FLAGS]))

    @property
    def refused(self) -> int:
        """Calls that were answered with zeros because they did not fit."""
        return int(self._parts.meter[REFUSED])

    def _hand_over(self) -> None:
        self._parts.slot[self._back] = self._now
        self._back = _publish(self._parts.middle, self._back)


@kernel
def _size(parts):
    return bytes_of(parts)


@kernel
def _settle(address, parts):
    place(address, parts)


@kernel
def _publish(middle, back):
    return swap(middle, back | FRESH) & (FRESH - 1)


@kernel
def take_over(parts):
    """Take up what the application has handed over, and say where the finger is during the block."""
    tables, meter, tone = parts.tables, parts.meter, parts.tables.bank.tone
    if parts.middle[0] & FRESH:
        meter[SLOT] = swap(parts.middle, meter[SLOT]) & (FRESH - 1)
    slot, block = parts.slot[meter[SLOT]], parts.position.shape[0]
    if slot[TONE_NEWS] != meter[TONE_HEARD]:
        meter[TONE_HEARD] = int(slot[TONE_NEWS])
        for r in range(TONE_ROWS):
            for k in range(tone.shape[1]):
                tone[r, k] = slot[HEAD + r * tone.shape[1] + k]
        parts.state.news[0] = 1
    if slot[FINGER_NEWS] != meter[FINGER_HEARD]:
        meter[FINGER_HEARD], meter[AGE] = int(slot[FINGER_NEWS]), 0
    for m in range(block):
        age = min((meter[AGE] + m) / tables.sample.rate, HORIZON)
        parts.position[m] = slot[POSITION] + age * slot[VELOCITY]
    meter[AGE] += block
    return slot[PLAYING] > 0.0


@kernel
def answer(parts):
    """Drive and flags of one block from what has been put into `sensed`; returns all its flags."""
    raised = 0
    if take_over(parts):
        block_step(
            parts.tables,
            parts.state,
            parts.sensed,
            parts.position,
            parts.wanted,
            parts.drive,
            parts.target,
            parts.flags,
        )
        for m in range(parts.flags.shape[0]):
            raised |= parts.flags[m]
    else:
        for m in range(parts.drive.shape[0]):
            for i in range(parts.drive.shape[1]):
                parts.drive[m, i] = 0.0
    parts.meter[FLAGS] |= raised
    parts.meter[SAMPLES] += parts.drive.shape[0]
    return raised


def _plain(sensed, drive, frames, user_data):
    """Blocks of double samples in SI units."""
    parts = behind(user_data)
    block, sensors = parts.sensed.shape
    channels, samples, raised = parts.drive.shape[1], int(frames), 0
    if samples % block or empty(sensed) or empty(drive):
        parts.meter[REFUSED] += 1
        for i in range(0 if empty(drive) else samples * channels):
            drive[i] = 0.0
        return -1
    for start in range(0, samples, block):
        for m in range(block):
            for i in range(sensors):
                parts.sensed[m, i] = sensed[(start + m) * sensors + i]
        raised |= answer(parts)
        for m in range(block):
            for i in range(channels):
                drive[(start + m) * channels + i] = parts.drive[m, i]
    return raised


def _audio(sensed, drive, frames, time, status, user_data):
    """Blocks of float samples at full scale, as PortAudio hands them."""
    parts = behind(user_data)
    block, sensors = parts.sensed.shape
    channels, samples = parts.drive.shape[1], int(frames)
    if status & LOST:
        parts.meter[FLAGS] |= OVERRUN
    if samples % block or empty(sensed) or empty(drive):
        parts.meter[REFUSED] += 1
        for i in range(0 if empty(drive) else samples * channels):
            drive[i] = 0.0
        return ABORT
    for start in range(0, samples, block):
        for m in range(block):
            for i in range(sensors):
                parts.sensed[m, i] = parts.scale[0] * sensed[(start + m) * sensors + i]
        answer(parts)
        for m in range(block):
            for i in range(channels):
                drive[(start + m) * channels + i] = parts.scale[1] * parts.drive[m, i]
    return CONTINUE
