"""One texture on a plate, an electroadhesive and an ultrasonic screen: the skin should feel the same.

A plate moves the skin with it, V = j w X; friction moves it by V = (v/F) F, with v/F as the scene has it.  The figure
is the largest error of the predicted skin velocity (1) over all bands and devices.
"""

from typing import NamedTuple

import numpy as np

import hapticrender as hr
from hapticrender.touch.perception import VELOCITY_PER_FORCE

DEVICES = ("vt-plate", "electroadhesion", "ultrasonic")


class SkinBand(NamedTuple):
    """Skin velocity of a band (m/s peak) at the device's first place, and its level over the detection threshold."""

    frequency: float  # Hz: the median while it is judged
    target: float
    achieved: float
    level: float  # dB; NaN where the threshold is not known


def velocity_per_unit(recording: hr.Recording, frequency: float) -> float:
    """Skin velocity (m/s) per unit of the device's quantity, at a frequency (Hz; any on a plate)."""
    unit = recording.header.unit
    if unit in ("m", "m/s"):
        return 2 * np.pi * frequency if unit == "m" else 1.0
    share = float(recording.scene.rendering.get("velocity_per_force", VELOCITY_PER_FORCE))
    return share or float(abs(recording.scene.finger.mechanics.skin_velocity_per_force(frequency)))


def skin_bands(recording: hr.Recording) -> list[SkinBand]:
    found = []
    for band in recording.summary()["bands"]:
        frequency, share = band["frequency"], velocity_per_unit(recording, band["frequency"])
        target, achieved = share * band["target"], share * band["achieved"]
        level = float(hr.sensation_level(achieved / (2 * np.pi * frequency), frequency))
        found.append(SkinBand(frequency, target, achieved, level))
    return found


def main() -> float:
    texture = hr.Grating(level=25.0, frequency=60.0, partials=((1.0, 1.0, 0.0), (2.0, 0.5, 1.0), (4.0, 0.25, 2.0)))
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
    errors = []
    for device in DEVICES:
        bands = skin_bands(hr.render(hr.Scene(texture=texture, finger=finger, device=device, duration=2.0)))
        rows = [f"{band.frequency:g} Hz {1e3 * band.achieved:.3f} mm/s ({band.level:.1f} dB)" for band in bands]
        print(f"{device}: {', '.join(rows)}")
        errors += [abs(band.achieved / band.target - 1) for band in bands]
    return max(errors)


if __name__ == "__main__":
    print(main())
