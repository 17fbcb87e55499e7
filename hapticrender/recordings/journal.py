"""The journal of a run: an append-only Sun AU file with its header as JSON in the annotation field.

64-bit big-endian floats, one column a signal, data size "unknown, read to the end": every audio tool opens it, also
after the process that wrote it was killed (libsndfile up to 1024 columns, 507 bands on a plate).
"""

import itertools
import json
import os
import struct
import threading
import weakref
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import Validated, check_names, checked, flag, number, numbers, option, parameter, require, text
from hapticrender.protocols import Array
from hapticrender.touch.scene import Scene

FORMAT = "hapticrender recording"
VERSION = 2
AU_HEAD = struct.Struct(">4s5I")  # magic, data offset, data size, encoding, rate, channels
AU_MAGIC, AU_UNKNOWN_SIZE, AU_DOUBLE = b".snd", 0xFFFFFFFF, 7
JOURNAL_DTYPE = np.dtype(">f8")
CHUNK_VALUES = 2**20  # numbers read at once
OPEN: weakref.WeakValueDictionary[str, BinaryIO] = weakref.WeakValueDictionary()  # journals written here, by real path
LONGEST_NOTE = 2**26  # bytes of header
MOTION_SOURCES = ("true", "sensors", "inferred", "unknown")
_COLUMNS, _MARKS = ("frequency", "wavenumber", "phase"), ("modulated", "differentiated", "spatial")  # of bands


def _places(key: str, value: Any) -> tuple[str, ...]:
    """Return the names of 1 to 1024 evaluation points."""
    require(isinstance(value, list | tuple) and 1 <= len(value) <= 1024, key, value, "1 to 1024 names")
    names = tuple(text(key, name) for name in value)
    require(len(set(names)) == len(names), key, names, "different names")
    return names


def _row(key: str, value: Any) -> Array:
    """Return a list of numbers, which may be empty, as an array."""
    return np.array(() if value == [] else numbers(key, value, least=-1e12, most=1e12), float)


def _noise(key: str, value: Any) -> tuple[float, ...]:
    """Return a noise for each place; one number is that of all."""
    if isinstance(value, list | tuple | np.ndarray):
        return numbers(key, value, least=0.0, most=1e12)
    return (number(key, value, least=0.0, most=1e12),)


def _bands(key: str, value: Any) -> Bands:
    """Return bands, also from their JSON object."""
    if isinstance(value, Bands):
        return value
    require(isinstance(value, dict), key, value, "an object")
    fields: dict[str, Any] = {name: _row(f"{key}.{name}", value.get(name)) for name in _COLUMNS}
    pairs, unfelt = value.get("envelope"), value.get("unfelt", [])
    if pairs is not None:
        good = isinstance(pairs, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in pairs)
        require(good, f"{key}.envelope", pairs, "pairs of real and imaginary part")
        fields["envelope"] = _row(f"{key}.envelope", [part for pair in pairs for part in pair]).view(complex)
    require(isinstance(unfelt, list), f"{key}.unfelt", unfelt, "a list")
    marks: dict[str, Any] = {name: flag(f"{key}.{name}", value.get(name, False)) for name in _MARKS}
    return Bands(**fields, **marks, unfelt=tuple(text(f"{key}.unfelt", each, 1000) for each in unfelt))


