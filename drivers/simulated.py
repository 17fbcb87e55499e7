"""The embedded default: a plant model behind the driver protocol."""

from __future__ import annotations

from hapticrender.drivers.base import BaseDriver
from hapticrender.protocols import Array, Controller, Plant, Sensed


class SimulatedDriver(BaseDriver):
    """Plays on a plant model instead of hardware.

    Where the plant can be closed with a controller inside compiled code, the
    loop does so (`plant.closed_loop`); `play` gives the same samples one block
    at a time.

    Parameters
    ----------
    plant : Plant
        A device model with a finger on it.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._played = False
        super().__init__(
            rate=plant.rate,
            drive_channels=plant.drive_channels,
            sensed_channels=plant.sensed_channels,
            block=plant.block,
            delay=plant.delay,
        )

    def compiled_with(self, controller: Controller) -> Plant | None:
        """Return the plant where it can be closed with `controller` in compiled code, sample by sample.

        A subclass that plays in its own way is taken at its word: it gets its blocks.
        """
        whole = type(self) is SimulatedDriver and self.block == 1
        return self.plant if whole and self.plant.closes(controller) else None

    def close(self) -> None:
        """Play zeros as any driver does, where anything was played: a plant closed in compiled code is no device."""
        if self._played:
            super().close()
        self._state = "closed"

    def _play(self, drive: Array) -> Sensed:
        self._played = True
        return self.plant.run(drive)
