"""A grating of friction on a glass that vibrates at 30 kHz, while the glass warms by 10 K and a finger comes and goes.

The figure is how far (Hz) the carrier has moved to stay where the glass is resonant.  Give a file's name for a picture.
"""

import sys

import numpy as np

import hapticrender as hr
from hapticrender.loop import prepare, run
from hapticrender.protocols import Flag

TOUCHES = [(0.0, 1.2), (1.3, 3.0)]  # s


def main() -> float:
    scene = hr.Scene(
        texture=hr.Grating(wavelength=1e-3, amplitude=10e-6),
        finger=hr.Finger.sliding(speed=0.08, normal_load=0.4, touches=TOUCHES, mechanics="light"),
        device="ultrasonic",
        duration=3.0,
        simulation={"temperature_rise": 10.0, "temperature_time": 2.5},  # K, s
    )
    rendering = prepare(scene)
    recording = run(rendering)
    shift = rendering.plant.loop.state["shift"][0]
    (band,) = recording.summary()["bands"]
    unlocked = np.count_nonzero(recording.flags & Flag.UNLOCKED) / recording.rate
    print(f"target {1e3 * band['target']:.2f} mN of friction, made {1e3 * band['achieved']:.2f} mN")
    print(f"the carrier moved by {shift:+.1f} Hz and was off its resonance for {1e3 * unlocked:.1f} ms, at the start")
    if len(sys.argv) > 1:
        recording.plot(sys.argv[1])
    return float(shift)


if __name__ == "__main__":
    print(main())