@dataclass(frozen=True, kw_only=True)
class Header(Validated):
    """Meaning and origin of the columns of a recording; a field out of its bounds is a ValueError or TypeError.

    `motion_source` is "true" (of a simulation or an independent instrument), "sensors" (computed from the sensed
    signals, so that errors of the sensors do not show), "inferred" (computed from another quantity by a law that is
    assumed, such as friction from an amplitude), or "unknown" (no sensors).
    """

    scene: str = checked(text, longest=2**26, lines=True)  # as TOML
    name: str = checked(text)  # of the scene
    device: str = checked(text)
    method: str = checked(text)
    seed: int = parameter(most=2**63 - 1)
    rate: float = parameter(unit="Hz", least=1e-3, most=1e9)  # exact; the AU header holds it rounded
    duration: float = parameter(unit="s", most=1e9)  # of the scene, 0 of a live session; a killed run is shorter
    tolerance: float = parameter(most=1e3)  # largest relative waveform error of the scene
    settle: float = parameter(unit="s", most=1e9)  # before the scene is judged
    bands: Bands = checked(_bands)
    drive_channels: int = parameter(2, most=1024)
    sensed_channels: int = parameter(2, most=1024)
    places: tuple[str, ...] = checked(_places, ("centre", "end 1", "end 2"))  # evaluation points, columns of motion
    drive_limit: float | None = parameter(None, most=1e12)  # of either sign; None where unknown
    unit: str = checked(text, "m")  # of sensors, motion and targets
    drive_unit: str = checked(text, "A")
    profile: tuple[float, ...] | None = checked(numbers, None, least=-1e6, most=1e6)  # target at each place over first
    motion_source: str = option("true", *MOTION_SOURCES)
    sensed_noise: tuple[float, ...] = checked(_noise, (0.0,))  # rms of the sensors' white noise in the motion, a place
    calibration: float = parameter(0.0, most=1e3)  # relative uncertainty of the sensors' gain; 0 where it is not known
    block: int | None = parameter(None, least=1, most=1e6)  # samples of the driver's; None, as the next, where unknown
    delay: int | None = parameter(None, least=1, most=1e6)  # samples from a sensed one to the drive computed from it

    def __post_init__(self) -> None:
        super().__post_init__()
        fits = self.profile is None or len(self.profile) == len(self.places)
        require(fits, "profile", self.profile, "one number a place")
        fits = len(self.sensed_noise) in (1, len(self.places))
        require(fits, "sensed_noise", self.sensed_noise, "one number, or one a place")

    @classmethod
    def of(cls, scene: Scene, **rest: Any) -> Self:
        """Take name, device, duration, tolerance and settling time from a scene, but for what `rest` states."""
        own = {name: getattr(scene, name) for name in ("name", "device", "duration", "tolerance", "settle")}
        return cls(scene=scene.to_toml(), **own | rest)

    @cached_property
    def columns(self) -> dict[str, list[tuple[str, str]]]:
        """Name and unit of every column of each signal, in the order of the file."""
        parts = ((k + 1, part) for k in range(len(self.bands)) for part in ("re", "im"))
        return {
            "drive": [(f"drive {i + 1}", unit) for i, unit in enumerate(self.drive_units)],
            "sensed": [(f"sensed {i + 1}", self.unit) for i in range(self.sensed_channels)],
            "motion": [(f"motion {place}", self.unit) for place in self.places],
            "position": [("position", "m")],
            "normal_load": [("normal load", "N")],
            "flags": [("flags", "1")],
            "reference": [("reference", self.unit)],
            "target": [(f"target {k} {part}", self.unit) for k, part in parts],
        }

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Columns of each signal."""
        widths = [len(columns) for columns in self.columns.values()]
        pairs = zip(widths, np.cumsum(widths).tolist(), strict=True)
        return {name: slice(end - width, end) for name, (width, end) in zip(self.columns, pairs, strict=True)}

    @property
    def drive_units(self) -> tuple[str, ...]:
        """Unit of every drive channel: `drive_unit` names one for all, or one each with ", " between them."""
        units = tuple(self.drive_unit.split(", "))
        return units if len(units) == self.drive_channels else (self.drive_unit,) * self.drive_channels

    @cached_property
    def channels(self) -> list[tuple[str, str]]:
        """Name and unit of every column."""
        return [*itertools.chain(*self.columns.values())]

    def to_json(self) -> str:
        """Write all fields as one JSON object; numbers keep every digit."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "bands"}
        envelope = self.bands.envelope
        bands = {name: getattr(self.bands, name).tolist() for name in _COLUMNS}
        bands |= {name: getattr(self.bands, name) for name in (*_MARKS, "unfelt")}
        bands["envelope"] = None if envelope is None else [[z.real, z.imag] for z in envelope.tolist()]
        channels = [{"name": name, "unit": unit} for name, unit in self.channels]
        return json.dumps({"format": FORMAT, "version": VERSION, **values, "bands": bands, "channels": channels})

    @classmethod
    def from_json(cls, note: str, where: str = "header") -> Self:
        """Read what `to_json` wrote, checking every field; `where` names the file in an error."""
        try:
            values = json.loads(note)
            require(isinstance(values, dict) and values.get("format") == FORMAT, "format", note[:40], repr(FORMAT))
            require(values.get("version") == VERSION, "version", values.get("version"), f"{VERSION}")
            own = {name: value for name, value in values.items() if name not in ("format", "version", "channels")}
            required = {entry.name: None for entry in fields(cls) if entry.default is MISSING}
            check_names(own, cls.names())
            return cls(**{**required, **own})
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise ValueError(f"{where}: not a recording of this library ({error})") from error


def journal_head(header: Header) -> bytes:
    """AU header and annotation, padded with zeros to a multiple of 8 bytes."""
    note = header.to_json().encode("ascii")
    note += b"\0" * (8 - len(note) % 8)
    offset = AU_HEAD.size + len(note)
    rate, columns = max(1, round(header.rate)), len(header.channels)
    return AU_HEAD.pack(AU_MAGIC, offset, AU_UNKNOWN_SIZE, AU_DOUBLE, rate, columns) + note


