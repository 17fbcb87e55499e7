"""Draw accuracy against cost as points with their front, and errors over frequency as a map or as lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.charts.measure import LOST, PARTIALS, SWEEP, Point, front
from benchmarks.charts.style import BLUE, GREEN, INK, ORANGE, PALE, RED, new_figure

METHODS = {
    "paper": ORANGE, "paper-common": "#B8860B", "boxcar": "#CC79A7", "static": PALE, "stiffness": "#56B4E9",
    "resonant": RED, "h": GREEN, "h2": "#6A51A3", "inverse": BLUE,
}  # fmt: skip
DEVICES = {"vt-plate": BLUE, "electroadhesion": ORANGE, "ultrasonic": GREEN}
SHAPES = {"inverse": "o", "h": "s", "static": "^", "stiffness": "v", "paper-common": "D"}
LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0, 50.0)  # %
OFF = 5.0  # %: a larger error over frequency is crossed out
UNFELT = 10.0  # %: errors below every just noticeable difference of an amplitude
TICKS = (20, 50, 100, 200, 400)  # Hz


def pareto(points: Sequence[Point], swept: dict[str, list[float]]) -> Any:
    """Draw the methods on the plate: error against the controller's cost and the simulation's speed, and a map."""

    def look(point: Point) -> dict[str, Any]:
        shape = "s" if point.setting.block > 1 else "^" if point.setting.heave_only else "o"
        return {"color": METHODS[point.setting.method], "marker": shape}

    with new_figure((12.5, 9.0)) as figure:
        panels = figure.subplot_mosaic([["cost", "speed"], ["map", "map"]], height_ratios=[3, 2])
        scatter(
            panels["cost"], points, lambda each: 1e-3 * len(PARTIALS) * each.nanoseconds, look, ["methods on the plate"]
        )
        scatter(panels["speed"], points, lambda each: -each.speed, look, ["methods on the plate"])
        panels["cost"].set(xlabel="time of the controller for a sample of 8 bands (µs)", title="Controller alone")
        panels["speed"].set(xlabel="simulated seconds a second", title="Controller, plate and finger", ylabel="")
        _map(figure, panels["map"], {name.split()[-1]: values for name, values in swept.items()})
        shapes = {"sample by sample": "o", "in blocks": "s", "model of heave only": "^", "a scene is lost": "x"}
        _legend(figure, METHODS, shapes, 6)
        figure.suptitle("Methods and settings on the plate under a sliding heavy finger: accuracy against cost")
    return figure


def devices(points: Sequence[Point], swept: dict[str, list[float]]) -> Any:
    """Draw the simulated devices: error against speed of every method and level, and error over frequency."""

    def look(point: Point) -> dict[str, Any]:
        hollow = point.setting.level == "envelope"
        return {
            "color": DEVICES[point.setting.device], "marker": SHAPES[point.setting.method],
            "fillstyle": "none" if hollow else "full", "ls": "--" if hollow else "-",
        }  # fmt: skip

    models = list(dict.fromkeys((each.setting.device, each.setting.level) for each in points))
    with new_figure((12.5, 6.4)) as figure:
        left, right = figure.subplots(1, 2, width_ratios=[1.35, 1])
        scatter(left, points, lambda each: -each.speed, look, models)
        left.set(xlabel="simulated seconds a second", title="Every method and level: lower right is better")
        for name, values in swept.items():
            device = name.split()[0]
            right.plot(SWEEP, 100 * np.array(values), "o-", color=DEVICES[device], ms=4, lw=1.5, label=device)
        right.axhline(UNFELT, color=INK, lw=1, ls="--")
        right.text(SWEEP[0], UNFELT * 1.08, "10 %: below every just noticeable difference", fontsize=8)
        right.set(xscale="log", yscale="log", xlabel="frequency of a tone (Hz)", ylabel="error at the finger (%)")
        right.set(title="Error over frequency: default method, default level", ylim=(None, 2 * UNFELT))
        right.set_xticks(TICKS, [str(tick) for tick in TICKS])
        right.minorticks_off()
        right.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        shapes = {name: shape for name, shape in SHAPES.items()} | {"a scene is lost": "x"}
        _legend(figure, DEVICES, shapes | {"hollow, dashed: envelope level": "o"}, 5)
        figure.suptitle("One control core on three simulated devices (the fourth, hybrid, combines two of them)")
    return figure


def scatter(
    axes: Any, points: Sequence[Point], cost: Callable[[Point], float], look: Callable[[Point], dict[str, Any]],
    models: Sequence[Any],
) -> None:  # fmt: skip
    """Plot error against a cost (negative: a speed); each model's front is a staircase whose points are named."""
    held = [100 * each.error for each in points if each.held]
    foot, top = 0.6 * min(held, default=1.0), 1.5 * max(held, default=1.0)
    axes.axhspan(top, 1.6 * top, color=PALE, alpha=0.13, lw=0)
    for point in points:
        if not point.refused:
            style = look(point) | {"ls": "none", "ms": 7.5, "mew": 1.4, "zorder": 3}
            style |= {} if point.held else {"marker": "x", "fillstyle": "full"}
            axes.plot(abs(cost(point)), 100 * point.error if point.held else 1.26 * top, **style)
    numbered: list[str] = []
    for model in models:
        own = [each for each in points if len(models) == 1 or (each.setting.device, each.setting.level) == model]
        best = front(own, cost)
        if not best:
            continue
        speed = cost(best[0]) < 0
        line = (
            {"color": INK, "ls": "-"}
            if len(models) == 1
            else {key: look(best[0]).get(key, "-") for key in ("color", "ls")}
        )
        stairs = sorted((abs(cost(each)), 100 * each.error) for each in best)
        axes.plot(
            *zip(*stairs, strict=True), lw=1.1, drawstyle="steps-pre" if speed else "steps-post", zorder=2, **line
        )
        for point in best:
            name = f"{point.setting.method}, {point.setting.what}".replace(", default", "")
            if len(models) == 1:
                numbered.append(f"{len(numbered) + 1}  {name}")
                name = str(len(numbered))
            offset, side = ((-8, -3), "right") if point.setting.level == "carrier" else ((8, -3), "left")
            axes.annotate(name, (abs(cost(point)), 100 * point.error), offset, textcoords="offset points", ha=side,
                          va="top", fontsize=8, fontweight="bold", color=line["color"])  # fmt: skip
    if numbered:  # where there are no points: fast and wrong, or slow and wrong
        at, side = (0.02, "left") if cost(points[0]) < 0 else (0.98, "right")
        axes.text(at, 0.9, "front:\n" + "\n".join(numbered), transform=axes.transAxes, ha=side, va="top", fontsize=8,
                  bbox={"facecolor": "white", "edgecolor": "#DDDDDD"}, zorder=4)  # fmt: skip
    axes.set(xscale="log", yscale="log", ylabel="worst error of any band at the finger (%)", ylim=(foot, 1.6 * top))
    low, high = axes.get_xlim()
    axes.set_xlim(0.8 * low, 2.2 * high)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")


