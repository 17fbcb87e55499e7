"""Electroadhesion screen: turns a scene into friction bands, the screen's band model, and the screen itself.

The target quantity is friction (N); the drive is an attraction (N) around a
bias, which the square root turns into the envelope of the current on the
carrier.  A driver of your own gets that envelope (A, peak), for an external
modulator, or the carrier itself; it senses friction (N) on a tribometer, the
attraction (N) that `control.gap` reads from voltage and current, or nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from hapticrender.control.bandmodel import BandModel
from hapticrender.control.square_root import SquareRoot
from hapticrender.plants.bounds import choice, number
from hapticrender.plants.electroadhesion import NORMAL, ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.protocols import Array, Driver
from hapticrender.renderers.friction import (
    ROOM,
    FrictionRenderer,
    FrictionSettings,
    largest_load,
    typical_load,
    typical_speed,
)
from hapticrender.renderers.shaped import CarrierDriver, ShapedDriver
from hapticrender.touch.scene import Scene

NOMINAL_GAP = 1.5e-6  # m


@dataclass(frozen=True, kw_only=True)
class ElectroadhesionSettings(FrictionSettings):
    """What a scene's `plant` table says of the drive, beside the screen's own parameters.

    Parameters
    ----------
    velocity_per_force : float, m/(N s)
        See `FrictionSettings`.
    square_root : {"on", "off"}
        Whether the envelope is the root of the wanted attraction, or goes straight with it, naively.
    headroom : float
        Swing of the drive over what a nominal finger needs, >= 1: what is more is left to the feedback.
    floor : float
        Least attraction as a share of the bias, 0 to 0.5; rounds off the cusps of the square root.
    output : {"envelope", "carrier"}
        What a driver of your own is handed: the peak of the carrier, or the carrier itself; that takes a driver
        without sensors whose rate is at least 4 times the carrier's frequency.
    """

    headroom: float = number(ROOM, least=1.0, most=100.0)
    floor: float = number(0.05, most=0.5)
    output: str = choice("envelope", "envelope", "carrier")


class ElectroadhesionRenderer(FrictionRenderer):
    """Renderer for current-driven electroadhesion screens."""

    name = "electroadhesion"
    needs = "a current source on a carrier, driven by its envelope (A peak); a tribometer (N), or open loop"

    def plant(self, scene: Scene, seed: int) -> ElectroadhesionScreen:
        """Return the simulated screen, with the scene's overrides and finger."""
        _, parameters = _read(scene)
        parameters = replace(parameters, open_loop_gain=_believed_gain(scene, parameters))
        return ElectroadhesionScreen(parameters, scene.finger, seed, self.compensation(scene))

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """Return `driver` behind the square root: it gets the current's envelope (A, peak), or the carrier."""
        settings, parameters = _read(scene)
        compensation = self.compensation(scene)
        if settings.output == "envelope":
            return ShapedDriver(driver, compensation)
        return CarrierDriver(
            driver, compensation, frequency=parameters.carrier_frequency, envelope_rate=parameters.rate
        )

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """Return what the controller may know of the screen behind `driver`."""
        for name, value, known in (("drive", driver.drive_channels, (1,)), ("sensed", driver.sensed_channels, (0, 1))):
            if value not in known:
                raise ValueError(f"driver.{name}_channels = {value}: must be {' or '.join(map(str, known))}")
        model = self._model(scene, driver.rate, driver.delay, driver.block, driver.sensed_channels > 0)
        compensation = self.compensation(scene)
        _, parameters = _read(scene)
        if driver.sensed_channels and parameters.sensor == "tribometer":
            steady = parameters.friction_coefficient * (largest_load(scene) + compensation.bias)
            self.check_range(scene, model, parameters, steady)
        return replace(model, drive_limit=compensation.bias - compensation.floor)

    def sensor_response(self, scene: Scene, frequency: Array) -> Array:
        """Return what the tribometer shows of friction, or what the gap's impedance says of it before it lags."""
        _, parameters = _read(scene)
        return parameters.sensor_response(frequency, typical_speed(scene, parameters.least_speed))

    def compensation(self, scene: Scene) -> SquareRoot:
        """Return the square root for a nominal finger under the scene's load, its bias as large as the scene needs.

        A scene that gives `open_loop_gain` is believed.

        Raises
        ------
        ValueError
            The scene needs more attraction than the source can make.
        """
        settings, parameters = _read(scene)
        finger, load = _nominal(parameters), typical_load(scene)
        limit, unit = parameters.voltage_limit, "V"
        if parameters.drive_kind == "current":
            limit, unit = min(parameters.current_limit, limit / abs(finger.impedance(load))), "A"
        gain = _believed_gain(scene, parameters) / finger.gain(load) * float(finger.attraction(1.0, load))
        most = gain * limit**2
        swing = settings.headroom * self.needed(scene, self._model(scene, parameters.rate, 1, 1))
        bias = swing / (1.0 - settings.floor)
        if bias + swing > most:
            raise ValueError(
                f"texture.amplitude asks for an attraction of {bias + swing:.3g} N: must be <= {most:.3g} N, "
                f"what {limit:.3g} {unit} make of a nominal finger of {load:.3g} N"
            )
        return SquareRoot(
            bias=bias,
            floor=settings.floor * bias,
            gain=gain,
            straight=settings.square_root == "off",
        )

    def _model(self, scene: Scene, rate: float, delay: int, block: int, listening: bool = True) -> BandModel:
        """Band model without its drive limit."""
        _, parameters = _read(scene)
        mu = parameters.friction_coefficient
        model = self.contact(
            scene, parameters, rate=rate, delay=delay, block=block, friction_per_drive=mu, listening=listening
        )
        if (
            listening and parameters.sensor == "impedance"
        ):  # what is sensed is the attraction, behind the estimator's low pass
            lag = parameters.estimator.delay
            model = replace(
                model,
                mass=lag**2 / 2 / mu * model.force_from_drive,
                damping=lag / mu * model.force_from_drive,
                coordinate_from_sensed=mu * model.coordinate_from_sensed,
                memory=0.0,
                late=lag,
                foresight=parameters.memory_length,
            )
        return model


def _read(scene: Scene) -> tuple[ElectroadhesionSettings, ElectroadhesionParameters]:
    settings, rest = ElectroadhesionSettings.split(scene.plant)
    return settings, ElectroadhesionParameters.with_overrides(rest, settings.names())  # type: ignore[return-value]


def _nominal(parameters: ElectroadhesionParameters) -> ElectroadhesionParameters:
    """Return the screen under a finger as one must be taken to be before it is felt."""
    return replace(parameters, area_scale=1.0, gap_thickness=NOMINAL_GAP, gap_resistance=NORMAL)


def _believed_gain(scene: Scene, parameters: ElectroadhesionParameters) -> float:
    """Return g (N/A^2) of a finger that is not sensed: as the scene says, else of a nominal one under its load."""
    if "open_loop_gain" in scene.plant:
        return parameters.open_loop_gain
    return _nominal(parameters).gain(typical_load(scene))
