"""Measure and draw the error of whole waveforms by signal, finger and speed: `inverse` against the open inverse.

On the plate of ``tests/strangers_plate.py`` through ``hr.render``; E = rms(y - r)/rms(r) of its true motion, 20-500 Hz,
without shift or gain fit, under the finger and at the worse end (`hapticrender.accuracy`).  The glass is rigid.  The
open inverse is the same method on the same plate without sensors: of the free plate, with the finger's path known
beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks.charts.open_loop import AlongPath, SensorlessPlate
from benchmarks.charts.style import BLUE, INK, ORANGE, new_figure, rounded
from hapticrender import Finger, Grating, Recorded
from hapticrender.accuracy import signals
from hapticrender.accuracy.plate import RIGID, Bench, draw_fingers
from hapticrender.touch.mechanics import HEAVY, LIGHT, NONE
from tests.strangers_plate import StrangersPlate

SPEED, SPEEDS = 0.1, (0.04, 0.08, 0.15, 0.3)  # m/s
RANDOM = 6  # the first of the random fingers of the accuracy suite
RMS = 5e-6  # m: of every waveform
BLOCK = 20  # samples of the open inverse: the reference is known ahead, so only the rounding of its drive depends on it
HEAVIER = (HEAVY, 0.8)
TONES = (47.0, 120.0, 178.0, 261.0)  # Hz
LAWS = {"inverse": BLUE, "open inverse of the free plate": ORANGE}
FINGERS = ("no finger", "light finger, 0.3 N", "heavy finger, 0.8 N", f"{RANDOM} random fingers, 0.5 N")


def tones(seed: int) -> Recorded:
    """Four tones together, at random phases."""
    phases = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, len(TONES))
    turns = np.multiply.outer(np.arange(round(5 * signals.FINE)) / signals.FINE, TONES)
    return signals.recorded(np.sin(2 * np.pi * turns + phases).sum(axis=1))


def ridges(_: int) -> Grating:
    """Ridges of 2 mm with two harmonics: 50, 100 and 150 Hz at 100 mm/s."""
    partials = ((1, 1.0, 0.0), (2, 0.5, 1.0), (3, 1 / 3, 2.0))
    peak = RMS / np.sqrt(sum(size**2 for _, size, _ in partials) / 2)
    return Grating(wavelength=2e-3, amplitude=peak, partials=partials)


SIGNALS: dict[str, tuple[Callable[[int], Any], float, float]] = {  # texture, length (s), judged from (s)
    "white": (signals.white, 4.0, 1.5), "pink": (signals.pink, 4.0, 1.5), "chirp": (signals.chirp, 3.0, 0.3),
    "clicks": (signals.clicks, 4.0, 1.5), "tones": (tones, 4.0, 1.5), "ridges": (ridges, 4.0, 1.5),
}  # fmt: skip


class Row(NamedTuple):
    """One measurement: errors (%) under the finger and at the worse end."""

    law: str
    signal: str
    finger: str
    speed: float  # m/s
    error: float
    end: float


def rows(
    signals: Sequence[str] = tuple(SIGNALS), random: int = RANDOM, speeds: Sequence[float] = SPEEDS
) -> Iterator[Row]:
    """Measure every signal under every finger at `SPEED`, and white noise and ridges under a heavy one at `speeds`."""
    known: list[tuple[str, Any]] = list(zip(FINGERS, (None, (LIGHT, 0.3), HEAVIER), strict=False))
    fingers = known + [(FINGERS[-1], (finger, 0.5)) for finger in draw_fingers(random)]
    cases = [(signal, name, finger, SPEED) for signal in signals for name, finger in fingers]
    cases += [
        (signal, FINGERS[2], HEAVIER, speed) for signal in ("white", "ridges") if signal in signals for speed in speeds
    ]
    for law in LAWS:
        for signal, name, finger, speed in cases:
            yield Row(law, signal, name, speed, *error(law, signal, finger, speed))


def error(law: str, signal: str, finger: Any, speed: float) -> tuple[float, float]:
    """Play one waveform under a sliding finger; None: there is none, or for ridges a position without a force."""
    make, seconds, start = SIGNALS[signal]
    texture, path = make(1), partial(signals.sliding, speed=speed)
    bench = Bench(method="inverse", make=StrangersPlate.of).of(**RIGID)
    if law != "inverse":
        texture, bench = AlongPath(texture, path), Bench(method="inverse", make=SensorlessPlate.of).of(BLOCK, **RIGID)
    if finger is None and signal == "ridges":
        finger = (NONE, 0.0)  # a position without a force
    who = finger and Finger(signals.Path(path), finger[1], mechanics=finger[0])
    at, end = 100 * bench.play(texture, seconds, who).wave_error(start)
    return float(at), float(end)


def draw(found: Sequence[Row]) -> Any:
    """Draw a panel for each finger, and one over speed."""
    signals = list(dict.fromkeys(row.signal for row in found))
    with new_figure((12.5, 4.2)) as figure:
        axes = figure.subplots(1, 5, width_ratios=[1, 1, 1, 1, 1.5])
        for panel, finger in zip(axes, FINGERS, strict=False):
            for law, color in LAWS.items():
                for at, signal in enumerate(signals):
                    own = [row for row in found if row[:4] == (law, signal, finger, SPEED)]
                    _errors(panel, at, own, color)
            panel.set_yticks(range(len(signals)), signals if panel is axes[0] else [])
            panel.set(
                xscale="log", xlim=(0.1, 150.0), ylim=(len(signals) - 0.5, -0.5), title=finger, xlabel="error (%)"
            )
            panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        _over_speed(axes[-1], found)
        _legend(figure)
        figure.suptitle(
            f"Error of whole waveforms of 5 µm rms on a third party's plate, finger sliding at {1e3 * SPEED:g} mm/s"
        )
    return figure


def _errors(axes: Any, at: float, own: Sequence[Row], color: str) -> None:
    """Draw and write the median error of one signal, its range over fingers, and the worse end."""
    if not own:
        return
    errors = [row.error for row in own]
    middle = float(np.median(errors))
    axes.plot([min(errors), max(errors)], [at, at], color=color, lw=1.5)
    axes.plot(middle, at, "o", color=color, ms=6)
    axes.plot(np.median([row.end for row in own]), at, "|", color=color, ms=9, mew=1.5)
    offset = (0, 5) if color == BLUE else (0, -12)
    axes.annotate(rounded(middle), (middle, at), offset, textcoords="offset points", ha="center", fontsize=7.5)


def _over_speed(axes: Any, found: Sequence[Row]) -> None:
    """Draw white noise and ridges under the heavy finger over speed."""
    for signal, line in (("white", "o-"), ("ridges", "s--")):
        for law, color in LAWS.items():
            own = {row.speed: row.error for row in found if row[:3] == (law, signal, FINGERS[2])}
            speeds = sorted(own)
            axes.plot(1e3 * np.array(speeds), [own[each] for each in speeds], line, color=color, label=signal)
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(0.1, 150.0),
        title="heavy finger, by speed",
        xlabel="speed (mm/s)",
    )
    ticks = sorted({round(1e3 * row.speed) for row in found})
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")


def _legend(figure: Any) -> None:
    """Explain colours and marks."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, lw=4, label=law) for law, color in LAWS.items()]
    handles += [
        Line2D([], [], color=INK, marker=mark, ls=line, label=label)
        for mark, line, label in (
            ("o", "", "under the finger (random: median, range)"), ("|", "", "at the worse end"),
            ("o", "-", "white"), ("s", "--", "ridges"),
        )
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=6)
