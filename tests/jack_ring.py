"""A JACK server with its dummy back end, a client on it that is a device (`jack_plate.c`), and the ring of both."""

import ctypes
import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from ctypes.util import find_library
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm
from synthetic import make_bands

from hapticrender.control.methods import METHODS
from hapticrender.drivers.audio import AudioDriver
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.plants.ultrasonic import UltrasonicParameters
from hapticrender.realtime_entry import RealtimeEntry
from hapticrender.touch.mechanics import HEAVY_SECOND

SOURCE = Path(__file__).with_name("jack_plate.c")
CLIENT = "plate"
RATE, BLOCK = 48_000.0, 64  # Hz, samples
AMPERES, METRES = 3.0, 1e-3  # of full scale, out and in
PEAK, FRICTION = 10e-3, 4.0  # A, N: the same of a screen
FAST, SHORT = 192_000.0, 16  # Hz, samples: of a card that plays a carrier itself
VOLTS, VIBRATION = 10.0, 10e-6  # V, m: full scales of a vibrating surface
NOISE = 1e-6  # m rms, of a sensor
ROUND_TRIP = 128  # samples: PortAudio and the plate each get what the other played in the period before
FREQUENCY = np.array([40.0, 90, 140, 190, 240, 290, 340, 390])  # Hz
AMPLITUDE = 2e-6  # m
PACKAGES = "jackd2 libportaudio2 libjack-jackd2-dev gcc libc6-dev"
PATIENCE = 20.0  # s: until the server is there
PERIODS = 1400  # of a freewheel, in which every period waits for all: 1.9 s; textures are computed 2 s ahead
SETTLED = slice(round(1.2 * RATE), round(1.7 * RATE))  # of them


def missing() -> str:
    """What is not installed, and how to get it; empty where all is there."""
    lacking = [each for each in ("jackd", "jack_wait", "gcc") if shutil.which(each) is None]
    lacking += [each for each in ("jack", "portaudio") if find_library(each) is None]
    if lacking:
        return f"{', '.join(lacking)} not installed: `make packages` as root, or apt install {PACKAGES}"
    return ""


class System(NamedTuple):
    """x' = A x + B u, y = C x + D u, inputs and outputs in full scales."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray

    def write(self, path: Path, length: int, noise: float) -> None:
        states, inputs, outputs = len(self.a), self.b.shape[1], len(self.c)
        with path.open("w", encoding="ascii") as file:
            print(states, inputs, outputs, length, repr(float(noise)), file=file)
            for matrix in self:
                np.savetxt(file, matrix, fmt="%.17g")


def plate(position: float = 0.01, load: float = 0.8) -> System:
    """The paper's plate, rigid, with a heavy finger at `position` (m), exact under held drive; outputs: both ends."""
    parameters = PlateParameters(rate=RATE)
    built = structure(parameters, HEAVY_SECOND, position, float(HEAVY_SECOND.load_factor(np.array(load))))
    phi, gamma = built.zero_order_hold(RATE)
    outputs = np.pad(built.outputs[1:3], ((0, 0), (0, len(phi) - built.outputs.shape[1]))) / METRES
    return System(phi, gamma[:, :2] * AMPERES, outputs, np.zeros((2, 2)))


def screen(speed: float, load: float) -> tuple[System, float]:
    """Screen under a sliding finger (m/s, N), for the command `square` with the second number.

    The sum of load and attraction makes the friction, behind the contact's memory and the tribometer's resonance, exact
    under held drive.  Full scales are `PEAK` and `FRICTION`.
    """
    parameters = ElectroadhesionParameters()
    attraction, pole = parameters.gain(load) * PEAK**2, speed / parameters.memory_length
    w0 = 2 * np.pi * parameters.tribometer_frequency
    a = np.array([[-pole, 0, 0], [0, 0, w0], [w0, -w0, -2 * parameters.tribometer_damping * w0]])
    b = np.array([[pole * parameters.friction_coefficient * attraction / FRICTION], [0], [0]])
    phi = expm(np.block([[a, b], [np.zeros((1, 4))]]) / RATE)
    return System(phi[:3, :3], phi[:3, 3:], np.array([[0.0, 1, 0]]), np.zeros((1, 1))), load / attraction


