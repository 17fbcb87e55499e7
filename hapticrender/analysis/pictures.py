"""Draw what the analysis of recordings found: load and impedance over time, over the load, and over frequency."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.analysis.models import FEWEST, LOAD_CLASSES, FingerFit, Samples, fit_finger, weighted_mean
from hapticrender.analysis.output import NAMES, SURE, Fits, page_of
from hapticrender.analysis.records import DOUBTFUL, KINDS, LOADED, UNLOADED, FingerRecord, Series
from hapticrender.protocols import Array
from hapticrender.recordings.formats import MissingExtra
from hapticrender.report.figure import BLUE, INK, ORANGE, PALE, legend, new_figure, save

MOST_BANDS = 8  # in one panel
SHADES = {UNLOADED: "#DDDDDD", DOUBTFUL: "#F6DDB0"}
COLOURS = {2: ORANGE, 4: BLUE}
POINTS = 1500  # of a curve over time


def draw(records: FingerRecord | Sequence[FingerRecord], folder: str | os.PathLike[str]) -> Path:
    """Draw one or several recordings into `folder`, which is made where it is not there; return its page.

    Load, impedance and motion over time (``time-1.png`` and so on, one a recording); as Grigorii et al. 2021 the
    impedance over the load (Fig. 8 C, ``load.png``), and over frequency with fits (Fig. 9, ``frequency.png``);
    ``index.html`` has them, the parameters with their intervals, and what could not be measured.  A picture without
    data is left out: that over the load where the loads differ by less than 1 %.  Without matplotlib there are no
    pictures, and a warning.

    Raises ValueError without a recording, OSError where the folder cannot be written.
    """
    records = [records] if isinstance(records, FingerRecord) else list(records)
    if not records:
        raise ValueError("records is empty: must be at least one FingerRecord")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    fits = fit_all(records)
    drawn: dict[str, Any] = {f"time-{i}.png": partial(draw_time, each) for i, each in enumerate(records, 1)}
    if Samples.of(records).loads_differ:
        drawn["load.png"] = partial(draw_load, records, fits)
    if fits:
        drawn["frequency.png"] = partial(draw_frequency, records, fits)
    try:
        for name, drawing in drawn.items():
            drawing(folder / name)
    except MissingExtra as error:
        warnings.warn(f"{folder}: no pictures: {error}", stacklevel=2)
        drawn = {}
    page = folder / "index.html"
    page.write_text(page_of(records, fits, list(drawn)), encoding="utf-8")
    return page


def fit_all(records: Sequence[FingerRecord]) -> Fits:
    """Fit both orders to every class of loads that has enough data, all recordings together, the better one first."""
    found: Fits = {}
    for name, loads in LOAD_CLASSES.items():
        if Samples.of(records, loads).carriers >= FEWEST[2]:
            fit = fit_finger(records, loads=loads)
            found[name] = {fit.order: fit}
            if isfinite(fit.bic_margin):
                found[name][6 - fit.order] = fit_finger(records, 6 - fit.order, loads=loads)
    return found


def draw_time(record: FingerRecord, path: str | os.PathLike[str]) -> None:
    """Draw load, impedance of every band, and position and velocity over time, unloaded spans shaded."""
    with new_figure((9, 7.2), pads=(0.1, 0.08)) as figure:
        panels = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.5, 1.0))
        for axes, drawing in zip(panels, (_load, _impedance, _kinematics), strict=True):
            drawing(axes, record)
            for kind, colour in SHADES.items():
                for segment in record.of_kind(kind):
                    axes.axvspan(segment.start, segment.stop, color=colour, alpha=0.7, lw=0, zorder=0)
        panels[-1].set(xlabel="time (s)", xlim=(record.time[0], record.time[-1]))
        figure.align_ylabels(panels)
        save(figure, path)


def draw_load(records: Sequence[FingerRecord], fits: Fits, path: str | os.PathLike[str]) -> None:
    """Draw the impedance over the load: windows as dots, the better fit of each class of loads as lines."""
    bins = Samples.of(records).by_frequency()
    chosen = [bins[i] for i in _shown(np.ones((1, len(bins))))]
    with new_figure((7, 4.2), pads=(0.1, 0.05)) as figure:
        axes = figure.subplots()
        for samples, colour in zip(chosen, _colours(len(chosen)), strict=True):
            frequency = np.median(samples.frequency)
            label = f"{frequency:.0f} Hz"
            axes.plot(samples.load, np.abs(samples.value), ".", color=colour, ms=2.5, alpha=0.5, label=label)
            for fit in (next(iter(each.values())) for each in fits.values()):
                lines = [abs(fit.impedance(np.array([frequency]), load)[0]) for load in fit.loads]
                axes.plot(fit.loads, lines, color=colour, lw=1.6)
        axes.set(title="Impedance over load", xlabel="normal load W (N)", ylabel="|Z_f| (N s/m)", yscale="log")
        _numbers(axes.yaxis)
        if np.ptp(np.log(np.concatenate([each.load for each in bins]))) > 1:
            axes.set_xscale("log")
            _numbers(axes.xaxis)
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.2)
        save(figure, path)


def draw_frequency(records: Sequence[FingerRecord], fits: Fits, path: str | os.PathLike[str]) -> None:
    """Draw modulus and phase of the impedance over frequency, with both fits and their 95 % bands, a class a column."""
    size = np.abs(Samples.of(records).value)
    with new_figure((max(5.4 * len(fits), 7), 6.2), pads=(0.1, 0.08)) as figure:
        panels = figure.subplots(2, len(fits), sharex=True, sharey="row", squeeze=False, height_ratios=[1.5, 1])
        for (name, of_class), column in zip(fits.items(), panels.T, strict=True):
            _over_frequency(column, name, of_class, Samples.of(records, LOAD_CLASSES[name]))
        panels[0, 0].set_ylim(0.6 * np.quantile(size, 0.01), 1.7 * np.quantile(size, 0.99))
        panels[0, 0].set_ylabel("|Z_f| (N s/m)")
        low, high = panels[1, 0].get_ylim()
        panels[1, 0].set(ylabel="phase (degrees)", ylim=(max(low, -180), min(high, 180)))
        for axes in panels[1]:
            axes.set_xlabel("frequency (Hz)")
        _numbers(panels[0, 0].xaxis, "25")
        _numbers(panels[0, 0].yaxis)
        save(figure, path)


def _shown(value: Array) -> list[int]:
    """Up to 8 bands with data, evenly spread."""
    there = np.flatnonzero(np.isfinite(value).any(axis=0))
    return there[np.unique(np.linspace(0, len(there) - 1, min(len(there), MOST_BANDS)).astype(int))].tolist()


def _colours(count: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps["viridis"](0.9 * i / max(count - 1, 1)) for i in range(count)]


def _curve(axes: Any, time: Array, series: Series, scale: float, colour: str, label: str) -> Any:
    """A quantity over time with its 95 % band."""
    step = max(len(time) // POINTS, 1)
    at, value, error = time[::step], scale * series.value[::step], scale * SURE * series.standard_error[::step]
    axes.fill_between(at, value - error, value + error, color=colour, alpha=0.25, lw=0)
    (line,) = axes.plot(at, value, color=colour, lw=1.4, label=label)
    return line


def _load(axes: Any, record: FingerRecord) -> None:
    from matplotlib.patches import Patch

    lines = [_curve(axes, record.time, record.normal_load, 1.0, INK, "normal load")]
    axes.set(title="Load", ylabel="normal load W (N)")
    most = float(np.nanmax(np.where(record.contact == LOADED, record.normal_load.value, np.nan), initial=0.1))
    axes.set_ylim(-0.08 * most, 1.25 * most)
    lines += [Patch(color=SHADES[kind], label=KINDS[kind]) for kind in SHADES if record.of_kind(kind)]
    legend(axes, lines, [each.get_label() for each in lines])


def _impedance(axes: Any, record: FingerRecord) -> None:
    z = record.impedance
    axes.set(title="Impedance", ylabel="|Z_f| (N s/m)")
    if not (bands := _shown(z.value)):
        return
    gaps: Any = np.flatnonzero(np.diff(z.time) > 1.5 * np.median(np.diff(z.time))) + 1 if len(z.time) > 1 else []
    for band, colour in zip(bands, _colours(len(bands)), strict=True):  # joined where no window is missing between
        columns = z.time, np.abs(z.value[:, band]), SURE * z.standard_error[:, band]
        style = {"color": colour, "marker": "o", "ms": 3, "lw": 0.9, "elinewidth": 0.8}
        label = f"{np.nanmedian(z.frequency[:, band]):.0f} Hz"
        axes.errorbar(*(np.insert(each, gaps, np.nan) for each in columns), label=label, **style)
    axes.set_yscale("log")
    _numbers(axes.yaxis)
    size = np.abs(z.value[:, bands])
    axes.set_ylim(0.7 * np.nanmin(size), 1.4 * np.nanmax(size))
    legend(axes, columns=MOST_BANDS)


def _kinematics(axes: Any, record: FingerRecord) -> None:
    lines = [_curve(axes, record.time, record.position, 1e3, BLUE, "position (mm)")]
    right = axes.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    lines.append(_curve(right, record.time, record.velocity, 1e3, ORANGE, "velocity (mm/s)"))
    axes.set(title="Motion", ylabel="position (mm)")
    right.set_ylabel("velocity (mm/s)")
    for panel, series in ((axes, record.position), (right, record.velocity)):
        loaded = np.abs(1e3 * series.value[np.isfinite(series.value) & (record.contact == LOADED)])
        reach = 1.3 * float(np.quantile(loaded, 0.99)) if loaded.size else 1.0
        panel.set_ylim(-max(reach, 0.1), max(reach, 0.1))
    legend(axes, lines, [each.get_label() for each in lines])


def _over_frequency(column: Any, name: str, fits: Mapping[int, FingerFit], samples: Samples) -> None:
    """One class: windows, their weighted means and the fits, all at the reference load of the better fit."""
    best = next(iter(fits.values()))
    load = best.mechanics.reference_load
    growth = (load / samples.load) ** best.load_exponent
    samples = samples._replace(value=samples.value * growth, standard_error=samples.standard_error * growth)
    grid = np.geomspace(samples.frequency.min(), samples.frequency.max(), 300)
    views: tuple[Callable[[Array], Array], ...] = (np.abs, lambda z: np.degrees(np.angle(z)))
    bins = samples.by_frequency()
    frequency = np.array([np.median(each.frequency) for each in bins])
    mean, error = np.array([weighted_mean(each.value, each.standard_error) for each in bins]).T
    bars = SURE * error.real, np.degrees(SURE * error.real / np.abs(mean))
    style = {"fmt": "o", "color": INK, "ms": 4.5, "elinewidth": 1, "capsize": 2, "zorder": 4, "label": "measured"}
    for axes, view, bar in zip(column, views, bars, strict=True):
        axes.plot(samples.frequency, view(samples.value), ".", color=PALE, ms=2, alpha=0.4, zorder=1)
        axes.errorbar(frequency, view(mean), bar, **style)
    for order, fit in sorted(fits.items()):
        _model(column, fit, grid, load, COLOURS[order], NAMES[order])
    low, high = samples.load.min(), samples.load.max()
    at = f"{load:.2g} N (data: {low:.2g} to {high:.2g} N)"
    column[0].set(title=f"{name.capitalize()} touch, at {at}", xscale="log", yscale="log")
    column[0].legend(loc="best")


def _model(column: Any, fit: FingerFit, grid: Array, load: float, colour: str, name: str) -> None:
    """Modulus and phase of a fit, with 95 % bands."""
    z, error = fit.impedance(grid, load), SURE * fit.relative_error(grid, load)
    phase, spread = np.degrees(np.angle(z)), np.degrees(error.imag)
    size, ratio = np.abs(z), np.exp(error.real)
    style = {"color": colour, "lw": 1.6, "ls": "--" if fit.order == 2 else "-", "zorder": 3, "label": name}
    for axes, value, low, high in zip(
        column, (size, phase), (size / ratio, phase - spread), (size * ratio, phase + spread), strict=True
    ):
        axes.plot(grid, value, **style)
        axes.fill_between(grid, low, high, color=colour, alpha=0.25, lw=0)


def _numbers(axis: Any, within: str = "235") -> None:
    """Plain numbers on a logarithmic axis, also `within` a decade."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in within else "")
