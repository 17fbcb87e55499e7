"""Cases of the accuracy suite on devices that modulate friction, and on the same texture on every kind of device.

Errors are those of friction (N), not of what is measured, on the simulated device at its defaults: a finger of 0.4 N
that slides at 80 mm/s, unless a case states otherwise.  Those of amplitude are of the ultrasonic mode (m), at level
"carrier"; its loop is that of the device, whatever method makes the friction.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from hapticrender.loop import registered, render
from hapticrender.plants.ultrasonic_surface import UltrasonicSurface
from hapticrender.protocols import Array, Flag, Sensed
from hapticrender.recordings.envelopes import amplitude_error, fit
from hapticrender.recordings.recording import Recording
from hapticrender.touch.finger import Finger, LoadCurve
from hapticrender.touch.grating import Grating
from hapticrender.touch.perception import VELOCITY_PER_FORCE
from hapticrender.touch.scene import Scene, Value

SCREEN, PLATE = "electroadhesion", "ultrasonic"
SPEED = 0.08  # m/s
FINGER = Finger.sliding(speed=SPEED, normal_load=0.4, mechanics="light")
FINGERS = (  # 0.2-1.5 N and 10-160 mm/s
    FINGER,
    Finger.sliding(speed=0.01, normal_load=0.2, mechanics="light"),
    Finger.sliding(speed=0.16, normal_load=1.5, mechanics="heavy"),
)
VELOCITY, EACH = 10e-3, 5e-3  # m/s: target of a tone, and of each of a few partials
LOADS = (0.2, 0.4, 1.0)  # N


def texture(frequencies: Sequence[float], velocity: float) -> Grating:
    """Partials (Hz) of one skin velocity (m/s) each, of random phases."""
    lowest = frequencies[0]
    phases = np.random.default_rng(1).uniform(0.0, 2 * np.pi, len(frequencies))
    partials = tuple((f / lowest, lowest / f, float(p)) for f, p in zip(frequencies, phases, strict=True))
    return Grating(frequency=lowest, velocity=velocity, partials=partials)


def play(
    device: str, method: str, touched: Grating, finger: Finger = FINGER, seconds: float = 2.0, **tables: Any
) -> Recording:
    """Render every band of the texture on the simulated device, with further tables of the scene."""
    scene = Scene(texture=touched, finger=finger, device=device, duration=seconds, keep_unfelt=True, **tables)
    return render(scene, method=method)


def worst(recording: Recording) -> float:
    """Largest rms error of any band over its target; infinite where nothing can be judged."""
    errors = [band["rms_error_friction"] for band in recording.summary()["bands"]]
    return max((float(error) for error in errors if error is not None), default=np.inf)


def line(signal: Array, rate: float, frequency: float, start: float) -> float:
    """Amplitude of a signal at a frequency (Hz) from `start` (s) on, by one least-squares fit."""
    kept = signal[int(start * rate) :]
    phase = 2 * np.pi * frequency * np.arange(len(kept))[:, None] / rate
    return float(abs(fit(phase[None], kept[None, :, None])[0][0, 0, 0]))


def tones(device: str, method: str) -> dict[str, float]:
    """8 tones, 20 to 400 Hz, under three fingers: worst rms error."""
    played = product((20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0), FINGERS)
    errors = (worst(play(device, method, Grating(frequency=f, velocity=VELOCITY), who)) for f, who in played)
    return {"error": max(errors)}


def comb(device: str, method: str) -> dict[str, float]:
    """20 bands, 20 to 400 Hz, from 1 s on: rms error of all amplitudes over their targets, as a ratio."""
    bands = texture(tuple(np.arange(20.0, 401.0, 20.0).tolist()), 4e-3)
    found = play(device, method, bands, Finger.sliding(SPEED, 0.8, mechanics="light"), 6.0).envelopes
    late = (found.start >= 1.0) & found.finite
    if not late.any():
        return {}
    return {"error": float(amplitude_error(found.achieved[late, 0].ravel(), found.target[late].ravel(), axis=0))}


def swipe(device: str, method: str) -> dict[str, float]:
    """Ridges of 0.5 and 1 mm under a finger that swipes at 3 Hz, +-50 mm/s, and one that goes to and fro."""
    fingers = {"swipe": Finger.swiping(frequency=3.0, speed=0.05, normal_load=0.4, mechanics="light"), "fro": FINGER}
    ridges = [Grating(wavelength=each, velocity=VELOCITY, speed=SPEED) for each in (0.5e-3, 1e-3)]
    return {
        name: max(worst(play(device, method, each, finger, 4.0)) for each in ridges) for name, finger in fingers.items()
    }


def area(method: str) -> dict[str, float]:
    """Area +-30 % and gaps of 0.5 to 3 um, all together, unknown to the controller: worst rms error of 3 partials."""
    three = texture((50.0, 120.0, 250.0), EACH)
    fingers = product((0.7, 1.0, 1.3), (0.5e-6, 1.5e-6, 3e-6))
    plants = ({"area_scale": scale, "gap_thickness": gap} for scale, gap in fingers)
    return {"error": max(worst(play(SCREEN, method, three, simulation=plant)) for plant in plants)}


def harmonic(method: str) -> dict[str, float]:
    """Second harmonic of friction over its first, from 2 s on, over 4 s: worst of three tones."""
    found = 0.0
    for frequency in (50.0, 120.0, 200.0):
        tone = Grating(frequency=frequency, velocity=VELOCITY)
        recording = play(SCREEN, method, tone, seconds=6.0)
        first, second = (line(recording.motion[:, 0], recording.rate, k * frequency, 2.0) for k in (1, 2))
        found = max(found, second / first)
    return {"second": found}


def velocity(method: str) -> dict[str, float]:
    """Five partials, 20 to 400 Hz, on every device kind: worst error of the mean skin velocity that they predict.

    A displacement X moves the skin with 2 pi f X, a friction F with 0.64 m/(N s) F [Grigorii et al. 2021].
    """
    frequencies, found = np.array([20.0, 50.0, 120.0, 250.0, 400.0]), {}
    for device in ("vt-plate", SCREEN, PLATE):
        recording = play(device, method, texture(frequencies.tolist(), EACH), seconds=4.0)
        lines = np.array([line(recording.motion[:, 0], recording.rate, each, 1.0) for each in frequencies])
        share = VELOCITY_PER_FORCE if recording.header.unit == "N" else 2 * np.pi * frequencies
        found[device] = float(abs(amplitude_error(share * lines, EACH)).max())
    return found


def surface(
    load: float | LoadCurve, touches: Sequence[tuple[float, float]] | None = None, **plant: Value
) -> UltrasonicSurface:
    """An ultrasonic surface at its defaults, but for `plant`, under a finger of so much load (N), or over time."""
    finger = Finger.sliding(speed=SPEED, normal_load=load, touches=touches, mechanics="light")
    scene = Scene(texture=Grating(frequency=100.0, amplitude=1e-6), finger=finger, device=PLATE, duration=2.0)
    renderer = registered("renderers", PLATE)()
    return renderer.plant(renderer.read(replace(scene, profile=plant), None), 0)  # type: ignore[no-any-return]


def driven(plate: UltrasonicSurface, amplitude: Array, load: float) -> Sensed:
    """Run a plate with the drive for amplitudes (m) under a sliding finger of so much load (N)."""
    p = plate.parameters
    ratio = p.friction_law.ratio(amplitude, load, SPEED)
    return plate.run((p.friction_coefficient * load * (ratio - p.bias))[:, None])


def held(plate: UltrasonicSurface, load: float, seconds: float) -> tuple[Sensed, Array]:
    """Run a plate at zero drive; what it measures, and the relative error of every sample's amplitude."""
    sensed = plate.run(np.zeros((int(seconds * plate.rate), 1)))
    target = float(plate.parameters.friction_law.amplitude(plate.parameters.bias, load, SPEED))
    return sensed, abs(amplitude_error(plate.amplitude, target))


