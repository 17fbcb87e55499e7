"""Every figure that the library claims about its speed, as a ratio to its reference in the same run."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np

import hapticrender as hr
from benchmarks import startup
from benchmarks.native import NaivePolar, TunedBlock
from benchmarks.numpy_loop import NumpyPlate, NumpyPolar
from benchmarks.numpy_loop import run as numpy_run
from benchmarks.peers import BLOCK, ScipyLockIn
from benchmarks.timing import Figure, compare, cores
from examples.your_own_driver import MyPlate
from hapticrender.bands import Bands
from hapticrender.control.controller import BankController
from hapticrender.control.demodulator import Demodulator
from hapticrender.control.methods import METHODS, Polar
from hapticrender.jit import addresses
from hapticrender.plants.plate import Plate, PlateParameters
from hapticrender.sweep import sweep
from hapticrender.touch.mechanics import HEAVY

CARD = 48_000.0  # Hz: a sound card
FEW = 400  # samples of the numpy loop
DEVICES = ("vt-plate", "electroadhesion", "ultrasonic", "hybrid")
SWEPT = 12  # scenes a device of the sweep on two cores
SLIDING = hr.Finger.sliding(speed=0.1, span=0.05, normal_load=0.8, mechanics=HEAVY)
FINGERS = {"finger at rest": (hr.Finger.still(normal_load=0.5, mechanics=HEAVY), 0.0, 465.0, 350.0),
           "sliding, with noise": (SLIDING, 1e-6, 315.0, 220.0)}  # fmt: skip


def comb(bands: int, amplitude: float, highest: float = 400.0) -> Bands:
    """Fixed carriers from 20 Hz to `highest`, of equal amplitude."""
    return Bands(
        frequency=np.linspace(20.0, highest, bands),
        wavenumber=np.zeros(bands),
        phase=np.linspace(0.0, 5.0, bands),
        envelope=np.full(bands, amplitude * np.exp(0.5j)),
    )


def in_blocks(bands: int) -> BankController:
    """Make the law by bands on a sound card, 64 samples a block.

    Designed for 8 bands and then given as many as are timed: the design's checks take minutes with 512 bands, and are
    not what is measured.
    """
    model = replace(PlateParameters(rate=CARD, delay=BLOCK).device_model(CARD, BLOCK), block=BLOCK, drive_step=1e-12)
    few: Any = METHODS["h2"].design(model, comb(8, 1e-6))
    settings = {name: few.settings[name] for name in few.settings.dtype.names} | {"observer": 1e-4}
    return BankController("h2", few.step, settings, comb(bands, 1e-9, 1000.0), history=int(few.state["history"][0]))


def step_on(controller: BankController, sensed: np.ndarray) -> Callable[[], int]:
    """Return the compiled step on the sensors' samples, with memory of its own, as a sound card's callback plays it."""
    samples, nothing = len(sensed), np.zeros(len(sensed))
    target = np.zeros((samples // controller.block, controller.n_bands), complex)
    arrays = {"drive": np.zeros((samples, controller.channels)), "target": target, "flags": np.zeros(samples, np.int64)}
    arrays |= {"sensed": sensed, "position": nothing, "waveform": nothing}
    signals = addresses(**arrays)

    def step(held: object = arrays) -> int:
        return controller.step(controller.state.ctypes.data, signals.ctypes.data, 0, samples)

    return step


def blocks(bands: int, pairs: int) -> Iterator[Figure]:
    """The law by bands in blocks of 64 on two channels at 48 kHz, over C tuned by hand; outputs are compared."""
    controller, count = in_blocks(bands), max(20, 10_000 // bands)
    samples = BLOCK * count
    sensed, nothing = 1e-9 * np.random.default_rng(0).standard_normal((samples, 2)), np.zeros(samples)
    controller.run(sensed, nothing, nothing)
    tuned = TunedBlock(controller)
    drive = controller.run(sensed, nothing, nothing)[0]
    off = abs(tuned.run(sensed) - drive).max()
    if not off <= 1e-6 * abs(drive).max():
        raise RuntimeError(f"blocks, {bands} bands: drives differ by {off} of {abs(drive).max()} A")
    ours, _, ratio = compare(step_on(controller, sensed), lambda: tuned.run(sensed), pairs)
    share = 100 * ours * CARD / samples
    note = f"{ours / samples / bands / 2 * 1e9:.2f} ns a band-sample and channel, {share:.2g} % of a core"
    yield Figure(f"law by bands, blocks of 64, {bands} bands: time over", 1 / ratio, "x", 1.1,
                 2.5 if bands == 8 else 2.0, False, "C tuned by hand (native/block.c)", note)  # fmt: skip


def closed_loop(what: str, seconds: float, pairs: int) -> Iterator[Figure]:
    """Plate, finger and the law by bands with 8 bands, times faster than the numpy loop of the paper's method."""
    finger, noise, target, floor = FINGERS[what]
    parameters = PlateParameters(sensor_noise=noise)
    bands = comb(8, 1e-6)
    controller = METHODS["h2"].design(parameters.device_model(parameters.rate, parameters.delay), bands)
    plate, silence = Plate(parameters, finger), np.zeros(int(seconds * parameters.rate))
    loop, free = NumpyPolar(bands.frequency, bands.phase, bands.envelope), NumpyPlate()
    ours, theirs, _ = compare(lambda: plate.closed_loop(controller, silence), lambda: numpy_run(loop, free, FEW), pairs)
    ratio = theirs / FEW / (ours / len(silence))
    yield Figure(f"closed loop, law by bands, 8 bands, {what}: times faster than", ratio, "x", target, floor, True,
                 "the numpy loop", f"{seconds / ours:.0f} simulated seconds a second")  # fmt: skip


