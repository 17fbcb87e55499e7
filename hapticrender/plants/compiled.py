"""A plant with a compiled step: samples, noise and finger in, what is sensed and moved out, alone or in closed loop."""

from typing import Any

import numpy as np

from hapticrender.jit import CFunction, addresses, close_loop, kernel
from hapticrender.protocols import Array, Controller, Flag, Sensed
from hapticrender.touch.finger import Finger

POSITION, LOAD, STRENGTH, SPEED = range(4)  # columns of the inputs that every plant gets; a plant may add its own
SENSOR_CLIPPED, SATURATED = int(Flag.SENSOR_CLIPPED), int(Flag.SATURATED)
HUGE = 1e300  # a drive beyond it is no number


@kernel
def quantise(value, step, limit):
    """Round to the nearest step inside +-`limit`; a step of 0 leaves the resolution ideal."""
    value = min(max(value, -limit), limit)
    return step * np.floor(value * (1.0 / step) + 0.5) if step > 0.0 else value


def resolution(bits: str, span: str, times: float, about: str) -> Any:
    """Property of parameters: the step of a converter with so many `bits` over `times` its `span`; 0 bits are ideal."""

    def step(parameters: Any) -> float:
        count = getattr(parameters, bits)
        return times * getattr(parameters, span) / 2**count if count else 0.0

    return property(step, doc=f"Resolution of {about}; 0 is ideal.")


@kernel
def queue_drive(queue, oldest, drive, due):
    """Exchange row `oldest` of the queue (latency, channels) for `drive` (channels,), write it to `due` (channels,).

    Returns the row that is the oldest afterwards.  A queue without rows passes the drive on; a drive that is no number
    becomes 0.
    """
    latency = queue.shape[0]
    for i in range(drive.shape[0]):
        value = drive[i]
        if latency > 0:
            value, queue[oldest, i] = queue[oldest, i], value
        due[i] = value if abs(value) < HUGE else 0.0
    return oldest + 1 if oldest + 1 < latency else 0


