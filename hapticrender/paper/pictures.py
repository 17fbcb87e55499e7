"""One picture for each item of the paper: what comes out, and beside it, in black and broken, what the paper prints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.charts.figures import BLUE, GREEN, INK, ORANGE, PALE, RED, new_figure, save
from hapticrender.paper.claims import Item, Table

PRINTED: dict[str, Any] = {"color": INK, "lw": 1.1, "ls": (0, (4, 2))}
METHODS = (("paper", RED, "o"), ("paper-common", ORANGE, "s"), ("h2", BLUE, "D"))
AMPLITUDES = ((GREEN, "1 µm"), (ORANGE, "10 µm"), (BLUE, "100 µm"))
TICKS = (20, 31, 47, 72, 111, 170, 261, 400)  # Hz


def draw(path: Path, item: Item) -> None:
    """Draw an item into a PNG.

    Parameters
    ----------
    path : Path
        File to write.
    item : Item
        One whose name is in `PICTURES`.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    with new_figure((11, 4.4), pads=(0.12, 0.07)) as figure:
        PICTURES[item.name](figure, item.tables)
        save(figure, path)


def _frequency_axis(*lanes: Any) -> None:
    """Logarithmic frequency axis with the paper's own frequencies."""
    for axes in lanes:
        axes.set(xscale="log", xlim=(18, 445), xlabel="frequency (Hz)")
        axes.set_xticks(TICKS, [f"{each}" for each in TICKS])
        axes.minorticks_off()


def _plain(axis: Any, *ticks: float) -> None:
    """Ticks of a logarithmic axis as plain numbers."""
    axis.set_ticks(ticks, [f"{each:g}" for each in ticks])
    axis.set_minor_locator(axis.get_major_locator().__class__([]))


def _controller(figure: Any, tables: Any) -> None:
    """C, T and S over frequency."""
    columns = tables["response"]
    frequency = columns["frequency (Hz)"]
    left, right = figure.subplots(1, 2)
    for symbol, colour in (("C", BLUE), ("T", RED), ("S", GREEN)):
        left.plot(frequency, columns[f"{symbol} exact (dB)"], color=colour, lw=1.8, label=symbol)
        left.plot(frequency, columns[f"{symbol} 2nd order (dB)"], color=colour, lw=1.0, ls=":")
    for symbol, colour in (("C", BLUE), ("T", RED)):
        right.plot(frequency, columns[f"{symbol} exact (deg)"], color=colour, lw=1.8, label=f"{symbol} exact")
        right.plot(
            frequency,
            columns[f"{symbol} 2nd order (deg)"],
            color=colour,
            lw=1.2,
            ls=":",
            label=f"{symbol} by the 2nd-order C",
        )
    left.plot([0.1, 5, 5], [-3, -3, -60], **PRINTED, label="paper: T is -3 dB at 5 Hz")
    left.set(
        title="Controller C, closed loop T, sensitivity S; dotted: C of 2nd order",
        ylabel="magnitude (dB)",
        ylim=(-60, 35),
    )
    right.set(title="Their phase", ylabel="phase (deg)")
    for axes in (left, right):
        axes.set(xscale="log", xlabel="frequency (Hz)", xlim=(0.1, 100))
        _plain(axes.xaxis, 0.1, 1, 5, 10, 100)
        axes.legend(loc="lower left")


