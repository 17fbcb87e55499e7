"""Inject faults of sensors and coils into a plate that the library does not know, while a texture plays.

Run: python -m benchmarks.faults [--plate other] [--place MM | --slides] [--tones] [--card | --blocks] [fault ...]

The plate is that of ``tests/strangers_plate.py`` with mass, springs, damping and sensor gains off by 2 to 20 %, a
bending mode at 1250 Hz, contact reported 5 ms late, and a delay of 2 samples, which is stated; ``--plate other`` takes
that of ``tests/other_plate.py``, whose parameters are what the library takes for granted; with ``--card`` the
stranger's plate takes blocks of 64 at 48 kHz, as behind a sound card, and is one sample later than stated; with
``--blocks`` it takes blocks of 25 at 5 kHz, and is one sample later than stated, too.
Printed for every fault, over 10 and 50 um, without and with a heavy finger of 0.8 N on the middle, or `--place` (mm)
off it, then with 0.8 and 2 N (with `--slides`, on the stranger's plate, it rests on the middle until 0.4 s after the
fault, then slides to 45 mm at 80 mm/s): the time from the fault to the stop, how many runs stopped, the largest
drive and the largest true motion of an end.  Textures are a tone of 20, 72, 189 or 400 Hz; with ``--tones`` one of 60
and 144 Hz.
"""

import argparse
from itertools import product

import numpy as np

import hapticrender as hr
from hapticrender.touch.mechanics import HEAVY_SECOND
from tests.other_plate import REACH, OtherPlate
from tests.strangers_plate import WRONG, StrangersPlate

START, DURATION, BEFORE = 0.6, 1.6, 0.2  # s: the fault, the end of a run that is not stopped, the rest before the fault
FINGER = HEAVY_SECOND.mass, HEAVY_SECOND.damping, HEAVY_SECOND.stiffness
INVERTED, SWAPPED = np.diag([-1.0, 1.0]), np.eye(2)[::-1]
FREQUENCIES = (20.0, 72.0, 189.0, 400.0)  # Hz
TONES = {"frequency": 60.0, "partials": ((1.0, 1.0, 0.0), (2.4, 0.4, 1.0))}


class FaultyPlate:
    """Sensors or coils that change at `START`; `change(plate, sensed)` returns what is sensed from then on."""

    probe = False

    def __init__(self, change, coils, **plate):
        super().__init__(seed=3, **plate)
        self.change, self.coils, self.drives, self.held = change, coils, [], None

    def play(self, drive):
        late = self.block * len(self.drives) >= START * self.rate
        self.drives.append(drive)
        sensed = super().play(drive @ self.coils.T if late else drive)
        if not late:
            return sensed
        if self.held is None:
            self.held = sensed.sensed.copy()
        return sensed._replace(sensed=self.change(self, sensed.sensed))


class FaultyOtherPlate(FaultyPlate, OtherPlate):
    """The plate whose parameters the library takes for granted."""

    def __init__(self, change, coils, load, place):
        super().__init__(change, coils, **({"finger": FINGER, "load": load, "position": place} if load else {}))
        self.ends = []  # displacement of both (m) at every sample

    def play(self, drive):
        self.ends.append(self._state[0] + REACH * self._state[1] * np.array([-1.0, 1.0]))
        return super().play(drive)


class FaultyWrongPlate(FaultyPlate, StrangersPlate):
    """A plate that is wrong in everything but the delay, which is stated."""

    def __init__(self, change, coils, load, place, **changes):
        touch = {"finger": FINGER, "load": load, "position": place} if load else {}
        contact = (lambda time: np.clip((time - 0.1) / 1e-3, 0.0, 1.0)) if load else 0.0
        plate = WRONG | {"contact": contact, "bending": (1250.0, 30.0, 0.1), "report_lag": 5e-3, "told": WRONG["delay"]}
        super().__init__(change, coils, **plate | touch | changes)

    @property
    def ends(self):
        """Displacement of both (m) at every sample."""
        return self.truth[:, 1:3]


def off_the_middle(time):
    """Position (m) of a finger that slides from the middle to 45 mm, 0.4 s after the fault."""
    return np.clip(0.08 * (time - START - 0.4), 0.0, 0.045)


def only_first(change):
    """Apply a change to the first sensor alone."""
    return lambda plate, sensed: np.column_stack([change(plate, sensed)[:, 0], sensed[:, 1]])


def every_second(plate, sensed):
    """Samples of which every second one is no number."""
    odd = (plate.block * len(plate.drives) + np.arange(len(sensed))) % 2 == 1
    return np.where(odd[:, None], sensed, np.nan)


def noise(plate, sensed):
    """Sensors that show nothing but noise."""
    return 1e-6 * plate._rng.standard_normal(sensed.shape)


