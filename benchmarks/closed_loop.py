"""Simulated seconds per second of the plate under the paper's controller, against the same loop in plain numpy.

Both run in this process, in turns; the figure is the median over the pairs,
the ratio the median of the pairs' ratios.  Shared machines are noisy: trust
the ratio, not the absolute figure.

Run: python benchmarks/closed_loop.py [--pairs 9] [--bands 8] [--json FILE]
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
from numpy_loop import NumpyPlate, NumpyPolar, run

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.methods import METHODS
from hapticrender.plants.vibrotactile import Plate, PlateParameters

COMPILED_SECONDS = 10.0
NUMPY_SECONDS = 0.2


def comb(bands):
    return Bands(
        frequency=np.linspace(20.0, 400.0, bands),
        wavenumber=np.zeros(bands),
        phase=np.zeros(bands),
        envelope=np.full(bands, 1e-6 + 0j),
    )


def compiled_rate(parameters, bands):
    plate = Plate(parameters, hr.Finger.absent())
    controller = METHODS["paper"].design(parameters.band_model(parameters.rate, parameters.delay), bands)
    samples = int(COMPILED_SECONDS * parameters.rate)
    start = time.perf_counter()
    plate.closed_loop(controller, np.zeros(samples))
    return COMPILED_SECONDS / (time.perf_counter() - start)


def numpy_rate(parameters, bands):
    controller = METHODS["paper"].design(parameters.band_model(parameters.rate, parameters.delay), bands)
    samples = int(NUMPY_SECONDS * parameters.rate)
    noise = np.random.default_rng(0).standard_normal((samples, 2)) * parameters.sensor_noise
    start = time.perf_counter()
    run(NumpyPolar(controller.tables), NumpyPlate(parameters), samples, noise)
    return NUMPY_SECONDS / (time.perf_counter() - start)


def measure(bands, pairs):
    parameters, wanted = PlateParameters(), comb(bands)
    compiled_rate(parameters, wanted)  # compile
    rows = [(compiled_rate(parameters, wanted), numpy_rate(parameters, wanted)) for _ in range(pairs)]
    return {
        "bands": bands,
        "pairs": pairs,
        "compiled_s_per_s": statistics.median(row[0] for row in rows),
        "numpy_s_per_s": statistics.median(row[1] for row in rows),
        "ratio": statistics.median(a / b for a, b in rows),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=9, help="interleaved pairs of runs")
    parser.add_argument("--bands", type=int, nargs="*", default=[1, 8, 64], help="numbers of bands")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    rows = [measure(bands, arguments.pairs) for bands in arguments.bands]
    print(f"{'bands':>6} {'compiled, s/s':>14} {'numpy, s/s':>12} {'ratio':>8}   (medians of {arguments.pairs} pairs)")
    for row in rows:
        print(f"{row['bands']:6d} {row['compiled_s_per_s']:14.0f} {row['numpy_s_per_s']:12.2f} {row['ratio']:8.0f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
