"""Hybrid: low bands move the finger, on a vibrotactile plate; high bands rub it, by the friction of a screen on it.

The target quantity is the velocity of the skin (m/s), to which both add [Grigorii et al. 2021, who propose it].  Both
parts take a share of every band, and the shares sum to one at every frequency: the screen's is

    s(f) = e(f/F - 1),   e(x) = x^2 (3 - 2 x) from 0 to 1,

0 below F and 1 above 2 F, half at the crossover 1.5 F, and the plate's is 1 - s.  Of carriers that follow the finger
each bank takes its share while the frequency goes up and down, by the fades that end its range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.control.together import TogetherController, TwoBands, TwoModels, design_together
from hapticrender.plants.bounds import Validated, check_names, number
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen
from hapticrender.plants.hybrid import PLACES, HybridPlant
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array, Driver, Method, Sensed, Texture
from hapticrender.renderers.base import BaseRenderer
from hapticrender.renderers.electroadhesion import ElectroadhesionRenderer
from hapticrender.renderers.friction import FrictionSettings
from hapticrender.renderers.limits import check_carriers, felt
from hapticrender.renderers.vibrotactile import VibrotactileRenderer
from hapticrender.touch.scene import Scene

BOTH = "rate"  # the parameter that plate and screen share
COILS = SENSORS = 2  # channels of the plate, which come first


@dataclass(frozen=True, kw_only=True)
class HybridSettings(Validated):
    """How bands are shared out; set in a scene's `plant` table beside the parameters of both devices.

    Parameters
    ----------
    crossover : float, Hz
        Where plate and screen take half of a band each, 40 to 400; both work from 2/3 to 4/3 of it.
    """

    crossover: float = number(100.0, "Hz", least=40.0, most=400.0)

    @property
    def start(self) -> float:
        """F (Hz): below it the screen is silent, above twice of it the plate is."""
        return self.crossover / 1.5

    def share_of_screen(self, frequency: Any) -> Any:
        """Share of a band at `frequency` (Hz) that the screen takes; the plate takes the rest."""
        x = np.clip(np.asarray(frequency, float) / self.start - 1.0, 0.0, 1.0)
        return x * x * (3.0 - 2.0 * x)


@dataclass(frozen=True)
class Shared:
    """The share of a texture that one part of the device takes."""

    own: Bands
    texture: Texture

    def bands(self, rate: float) -> Bands:
        """Carriers and envelopes of the share (`rate` in Hz is not needed)."""
        return self.own

    def waveform(self, time: Array, position: Array) -> Array:
        """Waveform of the whole texture (m)."""
        return self.texture.waveform(time, position)


class _View:
    """A driver as one part of the device sees it."""

    def __init__(self, driver: Driver, drive: int, sensed: int, part: str) -> None:
        self.rate, self.delay, self.block = driver.rate, driver.delay, driver.block
        self.drive_channels, self.sensed_channels = drive, sensed if driver.sensed_channels else 0
        self.plant = getattr(getattr(driver, "plant", None), part, None)


class HybridDriver:
    """A user's driver with the square root before the screen, which tells what the sensors say of the skin's velocity.

    Parameters
    ----------
    driver : Driver
        Drive: both coils (A), then the envelope of the screen's current (A, peak).  Sensed: both ends of the plate (m),
        then friction (N); or nothing.
    shape : callable
        The screen's drive from that of the controller.
    displacement : ndarray, shape (2, 2)
        Heave (m) and tilt (rad) of the plate per sensor.
    velocity_per_force : float, m/(N s)
        Skin velocity that feels as strong as a newton of friction.

    Notes
    -----
    Velocity is the difference to the sample before, half a sample late.
    """

    def __init__(self, driver: Driver, shape: Any, displacement: Array, velocity_per_force: float) -> None:
        self.driver, self.shape = driver, shape
        self.rate, self.block, self.delay = driver.rate, driver.block, driver.delay
        self.drive_channels, self.sensed_channels = driver.drive_channels, driver.sensed_channels
        self.displacement, self.velocity_per_force = displacement, velocity_per_force
        self._last = np.zeros(2)

    def __enter__(self) -> HybridDriver:
        self.driver.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.driver.__exit__(*exc)

    def play(self, drive: Array) -> Sensed:
        """Play a block, the screen's drive as a current."""
        drive = np.array(drive, float)
        drive[:, COILS] = self.shape(drive[:, COILS])
        sensed = self.driver.play(drive)
        if sensed.motion is not None or not self.sensed_channels:
            return sensed
        with np.errstate(invalid="ignore"):  # a sensor gone mad is the controller's to judge
            values = np.asarray(sensed.sensed, float)
            glass = values[:, :SENSORS] @ self.displacement.T
            rates = self.rate * np.diff(glass, axis=0, prepend=self._last[None])
            self._last = glass[-1]
            place = np.zeros(len(glass)) if sensed.position is None else np.nan_to_num(sensed.position)
            skin = rates[:, 0] + place * rates[:, 1] + self.velocity_per_force * values[:, SENSORS]
        return sensed._replace(motion=skin[:, None])