def refuse_open(path: Path) -> None:
    """Refuse to replace a journal that is being written."""
    file = OPEN.get(os.path.realpath(path))
    if file is not None and not file.closed:
        raise ValueError(f"{path}: is being recorded: end that first, or choose another name")


def refuse_others(path: Path) -> None:
    """Refuse to replace a file that is not empty and no journal, of whatever version and however damaged."""
    if path.is_file() and path.stat().st_size:
        with path.open("rb") as file:
            start = file.read(100)
        if not (start.startswith(AU_MAGIC) and FORMAT.encode() in start):
            raise ValueError(f"{path}: is there and no recording of this library: choose another name")


class JournalFrames:
    """Frames of a journal after `offset` bytes, read at every access; a file that is cut meanwhile is an error."""

    def __init__(self, path: Path, offset: int, columns: int) -> None:
        self.path, self._offset, self._columns = path, offset, columns
        self._file = path.open("rb", buffering=0)  # stays the same file where another one takes its name
        self._lock = threading.Lock()
        weakref.finalize(self, self._file.close)
        self._row = columns * JOURNAL_DTYPE.itemsize
        self._count = max(0, os.fstat(self._file.fileno()).st_size - offset) // self._row

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, rows: slice) -> Array:
        """Read a slice of the rows as native floats (n, columns)."""
        start, stop, step = rows.indices(self._count)
        count = max(0, stop - start) * self._columns
        with self._lock:
            self._file.seek(self._offset + start * self._row)
            data = np.fromfile(self._file, JOURNAL_DTYPE, count)
        if len(data) < count:
            raise ValueError(f"{self.path}: was cut to fewer than {self._count} samples while it was open")
        return data.reshape(-1, self._columns)[::step].astype(float)

    def __reduce__(self) -> Any:
        """Pickle as an array."""
        return np.asarray, (self[:],)


def read_journal(path: Path) -> tuple[Header, Array | JournalFrames]:
    """Header and frames (n, columns) of a journal; a frame cut short at the end is left out."""
    with path.open("rb") as file:
        head = file.read(AU_HEAD.size)
        if len(head) < AU_HEAD.size or head[:4] != AU_MAGIC:
            raise ValueError(f"{path}: not a Sun AU file, so no journal of this library")
        _, offset, _, encoding, _, columns = AU_HEAD.unpack(head)
        note = file.read(min(max(0, offset - AU_HEAD.size), LONGEST_NOTE)).rstrip(b"\0")
    header = Header.from_json(note.decode("ascii", "replace"), str(path))
    if encoding != AU_DOUBLE or columns != len(header.channels):
        raise ValueError(f"{path}: {encoding=}, {columns=}, expected {AU_DOUBLE} and {len(header.channels)}")
    return header, JournalFrames(path, offset, columns)


def column(header: Header, frames: Array, name: str) -> Array:
    """One signal of `frames` by name, as a native array; a view where the bytes allow it.

    The target is complex, flags are integers, position, load and reference have one dimension.
    """
    values = np.asarray(frames[:, header.slices[name]], float)
    if name == "target":
        return np.ascontiguousarray(values).view(complex)
    if name == "flags":
        return np.nan_to_num(values[:, 0]).clip(0, 2**31).astype(np.int64)
    return values[:, 0] if name in ("position", "normal_load", "reference") else values


def join(header: Header, signals: dict[str, Array]) -> Array:
    """Frames (n, columns) from signals by name; the inverse of `column`, and it checks every shape."""
    for name in header.slices:
        require(name in signals, name, None, "an array with a row a sample")
    count = len(signals["drive"])
    frames = np.empty((count, len(header.channels)))
    for name, columns in header.slices.items():
        values = np.asarray(signals[name])
        values = values[:, None] if values.ndim == 1 else values
        width = columns.stop - columns.start
        if name == "target":
            values = np.ascontiguousarray(values, complex).view(float)
        if values.shape != (count, width):
            raise ValueError(f"{name} has shape {np.shape(signals[name])}, expected {count} samples, {width} columns")
        frames[:, columns] = values
    return frames


def chunks(frames: Any, columns: int, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Array]:
    """Yield every `step`-th frame from `start` to `stop`, a bounded number at a time."""
    last = len(frames) if stop is None else min(stop, len(frames))
    size = step * max(1, CHUNK_VALUES // (max(1, columns) * step))
    for first in range(start, last, size):
        yield np.asarray(frames[first : min(first + size, last) : step], float)


def write_journal(path: Path, header: Header, frames: Any) -> None:
    """Write a whole journal at once."""
    with path.open("wb") as file:
        file.write(journal_head(header))
        for block in chunks(frames, len(header.channels)):
            file.write(block.astype(JOURNAL_DTYPE).tobytes())
