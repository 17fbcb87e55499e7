"""Design of the law by bands: from a device model, bands and a method's rules to the settings of its kernel.

Bandwidths follow carriers, spacing and delay: observer <= f0/2 and spacing/2 pi, integral <= f0/4 and what delay and
observer leave of the phase, DC estimate <= f0/8.  Thresholds follow the noise.  The inner damper is chosen by its
margins; then all of it is lowered until the margins of the sampled loop hold (`margin_check`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.adaptation import ADAPTATION_SAMPLES
from hapticrender.control.controller import (
    BankController,
    device_settings,
    lowest_carrier,
    refuse_whole_waveform,
    ridge_spacing,
    shared_settings,
    spacing,
)
from hapticrender.control.damping import Damping, added_damping, choose_damping, oscillators
from hapticrender.control.device_model import DeviceModel, FingerRange
from hapticrender.control.kernel import block_step, error_step
from hapticrender.control.margin_check import checked_settings
from hapticrender.control.supervisor import damper_settings
from hapticrender.defaults import FADE_IN

LEAST_FADE_IN = 0.5e-3  # s: however fast the device, as drives are finite
FAST_POLE, FAST_SIGMAS = 30.0, 5.5  # Hz, of the sensor noise behind that pole
SLOW_POLE, SLOW_SIGMAS = 4.0, 5.0
MOST_DAMPER_DELAY = 8  # samples: a longer delay is that of a block device, where a damper would act on stale noise
PHASE_MARGIN = math.pi / 4  # rad: 90 deg less integral gain times (delay + 1/observer pole)
ADAPTATION_SHARE = 0.5  # of a residual, adapted in a step at most: at 0.8 it swings under a light finger
ADAPTATION_TIME = 1 / 60  # s: fastest adaptation to what is always there; a delay counts twice
ADAPTATION_MARGIN = 5.0  # of the observer's pole over the adaptation, where that estimates all of D
FAST_DC = 60.0  # Hz: bandwidth of the DC estimate while the step of a contact goes into it
BACK_TIME = 0.02  # s: back-calculation at the limit
TOUCHED_DECAY = 1000.0  # 1/s: of an always damped mode at least
LEAST_NOISE = 1e-6  # of the sensors' range: thresholds never fall to nothing
ALWAYS = -1e300  # N: every load is larger
FROM_MODEL = ("sensor_delay", "contact_length", "contact_damping", "typical_speed", "drive_step", "highest_edge")
CROWDED = 40.0  # Hz: carriers closer than this share what the detectors see


@dataclass(frozen=True, kw_only=True)
class Rules:
    """How a method sets up the controller; rates in 1/s, bandwidths in Hz, times in s.

    Each pair is (low, high) gain: a detector of the deviation, or contact, raises the gains for `high_time`.
    `integral` has a medium gain between them, for the slow detector; `dc` is the least ratio of the lowest carrier to
    the bandwidth of the DC estimate; `rest` adapts what each band's stiffness leaves over; `damper` is a factor on the
    inner damper.
    """

    observer: tuple[float, float]
    integral: tuple[float, float, float]
    adaptation: tuple[float, float]
    rest: tuple[float, float] = (0.0, 0.0)
    damper: tuple[float, float] = (0.0, 0.0)
    dc: float = 8.0
    detects: bool = True
    high_time: float = 0.15
    medium_time: float = 0.4
    release: float = 0.05

    def scaled(self, factor: float) -> "Rules":
        """Return the rules for a device that is to be followed `factor` times as fast."""
        rates: dict[str, Any] = {
            name: tuple(factor * each for each in getattr(self, name))
            for name in ("observer", "integral", "adaptation", "rest")
        }
        times = {name: getattr(self, name) / factor for name in ("high_time", "medium_time", "release")}
        return replace(self, **rates, **times)


ONE_SPEED = Rules(observer=(10.0, 10.0), integral=(17.0, 17.0, 17.0), adaptation=(100.0, 100.0), detects=False)
TWO_SPEEDS = Rules(observer=(10.0, 20.0), integral=(2.0, 15.0, 25.0), adaptation=(1.0, 100.0), damper=(0.0, 1.0))
TWO_SPEEDS_CROWDED = Rules(
    observer=(20.0, 20.0),
    integral=(1.5, 1.5, 15.0),
    adaptation=(2.0, 100.0),
    rest=(0.05, 5.0),
    damper=(0.2, 1.0),
    dc=3.5,
    detects=False,
    high_time=0.4,
    release=0.3,
)


def rules_for(bands: Bands) -> Rules:
    """Two speeds; carriers nearer than 40 Hz, or that may come so near, have no detectors."""
    crowded = spacing(bands) < CROWDED or (bands.wavenumber > 0.0).sum() > 1
    return TWO_SPEEDS_CROWDED if crowded else TWO_SPEEDS


def design_controller(
    method: str, model: DeviceModel, bands: Bands, rules: Rules, *, feedback: bool = True
) -> BankController:
    """Design the law by bands, called `method`, for a device of 1 or 2 coordinates and its bands by `rules`.

    It runs in blocks where the delay is that of a block device (more than 8 samples), else sample by sample.  Without
    feedback nothing is sensed, and the law drives open loop.

    A `DesignError` where no bandwidth keeps the least margins; a ValueError where there are no carriers, two are equal,
    or the device has too many coordinates, channels or sensors.
    """
    refuse_whole_waveform(bands)
    rules = rules.scaled(model.pace)
    by_sample = model.delay <= MOST_DAMPER_DELAY
    damping = choose_damping(model) if any(rules.damper) and feedback and by_sample else None
    if damping is None or not damping.on:
        rules = replace(rules, damper=(0.0, 0.0))
    elif model.always_damped:
        rules = replace(rules, damper=(rules.damper[1], rules.damper[1]))
    if (bands.wavenumber > 0.0).any():  # what is left over at one frequency is wrong at the next
        rules = replace(rules, rest=(0.0, 0.0))
    block = model.block if model.block > 1 and not by_sample else 1
    settings = _settings(model, bands, rules, damping, feedback)
    if feedback:
        taps = damping.taps if damping else None
        settings = checked_settings(model, bands.frequency, settings, wavenumber=bands.wavenumber, taps=taps)
    if block > 1:
        settings = _in_blocks(settings, block, model.rate)
    history = int(settings["age"] + 0.5) + 2
    step = block_step if block > 1 else error_step
    return BankController(method, step, settings, bands, history=history)


def _gains(model: DeviceModel, bands: Bands, rules: Rules, feedback: bool) -> dict[str, float]:
    """How fast observer, integral and DC estimate may run, by lowest carrier (Hz), spacing and delay."""
    lowest, apart, period = lowest_carrier(model, bands), spacing(bands), 1.0 / model.rate
    if apart == 0.0:
        twice = np.sort(bands.frequency[bands.wavenumber == 0.0])
        raise ValueError(
            f"duplicate carrier frequency {twice[:-1][np.diff(twice) == 0.0][0]:g} Hz: merge the two partials"
        )
    pole = [2 * math.pi * min(width, lowest / 2, apart / (2 * math.pi)) for width in rules.observer]
    wait = model.delay * period  # integrator, observer and delay leave at least PHASE_MARGIN
    fastest = [min(2 * math.pi * lowest / 4, PHASE_MARGIN / (wait + 1 / each)) for each in pole]
    dc = 2 * math.pi * min(6.0, lowest / rules.dc) * period
    on = 1.0 if feedback else 0.0
    return {
        "observer": on * 2 * pole[0] * period,
        "observer_high": on * 2 * pole[1] * period,
        "integral": on * min(rules.integral[0], fastest[0]),
        "integral_medium": on * min(rules.integral[1], fastest[0]),
        "integral_high": on * min(rules.integral[2], fastest[1]),
        "dc": on * 1.6 * dc,
        "dc_drift": on * dc**2,
        "damper": rules.damper[0],
        "damper_high": rules.damper[1],
        "crowd_speed": max(pole) / ridge_spacing(bands),
    }


def _settings(
    model: DeviceModel, bands: Bands, rules: Rules, damping: Damping | None, feedback: bool
) -> Mapping[str, Any]:
    """Settings of the kernel, sample by sample."""
    period, fast = 1.0 / model.rate, 2 * math.pi * FAST_DC / model.rate
    lowest = lowest_carrier(model, bands)
    observer = min(rules.observer[0], lowest / 2, spacing(bands) / (2 * math.pi))
    sensor_map, drive_map = model.coordinate_from_sensed, np.linalg.pinv(model.force_from_drive)
    added = added_damping(oscillators(model), damping.quality) if damping and damping.on else np.zeros(1)
    decay = float((model.damping.diagonal() / model.mass.diagonal()).min()) if model.always_damped else math.inf
    return {
        **shared_settings(model, bands, sensor_map, drive_map, feedback),
        **device_settings(model),
        **_adaptation(model, rules, 2 * math.pi * observer, feedback),
        **_detectors(model, rules),
        **_finger(model.finger),
        **_gains(model, bands, rules, feedback),
        **{name: getattr(model, name) for name in FROM_MODEL},
        **damper_settings(model, damping),
        "added_damping": np.append(added, [0.0])[:2],
        "waveform_gain": 2 * 2 * math.pi * observer * period,
        "extrapolation": 0.0,
        "fade_in": period / max(FADE_IN / model.pace, LEAST_FADE_IN),
        "corrected": bands.sensor_response is None and (model.sensor_delay != 0.0 or model.contact_length != 0.0),
        "lock": 2 * math.pi * model.lock,
        "peak_decay": math.exp(-period * lowest),
        # of an always damped mode about as fast as it loses energy; however little, a finger takes it within 1 ms
        "back_calculation": min(model.pace / BACK_TIME, max(decay, TOUCHED_DECAY)),
        "dc_fast": 1.6 * fast,
        "dc_drift_fast": fast**2,
        "late": model.delay if model.late else 0,
        "age": (model.delay + 0.5) / ADAPTATION_SAMPLES,
    }


def _adaptation(model: DeviceModel, rules: Rules, observer: float, feedback: bool) -> dict[str, float]:
    """How fast the finger is estimated, by the observer's pole (1/s) and the delay; negative: never."""
    most = min(ADAPTATION_SHARE * model.rate / ADAPTATION_SAMPLES, model.finger.fastest)
    if model.finger.contact is None:  # what is always there is as large as D, and the law far from it while it adapts
        wait = model.delay / model.rate
        most = min(1 / (2 * wait + ADAPTATION_TIME / model.pace), most, observer / ADAPTATION_MARGIN)
    low, high = (min(each, most) if feedback else -1.0 for each in rules.adaptation)
    return {"adaptation": low, "adaptation_high": high, "rest": rules.rest[0], "rest_high": rules.rest[1]}


