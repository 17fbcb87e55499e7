"""The journal of a run: its header, and how its columns lie in the file.

The journal is an append-only Sun AU file: 64-bit big-endian floats, one column
a signal, data size "unknown, read to the end", so that every audio tool opens
it even if the process that wrote it was killed (libsndfile up to 1024 columns,
507 bands on a plate).  The header stands as JSON in the annotation field.
"""

from __future__ import annotations

import json
import math
import os
import struct
import threading
import weakref
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.touch.scene import Scene

FORMAT = "hapticrender recording"
VERSION = 1
AU_HEAD = struct.Struct(">4s5I")  # magic, data offset, data size, encoding, rate, channels
AU_MAGIC, AU_UNKNOWN_SIZE, AU_DOUBLE = b".snd", 0xFFFFFFFF, 7
JOURNAL_DTYPE = np.dtype(">f8")
CHUNK_VALUES = 2**20  # numbers read at once
LONGEST_NOTE = 2**26  # bytes of header
MOTION_SOURCES = ("true", "sensors", "unknown")
NUMBERS: dict[str, tuple[type, float, float, str]] = {  # type, least, largest, unit
    "seed": (int, 0, 2**63 - 1, ""),
    "rate": (float, 1e-3, 1e9, "Hz"),
    "duration": (float, 0, 1e9, "s"),
    "tolerance": (float, 0, 1e3, "1"),
    "settle": (float, 0, 1e9, "s"),
    "drive_channels": (int, 0, 1024, ""),
    "sensed_channels": (int, 0, 1024, ""),
    "drive_limit": (float, 0, 1e12, ""),
}
WORDS = ("name", "device", "method", "unit", "drive_unit", "motion_source")


