"""A screen laminated on a plate: the plate moves the finger, the screen rubs it, and it feels one skin velocity.

Velocities that feel alike add, in phase [Grigorii et al. 2021]::

    v = d/dt (displacement of the glass under the finger) + (v/F) (friction),   v/F = 0.64 m/(N s)

The finger's load bends both: the plate sags under it, and friction grows with it.  Attraction is a force between skin
and glass: it presses one on the other as much as it pulls, so that the plate feels the load alone, but for the motion
of the gap, which is left out.  Friction acts along the plate and does not move it.  What the plate's own vibration
makes of the normal force, and so of friction, is left out as well: the match v/F was found by fingers that slid over a
vibrating plate, so it is part of what a plate's velocity feels like.
"""

from __future__ import annotations

import numpy as np

from hapticrender.control.together import TogetherTables
from hapticrender.plants.base import TouchedPlant
from hapticrender.plants.electroadhesion import ElectroadhesionScreen, finger_rows
from hapticrender.plants.electroadhesion_kernels import LOAD, POSITION
from hapticrender.plants.hybrid_kernels import (
    COILS,
    HybridState,
    HybridTables,
    closed_hybrid_run,
    hybrid_run,
)
from hapticrender.plants.vibrotactile import Plate
from hapticrender.protocols import Array, Controller, Sensed

PLACES = ("skin",)


class HybridPlant(TouchedPlant):
    """Plate and screen in discrete time, behind the `Plant` protocol.

    Drive: a current for each coil (A), then the screen's; sensed: both ends of the plate (m), then what the screen
    senses (N).

    Parameters
    ----------
    plate : Plate
        With both coils.
    screen : ElectroadhesionScreen
        At the same rate, under the same finger.
    velocity_per_force : float, m/(N s)
        Skin velocity that feels as strong as a newton of friction, > 0.

    Attributes
    ----------
    felt : ndarray, shape (n, 2), m/s
        What plate and screen add to the skin's velocity, over the samples of the last run.

    Raises
    ------
    ValueError
        Plate and screen differ in rate, delay or finger, or the plate has a single coil.
    """

    closed_with = (TogetherTables,)
    sensed_channels = drive_channels = 3
    delay = block = 1

    def __init__(self, plate: Plate, screen: ElectroadhesionScreen, velocity_per_force: float) -> None:
        for name, found, needed in (
            ("rate", plate.rate, screen.rate),
            ("delay", plate.delay, screen.delay),
            ("finger", plate.finger, screen.finger),
            ("coils", plate.drive_channels, COILS),
        ):
            if found != needed:
                raise ValueError(f"plate.{name} = {found}: must be {needed} with this screen")
        if not velocity_per_force > 0.0:
            raise ValueError(f"{velocity_per_force=}: must be > 0 m/(N s)")
        super().__init__(screen.finger, screen.rate)
        self.plate, self.screen = plate, screen
        self.felt = np.zeros((0, 2))
        self._tables = HybridTables(plate._tables, screen._tables, float(velocity_per_force))
        self._state = HybridState(plate._state, screen._state, np.zeros(3), np.zeros(1), np.zeros(1))
        self._last = np.zeros(self.drive_channels)

    def _next(self, n: int) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
        """Finger rows and noise of the next n samples, and their columns to fill: sensed, motion, felt, flags."""
        noise = np.hstack([self.plate._next(n)[1], self.screen._next(n)[1]])
        finger = finger_rows(self.finger, self._samples, n, self.rate)
        self._samples += n
        self.felt = np.zeros((n, 2))
        return finger, noise, (np.zeros((n, 3)), np.zeros((n, 1)), self.felt, np.zeros(n, np.int64))

    def run(self, drive: Array) -> Sensed:
        """Advance by n samples under `drive` (shape (n, 3)); row i acts from sample i on, sensed at its start."""
        finger, noise, columns = self._next(len(drive))
        hybrid_run(self._tables, self._state, np.ascontiguousarray(drive, float), finger, noise, *columns)
        sensed, motion, _, flags = columns
        return Sensed(sensed, finger[:, POSITION], motion, finger[:, LOAD], flags)

    def closed_loop(self, controller: Controller, wanted: Array) -> tuple[Array, Array, Array, Sensed]:
        """Advance hybrid and controller together, sample by sample, over `wanted` (shape (n,))."""
        n = len(wanted)
        finger, noise, (sensed, motion, felt, flags) = self._next(n)
        drive, target = np.zeros((n, self.drive_channels)), np.zeros((n, controller.n_bands), complex)
        closed_hybrid_run(
            self._tables,
            self._state,
            controller.tables,
            controller.state,
            self._last,
            finger,
            noise,
            wanted,
            sensed,
            motion,
            felt,
            drive,
            target,
            flags,
        )
        return drive, target, flags, Sensed(sensed, finger[:, POSITION], motion, finger[:, LOAD], flags)
