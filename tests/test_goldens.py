"""What must not change: every recorded case keeps its figures, its flags, and, where the arithmetic is the same, drive.

The rules, on what ``goldens/record.py`` has stored:

* default method: an error is at most 1.1 times the stored one and a floor;
* baselines: an error stays within 10 % and the floor, both ways, where they work, within 25 % where they fail (worst
  error of 10 % and more), and they still fail there;
* floor: 2 standard deviations of the figure over seeds of the sensor noise, but at most a thousandth of the target, a
  hundredth of what can be felt;
* target: within 1 %;
* flags: the same bits, each for the first time within 5 ms;
* drive within 1e-6 of its peak, where the arithmetic is the same.
"""

import json

import numpy as np
import pytest
from goldens import figures as judge
from goldens.cases import CASES, DEFAULT_METHOD
from goldens.play import play
from goldens.record import ARRAYS, FIGURES

STORED = json.loads(FIGURES.read_text(encoding="utf-8"))
with np.load(ARRAYS) as stored:
    DRIVES = {name.removesuffix("/drive"): values for name, values in stored.items() if name.endswith("/drive")}
ERRORS = ("worst", "rms", "peak", "complex")
BOUNDED = (*ERRORS, "wobble", "residual", "drive_rms", "drive_peak")  # must not grow with the default method
MORE, OFF, OFF_FAILING, OFF_TARGET = 0.1, 0.1, 0.25, 0.01  # share of the stored figure
DEVIATIONS, FLOOR = 2.0, 1e-3  # of a figure over the seeds; of the target
LATER = 5e-3  # s
# Where a drive is rounded to the steps of a converter, the last bit of a sum decides a step, and the loop never comes
# back to the same rounding: such cases repeat on one build only.
ROUNDED = {"plate-comb", "plate-wrong"}
CHANGED = {  # contact raises the gains a sample earlier, the law takes the finger of that sample, h watches the error
    "electroadhesion-impedance",
    "electroadhesion-slide",
    "h-touch-lift",
    "hybrid-slide",
    "plate-frozen-sensor",
    "plate-nan-sensor",
    "plate-one-coil",
    "plate-press",
    "plate-reversal",
    "plate-saturation",
    "plate-slide",
    "plate-sweep",
    "plate-touch-lift",
    "plate-waveform",
    "ultrasonic-touch",
}
SAME_ARITHMETIC = set(CASES) - ROUNDED - CHANGED


def found_of(case, run):
    return {"figures": judge.figures(run, case.window, case.settle), "flags": judge.flags(run)}


def stored_of(name):
    return STORED["cases"][name] | {"window": CASES[name].window}


def complaints(found, stored):
    """Sentences about what has become worse, or different, than it was; none where all is kept."""
    figures = complaints_of_default if stored["method"] == DEFAULT_METHOD else complaints_of_baseline
    return [
        *complaints_of_target(found["figures"]["target"], stored["figures"]["target"]),
        *figures(found["figures"], stored),
        *complaints_of_flags(found["flags"], stored["flags"]),
    ]


def floor_of(key, stored):
    """What noise alone may add to a figure, in its unit."""
    in_unit = {"wobble": "target", "residual": "target", "drive_rms": "drive_rms", "drive_peak": "drive_peak"}
    return min(DEVIATIONS * stored["spread"][key], FLOOR * (stored["figures"][in_unit[key]] if key in in_unit else 1.0))


def complaints_of_target(target, stored):
    if target is None or abs(target - stored) > OFF_TARGET * stored:
        yield f"target = {target}: must be {stored} within {OFF_TARGET:.0%}"


def complaints_of_default(figures, stored):
    for key in BOUNDED:
        value, most = figures[key], (1 + MORE) * stored["figures"][key] + floor_of(key, stored)
        if value is None or value > most:
            yield f"{key} = {value}: must be <= {most}"
    settled, before = figures["settled"], stored["figures"]["settled"]
    if before is not None and (settled is None or settled > before + 1.5 * stored["window"]):
        yield f"settled = {settled} s: must be <= {before} s and a window"


def complaints_of_baseline(figures, stored):
    before = stored["figures"]
    fails = before["worst"] >= judge.FAILS
    if (figures["worst"] >= judge.FAILS) != fails:
        yield f"worst = {figures['worst']}: must {'fail' if fails else 'work'} as {before['worst']} did"
    for key in ERRORS:
        room = (OFF_FAILING if fails else OFF) * before[key] + floor_of(key, stored)
        if not abs(figures[key] - before[key]) <= room:
            yield f"{key} = {figures[key]}: must be {before[key]} within {room}"


def complaints_of_flags(found, stored):
    if found.keys() != stored.keys():
        yield f"flags {sorted(found)}: must be {sorted(stored)}"
    for name in found.keys() & stored.keys():
        if abs(found[name]["first"] - stored[name]["first"]) > LATER:
            yield f"{name} first at {found[name]['first']} s: must be at {stored[name]['first']} s within {LATER} s"


def test_the_cases_are_the_stored_ones():
    assert set(STORED["cases"]) == set(CASES)
    assert set(DRIVES) == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_figures_flags_and_drive_are_kept(name):
    """The drive within 1e-6 of its peak, at the start, in the middle and at the end of a run."""
    run = play(CASES[name])
    assert complaints(found_of(CASES[name], run), stored_of(name)) == []
    if name in SAME_ARITHMETIC:
        np.testing.assert_allclose(judge.drive_of(run), DRIVES[name], rtol=0, atol=1e-6 * abs(DRIVES[name]).max())
