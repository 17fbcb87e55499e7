"""Draw where each method is stable on the plate, over carrier and bandwidth, for fingers and for a wrong plate."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmarks.charts.style import INK, ORANGE, PALE, new_figure
from hapticrender.control.damping import damping_taps
from hapticrender.control.linear import ErrorLoop, Structure
from hapticrender.control.margins import sensitivity
from hapticrender.control.polar_loop import PolarLoop
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.protocols import Array
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
PLATE = PlateParameters()
MODEL = PLATE.device_model(PLATE.rate, PLATE.delay)
LOG_OFFSETS = np.geomspace(0.02, 50.0, 60)  # bandwidths beside a carrier at which the peak of S is looked for
MODE_OFFSETS = np.linspace(-6.0, 6.0, 9)  # Hz: and around each mode of the plant
INTEGRAL = 3.4  # 1/s per Hz of bandwidth: 17 1/s at 5 Hz
QUALITY = 1.4  # of the modes under the inner loop


class Case(NamedTuple):
    """One column: what rests on the plate, or differs from the plate of the design."""

    title: str
    mechanics: FingerMechanics
    load: float  # N
    position: float  # m


class Map(NamedTuple):
    """Growth of the slowest-decaying pole (1/s; >= 0 is unstable) and modulus margin (0 where unstable), (F, B)."""

    frequencies: Array  # Hz
    bandwidths: Array  # Hz
    growth: Array
    modulus: Array


def cases() -> tuple[Case, ...]:
    """The columns. A stiffer plate is the plate of the design with a spring of the difference at its middle."""
    spring = WRONG * (PLATE.stiffness_1 + PLATE.stiffness_2)
    stiffer = FingerMechanics(order=2, mass=1e-9, damping=1e-6, stiffness=spring, reference_load=1.0)
    return (
        Case("no finger", NAMED["none"], 0.5, 0.0),
        Case(f"plate {100 * WRONG:g} % stiffer\nthan designed for", stiffer, 1.0, 0.0),
        Case("light finger, 0.3 N,\n27.5 mm off the middle", NAMED["light"], 0.3, 27.5e-3),
        Case("heavy finger, 0.8 N,\nin the middle", NAMED["heavy"], 0.8, 0.0),
        Case("heavy finger, 0.8 N,\n27.5 mm off the middle", NAMED["heavy"], 0.8, 27.5e-3),
    )


def measure(frequencies: int = 110, bandwidths: int = 40) -> dict[str, list[Map]]:
    """Evaluate every method and case before the finger is learnt, on 20-400 Hz and bandwidths of 1-80 Hz."""
    grid, widths = np.geomspace(20.0, 400.0, frequencies), np.geomspace(1.0, 80.0, bandwidths)
    return {method: [stability_map(method, case, grid, widths) for case in cases()] for method in METHODS}


def stability_map(method: str, case: Case, frequencies: Array, bandwidths: Array) -> Map:
    """Evaluate the linear loop of one method, one carrier at a time; no rule lowers the bandwidth here.

    A bandwidth b is the paper's fT with fL = 2 b; for the error observer it is a pole at 2 b and an integral of 3.4 b
    1/s.  The impedance of the finger grows with its load.
    """
    strength = float(case.mechanics.load_factor(np.asarray(case.load)))
    plant = loaded_plate(case.mechanics, case.position, strength)
    carrier, width = (grid.ravel() for grid in np.meshgrid(frequencies, bandwidths, indexing="ij"))
    growth, peak = _polar(method, plant, carrier, width) if "paper" in method else _error(method, plant, carrier, width)
    modulus = np.where(growth < 0, 1 / peak, 0.0)
    shape = len(frequencies), len(bandwidths)
    return Map(frequencies, bandwidths, growth.reshape(shape), modulus.reshape(shape))


def loaded_plate(mechanics: FingerMechanics, position: float, strength: float) -> Structure:
    """Structure of the plate with a finger, driven by forces on heave and rocking, which its sensors measure."""
    body = structure(PLATE, mechanics, position, strength)
    inputs = body.input[:, :2] @ np.linalg.inv(PLATE.force_from_drive)
    return replace(body, input=inputs, output=MODEL.coordinate_from_sensed @ body.output[1:3])


def _polar(method: str, plant: Structure, carrier: Array, width: Array) -> tuple[Array, Array]:
    """Growth and peak of S of the paper's loop for every carrier and bandwidth."""
    loop = PolarLoop.on(plant.sampled(PLATE.rate), MODEL, carrier, width, common=method == "paper-common")
    poles = loop.poles()
    offset = np.concatenate([width[:, None] * LOG_OFFSETS, np.abs(poles.imag) / (2 * np.pi)], axis=1)
    peak = sensitivity(loop.loop(np.clip(offset, 1e-3, 0.49 * PLATE.rate))).max(axis=1)
    return poles.real.max(axis=1), peak


def _error(method: str, plant: Structure, carrier: Array, width: Array) -> tuple[Array, Array]:
    """Growth and peak of S of the error observer's loop for every carrier and bandwidth."""
    rate = PLATE.rate
    dc = 2 * math.pi * np.minimum(6.0, carrier / 8) / rate
    loop = ErrorLoop.on(
        plant.sampled(rate),
        Structure.of(MODEL),
        carrier[:, None],
        delay=PLATE.delay,
        lead=(PLATE.delay + 0.5) / rate,
        observer=2 * 2 * math.pi * 2 * width / rate,
        integral=INTEGRAL * width,
        dc=1.6 * dc,
        dc_drift=dc**2,
        inner=np.full(len(width), float(method == "h2")),
        taps=damping_taps(MODEL, QUALITY)[0],
    )
    poles = loop.poles()
    near = LOG_OFFSETS[::2]
    beside = np.concatenate([-near[::-1], near]) * width[:, None] + carrier[:, None]
    modes = (loop.plant.modes()[:, None] + MODE_OFFSETS).ravel()
    afar = np.append(np.linspace(1.0, 0.499 * rate, LOG_OFFSETS.size), modes) * np.ones((len(carrier), 1))
    peak = np.zeros(len(carrier))
    for grid in (beside, afar, np.abs(poles.imag) / (2 * np.pi)):
        z = np.exp(2j * np.pi * np.clip(grid, 0.1, 0.499 * rate) / rate)
        peak = np.maximum(peak, sensitivity(loop.loop(z)).max(axis=1))
    return poles.real.max(axis=1), peak


def draw(rows: dict[str, list[Map]]) -> Any:
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


def _panel(axes: Any, each: Map) -> Any:
    """Draw one map."""
    frequency, bandwidth = each.frequencies, each.bandwidths
    growth, modulus = each.growth.T, each.modulus.T
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
