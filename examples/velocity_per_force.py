"""How far the skin moves per newton, against the ratio at which people call vibration and friction equally strong.

The figure is the mean |V_s/F| (m/(N s)) of a light finger over the paper's eight frequencies; people match 0.64.
"""

import sys

import numpy as np

from hapticrender.touch.builtin_scenes import PAPER_FREQUENCIES
from hapticrender.touch.mechanics import HEAVY, LIGHT
from hapticrender.touch.perception import VELOCITY_PER_FORCE


def draw(path: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    frequency = np.geomspace(20, 400, 300)
    for name, mechanics, colour in (("light", LIGHT, "#0072B2"), ("heavy", HEAVY, "#E69F00")):
        axes.loglog(frequency, abs(mechanics.skin_velocity_per_force(frequency)), color=colour, label=f"{name} finger")
    axes.axhline(VELOCITY_PER_FORCE, color="#222222", ls="--", label="matched by people, 0.64")
    axes.set_xticks(PAPER_FREQUENCIES, [f"{each:g}" for each in PAPER_FREQUENCIES])
    axes.set_yticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
    axes.minorticks_off()
    axes.set(xlabel="frequency (Hz)", ylabel="|V_s/F| (m/(N s))", title="Skin velocity per newton of friction")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def main(picture: str | None = None) -> float:
    frequency = np.array(PAPER_FREQUENCIES)
    ratio = abs(LIGHT.skin_velocity_per_force(frequency))
    for each, value in zip(frequency, ratio, strict=True):
        print(f"{each:4g} Hz: {value:.3f} m/(N s), {20 * np.log10(value / VELOCITY_PER_FORCE):+.1f} dB from the match")
    if picture:
        draw(picture)
    return float(ratio.mean())


if __name__ == "__main__":
    print(main(*sys.argv[1:2]))
