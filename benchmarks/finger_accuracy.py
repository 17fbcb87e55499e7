"""Measure how well the finger is estimated from recordings of simulated subjects, against what the estimates say.

Run: python -m benchmarks.finger_accuracy [rigid | bending | unknown | own] [subjects [first seed]]

A subject touches a plate that is 2 % off its profile for 3 of 5 s, with eight carriers from 20 to 400 Hz at 10 mm/s or
6 um, at 0.1 to 1.2 N and up to 150 mm/s (`tests/subjects.py`): the fingers of Table 1, then random ones.  The plate is
`tests/strangers_plate.py`, which shares no code with the library: rigid, or bending at 1250 Hz (Q 30, shape 0.1 at the
coils), where the profile has the mode, 2 % too low, or does not know it; or it is the library's own.
"""

import sys
from pathlib import Path

import numpy as np

import hapticrender as hr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from subjects import FREQUENCIES, population  # noqa: E402  (after the path)

from hapticrender.formatting import table  # noqa: E402
from hapticrender.plants.plate import PlateParameters  # noqa: E402

BENDING = (1250.0, 30.0, 0.1)  # Hz, Q, shape at the coils
KNOWN = PlateParameters(bending_frequency=1225.0, bending_damping=1 / 60, bending_coil=0.1)
PLATES = {"rigid": (None, None), "bending": (BENDING, KNOWN), "unknown": (BENDING, None)}  # truth, and what is analysed
LOADS = ((0.1, 0.3), (0.3, 0.6), (0.6, 1.5))  # N


def study(subject, plate):
    """Errors of what is found of one subject."""
    if plate == "own":
        recording = subject.record()
        return subject.errors(recording, hr.analyse_finger(recording))
    bending, profile = PLATES[plate]
    recording = subject.record_elsewhere(bending)
    return subject.errors(recording, hr.analyse_finger(recording, profile), grows=False)


def main(plate="rigid", count=40, seed=1):
    """Print the errors of a population."""
    subjects = population(int(count), int(seed))
    print(f"{plate}:")
    show(subjects, [study(subject, plate) for subject in subjects])


def show(subjects, errors):
    """Print the worst of their errors, and the standard errors of the impedance by band."""
    print(f"{len(subjects)} subjects; one touch found in {sum(one.touches == 1 for one in errors)}")
    print(f"edges of contact: worst {1e3 * max(one.edge for one in errors):.1f} ms (bound 10)")
    print(f"load: worst {max(one.load.max() for one in errors):.2f} of 5 % or 20 mN")
    position = 1e3 * max(one.position.max(initial=0.0) for one in errors)
    print(f"position above 0.15 N in the middle 30 mm: worst {position:.2f} mm (bound 1)")
    velocity = [np.sqrt(np.nanmean(one.velocity**2)) for one in errors]
    print(f"velocity: rms, median of subjects {1e3 * np.median(velocity):.1f} mm/s")
    names = "impedance", "relative", "ratio"
    error, relative, ratio = (np.concatenate([getattr(one, name) for one in errors]) for name in names)
    parts = np.abs(np.stack([error.real, error.imag]))
    good = np.isfinite(parts)
    shares = [100 * (parts[good] < times).mean() for times in (1, 2)]
    print(f"impedance: {shares[0]:.1f} % inside one standard error, {shares[1]:.1f} % inside two")
    near = (np.abs(np.abs(ratio) - 1) < 0.1) & (np.abs(np.angle(ratio, deg=True)) < 10)
    sure = 3 * relative < 0.1
    windows = f"{sure.sum()} windows whose 3 standard errors are below 10 %"
    print(f"within 10 % and 10 degrees: {100 * near[sure].mean():.1f} % of the {windows}")
    by_load = {
        f"{low:g}-{high:g} N": group
        for low, high in LOADS
        if (group := [one for one, subject in zip(errors, subjects, strict=True) if low <= subject.load < high])
    }
    rows = [["band (Hz)", "inside one", "two", *by_load]]
    for k, frequency in enumerate(FREQUENCIES):
        medians = [np.nanmedian(np.concatenate([one.relative[:, k] for one in group])) for group in by_load.values()]
        inside = [np.mean(parts[:, :, k][good[:, :, k]] < times) for times in (1, 2)]
        rows.append([f"{frequency:g}", *(f"{100 * value:.1f} %" for value in (*inside, *medians))])
    print("standard error / |Z| by load, medians:")
    print(table(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
