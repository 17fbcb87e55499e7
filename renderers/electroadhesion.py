"""Electroadhesion screen: turns a scene into friction bands, the screen's band model, and the screen itself.

The target quantity is friction (N); the drive is an attraction (N) around a
bias, which the square root turns into the envelope of the current on the
carrier.  A driver of your own gets that envelope (A, peak), for an external
modulator; it senses friction (N) on a tribometer, or nothing.
"""

from __future__ import annotations

from dataclasses import replace

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.square_root import SquareRoot
from hapticrender.plants.electroadhesion import NORMAL, ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.protocols import Array, Driver
from hapticrender.renderers.friction import ROOM, FrictionRenderer, FrictionSettings, typical_load, typical_speed
from hapticrender.renderers.shaped import ShapedDriver
from hapticrender.touch.scene import Scene

FLOOR = 0.05  # of the bias: the least attraction, which rounds off the cusps of the square root
NOMINAL_GAP = 1.5e-6  # m


class ElectroadhesionRenderer(FrictionRenderer):
    """Renderer for current-driven electroadhesion screens."""

    name = "electroadhesion"
    needs = "a current source on a carrier, driven by its envelope (A peak); a tribometer (N), or open loop"

    def plant(self, scene: Scene, seed: int) -> ElectroadhesionScreen:
        """Return the simulated screen, with the scene's overrides and finger."""
        settings, parameters = _read(scene)
        naive = settings.square_root == "off" or parameters.drive_kind == "voltage"
        compensation = None if naive else self.compensation(scene)
        return ElectroadhesionScreen(parameters, scene.finger, seed, compensation)

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """Return `driver` behind the square root: it gets the current's envelope (A, peak)."""
        return ShapedDriver(driver, self.compensation(scene))

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """Return what the controller may know of the screen behind `driver`."""
        for name, value, known in (("drive", driver.drive_channels, (1,)), ("sensed", driver.sensed_channels, (0, 1))):
            if value not in known:
                raise ValueError(f"driver.{name}_channels = {value}: must be {' or '.join(map(str, known))}")
        settings, parameters = _read(scene)
        model = self._model(scene, driver.rate, driver.delay, driver.block)
        if settings.square_root == "off":
            return replace(model, drive_limit=parameters.current_limit, drive_unit="A")
        compensation = self.compensation(scene)
        return replace(model, drive_limit=compensation.bias - compensation.floor)

    def sensor_response(self, scene: Scene, frequency: Array) -> Array:
        """Return what the tribometer shows of friction, or what the gap's impedance says of it before it lags."""
        _, parameters = _read(scene)
        if parameters.sensor == "tribometer":
            return parameters.tribometer_response(frequency)
        speed = typical_speed(scene, parameters.least_speed)
        shown = parameters.friction_coefficient * parameters.sensed_response(frequency, speed)
        return shown / (parameters.friction_coefficient * parameters.lag_response(frequency, speed))

    def compensation(self, scene: Scene) -> SquareRoot:
        """Return the square root for a nominal finger under the scene's load, its bias as large as the scene needs.

        Raises
        ------
        ValueError
            The scene needs more attraction than the current source can make.
        """
        _, parameters = _read(scene)
        finger = _nominal(parameters)
        load = typical_load(scene)
        gain = finger.gain(load)
        current = min(parameters.current_limit, parameters.voltage_limit / abs(finger.impedance(load)))
        most = gain * current**2
        need = self.needed(scene, self._model(scene, parameters.rate, 1, 1))
        bias = ROOM * need / (1.0 - FLOOR)
        if bias + ROOM * need > most:
            raise ValueError(
                f"texture.amplitude asks for an attraction of {bias + ROOM * need:.3g} N: must be <= {most:.3g} N, "
                f"what {current:.3g} A make of a nominal finger of {load:.3g} N"
            )
        return SquareRoot(bias=bias, floor=FLOOR * bias, gain=gain)

    def _model(self, scene: Scene, rate: float, delay: int, block: int) -> BandModel:
        """Band model without its drive limit."""
        _, parameters = _read(scene)
        mu = parameters.friction_coefficient
        model = self.contact(scene, parameters, rate=rate, delay=delay, block=block, friction_per_drive=mu)
        if parameters.sensor == "impedance":  # what is sensed is the attraction, behind the estimator's low pass
            lag = parameters.estimator.delay
            model = replace(
                model,
                mass=lag**2 / 2 / mu * model.force_from_drive,
                damping=lag / mu * model.force_from_drive,
                coordinate_from_sensed=mu * model.coordinate_from_sensed,
                memory=0.0,
            )
        return model


def _read(scene: Scene) -> tuple[FrictionSettings, ElectroadhesionParameters]:
    settings, rest = FrictionSettings.split(scene.plant)
    return settings, ElectroadhesionParameters.with_overrides(rest)


def _nominal(parameters: ElectroadhesionParameters) -> ElectroadhesionParameters:
    """Return the screen under a finger as one must be taken to be before it is felt."""
    return replace(parameters, area_scale=1.0, gap_thickness=NOMINAL_GAP, gap_resistance=NORMAL)
