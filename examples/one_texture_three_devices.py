"""One texture on a plate, an electroadhesive and an ultrasonic screen: the skin should feel the same.

The figure is the largest error of the predicted skin velocity (1) over all bands and devices.
"""

import hapticrender as hr
from hapticrender.skin import skin_bands

DEVICES = ("vt-plate", "electroadhesion", "ultrasonic")


def main() -> float:
    texture = hr.Grating(level=25.0, frequency=60.0, partials=((1.0, 1.0, 0.0), (2.0, 0.5, 1.0), (4.0, 0.25, 2.0)))
    finger = hr.Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
    recordings = {
        device: hr.render(hr.Scene(texture=texture, finger=finger, device=device, duration=2.0)) for device in DEVICES
    }
    for device, recording in recordings.items():
        bands = skin_bands(recording)
        rows = [f"{band.frequency:g} Hz {1e3 * band.achieved:.3f} mm/s ({band.level:.1f} dB)" for band in bands]
        print(f"{device}: {', '.join(rows)}")
    return max(abs(band.error) for recording in recordings.values() for band in skin_bands(recording))


if __name__ == "__main__":
    print(main())
