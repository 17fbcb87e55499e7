"""Colours, style and figures of the charts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Colours of Okabe and Ito, distinct in every kind of colour vision.
BLUE, ORANGE, GREEN, RED, INK, PALE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#222222", "#8A8A8A"
STYLE: dict[str, Any] = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": PALE, "axes.grid": True,
    "axes.axisbelow": True, "grid.color": "#E4E4E4", "grid.linewidth": 0.6, "legend.frameon": False,
    "legend.fontsize": 8, "figure.titleweight": "bold", "figure.titlesize": 12,
}  # fmt: skip


@contextmanager
def new_figure(size: tuple[float, float], **style: Any) -> Iterator[Any]:
    """Make a figure of `size` (inch) without pyplot, and draw into it in this style."""
    with matplotlib.rc_context({**STYLE, **style}):
        figure: Any = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
        yield figure


def rounded(value: float) -> str:
    """Write a number to two digits, or to the unit from 10 on."""
    return f"{value:.{2 if value < 0.995 else 1 if value < 9.95 else 0}f}"
