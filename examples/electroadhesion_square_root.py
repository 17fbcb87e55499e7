"""A grating on an electroadhesion screen with and without the square root; name a file to keep a picture of it.

The figure is the share of the second harmonic in the friction that the square root takes away: a quarter.
"""

import sys

import numpy as np

import hapticrender as hr
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen

FREQUENCY, FORCE, SPEED = 100.0, 0.1, 0.05  # Hz, N of friction, m/s
FINGER = hr.Finger.sliding(speed=SPEED, normal_load=1.0)
SCREEN = ElectroadhesionParameters()


class OpenLoop(SimulatedDriver):
    """A screen whose force sensor shows nothing."""

    def _play(self, drive: np.ndarray) -> hr.Sensed:
        return super()._play(drive)._replace(sensed=np.zeros((len(drive), 0)))


def friction(square_root: str) -> np.ndarray:
    """Last 0.1 s of the friction (N)."""
    grating = hr.Grating(frequency=FREQUENCY, amplitude=0.64 * FORCE / (2 * np.pi * FREQUENCY))
    drive = {"square_root": square_root, "headroom": 1.0, "floor": 0.0}  # at full swing: the envelope touches zero
    scene = hr.Scene(texture=grating, finger=FINGER, device="electroadhesion", duration=0.3, rendering=drive)
    driver = OpenLoop(ElectroadhesionScreen(SCREEN, FINGER))
    driver.sensed_channels = 0
    return hr.render(scene, driver=driver).motion[-1000:, 0]


def second_harmonic(force: np.ndarray) -> float:
    """Share of the second harmonic, the lag of the friction behind the attraction undone."""
    lag = SCREEN.lag_response(np.array([1.0, 2.0]) * FREQUENCY, SPEED)
    first, second = abs(np.fft.rfft(force))[[10, 20]] / abs(lag)
    return float(second / first)


def main() -> float:
    forces = {setting: friction(setting) for setting in ("off", "on")}
    shares = {setting: second_harmonic(force) for setting, force in forces.items()}
    print("second harmonic: {off:.3%} without the square root, {on:.3%} with it".format(**shares))
    if len(sys.argv) > 1:
        from matplotlib import pyplot as plt

        for setting, force in forces.items():
            plt.plot(np.arange(400) / 10, force[:400], label=f"square root {setting}, {100 * shares[setting]:.1f} %")
        plt.gca().set(xlabel="time (ms)", ylabel="friction (N)", ylim=(0.78, 1.06))
        plt.legend(title="second harmonic", ncols=2, loc="upper center")
        plt.savefig(sys.argv[1])
    return shares["off"] - shares["on"]


if __name__ == "__main__":
    print(main())