def _transform(figure: Any, tables: Any) -> None:
    """Frequency and step response of the two transforms."""
    left, right = figure.subplots(1, 2)
    styles = (("STDFT*", BLUE, 2.0), ("STDFT, as quiet", RED, 1.2), ("STDFT, as wide", ORANGE, 1.2))
    for name, colour, width in styles:
        left.plot(
            tables["response"]["offset (Hz)"], tables["response"][f"{name} (dB)"], color=colour, lw=width, label=name
        )
        right.plot(1e3 * tables["step"]["time (s)"], tables["step"][name], color=colour, lw=width, label=name)
    left.plot([0, 10, 10], [-3, -3, -70], **PRINTED)
    left.text(11, -2, "paper: cut-off 10 Hz", va="center", fontsize=8)
    left.axvspan(40, 100, color=PALE, alpha=0.12, lw=0)
    left.text(98, -6, "images of carriers from 20 Hz on", ha="right", va="top", fontsize=8)
    left.set(title="What is heard beside the carrier", xlabel="offset from the carrier (Hz)", ylabel="gain (dB)",
             ylim=(-45, 3), xlim=(0, 100))  # fmt: skip
    right.set(title="An amplitude switched on", xlabel="time (ms)", ylabel="estimated amplitude", xlim=(0, 200))
    right.legend(loc="lower right")


def _commanded(figure: Any, tables: Any) -> None:
    """Motion of an end and of the centre, spectra, and the errors of the methods."""
    figure.set_size_inches(11, 9.4)
    grid = figure.add_gridspec(3, 3)
    _end(figure.add_subplot(grid[0, :2]), tables["end 2"])
    _errors(figure.add_subplot(grid[0, 2]), tables["errors"])
    centre, spectrum = tables["centre"], tables["spectrum"]
    shown = (spectrum["frequency (Hz)"] >= 150) & (spectrum["frequency (Hz)"] <= 372)
    for column, (name, label) in enumerate(zip(list(centre)[1:], ("1", "10", "100"), strict=True)):
        wanted, colour = float(label), AMPLITUDES[column][0]
        upper, lower = figure.add_subplot(grid[1, column]), figure.add_subplot(grid[2, column])
        time = 1e3 * (centre["time (s)"] - centre["time (s)"][0])
        upper.plot(time, centre[name] - centre[name].mean(), color=colour, lw=1.4)
        for sign in (-1, 1):
            upper.axhline(sign * wanted, **PRINTED)
        upper.set(title=f"Centre, {label} µm wanted", xlabel="time (ms)", ylim=(-1.5 * wanted, 1.5 * wanted))
        lower.plot(spectrum["frequency (Hz)"][shown], spectrum[name][shown], color=colour, lw=1.2)
        lower.axhline(wanted, **PRINTED)
        lower.set(title="Its spectrum, 2 s", xlabel="frequency (Hz)", yscale="log", xlim=(150, 372))
        lower.set_ylim(1e-4, 400)
        lower.minorticks_off()
        if column == 0:
            upper.set_ylabel("displacement (µm)")
            lower.set_ylabel("peak amplitude (µm)")
            lower.axhline(0.01, color=RED, lw=1.0, ls=":")
            lower.text(370, 60, "dotted: paper's accuracy, 0.01 µm", color=RED, fontsize=8, ha="right", va="bottom")
            lower.text(152, 1.25, "paper: as set", fontsize=8, va="bottom")
            upper.text(0, 1.05, "paper: as set", fontsize=8, va="bottom")
    figure.suptitle("261 Hz, heavy finger, 0.5 N, sliding at 100 mm/s: the paper's controller, each side apart",
                    fontweight="bold", fontsize=11, x=0.01, ha="left")  # fmt: skip


def _end(axes: Any, columns: Table) -> None:
    """Displacement of one end in all, and of what the coils do; the finger's place behind."""
    time = columns["time (s)"]
    axes.plot(time, columns["displacement (um)"], color=PALE, lw=0.5, label="in all: the finger tilts the plate")
    axes.plot(time, columns["without what is slow (um)"], color=ORANGE, lw=0.5, label="above 10 Hz")
    axes.axhline(0, color=INK, lw=0.6)
    axes.set(title="Fig. 4 A: end 2, 10 µm wanted", xlabel="time (s)", ylabel="displacement (µm)", xlim=(0.5, 5))
    axes.set_ylim(-85, 85)
    beside = axes.twinx()
    beside.plot(time, columns["finger (mm)"], color=BLUE, lw=1.4, label="finger (right)")
    beside.set(ylabel="finger from the middle (mm)", ylim=(-85, 85))
    beside.grid(visible=False)
    handles = [*axes.get_legend_handles_labels()[0], *beside.get_legend_handles_labels()[0]]
    axes.legend(handles=handles, loc="upper left", ncols=3)
    for line in axes.get_legend().get_lines():
        line.set_linewidth(2)


