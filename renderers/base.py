"""Base of the renderers: opens a scene on a device, and reads its tables."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from hapticrender import checks
from hapticrender.bands import Bands
from hapticrender.control.device_model import DeviceModel
from hapticrender.control.methods import method_named
from hapticrender.control.supervisor import supervised
from hapticrender.driver_checks import check_driver
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.protocols import Array, Controller, Driver, Method, Plant, Rendering, Texture
from hapticrender.touch.device_profile import Limits
from hapticrender.touch.scene import Scene, scene_keys
from hapticrender.touch.touch_panel import PanelReader

Waveform = Callable[[Array, Array], Array]
Setup = Any  # what `read` returns: a class of each renderer's own


def check_limits(limits: Limits, drive: float, unit: str, sensed: float = math.inf) -> None:
    """Refuse a limit that a device of such a largest `drive` (`unit`) and `sensed` range (m) cannot pass.

    It would guard nothing, and is mostly stated in another unit.
    """
    largest = drive, unit, "the largest drive"
    sensors = sensed, "m", "the sensors' range"
    for name, (most, of, whose) in {"peak_drive": largest, "rms_drive": largest, "displacement": sensors}.items():
        if (stated := getattr(limits, name) or 0.0) > most:
            bound = f"must be <= {most:g} {of}, {whose} of the device, or left out"
            raise ValueError(f"[limits] {name} = {stated:g} {of}: {bound}")


@dataclass(frozen=True, kw_only=True)
class Settings(checks.Validated):
    """Settings of a renderer, in a scene's [render] table; `probe`: the device is probed before the loop closes."""

    probe: bool = checks.checked(checks.flag, True)