class CompiledPlant:
    """Base of the plants behind the `Plant` protocol; a subclass gives a step, a state and the widths of its signals.

    That is all that a plant of one's own needs: ``tests/test_compiled_plants.py`` has one in 25 lines.  At the start of
    a sample the step senses, then advances under the drive; it writes `sensed`, `motion` and `flags` of each row (see
    `hapticrender.jit`).  `delay` (samples) is that of the loop, from a sensed sample to the drive computed from it;
    `block` samples are a call of `run`.
    """

    step: CFunction
    state: Array  # a record, shape (1,): all that the step reads and writes
    buffers: tuple[Array, ...] = ()  # arrays that it points to
    drive_channels = 1
    sensed_channels = 1
    motion_channels = 1  # the evaluated places first
    noise_channels = 1
    places = 1  # columns of `motion` that are evaluated

    def __init__(self, finger: Finger, rate: float, *, delay: int = 1, block: int = 1, seed: int = 0) -> None:
        if not 1 <= block <= delay:
            raise ValueError(f"block = {block}: must be between 1 and the loop's delay of {delay} samples")
        self.finger, self.rate, self.delay, self.block = finger, float(rate), delay, block
        self.motion = np.zeros((0, self.motion_channels))
        self._samples = 0
        self._random = np.random.default_rng([seed, 2])  # a texture may be drawn from the same seed
        self._last = np.zeros((block, self.drive_channels))
        self.step.expect()

    def inputs(self, first: int, n: int) -> Array:
        """Position (m), load (N), strength and speed (m/s) of the finger, sample by sample, shape (n, >= 4)."""
        return finger_inputs(self.finger, first, n, self.rate)

    def finger_position(self, n: int) -> Array:
        """Finger positions (m, shape (n,)) of the next n samples, NaN while lifted; the plant does not advance."""
        return self.finger.position((self._samples + np.arange(n)) / self.rate)

    def noise(self, n: int) -> Array:
        """Draw the white noise of the next n samples, unit variance, shape (n, noise_channels)."""
        return self._random.standard_normal((n, self.noise_channels))

    def _signals(self, n: int) -> dict[str, Array]:
        """Arrays of the next n samples, noise drawn; the clock goes on."""
        inputs = np.ascontiguousarray(self.inputs(self._samples, n))
        self._samples += n
        return {
            "inputs": inputs,
            "noise": self.noise(n),
            "sensed": np.zeros((n, self.sensed_channels)),
            "motion": np.zeros((n, self.motion_channels)),
            "flags": np.zeros(n, np.int64),
        }

    def _sensed(self, signals: dict[str, Array]) -> Sensed:
        """Sensed block; everything in `motion`, evaluated or not, stays readable until the next one."""
        self.motion = signals["motion"]
        position, load = signals["inputs"][:, POSITION], signals["inputs"][:, LOAD]
        return Sensed(signals["sensed"], position, self.motion[:, : self.places], load, signals["flags"])

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (n, drive_channels); row i acts from sample i, sensed at its start."""
        drive = np.ascontiguousarray(drive, float)  # a name keeps a copy alive while its address is used
        if drive.ndim != 2 or drive.shape[1] != self.drive_channels:
            raise ValueError(f"drive of shape {drive.shape}: must be (samples, {self.drive_channels})")
        signals = self._signals(len(drive))
        record = addresses(drive=drive, **signals)
        self.step(self.state.ctypes.data, record.ctypes.data, 0, len(drive))
        return self._sensed(signals)

    def closes(self, controller: Controller) -> bool:
        """Whether `closed_loop` takes this controller: it has a compiled step of the plant's block."""
        compiled = isinstance(getattr(controller, "step", None), CFunction)
        return compiled and getattr(controller, "block", 1) in (1, self.block)

    def closed_loop(self, controller: Any, waveform: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance plant and controller together over `waveform` (n,); returns drive as played, target, flags, sensed.

        Row n of the drive is computed from samples before n: the plant queues the rest of the loop's delay.
        """
        waveform = np.ascontiguousarray(waveform, float)  # a name keeps a copy alive while its address is used
        length, block = len(waveform), self.block
        n = -(-length // block) * block  # whole blocks; what is beyond the end is played and not returned
        if n > length:
            waveform = np.append(waveform, np.zeros(n - length))
        signals = self._signals(n)
        drive = np.zeros((n + block, self.drive_channels))
        drive[:block] = self._last
        rows = -(-n // controller.block)
        target = np.zeros((rows, controller.n_bands), complex)
        position = np.ascontiguousarray(signals["inputs"][:, POSITION])
        own = addresses(drive=drive, **signals)
        other = addresses(
            drive=drive[block:],
            sensed=signals["sensed"],
            position=position,
            waveform=waveform,
            target=target,
            flags=signals["flags"],
        )
        plant = (self.step.address, self.state.ctypes.data, own.ctypes.data)
        control = (controller.step.address, controller.state.ctypes.data, other.ctypes.data)
        close_loop(plant, control, n, block)
        self._last = drive[n:].copy()
        if controller.block > 1:
            target = np.repeat(target, controller.block, axis=0)
        signals = {name: array[:length] for name, array in signals.items()}
        return drive[:length], target[:length], signals["flags"], self._sensed(signals)


def finger_inputs(finger: Finger, first: int, n: int, rate: float) -> Array:
    """Position (m), load (N), strength and speed (m/s) of samples `first` to `first` + n - 1, shape (n, 4).

    The speed over a sample is the way to the next one; a finger that is lifted there keeps that of the sample before,
    one that touches for a single sample rests.  NaN while lifted, as a finger without load is.
    """
    touch = finger.touch(np.arange(max(first - 1, 0), first + n + 1) / rate)
    touch[~(touch[:, LOAD] > 0.0), POSITION] = np.nan
    way = rate * np.diff(touch[:, POSITION])
    if first == 0:
        way = np.r_[np.nan, way]
    rows = np.empty((n, 4))
    rows[:, :SPEED] = touch[-n - 1 : -1]
    after, before = way[1:], way[:-1]
    speed = np.where(np.isfinite(after), after, np.where(np.isfinite(before), before, 0.0))
    rows[:, SPEED] = np.where(np.isfinite(rows[:, POSITION]), speed, np.nan)
    return rows
