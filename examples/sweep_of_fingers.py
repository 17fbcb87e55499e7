"""Sixteen fingers on the same grating, rendered by two processes.

The figure is the worst waveform error of any finger, at its worst place.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import hapticrender as hr
from hapticrender.sweep import sweep, worst_error


def main() -> float:
    texture = hr.Grating(frequency=178.0, amplitude=20e-6)
    scenes = [
        hr.Scene(
            name=f"{mechanics}, {load:g} N, {1e3 * place:g} mm",
            texture=texture,
            finger=hr.Finger.still(place, normal_load=load, mechanics=mechanics),
            duration=2.0,
        )
        for mechanics in ("light", "heavy")
        for load in (0.3, 0.8)
        for place in (0.0, 5e-3, 10e-3, 20e-3)
    ]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:  # or a cluster: dask's Client(...).get_executor()
        errors = sweep(scenes, worst_error, executor=pool, at_a_time=8)
    for scene, error in zip(scenes, errors, strict=True):
        print(f"{scene.name:30s} {100 * error:5.2f} %")
    return max(errors)


if __name__ == "__main__":
    print(main())
