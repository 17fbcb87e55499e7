"""Cases of the accuracy suite on the plate of Grigorii et al. 2021, at its default electronics and 5 kHz.

Errors are relative amplitude errors of the true motion, by least squares with offset and slope over windows of
max(20 ms, 2/f).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from hapticrender.bands import Bands
from hapticrender.control.methods import method_named
from hapticrender.loop import registered
from hapticrender.plants.identify import identify
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.protocols import Array, Controller
from hapticrender.recordings.envelopes import amplitude_error, fit
from hapticrender.touch.finger import Finger
from hapticrender.touch.mechanics import HEAVY, HEAVY_SECOND, LIGHT, LIGHT_SECOND, FingerMechanics
from hapticrender.touch.motion import Sampled, Still, TriangleMotion

RATE = 5000.0
FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 143.0, 170.0, 178.0, 189.0, 261.0, 400.0)
AMPLITUDE = 50e-6  # m
TABLE_1 = ((LIGHT_SECOND, 0.3), (HEAVY_SECOND, 0.8), (LIGHT, 0.3), (HEAVY, 0.8))  # mechanics, load in N
PLACES = (0.0, 15e-3, 27.5e-3)  # m
SLIDING = Finger(TriangleMotion(0.1, 0.05), normal_load=0.8, touches=((1.0, 1000.0),), mechanics=HEAVY)
IDENTIFIED = {"m, I, k": ("mass", "inertia", "stiffness_1", "stiffness_2"), "b": ("damping_1", "damping_2")}


class Run(NamedTuple):
    """Motion (m) of centre and ends, finger position (m) and targets (m) of a closed loop."""

    bands: Bands
    motion: Array
    position: Array
    target: Array

    def envelopes(self, length: float, hop: float) -> tuple[Array, Array]:
        """Middle times (s, shape (w,)) and envelopes (m, shape (w, places, bands)) of windows of `length` (s)."""
        size = int(round(length * RATE))
        start = np.arange(0, len(self.motion) - size + 1, int(round(hop * RATE)))
        index = start[:, None] + np.arange(size)
        phase = self.bands.carrier_phase(np.arange(len(self.motion)) / RATE, self.position)
        return (start + size / 2) / RATE, fit(phase[index], self.motion[index])[0]

    def errors(self, amplitude: float) -> tuple[Array, Array]:
        """Middle times (s) and relative amplitude errors (w, places) of the first band."""
        length = window(float(self.bands.frequency[0]) or np.inf)
        time, envelope = self.envelopes(length, length / 2)
        return time, amplitude_error(envelope[:, :, 0], amplitude)

    def mean_error(self, amplitude: float, start: float) -> Array:
        """Relative error (places,) of the amplitude over everything from `start` (s) on."""
        n = np.arange(int(start * RATE), len(self.motion))
        phase = 2 * np.pi * np.mod(self.bands.frequency[0] * n / RATE, 1.0)[:, None]
        return abs(amplitude_error(fit(phase[None], self.motion[None, n])[0][0, :, 0], amplitude))


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A method, the plate it runs on, and the plate it was designed for."""

    method: str
    plate: PlateParameters = PlateParameters()
    known: PlateParameters | None = None

    def design(self, bands: Bands) -> Controller:
        """Design the controller of the method for the plate that it is given."""
        known = self.known or self.plate
        return method_named(self.method).design(known.device_model(RATE, known.delay), bands)

    def play(
        self, bands: Bands, seconds: float, finger: Finger | None = None, waveform: Array | None = None, seed: int = 0
    ) -> Run:
        """Close the loop for so many seconds; `waveform` (m) is the reference where the bands have no envelopes."""
        samples = int(round(seconds * RATE))
        plate = Plate(self.plate, finger or Finger.absent(), seed)
        zero = np.zeros(samples)
        controller = self.design(bands)
        lookahead = getattr(controller, "lookahead", 0)
        ahead = np.append(waveform[lookahead:], zero)[:samples] if waveform is not None else zero
        _, target, _, sensed = plate.closed_loop(controller, ahead)
        return Run(bands, plate.motion[:, :3], zero if sensed.position is None else sensed.position, target)


def window(frequency: float) -> float:
    """Length (s) of a window for a carrier of `frequency` (Hz)."""
    return max(0.02, 2 / frequency)


def tones(frequencies: Iterable[float], amplitude: float, phase: Array | float = 0.0) -> Bands:
    """Fixed carriers (Hz) of equal amplitude (m)."""
    frequency = np.array(list(frequencies), float)
    zero = np.zeros_like(frequency)
    envelope = amplitude * np.exp(1j * phase) * np.ones_like(frequency)
    return Bands(frequency=frequency, wavenumber=zero, phase=zero, envelope=envelope)


def rms(values: Array) -> Array:
    """Root mean square over the first axis."""
    return np.sqrt(np.mean(np.abs(values) ** 2, axis=0))


