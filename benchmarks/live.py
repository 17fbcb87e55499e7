"""Measure live play: the compiled callback of the waveform law, how soon `finger` acts, and how well textures play.

Run: python -m benchmarks.live [--calls 2000] [--sessions 8]

The callback at 48 kHz in blocks of 64, with a simulated plate behind it; in ratios to the time of a block, and to an
empty callback called alike.  Errors are those of a third party's plate (``tests/strangers_plate.py``) behind the public
driver protocol, of its true motion, 20-500 Hz, without shift or gain fit: under the finger, and at the worse end.
"""

import argparse
import itertools
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import hapticrender as hr
from benchmarks.callback import BLOCK, EMPTY, RATE, seconds_of
from hapticrender.control.methods import METHODS
from hapticrender.plants.plate import PlateParameters
from hapticrender.realtime_entry import RealtimeEntry
from hapticrender.sampled_texture import SampledTexture
from tests.strangers_plate import StrangersPlate

NOTE = 0.1 * np.sin(2 * np.pi * 150.0 * np.arange(8000) / 8000.0)
FINGERS = {"4 g": (4e-3, 1.5, 300.0), "skin on a heavy phalanx": (2e-4, 3.0, 3000.0, 8e-3, 2.0, 400.0)}
SPANS = (0.7, 1.5), (1.5, 1.54), (1.6, 3.0), (3.0, 3.04), (3.1, 4.5)  # s
WHAT = "a tone", "while it fades into", "ridges and a tone", "while they fade into", "a chirp"
TEXTURES = {
    "8 tones": hr.Grating(frequency=40.0, amplitude=5e-6, shape="square", harmonics=8),
    "64 ridges": hr.Grating(wavelength=5e-3, amplitude=5e-6, shape="square", harmonics=64),
    "a recording and ridges": hr.Recorded(samples=NOTE, rate=8000.0, amplitude=5e-6)
    + hr.Grating(wavelength=1e-3, amplitude=5e-6),
}


def entry_of(texture: hr.Texture) -> RealtimeEntry:
    """The waveform law for the paper's plate, with a texture and a finger that slides."""
    model = PlateParameters(rate=RATE, delay=2 * BLOCK).device_model(RATE, 2 * BLOCK)
    controller = METHODS["inverse"].design(replace(model, block=BLOCK), hr.Bands.none(spatial=False))
    entry = RealtimeEntry(controller)
    entry.play(SampledTexture(texture, RATE))
    entry.finger(-0.02, 0.05, 0.4)
    return entry


def finger_latency(calls: int) -> tuple[float, int, int]:
    """Median time (s) of a call of `Player.finger`; samples from it to another drive at the device, and by a tenth.

    Of two players that are alike one sets a sliding finger 0.1 mm from where it was expected; a tenth of the largest
    difference of their drives in 40 ms, after which the finger still slides.
    """
    spent, drives = np.empty(calls), []
    for shift in (0.0, 1e-4):
        plate = StrangersPlate(rate=RATE, block=BLOCK)
        with tempfile.TemporaryDirectory() as folder, hr.Player("vt-plate", plate, paced=False) as player:
            player.play(hr.Grating(wavelength=1e-3, amplitude=50e-6))
            for _ in range(50):
                player.finger(-0.02 + 0.05 * player.time, 0.05, 0.4)
                player.sleep(0.01)
            player.record(Path(folder) / "session.au")
            player.finger(-0.02 + 0.05 * player.time + shift, 0.05, 0.4)
            player.sleep(0.04)
            drives.append(player.end_recording().drive)
            for call in range(calls):
                start = time.perf_counter()
                player.finger(-0.02 + 1e-6 * call, 0.0, 0.4)
                spent[call] = time.perf_counter() - start
    change = abs(drives[0] - drives[1]).max(axis=1)
    first, tenth = (int(np.argmax(change > share * change.max())) for share in (0.0, 0.1))
    return float(np.median(spent)), first, tenth