def waveform_law(seconds: float, pairs: int) -> Iterator[Figure]:
    """The waveform law with 8 bands under a sliding finger, over the law by bands, each in closed loop with a plate."""
    parameters, works = PlateParameters(), []
    silence = np.zeros(int(seconds * parameters.rate))
    for method in ("inverse", "h2"):
        controller = METHODS[method].design(parameters.device_model(parameters.rate, 1), comb(8, 1e-6))
        works.append(partial(Plate(parameters, SLIDING).closed_loop, controller, silence))
    ours, _, ratio = compare(*works, pairs)
    yield Figure("closed loop, waveform law, 8 bands, sliding: time over", 1 / ratio, "x", 10.0, 20.0, False,
                 "the law by bands", f"{ours / len(silence) * 1e6:.2f} us a sample, plate included")  # fmt: skip


def supervision(seconds: float, pairs: int) -> Iterator[Figure]:
    """Both laws with 8 bands under a sliding finger, supervised over bare, each in closed loop with a plate."""
    parameters = PlateParameters(sensor_noise=1e-6)
    lines = tuple((n, 1.0, float(n)) for n in (1, 3, 5, 8, 11, 14, 17, 20))
    texture, silence = hr.Grating(frequency=20.0, amplitude=2e-6, partials=lines), np.zeros(int(seconds * 5e3))
    for method in ("inverse", "h2"):
        scene = hr.Scene(texture=texture, finger=SLIDING, duration=1.0, method=method, keep_unfelt=True)
        rendering = hr.prepare(scene)
        both: tuple[Any, Any] = (rendering.controller(), rendering.controller().controller)  # type: ignore[attr-defined]
        works = [partial(Plate(parameters, SLIDING, 1).closed_loop, controller, silence) for controller in both]
        ours, theirs, ratio = compare(*works, pairs)
        if both[0].fault is not None:
            raise RuntimeError(f"supervision of {method}: stopped, {both[0].fault.text}")
        note = f"{1e9 * (ours - theirs) / len(silence):.0f} ns a sample, plate included"
        yield Figure(f"supervised {method}, 8 bands, sliding: time over", 1 / ratio, "x", 1.15, 1.15, False,
                     "the same, not supervised", note)  # fmt: skip


