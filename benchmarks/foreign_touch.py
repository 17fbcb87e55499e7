"""Measure a touch and lift-off on a plate that the library does not know, through the public driver protocol.

The plate is that of ``tests/other_plate.py``, which imports no plant of the library; a heavy finger is put on its
middle for a second, within one sample.  The figure is the largest deviation of the waveform from its target in any
sample, not the error of a mean amplitude.

Run: python -m benchmarks.foreign_touch
"""

import numpy as np

import hapticrender as hr
from hapticrender.touch.mechanics import HEAVY_SECOND
from tests.other_plate import REACH, OtherPlate

RATE, AMPLITUDE = 5000, 50e-6  # Hz, m
ON, OFF = 7500, 12500  # samples


class TouchedPlate(OtherPlate):
    """The plate with a finger from sample `ON` to `OFF`; keeps its true coordinates."""

    def __init__(self, load):
        super().__init__()
        self.free, self.motion = (self._phi, self._gamma, self._push), []
        finger = HEAVY_SECOND.mass, HEAVY_SECOND.damping, HEAVY_SECOND.stiffness
        other = OtherPlate(finger=finger, load=load)
        self.touched = other._phi, other._gamma, other._push

    def play(self, drive):
        now = self.touched if ON <= len(self.motion) < OFF else self.free
        self._phi, self._gamma, self._push = now
        self.motion.append(self._state[:2].copy())
        return super().play(drive)


def deviation(frequency, load, place):
    """Largest deviation (of the amplitude) at a place (m from the middle) around touch and lift-off, sag removed."""
    plate = TouchedPlate(load)
    hr.render(hr.Scene(texture=hr.Grating(frequency=frequency, amplitude=AMPLITUDE), duration=3.0), driver=plate)
    motion = np.array(plate.motion) @ [1.0, place]
    carrier = np.exp(2j * np.pi * frequency * np.arange(len(motion)) / RATE)
    phase = np.angle(np.mean((motion / carrier)[5000 : ON - 100]))
    left = motion - AMPLITUDE * (carrier * np.exp(1j * phase)).real
    period = round(RATE / frequency)
    left = left - np.convolve(left, np.ones(period) / period, mode="same")
    return max(abs(left[at - 50 : at + 1500]).max() for at in (ON, OFF)) / AMPLITUDE


def main():
    for load in (0.0, 0.5):
        for frequency in (143.0, 189.0, 261.0, 400.0):
            found = [100 * deviation(frequency, load, place) for place in (0.0, -REACH, REACH)]
            print(f"{load} N, {frequency:g} Hz: " + ", ".join(f"{each:.0f} %" for each in found) + " (centre, ends)")


if __name__ == "__main__":
    main()
