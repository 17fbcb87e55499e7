"""The compiled real-time entry: a controller as a C function and one pointer, for an audio library to call.

A callback written in Python waits for Python's lock and misses its deadline whenever another thread is busy.  This one
holds no lock, allocates nothing and never waits: targets and the finger's position reach it through a triple buffer,
whose slots change hands in one atomic step::

    entry = RealtimeEntry(controller, sensed_scale=2e-4, drive_scale=0.5)   # m and 1/A of full scale
    stream = open_audio(callback=entry.address, user_data=entry.user_data, frames=entry.block)
    entry.play(voice)                  # a texture, from any thread of the application, one at a time
    entry.send(bands)                  # or other targets, of a law by bands
    entry.finger(0.01, velocity=0.05)  # m, m/s; extrapolated at this speed until the next call
    entry.samples, entry.flags         # what has happened
    entry.silence()                    # zero drive, before the stream is closed

Three slots, one writer and one reader: the writer fills its own slot and swaps it for the one in the middle, the reader
swaps its own for that where it is fresh.  Neither ever waits, and no slot is read while it is written.
"""

from __future__ import annotations

import math
import sys
import threading
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numba import carray, types

from hapticrender.bands import Bands
from hapticrender.control.carriers import track_finger
from hapticrender.control.records import CONTROLLER, CONTROLLER_T, SETPOINT_ROWS
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.jit import F8, I8, CFunction, addresses, call, entry, kernel, pointer, record, swap
from hapticrender.protocols import Array, Flag
from hapticrender.voices import FADE, VOICE_T, Voice, along_surface, eased, in_time

HORIZON = 0.05  # s: without a new position the finger stays where it was bound for by then,
HOLD = 0.25  # s: and after so long what lies along the surface fades out
TOUCH_FADE = 0.02  # s: of what lies along the surface, at touch and lift
JUMP, JUMP_TIME = 2e-3, 5e-3  # m, s: a correction of the position up to this decays by two poles of that time
GAIN_TIME = 10e-3  # s
LOG_TIME = 2.0  # s: of signals that are kept
CONTINUE, ABORT = 0, 2  # results of PortAudio's callback
OVERRUN, STOPPED = int(Flag.OVERRUN), int(Flag.STOPPED)
LOST = 0b1111  # PortAudio's status: input or output under- or overflow
UNSIGNED_LONG = types.uint32 if sys.platform == "win32" else types.uint64
F4 = types.float32
SLOTS, FRESH = 3, 4  # slots; bit beside the number of the slot in the middle: not yet read
# entries of a slot: the finger's position, speed and load, whether anything is played, the gain, the voice's address,
# how often finger and setpoints have changed, the watchdog's time (samples; 0: none), how often the application has
# called, then the setpoints row by row
POSITION, VELOCITY, LOAD, PLAYING, GAIN, VOICE_ADDRESS, FINGER_CHANGES, SETPOINT_CHANGES, WATCHDOG, CALLS = range(10)
HEAD = 10

BLOCK = ("sensed", "drive", "position", "waveform", "flags", "target")  # signals of a block
_ADDRESSES = "step controller signals slots_at setpoints_at sensed_at drive_at position_at waveform_at flags_at"
_COUNTS = "block sensors channels setpoints middle slot age samples flags refused lost ahead analysed idle timed_out"
_TEXTURE = "current previous switch gains_at tracker log_at log_rows log_width given taken"
_STATE = "finger_changes setpoint_changes calls gain touch place pace offset offset_input lead lead_input open"
_SETTINGS = "rate sensed_scale drive_scale fade touch_step gain_pole offset_kept closing_step"
ENTRY = np.dtype(
    [
        *((name, np.int64) for name in f"{_ADDRESSES} {_COUNTS} {_TEXTURE}".split()),
        *((name, np.float64) for name in f"{_STATE} {_SETTINGS}".split()),
    ]
)
ENTRY_T = numba.from_dtype(ENTRY)
FIELDS = ENTRY.names or ()
MIDDLE_AT = ENTRY.fields["middle"][1] if ENTRY.fields else 0


@entry
def publish(entry, back):
    """Swap the writer's slot `back` for the one in the middle; returns the writer's next slot."""
    return swap(entry + MIDDLE_AT, back | FRESH) & (FRESH - 1)


