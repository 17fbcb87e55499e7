"""The journal of a run: what its columns mean, and how they lie in the file.

The journal is an append-only Sun AU file: 64-bit big-endian floats, one column
a signal, data size "unknown, read to the end", so that every audio tool opens
it even if the process that wrote it was killed (libsndfile up to 1024 columns,
507 bands on a plate).  All that the columns mean stands as JSON in the
annotation field.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
CHUNK = 65536  # frames


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
        Seed of the run.
    rate : float
        Exact sampling rate (Hz); the AU header holds it rounded.
    duration : float
        Duration that the scene asks for (s); a killed run is shorter.
    tolerance : float
        Relative amplitude error that the scene allows.
    settle : float
        Time that the scene allows for settling before it is judged (s).
    bands : Bands
        Carriers, and constant envelopes where the texture has them.
    drive_channels, sensed_channels : int
        Columns of drive and of sensed signals.
    places : tuple of str
        Names of the judged places, one column of motion each.
    drive_limit : float or None
        Largest drive (either sign) that the device takes; None where unknown.
    unit, drive_unit : str
        Of the sensors, motion and targets; of the drive.
    profile : tuple of float, or None
        What is wanted at each place, as a multiple of the target; None: the same everywhere.
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
        """How many columns each signal takes, in the order of the file."""
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
        """Everything in one JSON object; numbers survive to the last bit."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "bands"}
        envelope = self.bands.envelope
        bands = {name: getattr(self.bands, name).tolist() for name in ("frequency", "wavenumber", "phase")}
        bands |= {name: getattr(self.bands, name) for name in ("modulated", "differentiated", "unfelt")}
        bands["envelope"] = None if envelope is None else [[z.real, z.imag] for z in envelope.tolist()]
        channels = [{"name": name, "unit": unit} for name, unit in self.channels]
        return json.dumps({"format": FORMAT, "version": VERSION, **fields, "bands": bands, "channels": channels})

    @classmethod
    def from_json(cls, text: str, where: str = "header") -> Header:
        """Read what `to_json` wrote; `where` names the file in an error."""
        try:
            fields = json.loads(text)
            if fields.pop("format") != FORMAT:
                raise KeyError("format")
            version = fields.pop("version")
            if version != VERSION:
                raise ValueError(f"{version=} of the header is unknown, this library reads {VERSION}")
            del fields["channels"]
            lists = {name: tuple(fields[name]) for name in ("places", "profile") if fields.get(name) is not None}
            return cls(**{**fields, "bands": _bands(**fields["bands"]), **lists})
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{where}: not a recording of this library ({error})") from error


def _bands(
    frequency: list[float],
    wavenumber: list[float],
    phase: list[float],
    envelope: list[Any] | None,
    modulated: bool = False,
    differentiated: bool = False,
    unfelt: Sequence[str] = (),
) -> Bands:
    constant = None if envelope is None else np.array([complex(re, im) for re, im in envelope], complex)
    return Bands(
        frequency=np.array(frequency, float),
        wavenumber=np.array(wavenumber, float),
        phase=np.array(phase, float),
        envelope=constant,
        modulated=modulated,
        differentiated=differentiated,
        unfelt=tuple(unfelt),
    )


def journal_head(header: Header) -> bytes:
    """AU header and annotation, padded with zeros to a multiple of 8 bytes."""
    note = header.to_json().encode("ascii")
    note += b"\0" * (8 - len(note) % 8)
    offset = AU_HEAD.size + len(note)
    rate, columns = max(1, round(header.rate)), len(header.channels)
    return AU_HEAD.pack(AU_MAGIC, offset, AU_UNKNOWN_SIZE, AU_DOUBLE, rate, columns) + note


def read_journal(path: Path) -> tuple[Header, Array]:
    """Header and memory-mapped frames (n, columns) of a journal; a frame cut short at the end is left out."""
    with path.open("rb") as file:
        head = file.read(AU_HEAD.size)
        if len(head) < AU_HEAD.size or head[:4] != AU_MAGIC:
            raise ValueError(f"{path}: not a Sun AU file, so no journal of this library")
        _, offset, _, encoding, _, columns = AU_HEAD.unpack(head)
        note = file.read(max(0, offset - AU_HEAD.size)).rstrip(b"\0")
    header = Header.from_json(note.decode("ascii", "replace"), str(path))
    if encoding != AU_DOUBLE or columns != len(header.channels):
        raise ValueError(f"{path}: {encoding=}, {columns=}, expected {AU_DOUBLE} and {len(header.channels)}")
    frames = max(0, path.stat().st_size - offset) // (columns * JOURNAL_DTYPE.itemsize)
    if frames == 0:
        return header, np.empty((0, columns))
    return header, np.memmap(path, JOURNAL_DTYPE, "r", offset, (frames, columns))


def split(header: Header, frames: Array) -> dict[str, Array]:
    """Signals by name, as native arrays: target complex, flags integer, position and load one-dimensional."""
    return {name: column(header, frames, name) for name in header.slices}


def column(header: Header, frames: Array, name: str) -> Array:
    """One signal of `frames` by name; a view where the bytes allow it."""
    values = np.asarray(frames[:, header.slices[name]], float)
    if name == "target":
        return np.ascontiguousarray(values).view(complex)
    if name == "flags":
        return values[:, 0].astype(np.int64)
    return values[:, 0] if name in ("position", "normal_load") else values


def join(header: Header, signals: dict[str, Array], dtype: Any = float) -> Array:
    """Frames (n, columns) from signals by name; the inverse of `split`, and it checks every shape."""
    count = len(signals["drive"])
    frames = np.empty((count, len(header.channels)), dtype)
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


def chunks(frames: Array) -> Iterator[Array]:
    """Native blocks of a long array, so that a mapped file never has to fit into memory."""
    for start in range(0, len(frames), CHUNK):
        yield np.asarray(frames[start : start + CHUNK], float)


def write_journal(path: Path, header: Header, frames: Array) -> None:
    """Write a whole journal at once."""
    with path.open("wb") as file:
        file.write(journal_head(header))
        for block in chunks(frames):
            file.write(block.astype(JOURNAL_DTYPE).tobytes())