def python_driver(seconds: float, pairs: int) -> Iterator[Figure]:
    """Runs on a driver in Python, sample by sample, over the time that its signals last; and the driver alone."""
    noise = hr.Recorded(samples=np.random.default_rng(1).standard_normal(5000), rate=5000.0, amplitude=5e-6)
    for name, texture in {"": hr.Grating(frequency=72.0, amplitude=10e-6), ", recording": noise}.items():
        scene = hr.Scene(texture=texture, duration=seconds)
        rendering, drive = hr.prepare(scene, driver=MyPlate()), np.zeros((1, 2))

        def alone(rendering: Any = rendering, drive: Any = drive) -> None:
            for _ in range(rendering.samples):
                rendering.driver.play(drive)

        ours, theirs, _ = compare(partial(hr.run, rendering), alone, pairs)
        ours_us, theirs_us = (1e6 * each / rendering.samples for each in (ours, theirs))
        note = f"{ours_us:.0f} us a sample, {theirs_us:.0f} of them its `play`"
        yield Figure(f"driver in Python, a sample a block{name}: time over", ours / seconds, "x", 0.3, 0.6, False,
                     "that of its signals, 5 kHz", note)  # fmt: skip


def paper(pairs: int) -> Iterator[Figure]:
    """The paper's method, 64 bands, times faster than naive C in double; outputs are compared."""
    bands, parameters, samples = comb(64, 1e-6), PlateParameters(), 4096
    bands = replace(bands, frequency=np.round(2 * bands.frequency) / 2)  # the look-up table has a grid of 0.5 Hz
    model = replace(parameters.device_model(parameters.rate, 1), drive_limit=1e9)
    controller = Polar(bandwidths=(5.0, 10.0)).design(model, bands)
    naive = NaivePolar(NumpyPolar(bands.frequency, bands.phase, bands.envelope))
    sensed, nothing = 1e-6 * np.random.default_rng(0).standard_normal((samples, 2)), np.zeros(samples)
    drive, expected = controller.run(sensed, nothing, nothing)[0], naive.run(sensed)
    if not abs(drive - expected).max() <= 1e-8 * abs(expected).max():
        raise RuntimeError(f"paper's method: drives differ by {abs(drive - expected).max()} A")
    ours, theirs, ratio = compare(step_on(controller, sensed), lambda: naive.run(sensed), pairs)
    note = f"{ours / samples / 128 * 1e9:.2f} against {theirs / samples / 128 * 1e9:.1f} ns a band-sample and channel"
    yield Figure("paper's method, 64 bands: times faster than", ratio, "x", 62.0, 10.0, True, "naive C, double", note)


