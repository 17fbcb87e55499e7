"""Ultrasonic surface: turns a scene into friction bands, the surface's band model, and the surface itself.

The target quantity is friction (N), as a change around a bias below that of
the surface at rest.  The inverse of the friction law makes it an amplitude of
the plate's mode, which the same controller holds on the resonant carrier.  A
driver of your own gets that carrier (V) at its own rate, and senses the mode's
displacement (m), or nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.surface import SurfaceParameters, UltrasonicSurface
from hapticrender.protocols import Array, Driver
from hapticrender.renderers.friction import (
    FrictionRenderer,
    FrictionSettings,
    largest_load,
    typical_load,
    typical_speed,
)
from hapticrender.renderers.resonant import ResonantDriver, amplitude_loop
from hapticrender.touch.scene import Scene

LEAST_NOISE = 1e-6  # of the range: of a friction that is worked out from the amplitude


class UltrasonicRenderer(FrictionRenderer):
    """Renderer for plates that take friction away by ultrasonic vibration."""

    name = "ultrasonic"
    needs = "a drive at the carrier's rate (V), the vibration sensed (m), or open loop"

    def plant(self, scene: Scene, seed: int) -> UltrasonicSurface:
        """Return the simulated surface, with the scene's overrides and finger."""
        _, parameters = _read(scene)
        nominal = typical_load(scene), typical_speed(scene, parameters.least_speed)
        return UltrasonicSurface(parameters, amplitude_loop(parameters), scene.finger, seed, nominal)

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """Return a device at the carrier's rate as a driver of friction; see `ResonantDriver`."""
        _, parameters = _read(scene)
        nominal = typical_load(scene), typical_speed(scene, parameters.least_speed)
        return ResonantDriver(driver, parameters, scene.finger, nominal)

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """Return what the controller may know of the surface behind `driver`.

        Raises
        ------
        ValueError
            The scene asks for more friction than the law can add to the bias or take from it.
        """
        for name, value, known in (("drive", driver.drive_channels, (1,)), ("sensed", driver.sensed_channels, (0, 1))):
            if value not in known:
                raise ValueError(f"driver.{name}_channels = {value}: must be {' or '.join(map(str, known))}")
        _, parameters = _read(scene)
        model = self._model(scene, parameters, driver)
        whole = parameters.friction_coefficient * typical_load(scene)
        room = whole * min(1.0 - parameters.bias, parameters.bias - parameters.friction_law.numbers.floor)
        need = self.needed(scene, model)
        if need > room:
            raise ValueError(
                f"texture.amplitude asks for {need:.3g} N of friction: must be <= {room:.3g} N, what amplitude can "
                f"change around {parameters.bias:g} of the friction of a finger of {typical_load(scene):.3g} N"
            )
        if driver.sensed_channels and parameters.sensor == "tribometer":
            self.check_range(scene, model, parameters, parameters.friction_coefficient * largest_load(scene))
        _check_amplitude(parameters, need / whole, typical_load(scene), typical_speed(scene, parameters.least_speed))
        return replace(model, drive_limit=room)

    def bands(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene, refused where the amplitude could not follow."""
        bands = super().bands(scene, model)
        if bands.frequency.max(initial=0.0) > model.highest_frequency:
            raise ValueError(
                f"texture.frequency = {bands.frequency.max():g}: must be <= {model.highest_frequency:g} Hz, "
                "which the amplitude can follow"
            )
        return bands

    def sensor_response(self, scene: Scene, frequency: Array) -> Array:
        """Return what the tribometer shows of friction, or what the sensed amplitude says of it before it lags."""
        _, parameters = _read(scene)
        return parameters.sensor_response(frequency, typical_speed(scene, parameters.least_speed))

    def _model(self, scene: Scene, parameters: SurfaceParameters, driver: Driver) -> BandModel:
        """Band model without its drive limit: what carries the amplitude along takes half a sample more than a hold."""
        listening, late = driver.sensed_channels > 0, 0.5 / driver.rate
        model = self.contact(
            scene,
            parameters,
            rate=driver.rate,
            delay=driver.delay,
            block=driver.block,
            friction_per_drive=1.0,
            listening=listening,
        )
        if listening and parameters.sensor == "amplitude":  # no contact and no tribometer between
            return replace(
                model,
                mass=late**2 / 2 * np.eye(1),
                damping=late * np.eye(1),
                stiffness=np.eye(1),
                memory=0.0,
                late=0.0,
                foresight=parameters.memory_length,
                sensed_noise=LEAST_NOISE * model.sensed_limit,
            )
        mass = model.mass + late * model.damping + late**2 / 2 * model.stiffness
        return replace(model, mass=mass, damping=model.damping + late * model.stiffness)


def _check_amplitude(parameters: SurfaceParameters, swing: float, load: float, speed: float) -> None:
    """Refuse a `swing` of the friction (1) around the bias for which the drive is too weak, however slow it is."""
    least = max(parameters.bias - swing, parameters.least_ratio)
    amplitude = float(parameters.friction_law.amplitude(least, load, speed))
    mode = parameters.mode
    volts = mode.drive_for(amplitude, normal_load=load)
    if volts > mode.drive_limit:
        raise ValueError(
            f"texture.amplitude asks for a vibration of {amplitude:.3g} m, which takes {volts:.3g} V under "
            f"{load:.3g} N: must be <= {mode.drive_limit:g} V"
        )


def _read(scene: Scene) -> tuple[FrictionSettings, SurfaceParameters]:
    settings, rest = FrictionSettings.split(scene.plant)
    return settings, SurfaceParameters.with_overrides(rest, settings.names())
