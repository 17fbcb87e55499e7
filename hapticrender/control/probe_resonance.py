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
LEAST = 0.4  # of the damping stated of the free surface: a quality 2.5 times that stated


def probe_resonance(driver: Driver, mode: Any) -> None:
    """Probe an open surface whose `mode` (`plants.ultrasonic.UltrasonicParameters`) is stated, and leave it at rest.

    A `DeviceFault` where a deviation was found in each of three tries.
    """
    mode, fault = mode.sampled(driver.rate), ""
    late = getattr(driver, "play_delay", driver.delay) - driver.block
    drive = resonance_drive(mode)
    for _ in range(TRIES):
        sensed, lost = play_probe(driver, drive[:, None], 1, REST)
        fault = judge_resonance(mode, late, drive, sensed[:, 0])
        if fault and lost > MOST_INVALID:
            fault = f"{lost:.0%} of the samples were lost on the way: the probe cannot judge"
        if not fault:
            return
    cure = "check the wiring, or [device]; [render] probe = false leaves the probe out"
    raise DeviceFault(f"{type(driver).__name__}: refused by the start-up probe: {fault}: {cure}")


def resonance_drive(mode: Any) -> Array:
    """Drive (V, shape (n,)) that sweeps over the resonance of the free surface."""
    time = np.arange(round(DURATION * mode.rate)) / mode.rate
    turns = float(mode.resonance()) * time * (1.0 - REACH + REACH * time / DURATION)
    return np.asarray(SHARE * mode.drive_limit * np.cos(2 * np.pi * turns))


def judge_resonance(mode: Any, late: int, drive: Array, sensed: Array) -> str:
    """Name what is not as stated in `sensed` (m, shape (n,)), `late` samples behind its drive; "" where nothing is."""
    if not np.all(abs(sensed) < mode.sensor_range):
        return f"samples of the sensor are no numbers, or beyond its range of {mode.sensor_range:g} m"
    resonance, lines = float(mode.resonance()), np.fft.rfftfreq(len(sensed), 1.0 / mode.rate)
    near = abs(lines - resonance) < REACH * resonance
    omega, off = 2 * np.pi * lines[near], 2j * np.pi * (lines[near] - resonance)
    held = np.exp(-1j * omega * (late + 0.5) / mode.rate) * np.sinc(lines[near] / mode.rate)
    into = mode.force_constant / (2j * mode.mass * omega) * held * np.fft.rfft(drive, len(sensed))[near]
    found = np.fft.rfft(sensed)[near]
    terms = np.column_stack([found, into, np.ones(len(found))])
    pole, gain, _ = np.linalg.lstsq(terms, off * found, rcond=None)[0]
    damping = -pole.real / (2 * np.pi * float(mode.pole()))
    if abs(gain) < DEAD:
        return f"{abs(gain):.2g} of the gain that it should have: sensor or actuator is dead"
    if gain.real < STRAIGHT * abs(gain):
        turned = np.degrees(np.angle(gain))
        return (
            f"sensor or actuator is inverted, or the delay is not that stated: the gain is turned by {turned:.0f} deg"
        )
    if not SCALES[0] <= abs(gain) <= SCALES[1]:
        return f"sensor or actuator has {abs(gain):.2g} times the gain that it should have"
    if damping < LEAST:
        return f"{damping:.2g} of the damping of the free surface: the quality is not that stated"
    return ""
