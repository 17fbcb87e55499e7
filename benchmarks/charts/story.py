"""Draw two methods under the same finger, which touches, slides and leaves."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.charts.style import BLUE, GREEN, INK, ORANGE, PALE, new_figure
from hapticrender import Finger, Grating, Recording, Scene, render

METHODS = {"paper-common": "paper's controller, common mode", "h2": "h2, the default"}
SCENE = Scene(
    texture=Grating(frequency=170.0, amplitude=50e-6),
    finger=Finger.sliding(speed=0.1, span=0.05, normal_load=0.8, mechanics="heavy", touches=((1.5, 3.5),)),
    duration=5.0,
    name="story",
)


def draw(scene: Scene = SCENE) -> Any:
    """Render a grating with both methods and draw them side by side."""
    recordings = {title: render(scene, method=name) for name, title in METHODS.items()}
    with new_figure((11, 5.4)) as figure:
        lanes = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=[3, 1])
        for column, (title, recording) in enumerate(recordings.items()):
            _motion(lanes[0, column], title, recording)
            _finger(lanes[1, column], recording)
        lanes[0, 0].set_ylabel("peak amplitude (µm)")
        lanes[1, 0].set_ylabel("finger (mm)")
        lanes[0, 1].legend(loc="upper right", ncols=4)
        frequency, amplitude = recording.bands.frequency[0], 1e6 * abs(recording.target[-1, 0])
        figure.suptitle(f"{frequency:g} Hz, {amplitude:g} µm: a heavy finger touches, slides to and fro, and leaves")
    return figure


def _motion(axes: Any, title: str, recording: Recording) -> None:
    """Plot the amplitude at the centre and the ends over time, and its target."""
    envelopes = recording.envelopes
    wanted, found = 1e6 * abs(envelopes.target[:, 0]), 1e6 * abs(envelopes.achieved[:, :, 0])
    axes.fill_between(envelopes.time, 0.9 * wanted, 1.1 * wanted, color="#E9E9E9", label="10 %: not noticeable")
    for place, (color, name) in enumerate(((BLUE, "centre"), (ORANGE, "end 1"), (GREEN, "end 2"))):
        axes.plot(envelopes.time, found[:, place], color=color, lw=1.8 if place == 0 else 1.0, label=name)
    axes.plot(envelopes.time, wanted, color=INK, lw=1.0, ls="--")
    late = envelopes.time > 1.0
    worst = 100 * np.max(abs(found[late] / wanted[late, None] - 1.0))
    axes.set(title=f"{title}: largest error {worst:.0f} %", ylim=(0.0, 2.0 * wanted.max()))


def _finger(axes: Any, recording: Recording) -> None:
    """Plot the finger's position while it touches."""
    axes.fill_between(recording.time, -30, 30, where=np.isfinite(recording.position), color="#DDEBF5", lw=0)
    axes.plot(recording.time, 1e3 * recording.position, color=INK, lw=1.2)
    axes.axhline(0.0, color=PALE, lw=0.5)
    axes.set(ylim=(-30, 30), xlabel="time (s)")
