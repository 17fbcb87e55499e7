"""Draw where each method is stable on the plate, for fingers and for a wrong plate.

The methods by bands over carrier and bandwidth.  The waveform law has neither: between contacts nothing is fed back to
its drive, as the filter that learns accounts for what was played, and around contacts its inner damper is.  That loop
is drawn over the true delay and a factor on its gain.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.charts.stability_map import StabilityMap, loaded_plate, stability_map
from benchmarks.charts.style import INK, ORANGE, PALE, new_figure
from hapticrender.control.damping import choose_damping
from hapticrender.control.linear import ErrorLoop
from hapticrender.control.margins import sensitivity
from hapticrender.plants.plate import PlateParameters
from hapticrender.touch.mechanics import NAMED, FingerMechanics

METHODS = {
    "paper": "paper, each side separately",
    "paper-common": "paper, common mode",
    "h": "h: heave and rocking together",
    "h2": "h2: with inner damping",
}
TICKS, WIDTHS = (20, 50, 100, 200, 400), (1, 2, 5, 10, 20, 50)  # Hz
FAIR = 0.5  # modulus margin: Ms = 2
USUAL = 5.0  # Hz: the paper's bandwidth
DELAYS, FACTORS = np.arange(1, 9), np.geomspace(0.25, 8.0, 61)  # samples; on the inner damper
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


def measure(frequencies: int = 60, bandwidths: int = 24) -> dict[str, list[StabilityMap]]:
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


class DamperMap(NamedTuple):
    """Growth (1/s) and modulus margin of the loop of the inner damper alone, each (DELAYS, FACTORS)."""

    growth: Any
    modulus: Any


def damper_map(case: Case) -> DamperMap:
    """Evaluate the inner damper that `inverse` has, on the plate with what rests on it.

    The loop is that of the error observer with a band that has faded out, and a DC estimate, which the damper does not
    use: their poles, at -50 1/s and beyond, are the only ones that are not the damper's.
    """
    parameters = PlateParameters()
    model = parameters.device_model(parameters.rate, parameters.delay)
    strength = float(case.mechanics.load_factor(np.asarray(case.load)))
    plant = loaded_plate(parameters, model, case.mechanics, position=case.position, strength=strength)
    taps, nothing = choose_damping(model).taps, np.zeros((1, 2, 2))
    frequency = np.concatenate([np.linspace(1.0, 0.499 * plant.rate, 300), plant.modes()])
    z = np.exp(2j * np.pi * frequency / plant.rate)
    growth, modulus = np.empty((2, len(DELAYS), len(FACTORS)))
    for at in np.ndindex(growth.shape):
        loop = ErrorLoop(
            plant=plant, delay=int(DELAYS[at[0]]), frequency=np.array([100.0]), observer=0.0, integral=0.0, dc=0.5,
            dc_drift=0.05, inner=float(FACTORS[at[1]]), taps=taps, law=nothing, slope=nothing, share=np.zeros(1),
        )  # fmt: skip
        growth[at] = loop.growth()
        modulus[at] = 1 / sensitivity(loop.loop(z)).max() if growth[at] < 0 else 0.0
    return DamperMap(growth, modulus)


def limits(found: DamperMap) -> tuple[int, float]:
    """Longest true delay (samples) with which the damper as designed is stable, and its margin with the delay told."""
    designed = int(np.argmin(abs(FACTORS - 1.0)))
    return int(DELAYS[found.growth[:, designed] < 0].max()), float(found.modulus[0, designed])


def draw(rows: dict[str, list[StabilityMap]], dampers: list[DamperMap]) -> Any:
    """Draw the maps of `measure`, and of `damper_map`: margin as shade, the unstable region hatched."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    columns = cases()
    with new_figure((15.0, 13.0), **{"axes.grid": False, "hatch.linewidth": 0.6}) as figure:
        axes = figure.subplots(len(rows) + 1, len(columns), sharey="row", sharex="row")
        for lane, (method, row) in zip(axes, rows.items(), strict=False):
            for panel, each in zip(lane, row, strict=True):
                shade = _by_bands(panel, each)
            lane[0].set_ylabel(f"{METHODS[method]}\nbandwidth (Hz)".replace(": ", ":\n"))
        for panel, found in zip(axes[-1], dampers, strict=True):
            _damper(panel, found)
        axes[-1, 0].set_ylabel("inverse, the default:\ndamper around contacts\nfactor on its gain")
        for panel, case in zip(axes[0], columns, strict=True):
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
    frequency, bandwidth = each.frequencies, each.bandwidths
    shade = _map(axes, frequency, bandwidth, each.growth[0, 0, 0].T, each.modulus[0, 0, 0].T)
    axes.plot(frequency, frequency / 4, color=ORANGE, lw=1.2, ls="--")
    axes.axhline(USUAL, color=ORANGE, lw=1.2, ls=":")
    axes.set(xscale="log", yscale="log", xlim=frequency[[0, -1]], ylim=bandwidth[[0, -1]])
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.set_yticks(WIDTHS, [f"{width:g}" for width in WIDTHS])
    axes.minorticks_off()
    return shade


def _damper(axes: Any, each: DamperMap) -> None:
    """Draw a map over delay and factor."""
    _map(axes, DELAYS, FACTORS, each.growth.T, each.modulus.T)
    axes.plot(DELAYS[0], 1.0, "o", color=ORANGE, ms=9, clip_on=False, zorder=4)
    axes.set(yscale="log", xlim=DELAYS[[0, -1]], ylim=FACTORS[[0, -1]], xlabel="true delay (samples; designed for 1)")
    axes.set_yticks([0.25, 0.5, 1, 2, 4, 8], ["0.25", "0.5", "1", "2", "4", "8"])
    axes.minorticks_off()


def _map(axes: Any, x: Any, y: Any, growth: Any, modulus: Any) -> Any:
    """Draw a margin (len(y), len(x)) as shade, and the unstable region."""
    shade = axes.pcolormesh(
        x, y, np.ma.masked_where(growth >= 0, modulus), cmap="cividis", vmin=0, vmax=FAIR, rasterized=True
    )
    if growth.max() > 0:
        axes.contourf(x, y, growth, levels=[0, np.inf], colors="white", hatches=["////"])
        axes.contour(x, y, growth, levels=[0], colors=INK, linewidths=1.8)
    axes.contour(x, y, modulus, levels=[FAIR], colors="white", linewidths=1.1)
    return shade
