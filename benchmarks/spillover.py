"""Plates whose bending mode the controller does not know: limit cycles with and without the supervisor.

Run: python -m benchmarks.spillover [--plate stranger]

38 modes a row: 500 to 2300 Hz in steps of 100, coupling +-0.1, Q 30 and 50 in turn; each free and under a finger of
0.8 N for 1 s.  Printed for each texture: how many ring on unsupervised (at the drive limit, or by
`false_stops.ringing`); supervised, the largest drive over its limit, how often the damper was turned down, and how
often the drive was stopped.  The stranger's plate (``tests/strangers_plate.py``: another mode shape, integrated
otherwise, contact reported 5 ms late) is played through `hapticrender.render` alone, supervised.
"""

import argparse
import warnings

import numpy as np

import hapticrender as hr
from benchmarks.false_stops import Hidden, ringing
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY
from tests.strangers_plate import StrangersPlate

TEXTURES = [(20.0, 10e-6), (72.0, 50e-6), (189.0, 50e-6), (400.0, 50e-6)]  # Hz, m
TOUCH = hr.Finger.still(normal_load=0.8, touches=((0.5, 1.5),), mechanics=HEAVY)


def run(frequency, amplitude, mode, finger, supervised=True):
    """Largest drive over its limit, whether it rings on, the damper's final gain, and whether it was stopped."""
    plate = Plate(PlateParameters(**mode), finger, 1)
    scene = hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=amplitude), finger=finger, duration=2.0)
    rendering = hr.prepare(scene, driver=Hidden(plate))
    controller = rendering.controller()
    inner = controller if supervised else controller.controller
    drive, limit = plate.closed_loop(inner, np.zeros(10_000))[0], rendering.model.drive_limit
    left = ringing(drive[-1500:]) or abs(drive[-1000:]).max() > 0.95 * limit
    return abs(drive).max() / limit, left, controller.damper_scale, controller.fault is not None


def modes():
    """Bending modes that are tried."""
    for number, frequency in enumerate(np.arange(500.0, 2301.0, 100.0)):
        for sign in (-1, 1):
            damping = 1 / 60 if number % 2 else 1 / 100
            yield {"bending_frequency": frequency, "bending_damping": damping, "bending_coil": 0.1 * sign}


def play_stranger(frequency, amplitude, mode, finger):
    """Whether it rings on on the stranger's plate; None where it was stopped."""
    plate = StrangersPlate.of(PlateParameters(**mode), finger, seed=1)
    texture = hr.Grating(frequency=frequency, amplitude=amplitude)
    rendering = hr.prepare(hr.Scene(texture=texture, finger=finger, duration=2.0), driver=plate)
    try:
        drive = hr.run(rendering).drive
    except hr.DeviceFault:
        return None
    return bool(ringing(drive[-1500:]) or abs(drive[-1000:]).max() > 0.95 * rendering.model.drive_limit)


def stranger():
    """Print how many scenes ring on and how many are stopped, texture by texture."""
    for texture in TEXTURES:
        found = [play_stranger(*texture, mode, who) for mode in modes() for who in (hr.Finger.absent(), TOUCH)]
        print(
            f"{texture[0]:g} Hz: of {len(found)} {found.count(None)} stopped, {found.count(True)} ring on", flush=True
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plate", choices=("own", "stranger"), default="own")
    warnings.simplefilter("ignore")
    if parser.parse_args().plate == "stranger":
        return stranger()
    for texture in TEXTURES:
        rings, left, peak, turned, stopped, needless = 0, 0, 0.0, 0, 0, 0
        for mode in modes():
            for finger in (hr.Finger.absent(), TOUCH):
                unstable = run(*texture, mode, finger, supervised=False)[1]
                largest, on, scale, fault = run(*texture, mode, finger)
                rings, turned, stopped = rings + unstable, turned + (scale < 1.0), stopped + fault
                needless += not unstable and (scale < 1.0 or fault)
                left, peak = left + on, max(peak, largest)
        print(
            f"{texture[0]:g} Hz: {rings} of 76 ring; supervised: {peak:.2f} of the limit, {turned} turned down, "
            f"{stopped} stopped, {left} ring on, {needless} turned down though stable",
            flush=True,
        )


if __name__ == "__main__":
    main()
