"""Hybrid: low bands on a vibrotactile plate, high bands by the friction of an electroadhesion screen on it.

The target quantity is the velocity of the skin (m/s), to which both add [Grigorii et al. 2021, who propose it].  The
shares of both sum to one at every frequency (docs/theory.md, "Hybrid").  Of carriers that follow the finger each bank
takes its share while the frequency goes up and down, by the fades that end its range.  A whole waveform, without
carriers, is the plate's alone.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import Validated, check_names, inside, parameter, require
from hapticrender.control.combined import CombinedBands, CombinedController, CombinedModel
from hapticrender.control.device_model import DeviceModel
from hapticrender.driver_checks import check_channels
from hapticrender.mathx import on_time, smoothstep
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.plants.hybrid import COILS, PLACES, SENSORS, HybridPlant
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Array, Driver, Method, Sensed
from hapticrender.renderers.base import BaseRenderer
from hapticrender.renderers.electroadhesion import LEVEL as SCREEN_LEVEL
from hapticrender.renderers.electroadhesion import ElectroadhesionRenderer, ElectroadhesionSettings, ScreenSetup
from hapticrender.renderers.friction import RATIO
from hapticrender.renderers.limits import perceptible
from hapticrender.renderers.shaped import Port, ShapedDriver
from hapticrender.renderers.vibrotactile import LEVEL, PlateSetup, VibrotactileRenderer
from hapticrender.touch.scene import Scene, scene_keys

BOTH = "rate"  # the parameter that plate and screen share


@dataclass(frozen=True, kw_only=True)
class HybridSettings(Validated):
    """How bands are shared out; set in a scene's [render] table beside the settings of the screen."""

    crossover: float = parameter(100.0, "Hz", least=40.0, most=400.0)  # both take half; work from 2/3 to 4/3 of it

    @property
    def start(self) -> float:
        """F (Hz): below it the screen is silent, above twice of it the plate is."""
        return self.crossover / 1.5

    def share_of_screen(self, frequency: Any) -> Any:
        """Share of a band at `frequency` (Hz) that the screen takes; the plate takes the rest."""
        return smoothstep(np.asarray(frequency, float) / self.start - 1.0)


class HybridDriver(ShapedDriver):
    """A user's driver with the square root before the screen, and the skin's velocity computed from its sensors.

    The driver takes both coils' drive (A), then the envelope of the screen's current (A, peak).  It senses both ends of
    the plate (m), then friction (N), `late` (s); or nothing.  `displacement` (2, 2) is heave (m) and tilt (rad) per
    sensor; velocity, a difference of two samples, waits for the friction.
    """

    sense = None

    def __init__(self, driver: Driver, root: Any, displacement: Array, velocity_per_force: float, late: float) -> None:
        super().__init__(driver, root)
        self._late = max(late, 0.5 / self.rate)  # s, of a velocity that is computed
        self.displacement, self.velocity_per_force = displacement, velocity_per_force
        self._waits = self._late * self.rate - 0.5  # samples, as a difference is half a sample late
        self.early = math.ceil(self._waits) + 1  # samples before those whose velocity is computed
        self._last = np.zeros((self.early, self.sensed_channels))

    def play(self, drive: Array) -> Sensed:
        """Play a block, the screen's drive as a current."""
        sensed = self.put(self.convert(drive))
        if sensed.motion is not None or not self.sensed_channels:
            return sensed
        place = np.zeros(len(sensed.sensed)) if sensed.position is None else sensed.position
        values = np.vstack([self._last, sensed.sensed])
        self._last = values[-self.early :]
        return sensed._replace(motion=self.skin(values, np.pad(place, (self.early, 0)))[self.early :])

    def skin(self, sensed: Array, position: Array) -> Array:
        """Velocity of the skin (m/s, shape (n, 1)), from the sensors, `motion_delay` late; less the first `early`."""
        self.motion_source, self.motion_delay = "sensors", self._late
        with np.errstate(invalid="ignore"):  # a faulty sensor is the controller's to flag
            glass = sensed[:, :SENSORS] @ self.displacement.T
            rates = on_time(self.rate * np.diff(glass, axis=0, prepend=glass[:1]), len(glass), -self._waits)
            skin = rates[:, 0] + np.nan_to_num(position) * rates[:, 1] + self.velocity_per_force * sensed[:, SENSORS]
        return skin[:, None]


@dataclass(frozen=True)
class HybridSetup:
    """A scene shared out: settings, the bands of both parts, and the setup of each part."""

    scene: Scene
    settings: HybridSettings
    velocity_per_force: float
    bands: CombinedBands
    plate: PlateSetup
    screen: ScreenSetup
    friction: ScreenSetup | None  # None: no band has a share of the screen


