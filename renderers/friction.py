"""Common part of friction devices: textures as lateral forces, and the device model of a sliding contact.

A texture is a displacement of the skin (m); friction moves it with a force (N).  They match where skin velocities do,
F = V/(v/F), with v/F = 0.64 m/(N s) over 20-400 Hz [Grigorii et al. 2021], or the finger's own admittance.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import option, parameter, require
from hapticrender.control.device_model import DeviceModel, FingerRange
from hapticrender.plants.sliding_contact import SlidingParameters
from hapticrender.protocols import Array, Driver, Texture
from hapticrender.renderers.base import BaseRenderer, Settings, Waveform, check_limits
from hapticrender.renderers.limits import Need, check_carriers, examined, needed, perceptible, speeds, top_speed
from hapticrender.touch.device_profile import Limits
from hapticrender.touch.perception import VELOCITY_PER_FORCE
from hapticrender.touch.scene import Scene

RATIO = "render.velocity_per_force"
LEAST_FORCE = 1e-3  # N: a smaller friction is too small to estimate the contact from
HEADROOM = 2.0  # of the drive that the free device needs: half is left to the feedback
PLACES = ("friction",)


@dataclass(frozen=True, kw_only=True)
class FrictionSettings(Settings):
    """Conversion of a texture to friction; set in a scene's [render] table.

    `velocity_per_force` is the skin velocity matched to a newton of friction; 0: the finger's own |V_s/F|, for fixed
    carriers.  `square_root` says whether a screen's drive is an attraction (N), or the current's envelope itself.
    `probe` says whether a vibrating surface, or the plate of a hybrid, is probed; of a surface the gain of drive and
    sensor is corrected.
    """

    velocity_per_force: float = parameter(VELOCITY_PER_FORCE, "m/(N s)", most=100.0)
    square_root: str = option("on", "on", "off")


@dataclass(frozen=True)
class FrictionSetup:
    """A scene, its settings, the surface that its controller assumes, and the one that is simulated."""

    scene: Scene
    settings: FrictionSettings
    assumed: SlidingParameters
    simulated: SlidingParameters

    @cached_property
    def speed(self) -> float:
        """Median speed (m/s) of the finger while it slides."""
        speed, least = speeds(self.scene), self.assumed.least_speed
        sliding = speed[speed >= least]  # NaN, lifted, is none
        if not sliding.size:
            raise ValueError(f"finger: must slide faster than {least:g} m/s: friction needs a sliding finger")
        return float(np.median(sliding))

    @cached_property
    def load(self) -> float:
        """Mean normal load (N) of the finger while it touches."""
        time = examined(self.scene)
        load = self.scene.finger.load(time)[np.isfinite(self.scene.finger.position(time))]
        mean = float(load.mean()) if load.size else 0.0
        require(mean > 0.0, "finger.normal_load", mean, "> 0 N, friction needs a load")
        return mean

    @cached_property
    def largest_load(self) -> float:
        """Largest normal load (N) of the finger."""
        return float(np.max(self.scene.finger.load(examined(self.scene)), initial=0.0))

    def waveform_of(self, texture: Texture) -> Waveform:
        """Waveform whose time derivative is the target friction: displacement of a texture over v/F (N s)."""
        share, mechanics = self.settings.velocity_per_force, self.scene.finger.mechanics
        factor = 1.0 / (share or VELOCITY_PER_FORCE)

        def impulse(time: Array, position: Array) -> Any:
            if not share and (bands := texture.bands(np.inf)).envelope is not None:
                turned = bands.envelope / mechanics.skin_velocity_per_force(bands.frequency)
                return (turned * np.exp(1j * bands.carrier_phase(time, position))).real.sum(axis=1)
            values = texture.waveform(time, position)
            return factor * np.asarray(values) if np.shape(values) else values  # no array: refused by its user

        return impulse

    def targets(self, model: DeviceModel) -> Bands:
        """Carriers and targets of the scene as friction (N): j w X/(v/F), w left to a carrier that follows the finger.

        v/F (m/(N s)) is the settings', or that of the finger's own mechanics.
        """
        scene, share, mechanics = self.scene, self.settings.velocity_per_force, self.scene.finger.mechanics
        require(not scene.gradient, "gradient", scene.gradient, "0 1/m: friction is made under the finger alone")
        bands = perceptible(scene, scene.texture.bands(model.rate), model)
        check_carriers(scene, model, bands)
        if bands.envelope is None:
            require(share > 0, RATIO, share, "> 0 m/(N s) for a recording")
            return replace(bands, differentiated=True)
        if (bands.wavenumber > 0.0).any():
            require(share > 0, RATIO, share, "> 0 m/(N s) for a texture over position")
            return replace(bands, envelope=bands.envelope / share, differentiated=True)
        require(share > 0 or mechanics.order > 0, RATIO, share, "> 0 m/(N s), or finger.mechanics not 'none'")
        ratio = share or mechanics.skin_velocity_per_force(bands.frequency)
        return replace(bands, envelope=2j * np.pi * bands.frequency * bands.envelope / ratio)

    def needed(self, model: DeviceModel) -> Need:
        """Amplitude and drive (N) that the scene needs of `model`."""
        return needed(self.scene, model, self.targets(model), self.waveform_of(self.scene.texture))

    def check_speed(self, model: DeviceModel, bands: Bands) -> None:
        """Refuse a skin velocity that the finger's own speed makes impossible, where the skin is modelled."""
        if self.scene.finger.mechanics.order == 0:
            return
        locked = bool((bands.wavenumber > 0.0).any())
        speed = top_speed(self.scene) if locked else self.speed
        velocity = self.needed(model).amplitude * self.settings.velocity_per_force
        if velocity > speed * (1 + 1e-9):  # up to rounding
            bound = f"must be <= {speed:.3g} m/s, the {'top' if locked else 'median'} speed of the finger"
            raise ValueError(f"texture.amplitude asks for a skin velocity of {velocity:.3g} m/s: {bound}")

    def check_range(self, model: DeviceModel, steady: float) -> None:
        """Refuse a friction, `steady` (N) for the most part, that a tribometer cannot measure."""
        most = steady + self.needed(model).amplitude
        bound = self.assumed.force_range
        if most > bound:
            raise ValueError(f"friction of {most:.3g} N: must be <= {bound:g} N, the tribometer's range")

    def contact(self, driver: Driver, friction_per_drive: float) -> DeviceModel:
        """Device model of a sliding contact whose drive makes `friction_per_drive` (N per N), seen by a tribometer.

        ``(1 + s delta/v) (1 + 2 zeta s/w0 + s^2/w0^2) F = friction_per_drive u`` up to s^2, at the scene's median
        speed; without the tribometer's part where `driver` senses nothing.  The drive limit is not set.
        """
        sliding, speed, sensed = self.assumed, self.speed, driver.sensed_channels > 0
        lag = sliding.memory_length / speed
        w0 = 2 * np.pi * sliding.tribometer_frequency
        ring = sliding.sensor_delay if sensed else 0.0
        own = 1.0 / friction_per_drive
        one = np.eye(1)
        return DeviceModel(
            rate=driver.rate,
            delay=driver.delay,
            block=1,  # held over a block, the envelopes saturate at touch: the friction answers within a sample
            mass=own * (1 / w0**2 + ring * lag if sensed else 0.0) * one,
            sensor_delay=ring,
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
            contact_damping=own * sliding.memory_length,
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
                needs_contact=True,
                least_speed=sliding.least_speed,
            ),
        )

    def inferred(self, model: DeviceModel, lag: float) -> DeviceModel:
        """Return `model` where friction is inferred from what follows the drive by a `lag` (s), before the contact."""
        mass, damping, contact = lag**2 / 2 * model.stiffness, lag * model.stiffness, self.assumed.memory_length
        return replace(model, mass=mass, damping=damping, contact_damping=0.0, contact_length=contact, inferred=True)