def hybrid(speed: float, load: float) -> tuple[System, float]:
    """A `screen` on the `plate`, whose finger presses in the middle."""
    friction, offset = screen(speed, load)
    return System(*map(block_diag, plate(0.0), friction)), offset


def vibrating(load: float) -> System:
    """Ultrasonic plate under a resting load (N) at `FAST`, exact under held drive; in `VOLTS` and `VIBRATION`."""
    mode = UltrasonicParameters(rate=FAST)
    w0, damping = 2 * np.pi * float(mode.resonance(load)), float(mode.damping(load)) / mode.mass
    a, b = np.array([[0.0, w0], [-w0, -damping]]), np.array([[0.0], [mode.force_constant / mode.mass / w0]])
    phi = expm(np.block([[a, b * VOLTS / VIBRATION], [np.zeros((1, 3))]]) / FAST)
    return System(phi[:2, :2], phi[:2, 2:], np.array([[1.0, 0.0]]), np.zeros((1, 1)))


def cable(delay: float = 0.0, taps: int = 33, gain: float = 1.0) -> System:
    """Output 1 on input 1, `delay` samples later than (taps - 1)/2: a windowed sinc, exact to 1e-4 below 0.3 rate."""
    n = np.arange(taps) - (taps - 1) / 2
    kernel = gain * np.sinc(n - delay) * np.kaiser(taps, 8.0)
    shift = np.eye(taps - 1, k=-1)
    b = np.zeros((taps - 1, 2))
    b[0, 0] = 1.0
    return System(shift, b, np.vstack([kernel[1:], 0 * kernel[1:]]), np.diag([kernel[0], 0.0]))


def straight() -> System:
    """Every output on the input of the same number."""
    return System(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2))


@dataclass
class Count:
    """What the device and the server counted: periods, overruns that JACK reported, and the server's time."""

    periods: int
    overruns: int
    frames: int