def _errors(axes: Any, columns: Table) -> None:
    """Mean amplitude of the centre under a heavy finger, by method."""
    for (name, colour, marker), shift in zip(METHODS, (0.8, 1.0, 1.25), strict=True):
        chosen = (columns["finger"] == "heavy") & (columns["method"] == name)
        for place, filled in (("centre", True), ("end 1", False)):
            wanted, off = columns["wanted (um)"][chosen], columns[f"{place}, off by (%)"][chosen]
            fill = colour if filled else "none"
            axes.plot(shift * wanted, off, marker, color=colour, ms=6, mfc=fill, label=name if filled else None)
    axes.axhline(0, **PRINTED)
    axes.set(title="Mean amplitude off by (ring: end 1)", xlabel="wanted (µm)", ylabel="error (%)", xscale="log")
    axes.set_xlim(0.5, 200)
    axes.set_ylim(-6, 6)
    _plain(axes.xaxis, 1, 10, 100)
    axes.legend(loc="upper right")


def _frequencies(figure: Any, tables: Any) -> None:
    """Errors at the eight frequencies, free and under a finger."""
    lanes = figure.subplots(1, 2, sharey=True)
    for axes, columns, title in zip(
        lanes, tables.values(), ("Free plate", "Heavy finger, 0.5 N, sliding at 100 mm/s"), strict=True
    ):
        frequency = columns["frequency (Hz)"]
        axes.axhspan(-5, 5, color=PALE, alpha=0.15, lw=0, label="5 %")
        axes.axhline(0, **PRINTED, label="paper: as commanded")
        for (method, colour, marker), shift in zip(METHODS, (0.97, 1.0, 1.03), strict=True):
            places = np.array([columns[f"{method}, {place} (%)"] for place in ("end 1", "end 2")])
            axes.vlines(shift * frequency, places.min(axis=0), places.max(axis=0), color=colour, lw=1.2)
            axes.plot(shift * frequency, columns[f"{method}, centre (%)"], marker, color=colour, ms=5, label=method)
        axes.set_title(title)
        axes.set_yscale("symlog", linthresh=5)
        axes.set_yticks([-100, -10, -5, 0, 5, 10, 100, 400], ["-100", "-10", "-5", "0", "5", "10", "100", "400"])
        axes.minorticks_off()
        axes.set_ylim(-120, 700)
        _frequency_axis(axes)
    lanes[0].set_ylabel("amplitude off by (%)")
    lanes[0].legend(loc="upper left", title="centre; the line spans both ends", title_fontsize=8, alignment="left")


def _press(figure: Any, tables: Any) -> None:
    """Errors under a press over frequency, by amplitude."""
    columns = tables["errors"]
    lanes = figure.subplots(1, 2, sharey=True)
    for axes, (method, title) in zip(
        lanes, (("paper", "The paper's controller"), ("h2", "h2, which tracks the sag")), strict=True
    ):
        axes.axhline(0, **PRINTED, label="paper: the load is ignored")
        for (colour, label), marker in zip(AMPLITUDES, ("o", "s", "D"), strict=True):
            name = f"{label.replace('µ', 'u')}, {method} (%)"
            off = np.where(columns[name] < 20, columns[name], np.nan)
            axes.plot(columns["frequency (Hz)"], off, marker=marker, color=colour, lw=1.2, ms=5, label=label)
        axes.set(title=title, ylim=(-108, 20))
        _frequency_axis(axes)
    lanes[0].text(21, -97, "nothing moves", fontsize=8, va="bottom")
    beyond = columns["100 um, paper (%)"][TICKS.index(170)]
    lanes[0].text(
        170, -12, f"170 Hz: {beyond:+.0f} %,\ntwo sides apart fail,\nload or not", fontsize=8, ha="center", va="top"
    )
    lanes[0].set_ylabel("amplitude at the centre off by (%)")
    lanes[1].legend(loc="lower right", title="still press of 0.5 N, no sensor noise", title_fontsize=8)


