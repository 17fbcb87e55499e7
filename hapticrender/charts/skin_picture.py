"""One texture on several devices, side by side in skin velocity: the waveform, and every band against its target."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from hapticrender import wording
from hapticrender.charts.figures import BLUE, GREEN, INK, ORANGE, RED, new_figure, save
from hapticrender.charts.picture import QUANTITIES
from hapticrender.recordings.recording import Recording
from hapticrender.skin import felt_bands, residual_velocity, skin_waveform
from hapticrender.touch.perception import HIGHEST

COLOURS = (BLUE, ORANGE, GREEN, RED)
PERIODS = 3.0  # of the lowest band
BOUND = 5.0  # %: how far devices may differ


def plot_devices(recordings: Mapping[str, Recording], path: str | os.PathLike[str]) -> None:
    """Draw recordings of one texture, by the name of their device, into a PNG.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
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
        _bands(figure.add_subplot(grid[1, :]), recordings)
        name = next(iter(recordings.values())).scene.texture
        figure.suptitle(
            f"One texture on {len(recordings)} devices, as the skin is predicted to feel it ({_said(name)})",
            x=0.01, ha="left", fontsize=12.5, fontweight="bold",
        )  # fmt: skip
    return figure


def _said(texture: Any) -> str:
    kind = getattr(texture, "kind", type(texture).__name__)
    partials = getattr(texture, "partials", None)
    return f"{kind}, {len(partials)} partials" if partials else str(kind)


def _waveform(axes: Any, recording: Recording, device: str, colour: str) -> None:
    """Show a few periods of the bands' wanted and achieved skin velocity, late in the run, and what is beside them."""
    lowest = min(band.frequency for band in felt_bands(recording))
    seconds = PERIODS / lowest
    start = len(recording) / recording.rate - 0.2 - seconds
    start = np.ceil(start * lowest) / lowest  # the same phase on every device
    time, wanted, achieved = skin_waveform(recording, start, seconds)
    milliseconds = 1e3 * (time - time[0])
    axes.plot(milliseconds, 1e3 * achieved, color=colour, lw=2.0, label="achieved")
    axes.plot(milliseconds, 1e3 * wanted, color=INK, lw=1.0, ls=(0, (4, 2)), label="wanted")
    quantity = QUANTITIES.get(recording.header.unit, "motion")
    axes.set(title=f"{device}, by {quantity}:\nits bands, from their envelopes", xlabel="time (ms)")
    beside = wording.quantity(residual_velocity(recording), "m/s")
    axes.text(
        0.98, 0.02, f"beside them {beside} rms, up to {wording.short(HIGHEST, 'Hz')}",
        transform=axes.transAxes, ha="right", va="bottom", fontsize=8,
    )  # fmt: skip
    axes.margins(x=0, y=0.18)
    axes.legend(loc="upper right", ncols=2, borderaxespad=0.1)


def _bands(axes: Any, recordings: Mapping[str, Recording]) -> None:
    """Error of every band's skin velocity on every device."""
    width = 0.8 / len(recordings)
    ticks: list[str] = []
    for i, (device, recording) in enumerate(recordings.items()):
        bands = felt_bands(recording)
        ticks = [f"{band.frequency:.4g} Hz\n{1e3 * band.wanted:.3g} mm/s" for band in bands]
        place = np.arange(len(bands)) + (i - (len(recordings) - 1) / 2) * width
        error = np.array([100 * band.error for band in bands])
        axes.bar(place, error, 0.92 * width, color=COLOURS[i % len(COLOURS)], label=device, zorder=3)
        for x, value in zip(place, error, strict=True):
            axes.annotate(
                f"{value:+.2f}", (x, value), xytext=(0, 3 if value >= 0 else -3), textcoords="offset points",
                ha="center", va="bottom" if value >= 0 else "top", fontsize=8,
            )  # fmt: skip
    for sign in (-1, 1):
        axes.axhline(sign * BOUND, color=INK, lw=1, ls=(0, (4, 2)))
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_xticks(range(len(ticks)), ticks)
    axes.grid(axis="x", visible=False)
    axes.set(ylim=(-1.35 * BOUND, 1.5 * BOUND), ylabel="error (%)")
    axes.set_title("Skin velocity of each band against the wanted one; dashed: how far devices may differ")
    axes.legend(loc="upper right", ncols=len(recordings), borderaxespad=0.1)
