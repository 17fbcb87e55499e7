"""The least model: its bound against the plate played twice, each option taken and refused, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import hapticrender as hr
from hapticrender import cli
from hapticrender.fidelity import fidelity
from hapticrender.fidelity_plate import OPTIONS, bound
from hapticrender.judge import LARGEST_INFLATION, fit
from hapticrender.plants.vibrotactile import Plate, PlateParameters

AMPLITUDE = 10e-6  # m


def temporal(finger, *frequencies, amplitude=AMPLITUDE, **more):
    partials = tuple((f / frequencies[0], 1.0, 0.3 * f) for f in frequencies)
    texture = hr.Grating(amplitude=amplitude, frequency=frequencies[0], partials=partials)
    return hr.Scene(texture=texture, finger=finger, duration=4.0, **more)


def spatial(finger, wavelength=1e-3):
    return hr.Scene(texture=hr.Grating(amplitude=AMPLITUDE, wavelength=wavelength), finger=finger, duration=4.0)


def reduced(scene, *names):
    """The scene with these options, "finger order 0" and the like, taken."""
    for name in names:
        (option,) = [each for each in OPTIONS if f"{each.name} {each.value}" == name]
        scene = option.reduced(scene)
        assert isinstance(scene, hr.Scene)
    return scene


def drive_of(scene, bands, time, position):
    """Current (A, (n, 2)) that makes the target on the rigid model of `scene`, were the finger at rest everywhere."""
    plate = PlateParameters.with_overrides(scene.plant)
    at, _, grip = scene.finger.touch(time).T
    at = np.nan_to_num(at)
    velocity = np.gradient(np.nan_to_num(position), time)
    force = np.zeros((len(time), 2))
    phase = bands.carrier_phase(time, position)
    for k, frequency in enumerate(bands.instantaneous_frequency(velocity).T):
        size = np.maximum(abs(frequency), 1e-3)
        known, back = np.unique(size.round(9), return_inverse=True)
        stiffness = plate.dynamic_stiffness(known)[back][:, :, 0]
        if plate.finger_dynamics:
            felt = (2j * np.pi * known * scene.finger.mechanics.impedance(known))[back] * grip
            stiffness = stiffness + felt[:, None] * np.stack([np.ones_like(at), at / plate.half_spacing], axis=1)
        stiffness = np.where(frequency[:, None] < 0, stiffness.conj(), stiffness)
        force += (stiffness * (bands.envelope[k] * np.exp(1j * phase[:, k]))[:, None]).real
    if plate.degrees_of_freedom == 1:
        force[:, 1] = 0.0
    return force @ np.linalg.inv(plate.force_from_drive).T


def played(scene, drive):
    """True motion (m, (n, 3)) of the scene's plate under `drive`, which no electronics limit."""
    plate = replace(
        PlateParameters.with_overrides(scene.plant), current_limit=1e3, current_bits=0, sensor_noise=0.0, sensor_bits=0
    )
    return Plate(plate, scene.finger).run(drive).motion


def true_error(scene, lesser, rate=5000.0):
    """Largest relative envelope of the difference of both plates in windows of max(20 ms, 2/f) after settling."""
    time = np.arange(int(scene.duration * rate)) / rate
    position, bands = scene.finger.position(time), scene.texture.bands(rate)
    drive = drive_of(lesser, bands, time, position)
    apart = played(scene, drive) - played(lesser, drive)
    velocity = np.gradient(np.nan_to_num(position), time)
    frequency = abs(bands.instantaneous_frequency(velocity))
    begin = time >= scene.settle
    slow = frequency[begin & (frequency.min(axis=1) >= 20.0)].min()
    spacing = np.diff(np.sort(frequency[begin], axis=1), axis=1).min() if len(bands) > 1 else np.inf
    size = int(rate * max(0.02, 2 / slow, 2 / spacing))
    start = np.arange(int(scene.settle * rate), len(time) - size + 1, size // 8)
    index = start[:, None] + np.arange(size)
    envelope, inflation, _ = fit(bands.carrier_phase(time, position)[index], apart[index])
    read = (inflation <= LARGEST_INFLATION) & (frequency[index].min(axis=1) >= 20.0)
    assert read.any()
    return (abs(envelope) / abs(bands.envelope)).transpose(0, 2, 1)[read].max()