def _map(figure: Any, axes: Any, swept: dict[str, list[float]]) -> None:
    """One row a method: error by frequency, crossed above `OFF`, grey where the method refuses the tone."""
    from matplotlib.colors import BoundaryNorm

    values = 100 * np.minimum(np.array(list(swept.values())), LOST)
    ratio = SWEEP[1] / SWEEP[0]
    edges = np.append(SWEEP, SWEEP[-1] * ratio) / np.sqrt(ratio)
    axes.set_facecolor("#DDDDDD")
    shade = axes.pcolormesh(
        edges, np.arange(len(swept) + 1), np.ma.masked_invalid(values), cmap="YlOrRd", norm=BoundaryNorm(LEVELS, 256),
        edgecolors="white", lw=0.4,
    )  # fmt: skip
    row, column = np.nonzero(values > OFF)
    axes.plot(SWEEP[column], row + 0.5, marker="X", ms=8, color=INK, mec="white", ls="none")
    axes.set(xscale="log", xlabel="frequency of a tone (Hz)", xlim=edges[[0, -1]])
    axes.set(title=f"Error over frequency, one tone alone, default settings; crossed: above {OFF:g} %")
    axes.set_yticks(np.arange(len(swept)) + 0.5, list(swept))
    axes.invert_yaxis()
    axes.set_xticks(TICKS, [str(tick) for tick in TICKS])
    axes.minorticks_off()
    axes.grid(False)
    figure.colorbar(shade, ax=axes, pad=0.01, ticks=LEVELS, format="%g").set_label("error (%)")


def _legend(figure: Any, colours: dict[str, str], shapes: dict[str, str], columns: int) -> None:
    """Explain colours and marker shapes below the panels."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=colour, lw=4, label=name) for name, colour in colours.items()]
    handles += [
        Line2D([], [], color=INK, marker=shape, ls="none", fillstyle="none" if "hollow" in name else "full", label=name)
        for name, shape in shapes.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
