"""Draw white noise under a finger that touches, slides and leaves: constant gain, open inverse, the paper, and ours."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from benchmarks.charts.style import BLUE, GREEN, INK, ORANGE, PALE, new_figure
from hapticrender import Finger, Recorded, Scene, prepare, run

RATE, SECONDS, RMS = 5000, 5.0, 5e-6  # Hz, s, m
TOUCH = (1.5, 3.5)  # s
WINDOW = 0.05  # s
ZOOM = (2.0, 2.04)  # s


def scene(**texture: Any) -> Scene:
    """White noise of 20 to 400 Hz on the plate, under a heavy finger for a while."""
    values = np.random.default_rng(1).standard_normal(round((SECONDS + 1) * RATE))
    return Scene(
        texture=Recorded(samples=values, rate=RATE, amplitude=4 * RMS, passband=(20.0, 400.0), **texture),
        finger=Finger.sliding(speed=0.1, span=0.05, normal_load=0.8, mechanics="heavy", touches=(TOUCH,)),
        duration=SECONDS,
        name="story",
    )


def constant_gain() -> tuple[Any, Any]:
    """Reference and motion with a drive of K/(2 K_T) times the reference."""
    rendering = prepare(scene())
    plate: Any = rendering.plant
    time = np.arange(round(SECONDS * RATE)) / RATE
    reference = rendering.waveform(time, np.full(time.size, np.nan))
    gain = rendering.model.stiffness[0, 0] / rendering.model.force_from_drive[0].sum()
    return reference, plate.run(np.outer(gain * reference, np.ones(2))).motion


def open_inverse() -> tuple[Any, Any]:
    """Reference and motion under the inverse of the free plate, which learns nothing."""
    rendering = prepare(scene())

    def controller() -> Any:
        made: Any = rendering.controller()
        made.law["learns"], made.law["prior"][:] = 0, 0.0
        return made

    recording = run(replace(rendering, controller=controller))
    return recording.reference, recording.motion


def method(name: str, **texture: Any) -> tuple[Any, Any]:
    """Reference and motion with a method of the library."""
    recording = run(prepare(scene(**texture), method=name))
    return recording.reference, recording.motion


def draw() -> Any:
    """Play all four and draw their errors over time, and a piece of the waveform under the finger."""
    plays = {
        "constant gain": (constant_gain(), PALE),
        "inverse of the free plate, open loop": (open_inverse(), ORANGE),
        "paper's controller, 8 carriers": (method("paper-common", carriers=8), GREEN),
        "inverse, the default": (method("inverse"), BLUE),
    }
    with new_figure((11, 6.6)) as figure:
        errors, waves, finger = figure.subplots(3, 1, height_ratios=[3, 2, 1])
        for name, ((reference, motion), color) in plays.items():
            time, error = over_time(reference, motion[:, 0])
            late = error[(time > TOUCH[0] + 0.5) & (time < TOUCH[1] - 0.25)]
            share = 100 * np.sqrt(np.mean(late**2))
            label = f"{name}: {share:.{0 if share > 10 else 1}f} % under the finger"
            errors.semilogy(time, 100 * error, color=color, lw=1.8 if color == BLUE else 1.2, label=label)
            here = slice(*(round(each * RATE) for each in ZOOM))
            if color != PALE:
                moved = motion[here, 0] - motion[here, 0].mean() + reference[here].mean()
                waves.plot(np.arange(here.start, here.stop) / RATE, 1e6 * moved, color=color, lw=1.4)
        waves.plot(np.arange(here.start, here.stop) / RATE, 1e6 * reference[here], color=INK, lw=1.0, ls="--")
        errors.axhspan(errors.get_ylim()[0], 10.0, color="#EFEFEF", lw=0)
        errors.set(ylabel="error of the centre, 50 ms (%)", ylim=(0.1, 20_000.0), xlim=(0.0, SECONDS))
        errors.legend(loc="upper left", ncols=2)
        waves.set(
            ylabel="motion (µm)", xlim=ZOOM, title="Under the sliding finger, the sag taken off; dashed: as asked for"
        )
        span = np.arange(0.0, SECONDS, 1e-3)
        position = np.where((span > TOUCH[0]) & (span < TOUCH[1]), scene().finger.position(span), np.nan)
        finger.fill_between(span, -30, 30, where=np.isfinite(position), color="#DDEBF5", lw=0)
        finger.plot(span, 1e3 * position, color=INK, lw=1.2)
        finger.set(ylim=(-30, 30), xlim=(0.0, SECONDS), ylabel="finger (mm)", xlabel="time (s)")
        figure.suptitle("White noise of 20-400 Hz, 5 µm rms: a heavy finger touches, slides to and fro, and leaves")
    return figure


def over_time(reference: Any, motion: Any) -> tuple[Any, Any]:
    """Middle times (s) and ``rms(y - r)/rms(r)`` in windows, 20 to 500 Hz."""
    sos = butter(4, [20.0, 500.0], "bandpass", fs=RATE, output="sos")
    size = round(WINDOW * RATE)
    count = len(motion) // size
    error, whole = (sosfiltfilt(sos, each)[: count * size] for each in (motion - reference, reference))
    level = np.sqrt((error.reshape(count, size) ** 2).mean(axis=1) / np.mean(whole**2))
    return (np.arange(count) + 0.5) * WINDOW, level
