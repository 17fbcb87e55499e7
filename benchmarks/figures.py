"""Measure the plate's figures through ``hr.render`` and a third party's driver, from that plate's own truth.

The plate is ``tests/strangers_plate.py``.  Waveforms: E = rms_B(y - r)/rms_B(r), B = 20-500 Hz zero-phase, r the
texture as requested at that sample's time; no time shift, no gain fit; under the finger and at the worse end, from
1.5 s on (chirp from .3 s, swipe from .7 s, cold).  Gratings: envelopes by least squares with offset and slope over
windows of max(20 ms, 2/f), at random phases.  Unless its row says otherwise the plate is rigid, which the library does
not know; ``--bending 1250,30,0.1`` (Hz, Q, shape at the coils) bends it.  Position and load are reported 5 ms late when
a finger touches or lifts.

Run: python -m benchmarks.figures [--method inverse] [--only white]
"""

import argparse
import warnings
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, resample_poly, sosfiltfilt

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.plants.plate import PlateParameters
from tests.strangers_plate import TRUTH, WRONG, StrangersPlate

PLACES = [folder / "shared/data/swipe_40mm_s.npz" for folder in Path(__file__).resolve().parents]  # beside the checkout
SWIPE = next((place for place in PLACES if place.exists()), None)
FINE = 20e3  # Hz: of the textures' samples
FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 143.0, 170.0, 178.0, 189.0, 261.0, 400.0)
LIGHT, HEAVY = (4e-3, 1.0, 200.0), (4e-3, 1.5, 300.0)  # kg, N s/m, N/m: Grigorii et al. 2021, table 1
FINGERS = {  # mechanics, load (N)
    "2L": (LIGHT, 0.3),
    "2H": (HEAVY, 0.8),
    "4L": ((0.2e-3, 1.5, 1e3, *LIGHT), 0.3),
    "4H": ((0.2e-3, 8.0, 8e3, *HEAVY), 0.8),
}
FINGER, ENDS, CENTRE = 0, [1, 2], 3  # columns of the plate's truth
EVERY = [FINGER, *ENDS]
options = argparse.Namespace(method="inverse", bending=None, seed=1, identified=False)


class Wave:
    """A texture in time from samples at `FINE`, repeated for ever, of so many metres rms; no bands."""

    def __init__(self, values, rms=5e-6):
        values = values * rms / np.sqrt(np.mean(values**2))
        self.period, grid = len(values) / FINE, np.arange(len(values) + 1) / FINE
        self.spline = CubicSpline(grid, np.append(values, values[0]), bc_type="periodic")

    def bands(self, rate):
        return Bands(frequency=[], wavenumber=[], phase=[], envelope=None)

    def waveform(self, time, position):
        return self.spline(np.asarray(time) % self.period)


def limited(values, low=20.0, high=500.0, exponent=0.0):
    """Give samples at `FINE` no energy outside low to high (Hz), and a power spectrum f^exponent steeper."""
    frequency, spectrum = np.fft.rfftfreq(len(values), 1 / FINE), np.fft.rfft(values)
    inside = (frequency >= low) & (frequency <= high)
    spectrum[inside] *= frequency[inside] ** (exponent / 2)
    return np.fft.irfft(np.where(inside, spectrum, 0.0), len(values))


def noise(low, high, exponent=0.0):
    draw = np.random.default_rng(options.seed).standard_normal(round(5 * FINE))
    return Wave(limited(draw, low, high, exponent))


def white():
    return noise(20.0, 400.0)


def pink():
    return noise(20.0, 500.0, -1.0)


def clicks():
    """One unit impulse every 60 to 140 ms, of either sign."""
    rng, values = np.random.default_rng(options.seed), np.zeros(round(5 * FINE))
    at = np.cumsum(rng.uniform(0.06, 0.14, 35))
    values[np.round(FINE * at).astype(int)] = rng.choice([-1.0, 1.0], 35)
    return Wave(limited(values))


def chirp():
    """20 to 480 Hz in 3 s and back."""
    time = np.arange(round(3 * FINE)) / FINE
    phase = 2 * np.pi * (20.0 * time + 460.0 / 6 * time**2)
    return Wave(limited(np.sin(np.append(phase, (phase[-1] + phase[-1] - phase)[::-1]))))


