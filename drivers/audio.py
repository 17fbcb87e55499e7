"""A sound card: its outputs drive the device, its inputs sense it; block by block, or by a compiled callback.

It needs DC-coupled outputs and inputs where the sag under a finger is to be corrected, an amplifier, and three numbers
of the set-up: the drive and the displacement at full scale, and the delay of the loop, which
``hapticrender latency --driver audio:NAME`` measures through a cable.
"""

import atexit
import copy
import time
from shlex import quote
from typing import Any

import numpy as np

from hapticrender.checks import scales
from hapticrender.drivers.audio_callback import AHEAD, SLOTS, BlockQueue, Relay
from hapticrender.drivers.base import BaseDriver
from hapticrender.drivers.portaudio import Stream, cards, find
from hapticrender.errors import DeviceLost, DeviceNotFound, DeviceTimeout, DriverError
from hapticrender.protocols import Array, Flag, Sensed
from hapticrender.touch.device_profile import Scales

RATE, BLOCK = 48000.0, 64  # Hz, samples a callback; unless they are given
TIMEOUT = 2.0  # s: longest wait for a block
LONGEST = 10.0  # s: delay that no set-up has
OVERRUN, SATURATED = int(Flag.OVERRUN), int(Flag.SATURATED)
FAR_AHEAD = 40  # blocks that wait to be played through a cable: nothing is computed from what is sensed
MOST_LATE = SLOTS // 2  # blocks that Python may be late and still get all that was sensed
FULL_SCALE = 3.0  # A: drive at full scale, as in the sound files of `WaveFileDriver`, unless it is given
Channels = tuple[int, ...]


