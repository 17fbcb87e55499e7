"""What the least model saves, at equal verdict, in this thread's own time: ``python benchmarks/least_model.py``."""

import time
from dataclasses import replace

import numpy as np
from pairing import interleave, keep_to_one_core

import hapticrender as hr
from hapticrender.fidelity.choice import LADDERS, fidelity
from hapticrender.touch.builtin import builtin_scenes
from hapticrender.wording import percent, table

PIECE = 2.0  # s of signal a run
PAIRS = 15
LIGHT = {"mechanics": "light", "normal_load": 0.3}


def scenes():
    """The built-in ones, electroadhesion on its carrier, and some that need little."""
    known = {name: scene for name, scene in builtin_scenes().items() if scene.device in LADDERS}
    for name, scene in known.items():
        if scene.device == "electroadhesion":
            known[name] = replace(scene, plant={"level": "carrier"})
    swiping = hr.Finger.swiping(frequency=0.5, stroke=0.01, **LIGHT)
    slow = replace(known["grating-20"], finger=hr.Finger.still(0.0, **LIGHT), tolerance=0.1)
    fast = hr.Scene(texture=hr.Grating(amplitude=1e-5, frequency=400.0), finger=swiping, duration=5.0)
    ridges = hr.Grating(velocity=8e-3, frequency=20.0)
    own = [
        replace(slow, name="light-still-20"),
        replace(fast, name="light-swiping-400"),
        replace(fast, name="light-swiping-400-rough", tolerance=0.5),
        replace(known["one-texture-electroadhesion"], name="screen-rough", tolerance=0.1),
        replace(known["one-texture-ultrasonic"], name="ultrasonic-20", texture=ridges, tolerance=0.1),
        replace(known["ultrasonic-swiping"], name="ultrasonic-swiping-rough", tolerance=0.5),
    ]
    return [*known.values(), *own]


def loop(scene):
    """Device and controller in their compiled loop for another piece of time, the finger down, as a function."""
    session = hr.prepare(replace(scene, finger=replace(scene.finger, touches=None)))
    plant, controller = session.driver.plant, session.controller()
    wanted = np.zeros(int(PIECE * plant.rate))
    return lambda: plant.closed_loop(controller, wanted)


def verdict(scene):
    """Whether a scene stays inside its tolerance, and its worst figure."""
    summary = hr.render(scene).summary()
    return f"{'within' if summary['passed'] else 'misses'}, {percent(summary['worst']['value'])}"


def row(scene):
    """One line of the table."""
    start = time.thread_time()
    found = fidelity(scene)
    spent = time.thread_time() - start
    left = ", ".join(f"{choice.option} {choice.value}" for choice in found.taken) or "nothing"
    head = [scene.name, f"{1e3 * spent:.0f} ms", percent(found.bound), verdict(scene)]
    if not found.taken:
        return [*head, "the same", "1", "", left]
    saved = interleave(loop(found.least), loop(scene), PAIRS, time.thread_time)
    return [*head, verdict(found.least), f"{saved.ratio:.2f}", f"{saved.low:.2f} to {saved.high:.2f}", left]


def main():
    keep_to_one_core()
    fidelity(scenes()[0])
    verdicts, times = ["bound", "full model", "least model"], ["full / least time", "half of the pairs"]
    print(table([["scene", "to choose", *verdicts, *times, "left out"], *map(row, scenes())]))


if __name__ == "__main__":
    main()
