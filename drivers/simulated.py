"""The default driver: a plant model behind the driver protocol."""

from collections.abc import Callable

from hapticrender.drivers.base import BaseDriver
from hapticrender.protocols import Array, Controller, DeviceLoop, Plant, Sensed


class SimulatedDriver(BaseDriver):
    """Plays on a plant model instead of hardware.

    Where the plant can run in closed loop with a controller inside compiled
    code, `device_loop` does so; `play` gives the same samples one block at a time.  With `locate`, which makes of the
    finger's positions (m, shape (block,)) those that a sensor gives, all goes block by block.
    """

    probe = False  # it is wired as its plant says

    def __init__(self, plant: Plant, locate: Callable[[Array], Array] | None = None) -> None:
        self.plant, self._locate = plant, locate
        self._played = False
        own = ("rate", "drive_channels", "sensed_channels", "block", "delay")
        super().__init__(**{name: getattr(plant, name) for name in own})

    def device_loop(self, controller: Controller) -> DeviceLoop | None:
        """Return the compiled loop of plant and controller; None where they have to run block by block.

        A subclass that plays in its own way gets its blocks.
        """
        compiled = self._locate is None and type(self) is SimulatedDriver and self.block == 1
        if not compiled or not self.plant.closes(controller):
            return None

        def advance(count: int, reference: Callable[[Array], Array]) -> tuple[Array, Array, Array, Sensed]:
            return self.plant.closed_loop(controller, reference(self.plant.finger_position(count)))

        return advance

    def close(self) -> None:
        """Play zeros as any driver does, where anything was played block by block."""
        if self._played:
            super().close()
        self._state = "closed"

    def _play(self, drive: Array) -> Sensed:
        self._played = True
        sensed = self.plant.run(drive)
        if self._locate is None or sensed.position is None:
            return sensed
        return sensed._replace(position=self._locate(sensed.position))
