"""The real-time entry: a controller as a C function and one pointer, for an audio library to call.

A callback written in Python waits for Python's lock and misses its deadline whenever another thread is busy.  This one
holds no lock, allocates nothing and never waits: textures and the finger's position reach it through a triple buffer::

    entry = RealtimeEntry(controller, sensed_scale=2e-4, drive_scale=0.5)   # m and 1/A of full scale
    stream = open_audio(callback=entry.address, user_data=entry.user_data, frames=entry.block)
    entry.play(SampledTexture(texture, rate))              # from any thread of the application, one at a time
    entry.play(SampledTexture(texture, rate), controller)  # where the controller works by bands: one designed for them
    entry.finger(0.01, velocity=0.05)  # m, m/s; extrapolated at this speed for 50 ms
    entry.samples, entry.flags         # what has happened
    entry.silence()                    # zero drive, before the stream is closed

Three slots, one writer and one reader: the writer fills its own slot and swaps it for the one in the middle, the reader
swaps its own for that where it is fresh, each in one atomic step.  No slot is read while it is written.
"""

import math
import threading
from typing import Any

import numpy as np

from hapticrender.checks import number, require, scales
from hapticrender.control.records import CONTROLLER
from hapticrender.control.state_transfer import damper_of, drive_limits, state_table
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.jit import CONVERSION, Addressed, CFunction, addresses, record_of
from hapticrender.protocols import Array, Flag
from hapticrender.realtime_kernel import (
    AUDIO,
    CONTROL,
    COPIES,
    ENTRY,
    ENTRY_WORDS,
    HOLD,
    MIDDLE_AT,
    PLAIN,
    SLOT,
    WORDS,
    advance_simulated,
    foresee,
)
from hapticrender.sampled_texture import FADE, SLOTS, EvaluatedTexture, SampledTexture, publish

TOUCH_FADE = 0.02  # s: of a function of position, at touch and lift
JUMP_TIME = 5e-3  # s: a correction of the position decays by two poles of that time
GAIN_TIME = 10e-3  # s
CHANGE = 14e-3, 34e-3  # s: one texture fades out before, the other one in after the change of controllers
LOG_TIME = 2.0  # s: of signals that are kept
LOG_MARGIN = 0.05  # s: of these, what may be written anew while it is read; a simulated device plays 2 to 50 ms at once
BLOCK = ("sensed", "drive", "position", "waveform", "flags")  # signals of a block that all controllers share
SAME = ("channels", "sensors", "block", "rate")  # of all controllers of an entry


class _Control:
    """Record that runs a controller on the entry's signals, and the arrays that it points to."""

    def __init__(self, controller: Any, signals: dict[str, Array], limit: Array | float = 0.0) -> None:
        self.controller, self.shared = controller, state_table(controller)
        self.limit = np.maximum(drive_limits(controller), limit)
        self._target = np.zeros((controller.block, controller.n_bands), complex)
        self._signals = addresses(**signals, target=self._target)
        self.record = record_of(
            CONTROL,
            step=controller.step.address,
            state=controller.state,
            signals=self._signals,
            reads_waveform=controller.bands.envelope is None,
            ahead=getattr(controller, "lookahead", 0),
            shared=self.shared,
            limit_at=self.limit,
            damper=damper_of(controller),
        )
        self.address = int(self.record.ctypes.data)


