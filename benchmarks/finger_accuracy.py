"""Measure how well the finger is estimated from recordings of simulated subjects, against what the estimates say.

Run: python -m benchmarks.finger_accuracy [subjects [first seed]]

A subject touches a plate that is 2 % off its profile for 3 of 5 s, with eight carriers from 20 to 400 Hz at 10 mm/s or
6 um, at 0.1 to 1.2 N and up to 150 mm/s (`tests/subjects.py`): the fingers of Table 1, then random ones.
"""

import sys
from pathlib import Path

import numpy as np

import hapticrender as hr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from subjects import FREQUENCIES, OFF, ON, population  # noqa: E402  (after the path)

from hapticrender.analysis.records import LOADED  # noqa: E402
from hapticrender.formatting import table  # noqa: E402

MIDDLE = 15e-3  # m from the middle
SETTLED = 0.1  # s from a change of contact: 10 Hz have settled


def study(subject):
    """Errors of one subject: edges (s), load, position and velocity over truth, and impedance."""
    recording = subject.record()
    found = hr.analyse_finger(recording)
    touches = found.of_kind(LOADED)
    at = np.flatnonzero((found.time > ON + SETTLED) & (found.time < OFF - SETTLED))
    place, load = recording.position[at], recording.normal_load[at]
    middle = (np.abs(place) <= MIDDLE) & (load > 0.15)
    speed = (np.gradient(recording.position[: len(found.time)]) * recording.rate)[at]
    z = found.impedance
    truth = subject.impedance(z.frequency, z.normal_load)
    return {
        "touches": len(touches),
        "edge": max(abs(touches[0].start - ON), abs(touches[-1].stop - OFF)) if touches else np.inf,
        "load": np.max(np.abs(found.normal_load.value[at] - load) / np.maximum(0.05 * load, 0.02)),
        "position": np.max(np.abs(found.position.value[at] - place)[middle], initial=0.0),
        "velocity": np.sqrt(np.nanmean((found.velocity.value[at] - speed) ** 2)),
        "impedance": (z.value - truth) / z.standard_error,
        "relative": z.standard_error / np.abs(truth),
        "ratio": z.value / truth,
    }


def main(count=40, seed=1):
    """Print the worst errors of a population, and the standard errors of the impedance by band."""
    subjects = population(count, seed)
    each = [study(subject) for subject in subjects]
    print(f"{count} subjects; one touch found in {sum(one['touches'] == 1 for one in each)}")
    print(f"edges of contact: worst {1e3 * max(one['edge'] for one in each):.1f} ms (bound 10)")
    print(f"load: worst {max(one['load'] for one in each):.2f} of 5 % or 20 mN")
    position = 1e3 * max(one["position"] for one in each)
    print(f"position above 0.15 N in the middle 30 mm: worst {position:.2f} mm (bound 1)")
    print(f"velocity: rms, median of subjects {1e3 * np.median([one['velocity'] for one in each]):.1f} mm/s")
    names = "impedance", "relative", "ratio"
    error, relative, ratio = (np.concatenate([one[name] for one in each]) for name in names)
    parts = np.abs(np.stack([error.real, error.imag]))
    good = np.isfinite(parts)
    print(
        f"impedance: {100 * (parts[good] < 1).mean():.1f} % inside one standard error, "
        f"{100 * (parts[good] < 2).mean():.1f} % inside two"
    )
    near = (np.abs(np.abs(ratio) - 1) < 0.1) & (np.abs(np.angle(ratio, deg=True)) < 10)
    sure = 3 * relative < 0.1
    print(
        f"within 10 % and 10 degrees: {100 * near[sure].mean():.1f} % of the {sure.sum()} windows whose 3 standard "
        "errors are below 10 %"
    )
    rows = [["band (Hz)", "inside one", "standard error / |Z|: 0.1-0.3 N", "0.3-0.6 N", "0.6-1.5 N"]]
    loads = np.array([subject.load for subject in subjects])
    for k, frequency in enumerate(FREQUENCIES):
        cells = []
        for low, high in ((0.1, 0.3), (0.3, 0.6), (0.6, 1.5)):
            chosen = [each[i]["relative"][:, k] for i in np.flatnonzero((loads >= low) & (loads < high))]
            cells.append(f"{100 * np.nanmedian(np.concatenate(chosen)):.1f} %")
        rows.append([f"{frequency:g}", f"{100 * np.nanmean(parts[:, :, k] < 1):.0f} %", *cells])
    print(table(rows))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