def back(off: Array, within: float, rate: float) -> float:
    """Time (s) after which `off` stays `within`."""
    return float((np.flatnonzero(off > within).max(initial=-1) + 1) / rate)


def step(_: str) -> dict[str, float]:
    """Steps of the target amplitude, from rest and between levels, under three loads: until 5 % of it are left."""
    slowest, steps = 0.0, ((0.0, 1e-6), (0.5e-6, 1e-6), (1e-6, 2e-6), (0.5e-6, 3e-6), (3e-6, 0.5e-6))
    for (low, high), load in product(steps, LOADS):
        plate = surface(load)
        before = int(plate.rate / 4) if low else 0
        driven(plate, np.r_[np.full(before, low), np.full(int(plate.rate / 4), high)], load)
        slowest = max(slowest, back(abs(plate.amplitude[before:] - high), 0.05 * abs(high - low), plate.rate))
    return {"response": slowest}


def modulation(_: str) -> dict[str, float]:
    """30 % AM at 400 Hz of 1 um, from 0.5 s on, over 0.5 s: gain or loss, whichever way, as a ratio >= 1."""
    most = 1.0
    for load in LOADS:
        plate = surface(load)
        time = np.arange(int(plate.rate)) / plate.rate
        driven(plate, 1e-6 * (1 + 0.3 * np.cos(2 * np.pi * 400.0 * time)), load)
        gain = line(plate.amplitude, plate.rate, 400.0, 0.5) / 0.3e-6
        most = max(most, gain, 1 / gain)
    return {"gain": most}


