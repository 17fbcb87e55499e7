"""Interfaces between the packages; start here.

Data flows one way round::

    Scene -> Renderer -> Controller -> Driver -> device | file | plant
                             ^                        |
                             +----- sensed block -----+

Everything is SI.  Time belongs to the loop: the core counts samples, only drivers know seconds.  Arrays are float64,
C-contiguous, with time first and the band (or channel) last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    from hapticrender.bands import Bands
    from hapticrender.control.device_model import DeviceModel
    from hapticrender.touch.scene import Scene

Array = np.ndarray[Any, np.dtype[Any]]
DIFFERENCE = 1e-7  # s: step of a time derivative of a waveform


class Flag(IntFlag):
    """Status bits of a sample: faults at run time are data."""

    SATURATED = 1  # a drive channel was cut to its limit
    NONFINITE = 2  # a sensed value was NaN, infinite or out of range; its prediction is held
    SENSOR_CLIPPED = 4  # a sensor was at the end of its range, or beyond
    OVERRUN = 8  # the driver lost samples
    OPEN_LOOP = 16  # a force could not be sensed and is driven open loop
    UNLOCKED = 32  # a carrier is off its resonance, or the motion is too small to measure it
    STOPPED = 64  # the drive was stopped permanently: by the supervisor, a watchdog, an error or a signal
    TWO_TOUCHES = 128  # one finger cannot explain what a plate senses; the law learns more slowly


class Sensed(NamedTuple):
    """A driver's measurements over a block of n samples; None where something is not measured."""

    sensed: Array  # (n, sensed_channels), in the sensors' unit (m on a plate)
    position: Array | None = None  # (n,), m (2 at most) from the middle of the surface, NaN while no finger touches
    motion: Array | None = None  # (n, places): true motion at the evaluation points (model.places), where it is known
    normal_load: Array | None = None  # (n,), N (-1 to 100), NaN where it is not known
    flags: Array | None = None  # (n,), `Flag` bits raised by the device

    def __eq__(self, other: object) -> bool:
        """Whether it is the same block; a tuple's own comparison fails on arrays."""
        return self is other

    def __ne__(self, other: object) -> bool:
        return self is not other


@runtime_checkable
class Texture(Protocol):
    """A reference waveform: a function of time (s) or of the finger's position (m).

    A texture may have ``spatial``, whether it is read at the finger's position.  One that is False there, a function of
    time alone, is read a piece of many blocks at once; others a block at a time, when the driver has said where the
    finger is.
    """

    def bands(self, rate: float) -> Bands:
        """Carriers, and constant envelopes where the texture has them, for sampling at `rate` (Hz).

        No carriers at all: the whole waveform is played, by methods that need no bands.  Two carriers must differ:
        envelopes are estimated with a bandwidth of at most spacing/(2 pi).  `hapticrender.strongest_carriers` chooses
        the carriers of a signal.
        """
        ...

    def waveform(self, time: Array, position: Array) -> Array:
        """Target displacement (m, shape (n,), finite) at `time` (s) with the finger at `position` (m, NaN: lifted)."""
        ...


@runtime_checkable
class Motion(Protocol):
    """Where the finger is."""

    def position(self, time: Array) -> Array:
        """Position (m from the middle of the surface, shape (n,)) at `time` (s)."""
        ...


@runtime_checkable
class Driver(Protocol):
    """Carries samples to a device, a file or a plant model, and back (see ``hapticrender.drivers.base``).

    A driver may have ``device_loop(controller)`` too, which returns a `DeviceLoop`, or None where this controller has
    to be run block by block.
    """

    rate: float  # Hz
    drive_channels: int
    sensed_channels: int  # 0: the device is driven open loop
    block: int  # samples a call of play
    delay: int  # samples from a sensed sample to the drive computed from it taking effect, >= block

    def __enter__(self) -> Driver: ...

    def __exit__(self, *exc: object) -> None: ...

    def play(self, drive: Array) -> Sensed:
        """Play a block (block, drive_channels) and return what was sensed while it played."""
        ...


# Advance device and controller together by `count` samples: loop(count, reference) -> drive as played, target,
# flags, sensed; `reference(position)` gives the texture's waveform at the finger's next positions.
DeviceLoop = Callable[[int, Callable[[Array], Array]], "tuple[Array, Array, Array, Sensed]"]


