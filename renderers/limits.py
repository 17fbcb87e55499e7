"""Limits common to all devices: of carriers by the rate, of targets by drive and sensors, of the finger's path."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from hapticrender.bands import NYQUIST_MARGIN, Bands
from hapticrender.checks import require
from hapticrender.control.device_model import Demand, DeviceModel
from hapticrender.control.inverse import share_driven
from hapticrender.control.supervisor import drive_per_target
from hapticrender.defaults import FADE_IN
from hapticrender.mathx import smoothstep
from hapticrender.protocols import Array
from hapticrender.renderers.base import Waveform
from hapticrender.touch.perception import drop_unfelt
from hapticrender.touch.scene import Scene

CHECK_STEP = 1e-3  # s: resolution at which the finger's path is checked against the surface
LOOK_AHEAD = 30.0  # s of a scene that are examined for the finger's speed and the drive that a waveform needs
FASTEST = 10.0  # m/s: no finger is faster


def check_path(scene: Scene, half: float) -> None:
    """Refuse a finger that leaves a glass of half length `half` (m)."""
    duration = min(scene.duration, 3600.0)
    position = scene.finger.position(np.arange(0.0, duration, max(CHECK_STEP, duration / 1e6)))
    reach = np.nanmax(abs(position), initial=0.0)
    if reach > half:
        raise ValueError(f"finger.position reaches {reach:g} m: must stay within {half:g} m of the glass's middle")


def examined(scene: Scene) -> Array:
    """Times (s) at which the finger is examined: every millisecond of the first `LOOK_AHEAD` in which it touches."""
    touches = scene.finger.touches
    start = min((on for on, _ in touches), default=0.0) if touches else 0.0
    return np.arange(start, min(scene.duration, start + LOOK_AHEAD) + 2 * CHECK_STEP, CHECK_STEP)


def speeds(scene: Scene) -> Array:
    """Speed of the finger (m/s) every millisecond, NaN while it is lifted."""
    return abs(np.diff(scene.finger.position(examined(scene)))) / CHECK_STEP


def top_speed(scene: Scene) -> float:
    """Largest speed of the finger (m/s)."""
    return float(np.nanmax(speeds(scene), initial=0.0))


def perceptible(scene: Scene, bands: Bands, model: DeviceModel) -> Bands:
    """Leave out the bands below the detection threshold, unless the scene keeps them; note which and why."""
    if not isinstance(bands, Bands):
        kind = type(scene.texture).__name__
        raise TypeError(f"{kind}.bands returned {type(bands).__name__}: must be hapticrender.Bands")
    if scene.keep_unfelt:
        return bands
    return drop_unfelt(
        bands,
        top_speed=min(top_speed(scene), FASTEST),
        lowest=max(model.lowest_frequency / 2, 1.0),
        highest=model.highest_edge * model.highest_frequency,
    )


def check_carriers(scene: Scene, model: DeviceModel, bands: Bands) -> None:
    """Refuse carriers of 0 Hz, and those that the rate cannot carry, at the finger's top speed too."""
    still = (bands.frequency == 0.0) & (bands.wavenumber == 0.0)
    require(not still.any(), "texture.frequency", 0.0, "> 0 Hz in a band without a wavenumber: leave the band out")
    highest, frequency = NYQUIST_MARGIN * model.rate, bands.frequency.max(initial=0.0)
    if frequency > highest:
        bound = f"must be <= {highest:g} Hz, {NYQUIST_MARGIN} of the rate of {model.rate:g} Hz"
        raise ValueError(f"texture.frequency = {frequency:g}: {bound}")
    speed, wavenumber = top_speed(scene), bands.wavenumber.max(initial=0.0)
    if speed * wavenumber > highest:
        passing = f"passes at {speed * wavenumber:g} Hz at the finger's {speed:g} m/s"
        raise ValueError(f"texture.wavelength = {1 / wavenumber:g} m {passing}: must be <= {highest:g} Hz")


def check_targets(scene: Scene, model: DeviceModel, bands: Bands, waveform: Waveform) -> None:
    """Refuse targets that pass the free device's drive, what its sensors can follow, or the limits of the device."""
    need, unit, drive_unit = needed(scene, model, bands, waveform), model.unit, model.drive_unit
    verb = "=" if unit == "m" else "asks for"
    peak = need.amplitude * max(map(abs, model.profile or (1.0,)))
    for amplitude, most, whose in (
        (need.amplitude, model.sensed_limit, "the sensors' range"),
        (peak, model.sensed_bound, "[limits] displacement"),
    ):
        if amplitude > most:
            raise ValueError(f"texture.amplitude {verb} {amplitude:.3g} {unit}: must be <= {most:g} {unit}, {whose}")
    peak_drive = scene.device_profile.limits.peak_drive or math.inf
    each = " in each coil" if drive_unit == "A" else ""
    bound, own, step = model.drive_limit, "", model.drive_step
    if 0.0 <= peak_drive - bound <= step:
        down = f", rounded down to a multiple of the converter's step of {step:.3g} {drive_unit}" if step else ""
        bound, own = peak_drive, f", [limits] peak_drive{down}"
    over = f" over {model.rms_time:g} s, [limits] rms_drive"
    for drive, most, stated, kind, whose in (
        (need.drive, model.drive_limit, bound, "", each + own),
        (need.rms, model.rms_limit, model.rms_limit, " rms", each + over),
    ):
        if drive > most:
            needs = f"at {need.frequency:.3g} Hz needs {drive:.3g} {drive_unit}{kind}"
            must = f"must be <= {stated:g} {drive_unit}{kind}{whose}"
            raise ValueError(f"texture.amplitude {verb} {need.worst:.3g} {unit} {needs}: {must}")