def carrier_limit(limits: Limits, most: float, unit: str) -> float:
    """Largest peak of a carrier, `most` (`unit`) or within the limits of peak and rms drive, of a sine; no others."""
    check_limits(limits, most, unit)
    bound = "left out: it bounds the sensors of plates; of a screen or an ultrasonic surface limit the drive"
    require(limits.displacement is None, "limits.displacement", limits.displacement, bound)
    return min(most, limits.peak_drive or np.inf, np.sqrt(2.0) * (limits.rms_drive or np.inf))


class FrictionRenderer(BaseRenderer):
    """Base of the renderers whose target quantity is friction (N) against the motion of a sliding finger."""

    differentiated = True

    def protected(self, limits: Limits, model: DeviceModel) -> DeviceModel:
        """Return `model`: its drive is a friction, and the setup has the limits of the carrier; see `carrier_limit`."""
        return model

    def waveform(self, setup: FrictionSetup, texture: Texture) -> Waveform:
        """Return the waveform whose time derivative is the target friction: displacement over v/F (N s)."""
        return setup.waveform_of(texture)

    def bands(self, setup: FrictionSetup, model: DeviceModel) -> Bands:
        """Carriers and targets of a scene; `device_model` has refused what is beyond the device.

        The sensor's response to a fixed carrier is taken into account here; of one that follows the finger the
        controller computes it from the model's delays.
        """
        bands = setup.targets(model)
        setup.check_speed(model, bands)
        direct = model.sensor_delay == model.contact_length == 0.0
        if direct or bands.envelope is None or (bands.wavenumber > 0.0).any():
            return bands
        device: Any = setup.assumed
        return replace(bands, sensor_response=device.sensor_response(bands.frequency, setup.speed))
