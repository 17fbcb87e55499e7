"""A compiled controller of one line, for the tests of plants and of surfaces with a loop inside."""

import math

import numba
import numpy as np

from hapticrender.jit import F8, I8, SIGNALS_T, addresses, pointer, record_of, step

NUMBERS, COUNTS = ("gain", "pulse"), ("count", "flag", "channels", "sensors")
STATE = np.dtype([(name, "f8") for name in NUMBERS] + [(name, "i8") for name in COUNTS])
STATE_T = numba.from_dtype(STATE)


@step
def proportional_step(state, signals, start, count):
    """Drive every channel by gain (waveform - first sensor), the waveform on a carrier of `pulse` turns a sample."""
    c = numba.carray(pointer(state, STATE_T), 1)[0]
    io = numba.carray(pointer(signals, SIGNALS_T), 1)[0]
    end = start + count
    drive = numba.carray(pointer(io.drive, F8), (end, c.channels))
    sensed = numba.carray(pointer(io.sensed, F8), (end, c.sensors))
    waveform, flags = numba.carray(pointer(io.waveform, F8), end), numba.carray(pointer(io.flags, I8), end)
    for n in range(start, end):
        carrier = math.cos(2 * math.pi * c.pulse * c.count)
        for i in range(c.channels):
            drive[n, i] = c.gain * (waveform[n] * carrier - sensed[n, 0])
        flags[n] |= c.flag
        c.count += 1
    return 0


class Proportional:
    """The least that a compiled controller has, and a `flag` that it raises."""

    step, n_bands, block = proportional_step, 1, 1

    def __init__(self, gain, pulse=0.0, flag=0, channels=1, sensors=1):
        self.state = record_of(STATE, gain=gain, pulse=pulse, flag=flag, channels=channels, sensors=sensors)

    def run(self, sensed, waveform):
        """Drive of one channel for n samples, shape (n, 1)."""
        drive, flags = np.zeros((len(sensed), 1)), np.zeros(len(sensed), np.int64)
        record = addresses(drive=drive, sensed=sensed, waveform=waveform, flags=flags)
        self.step(self.state.ctypes.data, record.ctypes.data, 0, len(sensed))
        return drive
