"""Measure the sound card's callback: its time over that of a block, and what a busy Python thread costs.

Run: python -m benchmarks.audio [--seconds 3] [--rounds 5]

First the compiled callback of the law by bands, called in a loop, at 48 kHz in blocks of 64, beside an empty compiled
callback.  Then, on a JACK server with its dummy back end and the plate as a second client (``tests/jack_plate.c``), the
callbacks lost in real time, and the accuracy of the closed ring.  Lost is what the plate's client went through and this
process did not; both compete with everything else on the machine, at normal priority.
"""

import argparse
import statistics
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import jack_ring  # noqa: E402
from jack_ring import AMPERES, BLOCK, METRES, RATE  # noqa: E402

import hapticrender as hr  # noqa: E402
from benchmarks.callback import EMPTY, seconds_of  # noqa: E402
from benchmarks.cases import in_blocks  # noqa: E402
from hapticrender.drivers.audio_callback import Relay  # noqa: E402
from hapticrender.realtime_entry import RealtimeEntry  # noqa: E402

BANDS = (8, 64, 512)
CALLS = 2000


def print_times() -> None:
    """Time of a call, and its share of a block."""
    cases = [("empty", EMPTY.address, 0)]
    entries = [RealtimeEntry(in_blocks(bands), sensed_scale=METRES, drive_scale=1 / AMPERES) for bands in BANDS]
    cases += [(f"{bands} bands", each.address, each.user_data) for bands, each in zip(BANDS, entries, strict=True)]
    for name, address, argument in cases:
        relay = Relay((0, 1), (0, 1), BLOCK)
        relay.call(address, argument)
        spent = seconds_of(relay.address, relay.user_data, CALLS, AMPERES, METRES)
        median, late = (100 * RATE / BLOCK * each for each in spent)
        print(f"callback, {name}: {median:.2f} % of a block (99th percentile {late:.2f} %)", flush=True)
    stopped = [bands for bands, each in zip(BANDS, entries, strict=True) if each.flags & hr.Flag.STOPPED]
    if stopped:
        print(f"stopped by the supervisor, and so too fast: {stopped} bands")


def print_losses(device: jack_ring.Device, seconds: float, rounds: int) -> None:
    """Median share of callbacks lost, of runs in turns; a process takes a core as a thread does, but not the lock."""
    kinds = {
        "compiled, alone": (lambda entry: entry, nullcontext),
        "compiled, beside a busy process": (lambda entry: entry, jack_ring.busy_process),
        "compiled, beside a busy Python thread": (lambda entry: entry, jack_ring.busy_thread),
        "in Python, alone": (jack_ring.PythonEntry, nullcontext),
        "in Python, beside a busy process": (jack_ring.PythonEntry, jack_ring.busy_process),
        "in Python, beside a busy Python thread": (jack_ring.PythonEntry, jack_ring.busy_thread),
    }
    rows = [[jack_ring.lost_callbacks(device, *kind, seconds) for kind in kinds.values()] for _ in range(rounds)]
    for name, column in zip(kinds, zip(*rows, strict=True), strict=True):
        every = ", ".join(f"{100 * each:.2f}" for each in column)
        print(f"lost callbacks, {name}: {100 * statistics.median(column):.2f} % ({every})", flush=True)


def print_ring(device: jack_ring.Device, folder: Path, freewheel: bool) -> None:
    """Largest error of 8 bands at the centre, over the last 2 s of 10."""
    live = jack_ring.driver().live()
    entry = jack_ring.entry_for(live)
    with live:
        live.start(entry)
        if freewheel:
            device.say("run 7500")
        else:
            time.sleep(10)
        load, lost = live.cpu_load, live.overruns
        live.stop()
        errors = jack_ring.relative_errors(device, folder / "record", entry)[0]
    amplitude, phase = abs(abs(1 + errors) - 1).max(), abs(np.angle(1 + errors, deg=True)).max()
    mode = "freewheel" if freewheel else "real time"
    print(
        f"ring in {mode}: amplitude within {100 * amplitude:.2f} %, phase within {phase:.2f} degrees, {lost} overruns, "
        f"load by PortAudio {100 * load:.2f} %",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0, help="length of a run in real time")
    parser.add_argument("--rounds", type=int, default=5, help="runs of each kind")
    arguments = parser.parse_args()
    print_times()
    if reason := jack_ring.missing():
        print(f"no JACK: {reason}")
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = jack_ring.build(folder)
        noise, length = jack_ring.NOISE / METRES, round(120 * RATE)
        with jack_ring.server(folder):
            for freewheel in (True, False):
                with jack_ring.device(program, folder, jack_ring.plate(), length=length, noise=noise) as device:
                    print_ring(device, folder, freewheel)
            with jack_ring.device(program, folder, jack_ring.plate(), noise=noise) as device:
                print_losses(device, arguments.seconds, arguments.rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
