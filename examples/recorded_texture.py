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
    """Half a second of ridges whose height differs, as an accelerometer on a moving finger would see them."""
    time = np.arange(4000) / 8000
    soundfile.write(path, (0.6 + 0.2 * np.cos(2 * np.pi * 4 * time)) * np.sin(2 * np.pi * RIDGES * time), 8000)


def strongest(motion: np.ndarray, rate: float) -> float:
    """Frequency (Hz) of the strongest line above 20 Hz."""
    power = np.abs(np.fft.rfft(motion * np.hanning(motion.size)))
    frequency = np.fft.rfftfreq(motion.size, 1 / rate)
    return float(frequency[np.argmax(np.where(frequency > 20, power, 0))])


def main() -> float:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "ridges.wav"
        make_recording(path)
        texture = hr.Recorded(file=path, amplitude=10e-6, speed=RECORDED_SPEED)
        finger = hr.Finger.sliding(speed=2 * RECORDED_SPEED, span=0.02)
        recording = hr.render(hr.Scene(texture=texture, finger=finger, duration=3.0))
    felt = strongest(recording.motion[recording.time >= 1.0, 0], recording.rate)
    print(f"recorded at {RIDGES:.0f} Hz, felt at {felt:.1f} Hz")
    return felt / RIDGES


if __name__ == "__main__":
    print(main())
