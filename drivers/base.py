"""The driver protocol in a page, and the part that every driver shares.

A driver carries samples to a device, a file or a plant model, and back.  Any object is one that has

``rate``
    sampling rate, Hz, <= 1e7
``drive_channels``, ``sensed_channels``
    how many columns it takes and gives; no sensed channel means that the device is driven open loop
``block``
    samples a call of `play`, >= 1
``delay``
    samples from the moment that a sample is sensed to the moment that the drive computed from it acts, >= `block`
``play(drive)``
    plays a block, float64 of shape (block, drive_channels), in A, and returns `Sensed` of as many samples, in arrays
    that it may use again; a device waits here until the block is due
``__enter__``, ``__exit__``
    makes the device ready, and leaves it at rest with zero drive whatever has happened
``zero_on_exit`` (optional)
    True where ``__exit__`` plays zeros by itself; otherwise the loop plays them before it leaves
``calibration`` (optional)
    relative uncertainty of the sensors' gain (0.01 is 1 %), which the verdict adds to its figures
``drive_limit`` (optional)
    A: largest drive that all of its channels play, below which identification stays
``probe`` (optional)
    False where the start-up probe is to be left out (docs/safety.md)
``by_host()`` (optional)
    of an open device with a controller of its own: the same, playing the drive of the host, in a `with` statement
``play_delay`` (optional)
    delay of `play`, where `delay` is that of a callback which plays a compiled controller (`start`, `stop`)
``host_delay`` (optional)
    samples of `delay` that the device itself does not have, only a drive that the host computes: a profile is without;
    where `Sensed.flags` have `Flag.OVERRUN` the device has played zeros for what the host computed so long before
``finger`` (optional)
    of a device that takes the finger's position from the host: None, until `render` sets it to the scene's `Finger`
``rendering``, ``device_kind`` (optional)
    of a device with a controller of its own: None, until `render` sets it to the `Rendering` that is to be played; the
    only kind of device that it plays, such as "vt-plate"
``live()`` (optional)
    the same device for live play (`hapticrender.Player`), where that is another driver
``start(entry)``, ``stop()`` (optional)
    of a device that calls back: hands it a ``hapticrender.realtime_entry.RealtimeEntry``, with ``sensed_scale`` (m) and
    ``drive_scale`` (1/A) of full scale; its ``check()`` (optional) raises what went wrong meanwhile
``cpu_load`` (optional)
    float: share of its time that a callback takes, 1 is all; NaN where it is not known; shown by ``Player.state()``
``loop(rendering)`` (optional)
    of a device with a controller of its own: what it plays live, like ``hapticrender.live_loop.LiveLoop``
``device_loop(controller)`` (optional)
    a whole closed loop of its own, sample by sample; see ``protocols.DeviceLoop``
``learned`` (optional)
    of an open device with a controller of its own: what `hapticrender.loop.differences` takes, as `mismatch`
``fault`` (optional)
    of such a device: a ``DeviceFault`` where it has stopped by itself, else None
``found()`` (optional, class method)
    list of str: the devices that are there now, each as the driver's argument, two spaces, and what it can do; shown
    by ``hapticrender devices``

A class that is registered as an entry point ``hapticrender.drivers``, or named as ``package.module:callable``, is
called with the text after ``--driver NAME:``, if there is any; parameters of it named ``drive_per_full_scale``,
``sensed_per_full_scale``, ``delay``, ``gain_uncertainty`` or ``profile`` get what the device's profile has.

Sample i of the drive is held during interval i; sample i of `Sensed` was taken at the *start* of interval i, before
that drive could act: with ``block = 1`` the next drive acts one interval after the sensing, ``delay = 1``.  The
finger's position (m from the middle, NaN while lifted) or load (N) comes with the block where it is measured.

A wrong argument (a shape, a NaN) is a ``ValueError`` before anything is played; a device that is absent, too slow or
gone is a `DriverError` that names device and operation; samples lost or cut are `Flag` bits in ``Sensed.flags``, which
has no others.  Motion that has been stated is stated in every later block.

Nothing has to be inherited: ``examples/your_own_driver.py`` is a whole plate in thirty lines.
"""

