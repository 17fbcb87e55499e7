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

from benchmarks.timing import Absent
from hapticrender.control.kernel import LEAK
from hapticrender.control.records import SAMPLE_ROWS, TOEPLITZ, W, aligned
from hapticrender.mathx import COS, SIN

HERE = Path(__file__).parent
FLAGS = ["-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared"]
WIDE = "-mprefer-vector-width=512"  # gcc and clang for x86 only
DOUBLES = ctypes.POINTER(ctypes.c_double)
GROUP = 16  # samples, whose sums over the lanes fill a register
PAIRS = GROUP // 2  # of samples in a group, at +-0.5, 1.5, 2.5 ... samples about its middle
ROWS = {  # of the arrays that block.c works on: (tiles, rows, 8 lanes)
    "BAND": "LIVE COS SIN RAMP WEIGHT SHARE WANTED_RE WANTED_IM R_RE R_IM DR_RE DR_IM SEEN_RE SEEN_IM",
    "LOOP": "E_RE E_IM V_RE V_IM FAST_RE FAST_IM SLOW_RE SLOW_IM COMMAND_RE COMMAND_IM SLOPED_RE SLOPED_IM",
    "CHANNEL": "NOW_RE NOW_IM FROM_RE FROM_IM STEP_RE STEP_IM",
    "PHASE": "TURNS TURNED TO_MIDDLE",
}
AT = {name: i for names in ROWS.values() for i, name in enumerate(names.split())}
AT |= {f"{array}_ROWS": len(names.split()) for array, names in ROWS.items()}
AT |= {"GROUP": GROUP, "PAIRS": PAIRS, "TURN_COS": 4 * PAIRS, "TURN_SIN": 4 * PAIRS + 1, "TABLE_ROWS": 4 * PAIRS + 2}
AT |= {"HELD_ROWS": 4 + 2 * AT["CHANNEL_ROWS"], "FIRST_LAW": 0, "LAW_ROWS": 4, "LAW_TILE_ROWS": 16}


def compiler() -> str:
    """Name of the C compiler, from CC or the usual ones."""
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and shutil.which(name):
            return name
    raise Absent("no C compiler: none of $CC, cc, gcc, clang is there")


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


def _pointer(array: np.ndarray) -> DOUBLES:
    return array.ctypes.data_as(DOUBLES)


class NaivePolar:
    """`naive.c` with the numbers of a `NumpyPolar`."""

    band = np.dtype(
        [(name, float) for name in ("frequency", "turns", "amplitude", "re", "im")] + [("channel", float, (2, 9))]
    )

    def __init__(self, twin):
        self.bands = np.zeros(len(twin.frequency), self.band)
        for name, values in zip(self.band.names, (twin.frequency, np.mod(twin.turns, 1.0), twin.target, twin.unit.real,
                                                  twin.unit.imag), strict=False):  # fmt: skip
            self.bands[name] = values
        self.bands["channel"][:, :, 0] = (1.0 / twin.gain).T
        self.rate, self.sections = twin.rate, [np.array([*b, *a[1:]]) for b, a in (twin.filter, twin.law)]
        self.listen, self.run_c = twin.listen, library("naive.c").naive_run

    def run(self, sensed):
        """Drive (samples, 2) from sensed displacements (samples, 2), before any limit."""
        sides = np.ascontiguousarray(sensed @ self.listen.T)
        drive = np.zeros_like(sides)
        self.run_c(self.bands.ctypes.data_as(ctypes.c_void_p), len(self.bands), ctypes.c_double(self.rate),
                   *map(_pointer, self.sections), _pointer(sides), _pointer(drive), len(sides))  # fmt: skip
        return drive


