"""Draw how fine a grating may be under a moving finger, by the sensor of its position, its latency and rate.

The closed form of `hapticrender.touch.latency_budget`, and simulated panels beside it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.charts.style import BLUE, GREEN, INK, ORANGE, PALE, RED, new_figure
from benchmarks.panels import PANELS
from hapticrender.protocols import Array
from hapticrender.touch.latency_budget import finest_wavelength, phase_error
from hapticrender.touch.motion import SineMotion
from hapticrender.touch.touch_panel import PanelReader, TouchPanel

DEGREES = 30.0
COLOURS = dict(zip(PANELS, (BLUE, GREEN, ORANGE, RED), strict=True))
SPEEDS = (0.01, 0.05, 0.1, 0.16)  # m/s
WAVELENGTH, SPEED = 1e-3, 0.05  # m, m/s: of the second chart
LATENCIES = (2e-3, 5e-3, 10e-3, 20e-3, 50e-3)  # s: of the simulated points
SECONDS = 8.0


def simulated(panel: TouchPanel, speed: float, wavelength: float) -> float:
    """Phase error (degrees rms) of 3 Hz swipes behind a simulated panel."""
    rate = 1000.0
    truth = SineMotion(frequency=3.0, speed=speed).position(np.arange(round(SECONDS * rate)) / rate)
    error = (PanelReader(panel, rate, seed=1)(truth) - truth)[round(0.5 * rate) :]
    return float(360.0 * np.sqrt(np.mean(error**2)) / wavelength)


def table() -> str:
    """Finest grating (mm) by sensor and peak speed, with the estimator and with the last sample held."""
    rows = [f"finest grating (mm) for {DEGREES:g} degrees rms; peak speed of 3 Hz swipes (mm/s): predicted / held"]
    rows.append("  ".join([f"{'':24}", *(f"{1e3 * speed:^13g}" for speed in SPEEDS)]))
    for name, panel in PANELS.items():
        found = [[finest_wavelength(panel, v, predicted=each) for each in (True, False)] for v in SPEEDS]
        rows.append("  ".join([f"{name:24}", *(f"{1e3 * a:6.3g}/{1e3 * b:6.3g}" for a, b in found)]))
    return "\n".join(rows)


def draw() -> Any:
    """Finest grating over speed for each sensor; phase error of one grating over latency for each rate."""
    with new_figure((11.5, 4.8)) as figure:
        left, right = figure.subplots(1, 2)
        _over_speed(left)
        _over_latency(right)
        right.legend(*left.get_legend_handles_labels(), loc="lower right", fontsize=7)
        for axis in (left.xaxis, left.yaxis, right.xaxis, right.yaxis):
            axis.set_major_formatter("{x:g}")
        figure.suptitle("Grating under a finger that swipes at 3 Hz: what late and noisy positions leave")
    return figure


def _over_speed(axes: Any) -> None:
    speeds = np.geomspace(0.01, 0.2, 25)
    for name, panel in PANELS.items():
        for predicted, style in ((True, "-"), (False, "--")):
            finest = [finest_wavelength(panel, speed, predicted=predicted) for speed in speeds]
            label = name if predicted else None
            axes.plot(1e3 * speeds, 1e3 * np.array(finest), style, color=COLOURS[name], label=label)
        points = [simulated(panel, speed, 1.0) / DEGREES for speed in SPEEDS]
        axes.plot(1e3 * np.array(SPEEDS), 1e3 * np.array(points), "o", ms=4, color=COLOURS[name])
    axes.plot(1e3 * speeds, 1e3 * speeds / 1000.0, ":", color=INK, lw=1.0, label="1 kHz: the devices' own limit")
    axes.plot([], [], "--", color=PALE, label="last sample held, no estimator")
    axes.plot([], [], "o", ms=4, color=PALE, label="simulated")
    axes.set(xscale="log", yscale="log", xlabel="peak speed (mm/s)", ylabel="finest grating (mm)")
    axes.set_title(f"Wavelength with a phase error of {DEGREES:g} degrees rms")


def _over_latency(axes: Any) -> None:
    latency = np.geomspace(1e-3, 0.1, 30)
    for name, panel in PANELS.items():
        for predicted, style in ((True, "-"), (False, "--")):
            axes.plot(1e3 * latency, _errors(panel, latency, predicted), style, color=COLOURS[name])
        points = [simulated(replace(panel, latency=each), SPEED, WAVELENGTH) for each in LATENCIES]
        axes.plot(1e3 * np.array(LATENCIES), points, "o", ms=4, color=COLOURS[name])
    axes.axhline(DEGREES, color=INK, lw=0.8, ls=":")
    axes.set(xscale="log", yscale="log", xlabel="latency of the sensor (ms)", ylabel="phase error (degrees rms)")
    axes.set_title(f"Grating of {1e3 * WAVELENGTH:g} mm at {1e3 * SPEED:g} mm/s")


def _errors(panel: TouchPanel, latency: Array, predicted: bool) -> list[float]:
    options: dict[str, Any] = {"predicted": predicted}
    return [phase_error(replace(panel, latency=each), SPEED, WAVELENGTH, **options) for each in latency]
