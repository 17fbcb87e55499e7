"""Two fingers on a plate: false alarms, detections, and the error with the law slowed, not slowed and without feedback.

Run: python -m benchmarks.two_touches [false | two]; on plates that share no code with the library, at 5 kHz.
"""

from __future__ import annotations

import sys
import warnings
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.signal import firwin, lfilter

import hapticrender as hr
from hapticrender.analysis.two_touches import TouchWatch, windows_under_touch
from hapticrender.loop import prepare, run
from hapticrender.protocols import Array
from tests.strangers_plate import WRONG, StrangersPlate
from tests.test_two_touches import HEAVY, LIGHT, TwoFingers

RATE = 5000.0
SECOND, LIFT, END = 1.4, 3.0, 4.0  # s: the second finger comes, both leave, the scene ends
PAIRS = {
    "heavy, -20 and 20 mm": ((HEAVY, -20e-3, 0.8, 0.6, LIFT), (HEAVY, 20e-3, 0.8, SECOND, LIFT)),
    "heavy -10, light 40 mm": ((HEAVY, -10e-3, 0.8, 0.6, LIFT), (LIGHT, 40e-3, 0.3, SECOND, LIFT)),
    "light 0, heavy 45 mm": ((LIGHT, 0.0, 0.3, 0.6, LIFT), (HEAVY, 45e-3, 1.0, SECOND, LIFT)),
}
ONE = {  # finger, load (N), peak speed (m/s), further arguments of the plate
    "heavy, 80 mm/s": (HEAVY, 0.8, 0.08, {}),
    "heavy, 160 mm/s, plate wrong": (HEAVY, 0.8, 0.16, {**WRONG, "told": 2}),
    "light, 0.2 N, 50 mm/s": (LIGHT, 0.2, 0.05, {}),
    "heavy, 80 mm/s, bending glass": (HEAVY, 0.8, 0.08, {"bending": (1250.0, 50.0, -0.1)}),
}


def textures() -> dict[str, Any]:
    """White noise of 20-400 Hz, 5 um rms; a tone."""
    samples = lfilter(firwin(401, [20, 400], pass_zero=False, fs=RATE), 1, np.random.default_rng(0).normal(size=26_000))
    return {
        "noise": hr.Recorded(samples=samples[401:], rate=RATE, amplitude=5e-6),
        "120 Hz": hr.Grating(frequency=120.0, amplitude=5e-6),
    }


def one_finger() -> None:
    """Print, of single sliding fingers, how near to the bound the statistic comes."""
    for name, (finger, load, speed, wrong) in ONE.items():
        for texture, played in textures().items():
            plate = StrangersPlate(
                finger=finger, load=load, report_lag=5e-3, **wrong, contact=lambda t: 1.0 * ((t > 1.0) & (t < 4.5)),
                position=lambda t, speed=speed: speed / 4.0 * np.sin(4.0 * t),
            )  # fmt: skip
            rendering = prepare(
                hr.Scene(texture=played, finger=hr.Finger.sliding(0.08, load), duration=5.0), driver=plate
            )
            found = [each for _, each in windows_under_touch(run(rendering), rendering.model)]
            ratio = np.array([each.statistic / each.bound for each in found])
            place = 1e3 * np.sqrt(np.mean([each.offset**2 for each in found]))
            print(f"{name}, {texture}: {len(found)} windows, {sum(each.two for each in found)} false alarms, "
                  f"most {ratio.max():.2f} of the bound, place {place:.2f} mm rms", flush=True)  # fmt: skip


def two_fingers() -> None:
    """Print errors over the plate (centre and ends, rms) with two fingers and after they have left."""
    for name, pair in PAIRS.items():
        for texture, played in textures().items():
            for how in ("slowed", "not slowed", "no feedback"):
                plate = TwoFingers(*pair, senses=how != "no feedback")
                scene = hr.Scene(texture=played, finger=hr.Finger.still(pair[0][1], pair[0][2]), duration=END)
                keep = TouchWatch.slow if how == "slowed" else lambda *_: None
                with patch.object(TouchWatch, "slow", keep):
                    recording = hr.render(scene, driver=plate)
                reference = played.waveform(np.arange(len(recording)) / RATE, np.zeros(len(recording)))
                flagged = np.flatnonzero(recording.flags & hr.Flag.TWO_TOUCHES) / RATE
                two, free = (100 * plate.error(reference, *span) for span in ((2.0, LIFT), (LIFT + 0.3, END)))
                late = f"flagged after {flagged[0] - SECOND:.2f} s" if len(flagged) else "not flagged"
                print(
                    f"{name}, {texture}, {how}: {_rms(two):.1f} % with two, {_rms(free):.1f} % after; {late}",
                    flush=True,
                )


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


if __name__ == "__main__":
    warnings.simplefilter("ignore", hr.PlateMismatch)
    parts = {"false": one_finger, "two": two_fingers}
    for part in sys.argv[1:] or parts:
        parts[part]()
