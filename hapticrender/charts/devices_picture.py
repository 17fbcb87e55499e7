"""The picture of `charts.devices`: accuracy against speed of every device kind, and error over frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hapticrender import defaults
from hapticrender.charts.devices import SWEEP, Point, fronts
from hapticrender.charts.figures import BLUE, GREEN, INK, ORANGE, PALE, RED, new_figure

DEVICES = {
    "vt-plate": (BLUE, "vibrotactile plate"),
    "electroadhesion": (ORANGE, "electroadhesion screen"),
    "ultrasonic": (GREEN, "ultrasonic surface"),
}
SHAPES = {"h2": "o", "h": "s", "static": "^", "stiffness": "v", "paper-common": "D"}
UNFELT = 10.0  # %: errors below every just noticeable difference
TENTHS, THIRDS, FREQUENCIES = (1.0, 2.0, 5.0), (1.0, 3.0), (1.0, 2.0, 4.0)  # ticks of a decade


def draw(points: Sequence[Point], swept: dict[str, list[float]]) -> Any:
    """Draw into a new ``matplotlib.figure.Figure``.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    with new_figure((12.5, 6.2), pads=(0.1, 0.07)) as figure:
        speed, frequency = figure.subplots(1, 2, width_ratios=[1.35, 1])
        _scatter(speed, points)
        _sweep(frequency, swept)
        figure.legend(handles=_keys(points), loc="outside lower center", ncols=4, columnspacing=1.6, handlelength=1.6)
        figure.suptitle(
            "Three kinds of device, one control core: tones and a texture of three partials under a finger that slides",
            x=0.01, ha="left", fontsize=12.5, fontweight="bold",
        )  # fmt: skip
    return figure


def _look(device: str) -> tuple[str, str]:
    """Colour and name of a device; one that this file does not know is red under its own name."""
    return DEVICES.get(device, (RED, device))


def _scatter(axes: Any, points: Sequence[Point]) -> None:
    """Error against speed, the front of every device and level as a staircase, and a lane for what is lost."""
    errors = [100 * point.error for point in points if point.stable]
    foot, top = 0.62 * min(errors, default=1.0), 1.6 * max(errors, default=1.0)
    lane, end = 1.35 * top, 1.8 * top
    axes.axhspan(top, end, color=PALE, alpha=0.13, lw=0)
    for point in points:
        if point.refused:
            continue
        axes.plot(
            point.speed, 100 * point.error if point.stable else lane,
            marker=SHAPES.get(point.setting.method, "P") if point.stable else "x", ms=8.5, mew=1.6, ls="none",
            color=_look(point.setting.device)[0], zorder=3, alpha=0.85,
            fillstyle="none" if point.setting.level == "envelope" else "full",
        )  # fmt: skip
    lost = dict.fromkeys(each.setting.method for each in points if not each.stable and not each.refused)
    refused = dict.fromkeys(each.setting.method for each in points if each.refused)
    told = [f"{what}: {', '.join(names)}" for what, names in (("lost", lost), ("refused", refused)) if names]
    axes.text(0.99, lane, "; ".join(told), transform=axes.get_yaxis_transform(), ha="right", va="center", fontsize=8)
    for (device, level), best in fronts(points).items():
        _staircase(axes, best, _look(device)[0], "--" if level == "envelope" else "-")
    axes.set(xscale="log", yscale="log", xlabel="simulated seconds a second: controller, device and finger together")
    axes.set(ylabel="worst error of any band at the finger (%)", title="Accuracy against speed: lower right is better")
    low, high = axes.get_xlim()
    axes.set_xlim(0.8 * low, 1.9 * high)  # room for names
    axes.set_ylim(foot, end)
    _ticks(axes.xaxis, TENTHS)
    _ticks(axes.yaxis, THIRDS)


def _staircase(axes: Any, best: Sequence[Point], colour: str, dashes: str) -> None:
    """The front of one device and level, its points named."""
    if not best:
        return
    stairs = sorted((point.speed, 100 * point.error) for point in best)
    axes.plot(*zip(*stairs, strict=True), color=colour, lw=1.2, ls=dashes, drawstyle="steps-pre", zorder=2)
    for point in best:
        place: Any = {"xytext": (0, -8), "ha": "center", "va": "top"}
        if point is not best[-1]:  # another stands below it
            place = {"xytext": (9, 0), "ha": "left", "va": "center"}
        axes.annotate(
            point.setting.method, (point.speed, 100 * point.error), **place,
            textcoords="offset points", fontsize=8, fontweight="bold", color=colour,
        )  # fmt: skip


def _sweep(axes: Any, swept: dict[str, list[float]]) -> None:
    """Error over frequency, a line a device."""
    for device, errors in swept.items():
        colour, name = _look(device)
        axes.plot(SWEEP, 100 * np.array(errors), "o-", color=colour, ms=4.5, lw=1.6, label=name)
    axes.axhline(UNFELT, color=INK, lw=1, ls=(0, (4, 2)))
    axes.annotate("10 %: below every just noticeable difference", (SWEEP[0], UNFELT), xytext=(0, 4), color=INK,
                  textcoords="offset points", fontsize=8)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="frequency of a tone (Hz)", ylabel="error at the finger (%)")
    axes.set_title(f"Error over frequency, {defaults.METHOD}, each device as it comes")
    axes.set_ylim(top=2 * UNFELT)
    _ticks(axes.xaxis, FREQUENCIES)
    _ticks(axes.yaxis, THIRDS)


def _ticks(axis: Any, mantissas: Sequence[float]) -> None:
    """Ticks at these in every decade, their numbers written as they are."""
    low, high = axis.get_view_interval()
    ticks = [mantissa * 10.0**power for power in range(-3, 6) for mantissa in mantissas]
    axis.set_ticks([tick for tick in ticks if low <= tick <= high])
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_ticks([], minor=True)


def _keys(points: Sequence[Point]) -> list[Any]:
    """What colours, shapes and fillings mean."""
    from matplotlib.lines import Line2D

    devices = dict.fromkeys(each.setting.device for each in points)
    methods = dict.fromkeys(each.setting.method for each in points)
    handles = [Line2D([], [], color=_look(each)[0], lw=4, label=_look(each)[1]) for each in devices]
    handles += [
        Line2D([], [], color=INK, marker="o", fillstyle="none", ls="none", label="hollow, dashed: envelope level"),
        Line2D([], [], color=INK, marker="x", ls="none", label="a scene is lost"),
        Line2D([], [], color=INK, lw=1.2, label="line and names: the front of a device and level"),
    ]
    return handles + [
        Line2D([], [], color=PALE, marker=SHAPES.get(each, "P"), ls="none", label=each) for each in methods
    ]
