"""Electroadhesion screen: turns a scene into friction bands, the screen's device model, and the simulated screen.

The target quantity is friction (N); the drive is an attraction (N) around a bias, which the square root turns into the
envelope of the current on the carrier.  A driver of your own gets that envelope (A, peak), for an external modulator,
or the carrier itself; it senses friction (N) on a tribometer, the attraction (N) that `plants.gap_estimator` computes
from voltage and current, or nothing.
"""

from dataclasses import dataclass, replace
from functools import cached_property

from hapticrender.checks import option, parameter, require
from hapticrender.control.device_model import DeviceModel
from hapticrender.driver_checks import check_channels
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen, SquareRoot
from hapticrender.protocols import Driver
from hapticrender.renderers.base import read_tables
from hapticrender.renderers.friction import HEADROOM, FrictionRenderer, FrictionSettings, FrictionSetup, carrier_limit
from hapticrender.renderers.shaped import CarrierDriver, Port, ShapedDriver
from hapticrender.touch.scene import Scene

LEVEL = ("level", "oversampling")  # how finely a screen is modelled
DESIGN = ("open_loop_gain",)  # of the control alone


@dataclass(frozen=True, kw_only=True)
class ElectroadhesionSettings(FrictionSettings):
    """Settings of the drive; set in a scene's [render] table.

    `output` is what a driver of your own gets: the carrier's peak, or the carrier itself (no sensors, rate >= 4 times
    its frequency).
    """

    headroom: float = parameter(HEADROOM, least=1.0, most=100.0)  # swing of the drive over what a nominal finger needs
    floor: float = parameter(0.05, most=0.5)  # least attraction over the bias; rounds off the cusps of the square root
    output: str = option("envelope", "envelope", "carrier")


@dataclass(frozen=True)
class ScreenSetup(FrictionSetup):
    """A scene on a screen, with the square root for it."""

    settings: ElectroadhesionSettings
    assumed: ElectroadhesionParameters
    simulated: ElectroadhesionParameters

    @property
    def open_loop_gain(self) -> float:
        """Gain g (N/A^2) under a finger that is not sensed: of the profile, else of its finger under its load."""
        if "open_loop_gain" in self.scene.profile:
            return self.assumed.open_loop_gain
        return self.assumed.gain(self.load)

    @cached_property
    def compensation(self) -> SquareRoot:
        """Square root for the profile's finger under the scene's load, its bias as large as the scene needs."""
        assumed, settings, load = self.assumed, self.settings, self.load
        limit, unit = assumed.voltage_limit, "V"
        if assumed.drive_kind == "current":
            limit, unit = min(assumed.current_limit, limit / abs(assumed.impedance(load))), "A"
        limit = carrier_limit(self.scene.device_profile.limits, limit, unit)
        gain = self.open_loop_gain / assumed.gain(load) * float(assumed.attraction(1.0, load))
        most = gain * limit**2
        swing = settings.headroom * self.needed(self.model(Port(assumed.rate, 1, 1))).drive
        bias = max(swing, 1e-3) / (1.0 - settings.floor)  # N: silence, too, is above the default noise, 0.3 mN of drive
        if bias + swing > most:
            bound = f"must be <= {most:.3g} N, at {limit:.3g} {unit} under a nominal finger of {load:.3g} N"
            raise ValueError(f"texture.amplitude asks for an attraction of {bias + swing:.3g} N: {bound}")
        return SquareRoot(bias=bias, floor=settings.floor * bias, gain=gain, straight=settings.square_root == "off")

    def model(self, driver: Driver) -> DeviceModel:
        """Device model of the screen behind `driver`, without its drive limit."""
        assumed, mu = self.assumed, self.assumed.friction_coefficient
        model = self.contact(driver, mu)
        if driver.sensed_channels and assumed.sensor == "impedance":  # attraction, behind the estimator's low pass
            sensed = mu * model.coordinate_from_sensed
            return replace(self.inferred(model, assumed.sensor_delay), coordinate_from_sensed=sensed)
        return model


class ElectroadhesionRenderer(FrictionRenderer):
    """Renderer for current-driven electroadhesion screens."""

    name = "electroadhesion"
    needs = "a current source on a carrier, driven by its envelope (A peak); a tribometer (N), or open loop"

    def read(self, scene: Scene, driver: Driver | None) -> ScreenSetup:
        """Read the tables of a scene; refuses one that needs more attraction than the source can make."""
        tables = read_tables(scene, ElectroadhesionParameters, ElectroadhesionSettings, LEVEL, design=DESIGN)
        settings, assumed, simulated = tables
        name, unit = ("current_limit", "A") if assumed.drive_kind == "current" else ("voltage_limit", "V")
        most = carrier_limit(scene.device_profile.limits, getattr(assumed, name), unit)
        return ScreenSetup(scene, settings, replace(assumed, **{name: most}), simulated)

    def plant(self, setup: ScreenSetup, seed: int) -> ElectroadhesionScreen:
        """Return the simulated screen with the scene's finger on it."""
        assumed = replace(setup.assumed, open_loop_gain=setup.open_loop_gain)
        return ElectroadhesionScreen(setup.simulated, setup.scene.finger, seed, setup.compensation, assumed)

    def connect(self, setup: ScreenSetup, driver: Driver) -> Driver:
        """Return `driver` behind the square root: it gets the current's envelope (A, peak), or the carrier.

        One with the law of a screen on it has the square root, too.
        """
        if getattr(driver, "device_kind", "") == self.name:
            self.board_law(setup)
            return driver
        if setup.settings.output == "envelope":
            return ShapedDriver(driver, setup.compensation)
        carrier, rate = setup.assumed.carrier_frequency, setup.assumed.rate
        return CarrierDriver(driver, setup.compensation, frequency=carrier, envelope_rate=rate)

    def board_law(self, setup: ScreenSetup) -> str:
        """Return the law of boards that plays it, in open loop; its hardware makes the carrier."""
        for name, only in (("square_root", "on"), ("output", "envelope")):
            value = getattr(setup.settings, name)
            require(value == only, f"render.{name}", value, f"{only!r} on a board, which puts out the carrier's peak")
        return "screen"

    def shape(self, setup: ScreenSetup) -> SquareRoot:
        """Return the square root for the scene."""
        return setup.compensation

    def device_model(self, setup: ScreenSetup, driver: Driver) -> DeviceModel:
        """Return the device model of the screen behind `driver`."""
        check_channels(driver, {1: ""}, {0: "", 1: ""})
        model, assumed, compensation = setup.model(driver), setup.assumed, setup.compensation
        if driver.sensed_channels and assumed.sensor == "tribometer":
            setup.check_range(model, assumed.friction_coefficient * (setup.largest_load + compensation.bias))
        return replace(model, drive_limit=compensation.bias - compensation.floor)