class HybridRenderer(BaseRenderer):
    """Renderer for a plate on two coils with a current-driven electroadhesion screen laminated on it."""

    name = "hybrid"
    needs = "2 coils (A), 2 displacement sensors (m), a current source on a carrier (A peak), a tribometer (N)"
    differentiated = True
    no_board = (
        "no board plays it: it takes two laws, of coils and screen, and a board has one: play it from the host "
        "(--driver 'audio:NAME?channels=1,2,3'), or its plate alone, with kind = 'vt-plate'"
    )

    def __init__(self) -> None:
        self._plate, self._screen = VibrotactileRenderer(), ElectroadhesionRenderer()

    def read(self, scene: Scene, driver: Driver | None) -> HybridSetup:
        """Read the tables of a scene and share out its bands."""
        require(not scene.gradient, "gradient", scene.gradient, "0 1/m: friction is made under the finger alone")
        settings, plate, screen = _split(scene)
        of_screen = self._screen.read(screen, driver)
        velocity_per_force = of_screen.settings.velocity_per_force
        require(velocity_per_force > 0.0, RATIO, velocity_per_force, "> 0 m/(N s): it adds velocity and friction")
        plate = replace(plate, profile={BOTH: of_screen.assumed.rate, **plate.profile})
        of_plate = self._plate.read(plate, driver)
        for name, needed in (("coils", COILS), ("delay", 1)):
            for table, device in (("device", of_plate.assumed), ("simulation", of_plate.simulated)):
                found = getattr(device, name)
                require(found == needed, f"{table}.{name}", found, f"{needed} on a hybrid")
        rate = of_screen.assumed.rate if driver is None else driver.rate
        bands = _share_out(scene, settings, of_plate.assumed, rate)
        of_plate = replace(of_plate, scene=_part(plate, bands.plate))
        friction = replace(of_screen, scene=_part(screen, bands.friction)) if len(bands.friction) else None
        return HybridSetup(scene, settings, velocity_per_force, bands, of_plate, of_screen, friction)

    def plant(self, setup: HybridSetup, seed: int) -> HybridPlant:
        """Return the simulated device with the scene's finger on it."""
        plate, own = self._plate.plant(setup.plate, seed), seed + 2**32  # noise of its own
        if setup.friction is None:
            screen = ElectroadhesionScreen(setup.screen.simulated, setup.scene.finger, own)
        else:
            screen = self._screen.plant(setup.friction, own)
        return HybridPlant(plate, screen, setup.velocity_per_force)

    def connect(self, setup: HybridSetup, driver: Driver) -> Driver:
        """Return `driver` behind the square root, with the skin's velocity computed from its sensors."""
        meaning = {SENSORS + 1: "both ends of the plate, then friction", 0: "open loop"}
        check_channels(driver, {COILS + 1: "both coils, then the screen"}, meaning)
        plate = setup.plate.assumed
        model = plate.device_model(driver.rate, driver.delay)
        lever = np.array([1.0, 1.0 / plate.half_spacing])
        displacement = lever[:, None] * model.coordinate_from_sensed
        late = setup.screen.assumed.sensor_delay  # of a later texture, where this one leaves the screen alone
        return HybridDriver(driver, self.shape(setup), displacement, setup.velocity_per_force, late)

    def probe(self, setup: HybridSetup, model: DeviceModel, driver: Driver) -> Callable[[Driver], None] | None:
        """Return what probes its plate, unless the scene says no."""
        return self._plate.probe(setup.plate, model, _part_of(driver, COILS, SENSORS, "plate"))

    def shape(self, setup: HybridSetup) -> Any:
        """Return the square root for the screen's share of the scene."""
        return None if setup.friction is None else setup.friction.compensation

    def modelled(
        self, scene: Scene, setup: HybridSetup, driver: Driver, **changes: Any
    ) -> tuple[CombinedModel, CombinedBands]:
        """Return device models and bands of both parts; what is judged is a velocity, which no sensor shows."""
        port, start, friction = _part_of(driver, COILS, SENSORS, "plate"), setup.settings.start, None
        moving = bool((setup.bands.wavenumber > 0.0).any())  # fixed carriers keep their share
        low: dict[str, Any] = {"highest_frequency": start, "highest_edge": 2.0} if moving else {}
        high = {"lowest_frequency": 2 * start} if moving else {}
        plate, of_plate = self._plate.modelled(setup.plate.scene, setup.plate, port, **low)
        bands = replace(setup.bands, plate=of_plate)
        if setup.friction is not None:
            port = _part_of(driver, 1, 1, "screen")
            friction, of_friction = self._screen.modelled(setup.friction.scene, setup.friction, port, **high)
            bands = replace(bands, friction=of_friction)
        of_both: dict[str, Any] = {
            "places": PLACES,
            "shown": np.zeros((len(PLACES), SENSORS + 1)),
            "lever_per_metre": 0.0,
            "drive_limit": np.inf,
            "sensed_limit": np.inf,
            "highest_frequency": (friction or plate).highest_frequency,
            "unit": "m/s",
            "drive_unit": "A, A, N",
        }
        own: dict[str, Any] = {"plate": plate, "friction": friction, "velocity_per_force": setup.velocity_per_force}
        return CombinedModel(**vars(plate) | of_both | own | changes), bands

    def design(self, method: Method, model: DeviceModel, bands: Bands, *, feedback: bool = True) -> CombinedController:
        """Return two controllers of `method`, one a part, as one."""
        return CombinedController(method, model, bands, feedback=feedback)  # type: ignore[arg-type]


