"""The plate of the library behind a driver that hides it, for cases of the accuracy suite."""

from collections.abc import Callable
from typing import Self

import numpy as np

from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Array, Controller, DeviceLoop, Sensed
from hapticrender.touch.finger import Finger


class SimulatedPlate:
    """A plate with a finger; of the plate it states a `delay` (samples) alone, which need not be the true one."""

    drive_channels = sensed_channels = 2
    probe = False  # the clock of the finger starts with the first sample

    def __init__(
        self, parameters: PlateParameters, finger: Finger, *, seed: int = 0, block: int = 1, delay: int = 1
    ) -> None:
        self._parameters, self._finger, self._moved = parameters, finger, [np.zeros((0, 3))]
        self._plate = Plate(parameters, finger, seed, block)
        self.rate, self.block, self.delay = parameters.rate, block, delay

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    @property
    def truth(self) -> Array:
        """Displacement (m, (n, 4)) under the finger (lifted: where it would touch), at both ends and in the middle."""
        moved, shape = np.concatenate(self._moved), self._parameters.displacement
        place = np.nan_to_num(self._finger.motion.position(np.arange(len(moved)) / self.rate))
        coordinates = moved @ np.linalg.inv(shape([0.0, *self._parameters.ends])).T
        return np.column_stack([(shape(place) * coordinates).sum(axis=1), moved[:, 1:], moved[:, 0]])

    def device_loop(self, controller: Controller) -> DeviceLoop | None:
        """Return the compiled loop of plate and controller; None where it has none."""
        if not self._plate.closes(controller):
            return None

        def advance(count: int, reference: Callable[[Array], Array]) -> tuple[Array, Array, Array, Sensed]:
            waveform = reference(self._plate.finger_position(count))
            drive, target, flags, sensed = self._plate.closed_loop(controller, waveform)
            return drive, target, flags, self._kept(sensed)

        return advance

    def play(self, drive: Array) -> Sensed:
        """Play a block."""
        return self._kept(self._plate.run(drive))

    def _kept(self, sensed: Sensed) -> Sensed:
        """Keep the motion, and state none."""
        self._moved.append(self._plate.motion[:, :3])
        return sensed._replace(motion=None)
