"""Every figure that the library claims about its speed, beside its reference and its target."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import native
import numpy as np
import scenes
import startup
from native import NaivePolar, NoCompiler, TunedBlock, TunedPolar
from numpy_loop import NumpyPlate, NumpyPolar
from numpy_loop import run as numpy_run
from pairing import interleave
from peers import LockIn, NoPeer, SlidingDft, in_blocks, open_loop

from hapticrender.control.analyser import Analyser
from hapticrender.control.block_kernels import block_run
from hapticrender.control.polar_kernels import polar_run

FEW = 400  # samples of the numpy loop
BANDWIDTH = 10.0  # Hz, of the analysis
DTYPES = {"double": np.float64, "single": np.float32}


@dataclass(frozen=True)
class Figure:
    """One line of the table.

    `target` is the bound, `at_least` its direction; a ratio is judged in CI with a margin, anything else only shown.
    """

    name: str
    measured: float
    unit: str
    target: float
    at_least: bool
    reference: str
    note: str = ""

    @property
    def met(self) -> bool:
        return self.measured >= self.target if self.at_least else self.measured <= self.target

    def within(self, margin: float) -> bool:
        """Whether a ratio stays within `margin` times its target."""
        if self.unit != "x":
            return True
        bound = self.target / margin if self.at_least else self.target * margin
        return self.measured >= bound if self.at_least else self.measured <= bound


def polar_against_c(bands: int, precision: str, pairs: int) -> Iterator[Figure]:
    """The paper's controller in blocks of 64 against C, tuned by hand and naive; outputs are compared first."""
    controller = scenes.polar(bands, precision)
    samples = 64 * max(4, 4000 // bands)
    sensed, nothing = 1e-6 * np.random.default_rng(0).standard_normal((samples, 2)), np.zeros(samples)
    sides = np.ascontiguousarray(sensed @ controller.tables.listen.T)
    drive, target, flags = np.zeros((samples, 2)), np.zeros((samples, bands), complex), np.zeros(samples, np.int64)

    def ours():
        polar_run(controller.tables, controller.state, sensed, nothing, nothing, drive, target, flags)

    tuned, naive = TunedPolar(controller, DTYPES[precision]), NaivePolar(controller)
    ours()
    expected = naive.run(sides)
    bound = {"double": 1e-9, "single": 1e-3}[precision] * abs(expected).max()
    for found in (drive, tuned.run(sides)):
        if not abs(found - expected).max() <= bound:
            raise RuntimeError(f"polar, {bands} bands, {precision}: outputs differ by {abs(found - expected).max()}")
    for reference, goal, at_least, who in (
        (tuned, 1.15, False, "C tuned by hand (native/polar.c)"),
        (naive, {"double": 30.0, "single": 90.0}[precision], True, "naive C, double (native/naive.c)"),
    ):
        paired = interleave(ours, lambda reference=reference: reference.run(sides), pairs)
        each = paired.candidate / samples / bands / 2 * 1e9
        ratio = paired.ratio if at_least else 1 / paired.ratio
        name = f"polar, {bands} bands, {precision}: {'times faster than' if at_least else 'time over that of'}"
        yield Figure(name, ratio, "x", goal, at_least, who, f"{each:.2f} ns a band-sample and channel")


def block_against_c(bands: int, precision: str, pairs: int) -> Iterator[Figure]:
    """The default method in blocks of 64 on two channels at 48 kHz: against C, and as a share of a core."""
    controller, count = scenes.in_blocks(bands, precision, drive_step=1e-12), max(20, 10_000 // bands)
    samples = scenes.BLOCK * count
    sensed, nothing = 1e-9 * np.random.default_rng(0).standard_normal((samples, 2)), np.zeros(samples)
    drive, target, flags = np.zeros((samples, 2)), np.zeros((count, bands), complex), np.zeros(samples, np.int64)

    def ours():
        block_run(controller.tables, controller.state, sensed, nothing, nothing, drive, target, flags)

    ours()
    tuned = TunedBlock(controller)
    ours()
    off = abs(tuned.run(sensed) - drive).max()
    if not off <= {"double": 1e-6, "single": 1e-3}[precision] * abs(drive).max():
        raise RuntimeError(f"blocks, {bands} bands, {precision}: drives differ by {off}")
    paired = interleave(ours, lambda: tuned.run(sensed), pairs)
    share, each = 100 * paired.candidate / (samples / scenes.CARD), paired.candidate / samples / bands / 2 * 1e9
    name, note = f"blocks of 64, {bands} bands x 2 at 48 kHz, {precision}", f"{each:.2f} ns a band-sample and channel"
    who = "C tuned by hand (native/block.c)"
    yield Figure(f"{name}: time over that of", 1 / paired.ratio, "x", 1.2, False, who, note)
    if bands == 512:
        yield Figure(name, share, "% of a core", {"double": 2.0, "single": 1.0}[precision], False, "on AVX-512")


def _analysis(bands: int) -> tuple[Analyser, np.ndarray]:
    """Analyser of two channels at 48 kHz on the bins of a sliding DFT, and noise for it."""
    frequency = 0.5 * scenes.CARD / bands * np.arange(bands)
    samples = np.random.default_rng(0).standard_normal((scenes.BLOCK * max(8, 4000 // bands), 2))
    return Analyser(frequency, BANDWIDTH, scenes.CARD, channels=2), samples


def _faster(bands: int, run: Callable[[np.ndarray], object], goal: float, who: str, pairs: int) -> Figure:
    """How much sooner the analyser is through the same blocks, into memory made beforehand."""
    analyser, samples = _analysis(bands)
    ours, room = analyser.run, analyser.room(scenes.BLOCK)
    paired = interleave(
        lambda: in_blocks(lambda block: ours(block, out=room), samples), lambda: in_blocks(run, samples), pairs
    )
    spent, theirs = (each / samples.size / bands * 1e9 for each in (paired.candidate, paired.reference))
    note = f"{spent:.2f} against {theirs:.1f} ns a band-sample and channel"
    name = f"analysis alone, {bands} bands x 2: times faster than {who.split('.')[0]}"
    return Figure(name, paired.ratio, "x", goal, True, who, note)


def analysis_against_scipy(bands: int, pairs: int) -> Iterator[Figure]:
    """The STDFT* in blocks of 64 from Python against scipy's lock-in; envelopes are compared first."""
    analyser, samples = _analysis(bands)
    lock_in = LockIn(analyser.frequency, BANDWIDTH, scenes.CARD, channels=2)
    for start in range(0, len(samples), scenes.BLOCK):
        block = samples[start : start + scenes.BLOCK]
        found, expected = analyser.run(block), lock_in.run(block)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())
    yield _faster(bands, lock_in.run, 10.0, "scipy.signal.sosfilt", pairs)


def analysis_against_sdft(bands: int, pairs: int) -> Iterator[Figure]:
    """The STDFT* in blocks of 64 from Python against sliding DFTs; both first find a tone in the middle."""
    analyser, sliding = _analysis(bands)[0], SlidingDft(bands, channels=2)
    phase = 2 * np.pi * analyser.frequency[bands // 2] / scenes.CARD * np.arange(240 * scenes.BLOCK)
    tone = np.stack([np.cos(phase), np.cos(phase)], axis=1)
    found, expected = abs(in_blocks(analyser.run, tone)[-1, 0]), 2 * abs(in_blocks(sliding.run, tone)[0][-1])
    np.testing.assert_allclose([found[bands // 2], expected[bands // 2]], 1.0, rtol=1e-3)
    yield _faster(bands, sliding.run, 15.0, "sdft.SDFT, boxcar", pairs)


def _open_loop_note(pairs: int) -> str:
    """What python-control makes of a second of the free plate without a controller."""
    try:
        forced, stepped = open_loop(scenes.PLATE, pairs)
    except NoPeer as missing:
        return f"python-control left out: {missing}"
    return f"python-control, open loop: {forced:.0f} (forced_response), {stepped:.1f} (input_output_response) s/s"


def simulation(method: str, goal: float, seconds: float, pairs: int) -> Iterator[Figure]:
    """Plate with a heavy finger sliding on it, 8 bands, adaptation on, against the numpy loop of the paper's method."""
    aside = _open_loop_note(pairs)
    for what, parameters in (
        ("ideal sensors", replace(scenes.PLATE, sensor_noise=0.0)),
        ("sensor noise drawn", scenes.PLATE),
    ):
        samples = int(seconds * parameters.rate)
        ours = scenes.closed_loop(method, 8, samples, parameters=parameters)
        loop, plate = NumpyPolar(scenes.polar(8).tables), NumpyPlate(parameters)
        noise = np.zeros((FEW, 2))
        paired = interleave(ours, lambda loop=loop, plate=plate, noise=noise: numpy_run(loop, plate, FEW, noise), pairs)
        rate = seconds / paired.candidate
        ratio = rate / (FEW / parameters.rate / paired.reference)
        name = f"closed loop, 8 bands, {method}, sliding finger, {what}"
        note = f"{ratio:.0f}x the numpy loop; {aside}"
        yield Figure(name, rate, "s/s", goal, True, "simulated seconds a second", note)


def linear_in_bands(pairs: int) -> Iterator[Figure]:
    """Cost a band of the default method in blocks, 4096 bands against 64."""
    runs = []
    for bands in (4096, 64):
        controller = scenes.in_blocks(bands)
        blocks = max(2, 4096 * 4 // bands)
        samples = scenes.BLOCK * blocks
        arrays = np.zeros((samples, 2)), np.zeros(samples), np.zeros(samples), np.zeros((samples, 2))
        arrays += np.zeros((blocks, bands), complex), np.zeros(samples, np.int64)
        runs.append((lambda c=controller, a=arrays: block_run(c.tables, c.state, *a), samples * bands))
    paired = interleave(runs[0][0], runs[1][0], pairs)
    ratio = paired.candidate / runs[0][1] / (paired.reference / runs[1][1])
    yield Figure("cost a band, 4096 bands over 64", ratio, "x", 1.2, False, "itself")


def hours_of_play(hours: float) -> Iterator[Figure]:
    """Phase of 8 bands after so many hours at 48 kHz in blocks, against whole-number arithmetic."""
    controller = scenes.in_blocks(8)
    block = scenes.BLOCK * 1000
    count = int(hours * 3600 * scenes.CARD) // block
    nothing, still = np.zeros(block), np.zeros((block, 2))
    start = time.perf_counter()
    for _ in range(count):
        controller.run(still, nothing, nothing)
    spent = time.perf_counter() - start
    samples, frequency = count * block, controller.tables.bank.tone[0]
    exact = np.array([float(_turns(f, samples)) for f in frequency])
    off = 2 * np.pi * (np.mod(controller.turns - exact + 0.5, 1.0) - 0.5)
    note = f"{hours * 3600 / spent:.0f} s of play a second"
    name = f"phase after {hours:g} h of play, 8 bands"
    yield Figure(name, float(abs(off).max()), "rad", 1e-5, False, "whole-number arithmetic", note)


def _turns(frequency: float, samples: int):
    from fractions import Fraction

    return Fraction(float(frequency)) * samples / Fraction(scenes.CARD) % 1


def start_up(pairs: int) -> Iterator[Figure]:
    """Fresh processes: import, first sample warm and cold."""
    for name, spent, goal in startup.measure(pairs):
        yield Figure(name, spent, "s", goal, False, "fresh process")


def every_case(short: bool) -> Iterator[tuple[str, Callable[[], Iterator[Figure]]]]:
    """All cases by name; short ones for CI."""
    pairs = 3 if short else 9
    for bands in (64,) if short else (64, 512):
        for precision in DTYPES:
            yield f"polar {bands} {precision}", lambda b=bands, p=precision: polar_against_c(b, p, pairs)
    for bands in (512,) if short else (8, 64, 512):
        for precision in DTYPES:
            yield f"blocks {bands} {precision}", lambda b=bands, p=precision: block_against_c(b, p, pairs)
    for bands in (64,) if short else (8, 64, 512):
        yield f"peers scipy {bands}", lambda b=bands: analysis_against_scipy(b, pairs)
        yield f"peers sdft {bands}", lambda b=bands: analysis_against_sdft(b, pairs)
    for method, goal in (("h2", 1500.0), ("paper", 2500.0)):
        seconds = 1.0 if short else 10.0
        yield f"simulation {method}", lambda m=method, g=goal, s=seconds: simulation(m, g, s, pairs)
    yield "linear", lambda: linear_in_bands(pairs)
    yield "hours", lambda: hours_of_play(0.01 if short else 10.0)
    yield "startup", lambda: start_up(1 if short else 5)


__all__ = ["Figure", "NoCompiler", "NoPeer", "every_case", "native"]
