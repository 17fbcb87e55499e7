"""Inject faults of sensors and coils into a plate that the library does not know, while a texture plays.

Run: python -m benchmarks.faults [fault ...]; python -m benchmarks.faults exchanged

The plate is that of ``tests/other_plate.py``.  Printed for every fault, over 10 and 50 um, without and with a heavy
finger of 0.8 N: the time from the fault to the stop, how many runs stopped, the largest drive and the largest true
motion of an end.  "exchanged" is apart: sensors exchanged on the plate of ``tests/strangers_plate.py``, 50 um, under a
finger on and off its middle.
"""

import sys
from itertools import product

import numpy as np

import hapticrender as hr
from hapticrender.touch.mechanics import HEAVY_SECOND
from tests.other_plate import REACH, OtherPlate
from tests.strangers_plate import StrangersPlate

START, DURATION = 0.6, 1.6  # s: the fault, the end of a run that is not stopped
FINGER = {"finger": (HEAVY_SECOND.mass, HEAVY_SECOND.damping, HEAVY_SECOND.stiffness), "load": 0.8}
INVERTED, SWAPPED = np.diag([-1.0, 1.0]), np.eye(2)[::-1]


class FaultyPlate(OtherPlate):
    """A plate whose sensors or coils change at `START`; `change(plate, sensed)` returns what is sensed from then on."""

    probe = False

    def __init__(self, change, coils=None, **truth):
        super().__init__(seed=3, **truth)
        self.change, self.late_coils, self.motion, self.held = change, coils, [], None

    def play(self, drive):
        late = len(self.played) >= START * self.rate
        if late and self.late_coils is not None:
            self._gamma, self.late_coils = self._gamma @ self.late_coils, None
        self.motion.append(abs(self._state[0] - self._push_state) + REACH * abs(self._state[1]))
        sensed = super().play(drive)
        if not late:
            return sensed
        if self.held is None:
            self.held = sensed.sensed.copy()
        return sensed._replace(sensed=self.change(self, sensed.sensed))

    @property
    def _push_state(self):
        return np.linalg.solve(np.eye(4) - self._phi, self._push)[0]


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
    "coils inverted": (lambda plate, sensed: sensed, -np.eye(2)),
    "one coil inverted": (lambda plate, sensed: sensed, INVERTED),
    "one coil dead": (lambda plate, sensed: sensed, np.diag([0.0, 1.0])),
}


def run(fault, frequency, amplitude, touched):
    """Time from fault to stop (s, NaN: none), largest drive (A) and motion (m) after the fault, and the message."""
    plate = FaultyPlate(*FAULTS[fault], **(FINGER if touched else {}))
    scene = hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=amplitude), duration=DURATION)
    stopped, message = np.nan, ""
    try:
        hr.render(scene, driver=plate)
    except hr.DeviceFault as error:
        stopped, message = error.time - START, str(error)
    first = round(START * plate.rate)
    drive = np.concatenate(plate.played)[first:]
    return stopped, abs(drive).max(), max(plate.motion[first:]), message


class Exchanged(StrangersPlate):
    """A plate whose sensors are exchanged from `START` on."""

    played = 0

    def play(self, drive):
        sensed = super().play(drive)
        self.played += len(drive)
        return sensed._replace(sensed=sensed.sensed[:, ::-1].copy()) if self.played > START * self.rate else sensed


def exchanged():
    """Print time and largest motion of an end for each frequency, place and load of the finger."""
    for frequency, place, load in product((72.0, 189.0, 400.0), (0.0, 27.5e-3, 50e-3), (0.8, 2.0)):
        touch = {"finger": (4e-3, 1.5, 300.0), "contact": lambda t: np.clip((t - 0.1) / 1e-3, 0.0, 1.0)}
        plate = Exchanged(position=place, load=load, report_lag=5e-3, seed=2, **touch)
        outcome = "no stop"
        try:
            hr.render(hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=50e-6), duration=3.0), driver=plate)
        except hr.DeviceFault as error:
            outcome = f"{1e3 * (error.time - START):.0f} ms"
        ends, first = np.asarray(plate.truth)[:, 1:3], round(START * plate.rate)
        largest = abs(ends[first:] - ends[first - 1000 : first].mean(axis=0)).max()
        print(f"{frequency:g} Hz, {load} N at {1e3 * place:g} mm: {outcome}, {1e6 * largest:.0f} um", flush=True)


def main(names):
    if names == ["exchanged"]:
        exchanged()
        return
    for fault in names or FAULTS:
        for frequency in (20.0, 72.0, 189.0, 400.0):
            runs = [run(fault, frequency, a, touched) for a in (10e-6, 50e-6) for touched in (False, True)]
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
    main(sys.argv[1:])