class HybridRenderer(BaseRenderer):
    """Renderer for a plate on two coils with a current-driven electroadhesion screen laminated on it."""

    name = "hybrid"
    needs = "2 coils (A), 2 displacement sensors (m), a current source on a carrier (A peak), a tribometer (N)"

    def __init__(self) -> None:
        self._plate, self._screen = VibrotactileRenderer(), ElectroadhesionRenderer()

    def plant(self, scene: Scene, seed: int) -> HybridPlant:
        """Return the simulated device, with the scene's overrides and finger."""
        parts = _Parts(scene)
        plate = self._plate.plant(parts.moved, seed)
        own = seed + 2**32  # noise of its own
        if len(parts.bands.rubbed):
            screen = self._screen.plant(parts.rubbed, own)
        else:
            screen = ElectroadhesionScreen(parts.screen, scene.finger, own)
        return HybridPlant(plate, screen, parts.velocity_per_force)

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """Return `driver` behind the square root, with the skin's velocity as its sensors tell it."""
        _check_channels(driver)
        parts = _Parts(scene)
        model = parts.plate.band_model(driver.rate, driver.delay)
        lever = np.array([1.0, 1.0 / parts.plate.half_spacing])
        shape = self._screen.compensation(parts.rubbed) if len(parts.bands.rubbed) else np.zeros_like
        return HybridDriver(driver, shape, lever[:, None] * model.coordinate_from_sensed, parts.velocity_per_force)

    def band_model(self, scene: Scene, driver: Driver) -> TwoModels:
        """Return what the controllers may know of the two parts behind `driver`."""
        _check_channels(driver)
        parts = _Parts(scene)
        moved = self._plate.band_model(parts.moved, _View(driver, COILS, SENSORS, "plate"))  # type: ignore[arg-type]
        rubbed = None
        if len(parts.bands.rubbed):
            rubbed = self._screen.band_model(parts.rubbed, _View(driver, 1, 1, "screen"))  # type: ignore[arg-type]
        if rubbed is not None and (parts.bands.wavenumber > 0.0).any():  # fixed carriers have their share for good
            start = parts.settings.start
            moved = replace(moved, highest_frequency=start, highest_edge=2.0)
            rubbed = replace(rubbed, lowest_frequency=2 * start)
        return _side_by_side(moved, rubbed, parts.velocity_per_force)

    def bands(self, scene: Scene, model: BandModel) -> TwoBands:
        """Carriers and targets of a scene, shared out; refused where a part cannot do its share."""
        parts = _Parts(scene, model.rate)
        bands = parts.bands
        check_carriers(scene, model, bands)
        if not isinstance(model, TwoModels):
            raise TypeError(f"model: must be the TwoModels of band_model, not {type(model).__name__}")
        if len(bands.moved):
            bands = replace(bands, moved=self._plate.bands(parts.moved, model.moved))
        if model.rubbed is not None:
            bands = replace(bands, rubbed=self._screen.bands(parts.rubbed, model.rubbed))
        return bands

    def design(self, method: Method, model: BandModel, bands: Bands, *, feedback: bool = True) -> TogetherController:
        """Return two controllers of `method`, one a part, as one."""
        if not (isinstance(model, TwoModels) and isinstance(bands, TwoBands)):
            raise TypeError("model, bands: must be those of band_model and bands")
        return design_together(method, model, bands, feedback=feedback)


class _Parts:
    """A scene taken apart: settings, parameters of both devices, and the scene of each."""

    def __init__(self, scene: Scene, rate: float | None = None) -> None:
        if scene.gradient:
            raise ValueError(f"gradient = {scene.gradient:g} 1/m: must be 0, friction is made under the finger alone")
        own, plate, screen = _split(scene.plant)
        self.settings = HybridSettings.with_overrides(own)
        friction, of_screen = FrictionSettings.split(screen)
        self.velocity_per_force = friction.velocity_per_force
        if not self.velocity_per_force > 0.0:
            raise ValueError("plant.velocity_per_force = 0: must be > 0 m/(N s), by it velocity and friction add up")
        self.screen = ElectroadhesionParameters.with_overrides(of_screen)
        plate = {BOTH: self.screen.rate} | plate
        self.plate = PlateParameters.with_overrides(plate)
        for name, needed in (("coils", COILS), ("delay", 1)):
            found = getattr(self.plate, name)
            if found != needed:
                raise ValueError(f"plant.{name} = {found}: must be {needed} on a hybrid")
        self.bands = _share_out(scene, self.settings, self.plate, self.screen.rate if rate is None else rate)
        self.moved = _part(scene, self.bands.moved, plate)
        self.rubbed = _part(scene, self.bands.rubbed, screen)


