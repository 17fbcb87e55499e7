"""The controller as a C function, which an audio library calls block after block while Python does something else.

Here a thread stands in for the audio library and a simulated plate for the sound card.  The figure is the amplitude (m)
of the last second, after the application has changed the gain on the way.
"""

import ctypes
import threading
from dataclasses import replace

import numpy as np

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.realtime_entry import RealtimeEntry

RATE, BLOCK = 48_000.0, 64  # Hz, samples
FULL_SCALE = 1e-3  # m: what the sensors' amplifier makes of 1.0
POINTER, LONG = ctypes.c_void_p, ctypes.c_ulong
CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, POINTER, LONG, POINTER, LONG, POINTER)  # as PortAudio declares it


def play(entry: RealtimeEntry, plate: Plate, motion: list[np.ndarray], stop: threading.Event) -> None:
    """What the audio library does: hand over what was recorded, take what is to be played."""
    callback = CALLBACK(entry.address)
    recorded, played = np.zeros((BLOCK, 2), np.float32), np.zeros((BLOCK, 2), np.float32)
    while not stop.is_set():
        sensed = plate.run(played.astype(float))
        motion.append(sensed.motion[:, 0])
        recorded[:] = sensed.sensed / FULL_SCALE
        callback(recorded.ctypes.data, played.ctypes.data, BLOCK, None, 0, entry.user_data)


def main() -> float:
    parameters = replace(PlateParameters(), rate=RATE, delay=BLOCK)
    model = replace(parameters.device_model(RATE, BLOCK), block=BLOCK)
    bands = replace(hr.Grating(frequency=80.0, amplitude=5e-6).bands(RATE), modulated=True)  # by the gain
    entry = RealtimeEntry(METHODS["h2"].design(model, bands), sensed_scale=FULL_SCALE)
    motion: list[np.ndarray] = []
    plate, stop = Plate(parameters, hr.Finger.absent(), block=BLOCK), threading.Event()
    audio = threading.Thread(target=play, args=(entry, plate, motion, stop))
    audio.start()
    while entry.samples < RATE:  # the application is busy; then it is to be more
        sum(range(1000))
    entry.set_gain(2.0)
    enough = entry.samples + 2 * RATE
    while entry.samples < enough:
        sum(range(1000))
    stop.set()
    audio.join()
    last = np.concatenate(motion)[-int(RATE) :]
    amplitude = abs(2 * np.mean(last * np.exp(-2j * np.pi * 80.0 * np.arange(len(last)) / RATE)))
    print(f"5 um, then 10 um: {1e6 * amplitude:.2f} um; {entry.samples} samples, {entry.refused} refused")
    return float(amplitude)


if __name__ == "__main__":
    print(main())
