"""A sound file as a texture: recorded at one speed, felt at another.

The figure is how much faster the texture runs under a finger that moves at twice the recorded speed.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import soundfile

import hapticrender as hr

RECORDED_SPEED = 0.05  # m/s
RIDGES = 50.0  # Hz, as recorded


def make_recording(path: Path) -> None:
    """Two seconds of ridges whose height differs, as an accelerometer on a moving finger would see them."""
    time = np.arange(16000) / 8000
    height = 0.6 + 0.2 * np.cos(2 * np.pi * 4 * time)
    soundfile.write(path, height * np.sin(2 * np.pi * RIDGES * time), 8000)


def strongest(motion: np.ndarray, rate: float) -> float:
    """Frequency (Hz) at which the spectrum is highest, above 20 Hz."""
    points = 2**17  # fine enough to read a peak to 0.04 Hz
    power = np.abs(np.fft.rfft(motion * np.hanning(motion.size), points))
    frequency = np.fft.rfftfreq(points, 1 / rate)
    return float(frequency[np.argmax(np.where(frequency > 20, power, 0))])


def main() -> float:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "ridges.wav"
        make_recording(path)
        texture = hr.Recorded(file=path, amplitude=10e-6, speed=RECORDED_SPEED, carriers=8)
        finger = hr.Finger.sliding(speed=2 * RECORDED_SPEED, span=0.09)
        recording = hr.render(hr.Scene(texture=texture, finger=finger, duration=2.0))
    one_stroke = (recording.time > 0.6) & (recording.time < 1.3)  # the finger turns at 0.45 and 1.35 s
    felt = strongest(recording.motion[one_stroke, 0], recording.rate)
    print(f"recorded at {RIDGES:.0f} Hz, felt at {felt:.1f} Hz")
    return felt / RIDGES


if __name__ == "__main__":
    print(main())
