"""The compiled real-time entry: a controller as a C function and one pointer, for an audio library to call.

A callback written in Python waits for Python's lock and misses its deadline whenever another thread is busy.  This one
holds no lock, allocates nothing and never waits: targets and the finger's position reach it through a triple buffer,
whose slots change hands in one atomic step::

    entry = RealtimeEntry(controller, sensed_scale=2e-4, drive_scale=0.5)   # m and 1/A of full scale
    stream = open_audio(callback=entry.address, user_data=entry.user_data, frames=entry.block)
    entry.send(bands)                  # other targets, from any thread of the application, one at a time
    entry.finger(0.01, velocity=0.05)  # m, m/s; extrapolated at this speed until the next call
    entry.samples, entry.flags         # what has happened
    entry.silence()                    # zero drive, before the stream is closed

Three slots, one writer and one reader: the writer fills its own slot and swaps it for the one in the middle, the reader
swaps its own for that where it is fresh.  Neither ever waits, and no slot is read while it is written.
"""

from __future__ import annotations

import sys
from functools import cached_property
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

from hapticrender.bands import Bands
from hapticrender.control.records import SETPOINT_ROWS
from hapticrender.jit import F8, I8, CFunction, addresses, call, entry, kernel, pointer, record
from hapticrender.protocols import Array, Flag

HORIZON = 0.05  # s: without a new position the finger stays where it was bound for by then
CONTINUE, ABORT = 0, 2  # results of PortAudio's callback
OVERRUN = int(Flag.OVERRUN)
LOST = 0b1111  # PortAudio's status: input or output under- or overflow
UNSIGNED_LONG = types.uint32 if sys.platform == "win32" else types.uint64
F4 = types.float32
SLOTS, FRESH = 3, 4  # slots; bit beside the number of the slot in the middle: not yet read
# entries of a slot: the finger's position and speed, whether anything is played, how often finger and setpoints have
# changed, then the setpoints row by row
POSITION, VELOCITY, PLAYING, FINGER_CHANGES, SETPOINT_CHANGES = range(5)
HEAD = 5

ENTRY = np.dtype(
    [
        *((name, np.int64) for name in ("step", "controller", "signals", "block", "sensors", "channels", "setpoints")),
        *((name, np.int64) for name in ("setpoints_at", "slots_at", "middle", "slot", "age")),
        *((name, np.float64) for name in ("finger_changes", "setpoint_changes", "rate", "sensed_scale", "drive_scale")),
        *((name, np.int64) for name in ("sensed_at", "drive_at", "position_at", "waveform_at", "flags_at")),
        *(
            (name, np.int64)
            for name in ("samples", "flags", "refused", "texture_at", "texture_length", "spatial", "ahead")
        ),
        ("period", np.float64),
    ]
)
ENTRY_T = numba.from_dtype(ENTRY)
MIDDLE_AT = ENTRY.fields["middle"][1] if ENTRY.fields else 0


@intrinsic
def swap(typingctx: Any, address: Any, value: Any) -> Any:
    """Store an int64 at an address and return what was there, in one indivisible step that orders memory."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = builder.inttoptr(values[0], ir.PointerType(ir.IntType(64)))
        return builder.atomic_rmw("xchg", place, values[1], "acq_rel")

    return types.int64(types.int64, types.int64), build


@entry
def publish(entry, back):
    """Swap the writer's slot `back` for the one in the middle; returns the writer's next slot."""
    return swap(entry + MIDDLE_AT, back | FRESH) & (FRESH - 1)


@kernel
def receive(entry):
    """Take up what the application has handed over: setpoints, and the finger's position during the block."""
    e = record(entry, ENTRY_T, 0)
    if e.middle & FRESH:
        e.slot = swap(entry + MIDDLE_AT, e.slot) & (FRESH - 1)
    width = HEAD + e.setpoints
    slot = carray(pointer(e.slots_at + 8 * width * e.slot, F8), width)
    if slot[SETPOINT_CHANGES] != e.setpoint_changes:
        e.setpoint_changes = slot[SETPOINT_CHANGES]
        setpoints = carray(pointer(e.setpoints_at, F8), e.setpoints)
        for i in range(e.setpoints):
            setpoints[i] = slot[HEAD + i]
    if slot[FINGER_CHANGES] != e.finger_changes:
        e.finger_changes, e.age = slot[FINGER_CHANGES], 0
    position, waveform = carray(pointer(e.position_at, F8), e.block), carray(pointer(e.waveform_at, F8), e.block)
    texture = carray(pointer(e.texture_at, F8), e.texture_length)
    for m in range(e.block):
        age = min((e.age + m) / e.rate, HORIZON)
        position[m] = slot[POSITION] + age * slot[VELOCITY]
        if e.texture_length > 0:
            ahead = e.ahead / e.rate
            at = position[m] + ahead * slot[VELOCITY] if e.spatial > 0 else (e.samples + m) / e.rate + ahead
            turns = at / e.period
            if turns != turns:  # lifted: what was last there holds
                waveform[m] = waveform[m - 1 if m > 0 else e.block - 1]
            else:
                place = (turns - np.floor(turns)) * e.texture_length
                i = int(place) % e.texture_length
                after = texture[(i + 1) % e.texture_length]
                waveform[m] = texture[i] + (place - int(place)) * (after - texture[i])
    e.age += e.block
    return slot[PLAYING] > 0.0


