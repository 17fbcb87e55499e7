"""A device of your own: one moving mass on a spring, with nothing inherited and nothing registered.

The figure is the amplitude (m) that the loop makes it move with.
"""

import numpy as np
from scipy.linalg import expm

import hapticrender as hr

COILS = 7.4  # N/A, each of two
MASS, DAMPING, STIFFNESS = 0.034, 2.0, 46e3  # kg, N s/m, N/m: not quite the plate that the controller is designed for


class Shaker:
    """Five numbers, a with statement and `play`: all that a driver is; `probe` is for a plate that is none."""

    rate, block, delay = 5000.0, 1, 1  # Hz, samples, samples
    drive_channels, sensed_channels = 2, 2
    probe = False  # it cannot rock, so the start-up probe would refuse it as a plate

    def __init__(self) -> None:
        spring = np.array([[0, 1, 0], [-STIFFNESS / MASS, -DAMPING / MASS, 1 / MASS], [0, 0, 0]])
        self.advance = expm(spring / self.rate)  # exact while the force is held
        self.state = np.zeros(3)  # m, m/s, N

    def __enter__(self) -> "Shaker":
        return self

    def __exit__(self, *exc: object) -> None:
        self.play(np.zeros((1, 2)))  # a driver leaves its device at rest

    def play(self, drive: np.ndarray) -> hr.Sensed:
        """Sense at the start of the interval, then hold the force until its end."""
        sensed = np.full((1, 2), self.state[0])  # both sensors see the same
        self.state[2] = COILS * drive.sum()
        self.state = self.advance @ self.state
        return hr.Sensed(sensed)


def main() -> float:
    scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=10e-6), duration=3.0)
    recording = hr.render(scene, driver=Shaker())
    (band,) = recording.summary()["bands"]
    print(f"target {1e6 * band['target']:.2f} um, moved {1e6 * band['achieved']:.2f} um")
    return band["achieved"]


if __name__ == "__main__":
    print(main())
