"""Start-up probe: check the wiring of a plate's sensors and actuators before the loop closes.

For 200 ms both actuators play lines of their own, away from the modes, so that a resting finger changes little; the
surface moves by a fortieth of the sensors' range.  The response y is compared with that of the model under at most 516
hypotheses h (13 wirings, each with 13 delays, that as stated also with 3 about the largest correlation of y with its
response, free and with a finger at either sensor) by the residual 1 - <y, y_h>/(|y| |y_h|), with offset, slope and
parabola taken out of each sensor.  The sensors' noise is that of second differences in the second half of the silence
after it; its energy is none of the response's.
"""

from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from hapticrender.control.device_model import DeviceModel
from hapticrender.control.linear import DiscretePlant
from hapticrender.driver_checks import check_sensed
from hapticrender.errors import DeviceFault
from hapticrender.protocols import Array, Driver, Flag

DURATION, EDGE, REST = 0.2, 0.03, 0.1  # s; Hann edges; silence after it
TRIES = 3
LOW = np.array([[0.31, 0.51, 0.71], [0.37, 0.58, 0.78]])  # lines of each actuator, over the lowest mode
HIGH = np.array([[1.40, 1.77], [1.59, 1.96]])  # over the highest
HIGH_GAIN = (2.0, 2.8)  # amplitude of a line above the modes, over one below
MOTION, MOST_DRIVE = 0.025, 0.05  # of the sensors' range; of the drive limit
DELAYS = 13
MOST_INVALID, MOST_REPEATS = 0.02, 0.6
LEAST_ENERGY = 0.005  # of the model's, beyond the noise's: half of what a tenth of the gain leaves
MOST_RESIDUAL, MOST_WORSE = 0.35, 0.05
MOST_NOISE = (1 / (1 - MOST_RESIDUAL / 2) ** 2 - 1) ** 0.5  # over |y|: this noise alone leaves half that residual
FINGER = 5e-3, 6.0, 6e3  # kg, N s/m, N/m at a sensor: half of the most that is expected
SCALES, DELAY_TOLERANCE = (0.6, 1.6), 2  # samples
ONE, SWAP = np.eye(2), np.eye(2)[::-1]
WIRINGS = {  # what is not as stated: sensors (rows are what is sensed), actuators
    "nothing": (ONE, ONE),
    "sensor 1 is inverted": (np.diag([-1.0, 1.0]), ONE),
    "sensor 2 is inverted": (np.diag([1.0, -1.0]), ONE),
    "both sensors, or all actuators, are inverted": (-ONE, ONE),
    "sensors, or actuators, are swapped": (SWAP, ONE),
    "sensors, or actuators, are swapped, and all inverted": (-SWAP, ONE),
    "sensor 1 is dead": (np.diag([0.0, 1.0]), ONE),
    "sensor 2 is dead": (np.diag([1.0, 0.0]), ONE),
    "actuator 1 is inverted": (ONE, np.diag([-1.0, 1.0])),
    "actuator 2 is inverted": (ONE, np.diag([1.0, -1.0])),
    "actuators, or sensors, are swapped": (ONE, SWAP),
    "actuator 1 is dead": (ONE, np.diag([0.0, 1.0])),
    "actuator 2 is dead": (ONE, np.diag([1.0, 0.0])),
}


class Found(NamedTuple):
    """Result of a probe."""

    fault: str  # what is not as stated; "" where nothing was found
    residual: float  # of the wiring as stated; NaN, as the next, where it was not looked for
    scale: float  # of the response over that of the model, 1 where all is as stated
    delay: int  # samples, of the loop; -1 where it was not looked for


def probe_plate(driver: Driver, model: Any) -> None:
    """Probe an open plate of two actuators and two sensors up to three times, and leave it at rest.

    It is probed by `play`, whose delay may be longer than that of the model (`play_delay`); a board, whose loop is its
    own, by the drive of the host.  Of a hybrid the plate is probed, the screen without drive.  A
    `DeviceFault` where a deviation from the model was found in every try.
    """
    places, model = len(model.places), getattr(model, "plate", model)
    drive = probe_drive(model)
    for _ in range(TRIES):
        with driver.by_host() if hasattr(driver, "by_host") else nullcontext(driver) as player:
            delay = model.delay + getattr(player, "play_delay", player.delay) - driver.delay
            played = replace(model, delay=delay, block=player.block)
            sensed, lost = play_probe(player, drive, places, REST)
        last = judge(played, drive, sensed[:, : len(ONE)])
        if not last.fault:
            return
        if lost > MOST_INVALID:
            last = Found(f"{lost:.0%} of the samples were lost on the way: the probe cannot judge", np.nan, np.nan, -1)
    shares = ((name, getattr(last, name)) for name in ("residual", "scale"))
    figures = [f"{name} {value:.2g}" for name, value in shares if np.isfinite(value)]
    figures += [f"delay {last.delay} samples"] * (last.delay >= 0)
    measured = f" ({', '.join(figures)})" if figures else ""
    raise DeviceFault(
        f"{type(driver).__name__}: refused by the start-up probe: {last.fault}{measured}: check the wiring, or "
        "[device]; [render] probe = false leaves the probe out"
    )


