"""Vibrotactile plate: turns a scene into bands, the plate's band model, and the plate itself.

The target quantity is the normal displacement (m) of the glass, the same all
along it; drive is the current of each coil (A).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.plants.vibrotactile import EXPECTED_BENDING, Plate, PlateParameters
from hapticrender.protocols import Array, Driver
from hapticrender.touch.scene import Scene

NYQUIST_MARGIN = 0.45  # of the rate: above this the hold's image cannot be told from the carrier
CHECK_STEP = 1e-3  # s: resolution at which the finger's path is checked against the glass
LOOK_AHEAD = 30.0  # s of a scene that are looked at for the finger's speed and the current that a waveform needs


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
        model = PlateParameters.with_overrides(scene.plant).band_model(driver.rate, driver.delay)
        model = replace(model, block=driver.block)
        if model.rigid and not isinstance(getattr(driver, "plant", None), Plate):
            return replace(model, bending=EXPECTED_BENDING, rigid=False)  # only a model of a plate is rigid
        return model

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
        fastest = _top_speed(scene) * bands.wavenumber.max(initial=0.0)
        if fastest > highest:
            raise ValueError(
                f"texture.wavelength = {1 / bands.wavenumber.max():g} m passes at {fastest:g} Hz at the finger's "
                f"{_top_speed(scene):g} m/s: must be <= {highest:g} Hz"
            )
        if bands.envelope is None:
            _check_waveform(scene, model)
        else:
            _check_envelopes(scene, model, bands)
        return bands


def _check_path(scene: Scene, half: float) -> None:
    """Refuse a finger that leaves the glass."""
    duration = min(scene.duration, 3600.0)
    position = scene.finger.position(np.arange(0.0, duration, max(CHECK_STEP, duration / 1e6)))
    reach = np.nanmax(abs(position), initial=0.0)
    if reach > half:
        raise ValueError(f"finger.position reaches {reach:g} m: must stay within {half:g} m of the glass's middle")


def _top_speed(scene: Scene) -> float:
    """Largest speed of the finger (m/s)."""
    time = np.arange(0.0, min(scene.duration, LOOK_AHEAD), CHECK_STEP)
    speed = abs(np.diff(scene.finger.position(time))) / CHECK_STEP
    return float(np.nanmax(speed, initial=0.0))


def _check_envelopes(scene: Scene, model: BandModel, bands: Bands) -> None:
    """Refuse constant targets that the free plate cannot reach within the current limit.

    A finger-locked carrier passes every frequency up to that of the finger's top speed; the worst of them counts.
    """
    _check_range(float(abs(bands.envelope).sum()), model)
    sweep = np.minimum(_top_speed(scene) * bands.wavenumber, 1.25 * model.highest_frequency)  # faded out beyond
    top = bands.frequency + sweep
    low = np.where(bands.wavenumber > 0.0, np.minimum(model.lowest_frequency, top), top)
    passed = low + np.linspace(0.0, 1.0, 400)[:, None] * (top - low)
    need = 1.0 / common_gain(model, passed)
    current = abs(bands.envelope) * need.max(axis=0)
    if current.sum() > model.drive_limit:
        worst = int(current.argmax())
        _refuse(abs(bands.envelope[worst]), float(passed[need[:, worst].argmax(), worst]), current.sum(), model)


def _check_waveform(scene: Scene, model: BandModel) -> None:
    """Refuse a wanted waveform that the free plate cannot follow within the current limit, in the device's range."""
    time = np.arange(int(min(scene.duration, LOOK_AHEAD) * model.rate) + 2) / model.rate
    wanted = np.nan_to_num(scene.texture.waveform(time, scene.finger.position(time)))
    _check_range(float(abs(wanted).max()), model)
    frequency = np.fft.rfftfreq(len(time), 1.0 / model.rate)
    felt = (frequency >= model.lowest_frequency / 2) & (frequency <= min(model.highest_frequency, 0.4 * model.rate))
    spectrum = np.where(felt, np.fft.rfft(wanted), 0.0)
    current = abs(np.fft.irfft(spectrum / model.response(frequency).sum(axis=-1)[:, 0], len(time))).max()
    if current > model.drive_limit:
        _refuse(abs(wanted).max(), float(frequency[abs(spectrum).argmax()]), current, model)


def _check_range(amplitude: float, model: BandModel) -> None:
    """Refuse motion that the sensors cannot follow."""
    if amplitude > model.sensed_limit:
        raise ValueError(
            f"texture.amplitude = {amplitude:.3g} m: must be <= {model.sensed_limit:g} m, the sensors' range"
        )


def _refuse(amplitude: float, frequency: float, current: float, model: BandModel) -> None:
    raise ValueError(
        f"texture.amplitude = {amplitude:.3g} m at {frequency:.3g} Hz needs {current:.3g} A: "
        f"must be <= {model.drive_limit:g} A in each coil"
    )


def common_gain(model: BandModel, frequency: Array) -> Array:
    """Heave of the free plate per coil current, both driven alike (m/A, shape of `frequency`)."""
    return abs(model.response(frequency).sum(axis=-1)[..., 0])
