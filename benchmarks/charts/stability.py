"""Draw where each method is stable on the plate, over carrier and bandwidth, for fingers and for a wrong plate."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.charts.stability_map import StabilityMap, stability_map
from benchmarks.charts.style import INK, ORANGE, PALE, new_figure
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import NAMED, FingerMechanics

METHODS = {
    "paper": "paper, each side separately",
    "paper-common": "paper, common mode",
    "h": "H: heave and rocking together",
    "h2": "H2, the default: with inner damping",
}
TICKS, WIDTHS = (20, 50, 100, 200, 400), (1, 2, 5, 10, 20, 50)  # Hz
FAIR = 0.5  # modulus margin: Ms = 2
USUAL = 5.0  # Hz: the paper's bandwidth
WRONG = 0.1  # share of the plate's stiffness that the design does not have


class Case(NamedTuple):
    """One column: what rests on the plate, or differs from the plate of the design."""

    title: str
    mechanics: FingerMechanics
    load: float  # N
    position: float  # m


def cases() -> tuple[Case, ...]:
    """The columns. A stiffer plate is the plate of the design with a spring of the difference at its middle."""
    plate = PlateParameters()
    spring = WRONG * (plate.stiffness_1 + plate.stiffness_2)
    stiffer = FingerMechanics(order=2, mass=1e-9, damping=1e-6, stiffness=spring, reference_load=1.0)
    return (
        Case("no finger", NAMED["none"], 0.5, 0.0),
        Case(f"plate {100 * WRONG:g} % stiffer\nthan designed for", stiffer, 1.0, 0.0),
        Case("light finger, 0.3 N,\n27.5 mm off the middle", NAMED["light"], 0.3, 27.5e-3),
        Case("heavy finger, 0.8 N,\nin the middle", NAMED["heavy"], 0.8, 0.0),
        Case("heavy finger, 0.8 N,\n27.5 mm off the middle", NAMED["heavy"], 0.8, 27.5e-3),
    )


def measure(frequencies: int = 110, bandwidths: int = 40) -> dict[str, list[StabilityMap]]:
    """Evaluate every method and case before the finger is learnt, on 20-400 Hz and bandwidths of 1-80 Hz."""
    grid, widths = np.geomspace(20.0, 400.0, frequencies), np.geomspace(1.0, 80.0, bandwidths)
    return {
        method: [
            stability_map(method, grid, bandwidths=widths, fingers={"": case.mechanics}, loads=(case.load,),
                          positions=(case.position,))
            for case in cases()
        ]
        for method in METHODS
    }  # fmt: skip


def draw(rows: dict[str, list[StabilityMap]]) -> Any:
    """Draw the maps of `measure`: margin as shade, the unstable region hatched."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    columns = cases()
    with new_figure((15.0, 10.5), **{"axes.grid": False, "hatch.linewidth": 0.6}) as figure:
        axes = figure.subplots(len(rows), len(columns), sharex=True, sharey=True)
        for lane, (method, row) in zip(axes, rows.items(), strict=True):
            for panel, each in zip(lane, row, strict=True):
                shade = _panel(panel, each)
            lane[0].set_ylabel(f"{METHODS[method]}\nbandwidth (Hz)".replace(": ", ":\n"))
        for panel, case in zip(axes[0], columns, strict=True):
            panel.set_title(case.title, loc="center")
        for panel in axes[-1]:
            panel.set_xlabel("carrier (Hz)")
        bar = figure.colorbar(shade, ax=axes, shrink=0.6, pad=0.01, ticks=[0, 0.125, 0.25, 0.375, 0.5])
        bar.set_label("modulus margin 1/Ms; 0.5 and above suffice")
        keys = [
            Patch(facecolor="white", edgecolor=INK, hatch="////", label="unstable, and its boundary"),
            Line2D([], [], color=PALE, lw=3, label="Ms = 2: sufficient below the line (white on the map)"),
            Line2D([], [], color=ORANGE, lw=1.2, ls="--", label="design rule: a quarter of the carrier"),
            Line2D([], [], color=ORANGE, lw=1.2, ls=":", label="5 Hz, the paper's bandwidth"),
        ]
        figure.legend(handles=keys, loc="outside lower center", ncols=4)
        figure.suptitle("Stability of each method on the plate, finger not yet learnt, by carrier and bandwidth")
    return figure


def _panel(axes: Any, each: StabilityMap) -> Any:
    """Draw one map."""
    frequency, bandwidth = each.frequencies, each.bandwidths
    growth, modulus = each.growth[0, 0, 0].T, each.modulus[0, 0, 0].T
    shade = axes.pcolormesh(
        frequency,
        bandwidth,
        np.ma.masked_where(growth >= 0, modulus),
        cmap="cividis",
        vmin=0,
        vmax=FAIR,
        rasterized=True,
    )
    if growth.max() > 0:
        axes.contourf(frequency, bandwidth, growth, levels=[0, np.inf], colors="white", hatches=["////"])
        axes.contour(frequency, bandwidth, growth, levels=[0], colors=INK, linewidths=1.8)
    axes.contour(frequency, bandwidth, modulus, levels=[FAIR], colors="white", linewidths=1.1)
    axes.plot(frequency, frequency / 4, color=ORANGE, lw=1.2, ls="--")
    axes.axhline(USUAL, color=ORANGE, lw=1.2, ls=":")
    axes.set(xscale="log", yscale="log", xlim=frequency[[0, -1]], ylim=bandwidth[[0, -1]])
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_yticks(WIDTHS, [f"{width:g}" for width in WIDTHS])
    axes.minorticks_off()
    return shade
