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

from hapticrender import _polynomials
from hapticrender._lanes import WIDTH, aligned

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
    names = ("S", "C", "A", "R", "S_SHORT", "C_SHORT", "A_SHORT", "R_SHORT")
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
        sections = (self.numbers.filter, self.numbers.law)
        self.filter, self.law = (in_delta(s) if dtype == np.float32 else np.array(s) for s in sections)

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


def drive_per_metre(tables):
    """Of every coordinate and band, from the look-up table, shape (coordinates, bands)."""
    at = tables.tone[0] / tables.numbers.table_step
    return 1.0 / np.array([np.interp(at, np.arange(row.size), row) for row in tables.gain])