def swipe():
    """Lateral force of a finger at 40 mm/s, 4.6 to 6.9 s of the recording, in time."""
    with np.load(SWIPE) as file:
        force = file["lateral_force"][46000:69000].astype(float)
    return Wave(limited(resample_poly(force - force.mean(), 2, 1)))


class Motion(NamedTuple):
    """A finger's motion, for the textures that are read at its position."""

    position: object


class Run(NamedTuple):
    time: np.ndarray  # s
    truth: np.ndarray  # m (n, 4)
    position: np.ndarray  # m, true, NaN without contact
    reference: np.ndarray  # m, of the texture at these


def identified(seed=0, **plate):
    """Identify a plate without a finger; its profile holds what was found."""
    return hr.identify(StrangersPlate(**{"bending": options.bending, "seed": seed} | plate), PlateParameters())


def play(texture, seconds, finger=None, position=0.0, contact=None, *, method=None, device=StrangersPlate, **plate):
    """Render a texture on the plate, a `StrangersPlate` or a subclass, and return what the plate truly did."""
    if finger is not None:
        mechanics, load = FINGERS[finger] if isinstance(finger, str) else finger
        contact = contact or (lambda t: np.clip((t - 0.1) / 1e-3, 0.0, 1.0))
        plate = {"finger": mechanics, "load": load, "contact": contact, "position": position} | plate
    device = device(**{"bending": options.bending, "seed": options.seed, "report_lag": 5e-3} | plate)
    free = {key: value for key, value in plate.items() if key not in ("finger", "load", "contact", "position")}
    profile = identified(**free).profile() if options.identified else {}
    motion = hr.Finger(Motion(position)) if callable(position) and device.sensed_channels else hr.Finger.absent()
    settings = {"method": method or options.method, "profile": profile, "keep_unfelt": True}
    scene = hr.Scene(texture=texture, finger=motion, duration=seconds, **settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hr.render(scene, driver=device)
    samples = round(seconds * device.rate)
    time, truth = np.arange(samples) / device.rate, device.truth[:samples]
    course = np.broadcast_to(position(time) if callable(position) else position, time.shape)
    course = np.where(device.contact[:samples] > 0.0, course, np.nan)
    return Run(time, truth, course, texture.waveform(time, course))


def sliding(time, speed=0.1):
    """Positions of a finger at `speed` (m/s), to and fro over +-25 mm, turning within 50 ms (4 m/s2 at 100 mm/s).

    Turned at once, the finger's load alone shakes the plate by 1.4 % of 5 um rms, whatever is played.
    """
    half = 0.05 / speed  # s, from turn to turn
    turn = np.round(np.asarray(time) / half)
    since = abs(time - half * turn)
    away = speed * np.where(since < 0.025, since**2 / 0.05 + 0.0125, since)
    return (-1.0) ** turn * (0.025 - away)


def in_band(run):
    """Reference (n,) and error under the finger and at both ends (n, 3), m, 20 to 500 Hz."""
    sos = butter(4, [20.0, 500.0], "bandpass", fs=1 / run.time[1], output="sos")
    return sosfiltfilt(sos, run.reference), sosfiltfilt(sos, run.truth[:, EVERY] - run.reference[:, None], axis=0)


def wave_error(run, start=1.5):
    """Percent of the reference, under the finger and at the worse end."""
    judged = (run.time >= start) & (run.time <= run.time[-1] - 0.05)
    reference, error = (each[judged] for each in in_band(run))
    each = 100 * np.sqrt(np.mean(error**2, axis=0) / np.mean(reference**2))
    return each[0], max(each[1:])


def envelopes(phase, motion, size, hop):
    """Sample numbers of the windows' beginnings and complex amplitudes (windows, bands, places) over carrier phases."""
    starts, line = np.arange(0, len(motion) - size + 1, hop), np.linspace(-1, 1, size)[:, None]
    found = []
    for start in starts:
        turn = np.exp(1j * phase[start : start + size])
        regressors = np.hstack([turn.real, -turn.imag, np.ones((size, 1)), line])
        fit = np.linalg.lstsq(regressors, motion[start : start + size], rcond=None)[0]
        found.append(fit[: turn.shape[1]] + 1j * fit[turn.shape[1] : 2 * turn.shape[1]])
    return starts, np.array(found)


def tone_errors(run, frequency, amplitude, columns, hop=None):
    """Middle times (s) and relative amplitude errors (windows, places) of a tone."""
    rate = 1 / run.time[1]
    size = round(rate * max(0.02, 2 / frequency))
    phase = 2 * np.pi * frequency * run.time[:, None]
    starts, found = envelopes(phase, run.truth[:, columns], size, hop or size // 2)
    return (starts + size / 2) / rate, abs(found[:, 0]) / amplitude - 1


def tone(frequency, amplitude=50e-6):
    phase = np.random.default_rng([options.seed, round(frequency)]).uniform(0, 2 * np.pi)
    return hr.Grating(frequency=frequency, amplitude=amplitude, phase=phase)


def rms(values, axis=0):
    return np.sqrt(np.mean(np.abs(values) ** 2, axis=axis))


def worst_waves():
    """Pink noise, a recorded swipe, clicks and a chirp under each finger sliding."""
    kinds = {pink: (4.0, 1.5), clicks: (4.0, 1.5), chirp: (3.0, 0.3), swipe: (2.3, 0.7)}
    if SWIPE is None:
        print("  ../shared/data/swipe_40mm_s.npz is not here: no swipe")
        del kinds[swipe]
    found = {}
    for kind, finger in product(kinds, FINGERS):
        seconds, start = kinds[kind]
        found[kind.__name__, finger] = wave_error(play(kind(), seconds, finger, sliding), start)
    print("  " + ", ".join(f"{' '.join(key)} {a:.2g}/{b:.2g}" for key, (a, b) in found.items()))
    return np.max(list(found.values()), axis=0)


def draw_fingers(count):
    """Draw m 1-10 g, b .3-4, k 60-900, 3 of 4 behind skin of .1-.5 g, .5-12, 400-12000; log-uniform, seed 24; 0.5 N."""
    rng = np.random.default_rng(24)
    draw = lambda *bounds: tuple(float(np.exp(rng.uniform(*np.log(bound)))) for bound in bounds)  # noqa: E731
    for _ in range(count):
        phalanx = draw((1e-3, 1e-2), (0.3, 4.0), (60.0, 900.0))
        skin = draw((1e-4, 5e-4), (0.5, 12.0), (400.0, 12e3))
        yield ((*skin, *phalanx) if rng.random() < 0.75 else phalanx), 0.5


def random_fingers(count=24):
    """White noise under random fingers sliding."""
    errors = [wave_error(play(white(), 4.0, finger, sliding))[0] for finger in draw_fingers(count)]
    print("  " + " ".join(f"{each:.2g}" for each in sorted(errors)))
    return np.median(errors), sum(each > 5 for each in errors)


def tones():
    """Heavy finger sliding from 1 s on; rms from 2 s on, worst of 11 frequencies."""
    found = []
    for frequency in FREQUENCIES:
        run = play(tone(frequency), 6.0, "4H", sliding, lambda t: 1.0 * (t >= 1.0))
        time, error = tone_errors(run, frequency, 50e-6, EVERY)
        found.append(100 * rms(error[time > 2.0]))
    worst = np.max(found, axis=0)
    return worst[0], max(worst[1:])


def comb():
    """20 lines of 10 um, 20 to 400 Hz, heavy finger sliding from 1 s on: dB; finger, worse end; first half second."""
    order = np.arange(1, 21)
    phases = np.random.default_rng(options.seed).uniform(0, 2 * np.pi, 20)
    texture = hr.Grating(
        frequency=20.0, amplitude=10e-6, partials=[(n, 1.0, p) for n, p in zip(order, phases, strict=True)]
    )
    run = play(texture, 6.0, "4H", sliding, lambda t: 1.0 * (t >= 1.0))
    phase = 2 * np.pi * 20.0 * np.multiply.outer(run.time, order)
    starts, found = envelopes(phase, run.truth[:, EVERY], 500, 250)
    error = found / 10e-6 - np.exp(1j * phases)[:, None]
    late, first = (starts >= 7500), (starts >= 5000) & (starts <= 7000)
    settled, begin = (20 * np.log10(rms(error[which], (0, 1))) for which in (late, first))
    return settled[0], max(settled[1:]), begin[0]


def sweeps():
    """Position-locked carriers from 30 to 390 Hz, worst of four fingers at 10 mm, centre: 200, 400, 800, 1600 Hz/s."""
    worst, texture = [], hr.Grating(wavelength=1e-6, amplitude=50e-6)  # the finger moves by less than half a mm
    for sweep in (200.0, 400.0, 800.0, 1600.0):
        found = []
        for finger in FINGERS:
            path = lambda t, sweep=sweep: 10e-3 + 1e-6 * (30 * t + 0.5 * sweep * np.maximum(t - 1, 0) ** 2)  # noqa: E731
            run = play(texture, 1 + 360 / sweep, finger, path, lambda t: np.ones_like(t))
            starts, envelope = envelopes(2e6 * np.pi * run.position[:, None], run.truth[:, [CENTRE]], 100, 50)
            found.append(100 * rms(abs(envelope[starts >= 5000, 0, 0]) / 50e-6 - 1))
        worst.append(max(found))
    return tuple(worst)


def touch(amplitude=50e-6, fingers=tuple(FINGERS), **plate):
    """Touch at 1 s (load within 1 ms) and lift at 2 s, in 1 ms steps: peak %, centre and worse end."""
    peaks = []
    for frequency, finger, place in product(FREQUENCIES[5:], fingers, (0.0, 15e-3, 27.5e-3)):
        mechanics, load = FINGERS[finger]
        press = lambda t, load=load: load * np.clip((t - 1.0) / 1e-3, 1e-4, 1.0)  # noqa: E731
        touches = lambda t: 1.0 * ((t >= 1.0) & (t < 2.0))  # noqa: E731
        run = play(tone(frequency, amplitude), 3.0, (mechanics, press), place, touches, **plate)
        time, error = tone_errors(run, frequency, amplitude, [CENTRE, *ENDS], hop=round(1e-3 / run.time[1]))
        near = [(time > start - 0.02) & (time < start + 0.9) for start in (1.0, 2.0)]
        peaks.append(100 * abs(error[near[0] | near[1]]).max(axis=0))
    worst = np.max(peaks, axis=0)
    return worst[0], max(worst[1:])


def mean_error(texture, seconds, *finger):
    """Percent error of the centre's mean amplitude from 2 s on."""
    run = play(texture, seconds, *finger)
    late = run.time >= 2.0
    phase = 2 * np.pi * texture.frequency * run.time[late, None]
    found = envelopes(phase, run.truth[late][:, [CENTRE]], late.sum(), 1)[1]
    return float(100 * abs(abs(found[0, 0, 0]) / texture.amplitude - 1))


def small():
    """1 um at 20 Hz under .5 N over 40 s; .1 um at 20, 72, 261 Hz over 400 s (takes minutes)."""
    pressed = mean_error(tone(20.0, 1e-6), 42.0, (FINGERS["4H"][0], 0.5))
    return pressed, max(mean_error(tone(each, 1e-7), 402.0) for each in (20.0, 72.0, 261.0))


def wobble():
    """A held 1 um at 11 frequencies: true motion of the centre about its mean, in phase (um rms, 12 s)."""
    worst = 0.0
    for frequency in FREQUENCIES:
        run = play(tone(frequency, 1e-6), 14.0)
        size, hop = (round(5000 * length) for length in (max(0.02, 2 / frequency), max(0.01, 1 / frequency)))
        starts, found = envelopes(2 * np.pi * frequency * run.time[:, None], run.truth[:, [CENTRE]], size, hop)
        turned = found[starts >= 10000, 0, 0] * np.exp(-1j * tone(frequency).phase)
        worst = max(worst, 1e6 * turned.real.std())
    return (worst,)


def identification():
    """Worst of 6 seeds, half of them wrong plates, mode at 1250 Hz, Q 30, +-.1: m, I, k and b %, samples, Hz, %."""
    errors = []
    for seed in range(6):
        truth, mode = (WRONG if seed % 2 else TRUTH), (1250.0, 30, 0.1 * (-1) ** (seed // 2))
        found = identified(seed, bending=mode, substeps=12, **truth).estimates
        off = {name: abs(found[name].value - truth[name]) / truth[name] for name in TRUTH if name in found}
        damping = [off[name] for name in ("damping_1", "damping_2")]
        rest = [off[name] for name in ("mass", "inertia", "stiffness_1", "stiffness_2")]
        late = abs(found["delay"].value - truth["delay"])
        frequency = abs(found["bending_frequency"].value - mode[0])
        coil = abs(found["bending_coil"].value / mode[2] - 1)
        errors.append([100 * max(rest), 100 * max(damping), late, frequency, 100 * coil])
    return tuple(np.max(errors, axis=0))


ROWS = {  # what is measured; must; aim
    "white free, %": (lambda: wave_error(play(white(), 4.0)), (1, 2), (0.4, 0.7)),
    "white heavy sliding, %": (lambda: wave_error(play(white(), 4.0, "4H", sliding)), (1, 2), (0.5, 0.9)),
    "white wrong free, %": (lambda: wave_error(play(white(), 4.0, told=2, **WRONG)), (1.5, 4), (0.8, 2.3)),
    "white wrong sliding, %": (
        lambda: wave_error(play(white(), 4.0, "4H", sliding, told=2, **WRONG)), (1.5, 4), (0.8, 2.3)),
    "white 48 kHz blocks of 64 sliding, %": (
        lambda: wave_error(play(white(), 4.0, "4H", sliding, rate=48e3, block=64)), (1, 2), (0.5, 0.8)),
    "pink, swipe, clicks, chirp: worst finger, %": (worst_waves, (2, 4), (1.2, 2)),
    "24 random fingers: median %, above 5 %": (random_fingers, (1, 4), (0.7, 2)),
    "tones, heavy sliding, %": (tones, (0.2, 0.5), (0.1, 0.3)),
    "comb, dB; first .5 s": (comb, (-52, -45, -35), (-55, -50, -40)),
    "sweeps 200, 400, 800, 1600 Hz/s, %": (sweeps, (0.3, 0.3, 0.5, 1.0), (0.15, 0.15, 0.25, 0.5)),
    "touch and lift, %": (touch, (9, 22), (6, 12)),
    "touch wrong, %": (lambda: touch(**WRONG, told=1), (11, 22), ()),
    "touch blocks of 25, %": (lambda: touch(block=25), (40, 80), ()),
    "touch 48 kHz blocks of 64, %": (lambda: touch(rate=48e3, block=64), (40, 80), ()),
    "touch 10 um at .8 N, %": (lambda: touch(10e-6, ("2H", "4H")), (30, 70), ()),
    "small: 1 um pressed, .1 um, %": (small, (0.5, 1), ()),
    "wobble held, um": (wobble, (0.015,), (0.01,)),
    "identify m I k %, b %, delay, f Hz, coupling %": (identification, (0.05, 0.2, 0.002, 0.5, 5), ()),
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="inverse")
    parser.add_argument("--only", default="", help="rows that contain this text")
    parser.add_argument("--identified", action="store_true", help="identify each plate first and use its profile")
    parser.add_argument("--bending", type=lambda text: tuple(float(each) for each in text.split(",")))
    parser.add_argument("--seed", type=int, default=1)
    parser.parse_args(namespace=options)
    print(f"{options.method}, seed {options.seed}, bending {options.bending}: reached (must; aim)")
    for name, (measure, must, aim) in ROWS.items():
        if options.only in name:
            begin = perf_counter()
            try:
                reached = measure()
            except (hr.HapticError, ValueError) as error:
                print(f"{name}: {error}", flush=True)
                continue
            held = "held" if all(value <= bound for value, bound in zip(reached, must, strict=True)) else "MISSED"
            texts = (" / ".join(f"{each:.3g}" for each in values) or "-" for values in (reached, must, aim))
            print("{}: {} ({}; {})".format(name, *texts), held, f"{perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
