"""Charts of methods against each other: pictures for people, and the data behind them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticrender.charts.figures import INK, ORANGE, PALE, new_figure, save
from hapticrender.plants.stability import LOOPS, StabilityMap, stability_map
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array
from hapticrender.recordings.formats import replacing
from hapticrender.touch.mechanics import NAMED

TITLES = {
    "paper": "paper, each side apart",
    "paper-common": "paper, common mode",
    "h": "H: heave and rocking together",
    "h2": "H2: with inner damping",
}
TICKS = (20, 50, 100, 200, 400)  # Hz
WIDTHS = (1, 2, 5, 10, 20, 50)  # Hz
IMAGE = 0.376  # bandwidth over carrier at which the ripple rule, rL rT < 0.283, ends for fL = 2 fT
FAIR = 0.5  # modulus margin: Ms = 2
USUAL = 5.0  # Hz: the paper's bandwidth


class Case(NamedTuple):
    """One column of a chart: what rests on the plate."""

    finger: str  # of Table 1: a name in ``touch.mechanics.NAMED``
    load: float  # N
    position: float  # m

    @property
    def title(self) -> str:
        """Words for the head of the column."""
        if self.finger == "none":
            return "no finger"
        place = "in the middle" if self.position == 0 else f"{1e3 * self.position:g} mm off the middle"
        return f"{self.finger} finger, {self.load:g} N,\n{place}"


CASES = (
    Case("none", 0.5, 0.0),
    Case("light", 0.3, 0.0),
    Case("light", 0.3, 27.5e-3),
    Case("heavy", 0.8, 0.0),
    Case("heavy", 0.8, 27.5e-3),
)


def stability(
    path: str | os.PathLike[str],
    *,
    methods: Sequence[str] = tuple(LOOPS),
    cases: Sequence[Case] = CASES,
    frequencies: Array | None = None,
    bandwidths: Array | None = None,
    parameters: PlateParameters | None = None,
    adapted: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[list[StabilityMap]]:
    """Draw where each method is stable, over frequency and bandwidth, and write the data beside the picture.

    Parameters
    ----------
    path : path-like
        PNG to write; the data go into a .npz of the same name.
    methods : sequence of str
        Rows, of ``plants.stability.LOOPS``.
    cases : sequence of Case
        Columns: finger, load and position.
    frequencies, bandwidths : ndarray, Hz, optional
        Ascending grids; by default 20..400 and 1..80.
    parameters : PlateParameters, optional
    adapted : bool
        Whether the bank's law has learnt the finger; otherwise the map is that of the moment of touch.
    progress : callable, optional
        Told the share that is done, 0..1.

    Returns
    -------
    list of list of StabilityMap
        Row by row, a map of one finger, load and position each.

    Raises
    ------
    MissingExtra
        matplotlib is not installed; the data are written all the same.
    """
    frequencies = np.geomspace(20.0, 400.0, 110) if frequencies is None else np.asarray(frequencies, float)
    bandwidths = np.geomspace(1.0, 80.0, 40) if bandwidths is None else np.asarray(bandwidths, float)
    rows: list[list[StabilityMap]] = []
    for row, method in enumerate(methods):
        rows.append([])
        for column, case in enumerate(cases):
            rows[-1].append(
                stability_map(
                    method,
                    frequencies,
                    bandwidths=bandwidths,
                    fingers={case.finger: NAMED[case.finger]},
                    loads=(case.load,),
                    positions=(case.position,),
                    parameters=parameters,
                    adapted=adapted,
                )
            )
            if progress is not None:
                progress((row * len(cases) + column + 1) / (len(methods) * len(cases)))
    path = Path(path)
    _save(path.with_suffix(".npz"), rows, cases)
    save(draw_stability(rows, cases), path, dpi=130)
    return rows


def _save(path: Path, rows: list[list[StabilityMap]], cases: Sequence[Case]) -> None:
    """All maps as arrays of shape (methods, cases, frequencies, bandwidths)."""
    with replacing(path) as scratch:
        np.savez(
            scratch,
            method=np.array([row[0].method for row in rows]),
            finger=np.array([case.finger for case in cases]),
            load=np.array([case.load for case in cases]),
            position=np.array([case.position for case in cases]),
            frequency=rows[0][0].frequencies,
            bandwidth=rows[0][0].bandwidths,
            growth=np.array([[each.growth[0, 0, 0] for each in row] for row in rows]),
            modulus=np.array([[each.modulus[0, 0, 0] for each in row] for row in rows]),
        )


def draw_stability(rows: list[list[StabilityMap]], cases: Sequence[Case]) -> Any:
    """Draw maps into a new ``matplotlib.figure.Figure``; see `stability`."""
    size = (2.7 * len(cases) + 1.6, 2.15 * len(rows) + 2.2)
    with new_figure(size, style={"axes.grid": False, "hatch.linewidth": 0.6}) as figure:
        axes = figure.subplots(len(rows), len(cases), sharex=True, sharey=True, squeeze=False)
        for lane, row in zip(axes, rows, strict=True):
            for panel, each in zip(lane, row, strict=True):
                shade = _panel(panel, each)
            lane[0].set_ylabel("bandwidth (Hz)")
            lane[0].annotate(
                TITLES.get(row[0].method, row[0].method),
                (0, 1.03), xycoords="axes fraction", fontweight="bold", va="bottom",
            )  # fmt: skip
        for panel, case in zip(axes[0], cases, strict=True):
            panel.annotate(case.title, (0.5, 1.17), xycoords="axes fraction", ha="center", va="bottom")
        for panel in axes[-1]:
            panel.set_xlabel("carrier (Hz)")
        bar = figure.colorbar(shade, ax=axes, shrink=0.6, pad=0.01, ticks=[0, 0.25, 0.5, 0.75, 1])
        bar.set_label("modulus margin 1/Ms")
        bar.outline.set_visible(False)
        figure.suptitle(
            "Where each method is stable on the plate, the finger not yet learnt"
            if not rows[0][0].adapted
            else "Where each method is stable on the plate, the finger learnt",
            x=0.01,
            ha="left",
            fontsize=14,
            fontweight="bold",
        )
        figure.legend(
            handles=_keys(), loc="outside lower left", ncols=5, fontsize=8.5, handlelength=2.2, columnspacing=1.6
        )
    return figure


def _panel(axes: Any, each: StabilityMap) -> Any:
    """One map: margin as shade, the unstable region hatched, its boundary and the line Ms = 2."""
    frequency, bandwidth = each.frequencies, each.bandwidths
    growth, modulus = each.growth[0, 0, 0].T, each.modulus[0, 0, 0].T
    shade = axes.pcolormesh(
        frequency, bandwidth, np.ma.masked_where(growth >= 0, modulus), cmap="cividis", vmin=0, vmax=1, rasterized=True
    )
    axes.contourf(frequency, bandwidth, growth, levels=[0, np.inf], colors="white", hatches=["////"])
    axes.contour(frequency, bandwidth, growth, levels=[0], colors=INK, linewidths=1.8)
    axes.contour(frequency, bandwidth, modulus, levels=[FAIR], colors="white", linewidths=1.1)
    axes.plot(frequency, frequency / 4, color=ORANGE, lw=1.2, ls=(0, (4, 2)))
    axes.plot(frequency, np.full(len(frequency), USUAL), color=ORANGE, lw=1.2, ls=(0, (1, 1.5)))
    if each.method.startswith("paper"):
        axes.plot(frequency, IMAGE * frequency, color=PALE, lw=1.0)
    axes.set(xscale="log", yscale="log", xlim=frequency[[0, -1]], ylim=bandwidth[[0, -1]])
    axes.set_xticks([tick for tick in TICKS if frequency[0] <= tick <= frequency[-1]])
    axes.set_yticks([tick for tick in WIDTHS if bandwidth[0] <= tick <= bandwidth[-1]])
    axes.minorticks_off()
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    return shade


def _keys() -> list[Any]:
    """What the lines and the hatching mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(facecolor="white", edgecolor=INK, hatch="////", label="unstable, and its boundary"),
        Line2D([], [], color=PALE, lw=3, label="Ms = 2 (white on the map)"),
        Line2D([], [], color=ORANGE, lw=1.2, ls=(0, (4, 2)), label="design rule: a quarter of the carrier"),
        Line2D([], [], color=ORANGE, lw=1.2, ls=(0, (1, 1.5)), label="5 Hz, the paper's bandwidth"),
        Line2D([], [], color=PALE, lw=1.0, label="paper: above, the image at twice the carrier counts too"),
    ]