@kernel
def receive(entry):
    """Take up what the application has handed over; returns the address of the slot."""
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
        jump = e.place + e.pace - slot[POSITION]  # from where it would have gone on
        e.offset = e.offset_input = jump if abs(jump) < JUMP else 0.0
    voice = int(slot[VOICE_ADDRESS])
    if voice != e.current and e.samples >= e.switch + e.fade:  # one change after the other
        e.previous, e.current, e.switch = e.current, voice, e.samples + e.ahead
        record(voice, VOICE_T, 0).begun = e.switch
    return e.slots_at + 8 * width * e.slot


@kernel
def follow_finger(entry, slot, m):
    """Where the finger is in sample m of the block, and where it will be at the end of the look-ahead (m)."""
    e, values = record(entry, ENTRY_T, 0), carray(pointer(slot, F8), HEAD)
    position, ahead = carray(pointer(e.position_at, F8), e.block), e.ahead / e.rate
    if e.given != 0:
        position[m] = carray(pointer(e.given, F8), 1)[e.taken + m]
        c = record(e.tracker, CONTROLLER_T, 0)
        track_finger(e.tracker, position[m])
        there = position[m] + ahead * (c.velocity + 0.5 * ahead * c.acceleration)
    else:
        age = (e.age + m) / e.rate
        position[m] = values[POSITION] + min(age, HORIZON) * values[VELOCITY] + e.offset
        there = position[m] + e.lead
        kept, lead = e.offset_kept, ahead * values[VELOCITY] if age < HORIZON else 0.0
        e.lead_input = lead + kept * (e.lead_input - lead)  # two poles: neither place nor speed steps
        e.lead = e.lead_input + kept * (e.lead - e.lead_input)
        e.offset_input *= kept
        e.offset = e.offset_input + kept * (e.offset - e.offset_input)
    touches = position[m] == position[m]
    if touches:
        e.pace = position[m] - e.place if abs(position[m] - e.place) < JUMP else 0.0
        e.place = position[m]
    fresh = e.given != 0 or e.age + m < HOLD * e.rate
    e.touch = min(max(e.touch + (e.touch_step if touches and fresh else -e.touch_step), 0.0), 1.0)
    return e.place, there if touches else e.place


@kernel
def texture_at(entry, sample, position, gain, touch):
    """Texture at a sample: a voice while it fades into the next one."""
    e = record(entry, ENTRY_T, 0)
    weight, total = eased((sample - e.switch) / e.fade), 0.0
    if e.current != 0:
        total += weight * gain * (in_time(e.current, sample) + touch * along_surface(e.current, position))
    if e.previous != 0 and weight < 1.0:
        total += (1.0 - weight) * gain * (in_time(e.previous, sample) + touch * along_surface(e.previous, position))
    return total


@kernel
def play_texture(entry, slot):
    """Waveform of the block, ahead of time as the law needs it (of bands: the gain); the texture itself into the log.

    Gain and touch wait in a ring meanwhile, so that what is asked for is what was handed to the law.
    """
    e, values = record(entry, ENTRY_T, 0), carray(pointer(slot, F8), HEAD)
    waveform, gains = carray(pointer(e.waveform_at, F8), e.block), carray(pointer(e.gains_at, F8), (e.ahead + 1, 2))
    log = carray(pointer(e.log_at, F8), (e.log_rows, e.log_width))
    for m in range(e.block):
        now, (here, there) = e.samples + m, follow_finger(entry, slot, m)
        e.gain += e.gain_pole * (values[GAIN] - e.gain)
        gain, touch = e.gain, eased(e.touch)
        waveform[m] = texture_at(entry, now + e.ahead, there, gain, touch) if e.analysed > 0 else gain
        gains[(now + e.ahead) % (e.ahead + 1), 0], gains[(now + e.ahead) % (e.ahead + 1), 1] = gain, touch
        then = now % (e.ahead + 1)
        log[now % e.log_rows, e.channels + e.sensors + 2] = texture_at(entry, now, here, gains[then, 0], gains[then, 1])
    e.age += e.block
    e.taken += e.block


