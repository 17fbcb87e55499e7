"""Sixteen fingers on the same grating at once: scenarios side by side in the processor's lanes, and on two processes.

The figure is the worst relative error at the finger.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import hapticrender as hr
from hapticrender.batch import Scenario
from hapticrender.sweep import sweep, worst_error
from hapticrender.touch.mechanics import NAMED


def main() -> float:
    bands = hr.Grating(frequency=178.0, amplitude=20e-6).bands(5000.0)
    fingers = {
        f"{name}, {load:g} N, {1e3 * place:g} mm": hr.Finger.still(place, normal_load=load, mechanics=NAMED[name])
        for name in ("light", "heavy")
        for load in (0.3, 0.8)
        for place in (0.0, 5e-3, 10e-3, 20e-3)
    }
    scenarios = [Scenario(bands=bands, finger=finger) for finger in fingers.values()]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:  # or a cluster: dask's Client(...).get_executor()
        errors = sweep(scenarios, 2.0, worst_error, executor=pool, at_a_time=8)
    for name, error in zip(fingers, errors, strict=True):
        print(f"{name:30s} {100 * error:5.2f} %")
    return max(errors)


if __name__ == "__main__":
    print(main())
