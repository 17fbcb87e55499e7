"""The C references: compiled by the machine's own compiler with its best flags, called through ctypes."""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from hapticrender.compiled import polynomials as _polynomials
from hapticrender.compiled.lanes import WIDTH, aligned
from hapticrender.control.bank import rows as row
from hapticrender.control.bank.observer import FORGET
from hapticrender.control.blocks import state as block_state

HERE = Path(__file__).parent
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared"]
WIDE = "-mprefer-vector-width=512"  # gcc and clang for x86 only
NAMES = {np.float64: "double", np.float32: "single"}
DOUBLES = ctypes.POINTER(ctypes.c_double)


class NoCompiler(RuntimeError):
    """The machine has no C compiler."""


def compiler() -> str:
    """Name of the C compiler, from CC or the usual ones."""
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and shutil.which(name):
            return name
    raise NoCompiler("no C compiler: none of $CC, cc, gcc, clang is there")


@cache
def library(source: str, *options: str) -> ctypes.CDLL:
    """Compile a source of this folder, once a machine and content, and load it."""
    text = (HERE / source).read_bytes()
    stamp = hashlib.sha256(b"\0".join([text, *(each.encode() for each in options)])).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"hapticrender-native-{os.getuid() if hasattr(os, 'getuid') else 0}"
    folder.mkdir(mode=0o700, exist_ok=True)
    built = folder / f"{Path(source).stem}-{stamp}.so"
    if not built.exists():
        flags = [*FLAGS, *options]
        for wide in ([WIDE], []):
            command = [compiler(), *flags, *wide, str(HERE / source), "-lm", "-o", f"{built}.part"]
            found = subprocess.run(command, capture_output=True, text=True)
            if found.returncode == 0:
                break
        else:
            raise RuntimeError(f"{' '.join(command)}: {found.stderr}")
        os.replace(f"{built}.part", built)
    return ctypes.CDLL(str(built))


def _coefficients() -> list[str]:
    names = [name + short for short in ("", "_SHORT") for name in ("S", "C", "A", "R", "W")]
    return [f"-DPOLY_{name}={','.join(map(repr, getattr(_polynomials, name)))}" for name in names]


def _pointer(array: np.ndarray) -> DOUBLES:
    return array.ctypes.data_as(DOUBLES)


def in_delta(section: tuple[float, ...]) -> np.ndarray:
    """Second-order section in powers of z - 1."""
    b0, b1, b2, a1, a2 = section
    return np.array([b0, 2 * b0 + b1, b0 + b1 + b2, 2 + a1, 1 + a1 + a2])


class NaivePolar:
    """`naive.c` with the parameters of a polar controller on two coordinates, fixed carriers and constant targets."""

    band = np.dtype(
        [(name, float) for name in ("frequency", "turns", "amplitude", "re", "im")] + [("channel", float, (2, 9))]
    )

    def __init__(self, controller):
        tables = controller.tables
        self.numbers, count = tables.numbers, tables.tone.shape[1]
        self.bands = np.zeros(count, self.band)
        frequency, _, phase, re, im = tables.tone
        self.bands["frequency"], self.bands["turns"] = frequency, np.mod(phase, 1.0)
        self.bands["amplitude"] = np.hypot(re, im)
        self.bands["re"], self.bands["im"] = re / np.hypot(re, im), im / np.hypot(re, im)
        self.bands["channel"][:, :, 0] = drive_per_metre(tables).T
        self.run_c = library("naive.c").naive_run

    def run(self, sides):
        """Drive (samples, 2) from the watched displacements (samples, 2), before any limit."""
        drive = np.zeros_like(sides)
        self.run_c(
            self.bands.ctypes.data_as(ctypes.c_void_p),
            len(self.bands),
            ctypes.c_double(self.numbers.rate),
            _pointer(np.array(self.numbers.filter)),
            _pointer(np.array(self.numbers.law)),
            _pointer(sides),
            _pointer(drive),
            len(sides),
        )
        return drive


