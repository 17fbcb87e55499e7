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

    The defaults are those of a finger on a plate that moves normal to it.

    Parameters
    ----------
    mass, damping, stiffness : (float, float)
        Least and most of each number; in kg, N s/m, N/m where the coordinate is a displacement.
    typical_mass, typical_stiffness : float
        How far from zero either may be expected, > 0; a residue is divided between them in this proportion.
    least_motion : float, coordinate's unit
        Bands that move less do not count in the adaptation, > 0.
    fastest : float, 1/s
        Fastest adaptation, > 0: the effect of noise grows with its rate.
    contact : (float, float), N, or None
        Loads of contact onset and loss, measured by the sag; None: the finger is always in contact.
    needs_contact : bool
        Targets and adaptation run only while the finger's position is known.
    least_speed : float, m/s
        And only while it slides at least so fast, where `needs_contact` holds.
    """

    mass: tuple[float, float] = (-2e-3, 12e-3)
    damping: tuple[float, float] = (0.0, 12.0)
    stiffness: tuple[float, float] = (-500.0, 15e3)
    typical_mass: float = 4e-3
    typical_stiffness: float = 300.0
    least_motion: float = 5e-8
    fastest: float = math.inf
    contact: tuple[float, float] | None = (0.05, 0.03)
    needs_contact: bool = False
    least_speed: float = 0.0

    def __post_init__(self) -> None:
        if not self.fastest > 0.0:
            raise ValueError(f"fastest = {self.fastest}: must be > 0 (1/s)")


@dataclass(frozen=True, kw_only=True)
class DeviceModel:
    """All that the controller is given of a device.

    In the controlled coordinates q the device obeys ``D(s) q = force_from_drive @ drive``
    with the dynamic stiffness ``D(s) = mass s^2 + damping s + stiffness``.  Coordinates are displacements (m) on a
    plate, a lateral force (N) on a screen; units below are those of a plate.

    Parameters
    ----------
    rate : float, Hz
        Sampling rate of the loop.
    delay : int, samples
        From a sensed sample to the moment the drive computed from it acts.
    block : int, samples
        How many samples the device takes and gives at once.
    mass, damping, stiffness : ndarray, shape (c, c), kg, N s/m, N/m
        The free device in its coordinates.
    force_from_drive : ndarray, shape (c, d), N per drive unit
        Generalised forces of the drive channels.
    coordinate_from_sensed : ndarray, shape (c, s)
        Coordinates from sensors.
    side_from_coordinate : ndarray, shape (d, c)
        Displacement at each transducer from the coordinates.
    place_from_coordinate : ndarray, shape (p, c)
        Displacement at each evaluation point from the coordinates.
    places : tuple of str
        Names of the evaluation points.
    drive_limit : float, drive unit
        Largest magnitude of each drive channel, > 0.
    sensed_limit : float, sensor unit
        Largest magnitude that a sensor can show, > 0; a larger sample is a sensor fault, a larger target is refused.
    drive_step : float, drive unit
        Resolution of the command; 0 is ideal.
    sensed_noise : float, sensor unit rms
        White noise of each sensor.
    bending : BendingMode or None
        The surface's own first mode, which the inner damper must not drive; None: unknown.
    rigid : bool
        The surface is known to have no mode of its own in reach.
    lowest_frequency, highest_frequency : float, Hz
        Finger-locked carriers fade out beyond these.
    highest_edge : float
        Times `highest_frequency`, where they have faded out, > 1.  Feedback stays on until the last quarter of
        `highest_frequency`.  Methods with a low pass use 1.25.
    shape : tuple of float, or None
        Pattern of the target over the coordinates; None: all of it in the first one.
    finger : FingerRange
        What a finger can add to D.
    pace : float
        Factor on every rate of a method's rules, which are meant for carriers from 20 Hz on; > 0.  Limits by delay,
        carriers and spacing stay as they are.
    contact_damping : float, N s/m times m/s
        Part of the first damping that goes as 1/|v| with the finger's speed, times that speed; it is in `damping` as it
        is at `typical_speed`.  0: none.
    typical_speed : float, m/s
        Of the finger, > 0.
    sensor_delay : float, s
        Delay of the sensor against the evaluation point; negative: a lead.
    contact_lag : float, m
        Length by which a sliding contact lags behind what the sensor shows.
    lock : float, Hz
        Bandwidth of the resonance lock, which moves the fixed carriers to where the device is resonant; 0: none.
    taps : int
        Of the inner damper where no bending mode is known, >= 3: more taps pass less noise and add delay.
    always_damped : bool
        The inner damper stays on at low gains as well, as its noise costs less than the onset of a contact.
    unit, drive_unit : str
        Of the coordinates and of the drive.

    Notes
    -----
    Equations of motion: Grigorii et al. 2021, corrected in coordinates q = [x_c, a theta].
    """

    rate: float
    delay: int
    mass: Array
    damping: Array
    stiffness: Array
    force_from_drive: Array
    coordinate_from_sensed: Array
    side_from_coordinate: Array
    place_from_coordinate: Array
    places: tuple[str, ...]
    drive_limit: float
    sensed_limit: float
    drive_step: float = 0.0
    sensed_noise: float = 0.0
    bending: BendingMode | None = None
    rigid: bool = False
    block: int = 1
    lowest_frequency: float = 20.0
    highest_frequency: float = 1000.0
    highest_edge: float = 1.25
    shape: tuple[float, ...] | None = None
    finger: FingerRange = FingerRange()
    pace: float = 1.0
    contact_damping: float = 0.0
    typical_speed: float = 1.0
    sensor_delay: float = 0.0
    contact_lag: float = 0.0
    lock: float = 0.0
    taps: int = 3
    always_damped: bool = False
    unit: str = "m"
    drive_unit: str = "A"

    @property
    def pattern(self) -> tuple[float, ...]:
        """Pattern of the target over the coordinates."""
        return self.shape or (1.0, *[0.0] * (len(self.mass) - 1))

    @property
    def profile(self) -> tuple[float, ...] | None:
        """Target at each evaluation point per target of the pattern; None: the same everywhere."""
        return None if self.shape is None else tuple((self.place_from_coordinate @ self.shape).tolist())

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
