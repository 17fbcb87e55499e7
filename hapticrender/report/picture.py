"""Draw a recording: target and achieved amplitude, a waveform close-up, errors, drive, finger and verdict."""

import itertools
import os
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from hapticrender.formatting import percent
from hapticrender.protocols import Array
from hapticrender.recordings.envelopes import RUNAWAY
from hapticrender.recordings.recording import Recording
from hapticrender.recordings.waveform_figures import LOOSER
from hapticrender.report.figure import BLUE, GREEN, INK, ORANGE, PALE, RED, check_format, legend, new_figure, save
from hapticrender.report.text import verdict

PLACES = ((BLUE, "o"), (ORANGE, "<"), (GREEN, ">"))
COILS = (BLUE, ORANGE, GREEN, RED)
DASHED = (0, (4, 2))
COLUMNS = 1400  # points that a full-width panel can show
QUANTITIES = {"m": "displacement", "N": "friction", "m/s": "skin velocity"}
PERIODS = 4  # of the strongest carrier in the close-up
LANE = 0.95  # inch: a lane of drive beyond the two of a plate
GROUP = 64  # stretches of an outline that are read at once
VERDICTS = {
    "passed": ("✓", "#00694E"),
    "passed in band": ("✓", "#00694E"),
    "failed": ("✗", "#A84300"),
    "not judged": ("–", "#555555"),
}
FLOOR = 1e-5  # relative error below which a dot stands at the foot of its panel