def _plate(figure: Any, tables: Any) -> None:
    """Frequency responses of the plate."""
    columns = tables["response"]
    frequency = columns["frequency (Hz)"]
    left, right = figure.subplots(1, 2)
    left.plot(frequency, columns["centre, coils together (um/A)"], color=BLUE, lw=1.8, label="centre")
    left.plot(frequency, columns["end 2, coils together (um/A)"], color=GREEN, lw=1.2, label="end 2")
    left.axvline(190, **PRINTED, label="paper: resonance 190 Hz")
    left.set_title("Coils together: heave")
    right.plot(frequency, columns["end 2, coils opposed (um/A)"], color=BLUE, lw=1.8, label="end 2, by its moments")
    right.plot(frequency, columns["end 2, coils opposed, as printed (um/A)"], **PRINTED,
               label="end 2, equations as printed")  # fmt: skip
    right.set_title("Coils opposed: rocking")
    (rocking, heave), (printed, _) = tables["modes"]["frequency (Hz)"], tables["modes"]["as printed (Hz)"]
    peaks = (
        (left, heave, "centre, coils together (um/A)", "right"),
        (right, rocking, "end 2, coils opposed (um/A)", "right"),
        (right, printed, "end 2, coils opposed, as printed (um/A)", "left"),
    )
    for axes, mode, name, side in peaks:
        axes.annotate(f"{mode:.1f} Hz", (mode, columns[name].max()), (-6 if side == "right" else 6, 3),
                      textcoords="offset points", ha=side, fontsize=8)  # fmt: skip
    for axes in (left, right):
        axes.set(yscale="log", ylabel="displacement per coil current (µm/A)")
        axes.margins(y=0.12)
        _frequency_axis(axes)
        axes.legend(loc="lower left")


def _loaded(figure: Any, tables: Any) -> None:
    """Gain of the plate under a finger over that without."""
    columns = tables["gain"]
    axes = figure.subplots()
    for kind, colour in (("light", BLUE), ("heavy", RED)):
        for order, style in (("4th", "-"), ("2nd", ":")):
            axes.plot(columns["frequency (Hz)"], columns[f"{kind}, {order} order (loaded/free)"], color=colour, lw=1.6,
                      ls=style, label=f"{kind}, {order} order")  # fmt: skip
    axes.axhline(1, **PRINTED)
    axes.axhspan(0.2, 1, color=PALE, alpha=0.15, lw=0)
    axes.text(20, 0.97, " paper: the finger always adds impedance, so the gain is below 1", va="top", fontsize=8)
    axes.set(
        title="Gain of the plate at its centre, a finger in the middle", ylabel="gain, loaded over free", yscale="log"
    )
    axes.set_ylim(0.2, 2.5)
    _plain(axes.yaxis, 0.25, 0.5, 1, 2)
    _frequency_axis(axes)
    axes.legend(loc="lower left")