class Device:
    """The second client."""

    def __init__(self, process: subprocess.Popen, outputs: int) -> None:
        self._process, self._outputs = process, outputs

    def say(self, command: str) -> Count:
        """Send a command of `jack_plate.c` and return what it counted."""
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        return Count(*map(int, self._process.stdout.readline().split()))

    def recorded(self, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Outputs so far without noise, and with it, float32 full scales of shape (n, outputs)."""
        self.say(f"save {path}")
        rows = np.fromfile(path, np.float32).reshape(-1, 2 * self._outputs)
        return rows[:, : self._outputs], rows[:, self._outputs :]


def build(folder: Path) -> Path:
    """Compile the device."""
    program = folder / "jack_plate"
    flags = "-std=gnu11 -O2 -Wall -Wextra -Werror".split()
    subprocess.run(["gcc", *flags, "-o", program, SOURCE, "-ljack"], check=True, timeout=120)
    return program


def run_paced(device):
    """Go through `PERIODS` of 2 ms in freewheel, and in it alone: in real time each of 1.3 ms would be late.

    Returns the device's samples until its end.
    """
    return [device.say(each) for each in ("pace 2", f"run {PERIODS}", "pace 0")][1].periods * BLOCK


@contextmanager
def server(folder: Path, name: str = "test", rate: float = RATE, block: int = BLOCK):
    """Run a server of its own that needs no privileges, as a process; every client of this process finds it.

    It waits 20 s for a client: PortAudio 19.6 ends the process by an assertion where it was disconnected.
    """
    name = f"hapticrender-{os.getpid()}-{name}"
    own = {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1", "JACK_NO_AUDIO_RESERVATION": "1"}
    before = {key: os.environ.get(key) for key in own}
    os.environ.update(own)
    command = ["jackd", "-r", "-t", "20000", "-n", name, "-d", "dummy", "-r", f"{rate:.0f}", "-p", str(block)]
    with (folder / "jackd.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        _wait_for(name, folder / "jackd.log")
        yield process
    finally:
        _end(process)
        for key, value in before.items():
            os.environ.pop(key) if value is None else os.environ.__setitem__(key, value)


def _wait_for(name: str, log: Path) -> None:
    """Wait for a server from another process: PortAudio is for servers that are there."""
    command = ["jack_wait", "-w", "-s", name, "-t", f"{PATIENCE:.0f}"]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        raise RuntimeError(f"no JACK server: {log.read_text()}")


@contextmanager
def device(program: Path, folder: Path, system: System, *, length: int = 0, noise: float = 0.0):
    """Run the device on the server; `length` samples are recorded, `noise` is the sensors' in full scales."""
    path = folder / "system.txt"
    system.write(path, length, noise)
    process = subprocess.Popen([program, CLIENT, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        if process.stdout.readline() != "ready\n":
            raise RuntimeError(f"jack_plate ended with status {process.wait(5)}")
        yield Device(process, len(system.c))
    finally:
        process.stdin.close()
        _end(process, patience=5.0)
        process.stdout.close()


def _end(process: subprocess.Popen, patience: float = 0.0) -> None:
    """Wait for a process that should end by itself, then ask it to, then make it."""
    for ask in (None, process.terminate, process.kill):
        if ask is not None:
            ask()
        try:
            process.wait(patience or 5.0 if ask else patience)
            return
        except subprocess.TimeoutExpired:
            continue


def comb():
    return make_bands(FREQUENCY, AMPLITUDE, phase=np.linspace(0.0, 5.0, 8))


def driver(delay=ROUND_TRIP, **options):
    scales = {"drive_per_full_scale": AMPERES, "sensed_per_full_scale": METRES}
    return AudioDriver(CLIENT, (1, 2), (1, 2), delay=delay, **scales | options)


def entry_for(live):
    """Designed for the paper's plate behind this driver, and compiled."""
    model = PlateParameters(rate=RATE, delay=live.delay).device_model(RATE, live.delay)
    controller = METHODS["h2"].design(replace(model, block=BLOCK), comb())
    entry = RealtimeEntry(controller, sensed_scale=live.sensed_scale, drive_scale=live.drive_scale)
    entry.finger(0.01)
    _ = entry.address
    return entry


def relative_errors(device, path, entry, seconds=2.0, before=0.5):
    """Motion of centre and ends over the target, less 1, complex of shape (3, 8), `before` (s) the end of the record.

    A block that the entry sensed then is found in what the device has recorded with its noise, and so are the entry's
    own numbers of the device's samples: what is lost later, after the freewheel, shifts nothing.
    """
    true, noisy = device.recorded(path)
    start = entry.samples - round(before * RATE)
    block = (entry.log(start)["sensed"][:BLOCK] / METRES).astype(np.float32)
    starts = np.flatnonzero(noisy[: -BLOCK + 1, 0] == block[0, 0])
    (place,) = (n for n in starts if (noisy[n : n + BLOCK] == block).all())
    index = place - np.arange(round(seconds * RATE))
    phase = 2 * np.pi * np.outer(index - place + start, FREQUENCY) / RATE + comb().phase
    motion = np.column_stack([true.mean(axis=1), true])[index].astype(float) * METRES
    found = np.linalg.lstsq(np.hstack([np.cos(phase), -np.sin(phase)]), motion, rcond=None)[0]
    return (found[:8] + 1j * found[8:]).T / comb().envelope - 1


class PythonEntry:
    """An entry whose callback is a function of Python that calls the compiled one."""

    def __init__(self, entry):
        pointer, long = ctypes.c_void_p, ctypes.c_ulong
        signature = ctypes.CFUNCTYPE(ctypes.c_int, pointer, pointer, long, pointer, long, pointer)
        compiled = signature(entry.address)
        self._callback = signature(lambda *arguments: compiled(*arguments))
        self.address = ctypes.cast(self._callback, pointer).value
        self.user_data, self.block, self.controller = entry.user_data, entry.block, entry.controller
        self.silence = entry.silence


@contextmanager
def busy_thread():
    """Keep Python's lock in another thread, but for the turns that it gives away every 5 ms."""
    stop = threading.Event()

    def work():
        while not stop.is_set():
            sum(range(10_000))

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def busy_process():
    """Keep a core busy as that thread does, without the lock."""
    process = subprocess.Popen([sys.executable, "-c", "while True: sum(range(10_000))"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def lost_callbacks(device, wrap, beside, seconds):
    """Share of the periods that the plate's client went through, and this process did not."""
    live = driver().live()
    entry = entry_for(live)
    with live, beside():
        live.start(wrap(entry))
        time.sleep(0.2)
        first, samples = device.say("count"), entry.samples
        time.sleep(seconds)
        last, more = device.say("count"), entry.samples
    return 1 - (more - samples) / BLOCK / (last.periods - first.periods)