def probe_drive(model: DeviceModel) -> Array:
    """Lines of the probe (drive unit, shape (n, 2)), from rest to rest."""
    modes = DiscretePlant.free(model.mass, model.damping, model.stiffness, model.rate).modes()
    lines = np.hstack([LOW * modes.min(), HIGH * modes.max()])
    time = np.arange(round(DURATION * model.rate)) / model.rate
    gains = np.array([*[1.0] * LOW.shape[1], *HIGH_GAIN]) * (lines < 0.4 * model.rate)
    phases = np.pi * np.arange(lines.shape[1]) ** 2 / lines.shape[1]  # Schroeder's
    edge = np.clip(np.minimum(time, time[-1] - time) / EDGE, 0.0, 1.0)
    drive = (gains[:, :, None] * np.sin(2 * np.pi * lines[:, :, None] * time + phases[:, None])).sum(axis=1).T
    drive *= np.sin(np.pi / 2 * edge)[:, None] ** 2
    limit = MOST_DRIVE * model.drive_limit / abs(drive).max()
    response = np.einsum("jjns", _responses(model, drive))
    return drive * min(MOTION * model.sensed_limit / abs(response).max(), limit)


def judge(model: DeviceModel, drive: Array, sensed: Array) -> Found:
    """Compare what was sensed under `drive` (n, 2) with the responses of the model, and name the deviation.

    `sensed` (n + m, 2) goes on into the silence after the drive.
    """
    silence = sensed[(len(drive) + len(sensed)) // 2 :]
    silence = silence[np.isfinite(silence).all(axis=1)]
    sensed = sensed[: len(drive)]
    stated = model.delay - model.block
    delays = range(max(stated - DELAYS // 2, 0), max(stated - DELAYS // 2, 0) + DELAYS)
    valid = np.asarray((abs(sensed) < model.sensed_limit).all(axis=1))
    repeats = (np.diff(sensed, axis=0) == 0.0).mean(axis=0)
    if (~valid).mean() > MOST_INVALID:
        largest, bound = abs(sensed[np.isfinite(sensed)]).max(initial=0.0), f"+-{model.sensed_limit:g} {model.unit}"
        beyond = f", up to {largest:.3g} and not within {bound}: must be in {model.unit}"
        invalid = f"{(~valid).mean():.0%} of the samples are invalid"
        return Found(invalid + beyond * bool(largest > model.sensed_limit), np.nan, np.nan, -1)
    y = _detrended(np.where(valid[:, None], sensed, 0.0))
    residuals, scales, model_energy = _compared(model, drive, y, delays)
    energy = float((y**2).sum())
    noise = float(np.diff(silence, 2, axis=0).std() / 6**0.5) if len(silence) else 0.0  # of white noise
    most = MOST_NOISE * (model_energy / y.size) ** 0.5
    noisy = f"the sensors' noise is {1e6 * noise:.2g} um rms, more than {1e6 * most:.2g} um: the probe cannot judge"
    if energy - noise**2 * y.size < LEAST_ENERGY * model_energy:
        if noise > most:  # as by a limit of the drive that leaves too little of it
            return Found(f"{noisy} by {abs(drive).max():.2g} {model.drive_unit}", np.nan, np.nan, -1)
        return Found("nothing moves: sensors or actuators are dead", np.nan, (energy / model_energy) ** 0.5, -1)
    if (repeats > MOST_REPEATS).any():
        return Found(f"sensor {1 + int(repeats.argmax())} repeats its values", np.nan, np.nan, -1)
    best = min(residuals, key=lambda each: residuals[each])
    own = min((each for each in residuals if each[0] == "nothing"), key=lambda each: residuals[each])
    scale, delay = scales[own], own[1] + model.block
    fault = ""
    if min(residuals[own], residuals[best] + MOST_WORSE) > MOST_RESIDUAL and noise > most:
        fault = noisy
    elif residuals[own] > residuals[best] + MOST_WORSE:
        fault = best[0]
    elif residuals[own] > MOST_RESIDUAL:
        fault = "the answer is not that of the device model"
    elif not SCALES[0] <= scale <= SCALES[1]:
        fault = f"sensors or actuators have {scale:.2g} times the gain that they should have"
    elif abs(delay - model.delay) > DELAY_TOLERANCE:
        fault = f"the loop's delay is {delay} samples, not {model.delay}"
    return Found(fault, residuals[own], scale, delay)


def _compared(
    model: DeviceModel, drive: Array, y: Array, delays: range
) -> tuple[dict[tuple[str, int, int], float], dict[tuple[str, int, int], float], float]:
    """Residual of every hypothesis (wiring, delay, number of the load), scale of y over it, and energy as stated."""
    residuals, scales, stated, energy = {}, {}, 0.0, float((y**2).sum())
    for load, finger in enumerate((None, *np.linalg.inv(model.coordinate_from_sensed))):
        parts = _responses(model, drive, finger)
        if finger is None:  # a delay may be off by blocks, which would look like another wiring
            stated = float((_detrended(free := np.einsum("jjns->ns", parts)) ** 2).sum())
            likely = _likely_delays(y, free)
        for name, (sensors, actuators) in WIRINGS.items():
            response = np.einsum("jk,jkns->ns", actuators, parts) @ sensors.T
            for delay in {*delays, *(likely if name == "nothing" else ())}:
                h = _detrended(np.pad(response, ((delay, 0), (0, 0)))[: len(response)])
                alike, power = float((y * h).sum()), float((h**2).sum())
                residuals[name, delay, load] = 1.0 - alike / max((energy * power) ** 0.5, 1e-300)
                scales[name, delay, load] = alike / max(power, 1e-300)
    return residuals, scales, stated


def _likely_delays(y: Array, response: Array) -> set[int]:
    """Shift (samples) of the largest correlation of `y` with a response (n, sensors), and its neighbours."""
    n = 2 * len(y)
    spectra = np.fft.rfft(y, n, axis=0) * np.fft.rfft(response, n, axis=0).conj()
    shift = int(np.argmax(np.fft.irfft(spectra.sum(axis=1), n)[: len(y) // 2]))
    return {max(shift - 1, 0), shift, shift + 1}


def _responses(model: DeviceModel, drive: Array, finger: Array | None = None) -> Array:
    """What the sensors show under signal k of a drive (n, 2) on actuator j, shape (2, 2, n, sensors).

    The device is free, or there is a `finger`, given by its displacement per coordinate (c,).
    """
    acts = np.zeros(model.mass.shape) if finger is None else np.outer(finger, finger)
    m, b, k = (part * acts for part in FINGER)
    plate = DiscretePlant.free(model.mass + m, model.damping + b, model.stiffness + k, model.rate)
    forces = np.einsum("cj,nk->njkc", plate.b @ model.force_from_drive, drive)
    states, state = np.empty_like(forces), np.zeros(forces.shape[1:])
    for n, force in enumerate(forces):
        states[n] = state
        state = state @ plate.a.T + force
    return np.moveaxis(states @ (np.linalg.inv(model.coordinate_from_sensed) @ plate.c).T, 0, 2)


def _detrended(values: Array) -> Array:
    """Take offset, slope and parabola out of each column."""
    basis = _parabolas(len(values))
    return np.asarray(values - basis @ (basis.T @ values))


@lru_cache(maxsize=4)
def _parabolas(n: int) -> Array:
    """Orthonormal basis (n, 3) of offset, slope and parabola."""
    return np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, n), 3))[0]


def play_probe(driver: Driver, drive: Array, places: int, rest: float) -> tuple[Array, float]:
    """Play a drive (n, channels) and `rest` s of silence in blocks; what was sensed meanwhile, and the share lost."""
    blocks = -(-(len(drive) + round(rest * driver.rate)) // driver.block)
    padded = np.zeros((blocks * driver.block, driver.drive_channels))
    padded[: len(drive), : drive.shape[1]] = drive
    parts = [
        check_sensed(driver, driver.play(block.copy()), places) for block in padded.reshape(blocks, driver.block, -1)
    ]
    lost = [0.0 if part.flags is None else float(np.mean(part.flags & Flag.OVERRUN > 0)) for part in parts]
    return np.concatenate([part.sensed for part in parts]), sum(lost) / blocks
