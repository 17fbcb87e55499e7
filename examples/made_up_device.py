"""A new kind of device takes a plant and a renderer: here a shaker, a mass on a spring that one coil moves.

Everything else is the library's: targets, control, judgement, pictures.
The figure is the rms error of the amplitude (1) under a finger that touches and leaves.
"""

import numpy as np
from scipy.linalg import expm

import hapticrender as hr
from hapticrender.control.device_model import DeviceModel
from hapticrender.renderers.base import BaseRenderer
from hapticrender.renderers.limits import check_carriers, check_targets, perceptible

MASS, DAMPING, STIFFNESS, FORCE, RATE, NOISE = 0.05, 2.0, 20e3, 5.0, 5000.0, 1e-6  # kg N s/m N/m N/A Hz m


class Shaker:
    """The plant: behind the same five numbers and `run` as every device."""

    rate, block, delay, drive_channels, sensed_channels = RATE, 1, 1, 1, 1

    def __init__(self, finger, seed):
        self.finger, self.rng = finger, np.random.default_rng(seed)
        self.samples, self.state, self.steps = 0, np.zeros(2), {}

    def step(self, skin):
        """Return one sample's exact propagator, with the mass, damping and stiffness of a finger."""
        if skin not in self.steps:
            mass, damping, stiffness = np.add((MASS, DAMPING, STIFFNESS), skin)
            system = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, FORCE / mass], [0, 0, 0]])
            self.steps[skin] = expm(system / RATE)[:2]
        return self.steps[skin]

    def run(self, drive):
        n, skin, motion = len(drive), self.finger.mechanics, np.empty((len(drive), 1))
        position, load, strength = self.finger.touch((self.samples + np.arange(n)) / RATE).T
        for i in range(n):
            motion[i] = self.state[0]
            step = self.step(tuple(strength[i] * np.array([skin.mass, skin.damping, skin.stiffness])))
            self.state = step @ [*self.state, drive[i, 0]]
        self.samples += n
        return hr.Sensed(motion + NOISE * self.rng.standard_normal((n, 1)), position, motion, load)

    def closes(self, controller):
        return False  # it has no compiled loop of its own


class ShakerRenderer(BaseRenderer):
    """The renderer: a table of what the device is, and what it refuses."""

    name, needs = "shaker", "a coil (A) and a displacement sensor (m)"

    def plant(self, scene, seed):
        return Shaker(scene.finger, seed)

    def device_model(self, scene, driver):
        one = np.eye(1)
        return DeviceModel(
            rate=driver.rate, delay=driver.delay, block=driver.block, mass=MASS * one, damping=DAMPING * one,
            stiffness=STIFFNESS * one, force_from_drive=FORCE * one, coordinate_from_sensed=one, rigid=True,
            side_from_coordinate=one, place_from_coordinate=one, places=("top",), drive_limit=2.0,
            sensed_limit=1e-3, sensed_noise=NOISE,
        )  # fmt: skip

    def bands(self, scene, model):
        bands = perceptible(scene, scene.texture.bands(model.rate), model)
        check_carriers(scene, model, bands)
        check_targets(scene, model, bands, scene.texture.waveform)
        return bands


def main() -> float:
    finger = hr.Finger.still(normal_load=0.4, touches=[(1.0, 1.5)], mechanics="light-2nd-order")
    scene = hr.Scene(texture=hr.Grating(frequency=80.0, amplitude=20e-6), finger=finger, device="shaker", duration=2.0)
    return hr.render(scene, renderer=ShakerRenderer()).summary()["bands"][0]["rms_error_top"]


if __name__ == "__main__":
    print(main())
