"""A device of your own, with nothing inherited and nothing registered: a plate on two coils, a sensor at each end.

The figure is the amplitude (m) that the loop makes it move with.
"""

import numpy as np
from scipy.linalg import expm

import hapticrender as hr


class MyPlate:
    """Five numbers, a with statement and `play`: all that a driver is; not quite the plate of the design."""

    rate, block, delay = 5000.0, 1, 1  # Hz, samples, samples
    drive_channels, sensed_channels = 2, 2

    def __init__(self) -> None:
        mass = np.array([[0.032], [4e-5 / 0.0275**2]])  # kg: heave and rocking, seen at the coils
        stiffness = np.array([[45.3e3, 0.5e3], [0.5e3, 45.3e3]])  # N/m
        damping = np.array([[1.7, 0.0], [0.0, 1.7]])  # N s/m
        coils = 7.4 * np.array([[1.0, 1.0], [-1.0, 1.0]])  # N/A
        generator = np.zeros((6, 6))
        generator[:2, 2:4] = np.eye(2)
        generator[2:4] = np.hstack([-stiffness, -damping, coils]) / mass
        self.advance = expm(generator / self.rate)  # exact while the drive is held
        self.state = np.zeros(6)  # heave, rocking, their rates, the two currents

    def __enter__(self) -> "MyPlate":
        return self

    def __exit__(self, *exc: object) -> None:
        self.play(np.zeros((1, 2)))  # a driver leaves its device at rest

    def play(self, drive: np.ndarray) -> hr.Sensed:
        """Sense at the start of the interval, then hold the drive until its end."""
        heave, rocking = self.state[:2]
        sensed = [heave - 2 * rocking, heave + 2 * rocking]  # glass ends lie twice as far out as the coils
        self.state[4:] = drive[0]
        self.state = self.advance @ self.state
        return hr.Sensed(np.array([sensed]))


def main() -> float:
    scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=10e-6), duration=2.0)
    recording = hr.render(scene, driver=MyPlate())
    (band,) = recording.summary()["bands"]
    print(f"target {1e6 * band['target']:.2f} um, moved {1e6 * band['achieved']:.2f} um")
    return band["achieved"]


if __name__ == "__main__":
    print(main())
