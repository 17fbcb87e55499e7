"""Run methods of the library on the simulated plate, and measure amplitudes."""

import numpy as np

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import Plate, PlateParameters


def fixed(*pairs):
    """Bands of fixed carriers from (frequency, envelope) pairs."""
    frequency, zero = np.array([pair[0] for pair in pairs], float), np.zeros(len(pairs))
    envelope = np.array([pair[1] for pair in pairs], complex)
    return Bands(frequency=frequency, wavenumber=zero, phase=zero, envelope=envelope)


def grating(wavelength, amplitude):
    """One carrier that follows the finger."""
    one = np.ones(1)
    return Bands(frequency=0 * one, wavenumber=one / wavelength, phase=0 * one, envelope=amplitude * one + 0j)


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
    n = np.arange(len(motion))[-round(seconds * rate) :]
    return abs(2 * np.mean(motion[n] * np.exp(-2j * np.pi * frequency * n / rate)[:, None], axis=0))


def amplitude_error(motion, frequency, wanted, seconds=1.0):
    """Relative error of the mean amplitude of each column over the last `seconds`, which hold whole periods."""
    return amplitude(motion, frequency, seconds) / wanted - 1.0
