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

from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.surface import SurfaceParameters, UltrasonicSurface
from hapticrender.protocols import Array, Driver
from hapticrender.renderers.friction import FrictionRenderer, FrictionSettings, typical_load, typical_speed
from hapticrender.renderers.resonant import ResonantDriver, amplitude_loop
from hapticrender.touch.scene import Scene


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
        return replace(model, drive_limit=room)

    def sensor_response(self, scene: Scene, frequency: Array) -> Array:
        """Return what the tribometer shows of friction, or what the sensed amplitude says of it before it lags."""
        _, parameters = _read(scene)
        return parameters.sensor_response(frequency, typical_speed(scene, parameters.least_speed))

    def _model(self, scene: Scene, parameters: SurfaceParameters, driver: Driver) -> BandModel:
        """Band model without its drive limit: what carries the amplitude along takes half a sample more than a hold."""
        model = self.contact(
            scene, parameters, rate=driver.rate, delay=driver.delay, block=driver.block, friction_per_drive=1.0
        )
        if parameters.sensor == "amplitude":  # no contact and no tribometer between
            late = 0.5 / driver.rate
            noise = 1e-6 * model.sensed_limit
            return replace(
                model,
                mass=late**2 / 2 * np.eye(1),
                damping=late * np.eye(1),
                stiffness=np.eye(1),
                memory=0.0,
                sensed_noise=noise,
            )
        return replace(model, damping=model.damping + 0.5 / driver.rate)


def _read(scene: Scene) -> tuple[FrictionSettings, SurfaceParameters]:
    settings, rest = FrictionSettings.split(scene.plant)
    return settings, SurfaceParameters.with_overrides(rest, settings.names())
