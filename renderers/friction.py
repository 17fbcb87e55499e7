"""What friction devices share: textures as lateral forces, and the sliding contact between a drive and what is felt.

A texture says how the skin is to move (m); friction moves it with a force (N).
One feels as strong as the other where skin velocities match, F = V/(v/F), with
v/F = 0.64 m/(N s) over 20-400 Hz [Grigorii et al. 2021], or the finger's own
admittance.  The force of a carrier that follows the finger grows with the
speed, as the skin velocity of a real grating does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel, FingerRange
from hapticrender.plants.bounds import Validated, choice, number
from hapticrender.plants.sliding import SlidingParameters
from hapticrender.protocols import Array
from hapticrender.renderers.base import BaseRenderer, Waveform
from hapticrender.renderers.limits import check_carriers, felt, looked_at, needed_drive, speeds, wanted_amplitude
from hapticrender.touch.perception import VELOCITY_PER_FORCE
from hapticrender.touch.scene import Scene

LEAST_FORCE = 1e-3  # N: a smaller friction teaches nothing of the contact
ROOM = 2.0  # of the drive that the free device needs: half is left to the feedback
PLACES = ("friction",)


@dataclass(frozen=True, kw_only=True)
class FrictionSettings(Validated):
    """How a texture becomes a friction; set in a scene's `plant` table beside the device's own parameters.

    Parameters
    ----------
    velocity_per_force : float, m/(N s)
        Skin velocity that feels as strong as a newton of friction; 0: the finger's own |V_s/F|, for carriers that do
        not follow it.
    square_root : {"on", "off"}
        Whether a screen's drive is an attraction (N), or the current's envelope itself, naively.
    """

    velocity_per_force: float = number(VELOCITY_PER_FORCE, "m/(N s)", most=100.0)
    square_root: str = choice("on", "on", "off")

    @classmethod
    def split(cls, plant: Mapping[str, Any]) -> tuple[FrictionSettings, dict[str, Any]]:
        """Settings, and what is left of a scene's `plant` table for the device."""
        own = cls.names()
        settings = cls.with_overrides({key: value for key, value in plant.items() if key in own})
        return settings, {key: value for key, value in plant.items() if key not in own}


