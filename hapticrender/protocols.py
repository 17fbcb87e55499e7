"""What the rooms of this house promise each other; read this file first.

Data flows one way round::

    Scene -> Renderer -> Controller -> Driver -> device | file | plant
                             ^                        |
                             +----- sensed block -----+

Everything is SI.  Time belongs to the loop: the core counts samples, only
drivers know seconds.  Arrays are float64, C-contiguous, with time first and
the band (or channel) last.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    from hapticrender.bands import Bands
    from hapticrender.control.bandmodel import BandModel
    from hapticrender.touch.scene import Scene

Array = np.ndarray[Any, np.dtype[Any]]


class Flag(IntFlag):
    """Trouble at run time is data: one status word a sample."""

    SATURATED = 1  # a drive channel was cut to its limit
    NONFINITE = 2  # a sensed value that no sensor can show (NaN, infinite, out of all range) was replaced by zero
    SENSOR_CLIPPED = 4  # a sensor stood at the end of its range
    OVERRUN = 8  # the driver lost samples
    OPEN_LOOP = 16  # a force could not be sensed and is driven open loop
    UNLOCKED = 32  # a carrier is off its resonance, or the motion too small to tell


class Sensed(NamedTuple):
    """What a driver returns for a block of n samples.

    `sensed` (n, sensed_channels), in the sensors' unit (m on a plate).
    `position` (n,), m from the middle of the surface, NaN while no finger is seen; None where the device cannot tell.
    `motion` (n, places), m: the true motion at the judged places; only simulated devices know it.
    `normal_load` (n,), N; None where the device cannot tell.
    `flags` (n,), `Flag` bits raised by the device; None where it raises none.
    """

    sensed: Array
    position: Array | None = None
    motion: Array | None = None
    normal_load: Array | None = None
    flags: Array | None = None


@runtime_checkable
class Texture(Protocol):
    """What the surface says: a function of time (s) or of position (m)."""

    def bands(self, rate: float) -> Bands:
        """Carriers, and constant envelopes where the texture has them, for sampling at `rate` (Hz)."""
        ...

    def waveform(self, time: Array, position: Array) -> Array:
        """Wanted displacement (m, shape (n,)) at `time` (s) with the finger at `position` (m, NaN: lifted)."""
        ...


@runtime_checkable
class Motion(Protocol):
    """Where the finger is."""

    def position(self, time: Array) -> Array:
        """Position (m from the middle of the surface, shape (n,)) at `time` (s)."""
        ...


@runtime_checkable
class Driver(Protocol):
    """Carries samples to a device, a file or a plant model, and back (see ``hapticrender.drivers.base``)."""

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

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance plant and controller together, sample by sample; returns drive (as played), target, flags, sensed."""
        ...

    def finger_position(self, n: int) -> Array:
        """Finger positions (m, shape (n,)) of the next n samples, NaN while lifted."""
        ...


@runtime_checkable
class Controller(Protocol):
    """Makes every band follow its target: estimator, law and synthesis over preallocated state.

    `tables` and `state` are the named tuples that its compiled step reads and writes; a plant hands them to the
    kernel in which the two are closed sample by sample.
    """

    method: str
    n_bands: int
    tables: Any
    state: Any

    def run(self, sensed: Array, position: Array, wanted: Array) -> tuple[Array, Array, Array]:
        """Digest n samples; return drive (n, channels), target envelopes (n, bands) and flags (n,).

        `wanted` (n,) is the texture's waveform, read only where the bands have no constant envelope.
        """
        ...


@runtime_checkable
class Renderer(Protocol):
    """Knows one kind of device and turns a scene into bands and a band model."""

    name: str
    needs: str  # what a real device of this kind takes, in a few words

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """All that the controller ever knows of the device behind `driver`."""
        ...

    def bands(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene; refuses with a ValueError what the device cannot do."""
        ...

    def plant(self, scene: Scene, seed: int) -> Plant:
        """The simulated device with the scene's finger on it."""
        ...

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """A driver of the user's as the controller is to see it; where nothing is in between, `driver` itself."""
        ...

    def waveform(self, scene: Scene) -> Callable[[Array, Array], Array]:
        """Wanted waveform over time (s) and position (m), in the device's quantity."""
        ...

    def design(self, method: Method, model: BandModel, bands: Bands, *, feedback: bool = True) -> Controller:
        """A controller of `method` for the whole device."""
        ...


class Method(Protocol):
    """A control method: designs a controller from a band model."""

    name: str

    def design(self, model: BandModel, bands: Bands, *, feedback: bool = True) -> Controller:
        """Validate, choose bandwidths, build tables; may raise `DesignError`.

        Without `feedback` nothing is sensed: the controller drives from what it knows of the device.
        """
        ...