class TunedBlock:
    """`block.c` on a copy of what a controller in blocks holds, from its present state on.

    The only place of the benchmarks that reads the internals of a controller: C has to start from the same numbers.
    """

    names = ("rate", "block_rate", "g", "dc", "dc_drift", "lead", "integral", "back", "leak", "ramp", "fast_smoothing")
    names += ("slow_smoothing", "fast_threshold", "slow_threshold", "limit", "sensed_limit", "step")

    def __init__(self, controller):
        p, state, tiles = controller.settings, controller.state[0], controller.tiles
        self.tiles, self.block = len(tiles), controller.block
        if self.block % GROUP or (p["coordinates"], p["channels"], p["sensors"]) != (2, 2, 2) or p["drive_step"] <= 0:
            raise ValueError(f"block={self.block}: must be a multiple of {GROUP}, on two stepped channels")
        if max(state["fast_open"], state["slow_open"]) > 0.0 or not (tiles["wavenumber"] == 0.0).all():
            raise ValueError("carriers must be fixed, and the controller in quiet")
        speak, q = p["drive_from_force"][:2], samples_of(controller)[TOEPLITZ]
        levels = np.array([*state["dc"], *state["dc_drift"]])
        self.arrays = [_bands(tiles), _loops(tiles), _laws(tiles), _held(tiles, speak)]
        self.arrays += [_phases(tiles, p["rate"], self.block)]
        self.arrays += [_tables(tiles, p["rate"], self.block), np.concatenate([np.zeros(self.block), q]), levels]
        values = {name: float(p[name]) for name in self.names if name in p.dtype.names}
        values |= {
            "block_rate": p["rate"] / self.block,
            "g": state["response_gain"],
            "lead": p["extrapolation"],
            "back": 0.0,
            "leak": LEAK,
            "ramp": p["fade_in"] * self.block,
            "limit": p["drive_limit"],
            "sensed_limit": p["sensor_limit"],
            "step": p["drive_step"],
        }
        rest = [p["coordinate_from_sensor"][:, :2], speak, p["pattern"], state["shaper"][:, :2]]
        numbers = [[values[name] for name in self.names], *(each.ravel() for each in rest)]
        self.numbers = np.concatenate(numbers).astype(float)
        options = [f"-DR_{name}={value}" for name, value in sorted(AT.items())]
        options += [f"-DPOLY_{name}={','.join(map(repr, each))}" for name, each in (("S", SIN), ("C", COS))]
        self.run_c = library("block.c", *options).block_run

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


def _rows(count, rows, **fields):
    """Array (count, rows, 8 lanes) with some of its rows set."""
    found = aligned((count, rows, W))
    for name, values in fields.items():
        found[:, AT[name.upper()]] = values
    return found


def samples_of(controller):
    """The controller's work array of a block's samples, shape (rows, block)."""
    address = int(controller.state["samples_at"][0])
    width = int(controller.settings["groups"] * controller.settings["group"])
    memory = (ctypes.c_double * (SAMPLE_ROWS * width)).from_address(address)
    return np.array(memory).reshape(SAMPLE_ROWS, width)


def _bands(tiles):
    same = {name: tiles[name] for name in ("weight", "r_re", "r_im")}
    same |= {"live": tiles["active"], "share": tiles["feedback"]}
    wanted = {"ramp": tiles["fade"], "wanted_re": tiles["setpoint_re"], "wanted_im": tiles["setpoint_im"]}
    return _rows(len(tiles), AT["BAND_ROWS"], **same, **wanted)


def _loops(tiles):
    """Loops of both coordinates of each tile in turn."""
    names = [f"{name}_{part}" for name in ("e", "v", "fast", "slow") for part in ("re", "im")]
    each = [
        _rows(len(tiles), AT["LOOP_ROWS"], **{name: tiles[name.replace("_", f"{i}_")] for name in names})
        for i in (0, 1)
    ]
    found = aligned((len(tiles), 2, AT["LOOP_ROWS"], W))
    found[:, 0], found[:, 1] = each
    return found


def _laws(tiles):
    """D and D' of each pair of coordinates."""
    found = aligned((len(tiles), 16, W))
    names = (f"{name}{i}{j}_{part}" for i in (0, 1) for j in (0, 1) for name in "ds" for part in ("re", "im"))
    for row, name in enumerate(names):
        found[:, row] = tiles[name]
    return found


def _held(tiles, speak):
    """Envelopes of the drive at the end of the last block, two rows for each coordinate before them."""
    found = aligned((len(tiles), AT["HELD_ROWS"], W))
    for channel in (0, 1):
        for part in ("re", "im"):
            row = 4 + AT["CHANNEL_ROWS"] * channel + AT[f"NOW_{part.upper()}"]
            found[:, row] = (
                speak[channel, 0] * tiles[f"last_force0_{part}"] + speak[channel, 1] * tiles[f"last_force1_{part}"]
            )
    return found


def _phases(tiles, rate, block):
    """Turns at the block's start, turns a block, and turns to the middle of the first group."""
    turn = tiles["frequency"] / rate
    values = {"turns": tiles["turns"] + tiles["phase"], "turned": block * turn, "to_middle": (PAIRS - 0.5) * turn}
    return _rows(len(tiles), AT["PHASE_ROWS"], **{name: np.mod(each, 1.0) for name, each in values.items()})


def _tables(tiles, rate, block):
    """Carriers of each pair of a group about its middle, the same times their distance, and the turn of a group."""
    found, angle = aligned((len(tiles), AT["TABLE_ROWS"], W)), 2 * np.pi * tiles["frequency"] / rate
    for i in range(PAIRS):
        cos, sin = np.cos((i + 0.5) * angle), np.sin((i + 0.5) * angle)
        for row, values in enumerate((cos, sin, (i + 0.5) / block * cos, (i + 0.5) / block * sin)):
            found[:, 4 * i + row] = values
    found[:, AT["TURN_COS"]], found[:, AT["TURN_SIN"]] = np.cos(GROUP * angle), np.sin(GROUP * angle)
    return found