class FrictionRenderer(BaseRenderer):
    """Base of the renderers whose target quantity is friction (N) against the motion of a sliding finger."""

    def waveform(self, scene: Scene) -> Waveform:
        """Return the waveform whose time derivative is the wanted friction: displacement over v/F (N s)."""
        settings, _ = FrictionSettings.split(scene.plant)
        share = settings.velocity_per_force or VELOCITY_PER_FORCE
        return lambda time, position: np.asarray(scene.texture.waveform(time, position), float) / share

    def wanted(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene as friction (N)."""
        if scene.gradient:
            raise ValueError(f"gradient = {scene.gradient:g} 1/m: must be 0, friction is made under the finger alone")
        settings, _ = FrictionSettings.split(scene.plant)
        bands = felt(scene, scene.texture.bands(model.rate), model)
        check_carriers(scene, model, bands)
        if bands.envelope is None:
            if not settings.velocity_per_force:
                raise ValueError("plant.velocity_per_force = 0: must be > 0 m/(N s) for a recording")
            return replace(bands, differentiated=True)
        return replace(bands, **_as_friction(scene, bands, settings))

    def sensor_response(self, scene: Scene, frequency: Array) -> Array:
        """Return what is sensed per friction (complex) at `frequency` (Hz)."""
        raise NotImplementedError

    def bands(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene; `band_model` has refused what is beyond the device.

        What the sensor makes of a fixed carrier is known, and taken into account; of one that follows the finger the
        controller knows how late it is shown.
        """
        bands = self.wanted(scene, model)
        deaf = model.late == model.foresight == 0.0
        if deaf or bands.envelope is None or (bands.wavenumber > 0.0).any():
            return bands
        return replace(bands, shown=self.sensor_response(scene, bands.frequency))

    def contact(
        self,
        scene: Scene,
        sliding: SlidingParameters,
        *,
        rate: float,
        delay: int,
        block: int,
        friction_per_drive: float,
        listening: bool = True,
    ) -> BandModel:
        """Band model of a sliding contact whose drive makes `friction_per_drive` (N per N), seen by a tribometer.

        ``(1 + s delta/v) (1 + 2 zeta s/w0 + s^2/w0^2) F = friction_per_drive u`` up to s^2, at the scene's median
        speed; without the tribometer's part where nothing is `listening`.  The drive limit is not set.
        """
        speed = typical_speed(scene, sliding.least_speed)
        lag = sliding.memory_length / speed
        w0 = 2 * np.pi * sliding.tribometer_frequency
        ring = 2 * sliding.tribometer_damping / w0 if listening else 0.0
        own = 1.0 / friction_per_drive
        one = np.eye(1)
        return BandModel(
            rate=rate,
            delay=delay,
            block=block,
            mass=own * (1 / w0**2 + ring * lag if listening else 0.0) * one,
            late=ring,
            damping=own * (lag + ring) * one,
            stiffness=own * one,
            force_from_drive=one,
            coordinate_from_sensed=one,
            side_from_coordinate=one,
            place_from_coordinate=one,
            places=PLACES,
            drive_limit=np.inf,
            sensed_limit=sliding.force_range,
            sensed_noise=sliding.force_noise,
            rigid=True,
            memory=own * sliding.memory_length,
            typical_speed=speed,
            unit="N",
            drive_unit="N",
            finger=FingerRange(
                mass=(0.0, 0.0),
                damping=(-0.9 * own * lag, 10 * own * lag),
                stiffness=(-0.7 * own, 4.0 * own),
                typical_mass=1e-12,
                typical_stiffness=0.5 * own,
                least_motion=LEAST_FORCE,
                contact=None,
                presence=True,
                least_speed=sliding.least_speed,
            ),
        )

    def check_range(self, scene: Scene, model: BandModel, sliding: SlidingParameters, steady: float) -> None:
        """Refuse a friction, `steady` (N) for the most part, that a tribometer cannot show."""
        most = steady + wanted_amplitude(scene, model, self.wanted(scene, model), self.waveform(scene))
        if most > sliding.force_range:
            raise ValueError(f"friction of {most:.3g} N: must be <= {sliding.force_range:g} N, the tribometer's range")

    def needed(self, scene: Scene, model: BandModel) -> float:
        """Largest drive (N) that the scene needs of `model`, the finger as assumed there."""
        return needed_drive(scene, model, self.wanted(scene, model), self.waveform(scene))


def typical_speed(scene: Scene, least: float) -> float:
    """Median speed (m/s) of the finger while it slides; friction is felt only then."""
    speed = speeds(scene)
    sliding = speed[speed >= least]  # NaN, lifted, is none
    if not sliding.size:
        raise ValueError(
            f"finger: must slide faster than {least:g} m/s, friction is not felt by one that rests or is lifted"
        )
    return float(np.median(sliding))


def typical_load(scene: Scene) -> float:
    """Mean normal load (N) of the finger while it touches."""
    time = looked_at(scene)
    load = scene.finger.load(time)[np.isfinite(scene.finger.position(time))]
    mean = float(load.mean()) if load.size else 0.0
    if not mean > 0.0:
        raise ValueError("finger.normal_load = 0: must be > 0 N, friction needs a load")
    return mean


def largest_load(scene: Scene) -> float:
    """Largest normal load (N) of the finger."""
    return float(np.max(scene.finger.load(looked_at(scene)), initial=0.0))


def _as_friction(scene: Scene, bands: Bands, settings: FrictionSettings) -> dict[str, Any]:
    """Envelopes of displacement (m) as friction (N): j w X/(v/F), w left to a carrier that follows the finger."""
    locked = bool((bands.wavenumber > 0.0).any())
    if settings.velocity_per_force:
        share: Array | float = settings.velocity_per_force
    elif locked:
        raise ValueError("plant.velocity_per_force = 0: must be > 0 m/(N s) for a texture over position")
    else:
        if scene.finger.mechanics.order == 0:
            raise ValueError(
                "plant.velocity_per_force = 0: must be > 0 m/(N s), or finger.mechanics one that moves: it has none"
            )
        share = scene.finger.mechanics.skin_velocity_per_force(bands.frequency)
    if locked:
        return {"envelope": bands.envelope / share, "differentiated": True}
    return {"envelope": 2j * np.pi * bands.frequency * bands.envelope / share}
