"""What a device is to the controller: a second-order matrix and the maps around it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.control.damping import BendingMode


@dataclass(frozen=True, kw_only=True)
class FingerRange:
    """What a finger can add to the first coordinate's dynamic stiffness, z(s) = mass s^2 + damping s + stiffness.

    The defaults are those of a finger on a plate that moves normal to it, where the coordinate is a displacement.
    """

    mass: tuple[float, float] = (-2e-3, 12e-3)  # kg, least and most, as of the next two
    damping: tuple[float, float] = (0.0, 12.0)  # N s/m
    stiffness: tuple[float, float] = (-500.0, 15e3)  # N/m
    typical_mass: float = 4e-3  # > 0, how far from zero it may be expected; a residue is divided between this ...
    typical_stiffness: float = 300.0  # ... and this in their proportion
    least_motion: float = 5e-8  # > 0, coordinate's unit: bands that move less do not count in the adaptation
    fastest: float = math.inf  # 1/s, > 0, of the adaptation: the effect of noise grows with its rate
    contact: tuple[float, float] | None = (0.05, 0.03)  # N, of onset and loss, by the sag; None: always in contact
    needs_contact: bool = False  # targets and adaptation run only while the finger's position is known ...
    least_speed: float = 0.0  # m/s: ... and while it slides at least so fast


@dataclass(frozen=True, kw_only=True)
class Demand:
    """What a scene needs of a device at most; supervision and drive limit follow from it."""

    motion: float  # R, coordinate's unit: peak of the target anywhere on the surface
    drive: float  # B, drive unit: amplitude of each channel with the worst finger
    lowest: float  # Hz, of what the target moves with
    highest: float  # Hz


@dataclass(frozen=True, kw_only=True, eq=False)
class DeviceModel:
    """All that the controller is given of a device of c coordinates, d drive channels, s sensors and p places.

    Notes
    -----
    Equations of motion: Grigorii et al. 2021, corrected in coordinates q = [x_c, a theta].
    """

    rate: float  # Hz
    delay: int  # samples from a sensed sample to the moment that the drive computed from it acts
    mass: Array  # (c, c), kg; with the next two the free device in its coordinates
    damping: Array  # (c, c), N s/m
    stiffness: Array  # (c, c), N/m
    force_from_drive: Array  # (c, d), N per drive unit: generalised forces of the drive channels
    coordinate_from_sensed: Array  # (c, s)
    side_from_coordinate: Array  # (d, c): displacement at each transducer
    place_from_coordinate: Array  # (p, c): displacement at each evaluation point
    places: tuple[str, ...]  # names of the evaluation points
    drive_limit: float  # drive unit, > 0: largest magnitude of each drive channel
    sensed_limit: float  # sensor unit, > 0: a larger sample is a sensor fault, a larger target is refused
    drive_step: float = 0.0  # drive unit: resolution of the command; 0 is ideal
    sensed_noise: float = 0.0  # sensor unit rms: white noise of each sensor
    inferred: bool = False  # what is sensed is computed from another quantity: that it repeats is no sensor fault
    bending: BendingMode | None = None  # the surface's own first mode, which the inner damper must not drive
    rigid: bool = False  # the surface is known to have no mode of its own in reach
    block: int = 1  # samples that the device takes and gives at once
    lowest_frequency: float = 20.0  # Hz: finger-locked carriers fade out below this
    highest_frequency: float = 1000.0  # Hz, and above this; feedback stays on until its last quarter
    highest_edge: float = 1.25  # times `highest_frequency`, > 1, where they have faded out; low-pass methods use 1.25
    shape: tuple[float, ...] | None = None  # pattern of the target over the coordinates; None: all in the first one
    finger: FingerRange = FingerRange()  # what a finger can add to D ...
    lever_per_metre: float = 0.0  # 1/m: ... at the lever arm of this times its position
    pace: float = 1.0  # > 0: on every rate of a method's rules, meant for carriers from 20 Hz on, but not on its limits
    contact_damping: float = 0.0  # N: part of the first damping that goes as 1/|v|, times v; in `damping` ...
    typical_speed: float = 1.0  # m/s, > 0: ... it is as at this speed of the finger
    sensor_delay: float = 0.0  # s, of the sensor against the evaluation point; negative: a lead
    contact_length: float = 0.0  # m: length by which a sliding contact lags behind what the sensor measures
    lock: float = 0.0  # Hz, of the resonance lock, which moves fixed carriers to where the device is resonant; 0: none
    taps: int | None = None  # >= 3, of the viscous damper without a bending mode; None: as many as reach 0.4 ms back
    late: bool = False  # the motion is to follow after the delay; else at once, for which the feedback has to act
    always_damped: bool = False  # the damper stays on at low gains: its noise costs less than the onset of a contact
    unit: str = "m"  # of the coordinates
    drive_unit: str = "A"
    demand: Demand | None = None  # of the scene; None: not known, or too little to supervise a motion by
    rms_limit: float = math.inf  # drive unit, > 0: largest rms of each drive channel ...
    rms_time: float = 10.0  # s: ... over about this time constant, by which a coil heats
    sensed_bound: float = math.inf  # sensor unit, > 0: a larger magnitude stops the drive
    shown: Array | None = None  # (p, s): `place_from_sensed`, where sensors show more than the coordinates

    @property
    def pattern(self) -> tuple[float, ...]:
        """Pattern of the target over the coordinates."""
        return self.shape or (1.0, *[0.0] * (len(self.mass) - 1))

    @property
    def profile(self) -> tuple[float, ...] | None:
        """Target at each evaluation point per target of the pattern; None: the same everywhere."""
        return None if self.shape is None else tuple((self.place_from_coordinate @ self.shape).tolist())

    @property
    def place_from_sensed(self) -> Array:
        """Displacement at each evaluation point per sensed signal, shape (p, s)."""
        return self.shown if self.shown is not None else self.place_from_coordinate @ self.coordinate_from_sensed

    def dynamic_stiffness(self, frequency: Array) -> Array:
        """D(j w), N/m, complex, shape (..., c, c), at `frequency` (Hz, shape (...))."""
        s = 2j * np.pi * np.asarray(frequency, float)[..., None, None]
        return self.mass * s**2 + self.damping * s + self.stiffness

    def response(self, frequency: Array) -> Array:
        """Coordinates per drive, m per drive unit, complex, shape (..., c, d): D^-1 times the drive's forces.

        Hold and delay are not in it; see `hold_and_delay`.
        """
        return np.linalg.inv(self.dynamic_stiffness(frequency)) @ self.force_from_drive

    def hold_and_delay(self, frequency: Array) -> Array:
        """Response of the zero-order hold and the known delay, complex, shape (...)."""
        turns = np.asarray(frequency, float) / self.rate
        return np.sinc(turns) * np.exp(-2j * np.pi * turns * (self.delay + 0.5))
