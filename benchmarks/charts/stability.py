"""Draw where each method is stable on the plate, for fingers and for a wrong plate.

The methods by bands over carrier and bandwidth.  The waveform law has neither: between contacts nothing is fed back to
its drive, as the filter that learns accounts for what was played, and around contacts its inner damper is.  That loop
is drawn over the true delay and a factor on its gain.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.charts.stability_map import PLATE, Case, StabilityMap, error_map, polar_map
from benchmarks.charts.style import INK, ORANGE, PALE, new_figure
from hapticrender.touch.mechanics import NAMED, FingerMechanics

METHODS = {  # rows: the name, the map, and what distinguishes it
    "paper, each side separately": (polar_map, False),
    "paper, common mode": (polar_map, True),
    "h: heave and rocking together": (error_map, 0.0),
    "h2: with inner damping": (error_map, 1.0),
}
TICKS, WIDTHS = (20, 50, 100, 200, 400), (1, 2, 5, 10, 20, 50)  # Hz
FAIR = 0.5  # modulus margin: Ms = 2
USUAL = 5.0  # Hz: the paper's bandwidth
WRONG = 0.1  # share of the plate's stiffness that the design does not have
SPRING = FingerMechanics(  # of a stiffer plate: that of the design with a spring of the difference at its middle
    order=2, mass=1e-9, damping=1e-6, stiffness=WRONG * (PLATE.stiffness_1 + PLATE.stiffness_2), reference_load=1.0
)
CASES = (
    Case("no finger", NAMED["none"], 0.5, 0.0),
    Case(f"plate {100 * WRONG:g} % stiffer\nthan designed for", SPRING, 1.0, 0.0),
    Case("light finger, 0.3 N,\n27.5 mm off the middle", NAMED["light"], 0.3, 27.5e-3),
    Case("heavy finger, 0.8 N,\nin the middle", NAMED["heavy"], 0.8, 0.0),
    Case("heavy finger, 0.8 N,\n27.5 mm off the middle", NAMED["heavy"], 0.8, 27.5e-3),
)


def measure(frequencies: int = 60, bandwidths: int = 24) -> dict[str, list[StabilityMap]]:
    """Evaluate every method and case before the finger is learnt, on 20-400 Hz and bandwidths of 1-80 Hz."""
    grid = np.geomspace(20.0, 400.0, frequencies), np.geomspace(1.0, 80.0, bandwidths)
    return {name: [make(case, how, *grid) for case in CASES] for name, (make, how) in METHODS.items()}


def limits(found: StabilityMap) -> tuple[int, float]:
    """Longest true delay (samples) with which the damper as designed is stable; its margin with the stated delay."""
    designed = int(np.argmin(abs(found.y - 1.0)))
    return int(found.x[found.growth[:, designed] < 0].max()), float(found.modulus[0, designed])


def draw(rows: dict[str, list[StabilityMap]], dampers: list[StabilityMap]) -> Any:
    """Draw the maps of `measure`, and of `damper_map` for every case: margin as shade, the unstable region hatched."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    with new_figure((15.0, 13.0), **{"axes.grid": False, "hatch.linewidth": 0.6}) as figure:
        axes = figure.subplots(len(rows) + 1, len(CASES), sharey="row", sharex="row")
        for lane, (method, row) in zip(axes, rows.items(), strict=False):
            for panel, each in zip(lane, row, strict=True):
                shade = _by_bands(panel, each)
            lane[0].set_ylabel(f"{method}\nbandwidth (Hz)".replace(": ", ":\n"))
        for panel, found in zip(axes[-1], dampers, strict=True):
            _damper(panel, found)
        axes[-1, 0].set_ylabel("inverse, the default:\ndamper around contacts\nfactor on its gain")
        for panel, case in zip(axes[0], CASES, strict=True):
            panel.set_title(case.title, loc="center")
        for panel in axes[-2]:
            panel.set_xlabel("carrier (Hz)")
        bar = figure.colorbar(shade, ax=axes, shrink=0.6, pad=0.01, ticks=[0, 0.125, 0.25, 0.375, 0.5])
        bar.set_label("modulus margin 1/Ms; 0.5 and above suffice")
        keys = [
            Patch(facecolor="white", edgecolor=INK, hatch="////", label="unstable, and its boundary"),
            Line2D([], [], color=PALE, lw=3, label="Ms = 2: sufficient below the line (white on the map)"),
            Line2D([], [], color=ORANGE, lw=1.2, ls="--", label="design rule: a quarter of the carrier"),
            Line2D([], [], color=ORANGE, lw=1.2, ls=":", label="5 Hz, the paper's bandwidth"),
            Line2D([], [], color=ORANGE, marker="o", ls="none", label="the damper as designed"),
        ]
        figure.legend(handles=keys, loc="outside lower center", ncols=5)
        figure.suptitle("Stability of each method on the plate, finger not yet learnt")
    return figure


def _by_bands(axes: Any, each: StabilityMap) -> Any:
    """Draw a map over carrier and bandwidth."""
    shade = _map(axes, each)
    axes.plot(each.x, each.x / 4, color=ORANGE, lw=1.2, ls="--")
    axes.axhline(USUAL, color=ORANGE, lw=1.2, ls=":")
    axes.set(xscale="log", yscale="log", xlim=each.x[[0, -1]], ylim=each.y[[0, -1]])
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_yticks(WIDTHS, [f"{width:g}" for width in WIDTHS])
    axes.minorticks_off()
    return shade


def _damper(axes: Any, each: StabilityMap) -> None:
    """Draw a map over delay and factor."""
    _map(axes, each)
    axes.plot(each.x[0], 1.0, "o", color=ORANGE, ms=9, clip_on=False, zorder=4)
    axes.set(yscale="log", xlim=each.x[[0, -1]], ylim=each.y[[0, -1]], xlabel="true delay (samples; designed for 1)")
    axes.set_yticks([0.25, 0.5, 1, 2, 4, 8], ["0.25", "0.5", "1", "2", "4", "8"])
    axes.minorticks_off()


def _map(axes: Any, each: StabilityMap) -> Any:
    """Draw the margin as shade, and the unstable region."""
    growth, modulus = each.growth.T, each.modulus.T
    held = np.ma.masked_where(growth >= 0, modulus)
    shade = axes.pcolormesh(each.x, each.y, held, cmap="cividis", vmin=0, vmax=FAIR, rasterized=True)
    if growth.max() > 0:
        axes.contourf(each.x, each.y, growth, levels=[0, np.inf], colors="white", hatches=["////"])
        axes.contour(each.x, each.y, growth, levels=[0], colors=INK, linewidths=1.8)
    axes.contour(each.x, each.y, modulus, levels=[FAIR], colors="white", linewidths=1.1)
    return shade