def demodulation(bands: int, pairs: int) -> Iterator[Figure]:
    """Demodulation alone, 2 channels in blocks of 64, against scipy's filters; outputs are compared."""
    frequency, count = np.linspace(20.0, 2000.0, bands), max(8, 4000 // bands)
    signal = np.random.default_rng(0).standard_normal((count * BLOCK, 2))
    parts = np.split(signal, count)
    ours, filters = Demodulator(frequency, 5.0, CARD, channels=2), ScipyLockIn(frequency, 5.0, CARD, 2)
    memory = np.empty((BLOCK, 2, bands), complex)
    for part in parts:
        found, expected = ours.run(part, memory), filters.run(part)
        if not abs(found - expected).max() <= 1e-9 * abs(expected).max():
            raise RuntimeError(f"demodulation: envelopes differ by {abs(found - expected).max()}")

    def work(run: Callable[[np.ndarray], object]) -> None:
        for part in parts:
            run(part)

    spent, theirs, ratio = compare(lambda: work(partial(ours.run, out=memory)), lambda: work(filters.run), pairs)
    note = f"{spent / signal.size / bands * 1e9:.2f} against {theirs / signal.size / bands * 1e9:.1f} ns"
    yield Figure(f"demodulation alone, {bands} bands: times faster than", ratio, "x", 22.0, 10.0, True,
                 "scipy.signal.sosfilt", f"{note} a band-sample and channel")  # fmt: skip


def two_cores(devices: tuple[str, ...], seconds: float, pairs: int) -> Iterator[Figure]:
    """Rendered and judged scenes of each device on two processes over one, in wall time."""
    if cores() < 2:
        return
    pools = [ProcessPoolExecutor(workers, get_context("spawn")) for workers in (2, 1)]
    with pools[0], pools[1]:
        for device in devices:
            scene = hr.Scene(
                texture=hr.Grating(frequency=120.0, velocity=10e-3),
                finger=hr.Finger.sliding(0.08, normal_load=0.4),
                device=device,
                duration=seconds,
            )
            scenes = [replace(scene, seed=seed) for seed in range(SWEPT)]
            two, one = (partial(sweep, scenes, executor=pool, at_a_time=1) for pool in pools)
            spent, _, ratio = compare(two, one, pairs, time.perf_counter)
            yield Figure(f"sweep on {device}, two cores: times faster than", ratio, "x", 1.8, 1.8, True, "one core",
                         f"{SWEPT * seconds / spent:.0f} scene-seconds a second, judged")  # fmt: skip


def linear(pairs: int) -> Iterator[Figure]:
    """Cost a band of the law by bands in blocks, 4096 bands over 64."""
    runs = []
    for bands in (4096, 64):
        controller, samples = in_blocks(bands), BLOCK * max(2, 16_384 // bands)
        zeros = np.zeros((samples, 2)), np.zeros(samples), np.zeros(samples)
        runs.append((lambda c=controller, z=zeros: c.run(*z), samples * bands))
    many, few, _ = compare(runs[0][0], runs[1][0], pairs)
    ratio = many / runs[0][1] / (few / runs[1][1])
    yield Figure("cost a band, 4096 bands over 64", ratio, "x", 1.0, 1.2, False, "itself")


def hours(duration: float) -> Iterator[Figure]:
    """Phase of 8 bands after so many hours at 48 kHz in blocks, against exact rational arithmetic."""
    controller, block = in_blocks(8), BLOCK * 1000
    count = int(duration * 3600 * CARD) // block
    still, nothing = np.zeros((block, 2)), np.zeros(block)
    for _ in range(count):
        controller.run(still, nothing, nothing)
    frequency = comb(8, 1e-9, 1000.0).frequency
    exact = np.array([float(Fraction(float(f)) * count * block / Fraction(CARD) % 1) for f in frequency])
    off = 2 * np.pi * (np.mod(controller.field("turns") - exact + 0.5, 1.0) - 0.5)
    name = f"phase after {duration:g} h of play, 8 bands"
    yield Figure(name, float(abs(off).max()), "rad", 1e-5, 1e-5, False, "rational arithmetic")


def start_up(times: int) -> Iterator[Figure]:
    """Import and first sample in fresh processes."""
    for name, spent, target, floor, note in startup.measure(times):
        yield Figure(name, spent, "s", target, floor, False, "fresh process", note)


def every_case(short: bool) -> dict[str, Callable[[], Iterator[Figure]]]:
    """All cases by name; short ones for CI, without the start: its seconds are no ratio, and take as long as all."""
    pairs, seconds = (3, 1.0) if short else (9, 8.0)
    cases = {f"blocks {bands}": partial(blocks, bands, pairs) for bands in (8, 64, 512)}
    cases |= {f"closed loop {what}": partial(closed_loop, what, seconds, pairs) for what in FINGERS}
    cases |= {
        "waveform": partial(waveform_law, seconds, pairs),
        "supervision": partial(supervision, seconds, 3 * pairs),
        "driver": partial(python_driver, seconds, pairs),
        "paper": partial(paper, pairs),
        "demodulation": partial(demodulation, 64, pairs),
        "sweep": partial(two_cores, DEVICES[:1] if short else DEVICES, 2.0, 1 if short else 3),
        "linear": partial(linear, pairs),
        "hours": partial(hours, 0.01 if short else 10.0),
    }
    return cases if short else cases | {"startup": partial(start_up, 5)}
