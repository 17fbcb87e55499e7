"""A driver behind a static shape of its drive, which a renderer puts between the controller and a user's device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hapticrender.protocols import Array, Driver, Sensed


class ShapedDriver:
    """A driver that is handed `shape` of what it is asked to play.

    Parameters
    ----------
    driver : Driver
        The device.
    shape : callable
        Drive of the device from that of the controller, sample by sample, of one shape (n, channels).
    """

    def __init__(self, driver: Driver, shape: Callable[[Array], Any]) -> None:
        self.driver, self.shape = driver, shape
        self.rate, self.block, self.delay = driver.rate, driver.block, driver.delay
        self.drive_channels, self.sensed_channels = driver.drive_channels, driver.sensed_channels

    def __enter__(self) -> ShapedDriver:
        self.driver.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.driver.__exit__(*exc)

    def play(self, drive: Array) -> Sensed:
        """Play `shape` of a block."""
        return self.driver.play(self.shape(drive))