def _part_of(driver: Driver, drive: int, sensed: int, name: str) -> Driver:
    """Numbers of a driver as one part of the device has them."""
    plant = getattr(getattr(driver, "plant", None), name, None)
    return Port(driver.rate, driver.delay, driver.block, drive, sensed if driver.sensed_channels else 0, plant)  # type: ignore[return-value]


def _part(scene: Scene, bands: Bands) -> Scene:
    """Scene of one part of the device; bands below the threshold have been left out already."""
    share: Any = SimpleNamespace(bands=lambda rate: bands, waveform=scene.texture.waveform)  # whole, as a waveform
    return replace(scene, texture=share, keep_unfelt=True)


def _share_out(scene: Scene, settings: HybridSettings, plate: PlateParameters, rate: float) -> CombinedBands:
    """Bands of a scene, and the share of each part as displacement (m)."""
    whole = perceptible(scene, scene.texture.bands(rate), plate.device_model(rate, 1))
    locked = whole.wavenumber > 0.0
    if whole.envelope is None and not locked.all():  # with carriers; without any the plate plays all of it
        raise ValueError("texture: a recording over time on carriers is not supported on a hybrid: leave out carriers")
    high = settings.share_of_screen(whole.frequency)
    parts: dict[str, Any] = {}
    for name, own in (("plate", 1.0 - high), ("friction", high)):
        share = np.where(locked, 1.0, own)  # locked: the fades of the banks share
        index = parts[f"{name}_index"] = np.flatnonzero(share > 0.0)
        envelope = None if whole.envelope is None else share * whole.envelope
        parts[name] = replace(whole, envelope=envelope).select(index, unfelt=())
    return CombinedBands(**vars(whole), **parts)


def _split(scene: Scene) -> tuple[HybridSettings, Scene, Scene]:
    """Settings of the hybrid, and the scene with the tables of the plate, and of the screen."""
    own, of_screen = HybridSettings.names(), ElectroadhesionSettings.names()
    with inside("render"):
        check_names(scene.rendering, own | of_screen, scene_keys("render"))
        chosen: dict[str, Any] = {key: value for key, value in scene.rendering.items() if key in own}
        settings = HybridSettings(**chosen)
    rendering = {key: value for key, value in scene.rendering.items() if key not in own}
    plate: dict[str, Any] = {"rendering": {key: value for key, value in rendering.items() if key == "probe"}}
    screen: dict[str, Any] = {"rendering": rendering, "limits": {}}  # which are the plate's
    moved = dict.fromkeys(own | of_screen | scene_keys("render"), "render")
    in_device = moved | dict.fromkeys({*LEVEL, *SCREEN_LEVEL} | scene_keys("simulation"), "simulation")
    in_simulation = moved | dict.fromkeys({BOTH} | scene_keys("device"), "device")
    for field, table, others in (("profile", "device", in_device), ("simulation", "simulation", in_simulation)):
        with inside(table):
            plate[field], screen[field] = _split_table(getattr(scene, field), others)
    return settings, replace(scene, **plate), replace(scene, **screen)


def _split_table(values: Mapping[str, Any], others: Mapping[str, str]) -> list[dict[str, Any]]:
    """Parameters of the plate and of the screen; `others` are keys that belong in another table, by its name.

    A parameter that both have has `plate_` or `screen_` before its name, but for the rate that they share.
    """
    plate, screen = PlateParameters.names(), ElectroadhesionParameters.names()
    double = plate & screen - {BOTH}
    known = [
        {prefix + name if name in double else name: name for name in names}
        for prefix, names in (("plate_", plate), ("screen_", screen))
    ]
    for key, value in values.items():
        if key in double:
            raise ValueError(f"{key} = {value!r}: must be plate_{key} or screen_{key}: both have one")
        if key in others:
            raise ValueError(f"{key}: belongs in [{others[key]}]")
    check_names(values, (known[0] | known[1]).keys() - others.keys())
    return [{names[key]: value for key, value in values.items() if key in names} for names in known]