from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np

from hapticrender.driver_checks import check_driver as check_driver
from hapticrender.errors import DriverError, noted_on
from hapticrender.protocols import Array, Sensed


def checked_drive(drive: Array, block: int, drive_channels: int) -> Array:
    """Return a block of drive (block, drive_channels) as float64 in C order; a ValueError before it is played."""
    checked = np.ascontiguousarray(drive, dtype=np.float64)
    if checked.shape != (block, drive_channels):
        raise ValueError(f"drive has shape {checked.shape}, must be {(block, drive_channels)} (block, drive_channels)")
    finite = np.isfinite(checked)
    if not finite.all():
        sample, channel = np.argwhere(~finite)[0]
        raise ValueError(f"drive[{sample}, {channel}]={checked[sample, channel]} must be finite (A)")
    return checked


class OpenedInWith:
    """Base of what a `with` statement opens and closes, by `open` and `close`."""

    def open(self) -> Self:
        """Make it ready."""
        raise NotImplementedError

    def close(self) -> None:
        """Leave it at rest."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close; where the body has failed already, a failure to close is noted on the body's error."""
        with noted_on(error):
            self.close()


class BaseDriver(OpenedInWith):
    """A driver whose kinds differ only in how they open, play and close.

    A subclass fills in `_play`, and `_open` and `_close` where it has something to acquire.  It is used once: opened,
    played, closed and not to be opened again.

    Parameters
    ----------
    rate : float, Hz, > 0
    drive_channels, sensed_channels : int, >= 1 and >= 0
    block : int, >= 1
        Samples a call of `play`.
    delay : int, >= block, optional
        Samples from sensing to the drive computed from it; `block` unless given.
    """

    zero_on_exit = True

    def __init__(
        self, *, rate: float, drive_channels: int, sensed_channels: int, block: int = 1, delay: int | None = None
    ) -> None:
        self.rate = rate
        self.drive_channels = drive_channels
        self.sensed_channels = sensed_channels
        self.block = block
        self.delay = block if delay is None else delay
        self._state = "new"
        check_driver(self)

    def _open(self) -> None:
        """Acquire what playing needs."""

    def _play(self, drive: Array) -> Sensed:
        """Play a block that has been checked."""
        raise NotImplementedError

    def _close(self) -> None:
        """Release what `_open` acquired."""

    def open(self) -> Self:
        """Make the device ready, unless it is open already; a DriverError where it has been closed, or cannot be."""
        if self._state == "closed":
            raise DriverError(f"{self}: open: it has been closed; make a new one")
        if self._state == "new":
            self._open()
            self._state = "open"
        return self

    def play(self, drive: Array) -> Sensed:
        """Play a block (block, drive_channels) and return what was sensed; for times and errors see the module."""
        if self._state != "open":
            raise DriverError(f"{self}: play: it is {self._state}, not open; use it in a with statement")
        return self._play(checked_drive(drive, self.block, self.drive_channels))

    def close(self) -> None:
        """Play zeros until they have come through and release the device; raise the first failure after both."""
        if self._state != "open":
            self._state = "closed"
            return
        self._state = "closed"
        rest = np.zeros((self.block, self.drive_channels))
        blocks = -(-self.delay // self.block)  # until zeros have come through to the device
        carry_through(lambda: [self._play(rest) for _ in range(blocks)], self._close)

    def __str__(self) -> str:
        return type(self).__name__


def carry_through(*steps: Callable[[], object]) -> None:
    """Call every step, whatever the others do; then raise the first failure, with the later ones noted on it."""
    failures: list[BaseException] = []
    for step in steps:
        try:
            step()
        except BaseException as error:
            failures.append(error)
    if failures:
        for other in failures[1:]:
            failures[0].add_note(f"and then: {other}")
        raise failures[0]