@kernel
def advance(entry):
    """Advance the controller by the block that is in its `sensed`; returns all flags of the block."""
    e = record(entry, ENTRY_T, 0)
    flags, drive = carray(pointer(e.flags_at, I8), e.block), carray(pointer(e.drive_at, F8), e.block * e.channels)
    playing, raised = receive(entry), 0
    if playing:
        for m in range(e.block):
            flags[m] = 0
        call(e.step, (e.controller, e.signals, 0, e.block))
        for m in range(e.block):
            raised |= flags[m]
    else:
        for i in range(e.block * e.channels):
            drive[i] = 0.0
    e.flags |= raised
    e.samples += e.block
    return raised


@kernel
def carry(entry, sensed, drive, frames, dtype, sensed_scale, drive_scale):
    """Advance by blocks of samples of `dtype` at two addresses; returns the flags, or -1 and zeros where it refuses."""
    e, count = record(entry, ENTRY_T, 0), int(frames)
    out = carray(pointer(drive, dtype), count * e.channels if drive != 0 else 0)
    if count % e.block or sensed == 0 or drive == 0:
        e.refused += 1
        out[:] = 0.0
        return -1
    given, raised = carray(pointer(sensed, dtype), count * e.sensors), 0
    inputs, outputs = e.block * e.sensors, e.block * e.channels
    own, result = carray(pointer(e.sensed_at, F8), inputs), carray(pointer(e.drive_at, F8), outputs)
    for block in range(count // e.block):
        for i in range(inputs):
            own[i] = sensed_scale * given[block * inputs + i]
        raised |= advance(entry)
        for i in range(outputs):
            out[block * outputs + i] = drive_scale * result[i]
    return raised


def _plain(sensed, drive, frames, entry):
    """Advance by blocks of double samples in SI units; returns the flags, or -1 where it refuses."""
    return carry(entry, sensed, drive, frames, F8, 1.0, 1.0)


def _audio(sensed, drive, frames, time, status, entry):
    """Advance by blocks of interleaved float samples at full scale: PortAudio's callback."""
    e = record(entry, ENTRY_T, 0)
    if status & LOST:
        e.flags |= OVERRUN
    return ABORT if carry(entry, sensed, drive, frames, F4, e.sensed_scale, e.drive_scale) < 0 else CONTINUE


PLAIN = CFunction(_plain, types.int32(I8, I8, types.uint64, I8))
AUDIO = CFunction(_audio, types.int32(I8, I8, UNSIGNED_LONG, I8, UNSIGNED_LONG, I8))


class RealtimeEntry:
    """A controller of any device and method behind a C function with one user-data pointer.

    Parameters
    ----------
    controller : Controller
        With a compiled step; its state goes on here, so do not run it elsewhere meanwhile.
    sensed_scale : float, m of full scale, > 0
        Unit of a float sample of 1.0 at the input.
    drive_scale : float, 1/A of full scale, > 0
        Float sample at the output for a drive of 1 A.
    waveform : ndarray, shape (n,), m, optional
        Of a texture that is a waveform (a recording): one period of it, repeated, read ahead as the law needs it.
    period : float, s or m
        Length of the waveform, > 0: in time, or along the surface where it is `spatial`.
    spatial : bool
        Whether the waveform lies along the surface.

    Attributes
    ----------
    address : int
        Of ``int (const void *input, void *output, unsigned long frames, const void *time, unsigned long status, void
        *user_data)``, PortAudio's callback, with interleaved float samples.  It returns 2 (abort) and writes zeros
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
        The controller has no compiled step.
    ValueError
        A scale is out of its bound, or a waveform is missing or not asked for.
    """

    def __init__(
        self,
        controller: Any,
        *,
        sensed_scale: float = 1.0,
        drive_scale: float = 1.0,
        waveform: Array | None = None,
        period: float = 1.0,
        spatial: bool = False,
    ) -> None:
        if not isinstance(getattr(controller, "step", None), CFunction):
            raise TypeError(f"controller of type {type(controller).__name__}: must have a compiled step")
        for name, value in (("sensed_scale (m)", sensed_scale), ("drive_scale (1/A)", drive_scale), ("period", period)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name}={value!r}: must be finite and > 0")
        analysed = controller.bands.envelope is None
        if analysed != (waveform is not None):
            need = "given for targets that are a waveform" if analysed else "left out: targets are envelopes"
            raise ValueError(f"waveform: must be {need}")
        self.controller, self.block, self.rate = controller, controller.block, float(controller.rate)
        setpoints = getattr(controller, "setpoints", np.zeros((SETPOINT_ROWS, 0)))
        self._slot = np.concatenate([[np.nan, 0.0, 1.0, 0.0, 0.0], setpoints.ravel()])
        self._back = 0
        waveform = np.zeros(0) if waveform is None else np.ascontiguousarray(waveform, float)
        arrays = {
            "sensed": np.zeros((self.block, controller.sensors)),
            "drive": np.zeros((self.block, controller.channels)),
            "position": np.zeros(self.block),
            "waveform": np.zeros(self.block),
            "flags": np.zeros(self.block, np.int64),
        }
        target = np.zeros((self.block, controller.n_bands), complex)
        signals = addresses(**arrays, target=target)
        self._slots = np.tile(self._slot, (SLOTS, 1))
        self._keep = (arrays, target, signals, waveform, setpoints)
        self._entry = np.zeros(1, ENTRY)
        values = {
            "step": controller.step.address,
            "controller": controller.state.ctypes.data,
            "signals": signals.ctypes.data,
            "block": self.block,
            "sensors": controller.sensors,
            "channels": controller.channels,
            "setpoints": setpoints.size,
            "setpoints_at": setpoints.ctypes.data,
            "slots_at": self._slots.ctypes.data,
            "middle": 1,
            "slot": 2,
            "rate": self.rate,
            "sensed_scale": sensed_scale,
            "drive_scale": drive_scale,
            "texture_at": waveform.ctypes.data,
            "texture_length": len(waveform),
            "spatial": spatial,
            "ahead": getattr(controller, "lookahead", 0),
            "period": period,
            **{f"{name}_at": array.ctypes.data for name, array in arrays.items()},
        }
        for name, value in values.items():
            self._entry[name] = value
        self.user_data = int(self._entry.ctypes.data)

    @cached_property
    def address(self) -> int:
        """Address of the callback for PortAudio; compiled when it is first read."""
        return AUDIO.address

    @cached_property
    def plain_address(self) -> int:
        """Address of the plain function; compiled when it is first read."""
        return PLAIN.address

    def send(self, bands: Bands) -> None:
        """Hand over other targets, for the next block; see `BankController.fitting` for the errors."""
        if not hasattr(self.controller, "fitting"):
            raise TypeError(f"controller of type {type(self.controller).__name__}: takes no other targets under way")
        self._slot[HEAD:] = self.controller.fitting(bands).ravel()
        self._slot[SETPOINT_CHANGES] += 1
        self._hand_over()

    def finger(self, position: float, velocity: float = 0.0) -> None:
        """Set the finger's position (m, NaN: lifted) and velocity (m/s, finite) at the start of the next block."""
        if np.isinf(position) or not np.isfinite(velocity):
            raise ValueError(f"{position=} m, {velocity=} m/s: must be finite (position may be NaN: lifted)")
        self._slot[[POSITION, VELOCITY]] = position, velocity
        self._slot[FINGER_CHANGES] += 1
        self._hand_over()

    def silence(self, quiet: bool = True) -> None:
        """Set zero drive from the next block on, whatever is sensed.

        With ``quiet=False`` the controller goes on where it was, at once; its carriers have waited meanwhile.
        """
        self._slot[PLAYING] = 0.0 if quiet else 1.0
        self._hand_over()

    @property
    def samples(self) -> int:
        """Samples that have been played, silent ones included."""
        return int(self._entry["samples"][0])

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return Flag(int(self._entry["flags"][0]))

    @property
    def refused(self) -> int:
        """Calls that were refused, and got zeros, because they did not fit."""
        return int(self._entry["refused"][0])

    def _hand_over(self) -> None:
        self._slots[self._back] = self._slot
        self._back = int(publish(self.user_data, self._back))
