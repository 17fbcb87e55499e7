"""A grating of 1 mm under a finger that swipes to and fro: the finger's speed makes the frequency.

The figure is the number of ridges that pass under the finger in one stroke, counted in the motion of the plate.
"""

import numpy as np

import hapticrender as hr

WAVELENGTH = 1e-3  # m
STROKE = 0.03  # m


def main() -> float:
    scene = hr.Scene(
        texture=hr.Grating(wavelength=WAVELENGTH, amplitude=10e-6),
        finger=hr.Finger.sliding(speed=0.08, span=STROKE),
        duration=3.0,
    )
    recording = hr.render(scene)
    (turns,) = np.nonzero(np.diff(np.sign(np.diff(recording.position))))  # where the finger reverses
    stroke = slice(turns[-2], turns[-1])
    motion = recording.motion[stroke, 0]
    crossings = np.count_nonzero(np.diff(np.signbit(motion)))
    print(f"{STROKE * 1e3:.0f} mm in {(turns[-1] - turns[-2]) / recording.rate:.3f} s")
    return crossings / 2


if __name__ == "__main__":
    print(main())