def simulated(paced: bool) -> tuple[float, int]:
    """Processor time over that of the signal of a simulated plate at 5 kHz, and samples lost."""
    with hr.Player("vt-plate", paced=paced) as player:
        player.play(TEXTURES["8 tones"])
        player.finger(0.0, 0.0, 0.4)
        player.sleep(0.5)
        start = time.process_time()
        player.sleep(3.0)
        return (time.process_time() - start) / 3.0, player.state().lost


def session(finger: tuple[float, ...], place: float, phase: float) -> np.ndarray:
    """Errors (spans, 2) of a session whose finger swipes by 20 mm about `place` (m), touching from 0.2 s on."""
    from scipy.signal import butter, sosfiltfilt

    plate = StrangersPlate(
        finger=finger,
        position=lambda time: place + 0.01 * np.sin(2 * np.pi * (0.8 * np.asarray(time) + phase)),
        load=0.4,
        contact=lambda time: np.clip((np.asarray(time) - 0.2) / 0.02, 0.0, 1.0),
        report_lag=5e-3,
    )
    with tempfile.TemporaryDirectory() as folder, hr.Player("vt-plate", plate, paced=False) as player:
        player.play(hr.Grating(frequency=100.0, amplitude=5e-6))
        player.record(Path(folder) / "session.au")
        player.sleep(1.5)
        player.play(hr.Grating(wavelength=3e-4, amplitude=5e-6) + hr.Grating(frequency=180.0, amplitude=2.5e-6))
        player.sleep(1.5)
        player.play(hr.Chirp(start=60.0, stop=300.0, duration=2.0, amplitude=5e-6))
        player.sleep(1.5)
        reference = player.end_recording().reference
    kinds = (4, 20.0, "highpass"), (12, 500.0, "lowpass")
    sections = np.vstack([butter(order, edge, kind, fs=plate.rate, output="sos") for order, edge, kind in kinds])
    error = sosfiltfilt(sections, plate.truth[: len(reference), :3] - reference[:, None], axis=0)
    texture, spans = sosfiltfilt(sections, reference), (np.array(SPANS) * plate.rate).astype(int)
    found = [np.sqrt((error[a:b] ** 2).mean(axis=0) / (texture[a:b] ** 2).mean()) for a, b in spans]
    return np.array([[each[0], each[1:].max()] for each in found])


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--calls", type=int, default=2000, help="calls timed (default: 2000)")
    parser.add_argument("--sessions", type=int, default=8, help="of which errors are measured, 1 to 8 (default)")
    arguments = parser.parse_args()
    calls, block = arguments.calls, BLOCK / RATE
    empty, _ = seconds_of(EMPTY.address, 0, calls)
    print(f"empty callback                  {100 * empty / block:6.2f} % of a block of {1e3 * block:.2f} ms")
    for name, texture in TEXTURES.items():
        entry = entry_of(texture)
        median, late = seconds_of(entry.address, entry.user_data, calls)
        print(
            f"waveform law, {name:<22}{100 * median / block:8.1f} %, 99 % of the calls below {100 * late / block:.0f} %"
        )
    call, first, tenth = finger_latency(calls)
    late = f"{first} samples later ({1e3 * first / RATE:.2f} ms), by a tenth {1e3 * tenth / RATE:.1f} ms"
    print(f"Player.finger(): {1e6 * call:.1f} us; the device plays another drive {late}")
    for paced, how in ((True, "held to the clock"), (False, "not paced")):
        share, lost = simulated(paced)
        print(f"simulated plate, {how}: {200 * share:.1f} us of a processor a sample of 200, {lost} lost")
    cases = itertools.product(FINGERS.values(), (0.0, 0.02), (0.0, 0.3))
    runs = [session(*case) for case in itertools.islice(cases, arguments.sessions)]
    median, worst = 100 * np.median(runs, axis=0), 100 * np.max(runs, axis=0)
    print(f"third party's plate, {len(runs)} sessions: median and worst error, under the finger / at the worse end")
    for what, middle, most in zip(WHAT, median, worst, strict=True):
        print(f"{what:<22}{middle[0]:6.2f} / {middle[1]:.2f} %   {most[0]:6.2f} / {most[1]:.2f} %")


if __name__ == "__main__":
    main()
