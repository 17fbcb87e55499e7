"""Run methods of the library on the simulated plate, and measure amplitudes."""

import numpy as np
from synthetic import make_bands
from waves import phasor

import hapticrender as hr
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import Plate, PlateParameters


def fixed(*pairs):
    """Bands of fixed carriers from (frequency, envelope) pairs."""
    return make_bands(*zip(*pairs, strict=True))


def grating(wavelength, amplitude):
    """One carrier that follows the finger."""
    return make_bands(0.0, amplitude, 1 / wavelength)


def play(controller, seconds, plate=None, finger=None, seed=0, waveform=None):
    """Drive (A) and true motion (m: centre, end 1, end 2) of a controller on the plate."""
    plate = Plate(plate or PlateParameters(), finger or hr.Finger.absent(), seed)
    waveform = np.zeros(round(seconds * plate.rate)) if waveform is None else waveform
    drive, _, _, sensed = plate.closed_loop(controller, waveform)
    return drive, sensed.motion


def hold(method, bands, seconds, plate=None, known=None, ahead=0.0, **scene):
    """Drive and motion under a method of the library, or the name of one.

    `known` is the plate that it was designed for; its law turns forces by `ahead` (s) more than it should.
    """
    plate = plate or PlateParameters()
    known = known or plate
    method = METHODS[method] if isinstance(method, str) else method
    controller = method.design(known.device_model(plate.rate, known.delay), bands)
    controller.state["p"]["lead"] += ahead
    return play(controller, seconds, plate, **scene)


def envelopes(motion, phase, rate, window, hop=None):
    """Centre times (s) and complex envelopes (windows, columns) by least squares with offset and slope."""
    width = round(window * rate)
    starts = np.arange(0, len(motion) - width + 1, round((hop or window / 4) * rate))
    ramp, found = np.linspace(-1, 1, width), []
    for start in starts:
        piece = slice(start, start + width)
        basis = np.column_stack([np.cos(phase[piece]), -np.sin(phase[piece]), np.ones(width), ramp])
        fit = np.linalg.lstsq(basis, motion[piece], rcond=None)[0]
        found.append(fit[0] + 1j * fit[1])
    return (starts + width / 2) / rate, np.array(found)


def amplitude(motion, frequency, seconds, rate=5000.0):
    """Mean amplitude (m) of each column over the last `seconds`, which hold whole periods."""
    return abs(phasor(motion[-round(seconds * rate) :], frequency, rate))


def amplitude_error(motion, frequency, wanted, seconds=1.0):
    """Relative error of the mean amplitude of each column over the last `seconds`, which hold whole periods."""
    return amplitude(motion, frequency, seconds) / wanted - 1.0