def _extraction(figure: Any, tables: Any) -> None:
    """Load, place and impedance over time, put in and found."""
    figure.set_size_inches(11, 6.4)
    columns = tables["over time"]
    time = columns["time (s)"]
    pairs = (
        ("load (N)", "W found (N)", "normal load (N)", GREEN),
        ("place (mm)", "P found (mm)", "place (mm)", BLUE),
        ("|Z_f| (N s/m)", "|Z_f| found (N s/m)", "|Z_f| (N s/m)", RED),
    )
    lanes = figure.subplots(3, 1, sharex=True)
    for axes, (true, found, label, colour) in zip(lanes, pairs, strict=True):
        axes.plot(time, columns[found], color=colour, lw=1.0, label="found, as the paper does it")
        axes.plot(time, columns[true], **PRINTED, label="put in")
        axes.set(ylabel=label, xlim=(0, 10))
    lanes[0].legend(loc="upper right")
    lanes[2].set_xlabel("time (s)")
    lanes[0].set_title(
        "A simulated heavy finger under 50 µm at 111 Hz: touches at 1 s, leaves at 9 s, |Z_f| as W^(1/3)"
    )
    figure.align_ylabels(lanes)


def _impedance(figure: Any, tables: Any) -> None:
    """Impedance magnitudes of Table 1."""
    columns = tables["impedance"]
    lanes = figure.subplots(1, 2, sharey=True)
    for axes, kind, colour, load in zip(
        lanes, ("light", "heavy"), (BLUE, RED), ("W < 0.5 N", "W > 0.5 N"), strict=True
    ):
        for order, style, width in (("4th", "-", 2.0), ("2nd", ":", 1.6)):
            axes.plot(columns["frequency (Hz)"], columns[f"{kind}, {order} order (N s/m)"], color=colour, ls=style,
                      lw=width, label=f"{order} order")  # fmt: skip
        axes.set(title=f"{kind.capitalize()} touch, {load}", yscale="log", ylim=(0.5, 20))
        _plain(axes.yaxis, 0.5, 1, 2, 5, 10, 20)
        _frequency_axis(axes)
        axes.legend(loc="upper left", title="Table 1", title_fontsize=8, alignment="left")
    lanes[0].set_ylabel("|Z_f| (N s/m)")
    lanes[0].text(
        400, 0.6, "paper: the 2nd order could not fit the light\ntouch at higher frequencies", ha="right", fontsize=8
    )
    lanes[1].text(400, 0.6, "paper: the 2nd order predicts\nthe heavy touch well", ha="right", fontsize=8)


def _admittance(figure: Any, tables: Any) -> None:
    """Velocities per force, and the printed balance beside the right one."""
    columns, eight = tables["velocity per force"], tables["at the eight frequencies"]
    frequency = columns["frequency (Hz)"]
    left, right = figure.subplots(1, 2)
    left.plot(frequency, columns["V_s/F (m/(N s))"], color=GREEN, lw=2.2, label="V_s: skin")
    left.plot(frequency, columns["V_p/F (m/(N s))"], color=RED, lw=1.6, ls=":", label="V_p: phalanx")
    left.plot(frequency, columns["V_t/F (m/(N s))"], color=BLUE, lw=1.6, ls="--", label="V_t: skin against phalanx")
    left.axhline(0.64, **PRINTED, label="paper: equal intensity, 0.64")
    left.set(title="Light touch, 4th order", ylabel="velocity per force (m/(N s))", ylim=(0, 1.25))
    right.plot(frequency, columns["V_s/F (m/(N s))"], color=GREEN, lw=2.2, label="V_s/F, with b_p x_p'")
    right.plot(frequency, columns["V_s/F, balance as printed (m/(N s))"], **PRINTED, label="as printed, with b_p x_s'")
    for place, off in zip(eight["frequency (Hz)"], eight["balance as printed, off by (%)"], strict=True):
        right.text(place, 0.05, f"{off:+.0f} %", ha="center", fontsize=8)
    right.text(20, 0.12, "as printed, off by:", fontsize=8)
    right.set(title="The force balance of the phalanx", ylim=(0, 1.25))
    _frequency_axis(left, right)
    for axes in (left, right):
        axes.legend(loc="upper right")