@kernel
def write_log(entry, slot):
    """Drive, sensed, position, load and flags of the block into the log, beside the texture."""
    e, values = record(entry, ENTRY_T, 0), carray(pointer(slot, F8), HEAD)
    drive, sensed = carray(pointer(e.drive_at, F8), e.block * e.channels), carray(pointer(e.sensed_at, F8), 1)
    position, flags = carray(pointer(e.position_at, F8), e.block), carray(pointer(e.flags_at, I8), e.block)
    log = carray(pointer(e.log_at, F8), (e.log_rows, e.log_width))
    for m in range(e.block):
        row = (e.samples + m) % e.log_rows
        for i in range(e.channels):
            log[row, i] = drive[m * e.channels + i]
        for i in range(e.sensors):
            log[row, e.channels + i] = sensed[m * e.sensors + i]
        log[row, e.channels + e.sensors] = position[m]
        log[row, e.channels + e.sensors + 1] = values[LOAD]
        log[row, e.channels + e.sensors + 3] = flags[m]


@kernel
def watch(entry, slot):
    """Count the samples since the application has called; beyond the watchdog's time the drive is stopped."""
    e, values = record(entry, ENTRY_T, 0), carray(pointer(slot, F8), HEAD)
    if values[CALLS] != e.calls:
        e.calls, e.idle = values[CALLS], 0
    e.idle += e.block
    if values[WATCHDOG] > 0.0 and e.idle > values[WATCHDOG] and e.timed_out < 0:
        e.timed_out = e.samples


@kernel
def fade_out(entry):
    """Bring the drive of a block, and of all that follow, down to zero within `supervisor.FADE_OUT`."""
    e = record(entry, ENTRY_T, 0)
    flags, drive = carray(pointer(e.flags_at, I8), e.block), carray(pointer(e.drive_at, F8), e.block * e.channels)
    for m in range(e.block):
        e.open = max(e.open - e.closing_step, 0.0)
        flags[m] |= STOPPED
        for i in range(e.channels):
            drive[m * e.channels + i] *= e.open


@kernel
def advance(entry):
    """Advance the controller by the block that is in its `sensed`; returns all flags of the block."""
    e = record(entry, ENTRY_T, 0)
    flags, drive = carray(pointer(e.flags_at, I8), e.block), carray(pointer(e.drive_at, F8), e.block * e.channels)
    slot, raised = receive(entry), 0
    watch(entry, slot)
    play_texture(entry, slot)
    for m in range(e.block):
        flags[m] = e.lost
    e.lost = 0
    if carray(pointer(slot, F8), HEAD)[PLAYING] > 0.0 and e.open > 0.0:
        call(e.step, (e.controller, e.signals, 0, e.block))
    else:
        for i in range(e.block * e.channels):
            drive[i] = 0.0
    if e.timed_out >= 0:
        fade_out(entry)
    for m in range(e.block):
        raised |= flags[m]
    write_log(entry, slot)
    e.flags |= raised
    e.samples += e.block
    return raised


