"""Time an audio callback at 48 kHz in blocks of 64, in a loop with a simulated plate."""

import ctypes
import time

import numpy as np

import hapticrender as hr
from hapticrender.jit import CFunction
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.realtime_kernel import AUDIO

RATE, BLOCK = 48_000.0, 64  # Hz, samples
POINTER, LONG = ctypes.c_void_p, ctypes.c_ulong
SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, POINTER, LONG, POINTER, LONG, POINTER)


def nothing(sensed, drive, frames, time, status, argument):
    """Compiled callback that does nothing."""
    return 0


EMPTY = CFunction(nothing, AUDIO.signature)


def seconds_of(address: int, argument: int, calls: int, amperes=1.0, metres=1.0) -> tuple[float, float]:
    """Median and 99th percentile (s) of a call; a sample of 1 is so many amperes or metres."""
    callback, plate = (
        SIGNATURE(address),
        Plate(PlateParameters(rate=RATE, delay=BLOCK), hr.Finger.absent(), block=BLOCK),
    )
    sensed, played, spent = np.zeros((BLOCK, 2), np.float32), np.zeros((BLOCK, 2), np.float32), np.empty(calls)
    for call in range(calls):
        sensed[:] = plate.run(amperes * played.astype(float)).sensed / metres
        start = time.perf_counter()
        callback(sensed.ctypes.data, played.ctypes.data, BLOCK, None, 0, argument)
        spent[call] = time.perf_counter() - start
    return float(np.median(spent)), float(np.quantile(spent, 0.99))