class RealtimeEntry(Addressed):
    """A controller of any device and method behind a C function with one user-data pointer.

    Parameters
    ----------
    controller : Controller
        With a compiled step; its state goes on here, so do not run it elsewhere meanwhile.
    sensed_scale : float or array of float, m of full scale, > 0
        Unit of a float sample of 1.0 at the input, of all sensors or of each.
    drive_scale : float or array of float, 1/A of full scale, > 0
        Float sample at the output for a drive of 1 A, of all channels or of each.
    frames : int, samples, optional
        Of a call, a multiple of the controller's block, which it is unless given; `log` needs it.
    ahead : int, samples, optional
        Longest look-ahead of the controllers that are to come, where that is longer than the first one's.
    converter : WrappedDriver, optional
        What is between controller and device, such as a square root (see `hapticrender.renderers.shaped`).

    Attributes
    ----------
    user_data : int
        The pointer that belongs to both addresses.  The entry has to outlive whoever calls them.
    block : int, samples of the device
        Frames a call, or a multiple.

    Raises
    ------
    TypeError
        The controller has no compiled step, or the converter none.
    ValueError
        A scale is out of its bound, or `frames` is no multiple of the block.
    """

    step, n_bands = advance_simulated, 0  # with `state` and `block` a controller, for a plant's closed loop

    def __init__(
        self,
        controller: Any,
        *,
        sensed_scale: float | Array = 1.0,
        drive_scale: float | Array = 1.0,
        frames: int | None = None,
        ahead: int = 0,
        converter: Any = None,
    ) -> None:
        if not isinstance(getattr(controller, "step", None), CFunction):
            raise TypeError(f"controller of type {type(controller).__name__}: must have a compiled step")
        if converter is not None and not any(getattr(converter, each, None) for each in ("act", "sense")):
            bound = "must have compiled steps, `act` or `sense`, where the device calls back"
            raise TypeError(f"converter of type {type(converter).__name__}: {bound}")
        own = next((vars(each) for each in type(converter).__mro__ if "play" in vars(each)), {"act": None})
        if not {"act", "sense"} & own.keys():  # those that it inherits do not what its `play` does
            bound = "must have compiled steps of its own beside its own `play` where the device calls back"
            raise TypeError(f"converter of type {type(converter).__name__}: {bound}")
        self.controller = controller
        self.converter, self.rate = converter, float(controller.rate)
        rows, hold = (controller.block, 1) if converter is None else (converter.block, converter.hold)
        self.block, self.frames = rows * hold, rows if frames is None else frames
        bound = f"a multiple of the controller's block of {controller.block} samples"
        require(self.frames > 0 and self.frames % controller.block == 0, "frames", frames, bound)
        self._slot, self._slots, self._back = np.zeros(1, SLOT), np.zeros(SLOTS, SLOT), 0
        self._slot["position"], self._slot["playing"], self._slot["gain"] = np.nan, 1, 1.0
        self._slots[:] = self._slot
        self._textures: list[SampledTexture | EvaluatedTexture] = []
        self._writing = threading.Lock()  # of threads of the application; the callback never waits
        self.ahead, self._tracker = max(int(getattr(controller, "lookahead", 0)), ahead), np.zeros(1, CONTROLLER)
        self._tracker["p"]["rate"] = self.rate
        self._arrays = self._buffers()
        for name, given, count in (
            ("sensed_scale", sensed_scale, controller.sensors),
            ("drive_scale", drive_scale, controller.channels),
        ):
            self._arrays[name] = np.resize(scales(name, given, count), count)
        self._signals = {name: self._arrays[name] for name in BLOCK}
        self._first = self._control = _Control(controller, self._signals)  # which may run without a texture
        fields = {f"{name}_at": array for name, array in {**self._arrays, "slots": self._slots}.items()} | self._start()
        fields |= {"control": self._control.address, "tracker": self._tracker} | self._converted()
        self._entry = record_of(ENTRY, **fields)
        self.user_data, self.state = int(self._entry.ctypes.data), self._entry
        self._arrays["copies"][:] = np.concatenate([self._entry.view(np.int64), self._slot.view(np.int64)])

    def _buffers(self) -> dict[str, Array]:
        """Signals of a block, gains that wait, and the log."""
        controller, block = self.controller, self.controller.block
        rows = -(-round(LOG_TIME * self.rate) // block) * block + self.frames
        return {
            "sensed": np.zeros((block, controller.sensors)),
            "drive": np.zeros((block, controller.channels)),
            "position": np.full(block, np.nan),
            "places": np.zeros((2, block)),
            "waveform": np.zeros(block),
            "flags": np.zeros(block, np.int64),
            "bump": np.zeros(controller.channels),
            "gains": np.zeros((self.ahead + block, 2)),
            "copies": np.zeros((COPIES, WORDS), np.int64),
            "log": np.zeros((rows, controller.channels + controller.sensors + 4)),
        }

    def _converted(self) -> dict[str, Any]:
        """Fields of the record for what is between controller and device; its signals are those of a call."""
        between = self.converter
        if between is None:
            arrays = {name: self._arrays[name] for name in ("drive", "sensed")}
            self._conversion = record_of(CONVERSION, **arrays, played=arrays["drive"], raw=arrays["sensed"])
            return {"unit": self.controller.block, "hold": 1, "conversion": self._conversion}
        steps = {"sense": between.sense, "act": between.act}
        return {
            **{name: each.address for name, each in steps.items() if each is not None},
            **{"unit": between.block, "hold": between.hold},
            **{"conversion": between.conversion, "converter": between.state},
        }

    def _start(self) -> dict[str, Any]:
        """Numbers of the record at rest."""
        log, rate = self._arrays["log"], self.rate
        return {
            **{name: getattr(self.controller, name) for name in ("block", "sensors", "channels")},
            **{"middle": 1, "slot": 2, "stopped": -1, "gain": 1.0, "open": 1.0, "place": np.nan, "rate": rate},
            **{"ahead": self.ahead, "log_rows": log.shape[0], "log_width": log.shape[1]},
            "age": round(HOLD * rate),
            "fade": round(FADE * rate),
            "fade_out": round(CHANGE[0] * rate),
            "fade_in": round(CHANGE[1] * rate),
            "switch": -round(FADE * rate),
            "touch_step": 1.0 / (TOUCH_FADE * rate),
            "closing_step": 1.0 / (FADE_OUT * rate),
            "gain_smoothing": -math.expm1(-1.0 / (GAIN_TIME * rate)),
            "offset_kept": math.exp(-1.0 / (JUMP_TIME * rate)),
        }

    @property
    def address(self) -> int:
        """Address of PortAudio's callback, with interleaved float samples; compiled when it is first read.

        ``int (const void *input, void *output, unsigned long frames, const void *time, unsigned long status, void
        *user_data)``; it returns 2 (abort) and writes zeros where `frames` is no whole number of blocks or a buffer is
        missing.
        """
        return AUDIO.address

    @property
    def plain_address(self) -> int:
        """Address of the plain function, with samples in m and A; compiled when it is first read.

        ``int (const double *sensed, double *drive, uint64_t frames, void *user_data)``, which returns the block's
        `Flag` bits, or -1 where it refuses.
        """
        return PLAIN.address

    def process(self, sensed: Array, position: Array | None = None, flags: int = 0) -> Array:
        """Advance from Python by n samples, whole blocks: drive (n, channels) for `sensed` (n, sensors), in m and A.

        `position` (m, NaN while lifted, shape (n,)) is the device's own, in place of `finger`; `flags` are the
        device's.
        """
        sensed, drive = np.ascontiguousarray(sensed, float), np.empty((len(sensed), self.controller.channels))
        position = None if position is None else np.ascontiguousarray(position, float)
        self._entry["sensed_position"] = 0 if position is None else position.ctypes.data
        self._entry["taken"], self._entry["lost"] = 0, flags
        PLAIN(sensed.ctypes.data, drive.ctypes.data, len(sensed), self.user_data)
        return drive

    def play(self, texture: SampledTexture | EvaluatedTexture, controller: Any = None) -> None:
        """Fade from the texture that plays into another one, within `FADE`; one change after the other.

        A controller that works by bands takes another texture with a `controller` designed for it, on the same device:
        the old texture fades out, the controller takes over, and its texture fades in (`CHANGE`).  Of constant
        envelopes the gain is a factor where they are modulated, and else ignored.
        `control.state_transfer.ready` prepares it.

        Raises
        ------
        ValueError
            The controller has another number of channels or sensors, block, rate or delay than the one before, or a
            longer look-ahead than the entry, or the texture plays under another controller.
        """
        last = self._control
        # addresses of textures that are, or may yet be, read
        used = {*self._slots["texture"].tolist(), *(int(self._entry[name][0]) for name in ("current", "previous"))}
        controller = last.controller if controller is None else controller
        for name in SAME:
            found, first = (getattr(each, name, 0) for each in (controller, self.controller))
            if found != first:
                raise ValueError(f"controller.{name} = {found}: must be {first}, as of the one before")
        found = getattr(controller, "lookahead", 0)
        require(found <= self.ahead, "controller.lookahead", found, f"<= {self.ahead}, `ahead` of the entry")
        if texture.address in used and texture.control.controller is not controller:
            raise ValueError("texture: plays under another controller: must be a new SampledTexture")
        if controller is not last.controller:
            control = _Control(controller, self._signals, last.limit)
            before, after = last.shared[:, 1], control.shared[:, 1]
            if np.any((before != after) & (before > 0) & (after > 0)):
                raise ValueError("controller: its state is laid out otherwise: must have the delay of the one before")
            self._control = control
        texture.control, texture.record["control"] = self._control, self._control.address
        self._textures = [each for each in self._textures if each.address in used] + [texture]
        self._set(texture=texture.address)

    def fill(self) -> None:
        """Compute what comes next of all textures in time; call it at least once a second."""
        playing = [int(self._entry[name][0]) for name in ("current", "previous")]
        for texture in self._textures:
            if texture.address in playing:
                texture.fill(self.samples + self.ahead - int(texture.record["begun"][0]))

    def finger(self, position: float, velocity: float = 0.0, load: float = 0.0) -> None:
        """Set the finger's position (m, NaN: lifted), velocity (m/s) and load (N) at the start of the next block."""
        if np.isinf(position) or not np.isfinite(velocity) or not 0.0 <= load < np.inf:
            raise ValueError(f"{position=} m, {velocity=} m/s, {load=} N: must be finite (position may be NaN: lifted)")
        self._set("finger_changes", position=position, velocity=velocity, load=load)

    def set_gain(self, gain: float) -> None:
        """Set the factor on the texture, finite; it is reached to 1 % within 50 ms."""
        self._set(gain=number("gain", gain))

    def watch(self, seconds: float | None = None) -> None:
        """Stop the drive permanently once neither this nor `alive` has been called for so long (s); None: never."""
        self._set("calls", watchdog=0.0 if seconds is None else seconds * self.rate)

    def alive(self) -> None:
        """Note a call of the application, for the watchdog."""
        if self._slot["watchdog"][0] > 0.0:
            self._set("calls")

    def foreseen(self, seconds: float) -> tuple[Any, Array]:
        """Return the entry as it was between its last two blocks, and the finger's path from then on (m, shape (2, n)).

        It reaches `ahead` samples and `seconds` far; the second row is NaN while the finger is lifted.
        """
        while True:
            samples = self.samples
            words = self._arrays["copies"][(samples // self.controller.block - 1) % COPIES].copy()
            if self.samples - samples < (COPIES - 2) * self.controller.block:
                break
        path = np.zeros((2, self.ahead + round(seconds * self.rate) + 2 * self.frames))
        entry, slot = words[:ENTRY_WORDS].view(ENTRY), words[ENTRY_WORDS:]
        entry["block"], entry["position_at"] = path.shape[1], path[1:].ctypes.data
        foresee(words.ctypes.data, slot.ctypes.data, path.ctypes.data)
        return entry, path

    def silence(self) -> None:
        """Set zero drive from the next block on, whatever is sensed."""
        self._set(playing=0)

    def log(self, start: int) -> dict[str, Array]:
        """Signals from sample `start` on, as far back as they are kept: `LOG_TIME`, less what may be written meanwhile.

        `first` (the first sample), drive (n, channels) as it plays with a sample, sensed (n, sensors), position (m),
        normal_load (N), reference (the whole texture) and flags, each shape (n,).
        """
        table, end = self._arrays["log"], self.samples
        margin = 8 * self.controller.block + self.frames + round(LOG_MARGIN * self.rate)
        first = max(start, min(max(end - len(table) + margin, 0), end))
        rows = table[np.arange(first, end) % len(table)]
        c, s = self.controller.channels, self.controller.sensors
        played = np.arange(first, end) - self.frames  # the drive of a call plays with the samples of the next one
        drive = np.where(played[:, None] < 0, 0.0, table[played % len(table), :c])
        position, load, reference, flags = rows[:, c + s :].T
        found = {"drive": drive, "sensed": rows[:, c : c + s], "position": position, "normal_load": load}
        return {"first": np.array(first), **found, "reference": reference, "flags": flags.astype(np.int64)}

    @property
    def samples(self) -> int:
        """Samples that have been played, silent ones included."""
        return int(self._entry["samples"][0])

    @property
    def flags(self) -> Flag:
        """Everything that was ever raised."""
        return Flag(int(self._entry["flags"][0]))

    @property
    def stopped(self) -> int | None:
        """Sample from which on supervisor, device or watchdog have stopped the drive; None: they have not."""
        sample = int(self._entry["stopped"][0])
        return None if sample < 0 else sample

    @property
    def timed_out(self) -> bool:
        """Whether it was the watchdog that stopped the drive."""
        return bool(self._entry["timed_out"][0])

    @property
    def running(self) -> Any:
        """The controller that runs: of the present texture or, until it has faded out, of the one before."""
        address = int(self._entry["control"][0])
        controls = [self._control, *(texture.control for texture in self._textures)]
        return next((each.controller for each in controls if each.address == address), self.controller)

    @property
    def refused(self) -> int:
        """Calls that were refused, and got zeros, because they did not fit."""
        return int(self._entry["refused"][0])

    def _set(self, counted: str = "", **values: float) -> None:
        """Set fields of the slot, count a change, and hand it over."""
        with self._writing:
            for name, value in values.items():
                self._slot[name] = value
            if counted:
                self._slot[counted] += 1
            self._slots[self._back] = self._slot[0]
            self._back = int(publish(self.user_data + MIDDLE_AT, self._back))