@kernel
def carry(entry, sensed, drive, frames, dtype, sensed_scale, drive_scale):
    """Advance by blocks of samples of `dtype` at two addresses; returns the flags, or -1 and zeros where it refuses."""
    e, count = record(entry, ENTRY_T, 0), int(frames)
    out = carray(pointer(drive, dtype), count * e.channels if drive != 0 else 0)
    if count % e.block or (sensed == 0 and e.sensors > 0) or drive == 0:
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
        e.lost = OVERRUN
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
    whole : bool
        Whether the law plays a whole waveform: textures then fade into each other (`play`).  Of a law by bands the
        gain is a factor of targets that are modulated, and else ignored.

    Raises
    ------
    TypeError
        The controller has no compiled step.
    ValueError
        A scale is out of its bound.
    """

    def __init__(self, controller: Any, *, sensed_scale: float = 1.0, drive_scale: float = 1.0) -> None:
        if not isinstance(getattr(controller, "step", None), CFunction):
            raise TypeError(f"controller of type {type(controller).__name__}: must have a compiled step")
        for name, value in (("sensed_scale (m)", sensed_scale), ("drive_scale (1/A)", drive_scale)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name}={value!r}: must be finite and > 0")
        self.controller, self.block, self.rate = controller, controller.block, float(controller.rate)
        self.whole = controller.bands.envelope is None
        setpoints = getattr(controller, "setpoints", np.zeros((SETPOINT_ROWS, 0)))
        self._slot = np.concatenate([np.zeros(HEAD), setpoints.ravel()])
        self._slot[[POSITION, PLAYING, GAIN]] = np.nan, 1.0, 1.0
        self._slots, self._back = np.tile(self._slot, (SLOTS, 1)), 0
        self._voices: list[Voice] = []
        self._writing = threading.Lock()  # of threads of the application; the callback never waits
        self.ahead, self._tracker = int(getattr(controller, "lookahead", 0)), np.zeros(1, CONTROLLER)
        self._tracker["p"]["rate"] = self.rate
        self._arrays = self._buffers()
        self._keep = setpoints, signals = setpoints, addresses(**{name: self._arrays[name] for name in BLOCK})
        self._entry = np.zeros(1, ENTRY)
        fixed = {
            "step": controller.step.address,
            "controller": controller.state.ctypes.data,
            "signals": signals.ctypes.data,
            "setpoints": setpoints.size,
            "setpoints_at": setpoints.ctypes.data,
            "slots_at": self._slots.ctypes.data,
            "tracker": self._tracker.ctypes.data,
            "sensed_scale": sensed_scale,
            "drive_scale": drive_scale,
            **{f"{name}_at": array.ctypes.data for name, array in self._arrays.items() if f"{name}_at" in FIELDS},
        }
        for name, value in (fixed | self._start()).items():
            self._entry[name] = value
        self.user_data = int(self._entry.ctypes.data)

    def _buffers(self) -> dict[str, Array]:
        """Signals of a block, gains that wait, and the log."""
        controller, block = self.controller, self.block
        rows = -(-round(LOG_TIME * self.rate) // block) * block
        return {
            "sensed": np.zeros((block, controller.sensors)),
            "drive": np.zeros((block, controller.channels)),
            "position": np.full(block, np.nan),
            "waveform": np.zeros(block),
            "flags": np.zeros(block, np.int64),
            "target": np.zeros((block, controller.n_bands), complex),
            "gains": np.zeros((self.ahead + 1, 2)),
            "log": np.zeros((rows, controller.channels + controller.sensors + 4)),
        }

    def _start(self) -> dict[str, float]:
        """Numbers of the record at rest."""
        log, rate = self._arrays["log"], self.rate
        return {
            **{"block": self.block, "sensors": self.controller.sensors, "channels": self.controller.channels},
            **{"middle": 1, "slot": 2, "timed_out": -1, "gain": 1.0, "open": 1.0, "place": np.nan, "rate": rate},
            **{"ahead": self.ahead, "analysed": self.whole, "log_rows": log.shape[0], "log_width": log.shape[1]},
            "age": round(HOLD * rate),
            "fade": round(FADE * rate),
            "switch": -round(FADE * rate),
            "touch_step": 1.0 / (TOUCH_FADE * rate),
            "closing_step": 1.0 / (FADE_OUT * rate),
            "gain_pole": -math.expm1(-1.0 / (GAIN_TIME * rate)),
            "offset_kept": math.exp(-1.0 / (JUMP_TIME * rate)),
        }

    @cached_property
    def address(self) -> int:
        """Address of the callback for PortAudio; compiled when it is first read."""
        return AUDIO.address

    @cached_property
    def plain_address(self) -> int:
        """Address of the plain function; compiled when it is first read."""
        return PLAIN.address

    def process(self, sensed: Array, position: Array | None = None, flags: int = 0) -> Array:
        """Advance from Python by n samples, whole blocks: drive (n, channels) for `sensed` (n, sensors), in m and A.

        `position` (m, NaN while lifted, shape (n,)) is the device's own, in place of `finger`; `flags` are the
        device's.
        """
        sensed, drive = np.ascontiguousarray(sensed, float), np.empty((len(sensed), self.controller.channels))
        position = None if position is None else np.ascontiguousarray(position, float)
        self._entry["given"] = 0 if position is None else position.ctypes.data
        self._entry["taken"], self._entry["lost"] = 0, flags
        PLAIN(sensed.ctypes.data, drive.ctypes.data, len(sensed), self.user_data)
        return drive

    def play(self, voice: Voice) -> None:
        """Fade from the texture that plays into another one, within `voices.FADE`; one change after the other."""
        self._slot[VOICE_ADDRESS] = voice.address
        self._voices = [each for each in self._voices if each.address in self._heard()]
        self._voices += [voice]
        self._hand_over()

    def fill(self) -> None:
        """Compute what comes next of all textures in time; call it at least once a second."""
        playing = [int(self._entry[name][0]) for name in ("current", "previous")]
        for voice in self._voices:
            if voice.address in playing:
                voice.fill(self.samples + self.ahead - int(voice.record["begun"][0]))

    def send(self, bands: Bands) -> None:
        """Hand over other targets, for the next block; see `BankController.fitting` for the errors."""
        if not hasattr(self.controller, "fitting"):
            raise TypeError(f"controller of type {type(self.controller).__name__}: takes no other targets under way")
        self._slot[HEAD:] = self.controller.fitting(bands).ravel()
        self._slot[SETPOINT_CHANGES] += 1
        self._hand_over()

    def finger(self, position: float, velocity: float = 0.0, load: float = 0.0) -> None:
        """Set the finger's position (m, NaN: lifted), velocity (m/s) and load (N) at the start of the next block."""
        if np.isinf(position) or not np.isfinite(velocity) or not 0.0 <= load < np.inf:
            raise ValueError(f"{position=} m, {velocity=} m/s, {load=} N: must be finite (position may be NaN: lifted)")
        with self._writing:
            self._slot[[POSITION, VELOCITY, LOAD]] = position, velocity, load
            self._slot[FINGER_CHANGES] += 1
        self._hand_over()

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, finite; it is reached within some 30 ms."""
        if not np.isfinite(gain):
            raise ValueError(f"{gain=}: must be finite")
        self._slot[GAIN] = gain
        self._hand_over()

    def watch(self, seconds: float | None = None) -> None:
        """Stop the drive for good once neither this nor `alive` has been called for so long (s); None: never."""
        with self._writing:
            self._slot[WATCHDOG] = 0.0 if seconds is None else seconds * self.rate
            self._slot[CALLS] += 1
        self._hand_over()

    def alive(self) -> None:
        """Note a call of the application, for the watchdog."""
        if self._slot[WATCHDOG] > 0.0:
            with self._writing:
                self._slot[CALLS] += 1
            self._hand_over()

    def silence(self, quiet: bool = True) -> None:
        """Set zero drive from the next block on, whatever is sensed.

        With ``quiet=False`` the controller goes on where it was, at once; its carriers have waited meanwhile.
        """
        self._slot[PLAYING] = 0.0 if quiet else 1.0
        self._hand_over()

    def log(self, start: int) -> dict[str, Array]:
        """Signals from sample `start` on, as far back as they are kept (`LOG_TIME`).

        `first` (the first sample), drive (n, channels), sensed (n, sensors), position (m), normal_load (N), reference
        (the texture as asked for) and flags, each shape (n,).
        """
        table, end = self._arrays["log"], self.samples
        first = max(start, end - len(table) + 8 * self.block, 0)
        rows = table[np.arange(first, end) % len(table)]
        c, s = self.controller.channels, self.controller.sensors
        names = ("position", "normal_load", "reference")
        found = {name: rows[:, c + s + i] for i, name in enumerate(names)}
        found |= {"drive": rows[:, :c], "sensed": rows[:, c : c + s], "flags": rows[:, -1].astype(np.int64)}
        return {"first": np.array(first), **found}

    @property
    def samples(self) -> int:
        """Samples that have been played, silent ones included."""
        return int(self._entry["samples"][0])

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return Flag(int(self._entry["flags"][0]))

    @property
    def timed_out(self) -> int | None:
        """Sample from which on the watchdog has stopped the drive; None where it has not."""
        sample = int(self._entry["timed_out"][0])
        return None if sample < 0 else sample

    @property
    def current_gain(self) -> float:
        """Factor on the texture at the moment."""
        return float(self._entry["gain"][0])

    @property
    def refused(self) -> int:
        """Calls that were refused, and got zeros, because they did not fit."""
        return int(self._entry["refused"][0])

    def _heard(self) -> set[int]:
        """Addresses of voices that are, or may yet be, read."""
        waiting = {int(address) for address in self._slots[:, VOICE_ADDRESS]}
        return waiting | {int(self._entry[name][0]) for name in ("current", "previous")}

    def _hand_over(self) -> None:
        with self._writing:
            self._slots[self._back] = self._slot
            self._back = int(publish(self.user_data, self._back))