def plot(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Draw a recording into one .png, .svg or .pdf; an older file is replaced when the new one is whole."""
    path = check_format(path)
    save(draw(recording), path)


def draw(recording: Recording) -> Any:
    """Draw a recording into a new ``matplotlib.figure.Figure``, apart from pyplot and its global state; see `plot`."""
    touched = bool(np.isfinite(outline(recording, "position")[1]).any())
    coils = recording.header.drive_channels
    height = (10.2 if touched else 8.6) + LANE * max(0, coils - 2)
    with new_figure((11, height), pads=(0.12, 0.07)) as figure:
        summary = recording.summary()
        lanes = [0.8] * coils + ([0.9, 0.9] if touched else [])
        heights = [0.5, 2.3, 2.2, *lanes]
        grid = figure.add_gridspec(len(heights), 2, height_ratios=heights, width_ratios=[1.35, 1])
        _head(figure.add_subplot(grid[0, :]), summary, touched)
        amplitude = figure.add_subplot(grid[1, :])
        (_amplitude if summary["bands"] else _course)(amplitude, recording, summary)
        _close_up(figure.add_subplot(grid[2, 0]), recording)
        _errors(figure.add_subplot(grid[2, 1]), recording)
        below = [figure.add_subplot(grid[3 + i, :], sharex=amplitude) for i in range(len(lanes))]
        _drive(below[:coils], recording, summary)
        if touched:
            _finger(below[-2], below[-1], recording)
        for axes in below[:-1]:
            axes.tick_params(labelbottom=False)
        below[-1].set_xlabel("time (s)")
        figure.align_ylabels([amplitude, *below])
        amplitude.set_xlim(0, max(len(recording), 1) / recording.rate)
    return figure


def drawn(unit: str) -> tuple[float, str]:
    """Scale and unit in which a quantity of `unit` (SI) is drawn.

    >>> drawn("m")
    (1000000.0, 'µm')
    """
    return (1e6, "µm") if unit == "m" else (1e3, f"m{unit}")


def _head(axes: Any, summary: dict[str, Any], touched: bool) -> None:
    axes.axis("off")
    axes.set(xlim=(0, 1), ylim=(0, 1))
    finger = "" if touched else " · no finger"
    finger += " · motion from the sensors" if summary["motion_source"] == "sensors" else ""
    name = textwrap.shorten(summary["scene"], 50, placeholder=" …") or "(no name)"
    axes.text(0, 1.0, name, fontsize=15, fontweight="bold", va="top")
    how = f"{summary['device']} · method {summary['method']} · seed {summary['seed']} · {summary['rate']:g} Hz{finger}"
    axes.text(1, 0.92, how, color="#555555", ha="right", va="top")
    mark, colour = VERDICTS[summary["verdict"]]
    sentence = textwrap.shorten(verdict(summary), 150, placeholder=" …")
    axes.text(0, 0.02, f"{mark} {sentence}", color=colour, fontweight="bold", va="bottom")


def _amplitude(axes: Any, recording: Recording, summary: dict[str, Any]) -> None:
    """Target and achieved amplitude over time, all bands together."""
    envelopes, header = recording.envelopes, recording.header
    shown = np.any(envelopes.readable, axis=0)
    readable = envelopes.readable[:, shown].all(axis=1) & envelopes.finite
    scale, unit = drawn(header.unit)
    achieved = scale * _together(envelopes.achieved[:, :, shown]) / np.array(header.profile or 1.0)
    achieved[~readable] = np.nan
    time, _, _, target = _stretches(
        recording, lambda start, stop: scale * _together(recording.read("target", start, stop)[:, shown])
    )
    low, high = (1 - header.tolerance) * target, (1 + header.tolerance) * target
    for i, (name, (colour, _)) in enumerate(zip(header.places, itertools.cycle(PLACES), strict=False)):
        style = {"color": colour, "lw": 1.1 if i else 1.8, "marker": "." if len(achieved) < 500 else "", "ms": 3}
        if np.isfinite(achieved[:, i]).any():
            axes.plot(envelopes.time, achieved[:, i], label=name, zorder=4 - i, **style)
    axes.plot(time, target, color=INK, lw=1.1, ls=DASHED, label="target", zorder=5)
    axes.fill_between(time, low, high, color=PALE, alpha=0.2, lw=0, label="tolerance", zorder=0)
    if summary["verdict"] != "not judged":
        axes.axvline(summary["judged_from"], color=PALE, lw=0.9, ls=":", label="judged from here")
    several = "" if shown.sum() <= 1 else f" ({int(shown.sum())} bands: root of the sum of squares)"
    axes.set(title=f"Peak amplitude{several}", ylabel=f"amplitude ({unit})")
    axes.set_ylim(0, 1.25 * max(np.nanmax(achieved, initial=0), high.max(initial=0)) or 1)
    legend(axes)


def _course(axes: Any, recording: Recording, summary: dict[str, Any]) -> None:
    """Range that texture and motion cover over time, of a texture without bands."""
    scale, unit = drawn(recording.header.unit)
    for name, colour, label in (("motion", BLUE, recording.header.places[0]), ("reference", INK, "texture")):
        time, low, high = outline(recording, name)
        low, high = (scale * _bounded(values.reshape(len(time), -1)[:, 0]) for values in (low, high))
        axes.fill_between(time, low, high, color=colour, alpha=0.5, lw=0.5, label=label)
    axes.axvline(summary["judged_from"], color=PALE, lw=0.9, ls=":", label="judged from here")
    axes.set(title="Waveform", ylabel=f"{QUANTITIES.get(recording.header.unit, 'motion')} ({unit})")
    legend(axes)


def _bounded(values: Array) -> Array:
    """Values (SI) with a gap where they are no numbers, or beyond `RUNAWAY`."""
    return np.where(np.abs(values) < RUNAWAY, values, np.nan)


def _together(envelope: Array) -> Array:
    return np.sqrt((np.abs(envelope) ** 2).sum(axis=-1))


def _close_up(axes: Any, recording: Recording) -> None:
    """Draw a few periods of the reference and of the true waveform at the centre, at the end of the judged time."""
    start, stop = _close_span(recording)
    time = np.arange(start, stop) / recording.rate
    scale, unit = drawn(recording.header.unit)
    target = scale * recording.read("reference", start, stop)
    motion = scale * _bounded(recording.read("motion", start, stop)[:, 0])
    offset = np.nan_to_num(np.mean(motion - target)) if motion.size else 0.0  # a stretch holds parts of periods
    milliseconds = 1e3 * (time - time[:1])
    axes.plot(milliseconds, motion - offset, color=BLUE, lw=1.8, label=recording.header.places[0])
    axes.plot(milliseconds, target, color=INK, lw=1.1, ls=DASHED, label="target")
    begin = f"{time[0]:.2f} s" if time.size else "the start"
    level = f", offset of {offset:.3g} {unit} removed" if abs(offset) > 0.05 * np.abs(target).max(initial=0) else ""
    quantity = QUANTITIES.get(recording.header.unit, "motion")
    axes.set(title=f"Waveform from {begin}{level}", xlabel="time (ms)", ylabel=f"{quantity} ({unit})")
    axes.margins(x=0, y=0.12)
    legend(axes)


def _close_span(recording: Recording) -> tuple[int, int]:
    """First and last sample of a few periods near the end of the judged time, or at the end where nothing is judged."""
    envelopes, rate = recording.envelopes, recording.rate
    judged = np.flatnonzero(envelopes.judged.any(axis=1))
    if not judged.size:
        return max(0, len(recording) - round(0.1 * rate)), len(recording)
    chosen = judged[int(0.8 * judged.size)]
    frequency = envelopes.frequency[chosen]
    strength = np.where(envelopes.judged[chosen], np.abs(envelopes.target[chosen]), 0)
    seconds = max(PERIODS / frequency[strength.argmax()], 1.5 / frequency[strength >= 0.1 * strength.max()].min())
    stop = min(len(recording), round((envelopes.start[chosen] + envelopes.window) * rate))
    return max(0, stop - round(seconds * rate)), stop


def _errors(axes: Any, recording: Recording) -> None:
    """Error of every third octave at every place, against its bound."""
    figures = {place: each["third_octaves"] for place, each in recording.waveform["places"].items() if each}
    for i, (place, thirds) in enumerate(figures.items()):
        colour, marker = PLACES[i % len(PLACES)]
        values = [100 * max(value, FLOOR) for value in thirds.values()]
        axes.plot(range(len(values)), values, marker, color=colour, ms=4, label=place.replace("_", " "))
    names = [name.removesuffix(" Hz") for name in next(iter(figures.values()), {})]
    allowed = 100 * LOOSER * recording.header.tolerance
    axes.axhline(allowed, color=INK, lw=1, ls=DASHED, label="bound")
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    low, high = min(low, allowed / 30) / 1.5, 1.5 * max(high, allowed)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    axes.grid(axis="x", visible=False)
    axes.axhspan(allowed, high, color=RED, alpha=0.08, lw=0)
    axes.set_ylim(low, high)
    axes.text(0.01, allowed, f"{allowed:.3g} %", fontsize=8, va="bottom", transform=axes.get_yaxis_transform())
    axes.set_xticks(range(len(names)), names, fontsize=7.5)
    axes.set_xlim(-0.6, max(len(names), 1) - 0.4)
    axes.set(title="Third octaves", ylabel="error (%)", xlabel="Hz")
    legend(axes, columns=4)


def _drive(lanes: list[Any], recording: Recording, summary: dict[str, Any]) -> None:
    """Draw the drive of every channel in its lane; a long run as the range that each column of pixels covers."""
    units = recording.header.drive_units
    time, lows, highs = outline(recording, "drive")
    lows, highs = _bounded(lows), _bounded(highs)
    limit: Any = recording.header.drive_limit if len(set(units)) == 1 else None
    largest = np.nanmax(np.maximum(np.abs(lows), np.abs(highs)), axis=0, initial=0.0)
    peaks = {unit: max(largest[[each == unit for each in units]]) or 1e-3 for unit in units}
    near = limit is not None and peaks[units[0]] > 0.4 * limit
    for i, (axes, unit) in enumerate(zip(lanes, units, strict=True)):
        reach = 1.12 * (max(peaks[unit], limit) if near else peaks[unit])
        axes.fill_between(time, lows[:, i], highs[:, i], color=COILS[i % len(COILS)], lw=0.5)
        for sign in (-1, 1) if near else ():
            axes.axhline(sign * limit, color=INK, lw=1, ls=DASHED)
        axes.set(ylabel=f"drive {i + 1} ({unit})", ylim=(-reach, reach))
        if near:
            axes.set_yticks([-limit, 0, limit], [f"{tick:.3g}" for tick in (-limit, 0, limit)])
    stated = "" if limit is None else f", limit ±{limit:.3g} {units[0]}" + (" (dashed)" if near else "")
    if summary["saturated_share"]:
        stated += f", saturated in {percent(summary['saturated_share'])} of the samples"
    lanes[0].set_title(f"Drive{stated}")


def _finger(upper: Any, lower: Any, recording: Recording) -> None:
    time, low, high = outline(recording, "position")
    upper.plot(time, 1e3 * (low + high) / 2, color=INK, lw=1.3)
    upper.set(title="Finger", ylabel="position (mm)")
    time, low, high = outline(recording, "normal_load")
    lower.fill_between(time, 0, (low + high) / 2, color=GREEN, alpha=0.25, lw=0)
    lower.plot(time, (low + high) / 2, color=GREEN, lw=1.3)
    lower.set(ylabel="load (N)", ylim=(0, 1.15 * np.nanmax(high, initial=0.0) or 1))


def outline(recording: Recording, name: str) -> tuple[Array, Array, Array]:
    """Middle (s), least and greatest value of a signal in each of at most `COLUMNS` stretches; NaN with a NaN in it."""
    return _stretches(recording, lambda start, stop: recording.read(name, start, stop))[:3]


def _stretches(recording: Recording, read: Callable[[int, int], Array]) -> tuple[Array, Array, Array, Array]:
    """Middle (s), least, greatest and mean value of ``read(start, stop)`` in each stretch, `GROUP` read at once."""
    edges = np.linspace(0, len(recording), min(COLUMNS, len(recording)) + 1).astype(int)
    found = []
    for i in range(0, len(edges) - 1, GROUP):
        part = edges[i : i + GROUP + 1]
        values, starts = read(part[0], part[-1]), part[:-1] - part[0]
        sums = np.add.reduceat(values, starts).T / np.diff(part)
        found.append((np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts), sums.T))
    if not found:
        empty = read(0, 0)
        return np.empty(0), empty, empty, empty
    low, high, mean = (np.concatenate(each) for each in zip(*found, strict=True))
    return (edges[:-1] + edges[1:] - 1) / (2 * recording.rate), low, high, mean