def _detectors(model: DeviceModel, rules: Rules) -> dict[str, float]:
    """What raises the gains, and for how long (samples)."""
    noise = np.sqrt((model.coordinate_from_sensed**2).sum(axis=1).max()) * max(
        model.sensed_noise, LEAST_NOISE * model.sensed_limit
    )
    period, fast, slow = 1.0 / model.rate, FAST_POLE * model.pace, SLOW_POLE * model.pace
    return {
        "detects": rules.detects,
        "fast_smoothing": -math.expm1(-2 * math.pi * fast * period),
        "slow_smoothing": -math.expm1(-2 * math.pi * slow * period),
        # square (m2) of so many sigmas of 2 eps e^(-j phi) behind a pole (Hz), eps white of rms `noise` (m)
        "fast_threshold": 2 * math.pi * fast * period * (FAST_SIGMAS * noise) ** 2,
        "slow_threshold": 2 * math.pi * slow * period * (SLOW_SIGMAS * noise) ** 2,
        "fast_time": rules.high_time * model.rate,
        "slow_time": rules.medium_time * model.rate,
        "release": period / rules.release,
    }


def _finger(finger: FingerRange) -> dict[str, Any]:
    """How contact is detected, and what may be estimated of it."""
    on, off = finger.contact or (ALWAYS, ALWAYS)
    bounds = {f"{name}_range": getattr(finger, name) for name in ("mass", "damping", "stiffness")}
    typical = {name: getattr(finger, name) for name in ("least_motion", "typical_mass", "typical_stiffness")}
    return {"contact_on": on, "contact_off": off, **typical, **bounds}


def _in_blocks(settings: Mapping[str, Any], block: int, rate: float) -> dict[str, Any]:
    """Settings of the kernel for blocks: what is stated per sample becomes per block; no inner damper, no lock."""
    most = ADAPTATION_SHARE * rate / block
    return {
        **settings,
        **{name: 1.0 - (1.0 - settings[name]) ** block for name in ("fast_smoothing", "slow_smoothing")},
        **{name: settings[name] / block for name in ("fast_time", "slow_time")},
        **{name: min(settings[name], most) for name in ("adaptation", "adaptation_high")},
        "block": block,
        "middle": 0.5,
        "extrapolation": settings["lead"],
        "release": min(settings["release"] * block, 1.0),
        "peak_decay": settings["peak_decay"] ** block,
        "age": max((settings["lead"] * rate - 0.5) / block, 1.0),
        "damper": 0.0,
        "damper_high": 0.0,
        "lock": 0.0,
        "late": 0,
    }
