"""Scenes and devices that the tests of electroadhesion share."""

import numpy as np
from live_devices import Told
from tables import scene_on

import hapticrender as hr
from hapticrender.plants.electroadhesion import ElectroadhesionParameters, ElectroadhesionScreen

RATE, SPEED, MU = 10_000, 0.05, 0.8
FORCE = 0.1  # N of friction
SLIDE = hr.Finger.sliding(speed=SPEED, normal_load=1.0)


def tone(frequency, force=FORCE, finger=SLIDE, duration=2.0, **plant):
    """A friction of `force` (N) at `frequency` (Hz): a displacement of 0.64 m/(N s) of it over w."""
    texture = hr.Grating(frequency=frequency, amplitude=0.64 * force / (2 * np.pi * frequency))
    return scene_on("electroadhesion", texture, finger, duration, keep_unfelt=True, **plant)


class Screen(Told):
    """A screen of the user's own: it takes the envelope, in blocks, and shows friction or, blind, nothing."""

    def __init__(self, *, blind=True, block=1, seed=1, finger=SLIDE, tell=lambda sample, sensed: sensed, **parameters):
        super().__init__(ElectroadhesionScreen(ElectroadhesionParameters(**parameters), finger, seed=seed), tell)
        self.block = self.delay = block
        self.sensed_channels = 0 if blind else 1


def band(recording):
    (figures,) = recording.summary()["bands"]
    return figures
