"""Vibrotactile plate: turns a scene into bands, the plate's band model, and the plate itself.

The target quantity is the normal displacement (m) of the glass, the same all
along it or growing from end to end; drive is the current of each coil (A).
Any plate with one coil or two is told by its parameters, as `hapticrender
identify` finds them.
"""

from __future__ import annotations

from dataclasses import replace

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.vibrotactile import EXPECTED_BENDING, Plate, PlateParameters
from hapticrender.protocols import Driver
from hapticrender.renderers.base import BaseRenderer
from hapticrender.renderers.limits import check_carriers, check_path, check_targets, felt
from hapticrender.touch.scene import Scene

STEEPEST = 1.0  # change of the amplitude from the middle to an end


class VibrotactileRenderer(BaseRenderer):
    """Renderer for plates on one or two coils, like that of Grigorii et al. 2021."""

    name = "vt-plate"
    needs = "1 or 2 coils (A), 2 displacement sensors at the plate's ends (m)"

    def plant(self, scene: Scene, seed: int) -> Plate:
        """Return the simulated plate, with the scene's overrides and finger."""
        parameters = PlateParameters.with_overrides(scene.plant)
        half = parameters.glass_length / 2
        check_path(scene, half, "glass")
        return Plate(parameters, scene.finger, seed)

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """Return what the controller may know of the plate behind `driver`."""
        parameters = PlateParameters.with_overrides(scene.plant)
        if driver.drive_channels != parameters.coils:
            raise ValueError(
                f"driver.drive_channels = {driver.drive_channels}: must be {parameters.coils} (one a coil)"
            )
        if driver.sensed_channels not in (0, 2):
            raise ValueError(
                f"driver.sensed_channels = {driver.sensed_channels}: must be 2 (one an end) or 0 (open loop)"
            )
        model = replace(parameters.band_model(driver.rate, driver.delay), block=driver.block)
        if scene.gradient:
            model = replace(model, shape=_pattern(scene, parameters))
        if model.rigid and not isinstance(getattr(driver, "plant", None), Plate):
            return replace(model, bending=EXPECTED_BENDING, rigid=False)  # only a model of a plate is rigid
        return model

    def bands(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene, refused where they pass Nyquist or the current limit."""
        bands = felt(scene, scene.texture.bands(model.rate), model)
        check_carriers(scene, model, bands)
        check_targets(scene, model, bands, scene.texture.waveform)
        return bands


def _pattern(scene: Scene, parameters: PlateParameters) -> tuple[float, float]:
    """Heave and rocking of an amplitude 1 + gradient x: displacement at x is x_c + (x/a) a theta."""
    if parameters.coils == 1:
        raise ValueError(f"gradient = {scene.gradient:g} 1/m: must be 0, a plate with one coil moves as a whole")
    reach = abs(scene.gradient) * parameters.glass_length / 2
    if reach > STEEPEST:
        raise ValueError(
            f"gradient = {scene.gradient:g} 1/m: must be <= {2 * STEEPEST / parameters.glass_length:g} 1/m, "
            "where the amplitude at one end of the plate comes to nothing"
        )
    return 1.0, scene.gradient * parameters.half_spacing