class BaseRenderer:
    """Renderer made of parts: `read` the scene once, then give its setup to every other part.

    A subclass fills in `plant`, `device_model` and `bands`.  Where it leaves `read` as it is, the setup is the scene.
    """

    name = ""
    needs = "a driver"  # of a real device of this kind, in a few words
    differentiated = False  # the target is the time derivative of `waveform`
    no_board = "no board has a law for it: play it from the host (--driver)"  # why `board_law` refuses, and what to do

    def open(self, scene: Scene, driver: Driver | None = None) -> Rendering:
        """Open a scene on the device behind `driver`, or on the simulated one; see ``protocols.Renderer``."""
        method = method_named(scene.method)
        if driver is not None:
            check_driver(driver)
            if hasattr(driver, "check_calibrated"):  # what is unknown is refused before anything is designed
                driver.check_calibrated()
        setup = self.read(scene, driver)
        if driver is None:
            plant = self.plant(setup, scene.seed)
            panel = scene.panel
            device = facing = SimulatedDriver(plant, panel and PanelReader(panel, plant.rate, scene.seed))
        else:
            plant, device, facing = None, driver, self.connect(setup, driver)
        check_driver(facing)
        model, bands = self.modelled(scene, setup, facing)
        design = partial(self.design, method, model, feedback=facing.sensed_channels > 0)
        return Rendering(
            scene=scene,
            device=device,
            driver=facing,
            plant=plant,
            model=model,
            bands=bands,
            waveform=self.waveform(setup, scene.texture),
            waveform_of=partial(self.waveform, setup),
            differentiated=self.differentiated,
            controller=partial(design, bands),
            design=design,
            shape=self.shape(setup),
            probe=self.probe(setup, model, facing) if getattr(device, "probe", True) else None,
            board_law=partial(self.board_law, setup),
        )

    def check(self, scene: Scene) -> None:
        """Refuse a method or an entry of the tables with which no texture could be played; `open` refuses the rest."""
        method_named(scene.method)
        self.read(scene, None)

    def read(self, scene: Scene, driver: Driver | None) -> Setup:
        """Return the setup: what the scene's tables say, in the form that the other parts take."""
        return scene

    def plant(self, setup: Setup, seed: int) -> Plant:
        """Return the simulated device with the scene's finger on it."""
        raise NotImplementedError

    def connect(self, setup: Setup, driver: Driver) -> Driver:
        """Return `driver` as the controller is to see it."""
        return driver

    def device_model(self, setup: Setup, driver: Driver) -> DeviceModel:
        """Return the device model of the device behind `driver`."""
        raise NotImplementedError

    def modelled(self, scene: Scene, setup: Setup, driver: Driver, **changes: Any) -> tuple[DeviceModel, Bands]:
        """Return the device model with its limits, some fields changed, and the bands; see the parts below."""
        model = replace(self.device_model(setup, driver), **changes)
        model = self.protected(scene.device_profile.limits, model)
        bands = self.bands(setup, model)
        return self.limited(setup, model, bands), bands

    def protected(self, limits: Limits, model: DeviceModel) -> DeviceModel:
        """Return the device model with the limits of the device, whose drive is that of `model`; see `check_limits`."""
        check_limits(limits, model.drive_limit, model.drive_unit, model.sensed_limit if model.unit == "m" else math.inf)
        infinite = {name: getattr(limits, name) or math.inf for name in ("peak_drive", "rms_drive", "displacement")}
        peak, step = infinite["peak_drive"], model.drive_step
        if step > 0.0 and peak < model.drive_limit:
            peak = step * math.floor(peak / step)  # what the converter rounds up would pass it
        return replace(
            model,
            drive_limit=min(model.drive_limit, peak),
            rms_limit=infinite["rms_drive"],
            rms_time=limits.rms_time,
            sensed_bound=infinite["displacement"],
        )

    def bands(self, setup: Setup, model: DeviceModel) -> Bands:
        """Carriers and targets; refuses with a ValueError what the device cannot do."""
        raise NotImplementedError

    def limited(self, setup: Setup, model: DeviceModel, bands: Bands) -> DeviceModel:
        """Return the device model with the scene's demand, where motion and drive can be supervised by it."""
        return model

    def probe(self, setup: Setup, model: DeviceModel, driver: Driver) -> Callable[[Driver], None] | None:
        """Return what probes the open device behind `driver` before the loop closes; None where nothing does.

        It is not called for a device whose `probe` is False.
        """
        return None

    def board_law(self, setup: Setup) -> str:
        """Return the law of ``drivers/firmware`` that plays the scene, "plate" or "screen"; a ValueError: none does."""
        raise ValueError(f"device.kind = {self.name!r}: {self.no_board}")

    def waveform(self, setup: Setup, texture: Texture) -> Waveform:
        """Return the target waveform of `texture` over time (s) and position (m), in the device's quantity."""
        return texture.waveform

    def shape(self, setup: Setup) -> Any:
        """Return the static characteristic that the scene needs before the device; None: none."""
        return None

    def design(self, method: Method, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> Controller:
        """Return a controller of `method` for the whole device, supervised."""
        controller = method.design(model, bands, feedback=feedback)
        return supervised(controller, model, feedback=feedback)


def read_tables(
    scene: Scene,
    device: type[checks.Validated],
    settings: type[Settings],
    level: Collection[str],
    more: Collection[str] = (),
    design: Collection[str] = (),
) -> tuple[Any, Any, Any]:
    """Settings of a renderer, and the parameters of its device as assumed by the controller and as simulated.

    Refuses a key that stands in the wrong table of a scene, or in none.  Parameters of the model `level` stand in
    [simulation] and hold for both devices; `more` are those that only some of the devices have; those of the `design`
    say nothing of a device, and stand in [device].
    """
    names = {*device.names(), *more}
    tables: dict[str, tuple[Mapping[str, Any], set[str]]] = {
        "device": (scene.profile, names - set(level)),
        "simulation": (scene.simulation, names - {"rate", *design}),
        "render": (scene.rendering, settings.names()),
    }
    for table, (values, known) in tables.items():
        for key in values:
            others = " or ".join(f"[{name}]" for name, (_, keys) in tables.items() if key in keys | scene_keys(name))
            if key not in known and others:
                raise ValueError(f"{table}.{key}: belongs in {others}")
        with checks.inside(table):
            checks.check_names(values, known, scene_keys(table))
    with checks.inside("render"):
        chosen = settings.with_overrides(scene.rendering)
    common = {key: value for key, value in scene.simulation.items() if key in level}
    try:
        assumed = device.with_overrides({**common, **scene.profile})
    except (TypeError, ValueError) as problem:
        with checks.inside("simulation" if str(problem).partition(" ")[0] in common else "device"):
            raise problem
    with checks.inside("simulation"):
        return chosen, assumed, device.with_overrides({**scene.profile, **scene.simulation})
