"""Textures, and devices that lie, fail, sense no finger or call back, for tests of live play."""

import ctypes
import threading
from dataclasses import replace

import numpy as np

import hapticrender as hr
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate, PlateParameters

RIDGES = hr.Grating(wavelength=1e-3, amplitude=5e-6)
TONE = hr.Grating(frequency=100.0, amplitude=5e-6)
ROUNDING = 10.0 / 4096  # A: a step of a 12-bit converter, which a rounding may move by one


def slide(player, seconds, start=-0.02, speed=0.05, load=0.4, pause=0.02):
    """Say where a sliding finger is, again and again; returns where it ends."""
    place = start
    for _ in range(round(seconds / pause)):
        player.finger(place, speed, load)
        player.sleep(pause)
        place += speed * pause
    return place


LIES = {  # what is sensed instead, and what is named
    "stuck": (lambda sensed: sensed * (0.0, 1.0) + (1e-5, 0.0), "sensor 1: one value repeats"),
    "dead": (lambda sensed: 0 * sensed, "sensor 1 and 2: one value repeats"),
    "no numbers": (lambda sensed: np.nan * sensed, "sensor 1 and 2: samples are no numbers"),
    "inverted": (lambda sensed: -sensed, "sensor 1 and 2: the samples are suddenly -"),
    "gain of 3": (lambda sensed: 3.0 * sensed, "sensor 1 and 2: the samples are suddenly [23]"),
}


class Lying(SimulatedDriver):
    """A plate whose sensors lie from a moment on, or whose cable is pulled."""

    def __init__(self, at, what):
        super().__init__(Plate(PlateParameters(), hr.Finger.absent()))
        self.at, self.what, self.played, self.count = at, what, [], 0

    def _play(self, drive):
        sensed = super()._play(drive)
        self.count += 1
        self.played.append(drive.copy())
        if self.count > self.at * self.rate:
            if self.what == "unplugged" and self.count < self.at * self.rate + 10:
                raise hr.DeviceLost("plate: play: no answer")
            if self.what in LIES:
                sensed = sensed._replace(sensed=LIES[self.what][0](sensed.sensed))
            if self.what == "cut" and self.count < self.at * self.rate + 2:
                return sensed._replace(sensed=sensed.sensed[:, :1])
        return sensed


class Bench:
    """A device that need not be opened or closed."""

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


class Calling(Bench):
    """A device that calls back, like a sound card: a thread of its own calls the entry block by block."""

    rate, block, delay = 48_000.0, 64, 64
    drive_channels = sensed_channels = 2
    sensed_scale, drive_scale, probe, zero_on_exit = 1e-3, 0.5, False, True
    cpu_load = 0.25

    def __init__(self):
        parameters = replace(PlateParameters(), rate=self.rate, delay=self.delay)
        self.plate = Plate(parameters, hr.Finger.absent(), block=self.block)
        self.stopping, self.last = threading.Event(), None

    def start(self, entry):
        self.thread = threading.Thread(target=self.call, args=(entry,))
        self.thread.start()

    def stop(self):
        self.stopping.set()
        self.thread.join()

    def call(self, entry):
        pointer, long = ctypes.c_void_p, ctypes.c_ulong
        callback = ctypes.CFUNCTYPE(ctypes.c_int, pointer, pointer, long, pointer, long, pointer)(entry.address)
        given, made = (np.zeros((self.block, each), np.float32) for each in (self.sensed_channels, self.drive_channels))
        while not self.stopping.is_set():
            given[:] = self.play(made.astype(float) / self.drive_scale).sensed / self.sensed_scale
            callback(given.ctypes.data, made.ctypes.data, self.block, None, 0, entry.user_data)
            self.last = made.copy()
            threading.Event().wait(1e-3)

    def play(self, drive):
        return hr.Sensed(self.plate.run(drive).sensed)


class Told(SimulatedDriver):
    """A plant as a device of the user's own, which hands over `tell(sample, sensed)`, and its motion to nobody else.

    It keeps what it plays (`played`) and how it really moves (`moved`), block by block.
    """

    def __init__(self, plant, tell=lambda sample, sensed: sensed._replace(motion=None)):
        super().__init__(plant)
        self.tell, self.played, self.moved = tell, [], []

    def _play(self, drive):
        sample, sensed = self.block * len(self.played), super()._play(drive)
        self.played.append(drive.copy())
        self.moved.append(sensed.motion)
        return self.tell(sample, sensed._replace(sensed=sensed.sensed[:, : self.sensed_channels]))


class Blind(SimulatedDriver):
    """A plate that senses no finger."""

    def _play(self, drive):
        return super()._play(drive)._replace(position=None, normal_load=None)


def error_of(recording, start, stop=None):
    """Waveform error of a part of a recording in which the texture lies above 40 Hz, its mean removed."""
    rate = recording.rate
    first, last = round(start * rate), None if stop is None else round(stop * rate)
    wanted, moved = recording.reference[first:last], recording.motion[first:last, 0]
    wanted, moved = wanted - wanted.mean(), moved - moved.mean()
    return float(np.sqrt(np.mean((moved - wanted) ** 2) / np.mean(wanted**2)))