class Need(NamedTuple):
    """Demand of a scene's targets on the free device."""

    amplitude: float  # largest sum of the targets, in the device's quantity
    drive: float  # that they need
    worst: float  # target of the band that needs most of it (of a waveform: its peak)
    frequency: float  # Hz, of that band
    lowest: float  # Hz, of all that the targets move with
    highest: float  # Hz
    rms: float  # of the drive that no finger's speed changes, over the time constant of [limits]


def demand(scene: Scene, model: DeviceModel, bands: Bands, waveform: Waveform) -> Demand:
    """Return what the targets of a scene need of a plate at most, with the worst finger; see `control.supervisor`."""
    need = needed(scene, model, bands, waveform, partial(drive_per_target, model), NYQUIST_MARGIN * model.rate)
    motion = need.amplitude * max(map(abs, model.profile or (1.0,)))
    lowest = max(need.lowest, model.lowest_frequency / 2)
    return Demand(motion=motion, drive=need.drive, lowest=lowest, highest=max(need.highest, lowest))


def needed(
    scene: Scene,
    model: DeviceModel,
    bands: Bands,
    waveform: Waveform,
    per_target: Callable[[Array], Array] | None = None,
    top: float = 0.0,
) -> Need:
    """Amplitude and drive that a scene's targets need of the free device, all channels driven alike.

    `per_target` (drive per target at frequencies in Hz) may state another drive.  A waveform's is what it needs up to
    what the device renders, or up to `top` (Hz).  A finger-locked carrier of a constant target passes every frequency
    up to that of the finger's top speed.
    """
    per_target = per_target or (lambda frequency: 1.0 / model.response(frequency).sum(axis=-1)[..., 0])
    if bands.envelope is None:
        top = max(0.0 if bands.differentiated else top, min(model.highest_frequency, 0.4 * model.rate))
        return _need_of_waveform(scene, model, bands, waveform, per_target, top)
    sweep = np.minimum(top_speed(scene) * bands.wavenumber, model.highest_edge * model.highest_frequency)
    high = bands.frequency + sweep
    low = np.where(bands.wavenumber > 0.0, np.minimum(model.lowest_frequency, high), high)
    passed = low + np.linspace(0.0, 1.0, 400)[:, None] * (high - low)
    target = abs(bands.envelope) * (2 * np.pi * passed if bands.differentiated else np.ones_like(passed))
    drive = target * abs(per_target(passed))
    worst = int(drive.max(axis=0).argmax())
    at = int(drive[:, worst].argmax()), worst
    sums = (float(each.max(axis=0).sum()) for each in (target, drive))
    ends = float(passed.min()), float(passed.max())
    power = (drive[0, bands.wavenumber == 0.0] ** 2).sum() / 2.0
    rms = math.sqrt(power * -math.expm1(-scene.duration / scene.device_profile.limits.rms_time))
    return Need._make([*sums, float(target[at]), float(passed[at]), *ends, rms])


def _need_of_waveform(
    scene: Scene, model: DeviceModel, bands: Bands, waveform: Waveform, per_target: Callable[[Array], Array], top: float
) -> Need:
    """A target waveform up to `top` (Hz), 0.1 % of the energy left out at either side."""
    from scipy.fft import next_fast_len  # only waveforms need them, and their import takes a second
    from scipy.signal import lfilter

    time = np.arange(int(min(scene.duration, LOOK_AHEAD) * model.rate) + 2) / model.rate
    target = bands.checked(type(scene.texture).__name__, waveform, time, scene.finger.position(time))
    played = target if bands.differentiated else _faded(target, model.rate)
    size = len(played) if bands.differentiated else next_fast_len(len(played), real=True)  # a faded one ends at zero
    frequency = np.fft.rfftfreq(size, 1.0 / model.rate)
    kept = (frequency >= model.lowest_frequency / 2) & (frequency <= top)
    turn = 2j * np.pi * frequency if bands.differentiated else 1.0
    spectrum = np.where(kept, turn * np.fft.rfft(played, size), 0.0)
    if bands.differentiated:
        target = np.fft.irfft(spectrum, size)
    driven = spectrum.copy()
    driven[kept] *= share_driven(model, frequency[kept]) * per_target(frequency[kept])
    drive = np.fft.irfft(driven, size)
    pole = -math.expm1(-1.0 / (model.rate * scene.device_profile.limits.rms_time))
    rms = math.sqrt(lfilter([pole], [1.0, pole - 1.0], drive**2).max())
    amplitude = float(abs(target).max())
    energy = np.cumsum(abs(spectrum) ** 2)
    ends = (float(frequency[np.searchsorted(energy, share * energy[-1])]) for share in (1e-3, 1.0 - 1e-3))
    strongest = float(frequency[abs(spectrum).argmax()])
    return Need._make([amplitude, float(abs(drive).max()), amplitude, strongest, *ends, rms])


def _faded(target: Array, rate: float) -> Array:
    """Target, faded in as the law does, then on by its own reflection and out: no step between its ends."""
    count = min(round(FADE_IN * rate), len(target) - 1)
    after = 2.0 * target[-1] - target[-2 : -2 - count : -1]
    rising = smoothstep(np.arange(len(target)) / (FADE_IN * rate))
    return np.concatenate([rising * target, smoothstep(1.0 - np.arange(1, count + 1) / count) * after])
