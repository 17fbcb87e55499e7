"""Count normal scenes that the supervisor stops, on simulated plates that are not quite those designed for.

Run: python -m benchmarks.false_stops [--plate stranger] [hours [first seed]]

A scene lasts 20 s: tones of 1 to 100 um, chords, combs of 20 bands, amplitude-modulated noise, gratings over position,
tones that saturate the drive; no finger, or one of Table 1 or of up to 10 g that rests, slides to and fro at up to
160 mm/s, or taps at up to 8 Hz, with 0.1 to 1.5 N (one in seven: 3 to 5 N) that rise within 1 to 50 ms.  Half of the
plates are off by up to 5 % (damping 20 %, sensor gains 2 %, half of them a sample later), a third bend at 1.1 to
1.4 kHz.  Printed: every stop and every damper that was turned down, with its seed and with whether the scene rings
unsupervised (at the limit of the drive, or a coil's force beyond 480 Hz above 0.4 N rms over 0.2 s), and the sum.  The
stranger's plate (`tests/strangers_plate.py`) shares no code with the library's, is not compiled with the loop (some 30
times slower), and reports contact 5 ms late.
"""

import argparse
import warnings
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfiltfilt

import hapticrender as hr
from hapticrender.drivers.simulated import SimulatedDriver
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.touch.mechanics import HEAVY, LIGHT, FingerMechanics
from tests.strangers_plate import StrangersPlate

SECONDS = 20.0
BEYOND, MOST = butter(8, 480.0, "highpass", fs=5000.0, output="sos"), 0.4  # Hz, N rms: more is ringing


class Tones:
    """A sum of fixed tones; `modulation` (Hz) makes a waveform of them, whose envelopes the controller estimates."""

    def __init__(self, frequency, amplitude, phase, modulation=0.0):
        self.frequency, self.amplitude, self.phase, self.modulation = frequency, amplitude, phase, modulation

    def bands(self, rate):
        envelope = None if self.modulation else self.amplitude + 0j
        return hr.Bands(frequency=self.frequency, wavenumber=0 * self.frequency, phase=self.phase, envelope=envelope)

    def waveform(self, time, position):
        turns = np.outer(time, 2 * np.pi * self.frequency) + self.phase
        swell = 0.6 + 0.4 * np.sin(2 * np.pi * self.modulation * np.asarray(time))
        return swell * (self.amplitude * np.cos(turns)).sum(axis=1)


def spaced(rng, count):
    """Frequencies (Hz) from 20 to 400, at least 20 Hz apart."""
    return 20.0 + 380.0 / count * (np.arange(count) + rng.uniform(0.0, 0.45, count))


def random_texture(rng, finger):
    """Return a texture, with a finger also one over position."""
    kind = rng.choice(["tone", "tone", "chord", "comb", "modulated", "saturating", *["grating"] * 3 * finger])
    amplitude = 1e-6 * 10 ** rng.uniform(0.0, 2.0)
    if kind == "grating":
        return hr.Grating(wavelength=1e-3 * 10 ** rng.uniform(-0.4, 0.6), amplitude=min(amplitude, 40e-6))
    if kind == "saturating":
        return hr.Grating(frequency=400.0, amplitude=rng.uniform(240e-6, 281e-6))
    if kind == "tone":
        return hr.Grating(frequency=20.0 * 20 ** rng.uniform(), amplitude=amplitude)
    count = {"chord": int(rng.integers(2, 7)), "comb": 20, "modulated": int(rng.integers(1, 5))}[kind]
    each = np.full(count, amplitude / count)
    phase = rng.uniform(0.0, 2 * np.pi, count)
    return Tones(spaced(rng, count), each, phase, rng.uniform(0.5, 4.0) if kind == "modulated" else 0.0)


def random_finger(rng):
    """Return a finger that comes and goes."""
    mechanics = [HEAVY, LIGHT, None][rng.integers(3)] or FingerMechanics(
        order=2, mass=rng.uniform(1e-3, 10e-3), damping=rng.uniform(0.5, 12.0), stiffness=rng.uniform(0.0, 12e3)
    )
    rise, load = 10 ** rng.uniform(-3.0, -1.3), rng.uniform(0.1, 1.5) if rng.uniform() > 0.15 else rng.uniform(3.0, 5.0)
    taps = rng.uniform() < 0.3
    period = 1 / rng.uniform(1.0, 8.0) if taps else rng.uniform(1.0, 4.0)
    on = 0.5 + period * np.arange(int((SECONDS - 1.0) / period))
    off = on + rng.uniform(0.4, 0.8) * period
    times = np.ravel(np.column_stack([on, on + min(rise, 0.2 * period), off - 1e-3, off]))
    curve = (tuple(times), tuple(np.tile([1e-3, load, load, 1e-3], len(on))))
    motion = {"normal_load": curve, "touches": tuple(zip(on, off, strict=True)), "mechanics": mechanics}
    if rng.uniform() < 0.4:
        return hr.Finger.still(position=rng.uniform(-0.05, 0.05), **motion)
    return hr.Finger.sliding(speed=rng.uniform(0.01, 0.16), span=rng.uniform(0.02, 0.08), **motion)


