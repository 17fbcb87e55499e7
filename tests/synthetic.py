"""Recordings of motions that are known in closed form."""

from dataclasses import replace

import numpy as np

import hapticrender as hr

RATE = 5000.0  # Hz
PLACES = ("centre", "end 1", "end 2")


def make_bands(frequency, envelope, wavenumber=0.0, phase=0.0, **options):
    frequency, wavenumber, phase = np.broadcast_arrays(np.atleast_1d(frequency).astype(float), wavenumber, phase)
    constant = envelope if envelope is None else np.broadcast_to(np.asarray(envelope, complex), frequency.shape)
    return hr.Bands(frequency=frequency, wavenumber=wavenumber * 1.0, phase=phase * 1.0, envelope=constant, **options)


def make_recorder(path, bands, *, rate=RATE, **fields):
    texture = hr.Grating(amplitude=1e-5, frequency=100.0)
    scene = hr.Scene(**({"texture": texture, "duration": 4.0, "name": "known"} | fields))
    return hr.Recorder(path, scene=scene, method="paper", seed=7, rate=rate, bands=bands, drive_limit=3.0)


def times(duration, rate=RATE):
    return np.arange(round(duration * rate)) / rate


def make_signals(bands, motion_envelope, *, duration=4.0, rate=RATE, position=np.nan, target=None, extra=0.0):
    """Signals whose motion is `extra` (n, places) plus the given envelopes (broadcast to (n, places, n_bands))."""
    time = times(duration, rate)
    n, k = len(time), len(bands)
    position = np.broadcast_to(np.asarray(position, float), n)
    carrier = np.exp(1j * bands.carrier_phase(time, position))
    envelope = np.broadcast_to(np.asarray(motion_envelope, complex), (n, len(PLACES), k))
    motion = np.einsum("npk,nk->np", envelope, carrier).real + extra
    target = np.broadcast_to(np.asarray(bands.envelope if target is None else target, complex), (n, k))
    return {
        "drive": np.outer(np.sin(time), [1.0, 0.5]),
        "sensed": motion[:, 1:],
        "motion": motion,
        "position": position,
        "normal_load": np.where(np.isfinite(position), 0.4, 0.0),
        "target": target,
        "reference": (target * carrier).real.sum(axis=1),
        "flags": np.zeros(n, np.int64),
    }


def make_recording(bands, motion_envelope, *, scene=None, motion_source="true", **rest):
    recorder = make_recorder(None, bands, **({"duration": rest.get("duration", 4.0)} | (scene or {})))
    recorder.append(**make_signals(bands, motion_envelope, **rest), motion_source=motion_source)
    return recorder.finish()


def make_play(reference, motion, position=np.nan, **fields):
    """Recording of a waveform without bands at `RATE`; `motion` is the same at every place, or (n, places)."""
    n, bands = len(reference), hr.Bands.none(spatial=False)
    recorder = make_recorder(None, bands, **({"duration": n / RATE, "settle": 0.0} | fields))
    motion = np.broadcast_to(np.reshape(motion, (n, -1)), (n, len(PLACES)))
    signals = make_signals(bands, np.zeros(0), duration=n / RATE, position=position)
    recorder.append(**signals | {"motion": motion, "reference": np.asarray(reference)})
    return recorder.finish()


def summary_of(bands, signals, header=None, **scene):
    recorder = make_recorder(None, bands, **scene)
    recorder.header = replace(recorder.header, **(header or {}))
    recorder.append(**signals)
    return recorder.finish().summary()
