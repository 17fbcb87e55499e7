"""Vibrotactile plate: turns a scene into bands, the plate's band model, and the plate itself.

The target quantity is the normal displacement (m) of the glass, the same all
along it; drive is the current of each coil (A).
"""

from __future__ import annotations

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.vibrotactile import Plate, PlateParameters
from hapticrender.protocols import Array, Driver
from hapticrender.touch.scene import Scene

NYQUIST_MARGIN = 0.45  # of the rate: above this the hold's image cannot be told from the carrier
CHECK_STEP = 1e-3  # s: resolution at which the finger's path is checked against the glass


class VibrotactileRenderer:
    """Renderer for the two-coil plate of Grigorii et al. 2021."""

    name = "vt-plate"

    def plant(self, scene: Scene, seed: int) -> Plate:
        """Return the simulated plate, with the scene's overrides and finger."""
        parameters = PlateParameters.with_overrides(scene.plant)
        half = parameters.glass_length / 2
        _check_path(scene, half)
        return Plate(parameters, scene.finger, seed)

    def band_model(self, scene: Scene, driver: Driver) -> BandModel:
        """Return what the controller may know of the plate behind `driver`."""
        if driver.drive_channels != 2:
            raise ValueError(f"driver.drive_channels = {driver.drive_channels}: must be 2 (one a coil)")
        if driver.sensed_channels not in (0, 2):
            raise ValueError(
                f"driver.sensed_channels = {driver.sensed_channels}: must be 2 (one an end) or 0 (open loop)"
            )
        return PlateParameters.with_overrides(scene.plant).band_model(driver.rate, driver.delay)

    def bands(self, scene: Scene, model: BandModel) -> Bands:
        """Carriers and targets of a scene, refused where they pass Nyquist or the current limit."""
        bands = scene.texture.bands(model.rate)
        highest = NYQUIST_MARGIN * model.rate
        for frequency in bands.frequency:
            if not 0.0 <= frequency <= highest:
                raise ValueError(
                    f"texture.frequency = {frequency:g}: must be <= {highest:g} Hz, "
                    f"{NYQUIST_MARGIN} of the rate of {model.rate:g} Hz"
                )
        if bands.envelope is not None:
            _check_current(scene, model, bands)
        return bands


def _check_path(scene: Scene, half: float) -> None:
    """Refuse a finger that leaves the glass."""
    duration = min(scene.duration, 3600.0)
    position = scene.finger.position(np.arange(0.0, duration, max(CHECK_STEP, duration / 1e6)))
    reach = np.nanmax(abs(position), initial=0.0)
    if reach > half:
        raise ValueError(f"finger.position reaches {reach:g} m: must stay within {half:g} m of the glass's middle")


def _speed_range(scene: Scene) -> float:
    """Largest speed of the finger (m/s), away from jumps."""
    time = np.arange(0.0, min(scene.duration, 60.0), CHECK_STEP)
    speed = abs(np.diff(scene.finger.position(time))) / CHECK_STEP
    return float(np.nanmax(speed, initial=0.0))


def _check_current(scene: Scene, model: BandModel, bands: Bands) -> None:
    """Refuse targets that the free plate cannot reach within the current limit."""
    speed = _speed_range(scene)
    frequency = np.minimum(bands.frequency + speed * bands.wavenumber, model.highest_frequency)
    current = abs(bands.envelope) / common_gain(model, frequency)
    if current.sum() > model.drive_limit:
        worst = int(current.argmax())
        raise ValueError(
            f"texture.amplitude = {abs(bands.envelope[worst]):g} m at {frequency[worst]:g} Hz "
            f"needs {current.sum():.3g} A: must be <= {model.drive_limit:g} A in each coil"
        )


def common_gain(model: BandModel, frequency: Array) -> Array:
    """Heave of the free plate per coil current, both driven alike (m/A, shape of `frequency`)."""
    return abs(model.response(frequency).sum(axis=-1)[..., 0])
