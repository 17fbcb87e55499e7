"""The compiled real-time entry: a controller as a C function and one pointer, for an audio library to call.

A callback written in Python waits for Python's lock and misses its deadline whenever another thread is busy.  This one
holds no lock, allocates nothing and never waits: targets and the finger's position reach it through a triple buffer,
whose slots change hands in one atomic step::

    entry = RealtimeEntry(controller, sensed_scale=2e-4, drive_scale=0.5)   # m and 1/A of full scale
    stream = open_audio(callback=entry.address, user_data=entry.user_data, frames=entry.block)
    entry.play(voice)                  # a texture, from any thread of the application, one at a time; of a law by
    entry.play(voice, controller)      # bands with the controller that is designed for it
    entry.send(bands)                  # or other targets, of a law by bands
    entry.finger(0.01, velocity=0.05)  # m, m/s; extrapolated at this speed until the next call
    entry.samples, entry.flags         # what has happened
    entry.silence()                    # zero drive, before the stream is closed

Three slots, one writer and one reader: the writer fills its own slot and swaps it for the one in the middle, the reader
swaps its own for that where it is fresh.  Neither ever waits, and no slot is read while it is written.
"""

from __future__ import annotations

import math
import threading
from functools import cached_property
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.records import CONTROLLER, SETPOINT_ROWS
from hapticrender.control.state_transfer import state_table
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.jit import CFunction, addresses
from hapticrender.protocols import Array, Flag
from hapticrender.realtime_kernel import (
    AUDIO,
    CALLS,
    ENTRY,
    FINGER_CHANGES,
    GAIN,
    HEAD,
    HOLD,
    LOAD,
    PLAIN,
    PLAYING,
    POSITION,
    SETPOINT_CHANGES,
    VELOCITY,
    VOICE_ADDRESS,
    WATCHDOG,
    publish,
)
from hapticrender.voices import FADE, Voice

TOUCH_FADE = 0.02  # s: of what lies along the surface, at touch and lift
JUMP_TIME = 5e-3  # s: a correction of the position decays by two poles of that time
GAIN_TIME = 10e-3  # s
CHANGE = 14e-3, 34e-3  # s: one texture fades out before, the other one in after the change of controllers
LOG_TIME = 2.0  # s: of signals that are kept
SLOTS = 3
BLOCK = ("sensed", "drive", "position", "waveform", "flags")  # signals of a block that all controllers share
FIELDS = ENTRY.names or ()


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
        Whether the law takes a waveform.  Of one by bands with constant envelopes the gain is a factor of targets that
        are modulated, and else ignored; another texture takes another controller (`play`).

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
        self.controller = self._last = controller
        self.block, self.rate = controller.block, float(controller.rate)
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
        law, self._keep = self._fields, self._held = self._law(controller)
        self._entry = np.zeros(1, ENTRY)
        fixed = {
            **law,
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

    def _law(self, controller: Any) -> tuple[dict[str, int], tuple[Any, ...]]:
        """Fields of a record that runs a controller on the entry's signals, and what they point to."""
        target, shared = np.zeros((self.block, controller.n_bands), complex), state_table(controller)
        signals = addresses(**{name: self._arrays[name] for name in BLOCK}, target=target)
        fields = {
            "step": controller.step.address,
            "controller": controller.state.ctypes.data,
            "signals": signals.ctypes.data,
            "analysed": controller.bands.envelope is None,
            "shared": shared.ctypes.data,
        }
        return fields, (controller, target, signals, shared)

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
            "bump": np.zeros(controller.channels),
            "gains": np.zeros((self.ahead + 1, 2)),
            "log": np.zeros((rows, controller.channels + controller.sensors + 4)),
        }

    def _start(self) -> dict[str, float]:
        """Numbers of the record at rest."""
        log, rate = self._arrays["log"], self.rate
        return {
            **{"block": self.block, "sensors": self.controller.sensors, "channels": self.controller.channels},
            **{"middle": 1, "slot": 2, "timed_out": -1, "gain": 1.0, "open": 1.0, "place": np.nan, "rate": rate},
            **{"ahead": self.ahead, "log_rows": log.shape[0], "log_width": log.shape[1]},
            "age": round(HOLD * rate),
            "fade": round(FADE * rate),
            "fade_out": round(CHANGE[0] * rate),
            "fade_in": round(CHANGE[1] * rate),
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

    def play(self, voice: Voice, controller: Any = None) -> None:
        """Fade from the texture that plays into another one, within `voices.FADE`; one change after the other.

        A law by bands takes another texture with a `controller` designed for it, on the same device: the old texture
        fades out, the controller takes over, and its texture fades in (`CHANGE`).  `control.state_transfer.ready`
        prepares it.  `send` remains that of the entry's first controller.

        Raises
        ------
        ValueError
            The controller has another number of channels or sensors, block, look-ahead, rate or delay than the one
            before, or the voice plays under another controller.
        """
        controller = self._last if controller is None else controller
        for name in ("channels", "sensors", "block", "lookahead", "rate"):
            found, first = (getattr(each, name, 0) for each in (controller, self.controller))
            if found != first:
                raise ValueError(f"controller.{name} = {found}: must be {first}, as of the one before")
        if voice.law is not None and voice.law[0] is not controller and voice.address in self._heard():
            raise ValueError("voice: plays under another controller: must be a new Voice of the texture")
        if controller is not self._last:
            fields, held = self._law(controller)
            before, after = self._held[-1][:, 1], held[-1][:, 1]
            if np.any((before != after) & (before > 0) & (after > 0)):
                raise ValueError("controller: its state is laid out otherwise: must have the delay of the one before")
            self._last, self._fields, self._held = controller, fields, held
        voice.law = self._held
        for name, value in self._fields.items():
            voice.record[name] = value
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

        `first` (the first sample), drive (n, channels) as it plays with a sample, sensed (n, sensors), position (m),
        normal_load (N), reference (the texture as asked for) and flags, each shape (n,).
        """
        table, end = self._arrays["log"], self.samples
        first = max(start, end - len(table) + 8 * self.block, 0)
        rows = table[np.arange(first, end) % len(table)]
        c, s = self.controller.channels, self.controller.sensors
        played = np.arange(first, end) - self.block  # a block's drive plays with the next one
        drive = np.where(played[:, None] < 0, 0.0, table[played % len(table), :c])
        names = ("position", "normal_load", "reference")
        found = {name: rows[:, c + s + i] for i, name in enumerate(names)}
        found |= {"drive": drive, "sensed": rows[:, c : c + s], "flags": rows[:, -1].astype(np.int64)}
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
    def running(self) -> Any:
        """The controller that runs: of the present texture or, until it has faded out, of the one before."""
        address = int(self._entry["controller"][0])
        laws = [self._last, *(voice.law[0] for voice in self._voices)]
        return next((each for each in laws if each.state.ctypes.data == address), self.controller)

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
