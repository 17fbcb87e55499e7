"""Measure how well the plate alone says where a swiping finger is now: the tracker, and the estimator that predicts it.

Run: python -m benchmarks.plate_position [seconds]

The plate is identified, and plays five carriers of 31 to 261 Hz; the finger swipes at random around 3 Hz, 50 mm/s.
"""

import sys
from pathlib import Path

import numpy as np

import hapticrender as hr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from plate_swipes import followed_on_a_plate  # noqa: E402  (after the path)

from hapticrender.formatting import table  # noqa: E402
from hapticrender.plants.plate import PlateParameters  # noqa: E402

LOADS = (0.1, 0.15, 0.2, 0.4, 0.8)  # N


def main(seconds=20.0):
    """Print the errors of position and velocity under a few loads, and the finest grating at 30 degrees rms."""
    rows = [["load", "position", "velocity", "inside one, two", "finest grating"]]
    for load in LOADS:
        errors, stated = followed_on_a_plate(load, seconds, np.random.default_rng(1))
        position, velocity = np.sqrt(np.mean(errors**2, axis=0))
        shares = [100 * np.mean(np.abs(errors[:, 0]) < times * stated[:, 0]) for times in (1, 2)]
        inside = f"{shares[0]:.0f} %, {shares[1]:.0f} %"
        cells = f"{1e3 * position:.2f} mm", f"{1e3 * velocity:.0f} mm/s", inside, f"{12e3 * position:.1f} mm"
        rows.append([f"{load:g} N", *cells])
    tracker = hr.FingerTracker(PlateParameters(), lookahead=0.0)
    print(f"rms errors, predicted over {1e3 * tracker.latency / tracker.rate:.0f} ms")
    print(table(rows))


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