def random_plate(rng):
    """Return what differs on the simulated plate."""
    plate, changes = PlateParameters(), {}
    if rng.uniform() < 0.5:
        for name in ("mass", "inertia", "stiffness_1", "stiffness_2", "damping_1", "damping_2"):
            spread = 0.2 if "damping" in name else 0.05
            changes[name] = getattr(plate, name) * rng.uniform(1 - spread, 1 + spread)
        changes |= {name: rng.uniform(0.98, 1.02) for name in ("sensor_gain_1", "sensor_gain_2")}
        changes["delay"] = int(rng.integers(1, 3))
    if rng.uniform() < 1 / 3:
        changes |= {"bending_frequency": rng.uniform(1100.0, 1400.0), "bending_coil": rng.choice([-0.1, 0.1])}
    return changes


def own_plate(parameters, finger, seed):
    """Return a driver of the library's plate that shows nothing of it."""
    return Hidden(Plate(parameters, finger, seed))


def strangers_plate(parameters, finger, seed):
    """Return the stranger's plate, which is a driver itself."""
    return StrangersPlate.of(parameters, finger, seed=seed)


def random_scene(seed, seconds=SECONDS, plate=own_plate):
    """Return the scene of a seed, and a driver of its plate; the controller assumes the paper's plate."""
    rng = np.random.default_rng(seed)
    finger = rng.uniform() < 0.8
    scene = hr.Scene(
        texture=random_texture(rng, finger),
        finger=random_finger(rng) if finger else hr.Finger.absent(),
        duration=seconds,
        keep_unfelt=True,
    )
    return scene, plate(PlateParameters(**random_plate(rng)), scene.finger, seed)


class Hidden:
    """A driver that shows no parameters of its simulated plate, but closes its loop in compiled code."""

    probe, block, delay, drive_channels, sensed_channels = False, 1, 1, 2, 2

    def __init__(self, plate):
        self.driver, self.rate = SimulatedDriver(plate), plate.rate
        self.device_loop, self.play = self.driver.device_loop, self.driver.play

    def __enter__(self):
        self.driver.__enter__()
        return self

    def __exit__(self, *exc):
        self.driver.__exit__(*exc)


def run(scene, driver):
    """Render a scene; the error that stopped it, else None, and the controller."""
    rendering = hr.prepare(scene, driver=driver)
    made = []

    def controller():
        made.append(rendering.controller())
        return made[-1]

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hr.run(replace(rendering, controller=controller))
    except hr.DeviceFault as error:
        return error, made[-1]
    return None, made[-1]


def ringing(drive):
    """Whether the force of a coil (drive in A, shape (n, 2)) beyond 480 Hz is more than `MOST` over 0.2 s."""
    force = sosfiltfilt(BEYOND, PlateParameters().force_constant * drive, axis=0)
    return uniform_filter1d(force**2, 1000, axis=0).max() > MOST**2


def rings(seed, plate):
    """Whether a scene rings without supervision, or drives its plate to the limit."""
    scene, driver = random_scene(seed, plate=plate)
    rendering = hr.prepare(scene, driver=driver)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recording = hr.run(replace(rendering, controller=lambda: rendering.controller().controller))
    return ringing(recording.drive) or abs(recording.drive).max() > 0.95 * rendering.model.drive_limit


def play(hours, seed, plate):
    """Play scenes from a seed on and print what was stopped."""
    played, stops, turned, needless, refused = 0.0, 0, 0, 0, 0
    while played < 3600 * hours:
        try:
            error, controller = run(*random_scene(seed, plate=plate))
        except ValueError:  # more than the device can do
            refused += 1
        else:
            played += SECONDS
            stops, turned = stops + (error is not None), turned + (controller.damper_scale < 1.0)
            if error is not None or controller.damper_scale < 1.0:
                rightly = rings(seed, plate)
                needless += not rightly
                print(
                    f"seed {seed}: damper {controller.damper_scale:g}; {error or 'not stopped'}; unsupervised "
                    f"{'rings' if rightly else 'stable'}",
                    flush=True,
                )
        seed += 1
        if seed % 50 == 0:
            print(
                f"to seed {seed}: {played / 3600:.2f} h, {stops} stops, {turned} turned down, {needless} needlessly",
                flush=True,
            )
    print(f"{played / 3600:.2f} h, {stops} stopped, {turned} turned down, {needless} needlessly, {refused} refused")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plate", choices=("own", "stranger"), default="own")
    parser.add_argument("hours", type=float, nargs="?", default=0.1)
    parser.add_argument("seed", type=int, nargs="?", default=0, help="of the first scene")
    given = parser.parse_args()
    play(given.hours, given.seed, own_plate if given.plate == "own" else strangers_plate)


if __name__ == "__main__":
    main()
