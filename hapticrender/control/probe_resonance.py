"""Start-up probe of a vibrating surface: whether its sensor follows its drive, before the loop closes.

For 25 ms a twentieth of the drive's limit sweeps over the resonance w of the free surface as stated.  Y and U are the
spectra of sensor and drive, silence included, on the lines W = w + d in that range.  Near the resonance w + s of a mode
of damping b, whose gain of drive and sensor is g times that stated,

    j d Y = (-b/2m + j s) Y + g k/(2 j m W) U + c,

where c stands for what rings at the end: three complex unknowns, by linear least squares.  A finger changes b and s,
and not g.
"""

from typing import Any

import numpy as np

from hapticrender.control.probe import MOST_INVALID, SCALES, TRIES, play_probe
from hapticrender.errors import DeviceFault
from hapticrender.protocols import Array, Driver

DURATION, REST = 25e-3, 15e-3  # s; silence after the sweep
SHARE = 0.05  # of the drive's limit
REACH = 0.02  # of the resonance: half the range of the sweep
DEAD = 0.1  # gain of a dead part, at most
STRAIGHT = 0.8  # cosine of the gain's angle, 37 degrees, at least: a sample at 30 of 192 kHz is 56
OVER_RESIDUAL = 2.0  # least deviation of the gain, over the share of the response that the fit leaves
LEAST = 0.4  # of the damping stated of the free surface: a quality 2.5 times that stated


def probe_resonance(driver: Driver, mode: Any) -> float:
    """Probe an open surface whose `mode` (`plants.ultrasonic.UltrasonicParameters`) is stated, and leave it at rest.

    Returns the gain of drive and sensor over that stated, see `judge_resonance`.  A `DeviceFault` where a deviation was
    found in each of three tries.
    """
    mode, fault = mode.sampled(driver.rate), ""
    late = getattr(driver, "play_delay", driver.delay) - driver.block
    drive = resonance_drive(mode)
    for _ in range(TRIES):
        sensed, lost = play_probe(driver, drive[:, None], 1, REST)
        fault, gain = judge_resonance(mode, late, drive, sensed[:, 0])
        if fault and lost > MOST_INVALID:
            fault = f"{lost:.0%} of the samples were lost on the way: the probe cannot judge"
        if not fault:
            return gain
    cure = "check the wiring, or [device]; [render] probe = false leaves the probe out"
    raise DeviceFault(f"{type(driver).__name__}: refused by the start-up probe: {fault}: {cure}")


def resonance_drive(mode: Any) -> Array:
    """Drive (V, shape (n,)) that sweeps over the resonance of the free surface."""
    time = np.arange(round(DURATION * mode.rate)) / mode.rate
    turns = float(mode.resonance()) * time * (1.0 - REACH + REACH * time / DURATION)
    return np.asarray(SHARE * mode.drive_limit * np.cos(2 * np.pi * turns))


def judge_resonance(mode: Any, late: int, drive: Array, sensed: Array) -> tuple[str, float]:
    """Name what is not as stated in `sensed` (m, shape (n,)), `late` samples behind its drive ("": nothing); the gain.

    The gain is 1 where it deviates by less than `OVER_RESIDUAL` times the share of the response that the fit leaves: in
    noise, or where a contact begins, it is too small.
    """
    if not np.all(abs(sensed) < mode.sensor_range):
        return f"samples of the sensor are no numbers, or beyond its range of {mode.sensor_range:g} m", 1.0
    resonance, lines = float(mode.resonance()), np.fft.rfftfreq(len(sensed), 1.0 / mode.rate)
    near = abs(lines - resonance) < REACH * resonance
    omega, off = 2 * np.pi * lines[near], 2j * np.pi * (lines[near] - resonance)
    held = np.exp(-1j * omega * (late + 0.5) / mode.rate) * np.sinc(lines[near] / mode.rate)
    into = mode.force_constant / (2j * mode.mass * omega) * held * np.fft.rfft(drive, len(sensed))[near]
    found = np.fft.rfft(sensed)[near]
    terms = np.column_stack([found, into, np.ones(len(found))])
    pole, turned, rest = np.linalg.lstsq(terms, off * found, rcond=None)[0]
    gain, damping, fault = float(abs(turned)), -pole.real / (2 * np.pi * float(mode.pole())), ""
    if gain < DEAD:
        fault = f"{gain:.2g} of the gain that it should have: sensor or actuator is dead"
    elif turned.real < STRAIGHT * gain:
        wrong = "sensor or actuator is inverted, or the delay is not that stated"
        fault = f"{wrong}: the gain is turned by {np.degrees(np.angle(turned)):.0f} deg"
    elif not SCALES[0] <= gain <= SCALES[1]:
        fault = f"sensor or actuator has {gain:.2g} times the gain that it should have"
    elif damping < LEAST:
        fault = f"{damping:.2g} of the damping of the free surface: the quality is not that stated"
    if fault:
        return fault, 1.0
    left = np.linalg.norm((turned * into + rest) / (off - pole) - found) / np.linalg.norm(found)
    return "", gain if abs(gain - 1.0) > OVER_RESIDUAL * left else 1.0
