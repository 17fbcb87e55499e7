"""Inject faults of sensors and coils into a plate that the library does not know, while a texture plays.

Run: python -m benchmarks.faults [--place MM] [fault ...]

The plate is that of ``tests/other_plate.py``.  Printed for every fault, over 10 and 50 um, without and with a heavy
finger of 0.8 N on the middle, or `--place` (mm) off it, then with 0.8 and 2 N: the time from the fault to the stop, how
many runs stopped, the largest drive and the largest true motion of an end.
"""

import argparse
from itertools import product

import numpy as np

import hapticrender as hr
from hapticrender.touch.mechanics import HEAVY_SECOND
from tests.other_plate import REACH, OtherPlate

START, DURATION = 0.6, 1.6  # s: the fault, the end of a run that is not stopped
FINGER = HEAVY_SECOND.mass, HEAVY_SECOND.damping, HEAVY_SECOND.stiffness
INVERTED, SWAPPED = np.diag([-1.0, 1.0]), np.eye(2)[::-1]


class FaultyPlate(OtherPlate):
    """A plate whose sensors or coils change at `START`; `change(plate, sensed)` returns what is sensed from then on."""

    probe = False

    def __init__(self, change, coils=None, **truth):
        super().__init__(seed=3, **truth)
        self.change, self.late_coils, self.motion, self.held = change, coils, [], None
        self._at_rest = np.linalg.solve(np.eye(4) - self._phi, self._push)

    def play(self, drive):
        late = len(self.played) >= START * self.rate
        if late and self.late_coils is not None:
            self._gamma, self.late_coils = self._gamma @ self.late_coils, None
        moved = abs(self._state - self._at_rest)
        self.motion.append(moved[0] + REACH * moved[1])
        sensed = super().play(drive)
        if not late:
            return sensed
        if self.held is None:
            self.held = sensed.sensed.copy()
        return sensed._replace(sensed=self.change(self, sensed.sensed))


def only_first(change):
    """Apply a change to the first sensor alone."""
    return lambda plate, sensed: np.column_stack([change(plate, sensed)[:, 0], sensed[:, 1]])


def noise(plate, sensed):
    """Sensors that show nothing but noise."""
    return 1e-6 * plate._rng.standard_normal(sensed.shape)


FAULTS = {
    "frozen, both": (lambda plate, sensed: plate.held, None),
    "frozen, one": (only_first(lambda plate, sensed: plate.held), None),
    "dead, both": (lambda plate, sensed: 0 * sensed, None),
    "dead, one": (only_first(lambda plate, sensed: 0 * sensed), None),
    "at its range, both": (lambda plate, sensed: 0 * sensed + 1e-3, None),
    "NaN, both": (lambda plate, sensed: np.nan * sensed, None),
    "every second NaN": (lambda plate, sensed: sensed * (1.0 if len(plate.played) % 2 else np.nan), None),
    "dead but noisy, both": (noise, None),
    "dead but noisy, one": (only_first(noise), None),
    "inverted, both": (lambda plate, sensed: -sensed, None),
    "inverted, one": (lambda plate, sensed: sensed @ INVERTED, None),
    "swapped": (lambda plate, sensed: sensed @ SWAPPED, None),
    "gain x3": (lambda plate, sensed: 3 * sensed, None),
    "one gain x3": (only_first(lambda plate, sensed: 3 * sensed), None),
    "gain x10": (lambda plate, sensed: 10 * sensed, None),
    "gain x0.1": (lambda plate, sensed: 0.1 * sensed, None),
    "gain x1000": (lambda plate, sensed: 1000 * sensed, None),
    "one gain x0.5": (lambda plate, sensed: sensed * (0.5, 1.0), None),
    "coils swapped": (lambda plate, sensed: sensed, SWAPPED),
    "coils inverted": (lambda plate, sensed: sensed, -np.eye(2)),
    "one coil inverted": (lambda plate, sensed: sensed, INVERTED),
    "one coil dead": (lambda plate, sensed: sensed, np.diag([0.0, 1.0])),
}


def run(fault, frequency, amplitude, load, place):
    """Time from fault to stop (s, NaN: none), largest drive (A) and motion (m) after the fault, and the message."""
    plate = FaultyPlate(*FAULTS[fault], **({"finger": FINGER, "load": load, "position": place} if load else {}))
    scene = hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=amplitude), duration=DURATION)
    stopped, message = np.nan, ""
    try:
        hr.render(scene, driver=plate)
    except hr.DeviceFault as error:
        stopped, message = error.time - START, str(error)
    first = round(START * plate.rate)
    drive = np.concatenate(plate.played)[first:]
    return stopped, abs(drive).max(), max(plate.motion[first:]), message


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("faults", nargs="*", metavar="fault", help=f"of {', '.join(FAULTS)}; all unless given")
    parser.add_argument("--place", type=float, default=0.0, help="of the finger (mm)")
    arguments = parser.parse_args()
    if unknown := set(arguments.faults) - set(FAULTS):
        parser.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(FAULTS)}")
    if abs(arguments.place) > 1e3 * REACH:
        parser.error(f"--place {arguments.place:g} mm: must be within {1e3 * REACH:g}, the ends of the plate")
    loads = (0.8, 2.0) if arguments.place else (0.0, 0.8)
    for fault, frequency in product(arguments.faults or FAULTS, (20.0, 72.0, 189.0, 400.0)):
        cases = product((10e-6, 50e-6), loads)
        runs = [run(fault, frequency, amplitude, load, 1e-3 * arguments.place) for amplitude, load in cases]
        times = np.array([each[0] for each in runs])
        count, latest = int(np.isfinite(times).sum()), np.nanmax(times) if np.isfinite(times).any() else np.nan
        drive, motion = max(each[1] for each in runs), max(each[2] for each in runs)
        causes = sorted({each[3].split(": ")[2][:40] if each[3] else "no stop" for each in runs})
        print(
            f"{fault:22} {frequency:4g} Hz: {1e3 * latest:6.1f} ms ({count} of 4), {drive:.2f} A, "
            f"{1e6 * motion:5.0f} um; {'; '.join(causes)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