def _part(scene: Scene, bands: Bands, plant: Mapping[str, Any]) -> Scene:
    """Scene of one part of the device; what no one can feel of the whole has been left out already."""
    return replace(scene, texture=Shared(bands, scene.texture), keep_unfelt=True, plant=plant)


def _share_out(scene: Scene, settings: HybridSettings, plate: PlateParameters, rate: float) -> TwoBands:
    """Bands of a scene, and the share of each part as displacement (m)."""
    whole = felt(scene, scene.texture.bands(rate), plate.band_model(rate, 1))
    locked = whole.wavenumber > 0.0
    if whole.envelope is None and not locked.all():
        raise ValueError(
            "texture: must be a grating, or go over position, on a hybrid: a recording over time is not shared out"
        )
    high = settings.share_of_screen(whole.frequency)
    shares = np.where(locked, 1.0, 1.0 - high), np.where(locked, 1.0, high)  # locked: the fades of the banks share
    index = [np.flatnonzero(share > 0.0) for share in shares]
    own = [
        replace(
            whole,
            frequency=whole.frequency[which],
            wavenumber=whole.wavenumber[which],
            phase=whole.phase[which],
            envelope=None if whole.envelope is None else (share * whole.envelope)[which],
            unfelt=(),
        )
        for share, which in zip(shares, index, strict=True)
    ]
    common = {each.name: getattr(whole, each.name) for each in fields(Bands)}
    return TwoBands(**common, moved=own[0], rubbed=own[1], of_moved=index[0], of_rubbed=index[1])


def _split(plant: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Settings of the hybrid, parameters of the plate and of the screen; `plate_` or `screen_` tells which is meant."""
    own, plate = HybridSettings.names(), PlateParameters.names()
    screen = FrictionSettings.names() | ElectroadhesionParameters.names()
    double = plate & screen - {BOTH}
    known = own | (plate | screen) - double | {f"{of}_{each}" for each in double for of in ("plate", "screen")}
    check_names([key for key in plant if key not in double], known)
    found: tuple[dict[str, Any], ...] = ({}, {}, {})
    for key, value in plant.items():
        if key in double:
            raise ValueError(f"plant.{key} = {value!r}: must be plate_{key} or screen_{key}: both have one")
        whose = [
            (table, name)
            for table, names, name in zip(
                found, (own, plate, screen), (key, key.removeprefix("plate_"), key.removeprefix("screen_")), strict=True
            )
            if name in names and (name == key or name in double)
        ]
        for table, name in whose:
            table[name] = value
    return found[0], found[1], found[2]


def _side_by_side(moved: BandModel, rubbed: BandModel | None, velocity_per_force: float) -> TwoModels:
    """Band model of both, block by block; what is judged is a velocity, no multiple of the coordinates."""
    parts = [moved] if rubbed is None else [moved, rubbed]

    def blocks(name: str) -> Array:
        from scipy.linalg import block_diag

        return np.asarray(block_diag(*(getattr(part, name) for part in parts)))

    names = ("mass", "damping", "stiffness", "force_from_drive", "coordinate_from_sensed", "side_from_coordinate")
    matrices = {name: blocks(name) for name in names}
    return TwoModels(
        rate=moved.rate,
        delay=moved.delay,
        block=moved.block,
        **matrices,
        place_from_coordinate=np.zeros((len(PLACES), len(matrices["mass"]))),
        places=PLACES,
        drive_limit=np.inf,
        sensed_limit=np.inf,
        lowest_frequency=moved.lowest_frequency,
        highest_frequency=moved.highest_frequency if rubbed is None else rubbed.highest_frequency,
        unit="m/s",
        drive_unit="A, A, N",
        moved=moved,
        rubbed=rubbed,
        velocity_per_force=velocity_per_force,
    )


def _check_channels(driver: Driver) -> None:
    """Refuse a driver that cannot be that of a hybrid."""
    if driver.drive_channels != COILS + 1:
        raise ValueError(f"driver.drive_channels = {driver.drive_channels}: must be 3 (both coils, then the screen)")
    if driver.sensed_channels not in (0, SENSORS + 1):
        raise ValueError(
            f"driver.sensed_channels = {driver.sensed_channels}: must be 3 (both ends of the plate, then friction) or 0"
        )
