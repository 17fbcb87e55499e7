"""A texture of your own: ridges that stand higher the further right the finger is.

The figure is how many times higher the plate moves on the right third of the path than on the left third.
"""

from dataclasses import dataclass

import numpy as np

import hapticrender as hr

SPAN = 0.04  # m


@dataclass(frozen=True)
class Slope:
    """Ridges `wavelength` (m) apart whose height (m) grows from `low` to `high` over the finger's path."""

    wavelength: float
    low: float
    high: float

    def bands(self, rate: float) -> hr.Bands:
        """One carrier, locked to the finger; no envelope, as it is not constant: the loop analyses the waveform."""
        one = np.array([1 / self.wavelength])
        return hr.Bands(frequency=np.zeros(1), wavenumber=one, phase=np.zeros(1))

    def waveform(self, time: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Target displacement (m) at the finger, nothing while it is lifted (NaN)."""
        height = self.low + (self.high - self.low) * (position / SPAN + 0.5)
        return np.nan_to_num(height * np.cos(2 * np.pi * position / self.wavelength))


def main() -> float:
    scene = hr.Scene(texture=Slope(1e-3, 2e-6, 12e-6), finger=hr.Finger.sliding(speed=0.05, span=SPAN), duration=4.8)
    recording = hr.render(scene)
    settled = recording.time >= 1.6
    right = np.std(recording.motion[settled & (recording.position > SPAN / 6), 0])
    left = np.std(recording.motion[settled & (recording.position < -SPAN / 6), 0])
    print(f"rms {1e6 * left:.2f} um on the left, {1e6 * right:.2f} um on the right")
    return float(right / left)


if __name__ == "__main__":
    print(main())
