"""Start-up probe of a vibrating surface: whether its sensor follows its drive, before the loop closes.

For 25 ms the drive is a twentieth of its limit on the resonance w of the free surface; U and Y are the amplitudes of
drive and sensor over the last 10 ms.  A mode of damping b, d off its resonance, has Y/U = k/(j w b - 2 m w d), so that

    r = Re(k U/(j w Y))/b_free = (b/b_free)/(gain of drive and sensor over that stated),

wherever the resonance is.  A finger damps: r may lie between that of the free surface and that of `MOST_LOAD`.
"""

from typing import Any

import numpy as np

from hapticrender.control.probe import MOST_INVALID, TRIES, play_probe
from hapticrender.errors import DeviceFault
from hapticrender.protocols import Array, Driver

DURATION, EDGE, JUDGED, REST = 25e-3, 5e-3, 10e-3, 15e-3  # s; judged at the end; silence after it
SHARE = 0.05  # of the drive's limit
LEAST, MOST_GAIN = 0.4, 0.6  # least r: a quality 2.5 times that stated; r of the most damped surface over its gain
MOST_LOAD = 20.0  # N


def probe_resonance(driver: Driver, mode: Any) -> None:
    """Probe an open surface whose `mode` (`plants.ultrasonic.UltrasonicParameters`) is stated, and leave it at rest.

    A `DeviceFault` where a deviation was found in each of three tries.
    """
    mode, fault = mode.sampled(driver.rate), ""
    drive = resonance_drive(mode)
    for _ in range(TRIES):
        sensed, lost = play_probe(driver, drive[:, None], 1, REST)
        fault = judge_resonance(mode, driver.delay - driver.block, drive, sensed[: len(drive), 0])
        if fault and lost > MOST_INVALID:
            fault = f"{lost:.0%} of the samples were lost on the way: the probe cannot judge"
        if not fault:
            return
    cure = "check the wiring, or [device]; [render] probe = false leaves the probe out"
    raise DeviceFault(f"{type(driver).__name__}: refused by the start-up probe: {fault}: {cure}")


def resonance_drive(mode: Any) -> Array:
    """Drive (V, shape (n,)) on the resonance of the free surface, from rest."""
    time = np.arange(round(DURATION * mode.rate)) / mode.rate
    edge = np.sin(np.pi / 2 * np.minimum(time / EDGE, 1.0)) ** 2
    return np.asarray(SHARE * mode.drive_limit * edge * np.cos(2 * np.pi * mode.resonance() * time))


def judge_resonance(mode: Any, late: int, drive: Array, sensed: Array) -> str:
    """Name what is not as stated in `sensed` (m, shape (n,)), `late` samples behind its drive; "" where nothing is."""
    rate, omega = mode.rate, 2 * np.pi * float(mode.resonance())
    if not np.all(abs(sensed) < mode.sensor_range):
        return f"samples of the sensor are no numbers, or beyond its range of {mode.sensor_range:g} m"
    last = np.arange(len(drive) - round(JUDGED * rate), len(drive))
    turns = np.exp(-1j * omega * last / rate) * np.hanning(len(last))
    held = np.exp(-1j * omega * (late + 0.5) / rate) * np.sinc(omega / (2 * np.pi * rate))
    into, found = held * (drive[last] @ turns), sensed[last] @ turns
    free = float(mode.damping())
    most = float(mode.damping(MOST_LOAD)) / free / MOST_GAIN
    expected = mode.force_constant * into / (1j * omega * free)
    if abs(found) * most <= abs(expected):
        return f"{abs(found / expected):.2g} of the vibration that it should have: sensor or actuator is dead"
    damping = float((expected / found).real)
    if damping < 0.0:
        return "sensor or actuator is inverted, or the delay is not that stated"
    if damping < LEAST:
        return f"the vibration is {1 / damping:.2g} times that of the free surface: gain or quality is not that stated"
    return ""