class AudioDriver(BaseDriver):
    """Plays on a sound card through PortAudio, block by block, or between `start` and `stop` by a compiled callback.

    `play` serves `hapticrender.render` and identification.  Python computes its blocks, so it adds `host_delay` samples
    to the delay.  Where the card or Python has lost samples the block has `Flag.OVERRUN`, `overruns` counts, and the
    delay stays the same.  The callback does not wait for Python; `live` makes the driver whose `delay` is that of the
    card alone, for which a controller that is called back is designed.  The stream runs from `open` to `close`; while
    nothing is played, the outputs are zero.

    Parameters
    ----------
    device : int, str or (input, output), optional
        Card by its index or by parts of its name and host ("0", "scarlett", "usb alsa"), as ``hapticrender devices``
        lists them; the system's default unless given.
    channels : tuple of int, >= 1
        Outputs that carry the drive, in the order of the drive's columns.
    sensed_channels : tuple of int, >= 1, optional
        Inputs that sense, in the order of the sensors.  Unless given: none where neither `delay` nor
        `sensed_per_full_scale` is known, and the device is driven open loop; otherwise (1, 2), for which both must be.
    rate : float, Hz
    block : int, samples
        Frames a callback.
    latency : "low", "high", float or (float, float)
        Requested of PortAudio: the card's own low or high latency, or seconds (input, output).
    drive_per_full_scale : float or tuple of float, A, > 0
        Drive at which an output is at full scale (V for a device driven by a voltage), of all or of each of `channels`;
        3 unless given.
    sensed_per_full_scale : float or tuple of float, m, > 0, optional
        Displacement (or friction, N) at which an input is at full scale, of all or of each of `sensed_channels`.
    delay : float, samples, >= block, optional
        Of the card with its buffers, as ``hapticrender latency`` measures it with this rate, block and latency.

    Raises
    ------
    ValueError
        A channel, a scale or the delay is out of its bound.
    """

    _ahead = AHEAD

    def __init__(
        self,
        device: int | str | tuple[int | str, int | str] | None = None,
        channels: Channels = (1, 2),
        sensed_channels: Channels | None = None,
        *,
        rate: float = RATE,
        block: int = BLOCK,
        latency: Any = "low",
        drive_per_full_scale: Scales = FULL_SCALE,
        sensed_per_full_scale: Scales | None = None,
        delay: float | None = None,
    ) -> None:
        if sensed_channels is None:
            sensed_channels = () if delay is None and sensed_per_full_scale is None else (1, 2)
        pair = latency if isinstance(latency, tuple | list) else (latency, latency)
        for each in pair:
            seconds = isinstance(each, int | float) and not isinstance(each, bool) and 0.0 <= each <= LONGEST
            if len(pair) != 2 or (each not in ("low", "high") and not seconds):
                raise ValueError(f"{latency=}: must be 'low', 'high' or 0 to {LONGEST:g} s, or a pair of them")
        self.device, self.latency = device, latency
        self.channels, self.inputs = _channels("channels", channels), _channels("sensed_channels", sensed_channels)
        if not self.channels:
            raise ValueError("channels=(): must name at least one output, such as (1, 2)")
        drive = np.array(scales("drive_per_full_scale", drive_per_full_scale, len(self.channels)))
        sensed = 1.0 if sensed_per_full_scale is None else sensed_per_full_scale
        self.sensed_scale = 1.0 * np.array(scales("sensed_per_full_scale", sensed, len(self.inputs)))
        if delay is not None and not block <= delay <= LONGEST * rate:
            raise ValueError(f"{delay=} samples: must be >= block = {block} and <= {LONGEST:g} s")
        self.drive_per_full_scale, self.sensed_per_full_scale = drive_per_full_scale, sensed_per_full_scale
        self.drive_limit, self.drive_scale = float(drive.min()), 1.0 / drive
        needed = {"delay": delay, "sensed_per_full_scale (m)": sensed_per_full_scale}
        self._unknown = [name for name, value in needed.items() if value is None and self.inputs]
        self._stream: Stream | None = None
        self._entry: Any = None
        self._number, self._late = 0, 0  # of the next block of `play`; `play`s in a row whose drive came too late
        self._lost = self._before = 0  # blocks that lost samples; the relay's overruns at `start`
        self.host_delay = (1 + AHEAD) * block  # of `delay`: the block that Python computes, and those that wait
        super().__init__(
            rate=rate,
            drive_channels=len(self.channels),
            sensed_channels=len(self.inputs),
            block=block,
            delay=self.host_delay + (block if delay is None else int(np.floor(delay + 0.5))),
        )
        self.play_delay = self.delay

    def live(self) -> "AudioDriver":
        """Make the same driver for a compiled controller: its `delay` is the card's, `play_delay` is that of `play`."""
        driver = copy.copy(self)
        driver.delay, driver.host_delay = self.delay - self.host_delay, 0
        return driver

    def loop_back(self) -> "AudioDriver":
        """Make a driver of the first output and the first input (1 unless given), both in full scales."""
        options = {"rate": self.rate, "block": self.block, "latency": self.latency, "delay": float(self.block)}
        channels, inputs = self.channels[:1], (self.inputs or (1,))[:1]
        options |= {"drive_per_full_scale": 1.0, "sensed_per_full_scale": 1.0}
        driver = AudioDriver(self.device, channels, inputs, **options)
        driver._ahead, driver.host_delay = FAR_AHEAD, (1 + FAR_AHEAD) * self.block
        return driver

    @staticmethod
    def found() -> list[str]:
        """Sound cards that are there now: the driver's argument, and what the card can do."""
        return [f"{each.index}  {each.name}: {each.about}" for each in cards()]

    def check_calibrated(self) -> None:
        """Refuse to close a loop whose delay, or displacement at full scale, is unknown, by a DriverError."""
        if self._unknown:
            cure = "give it"
            if self._unknown[0] == "delay":
                cure = f"connect output {self.channels[0]} to input {self.inputs[0]} and measure it with `hapticrender "
                cure += f"latency --driver {quote(str(self))} --out profile.toml`"
                cure += ", and give sensed_per_full_scale" if len(self._unknown) > 1 else ""
            names = " and ".join(self._unknown)
            raise DriverError(
                f"{self}: {names} is unknown, so the loop cannot be closed: {cure}; or give neither delay "
                "nor sensed_per_full_scale nor sensed_channels, for open loop"
            )

    def _open(self) -> None:
        self.check_calibrated()
        output, inputs = self._side(self.channels, 1), self._side(self.inputs, 0)
        self._relay = Relay(*(tuple(n - 1 for n in each) for each in (self.inputs, self.channels)), self.block)
        self._queue = BlockQueue(self.block, self.sensed_channels, self.drive_channels, self._ahead)
        _ = self._queue.blocks  # compiled before the stream starts
        addresses = self._relay.address, self._relay.user_data
        self._stream = Stream(str(self), output, inputs, self.rate, self.block, *addresses, self)
        atexit.register(self.close)  # the callback must not outlive the memory that it works in
        try:
            self._stream.start()
            self._settle()
        except BaseException:
            self.close()
            raise

    def _side(self, channels: Channels, output: int) -> tuple[int, int, float] | None:
        """Card, number of channels and latency (s) of a side of the stream; None where no channel of it is used."""
        if not channels:
            return None
        card = find(self.device[output] if isinstance(self.device, tuple) else self.device)
        kind = "outputs" if output else "inputs"
        present, own = (card.outputs, card.output_latency) if output else (card.inputs, card.input_latency)
        if max(channels) > present:
            raise DeviceNotFound(f"{self}: {kind} {channels}: {card} has {present} {kind}")
        latency: Any = self.latency if isinstance(self.latency, str | int | float) else self.latency[output]
        seconds = {"low": own[0], "high": own[1]}.get(latency, latency)
        return card.index, max(channels), float(seconds)

    def _settle(self) -> None:
        """Wait until the card has called back twice more, or has ended."""
        enough, end = self._relay.count("calls") + 2, time.monotonic() + TIMEOUT
        while self.active and self._relay.count("calls") < enough and time.monotonic() < end:
            time.sleep(self.block / self.rate)

    def check(self) -> None:
        """Raise a `DeviceLost` where the card does not call back any more."""
        if self._state == "open" and not self.active:
            played = self._relay.count("blocks") * self.block
            raise DeviceLost(f"{self}: the card stopped after {played} samples: is it still connected?")

    def _play(self, drive: Array) -> Sensed:
        if self._entry is not None:
            raise DriverError(f"{self}: play: it runs a controller; stop it first")
        number, queue = self._number, self._queue
        queue.put(number + self._ahead, drive * self.drive_scale)
        behind = queue.blocks - number
        self._late = self._late + 1 if behind > self._ahead else 0
        if behind > MOST_LATE or self._late > 2 * MOST_LATE:  # a host that does not catch up
            number, self._late = queue.blocks, 0  # what is older is lost; go on with the next one
        if self._relay.count("function") == 0:
            self._relay.call(queue.address, queue.user_data)
        self._wait_for(number)
        sensed, flags = queue.take(number)
        flags |= OVERRUN if number > self._number else 0
        self._lost += flags != 0
        self._number = number + 1
        raised = np.where(np.any(abs(drive * self.drive_scale) > 1.0, axis=1), SATURATED, 0) | flags
        return Sensed(sensed * self.sensed_scale, flags=raised)

    def _wait_for(self, number: int) -> None:
        """Wait until the callback has sensed block `number`."""
        end = time.monotonic() + TIMEOUT
        while self._queue.blocks <= number:
            self.check()
            if time.monotonic() > end:
                raise DeviceTimeout(f"{self}: play: no block of {self.block} samples came within {TIMEOUT:g} s")
            time.sleep(0.2 * self.block / self.rate)

    def start(self, entry: Any) -> None:
        """Let the card call a compiled controller back until `stop`.

        Parameters
        ----------
        entry : hapticrender.realtime_entry.RealtimeEntry
            Of this driver's channels, `sensed_scale` and `drive_scale`, and of a block that divides this driver's; it
            has to outlive `stop`.

        Raises
        ------
        ValueError
            The entry has other channels, or a block that does not fit.
        DriverError
            The driver is not open, or runs already.
        """
        if self._state != "open" or self._entry is not None:
            raise DriverError(f"{self}: start: it is {self._state if self._state != 'open' else 'running already'}")
        own, theirs = (self.sensed_channels, self.drive_channels), (entry.controller.sensors, entry.controller.channels)
        if own != theirs:
            raise ValueError(f"entry: (sensors, drive channels) is {theirs}: must be the driver's, {own}")
        if self.block % entry.block:
            raise ValueError(f"entry.block = {entry.block} samples: must divide the driver's, {self.block}")
        address = entry.address  # compiled here
        self._relay.rest()
        self._settle()
        self.check()
        self._entry, self._kept = entry, entry  # kept until another takes its place: a last call may be under way
        self._before = self._relay.count("overruns")
        self._relay.call(address, entry.user_data)

    def stop(self) -> None:
        """Play zeros from the next block on, and wait until they are played; nothing where it does not run."""
        if self._entry is not None:
            self._lost, entry, self._entry = self.overruns, self._entry, None
            self._relay.rest()
            entry.silence()
            self._settle()

    def close(self) -> None:
        """Play zeros, end the stream and release the card; a second call does nothing."""
        self._state, stream = "closed", self._stream
        if stream is None:
            return
        try:
            self.stop()
            self._relay.rest()
            self._settle()
        finally:
            self._stream = None
            stream.close()
            atexit.unregister(self.close)

    @property
    def active(self) -> bool:
        """Whether the card calls back."""
        return self._stream is not None and self._stream.active

    @property
    def overruns(self) -> int:
        """Blocks that lost samples: because the card did, or because Python was late with a block of `play`."""
        return self._lost + (0 if self._entry is None else self._relay.count("overruns") - self._before)

    @property
    def clipped(self) -> int:
        """Samples of drive that were cut to full scale."""
        return 0 if self._state == "new" else self._relay.count("clipped")

    @property
    def cpu_load(self) -> float:
        """Time in the callback over the time of a block, averaged by PortAudio."""
        return 0.0 if self._stream is None else self._stream.load

    def __str__(self) -> str:
        chosen = (("block", self.block, BLOCK), ("rate", self.rate, RATE))
        options = "&".join(f"{name}={value:g}" for name, value, usual in chosen if value != usual)
        return f"audio:{'' if self.device is None else self.device}{options and '?'}{options}"


def _channels(name: str, given: Any) -> Channels:
    """Check channel numbers as they are printed on the card, from 1 on."""
    channels = tuple(np.atleast_1d(given))
    whole = all(isinstance(each, int | np.integer) and each >= 1 for each in channels)
    if not whole or len(set(channels)) < len(channels):
        raise ValueError(f"{name}={given!r}: must be different whole numbers >= 1")
    return tuple(int(each) for each in channels)
