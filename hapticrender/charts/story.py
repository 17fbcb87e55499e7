"""The picture that tells the story: two methods under the same finger, which touches, slides and leaves."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from hapticrender.charts.figures import BLUE, GREEN, INK, ORANGE, PALE, new_figure, save
from hapticrender.loop import render
from hapticrender.recordings.recording import Recording
from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.scene import Scene

METHODS = (("paper-common", "the paper's controller, common mode"), ("h2", "h2, the default"))
SCENE = Scene(
    texture=Grating(frequency=170.0, amplitude=50e-6),
    finger=Finger.sliding(speed=0.1, span=0.05, normal_load=0.8, mechanics="heavy", touches=((1.5, 3.5),)),
    duration=5.0,
    name="story",
)


def draw_story(path: str | os.PathLike[str], scene: Scene = SCENE) -> None:
    """Render `scene` with both methods and draw them side by side.

    Parameters
    ----------
    path : path-like
        PNG to write.
    scene : Scene
        A grating and a finger; by default 170 Hz, 50 um, a heavy finger that slides from 1.5 to 3.5 s.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    with new_figure((11, 5.4)) as figure:
        recordings = [(title, render(scene, method=name)) for name, title in METHODS]
        lanes = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=[3, 1])
        for column, (title, recording) in enumerate(recordings):
            _motion(lanes[0, column], title, recording)
            _finger(lanes[1, column], recording)
        lanes[0, 0].set_ylabel("peak amplitude (µm)")
        lanes[1, 0].set_ylabel("finger (mm)")
        lanes[0, 1].legend(loc="upper right", ncols=4)
        frequency, amplitude = recordings[0][1].bands.frequency[0], 1e6 * abs(recordings[0][1].target[-1, 0])
        figure.suptitle(
            f"A grating of {frequency:g} Hz, {amplitude:g} µm: a heavy finger touches, slides to and fro, and leaves",
            fontweight="bold",
            fontsize=11,
        )
        save(figure, path)


def _motion(axes: Any, title: str, recording: Recording) -> None:
    """Amplitude at the centre and the ends over time, and what was wanted."""
    envelopes = recording.envelopes
    wanted = 1e6 * abs(envelopes.wanted[:, 0])
    found = 1e6 * abs(envelopes.achieved[:, :, 0])
    axes.fill_between(envelopes.time, 0.9 * wanted, 1.1 * wanted, color="#E9E9E9", label="10 %: felt by nobody")
    for place, (color, name) in enumerate(((BLUE, "centre"), (ORANGE, "end 1"), (GREEN, "end 2"))):
        axes.plot(envelopes.time, found[:, place], color=color, lw=1.8 if place == 0 else 1.0, label=name)
    axes.plot(envelopes.time, wanted, color=INK, lw=1.0, ls="--")
    late = envelopes.time > 1.0
    worst = 100 * np.max(abs(found[late] / wanted[late, None] - 1.0))
    axes.set_title(f"{title}: {worst:.0f} % off at worst")
    axes.set_ylim(0.0, 2.0 * wanted.max())


def _finger(axes: Any, recording: Recording) -> None:
    """Where the finger is while it touches."""
    time = recording.time
    axes.plot(time, 1e3 * recording.position, color=INK, lw=1.2)
    touched = np.isfinite(recording.position)
    axes.fill_between(time, -30, 30, where=touched, color="#DDEBF5", lw=0)
    axes.set_ylim(-30, 30)
    axes.set_xlabel("time (s)")
    axes.axhline(0.0, color=PALE, lw=0.5)
