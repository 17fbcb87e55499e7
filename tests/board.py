"""The board as a real process behind a pseudo-terminal: built, run by the clock, or stepped through a faulty line."""

import functools
import os
import select
import shutil
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import make_bands

import hapticrender as hr
from hapticrender.drivers.serial import BoardClient, SerialDriver
from hapticrender.export import export

ROOT = Path(__file__).resolve().parent.parent
FIRMWARE = ROOT / "drivers" / "firmware"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
CAREFUL = "-Wconversion -Wshadow -Wcast-qual -Wundef -Wstrict-prototypes -Wmissing-prototypes -Wvla".split()
SANITISED = ("-Og", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SOURCES = "board board_commands board_telemetry board_textures frames texture plate hardware_posix".split()
SOURCES += "law learning carriers supervisor gains".split()
RATE = 5000.0  # Hz
MECHANICS = "heavy-2nd-order"
FINGER = hr.Finger.swiping(frequency=0.8, stroke=0.05, normal_load=0.4, mechanics=MECHANICS)
SCENE = hr.Scene(texture=hr.Grating(wavelength=1e-3, amplitude=10e-6), finger=FINGER, duration=2.0, tolerance=0.1)
FOLDERS = []  # of programs, deleted at the end
SLOWER = 5  # times, so that a busy machine may pause the host for 0.4 s: 80 ms of the board's clock
SLOW = "--slow", str(SLOWER)


def compile_c(out, sources, *options):
    """Compile C sources strictly into a program; skip the test where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here: install gcc")
    subprocess.run([compiler, *STRICT, *options, "-o", out, *sources, "-lm"], check=True)
    return out


def build_board(folder, rendering, *options, bands=0):
    """Program of the board with the design of a rendering."""
    export(rendering, folder, bands=bands, force=True)
    return compile_c(folder / "board", [folder / f"{name}.c" for name in (*SOURCES, "design")], *options)


@functools.cache
def program_of(*options):
    """Program of a board with the design of `SCENE`, built once."""
    folder = tempfile.TemporaryDirectory(prefix="board")
    FOLDERS.append(folder)
    return build_board(Path(folder.name), hr.prepare(SCENE), *options)


class SlowClock:
    """A clock for a host whose board runs with `SLOW`."""

    def monotonic(self):
        return time.monotonic() / SLOWER

    def sleep(self, seconds):
        time.sleep(seconds * SLOWER)


class BoardProcess:
    """A running board, paced by the clock; `port` leads to its pseudo-terminal."""

    def __init__(self, program, folder, *options, stdin=None, stdout=None):
        self.port, self.log_path = folder / "tty", folder / "log"
        arguments = [program, self.port, "--log", self.log_path, *options]
        self.process = subprocess.Popen(arguments, stdin=stdin, stdout=stdout)
        end = time.monotonic() + 10.0
        while not self.port.exists():
            assert self.process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.01)

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.port.unlink(missing_ok=True)

    def log(self):
        """Lines of what it executed, as lists of words."""
        return [line.split() for line in self.log_path.read_text().splitlines()]

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        self.kill()


def slow_board(folder):
    """A board that is paced by a slow clock."""
    return BoardProcess(program_of("-O2"), folder, *SLOW)


def slow_client(board, **options):
    """A client with a thread and the same clock."""
    return BoardClient(str(board.port), clock=SlowClock(), **options)


class SteppedBoard:
    """A board whose time passes only in `sleep`: the clock of its client too, and the line between them, with faults.

    `damage(data)` returns what becomes of bytes on their way; before the time `pulled` all are lost.
    """

    def __init__(self, folder, *options, program=None):
        self.program, self.folder, self.options = program or program_of(*SANITISED), folder, options
        self.damage = lambda data: data
        self.time, self.pulled, self.connections, self.records = 0.0, 0.0, 0, []
        self._start()

    def _start(self):
        self.board = BoardProcess(
            self.program, self.folder, "--step", *self.options, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.sample, self._to_board, self._from_board = 0, 0, 0
        self._waiting, self._arrived = bytearray(), bytearray()
        self._line = os.open(self.board.port, os.O_RDWR | os.O_NOCTTY)
        self.board.process.stdout.readline()

    def reset(self):
        """Kill the board in the middle of whatever it does, and start it again."""
        self.close_board()
        self._start()

    def close_board(self):
        os.close(self._line)
        self.board.__exit__()
        self.records.append(self.board.log())

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close_board()

    def monotonic(self):
        return self.time

    def sleep(self, seconds):
        """Let the board run, and carry what both have to say."""
        samples = max(round(seconds * RATE), 1)
        data, self._waiting = bytes(self._waiting), bytearray()
        self._to_board += len(data)
        pipes = self.board.process
        pipes.stdin.write(f"{samples} {self._to_board}\n".encode())
        pipes.stdin.flush()
        while data:
            data = data[os.write(self._line, data) :]
        self.sample, total = map(int, pipes.stdout.readline().split())
        self.time += samples / RATE
        arrived = bytearray()
        while self._from_board + len(arrived) < total:
            assert select.select([self._line], [], [], 10.0)[0]
            arrived += os.read(self._line, 65536)
        self._from_board += len(arrived)
        if self.time >= self.pulled:
            self._arrived += self.damage(bytes(arrived))

    def connect(self, port, baud):
        self.connections += 1
        return self

    def read(self, most):
        data, self._arrived = bytes(self._arrived[:most]), self._arrived[most:]
        return data

    def write(self, data):
        if self.time >= self.pulled:
            self.inject(self.damage(data))

    def assert_at_rest(self):
        """Nothing is driven in the last sample."""
        self.sleep(0.001)
        assert driven(self.board.log(), self.sample - 1, self.sample) == []

    def client(self, **options):
        return BoardClient("stepped", background=False, clock=self, connect=self.connect, **options)

    def driver(self, **options):
        return SerialDriver("stepped", background=False, clock=self, connect=self.connect, **options)

    def started(self, bands=None, seconds=0.0, stream=0, **options):
        """Client whose board has played bands for some time; a tone of 47 Hz where none are given."""
        client = self.client(**options).open()
        client.set_bands(bands or tones(47.0))
        client.start(stream=stream)
        self.run(client, seconds)
        return client

    def run(self, client, seconds):
        end = self.time + seconds
        while self.time < end:
            client.step()
            self.sleep(0.005)

    def inject(self, data):
        """Put bytes on the line to the board."""
        self._waiting += data

    def close(self):
        """Close the line, as its client does: the board stays."""


class Faults:
    """A line on which a share of the bytes is flipped, cut or doubled."""

    def __init__(self, seed, share):
        self._rng, self._share = np.random.default_rng(seed), share
        self.carried = self.faulty = 0

    def __call__(self, data):
        bad = np.flatnonzero(self._rng.random(len(data)) < self._share)
        self.carried, self.faulty = self.carried + len(data), self.faulty + len(bad)
        if not bad.size:
            return data
        pieces = [bytes([byte]) for byte in data]
        for at in bad:
            kind = self._rng.integers(3)
            flipped = bytes([data[at] ^ int(self._rng.integers(1, 256))])
            pieces[at] = (flipped, b"", 2 * pieces[at])[kind]
        return b"".join(pieces)


def tones(*frequencies, amplitude=5e-6):
    return make_bands(frequencies, amplitude)


def simulated_as(recording, scene, noise):
    """The scene on the library's plate, under a finger that moves as a board's recording says it did."""
    position = recording.read("position")
    position[: np.argmax(np.isfinite(position))] = position[np.isfinite(position)][0]
    same = hr.Finger.sampled(position, rate=RATE, normal_load=0.4, mechanics=MECHANICS)
    return hr.render(replace(scene, finger=same, simulation={"sensor_noise": noise}))


def sensed_error(recording, start=int(0.3 * RATE)):
    """Error of the middle of the plate by its sensors, 20-500 Hz, over the texture, from sample `start` on."""
    reference = recording.read("reference", start)
    error = np.fft.rfft(recording.read("sensed", start).mean(axis=1) - reference)
    frequency = np.fft.rfftfreq(len(reference), 1 / RATE)
    inside = (frequency >= 20) & (frequency <= 500)
    return np.linalg.norm(error[inside]) / np.linalg.norm(np.fft.rfft(reference)[inside])


def driven(log, start, stop):
    """Samples from which on it drove between `start` and `stop`; none where there is nothing between."""
    if start >= stop:
        return []
    changes = [(int(line[0]), line[2] == "1") for line in log if line[1] == "drives"]
    ends = [sample for sample, _ in changes[1:]] + [2**62]
    return [
        sample for (sample, drives), end in zip(changes, ends, strict=True) if drives and sample < stop and end > start
    ]
