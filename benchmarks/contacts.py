"""Measure the error of a texture around presses, and around touches that take as long as a finger's.

Run: python -m benchmarks.contacts [seeds]

The accuracy suite touches in 1 ms and lifts in one sample; here a finger touches and lifts within 10 or 30 ms, or
stays and presses harder and less.  The plate is `tests/strangers_plate.py`, which shares no code with the library,
behind the public driver protocol; white noise (20 to 400 Hz, 5 um rms) or a tone of 178 Hz (50 um), in the middle and
20 mm off.  Printed is the waveform's error (20 to 500 Hz, no shift or gain fitted), rms over places and seeds, under
the finger / at the worse end, for the 100 ms from an event on, and for the 200 ms after.
"""

import sys
from itertools import product

import numpy as np

from hapticrender.accuracy.plate import HEAVY, RIGID, Bench, Still, rms, white, worse
from hapticrender.formatting import table
from hapticrender.touch.finger import Finger
from tests.strangers_plate import plate

FIRST, SECOND, END = 1.5, 2.3, 3.0  # s: events, and the end
CASES = {  # load (N) before, between and after the events, and how long these take (s)
    "touch and lift, 1 ms": (0.0, 0.8, 0.0, 1e-3),
    "touch and lift, 10 ms": (0.0, 0.8, 0.0, 10e-3),
    "touch and lift, 30 ms": (0.0, 0.8, 0.0, 30e-3),
    "0.5, 2, 0.5 N, 1 ms": (0.5, 2.0, 0.5, 1e-3),
    "0.8, 4, 0.8 N, 20 ms": (0.8, 4.0, 0.8, 20e-3),
}
WINDOWS = ((FIRST, 0.0, 0.1), (FIRST, 0.1, 0.3), (SECOND, 0.0, 0.1), (SECOND, 0.1, 0.3))


def finger(case, place):
    """Finger at a place (m); it is there while it presses."""
    before, between, after, long = case
    times, loads = (0.0, FIRST, FIRST + long, SECOND, SECOND + long), (before, before, between, between, after)
    pressing = ((0.1, END),) if before else ((FIRST, SECOND + long),)
    return Finger(Still(place), (times, loads), pressing, HEAVY)


def errors(case, noise, place, seed):
    """Errors of one run (windows, 2)."""
    bench = Bench(method="inverse", make=plate, seed=seed).of(**RIGID)
    run = bench.play(white(seed) if noise else bench.tone(178.0), END, finger(case, place))
    reference, error = run.in_band()
    judged = [(run.time >= at + start) & (run.time < at + stop) for at, start, stop in WINDOWS]
    return [worse(rms(error[each]) / rms(reference[each])) for each in judged]


def main(seeds="3"):
    """Print the table."""
    rows = [["contact", "texture", "first event", "after it", "second", "after it, %"]]
    for (name, case), noise in product(CASES.items(), (True, False)):
        runs = [errors(case, noise, place, 1 + seed) for place in (0.0, 20e-3) for seed in range(int(seeds))]
        found = 100 * rms(np.array(runs))
        rows.append([name, "white noise" if noise else "178 Hz", *(f"{here:.3g} / {end:.3g}" for here, end in found)])
    print(table(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
