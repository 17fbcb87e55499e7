"""A screen laminated on a plate: the plate moves the finger, the screen rubs it, and both add to one skin velocity.

Velocities that feel alike add in phase (docs/theory.md, "Hybrid").  The plate carries the finger's load alone, as
attraction presses skin and glass on each other as much as it pulls; friction acts along the plate and does not move it.
Left out are the motion of the gap, and what the plate's vibration makes of friction: the match v/F was measured by
fingers that slid over a vibrating plate.
"""

from typing import Any

import numba
import numpy as np
from numba import carray

from hapticrender.checks import require
from hapticrender.jit import F8, I8, SIGNALS, SIGNALS_T, call, pointer, record_of, step
from hapticrender.plants.compiled import CompiledPlant
from hapticrender.plants.plate import Plate
from hapticrender.protocols import Array

PLACES = ("skin",)
COILS = SENSORS = 2  # channels of the plate, before those of the screen
VELOCITY = 3  # column of the plate's motion: of the glass under the finger

SCREEN_SIGNALS = SIGNALS.itemsize  # bytes from the plate's record of signals to the screen's

HYBRID = np.dtype(
    [
        ("velocity_per_force", "f8"),
        ("plate", "i8", (2,)),  # addresses of step and state
        ("screen", "i8", (2,)),
        ("parts", "i8"),  # address of a `SIGNALS` record of the plate, then of one of the screen
        ("input_channels", "i8"),
        ("noise_channels", "i8"),
        ("plate_motion", "i8"),  # address of a row of the plate's motion
        ("screen_motion", "i8"),
    ],
    align=True,
)
HYBRID_T = numba.from_dtype(HYBRID)


@step
def hybrid_step(state, signals, start, count):
    """Advance plate and screen sample by sample; motion is the skin's velocity (m/s), then each part's share of it."""
    s = carray(pointer(state, HYBRID_T), 1)[0]
    io = carray(pointer(signals, SIGNALS_T), 1)[0]
    parts = carray(pointer(s.parts, SIGNALS_T), 2)
    plate, screen = parts[0], parts[1]
    stop = start + count
    motion = carray(pointer(io.motion, F8), (stop, 3))
    flags = carray(pointer(io.flags, I8), stop)
    moved = carray(pointer(s.plate_motion, F8), VELOCITY + 1)
    friction = carray(pointer(s.screen_motion, F8), 1)
    for n in range(start, stop):
        plate.drive = io.drive + 8 * (COILS + 1) * n
        plate.noise = io.noise + 8 * s.noise_channels * n
        plate.sensed = io.sensed + 8 * (SENSORS + 1) * n
        plate.inputs = screen.inputs = io.inputs + 8 * s.input_channels * n
        plate.flags = screen.flags = io.flags + 8 * n
        screen.drive = plate.drive + 8 * COILS
        screen.noise = plate.noise + 8 * SENSORS
        screen.sensed = plate.sensed + 8 * SENSORS
        call(s.plate[0], (s.plate[1], s.parts, 0, 1))
        raised = flags[n]
        call(s.screen[0], (s.screen[1], s.parts + SCREEN_SIGNALS, 0, 1))
        flags[n] |= raised
        motion[n, 1], motion[n, 2] = moved[VELOCITY], s.velocity_per_force * friction[0]
        motion[n, 0] = motion[n, 1] + motion[n, 2]
    return 0


class HybridPlant(CompiledPlant):
    """Plate and screen in discrete time, behind the `Plant` protocol.

    Drive: a current for each coil (A), then the screen's; sensed: both ends of the plate (m), then what the screen
    senses (N); `motion`: the skin's velocity (m/s), then what plate and screen add to it.  The screen is any compiled
    plant of one drive channel and one sensor, whose motion starts with friction (N); `velocity_per_force` (m/(N s)) is
    the skin velocity that matches a newton of friction, > 0.  The plate has two coils, and both parts have one rate;
    that they have one finger and a delay of a sample is checked where a scene is read.
    """

    step = hybrid_step
    sensed_channels = drive_channels = SENSORS + 1
    motion_channels = 3

    def __init__(self, plate: Plate, screen: CompiledPlant, velocity_per_force: float) -> None:
        stated = plate.rate, plate.drive_channels, velocity_per_force
        good = stated[:2] == (screen.rate, COILS) and 0.0 < velocity_per_force < np.inf
        names, bound = "plate.rate, its coils, velocity_per_force", f"{screen.rate:g} Hz, {COILS} and > 0 m/(N s)"
        require(good, names, stated, bound)
        super().__init__(screen.finger, screen.rate)
        self.plate, self.screen = plate, screen
        self.noise_channels = plate.noise_channels + screen.noise_channels
        rows = [np.zeros(part.motion_channels) for part in (plate, screen)]
        parts = np.zeros(2, SIGNALS)
        parts["motion"] = [row.ctypes.data for row in rows]
        self.buffers = (parts, *rows)
        self.state = record_of(
            HYBRID,
            velocity_per_force=velocity_per_force,
            plate=(plate.step.address, plate.state.ctypes.data),
            screen=(screen.step.address, screen.state.ctypes.data),
            parts=parts,
            input_channels=screen.inputs(0, 1).shape[1],
            noise_channels=self.noise_channels,
            plate_motion=rows[0],
            screen_motion=rows[1],
        )

    def reshape(self, root: Any) -> None:
        """Change what is before the screen; see `ElectroadhesionScreen.reshape`."""
        self.screen.reshape(root)  # type: ignore[attr-defined]

    def inputs(self, first: int, n: int) -> Array:
        """Finger and whatever else the screen takes, sample by sample."""
        return self.screen.inputs(first, n)

    def noise(self, n: int) -> Array:
        """Noise of the plate's sensors, then of the screen's."""
        return np.hstack([self.plate.noise(n), self.screen.noise(n)])