def _electroadhesion(figure: Any, tables: Any) -> None:
    """Envelope of the current and the force over a period."""
    columns = tables["period"]
    turn = columns["time (periods)"]
    left, right = figure.subplots(1, 2)
    left.plot(turn, columns["current with the root (mA)"], color=BLUE, lw=2.0, label="6 mA sqrt((sin + 1)/2)")
    left.plot(turn, columns["current without (mA)"], color=ORANGE, lw=1.2, label="without the root")
    left.axhline(6, **PRINTED, label="paper: 6 mA")
    left.set(title="Envelope of the 20 kHz current", ylabel="current (mA)", ylim=(0, 7.6))
    right.plot(turn, columns["force with the root (of its peak)"], color=BLUE, lw=2.0, label="with the root")
    right.plot(
        turn, columns["force without (of its peak)"], color=ORANGE, lw=1.2, label="without: 25 % second harmonic"
    )
    right.plot(turn, (np.sin(2 * np.pi * turn) + 1) / 2, **PRINTED, label="paper: a sine")
    right.set(title="Force, as the square of the current", ylabel="force (of its peak)", ylim=(0, 1.28))
    for axes in (left, right):
        axes.set(xlabel="time (periods of the grating)", xlim=(0, 1))
        axes.legend(loc="upper right")


def _stimuli(figure: Any, tables: Any) -> None:
    """Ceiling of the displacement, and what it takes."""
    ceiling, eight = tables["ceiling"], tables["frequencies"]
    left, right = figure.subplots(1, 2)
    left.plot(ceiling["frequency (Hz)"], ceiling["displacement (mm)"], color=BLUE, lw=1.8, label="0.06 m/s")
    left.plot(eight["frequency (Hz)"], eight["displacement (mm)"], "o", color=BLUE, ms=5, label="the eight frequencies")
    left.plot([20, 400], [0.48, 0.024], "x", color=INK, ms=9, mew=1.6, label="paper: 0.48 and 0.024 mm")
    left.axhline(0.5, **PRINTED, label="paper: sensor linear to 0.5 mm")
    left.set(title="Ceiling of the slider", ylabel="displacement (mm, peak)", yscale="log", ylim=(0.02, 0.9))
    _plain(left.yaxis, 0.02, 0.05, 0.1, 0.2, 0.5)
    left.legend(loc="lower left")
    right.plot(ceiling["frequency (Hz)"], ceiling["current a coil (A)"], color=RED, lw=1.8)
    right.set(title="What that takes, without a finger", ylabel="current in each coil (A, peak)", ylim=(0, None))
    _frequency_axis(left, right)


def _statistics(figure: Any, tables: Any) -> None:
    """Printed and recomputed p values."""
    columns = tables["p"]
    rows = np.arange(len(columns["t"]))[::-1]
    axes = figure.subplots()
    axes.plot(columns["p two-sided"], rows, "o", color=BLUE, ms=7, label="two-sided")
    axes.plot(columns["p one-sided"], rows, "o", mfc="none", color=BLUE, ms=7, label="one-sided")
    axes.plot(columns["p below, printed"], rows, "|", color=INK, ms=26, mew=1.6, label="paper: p below")
    names = [
        f"t({degrees:.0f}) = {t:g}" for t, degrees in zip(columns["t"], columns["degrees of freedom"], strict=True)
    ]
    axes.set_yticks(rows, names)
    axes.set(title="p of the printed t", xlabel="p", xscale="log", xlim=(1e-9, 1), ylim=(-0.7, rows.max() + 0.7))
    axes.minorticks_off()
    axes.legend(loc="lower left", markerscale=0.6)


PICTURES: dict[str, Callable[[Any, Any], None]] = {
    "controller": _controller,
    "transform": _transform,
    "commanded": _commanded,
    "frequencies": _frequencies,
    "press": _press,
    "plate": _plate,
    "loaded": _loaded,
    "extraction": _extraction,
    "impedance": _impedance,
    "admittance": _admittance,
    "electroadhesion": _electroadhesion,
    "stimuli": _stimuli,
    "statistics": _statistics,
}
