"""A texture on a sound card: `python examples/sound_card.py 0`, with the card's number or a part of its name.

Without a card it lists those that are there, and plays nothing.  Output 1 and 2 drive the coils of a plate through an
amplifier, open loop.  With sensors on inputs 1 and 2 the loop is closed once three more numbers are known: what full
scale is in metres, and the delay, which `hapticrender latency --driver audio:0` measures through a cable:

    AudioDriver(card, drive_per_full_scale=3.0, sensed_per_full_scale=1e-3, delay=341.2)

The figure is the largest drive (A) that was played, 0 without a card.
"""

import sys

import numpy as np

import hapticrender as hr
from hapticrender.drivers.audio import AudioDriver


def main(arguments: list[str]) -> float:
    if not arguments:
        try:
            print("\n".join(AudioDriver.found()) or "there is no sound card")
        except hr.DeviceNotFound as missing:  # no PortAudio
            print(missing)
        return 0.0
    scene = hr.Scene(
        texture=hr.Grating(wavelength=1e-3, amplitude=10e-6),
        finger=hr.Finger.sliding(speed=0.08, normal_load=0.4),
        duration=5.0,
    )
    driver = AudioDriver(arguments[0], channels=(1, 2), drive_per_full_scale=3.0)
    recording = hr.render(scene, driver=driver)
    print(f"{driver}: {driver.overruns} of {len(recording) // driver.block} blocks came too late")
    return float(np.abs(recording.read("drive")).max())


if __name__ == "__main__":
    print(main(sys.argv[1:]))