def means(bench: Bench, seconds: float, start: float) -> Array:
    """Errors of the mean on the free plate from `start` (s) on, shape (frequencies, places)."""
    runs = (bench.play(tones([each], AMPLITUDE), seconds) for each in FREQUENCIES)
    return np.array([run.mean_error(AMPLITUDE, start) for run in runs])


def free(bench: Bench) -> dict[str, float]:
    """Free plate, ends included, averaged over 20 s of noise."""
    error = means(bench, 22.0, 2.0)
    return {"error": float(error.max()), "centre": float(error[:, 0].max())}


def late(bench: Bench) -> dict[str, float]:
    """A known delay of 60 ms: free plate, centre."""
    slow = replace(bench, plate=replace(bench.plate, delay=int(0.06 * RATE)))
    return {"error": float(means(slow, 12.0, 8.0)[:, 0].max())}


def slide(bench: Bench) -> dict[str, float]:
    """Heavy finger sliding +-25 mm at 100 mm/s, worst of 11 frequencies."""
    found = []
    for frequency in FREQUENCIES:
        time, error = bench.play(tones([frequency], AMPLITUDE), 6.0, SLIDING).errors(AMPLITUDE)
        found.append(rms(error[time > 2.0]))
    worst = np.max(found, axis=0)
    return {"centre": float(worst[0]), "ends": float(worst[1:].max())}


def touch(
    bench: Bench, fingers: Iterable[tuple[FingerMechanics, float]] = TABLE_1, places: Iterable[float] = PLACES
) -> dict[str, float]:
    """Touch in 1 ms and lift-off in a sample at 143-400 Hz, worst finger and place: centre's peak, return, rest."""
    peak = back = left = 0.0
    for frequency, (mechanics, load), place in product(FREQUENCIES[5:], fingers, places):
        pressing = ((0.0, 1.0, 1.001), (1e-4, 1e-4, load))
        finger = Finger(Still(place), normal_load=pressing, touches=((1.0, 2.0),), mechanics=mechanics)
        time, error = bench.play(tones([frequency], AMPLITUDE), 3.0, finger).errors(AMPLITUDE)
        centre = abs(error[:, 0])
        for start in (1.0, 2.0):
            after = (time > start - 0.02) & (time < start + 0.9)
            peak = max(peak, float(centre[after].max()))
            back = max(back, float(time[after & (centre > 0.05)].max(initial=start) - start))
            left = max(left, float(centre[after & (time > start + 0.6)].max()))
    return {"peak": peak, "back": back, "left": left}


def chirp(bench: Bench) -> dict[str, float]:
    """Carriers sweeping from 30 to 390 Hz, worst of the Table 1 fingers at 10 mm: rms at the centre."""
    found = {}
    wavelength, one = 1e-6, np.ones(1)  # m: the finger moves less than half a millimetre, its carrier sweeps
    bands = Bands(frequency=0 * one, wavenumber=one / wavelength, phase=0 * one, envelope=AMPLITUDE * (one + 0j))
    for sweep in (200.0, 400.0, 800.0, 1600.0):
        seconds, worst = 1.0 + 360.0 / sweep, 0.0
        time = np.arange(int(seconds * RATE) + 2) / RATE
        turns = 30.0 * time + 0.5 * sweep * np.maximum(time - 1.0, 0.0) ** 2
        path = Sampled(tuple(10e-3 + wavelength * turns), RATE)
        for mechanics, load in TABLE_1:
            finger = Finger(path, normal_load=load, mechanics=mechanics)
            at, error = bench.play(bands, seconds, finger).errors(AMPLITUDE)
            worst = max(worst, float(rms(error[at > 1.0, 0])))
        found[f"{sweep:.0f} Hz/s"] = worst
    return found


def comb(bench: Bench) -> dict[str, float]:
    """20 bands, 20 to 400 Hz, under a sliding heavy finger, from 0.5 s after contact: error over target, as a ratio."""
    frequency, found = np.arange(20.0, 401.0, 20.0), []
    for seed in range(2):
        phase = np.random.default_rng(seed + 1).uniform(0, 2 * np.pi, frequency.size)
        bands = tones(frequency, 10e-6, phase)
        time, envelope = bench.play(bands, 9.0, SLIDING, seed=seed).envelopes(0.1, 0.05)
        error = envelope[time > 1.55] - bands.envelope
        found.append(np.sqrt((abs(error) ** 2).sum(axis=-1).mean(axis=0)) / 10e-6 / np.sqrt(frequency.size))
    worst = np.max(found, axis=0)
    return {"centre": float(worst[0]), "ends": float(worst[1:].max())}