@runtime_checkable
class Plant(Protocol):
    """A model of a device with a finger on it; ``SimulatedDriver`` plays on it."""

    rate: float
    drive_channels: int
    sensed_channels: int
    block: int
    delay: int

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (n, drive_channels)."""
        ...

    def closes(self, controller: Controller) -> bool:
        """Whether `closed_loop` can take this controller."""
        ...

    def closed_loop(self, controller: Controller, waveform: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance plant and controller together, sample by sample; returns drive (as played), target, flags, sensed."""
        ...

    def finger_position(self, n: int) -> Array:
        """Finger positions (m, shape (n,)) of the next n samples, NaN while lifted."""
        ...


@runtime_checkable
class Controller(Protocol):
    """Makes the motion follow the texture, as a waveform or by bands, over preallocated state.

    `state` is the record that its compiled step reads and writes; a plant hands its address to the kernel in which the
    two are closed sample by sample.
    """

    method: str
    n_bands: int
    state: Any

    def run(self, sensed: Array, position: Array, waveform: Array) -> tuple[Array, Array, Array]:
        """Advance by n samples; return drive (n, channels), target envelopes (n, bands) and flags (n,), new arrays.

        `waveform` (n,) is the texture's waveform, read only where the bands have no constant envelope.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """A scene opened on a device: all that a run needs, designed and checked; nothing has been played yet."""

    scene: Scene  # with the method and the seed that are used
    device: Driver  # as handed over, or the simulated one
    driver: Driver  # the same, as the controller sees it: behind a square root, a resonance or nothing
    plant: Plant | None = None  # the simulated device
    model: DeviceModel  # for which the controller is designed
    bands: Bands  # carriers and targets, in the device's quantity
    waveform: Callable[[Array, Array], Array]  # target over time (s) and position (m), in the device's quantity
    waveform_of: Callable[[Texture], Callable[[Array, Array], Array]] | None = None  # of another one; None: its own
    differentiated: bool = False  # the target is the time derivative of `waveform`
    controller: Callable[[], Controller]  # a new one at rest
    design: Callable[[Bands], Controller] | None = None  # one at rest for other bands; None: for these only
    shape: Any = None  # static characteristic before the device, for this texture; `plant` or `driver` has `reshape`
    probe: Callable[[Driver], None] | None = None  # checks the open device, may correct its gain; None: nothing
    board_law: Callable[[], str] | None = None  # "plate" or "screen", which boards have; else a ValueError; None: none

    @property
    def samples(self) -> int:
        """Length of the run in samples."""
        return max(int(round(self.scene.duration * self.driver.rate)), 1)

    def reference(self, time: Array, position: Array) -> Array:
        """Texture's waveform that the controller analyses; 0 where every band has a constant envelope."""
        if self.bands.envelope is not None:
            return np.zeros(len(position))
        return self._checked(time, position)

    def requested(self, time: Array, position: Array, velocity: Array) -> Array:
        """Texture as the scene specifies it (device's quantity, shape (n,)), for a finger at `velocity` (m/s).

        0 while the finger is away, where the texture follows it or the device works on a finger alone.  A derivative is
        ``dr/dt = (r(t + h, x + v h) - r(t - h, x - v h))/(2 h)``, h = 0.1 us: an error of 2e-8 at 500 Hz.
        """
        if self.differentiated:
            step = np.array([DIFFERENCE, -DIFFERENCE])[:, None]
            ahead, behind = (self._checked(time + h, position + velocity * h) for h in step)
            values = (ahead - behind) / (2 * DIFFERENCE)
        else:
            values = self._checked(time, position)
        away = np.isnan(position) & (self.bands.follows_finger or self.model.finger.needs_contact)
        return np.where(away, 0.0, values)

    def _checked(self, time: Array, position: Array) -> Array:
        return self.bands.checked(type(self.scene.texture).__name__, self.waveform, time, position)


@runtime_checkable
class Renderer(Protocol):
    """Opens scenes on one kind of device (see ``hapticrender.renderers.base`` for what is shared)."""

    name: str
    needs: str  # what a real device of this kind takes, in a few words

    def open(self, scene: Scene, driver: Driver | None = None) -> Rendering:
        """Open a scene on the device behind `driver`, or on the simulated one; read its tables once, check everything.

        A ValueError or TypeError where the scene requests what the device cannot do.  What of that no texture could
        change, ``check(scene)`` may refuse (optional), which `hapticrender.Player` calls where it is made.
        """
        ...


class Method(Protocol):
    """A control method: designs a controller from a device model."""

    name: str

    def design(self, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> Controller:
        """Validate, design the loop by the device model, build tables; may raise `DesignError`.

        Without `feedback` nothing is measured: the drive is computed from the device model alone.
        """
        ...