@dataclass(frozen=True, kw_only=True)
class Header:
    """What the columns of a recording mean, and where they come from.

    Parameters
    ----------
    scene : str
        The scene as TOML.
    name, device, method : str
        Names of the scene, of the device and of the control method.
    seed : int
        Seed of the run, >= 0.
    rate : float
        Exact sampling rate (Hz), 1e-3 to 1e9; the AU header holds it rounded.
    duration : float
        Duration of the scene (s), >= 0; a killed run is shorter.
    tolerance : float
        Largest relative amplitude error of the scene, 0 to 1000.
    settle : float
        Settling time of the scene before it is judged (s), >= 0.
    bands : Bands
        Carriers, and constant envelopes where the texture has them.
    drive_channels, sensed_channels : int
        Columns of drive and of sensed signals, 0 to 1024.
    places : tuple of str
        Names of the evaluation points, one column of motion each, 1 to 1024.
    drive_limit : float or None
        Largest drive (either sign) that the device takes; None where unknown.
    unit, drive_unit : str
        Of the sensors, motion and targets; of the drive.
    profile : tuple of float, or None
        Target at each place, as a multiple of the target at the first; None: the same everywhere.
    motion_source : str
        "true" (known by a simulation or an independent instrument), "sensors" (computed from the sensed signals,
        so that errors of the sensors do not show), or "unknown" (no sensors).

    Raises
    ------
    ValueError
        A field has another type, or lies outside its bounds.
    """

    scene: str
    name: str
    device: str
    method: str
    seed: int
    rate: float
    duration: float
    tolerance: float
    settle: float
    bands: Bands
    drive_channels: int = 2
    sensed_channels: int = 2
    places: tuple[str, ...] = ("centre", "end 1", "end 2")
    drive_limit: float | None = None
    unit: str = "m"
    drive_unit: str = "A"
    profile: tuple[float, ...] | None = None
    motion_source: str = "true"

    def __post_init__(self) -> None:
        for name, (kind, least, most, unit) in NUMBERS.items():
            value = getattr(self, name)
            if value is not None or name != "drive_limit":
                _check_number(name, value, kind, least, most, unit)
        _require(isinstance(self.scene, str), "scene", self.scene, "TOML text")
        for name in WORDS:
            _check_word(name, getattr(self, name))
        _require(self.motion_source in MOTION_SOURCES, "motion_source", self.motion_source, str(MOTION_SOURCES))
        _require(isinstance(self.places, tuple) and 1 <= len(self.places) <= 1024, "places", self.places, "1 to 1024")
        for name in self.places:
            _check_word("places", name)
        _require(len(set(self.places)) == len(self.places), "places", self.places, "different names")
        if self.profile is not None:
            fits = isinstance(self.profile, tuple) and len(self.profile) == len(self.places)
            _require(fits, "profile", self.profile, "one number a place")
            for value in self.profile:
                _check_number("profile", value, float, -1e6, 1e6, "1")

    @classmethod
    def of(cls, scene: Scene, **rest: Any) -> Header:
        """Take name, device, duration, tolerance and settling time from a scene."""
        return cls(
            scene=scene.to_toml(),
            name=scene.name,
            device=scene.device,
            duration=float(scene.duration),
            tolerance=float(scene.tolerance),
            settle=float(scene.settle),
            **rest,
        )

    @property
    def widths(self) -> dict[str, int]:
        """Number of columns of each signal, in the order of the file."""
        return {
            "drive": self.drive_channels,
            "sensed": self.sensed_channels,
            "motion": len(self.places),
            "position": 1,
            "normal_load": 1,
            "flags": 1,
            "target": 2 * len(self.bands),
        }

    @property
    def slices(self) -> dict[str, slice]:
        """Columns of each signal."""
        ends = np.cumsum(list(self.widths.values())).tolist()
        return {name: slice(end - width, end) for (name, width), end in zip(self.widths.items(), ends, strict=True)}

    @property
    def drive_units(self) -> tuple[str, ...]:
        """Unit of every drive channel: `drive_unit` names one for all, or one each with ", " between them."""
        units = tuple(self.drive_unit.split(", "))
        return units if len(units) == self.drive_channels else (self.drive_unit,) * self.drive_channels

    @property
    def channels(self) -> list[tuple[str, str]]:
        """Name and unit of every column."""
        return [
            *((f"drive {i + 1}", unit) for i, unit in enumerate(self.drive_units)),
            *((f"sensed {i + 1}", self.unit) for i in range(self.sensed_channels)),
            *((f"motion {place}", self.unit) for place in self.places),
            ("position", "m"),
            ("normal load", "N"),
            ("flags", "1"),
            *((f"target {k + 1} {part}", self.unit) for k in range(len(self.bands)) for part in ("re", "im")),
        ]

    def to_json(self) -> str:
        """Write all fields as one JSON object; numbers keep every digit."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "bands"}
        envelope = self.bands.envelope
        bands = {name: getattr(self.bands, name).tolist() for name in ("frequency", "wavenumber", "phase")}
        bands |= {name: getattr(self.bands, name) for name in ("modulated", "differentiated", "unfelt")}
        bands["envelope"] = None if envelope is None else [[z.real, z.imag] for z in envelope.tolist()]
        channels = [{"name": name, "unit": unit} for name, unit in self.channels]
        return json.dumps({"format": FORMAT, "version": VERSION, **values, "bands": bands, "channels": channels})

    @classmethod
    def from_json(cls, text: str, where: str = "header") -> Header:
        """Read what `to_json` wrote, checking every field; `where` names the file in an error."""
        try:
            values = json.loads(text)
            _require(isinstance(values, dict) and values.get("format") == FORMAT, "format", text[:40], repr(FORMAT))
            version = values.get("version")
            _require(version == VERSION, "version", version, f"{VERSION}, the one that this library reads")
            own = {name: value for name, value in values.items() if name not in ("format", "version", "channels")}
            return cls(**_named_fields(own))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{where}: not a recording of this library ({error})") from error


def _named_fields(values: dict[str, Any]) -> dict[str, Any]:
    """Keyword arguments of `Header` from the values of its JSON object."""
    known = {entry.name: entry.default is MISSING for entry in fields(Header)}
    _require(values.keys() <= known.keys(), "fields", sorted(values.keys() - known.keys()), "known to this version")
    missing = [name for name, required in known.items() if required and name not in values]
    _require(not missing, "fields", missing, "present")
    for name in ("places", "profile"):
        if isinstance(values.get(name), list):
            values[name] = tuple(values[name])
    for name, (kind, *_) in NUMBERS.items():
        if kind is float and type(values.get(name)) is int and abs(values[name]) < 2**53:
            values[name] = float(values[name])
    return values | {"bands": _bands(values["bands"])}


def _bands(values: Any) -> Bands:
    """Bands from their JSON object."""
    _require(isinstance(values, dict), "bands", values, "an object")
    columns = {name: values.get(name) for name in ("frequency", "wavenumber", "phase")}
    for name, column in columns.items():
        _require(isinstance(column, list), f"bands.{name}", column, "a list of numbers")
        for value in column or ():
            _check_number(f"bands.{name}", value, float, -1e12, 1e12, "")
    envelope = values.get("envelope")
    if envelope is not None:
        pairs = isinstance(envelope, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in envelope)
        _require(pairs, "bands.envelope", envelope, "pairs of real and imaginary part")
        for value in (part for pair in envelope for part in pair):
            _check_number("bands.envelope", value, float, -1e12, 1e12, "")
        envelope = np.array([complex(*pair) for pair in envelope], complex)
    marks = {name: values.get(name, False) for name in ("modulated", "differentiated")}
    for name, mark in marks.items():
        _require(isinstance(mark, bool), f"bands.{name}", mark, "true or false")
    unfelt = values.get("unfelt", [])
    _require(isinstance(unfelt, list), "bands.unfelt", unfelt, "a list of texts")
    for text in unfelt:
        _check_word("bands.unfelt", text, 1000)
    arrays: dict[str, Any] = {name: np.array(column, float) for name, column in columns.items()}
    return Bands(**arrays, envelope=envelope, **marks, unfelt=tuple(unfelt))


def _require(good: bool, name: str, value: Any, bound: str) -> None:
    if not good:
        shown = repr(value)
        raise ValueError(f"{name} = {shown if len(shown) <= 60 else shown[:57] + '...'}: must be {bound}")


def _check_number(name: str, value: Any, kind: type, least: float, most: float, unit: str) -> None:
    numeric = type(value) is int or (kind is float and type(value) is float)
    good = numeric and math.isfinite(value) and least <= value <= most
    _require(
        good, name, value, f"{'a whole' if kind is int else 'a'} number from {least:g} to {most:g} {unit}".rstrip()
    )


def _check_word(name: str, value: Any, longest: int = 200) -> None:
    good = isinstance(value, str) and value.isprintable() and len(value) <= longest
    _require(good, name, value, f"a text of printable characters, at most {longest}")


def journal_head(header: Header) -> bytes:
    """AU header and annotation, padded with zeros to a multiple of 8 bytes."""
    note = header.to_json().encode("ascii")
    note += b"\0" * (8 - len(note) % 8)
    offset = AU_HEAD.size + len(note)
    rate, columns = max(1, round(header.rate)), len(header.channels)
    return AU_HEAD.pack(AU_MAGIC, offset, AU_UNKNOWN_SIZE, AU_DOUBLE, rate, columns) + note


class JournalFrames:
    """Frames of a journal, read from its file at every access: nothing is held, and a file cut meanwhile is an error.

    Parameters
    ----------
    path : Path
    offset : int
        Bytes before the first frame.
    columns : int
    """

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
        data = bytearray(max(0, stop - start) * self._row)
        view, done = memoryview(data), 0
        with self._lock:
            self._file.seek(self._offset + start * self._row)
            while done < len(data):
                count = self._file.readinto(view[done:])
                if not count:
                    raise ValueError(f"{self.path}: was cut to fewer than {self._count} samples while it was open")
                done += count
        return np.frombuffer(data, JOURNAL_DTYPE).reshape(-1, self._columns)[::step].astype(float)

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


def split(header: Header, frames: Array) -> dict[str, Array]:
    """Signals by name, as native arrays: target complex, flags integer, position and load one-dimensional."""
    return {name: column(header, frames, name) for name in header.slices}


def column(header: Header, frames: Array, name: str) -> Array:
    """One signal of `frames` by name; a view where the bytes allow it."""
    values = np.asarray(frames[:, header.slices[name]], float)
    if name == "target":
        return np.ascontiguousarray(values).view(complex)
    if name == "flags":
        return np.nan_to_num(values[:, 0]).clip(0, 2**31).astype(np.int64)
    return values[:, 0] if name in ("position", "normal_load") else values


def join(header: Header, signals: dict[str, Array]) -> Array:
    """Frames (n, columns) from signals by name; the inverse of `split`, and it checks every shape."""
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