def press(bench: Bench) -> dict[str, float]:
    """0.5 N press on 1 um at 20 Hz, and a target of 0.1 um: error of the mean over 40 s."""
    finger = Finger.still(normal_load=0.5, mechanics=HEAVY)
    pressed = bench.play(tones([20.0], 1e-6), 82.0, finger).mean_error(1e-6, 2.0)
    small = [bench.play(tones([each], 1e-7), 402.0).mean_error(1e-7, 2.0)[0] for each in (20.0, 72.0, 261.0)]
    return {"pressed": float(pressed[0]), "0.1 um": float(max(small))}


def wobble(bench: Bench) -> dict[str, float]:
    """True motion of a held 1 um about its mean (m rms, in phase), and a 30 % AM at 5 Hz of 50 um."""
    held = tracking = 0.0
    for frequency in FREQUENCIES:
        time, envelope = bench.play(tones([frequency], 1e-6), 42.0).envelopes(
            window(frequency), max(0.01, 1 / frequency)
        )
        centre = envelope[time > 2.0, 0, 0]
        held = max(held, float((centre - centre.mean()).real.std()))
    for frequency in (47.0, 111.0, 178.0, 261.0):
        time = np.arange(int(6 * RATE)) / RATE
        modulated = AMPLITUDE * (1 + 0.3 * np.cos(2 * np.pi * 5.0 * time)) * np.cos(2 * np.pi * frequency * time)
        run = bench.play(replace(tones([frequency], 1.0), envelope=None), 6.0, waveform=modulated)
        length = int(RATE * window(frequency)) / RATE
        at, envelope = run.envelopes(length, length / 2)
        target = (run.target * np.exp(2j * np.pi * frequency * time)[:, None]).real
        reference = run._replace(motion=target).envelopes(length, length / 2)[1]
        late = at > 2.0
        tracking = max(tracking, float(amplitude_error(envelope[late, 0, 0], reference[late, 0, 0], axis=0)))
    return {"held": held, "AM": tracking}


def wrong(bench: Bench) -> dict[str, float]:
    """The plate is not the one designed for: k +5, m -5, b -20 %, gains +-2 %, delay +1 sample, all together."""
    factors = {"stiffness": 1.05, "mass": 0.95, "inertia": 0.95, "damping": 0.8}
    names = ("stiffness_1", "stiffness_2", "mass", "inertia", "damping_1", "damping_2")
    changed: dict[str, Any] = {name: factors[name.partition("_")[0]] * getattr(bench.plate, name) for name in names}
    gains: dict[str, Any] = {"sensor_gain_1": 1.02, "sensor_gain_2": 0.98}
    other = replace(
        bench, plate=replace(bench.plate, delay=bench.plate.delay + 1, **gains, **changed), known=bench.plate
    )
    touched = touch(other, TABLE_1[3:], PLACES[1:2])
    return {"free": free(other)["centre"], "touch": touched["peak"], "slide": slide(other)["centre"]}


def overload(bench: Bench) -> dict[str, float]:
    """2 s of 1 mm at 400 Hz (10.6 A of 3 A), then 100 um: time until within 5 %, third harmonic before."""
    zero, plate = np.zeros(int(4 * RATE)), Plate(bench.plate, Finger.absent())
    controller, softer = (bench.design(tones([400.0], amplitude)) for amplitude in (1e-3, 100e-6))
    plate.closed_loop(controller, zero[: len(zero) // 2])
    loud = plate.motion[:, :3]
    controller.setpoints[:] = softer.setpoints  # type: ignore[attr-defined]
    plate.closed_loop(controller, zero)
    n = np.arange(len(loud))[-int(RATE) :]
    third = abs(2 * np.mean(loud[n, 0] * np.exp(-2j * np.pi * 1200.0 * n / RATE)))
    time, error = Run(tones([400.0], 1.0), plate.motion[:, :3], zero, zero).errors(100e-6)
    return {"back": float(time[abs(error[:, 0]) > 0.05].max(initial=0.0)), "third": float(third)}


def identified(bench: Bench) -> dict[str, float]:
    """Identification of the free plate within 1 s at about 100 um, whatever the method: worst error over 4 seeds."""
    worst = {"m, I, k": 0.0, "b": 0.0, "delay": 0.0}
    for seed in range(4):
        with registered("drivers", "simulated")(Plate(bench.plate, Finger.absent(), seed)) as driver:
            found = identify(driver, bench.plate)
        for kind, names in IDENTIFIED.items():
            errors = [abs(getattr(found.parameters, name) / getattr(bench.plate, name) - 1.0) for name in names]
            worst[kind] = max(worst[kind], *errors)
        worst["delay"] = max(worst["delay"], abs(found.estimates["delay"].value - bench.plate.delay))
    return worst


CASES: dict[str, Callable[[str], dict[str, float]]] = {
    case.__name__: lambda method, case=case: case(Bench(method=method))  # type: ignore[misc]
    for case in (free, slide, touch, chirp, comb, press, wobble, wrong, late, overload, identified)
}