def heat(_: str) -> dict[str, float]:
    """1 um while the plate warms by 10 K within 1 s, under a finger and lifted: largest error of any sample."""
    most = 0.0
    for load, touches in ((LOADS[0], None), (LOADS[-1], None), (LOADS[1], ((0.0, 0.2),))):
        plate = surface(load, touches, temperature_rise=10.0, temperature_time=1.0)
        target = np.full(int(2 * plate.rate), 1e-6)
        if touches:  # what is held while no finger is there
            target[:] = plate.parameters.friction_law.amplitude(plate.parameters.bias, load, SPEED)
        driven(plate, target, load)
        most = max(most, float(abs(amplitude_error(plate.amplitude, target))[int(0.3 * plate.rate) :].max()))
    return {"error": most}


def touch(_: str) -> dict[str, float]:
    """Touch and lift-off in a sample, twice, under three loads, the amplitude held: longest unlocked, back in 2 %."""
    unlocked = slowest = 0.0
    for load in LOADS:
        plate = surface(load, ((0.5, 1.0), (1.5, 2.0)))
        sensed, off = held(plate, load, 2.5)
        lost = (np.asarray(sensed.flags) & Flag.UNLOCKED) != 0
        for start in (0.5, 1.0, 1.5, 2.0):
            after = slice(int(start * plate.rate), int((start + 0.5) * plate.rate))
            slowest = max(slowest, back(off[after], 0.02, plate.rate))
            unlocked = max(unlocked, float(lost[after].sum()) / plate.rate)
    return {"unlocked": unlocked, "back": slowest}


def press(_: str) -> dict[str, float]:
    """Loads that come and go within a millisecond, the amplitude held: largest error in the mean over a sample."""
    most = 0.0
    for load in (0.2, 0.5, 1.5):
        plate = surface(((0.0, 0.3, 0.301, 0.6, 0.601, 1.0), (0.0, 0.0, load, load, 0.0, 0.0)))
        most = max(most, float(held(plate, load, 0.9)[1][int(0.2 * plate.rate) :].max()))
    return {"peak": most}


WITHOUT_METHOD = {f"{PLATE}: {case.__name__}": case for case in (step, modulation, heat, touch, press)}
CASES: dict[str, Callable[[str], dict[str, float]]] = {
    f"{SCREEN}: area": area,
    f"{SCREEN}: harmonic": harmonic,
    **{
        f"{device}: {case.__name__}": partial(case, device)
        for device in (SCREEN, PLATE)
        for case in (tones, comb, swipe)
    },
    **WITHOUT_METHOD,
    "every device: velocity": velocity,
}
