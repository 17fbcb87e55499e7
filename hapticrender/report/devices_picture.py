"""Draw one texture on several devices in skin velocity: the waveform, and the error of every band."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticrender.formatting import quantity
from hapticrender.recordings.recording import Recording
from hapticrender.report.figure import BLUE, GREEN, INK, ORANGE, RED, legend, new_figure, save
from hapticrender.report.picture import DASHED, FLOOR, QUANTITIES, error_axis
from hapticrender.skin import skin_bands, skin_waveform

COLOURS, MARKERS = (BLUE, ORANGE, GREEN, RED), "os^D"
PERIODS = 3.0  # of the lowest band
BOUND = 5.0  # %: how far devices may differ


def plot_devices(recordings: Mapping[str, Recording], path: str | os.PathLike[str]) -> None:
    """Draw recordings of one texture, by the name of their device, into a .png, .svg or .pdf."""
    save(draw_devices(recordings), path)


def draw_devices(recordings: Mapping[str, Recording]) -> Any:
    """Draw into a new ``matplotlib.figure.Figure``; see `plot_devices`."""
    with new_figure((12.5, 6.8)) as figure:
        grid = figure.add_gridspec(2, len(recordings), height_ratios=[1.15, 1])
        first: Any = None
        for i, (device, recording) in enumerate(recordings.items()):
            first = first or figure.add_subplot(grid[0, 0])
            axes = first if i == 0 else figure.add_subplot(grid[0, i], sharey=first)
            _waveform(axes, recording, device, COLOURS[i % len(COLOURS)])
            axes.set_ylabel("skin velocity (mm/s)" if i == 0 else "")
            axes.tick_params(labelleft=i == 0)
        figure.legend(*first.get_legend_handles_labels(), loc="outside upper right", ncols=2)
        _bands(figure.add_subplot(grid[1, :]), recordings)
        texture = next(iter(recordings.values())).scene.texture
        figure.suptitle(
            f"Predicted skin velocity on {len(recordings)} devices ({_name(texture)})",
            x=0.01, ha="left", fontsize=12.5, fontweight="bold",
        )  # fmt: skip
    return figure


def _name(texture: Any) -> str:
    kind = getattr(texture, "kind", type(texture).__name__)
    partials = getattr(texture, "partials", None)
    return f"{kind}, {len(partials)} partials" if partials else str(kind)


def _waveform(axes: Any, recording: Recording, device: str, colour: str) -> None:
    """Draw a few periods of the bands' target and achieved skin velocity at the end of the run."""
    lowest = min(band.frequency for band in skin_bands(recording))
    seconds = PERIODS / lowest
    start = len(recording) / recording.rate - 0.2 - seconds
    start = np.ceil(start * lowest) / lowest  # the same phase on every device
    time, target, achieved = skin_waveform(recording, start, seconds)
    milliseconds = 1e3 * (time - time[0])
    axes.plot(milliseconds, 1e3 * achieved, color=colour, lw=2.0, label="achieved (from the envelopes)")
    axes.plot(milliseconds, 1e3 * target, color=INK, lw=1.0, ls=DASHED, label="target")
    axes.set(title=f"{device}, by {QUANTITIES.get(recording.header.unit, 'motion')}", xlabel="time (ms)")
    beside = f"beside the bands {quantity(recording.summary()['residual_rms'], recording.header.unit)} rms"
    axes.text(0.98, 0.02, beside, transform=axes.transAxes, ha="right", va="bottom", fontsize=8)
    axes.set_ymargin(0.12)
    axes.set_xlim(0, milliseconds[-1])


def _bands(axes: Any, recordings: Mapping[str, Recording]) -> None:
    """Draw the magnitude of the error of every band's skin velocity on every device, with its sign as text."""
    width, ticks = 0.8 / len(recordings), []
    for i, (device, recording) in enumerate(recordings.items()):
        bands = skin_bands(recording)
        ticks = [f"{band.frequency:.4g} Hz, target {1e3 * band.target:.3g} mm/s" for band in bands]
        place = np.arange(len(bands)) + (i - (len(recordings) - 1) / 2) * width
        error = np.array([100 * band.error for band in bands])
        size, colour = np.maximum(np.abs(error), FLOOR), COLOURS[i % len(COLOURS)]
        axes.plot(place, size, MARKERS[i % len(MARKERS)], color=colour, ms=8, label=device)
        for x, y, value in zip(place, size, error, strict=True):
            axes.annotate(f"{value:+.2f} %", (x, y), xytext=(8, 0), textcoords="offset points", va="center", fontsize=8)
    axes.axhline(BOUND, color=INK, lw=1, ls=DASHED, label=f"{BOUND:g} %")
    axes.set(ylim=error_axis(axes, BOUND), xlim=(-0.6, len(ticks) - 0.4))
    axes.set_xticks(range(len(ticks)), ticks)
    axes.set(ylabel="error (%)", title="Error of the skin velocity of each band")
    legend(axes)
