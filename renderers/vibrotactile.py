"""Vibrotactile plate: turns a scene into bands, the plate's device model, and the simulated plate.

The target quantity is the normal displacement (m) of the glass, the same all along it or growing from end to end; the
drive is the current of each coil (A).  Any plate with one or two coils is described by its parameters, as `hapticrender
identify` finds them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from hapticrender.bands import Bands
from hapticrender.checks import require
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.probe import probe_plate
from hapticrender.control.supervisor import governed
from hapticrender.driver_checks import check_channels
from hapticrender.plants.plate import EXPECTED_BENDING, Plate, PlateParameters
from hapticrender.protocols import Driver
from hapticrender.renderers.base import BaseRenderer, Settings, check_limits, read_tables
from hapticrender.renderers.limits import check_carriers, check_path, check_targets, demand, perceptible
from hapticrender.touch.scene import Scene

STEEPEST = 1.0  # change of the amplitude from the middle to an end
LEVEL = ("degrees_of_freedom", "finger_dynamics")  # how finely a plate is modelled


@dataclass(frozen=True)
class PlateSetup:
    """A scene, its settings, the plate that its controller assumes, and the plate that is simulated."""

    scene: Scene
    settings: Settings
    assumed: PlateParameters
    simulated: PlateParameters


class VibrotactileRenderer(BaseRenderer):
    """Renderer for plates on one or two coils, like that of Grigorii et al. 2021."""

    name = "vt-plate"
    needs = "1 or 2 coils (A), 2 displacement sensors at the plate's ends (m)"

    def read(self, scene: Scene, driver: Driver | None) -> PlateSetup:
        """Read the tables of a scene."""
        setup = PlateSetup(scene, *read_tables(scene, PlateParameters, Settings, LEVEL))
        check_limits(scene.device_profile.limits, setup.assumed.current_limit, "A", setup.assumed.sensor_range / 2)
        return setup

    def plant(self, setup: PlateSetup, seed: int) -> Plate:
        """Return the simulated plate with the scene's finger on it."""
        coils, assumed = setup.simulated.coils, setup.assumed.coils
        require(coils == assumed, "simulation.coils", coils, f"{assumed}, as in [device]")
        check_path(setup.scene, setup.simulated.glass_length / 2)
        return Plate(setup.simulated, setup.scene.finger, seed)

    def probe(self, setup: PlateSetup, model: DeviceModel, driver: Driver) -> Callable[[Driver], None] | None:
        """Return what probes the wiring of two coils and two sensors, unless the scene says no."""
        whole = setup.assumed.coils == driver.sensed_channels == 2
        return partial(probe_plate, model=model) if setup.settings.probe and whole else None

    def board_law(self, setup: PlateSetup) -> str:
        """Return the law of boards that plays it."""
        return "plate"

    def device_model(self, setup: PlateSetup, driver: Driver) -> DeviceModel:
        """Return the device model of the plate behind `driver`."""
        assumed, coils = setup.assumed, setup.assumed.coils
        other = {1: 2, 2: 1}[coils]
        meaning = f"one a coil; of a plate with {other}: [device] coils = {other}"
        check_channels(driver, {coils: meaning}, {2: "one an end", 0: "open loop"})
        plate = getattr(driver, "plant", None)
        own = isinstance(plate, Plate) and plate.parameters is setup.simulated
        # that of a simulated plate may differ from what is assumed; a driver may state less than was identified
        delay = assumed.delay if own else max(assumed.delay + getattr(driver, "host_delay", 0), driver.delay)
        model = replace(assumed.device_model(driver.rate, delay), block=driver.block)
        if gradient := setup.scene.gradient:  # of an amplitude 1 + gradient x: displacement at x is x_c + (x/a) a theta
            require(coils > 1, "gradient", gradient, "0 1/m: a plate with one coil moves as a whole")
            steepest = 2 * STEEPEST / assumed.glass_length
            bound = f"<= {steepest:g} 1/m, where the amplitude at one end of the plate is 0"
            require(abs(gradient) <= steepest, "gradient", gradient, bound)
            model = replace(model, shape=(1.0, gradient * assumed.half_spacing))
        stated = "bending_frequency" in setup.scene.profile  # 0 as well: identified, and no mode found
        if model.rigid and not stated and not isinstance(plate, Plate):
            return replace(model, bending=EXPECTED_BENDING, rigid=False)
        return model

    def bands(self, setup: PlateSetup, model: DeviceModel) -> Bands:
        """Carriers and targets of a scene, refused where they pass Nyquist or the current limit."""
        scene = setup.scene
        bands = perceptible(scene, scene.texture.bands(model.rate), model)
        check_carriers(scene, model, bands)
        if len(bands) or bands.envelope is None:  # of a hybrid's none may be the plate's
            check_targets(scene, model, bands, scene.texture.waveform)
        return bands

    def limited(self, setup: PlateSetup, model: DeviceModel, bands: Bands) -> DeviceModel:
        """Return the device model with the scene's demand, its drive limited to what the scene needs."""
        if not len(bands) and bands.envelope is not None:
            return model
        return governed(model, demand(setup.scene, model, bands, setup.scene.texture.waveform))
