"""A compiled controller of one line, for the tests of surfaces with a loop inside."""

import numba
import numpy as np

from hapticrender.jit import F8, SIGNALS_T, addresses, pointer, step

STATE_T = numba.from_dtype(np.dtype([("gain", "f8"), ("bias", "f8"), ("pulse", "f8"), ("count", "i8")]))


@step
def proportional_step(state, signals, start, count):
    """Drive gain (waveform - sensed) + bias, on a carrier of `pulse` turns a sample."""
    c = numba.carray(pointer(state, STATE_T), 1)[0]
    io = numba.carray(pointer(signals, SIGNALS_T), 1)[0]
    end = start + count
    drive, sensed = numba.carray(pointer(io.drive, F8), end), numba.carray(pointer(io.sensed, F8), end)
    waveform = numba.carray(pointer(io.waveform, F8), end)
    for n in range(start, end):
        carrier = np.cos(2 * np.pi * c.pulse * c.count)
        drive[n] = c.gain * (waveform[n] * carrier - sensed[n]) + c.bias
        c.count += 1
    return 0


class Proportional:
    """Drive `gain` (waveform - sensed) + `bias`, waveform on a carrier of `pulse` turns a sample."""

    step, n_bands, block = proportional_step, 1, 1

    def __init__(self, gain, bias=0.0, pulse=0.0):
        self.state = np.array([(gain, bias, pulse, 0)], STATE_T.dtype)

    def run(self, sensed, waveform):
        """Drive for n samples, shape (n, 1)."""
        drive = np.zeros((len(sensed), 1))
        record = addresses(drive=drive, sensed=sensed, waveform=waveform)
        self.step(self.state.ctypes.data, record.ctypes.data, 0, len(sensed))
        return drive
