"""Share among all pictures: colours, style, a figure apart from pyplot, its legend and its file."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.recordings.formats import MissingExtra, replacing

# Okabe and Ito's colours: distinct for every kind of colour vision, and of different lightness.
BLUE, ORANGE, GREEN, RED, INK, PALE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#222222", "#8A8A8A"
FORMATS = (".png", ".svg", ".pdf")
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": PALE,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


@contextmanager
def new_figure(size: tuple[float, float], *, pads: tuple[float, float] | None = None) -> Iterator[Any]:
    """Make a ``matplotlib.figure.Figure`` of `size` (inch), apart from pyplot, in `STYLE`.

    `pads` (inch) is the room beside and above every panel.  Raises `MissingExtra` without matplotlib.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("pictures need matplotlib: pip install 'hapticrender[plot]'") from error
    with matplotlib.rc_context(STYLE), np.errstate(all="ignore"):
        figure: Any = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        if pads is not None:
            figure.get_layout_engine().set(w_pad=pads[0], h_pad=pads[1])
        yield figure


def check_format(path: str | os.PathLike[str]) -> Path:
    """Return `path` if its ending names a picture format; a ValueError lists the known ones."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path}: suffix {path.suffix!r} is no picture format: must be one of {', '.join(FORMATS)}")
    return path


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure in the format of the ending of `path`; an older file is replaced when the new one is whole."""
    path = check_format(path)
    with np.errstate(all="ignore"), replacing(path) as scratch:
        figure.savefig(scratch, dpi=110, format=path.suffix[1:].lower())


def legend(axes: Any, *entries: Any, columns: int = 6) -> None:
    """Put the legend above the panel, right of its title, where no curve runs."""
    axes.legend(
        *entries, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, borderaxespad=0.1, handlelength=1.6,
        columnspacing=0.9,
    )  # fmt: skip
