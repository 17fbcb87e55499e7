"""A vibration of 47 Hz and 10 um: the plate moves as the texture states.

The figure is the amplitude (m) in the middle of the plate once the loop has settled.
"""

import hapticrender as hr


def main() -> float:
    scene = hr.Scene(texture=hr.Grating(frequency=47.0, amplitude=10e-6), duration=5.0)
    recording = hr.render(scene)
    (band,) = recording.summary()["bands"]
    print(f"target {1e6 * band['target']:.3f} um, moved {1e6 * band['achieved']:.3f} um")
    return band["achieved"]


if __name__ == "__main__":
    print(main())