FAULTS = {
    "none": (lambda plate, sensed: sensed, np.eye(2)),
    "frozen, both": (lambda plate, sensed: 0 * sensed + plate.held[0], np.eye(2)),
    "frozen, one": (only_first(lambda plate, sensed: 0 * sensed + plate.held[0]), np.eye(2)),
    "buffer repeats, both": (lambda plate, sensed: plate.held, np.eye(2)),  # as frozen where a block is a sample
    "buffer repeats, one": (only_first(lambda plate, sensed: plate.held), np.eye(2)),
    "dead, both": (lambda plate, sensed: 0 * sensed, np.eye(2)),
    "dead, one": (only_first(lambda plate, sensed: 0 * sensed), np.eye(2)),
    "at its range, both": (lambda plate, sensed: 0 * sensed + 1e-3, np.eye(2)),
    "NaN, both": (lambda plate, sensed: np.nan * sensed, np.eye(2)),
    "every second NaN": (every_second, np.eye(2)),
    "dead but noisy, both": (noise, np.eye(2)),
    "dead but noisy, one": (only_first(noise), np.eye(2)),
    "inverted, both": (lambda plate, sensed: -sensed, np.eye(2)),
    "inverted, one": (lambda plate, sensed: sensed @ INVERTED, np.eye(2)),
    "swapped": (lambda plate, sensed: sensed @ SWAPPED, np.eye(2)),
    "gain x3": (lambda plate, sensed: 3 * sensed, np.eye(2)),
    "one gain x3": (only_first(lambda plate, sensed: 3 * sensed), np.eye(2)),
    "gain x10": (lambda plate, sensed: 10 * sensed, np.eye(2)),
    "gain x0.1": (lambda plate, sensed: 0.1 * sensed, np.eye(2)),
    "gain x1000": (lambda plate, sensed: 1000 * sensed, np.eye(2)),
    "one gain x0.5": (lambda plate, sensed: sensed * (0.5, 1.0), np.eye(2)),
    "coils swapped": (lambda plate, sensed: sensed, SWAPPED),
    "coils inverted": (lambda plate, sensed: sensed, -np.eye(2)),
    "one coil inverted": (lambda plate, sensed: sensed, INVERTED),
    "one coil dead": (lambda plate, sensed: sensed, np.diag([0.0, 1.0])),
}
PLATES = {"other": FaultyOtherPlate, "wrong": FaultyWrongPlate}
CARD, BLOCKS = {"rate": 48e3, "block": 64, "told": 64}, {"block": 25, "told": 25}


def run(plate, texture):
    """Time from fault to stop (s, NaN: none), largest drive (A) and motion (m) after the fault, and the message."""
    stopped, message = np.nan, ""
    try:
        hr.render(hr.Scene(texture=texture, duration=DURATION), driver=plate)
    except hr.DeviceFault as error:
        stopped, message = error.time - START, str(error)
    first, rest = round(START * plate.rate), round(BEFORE * plate.rate)
    drive, motion = np.concatenate(plate.drives), np.array(plate.ends)
    if len(drive) <= first:
        raise SystemExit(f"stopped before the fault: {message}")
    largest = abs(motion[first:] - motion[first - rest : first].mean(axis=0)).max()
    return stopped, abs(drive[first:]).max(), largest, message


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("faults", nargs="*", metavar="fault", help=f"of {', '.join(FAULTS)}; all unless given")
    parser.add_argument("--plate", choices=PLATES, default="wrong", help="which plate")
    parser.add_argument("--tones", action="store_true", help="two tones at once, instead of one")
    ways = parser.add_mutually_exclusive_group()
    ways.add_argument("--card", action="store_true", help="48 kHz, in blocks of 64, on the stranger's plate")
    ways.add_argument("--blocks", action="store_true", help="5 kHz, in blocks of 25, on the stranger's plate")
    places = parser.add_mutually_exclusive_group()
    places.add_argument("--place", type=float, default=0.0, help="of the finger (mm)")
    places.add_argument("--slides", action="store_true", help="it slides off the middle, on the stranger's plate")
    arguments = parser.parse_args()
    if unknown := set(arguments.faults) - set(FAULTS):
        parser.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(FAULTS)}")
    if abs(arguments.place) > 1e3 * REACH:
        parser.error(f"--place {arguments.place:g} mm: must be within {1e3 * REACH:g}, the ends of the plate")
    loads = (0.8, 2.0) if arguments.place or arguments.slides else (0.0, 0.8)
    place = off_the_middle if arguments.slides else 1e-3 * arguments.place
    changes = CARD if arguments.card else BLOCKS if arguments.blocks else {}
    textures = [TONES] if arguments.tones else [{"frequency": each} for each in FREQUENCIES]
    for fault, texture in product(arguments.faults or FAULTS, textures):
        runs = [
            run(
                PLATES[arguments.plate](*FAULTS[fault], load, place, **changes),
                hr.Grating(amplitude=a, **texture),
            )
            for a, load in product((10e-6, 50e-6), loads)
        ]
        times = np.array([each[0] for each in runs])
        count, latest = int(np.isfinite(times).sum()), np.nanmax(times) if np.isfinite(times).any() else np.nan
        drive, motion = max(each[1] for each in runs), max(each[2] for each in runs)
        causes = sorted({each[3].split(": ")[2][:40] if each[3] else "no stop" for each in runs})
        print(
            f"{fault:22} {texture['frequency']:4g} Hz: {1e3 * latest:6.1f} ms ({count} of 4), {drive:.2f} A, "
            f"{1e6 * motion:5.0f} um; {'; '.join(causes)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
