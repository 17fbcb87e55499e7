"""Draw white noise under a finger that touches, slides and leaves: constant gain, open inverse, the paper, and ours.

Played on the plate of ``tests/strangers_plate.py``; errors as in `hapticrender.accuracy`, from that plate's truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.charts.open_loop import SensorlessPlate
from benchmarks.charts.style import BLUE, GREEN, INK, ORANGE, PALE, new_figure, rounded
from hapticrender import Finger, strongest_carriers
from hapticrender.accuracy.plate import FINGER, RIGID, Bench, Run, rms
from hapticrender.accuracy.signals import Path, sliding, white
from hapticrender.bands import Bands
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import HEAVY
from tests.strangers_plate import FORCE_CONSTANT, TRUTH, StrangersPlate

RATE, SECONDS, RAMP = 5000, 5.0, 10e-3  # Hz, s, s: within which the finger touches, and leaves
TOUCH = (1.5, 3.5)  # s
WINDOW = 0.05  # s
ZOOM = (2.7, 2.74)  # s
JUDGED = {"before": (0.5, 1.25), "sliding": (2.0, 3.25), "after": (4.0, 4.95)}  # s
CARRIERS = 8
PRESSING = (TOUCH[0], TOUCH[0] + RAMP, TOUCH[1] - RAMP, TOUCH[1]), (0.0, 0.8, 0.8, 0.0)  # s, N
WHO = Finger(Path(sliding), PRESSING, (TOUCH,), HEAVY, load_scaling=True)
NOTE = """Error: rms(y - r)/rms(r) of the true motion y under the finger, in windows
of 50 ms, 20-500 Hz, without shift or gain fit. Grey line: no motion at all.
The load of 0.8 N alone moves the plate under the finger by 31 µm."""


class OnCarriers:
    """A waveform of which a method by bands plays the strongest carriers, 40 Hz or more apart."""

    def __init__(self, texture: Any):
        self.waveform = texture.waveform
        signal = texture.waveform(np.arange(round(SECONDS * RATE)) / RATE, None)
        self.frequency = strongest_carriers(signal, RATE, count=CARRIERS)

    def bands(self, rate: float) -> Bands:
        """Carriers; their envelopes come from the waveform."""
        nothing = np.zeros(len(self.frequency))
        return Bands(frequency=self.frequency, wavenumber=nothing, phase=nothing)


def play(texture: Any, method: str = "inverse", make: Any = StrangersPlate) -> Run:
    """Play under the heavy finger."""
    return Bench(method=method, make=make.of).of(**RIGID).play(texture, SECONDS, WHO)


def constant_gain(texture: Any) -> Run:
    """Play with a drive of (k_1 + k_2)/(2 K_T) times the reference: right for slow motion of the free plate."""
    samples = round(SECONDS * RATE)
    time = np.arange(samples) / RATE
    reference = texture.waveform(time, None)
    gain = (TRUTH["stiffness_1"] + TRUTH["stiffness_2"]) / (2 * FORCE_CONSTANT)
    plate = StrangersPlate.of(PlateParameters(delay=samples), WHO, block=samples)  # type: ignore[no-untyped-call]
    plate.play(np.outer(gain * reference, np.ones(2)))
    return Run(time, plate.truth, reference)


def measure() -> dict[str, Run]:
    """Play the same waveform in four ways."""
    texture = white(1)
    return {
        "Constant gain": constant_gain(texture),
        "Open inverse of the free plate": play(texture, make=SensorlessPlate),
        f"Controller of Grigorii et al. 2021, common mode, {CARRIERS} carriers": play(
            OnCarriers(texture), method="paper-common"
        ),
        "inverse, the default": play(texture),
    }


def over_time(run: Run) -> tuple[Any, Any, dict[str, float]]:
    """Middle times (s) and errors under the finger (%) of windows, and of the spans of `JUDGED`, 20 to 500 Hz."""
    reference, error = run.in_band()
    size = round(WINDOW * RATE)
    count = len(error) // size
    whole = rms(reference)
    windows = 100 * rms(error[: count * size, FINGER].reshape(count, size), 1) / whole
    spans = {name: slice(*(round(each * RATE) for each in span)) for name, span in JUDGED.items()}
    judged = {name: 100 * rms(error[at, 0]) / rms(reference[at]) for name, at in spans.items()}
    return (np.arange(count) + 0.5) * WINDOW, windows, judged


def draw(runs: dict[str, Run]) -> Any:
    """Draw a row for each way: its error over time in numbers, and a piece of the motion under the finger."""
    with new_figure((11, 8.4)) as figure:
        axes = figure.subplots(5, 2, sharex="col", width_ratios=[1.5, 1], height_ratios=[2, 2, 2, 2, 1])
        for lane, (name, run), color in zip(axes, runs.items(), (PALE, ORANGE, GREEN, BLUE), strict=False):
            _errors(lane[0], name, run, color)
            _waves(lane[1], run, color)
        axes[0, 1].set_title("Motion under the finger (µm); dashed: as requested")
        axes[3, 1].set_xlabel("time (s)")
        axes[3, 1].tick_params(labelbottom=True)
        axes[4, 1].set_axis_off()
        axes[4, 1].text(0.0, 0.6, NOTE, transform=axes[4, 1].transAxes, va="top", fontsize=8)
        time = np.arange(0.0, SECONDS, 1e-3)
        place = 1e3 * WHO.position(time)
        axes[4, 0].axvspan(*TOUCH, color="#DDEBF5", lw=0)
        axes[4, 0].plot(time, place, color=INK, lw=1.2)
        axes[4, 0].set(ylim=(-30, 30), xlim=(0.0, SECONDS), ylabel="finger\n(mm)", xlabel="time (s)")
        figure.suptitle("White noise of 20-400 Hz, 5 µm rms: a heavy finger touches, slides to and fro, and leaves")
    return figure


def _errors(axes: Any, name: str, run: Run, color: str) -> None:
    """Draw the error over time, and write it where it has settled."""
    time, windows, judged = over_time(run)
    axes.axvspan(*TOUCH, color="#DDEBF5", lw=0)
    axes.semilogy(time, windows, color=color, lw=1.6)
    for what, (start, end) in JUDGED.items():
        middle = (start + end) / 2
        axes.text(middle, 2.5e3, f"{what}: {rounded(judged[what])} %", ha="center", va="center", fontweight="bold")
    axes.axhline(100.0, color=PALE, lw=0.8)
    axes.set(ylim=(0.1, 1e4), ylabel="error (%)", title=name)
    axes.set_yticks([0.1, 1, 10, 100, 1000], ["0.1", "1", "10", "100", "1000"])
    axes.minorticks_off()


def _waves(axes: Any, run: Run, color: str) -> None:
    """Draw what was played and what was requested, 20 to 500 Hz."""
    reference, error = run.in_band()
    here = slice(*(round(each * RATE) for each in ZOOM))
    axes.plot(run.time[here], 1e6 * (reference + error[:, FINGER])[here], color=color, lw=2.2)
    axes.plot(run.time[here], 1e6 * reference[here], color=INK, lw=1.0, ls="--")
    axes.set(xlim=ZOOM, ylim=(-22.0, 22.0))