class TunedPolar:
    """`polar.c`, of double or single precision."""

    def __init__(self, controller, dtype):
        tables, width = controller.tables, WIDTH[np.dtype(dtype)]
        self.numbers, count = tables.numbers, tables.tone.shape[1]
        self.tiles = -(-count // width)
        fields = [("frequency", float, width), ("turns", float, width)]
        fields += [(name, dtype, width) for name in ("amplitude", "re", "im")] + [("channel", dtype, (2, 9, width))]
        kind = np.dtype(fields)
        self.memory = aligned((self.tiles * kind.itemsize // 8,))
        self.state = self.memory.view(kind)
        frequency, _, phase, re, im = tables.tone
        amplitude = np.hypot(re, im)
        gains = drive_per_metre(tables)
        rows = {"frequency": frequency, "turns": np.mod(phase, 1.0), "amplitude": amplitude}
        rows |= {"re": re / amplitude, "im": im / amplitude}
        for name, values in rows.items():
            self.state[name] = np.pad(values, (0, self.tiles * width - count)).reshape(self.tiles, width)
        for c in range(2):
            padded = np.pad(gains[c], (0, self.tiles * width - count)).reshape(self.tiles, width)
            self.state["channel"][:, c, 0] = padded
        options = [*_coefficients(), *(["-DSINGLE"] if dtype == np.float32 else [])]
        self.run_c = getattr(library("polar.c", *options), f"polar_{NAMES[dtype]}")
        self.filter, self.law = in_delta(self.numbers.filter), in_delta(self.numbers.law)

    def run(self, sides):
        """Drive (samples, 2) from the watched displacements (samples, 2), before any limit."""
        drive = np.zeros_like(sides)
        self.run_c(
            self.memory.ctypes.data_as(ctypes.c_void_p),
            self.tiles,
            ctypes.c_double(self.numbers.rate),
            _pointer(self.filter),
            _pointer(self.law),
            _pointer(sides),
            _pointer(drive),
            len(sides),
        )
        return drive


class TunedBlock:
    """`block.c` on a copy of what a `BlockController` holds, from its state of the moment on."""

    names = ("rate", "block_rate", "g", "dc", "dc_drift", "lead", "integral", "back", "forget", "ramp", "fast_pole")
    names += ("slow_pole", "fast_level", "slow_level", "limit", "sensed_limit", "step")

    def __init__(self, controller):
        tables, state = controller.tables, controller.state
        numbers, sample, block, group = tables.bank.numbers, tables.sample, len(state.place), block_state.GROUP
        if block % group or sample.drive_step <= 0.0 or len(tables.bank.shape) != 2 or len(tables.bank.speak) != 2:
            raise ValueError(f"{block=}: must be a multiple of {group}, on two coordinates and two stepped channels")
        self.arrays = [
            same(each) for each in (state.bank.band, state.bank.loop, state.bank.law, state.held, state.phase)
        ]
        self.arrays += [same(state.table), state.inverse[0].copy(), state.bank.level.copy()]
        values = {
            **{name: getattr(sample, name) for name in ("rate", "dc", "dc_drift", "lead", "sensed_limit")},
            **{name: getattr(numbers, name) for name in ("fast_pole", "slow_pole", "integral", "ramp")},
            **{name: max(min(getattr(numbers, name), 1e30), -1e30) for name in ("fast_level", "slow_level")},
            "block_rate": numbers.rate,
            "g": float(state.gain[0]),
            "back": 0.0,
            "forget": FORGET,
            "limit": sample.drive_limit,
            "step": sample.drive_step,
        }
        rest = [tables.bank.listen.ravel(), tables.bank.speak.ravel(), tables.bank.shape, np.zeros(4)]
        self.numbers = np.concatenate([[values[name] for name in self.names], *rest]).astype(float)
        self.tiles, self.block = len(state.bank.band), block
        rows = {name: getattr(row, name) for name in dir(row) if name.isupper()}
        rows |= {name: getattr(block_state, name) for name in dir(block_state) if name.isupper()}
        rows |= {"TABLE_ROWS": state.table.shape[1], "HELD_ROWS": state.held.shape[1]}
        rows["LAW_TILE_ROWS"] = state.bank.law.shape[1]
        dtype = state.table.dtype.type
        options = [f"-DR_{name}={value}" for name, value in sorted(rows.items()) if isinstance(value, int)]
        options += [*_coefficients(), *(["-DSINGLE"] if dtype == np.float32 else [])]
        self.run_c = getattr(library("block.c", *options), f"block_{NAMES[dtype]}")

    def run(self, sensed):
        """Drive (samples, 2) from whole blocks of the sensors (samples, 2)."""
        drive = np.zeros_like(sensed)
        self.run_c(
            *(each.ctypes.data_as(ctypes.c_void_p) for each in self.arrays),
            _pointer(self.numbers),
            self.tiles,
            self.block,
            _pointer(sensed),
            _pointer(drive),
            len(sensed) // self.block,
        )
        return drive


def same(array):
    """Copy of an array of vectors, aligned like it."""
    copy = aligned(array.shape, array.dtype)
    copy[:] = array
    return copy


def drive_per_metre(tables):
    """Of every coordinate and band, from the look-up table, shape (coordinates, bands)."""
    at = tables.tone[0] / tables.numbers.table_step
    return 1.0 / np.array([np.interp(at, np.arange(each.size), each) for each in tables.gain])
