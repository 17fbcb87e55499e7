"""The picture of `hapticrender.charts.pareto`: two views of accuracy against cost, and where each method holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hapticrender.charts.figures import BLUE, GREEN, INK, ORANGE, PALE, RED, new_figure
from hapticrender.charts.pareto import LOST, MAP, OFF, RESTLESS, Point, front
from hapticrender.protocols import Array

COLOURS = {
    "paper": ORANGE,
    "paper-common": "#B8860B",
    "boxcar": "#CC79A7",
    "static": PALE,
    "stiffness": "#56B4E9",
    "resonant": RED,
    "h": GREEN,
    "h2": BLUE,
}
FOOT = 0.15  # %: foot of the axes of error
LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # %
TICKS = (20, 50, 100, 200, 400)  # Hz


def draw(points: Sequence[Point], held: dict[str, Array]) -> Any:
    """Draw into a new ``matplotlib.figure.Figure``.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    with new_figure((12.5, 8.6)) as figure:
        panels = figure.subplot_mosaic([["cost", "speed"], ["map", "map"]], height_ratios=[3, 2])
        _scatter(panels["cost"], points, lambda each: each.nanoseconds, "controller, ns a band-sample (8 bands)")
        _scatter(
            panels["speed"], points, lambda each: -each.speed, "simulated seconds a second, plant and finger included"
        )
        panels["cost"].set_ylabel("worst error at the finger (%)")
        panels["cost"].set_title("Accuracy against the controller's cost: cheap and good is lower left")
        panels["speed"].set_title("and against the speed of the whole simulation: lower right")
        _map(figure, panels["map"], held)
        figure.legend(handles=_keys(points), loc="outside lower center", ncols=6, columnspacing=1.4, handlelength=1.6)
        figure.suptitle(
            "Every method at several settings: four tones and a comb of eight, free and under a sliding heavy finger",
            x=0.01,
            ha="left",
            fontsize=12.5,
            fontweight="bold",
        )
    return figure


def _marker(point: Point) -> tuple[str, str]:
    """Shape by how the device is served, filling by precision."""
    shape = "s" if point.setting.block > 1 else "^" if "heave only" in point.setting.what else "o"
    return shape, "none" if "single" in point.setting.what else "full"


def _scatter(axes: Any, points: Sequence[Point], cost: Callable[[Point], float], label: str) -> None:
    """Error against a cost (negative: a speed), the front as a staircase with its points named."""
    best = front(points, cost)
    reach = 100.0
    for point in points:
        if point.refused:
            continue
        shape, filling = _marker(point)
        colour = COLOURS[point.setting.method]
        lost = not point.stable
        axes.plot(
            abs(cost(point)),
            reach if lost else max(100 * point.error, FOOT),
            marker="x" if lost else shape,
            ms=9 if point in best else 6.5,
            color=colour,
            fillstyle="full" if lost else filling,
            mew=1.3,
            ls="none",
            zorder=3,
            clip_on=False,
        )
    stairs = sorted(((abs(cost(each)), max(100 * each.error, FOOT)) for each in best), key=lambda each: each[0])
    steps = "steps-post" if cost(best[0]) > 0 else "steps-pre"
    axes.plot(*zip(*stairs, strict=True), color=INK, lw=1.1, drawstyle=steps, zorder=2)
    at, side, away = (0.99, "right", -8) if cost(best[0]) > 0 else (0.02, "left", 8)  # where there are no points
    for number, point in enumerate(best, start=1):
        axes.annotate(
            str(number),
            (abs(cost(point)), max(100 * point.error, FOOT)),
            xytext=(away, -3), textcoords="offset points", ha=side, va="top", fontsize=9, fontweight="bold",
        )  # fmt: skip
    lines = [f"{number}  {each.setting.method}, {each.setting.what}" for number, each in enumerate(best, start=1)]
    axes.text(
        at, 0.97, "the front:\n" + "\n".join(lines), transform=axes.transAxes, ha=side, va="top", fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "#DDDDDD", "boxstyle": "round,pad=0.4"}, zorder=4,
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel=label, ylim=(FOOT, reach))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    low, high = axes.get_xlim()
    low, high = 0.8 * low, 1.25 * high
    ticks = [mantissa * 10.0**power for power in range(-1, 6) for mantissa in (1, 2, 5)]
    axes.set_xlim(low, high)
    axes.set_xticks([tick for tick in ticks if low <= tick <= high])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: "")


def _map(figure: Any, axes: Any, held: dict[str, Array]) -> None:
    """A lane a method: error by carrier, black where nothing is held."""
    from matplotlib.colors import BoundaryNorm

    names = list(held)
    values, restless = (np.array([held[name][part] for name in names]) for part in range(2))
    values = 100 * np.minimum(np.nan_to_num(values, nan=np.inf, posinf=LOST), LOST)
    edges = np.geomspace(MAP[0] ** 1.5 / MAP[1] ** 0.5, MAP[-1] ** 1.5 / MAP[-2] ** 0.5, len(MAP) + 1)
    refused = np.isnan(restless)
    shade = axes.pcolormesh(
        edges,
        np.arange(len(names) + 1),
        np.ma.masked_where(refused, values),
        cmap="YlOrRd",
        norm=BoundaryNorm(LEVELS, 256),
        edgecolors="white",
        lw=0.4,
    )
    lane, column = np.nonzero((restless > RESTLESS) | (values > 100 * OFF))
    axes.plot(MAP[column], lane + 0.5, marker="X", ms=8, color=INK, mec="white", ls="none")
    axes.set(xscale="log", xlabel="carrier (Hz), each alone, every method as it comes", xlim=edges[[0, -1]])
    axes.set_yticks(np.arange(len(names)) + 0.5, names)
    axes.invert_yaxis()
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    axes.grid(False)
    axes.set_title(
        "Where each stops holding: error 2 s after the worst of three touches; crossed: it wanders or stays off"
    )
    bar = figure.colorbar(shade, ax=axes, pad=0.01, ticks=LEVELS)
    bar.set_label("error (%)")
    bar.outline.set_visible(False)


def _keys(points: Sequence[Point]) -> list[Any]:
    """What colours and shapes mean."""
    from matplotlib.lines import Line2D

    present = dict.fromkeys(each.setting.method for each in points)
    handles = [Line2D([], [], color=COLOURS[name], marker="o", ls="none", label=name) for name in present]
    shapes: tuple[tuple[str, Any, str], ...] = (
        ("o", "full", "sample by sample"),
        ("s", "full", "in blocks"),
        ("^", "full", "knows heave only"),
        ("o", "none", "hollow: single precision"),
        ("x", "full", "a scene is lost"),
    )
    return handles + [
        Line2D([], [], color=INK, marker=shape, fillstyle=filling, ls="none", label=label)
        for shape, filling, label in shapes
    ]
