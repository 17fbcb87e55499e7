"""The journal of a run, and the formats in which a recording leaves the house.

The journal is an append-only Sun AU file: 64-bit big-endian floats, one column
a signal, data size "unknown, read to the end", so that every audio tool opens
it even if the process that wrote it was killed (libsndfile up to 1024 columns,
507 bands on a plate).  All that the columns mean stands as JSON in the
annotation field.
"""

from __future__ import annotations

import json
import os
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.errors import HapticError
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.touch.scene import Scene

FORMAT = "hapticrender recording"
VERSION = 1
AU_HEAD = struct.Struct(">4s5I")  # magic, data offset, data size, encoding, rate, channels
AU_MAGIC, AU_UNKNOWN_SIZE, AU_DOUBLE = b".snd", 0xFFFFFFFF, 7
JOURNAL_DTYPE = np.dtype(">f8")
COMMENT_LIMIT = 4000  # characters; libsndfile drops a longer WAV comment without a word
FLAC_CHANNELS = 8
CHUNK = 65536  # frames


class MissingExtra(HapticError, ImportError):
    """An optional part is not installed: says which extra brings it."""


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
        Largest drive (A, either sign) that the device takes; None where unknown.
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
    def channels(self) -> list[tuple[str, str]]:
        """Name and unit of every column."""
        return [
            *((f"drive {i + 1}", "A") for i in range(self.drive_channels)),
            *((f"sensed {i + 1}", "m") for i in range(self.sensed_channels)),
            *((f"motion {place}", "m") for place in self.places),
            ("position", "m"),
            ("normal load", "N"),
            ("flags", "1"),
            *((f"target {k + 1} {part}", "m") for k in range(len(self.bands)) for part in ("re", "im")),
        ]

    def to_json(self) -> str:
        """Everything in one JSON object; numbers survive to the last bit."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "bands"}
        envelope = self.bands.envelope
        bands = {name: getattr(self.bands, name).tolist() for name in ("frequency", "wavenumber", "phase")}
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
            return cls(**{**fields, "bands": _bands(**fields["bands"]), "places": tuple(fields["places"])})
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{where}: not a recording of this library ({error})") from error


def _bands(frequency: list[float], wavenumber: list[float], phase: list[float], envelope: list[Any] | None) -> Bands:
    constant = None if envelope is None else np.array([complex(re, im) for re, im in envelope], complex)
    return Bands(
        frequency=np.array(frequency, float),
        wavenumber=np.array(wavenumber, float),
        phase=np.array(phase, float),
        envelope=constant,
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


def read(path: str | os.PathLike[str]) -> tuple[Header, Array]:
    """Header and frames of a recording in any format that can be read back.

    Parameters
    ----------
    path : path-like
        A file whose name ends in .au, .npz or .h5.

    Returns
    -------
    header : Header
    frames : ndarray, shape (n, columns)
        Mapped from the file where it is a journal.
    """
    path = Path(path)
    reader = _known(path, READERS, "read")
    return reader(path)


def write(path: str | os.PathLike[str], header: Header, frames: Array) -> None:
    """Write a recording in the format that the suffix of `path` names; an older file goes only when this one is whole.

    Parameters
    ----------
    path : path-like
        Suffix .au (journal), .npz, .h5, .mat, .csv, .wav, .w64, .rf64 or .flac.
    header : Header
    frames : ndarray, shape (n, columns)
    """
    path = Path(path)
    writer = _known(path, WRITERS, "written")
    with replacing(path) as scratch:
        writer(scratch, header, frames)


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


def write_sound(
    path: str | os.PathLike[str],
    signal: Array,
    rate: float,
    full_scale: float | None = None,
    *,
    unit: str = "",
    bits: int = 16,
) -> float:
    """Write a signal as PCM sound for a person to listen to; the comment of the file states the scale.

    Parameters
    ----------
    path : path-like
        Suffix .wav, .w64, .rf64 or .flac.
    signal : ndarray, shape (n,) or (n, channels)
        In `unit`; what is not finite becomes silence.
    rate : float
        Sampling rate (Hz), > 0; sound files hold it rounded.
    full_scale : float or None
        Value that becomes digital full scale, > 0; larger ones are cut.  None: the signal's largest magnitude.
    unit : str
        Unit of the signal, for the comment.
    bits : int
        16 or 24.

    Returns
    -------
    float
        The full scale that was used, in `unit`.
    """
    path = Path(path)
    container = _known(path, SOUND_CONTAINERS, "written as sound")
    if bits not in (16, 24):
        raise ValueError(f"{bits=} must be 16 or 24")
    signal = np.nan_to_num(np.asarray(signal, float), nan=0.0, posinf=0.0, neginf=0.0)
    if full_scale is None:
        full_scale = float(np.abs(signal).max(initial=0.0)) or 1.0
    if not 0 < full_scale < np.inf:
        raise ValueError(f"{full_scale=} {unit} must be finite and > 0")
    comment = f"full scale = {full_scale:.6g} {unit}".rstrip()
    with replacing(path) as scratch:
        _write_audio(scratch, container, f"PCM_{bits}", np.clip(signal / full_scale, -1, 1), rate, comment)
    return full_scale


def _known(path: Path, table: dict[str, Any], verb: str) -> Any:
    suffix = path.suffix.lower()
    if suffix not in table:
        raise ValueError(f"{path}: suffix {suffix!r} cannot be {verb}, known are {', '.join(sorted(table))}")
    return table[suffix]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a scratch file beside `path` that takes its place only if the block succeeds."""
    handle, name = tempfile.mkstemp(path.suffix.lower(), f".{path.stem}-", path.parent)
    os.close(handle)
    scratch = Path(name)
    try:
        yield scratch
        scratch.chmod(path.stat().st_mode if path.exists() else 0o666 & ~_umask())
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _chunks(frames: Array) -> Iterator[Array]:
    """Native blocks of a long array, so that a mapped file never has to fit into memory."""
    for start in range(0, len(frames), CHUNK):
        yield np.asarray(frames[start : start + CHUNK], float)


def _write_journal(path: Path, header: Header, frames: Array) -> None:
    with path.open("wb") as file:
        file.write(journal_head(header))
        for block in _chunks(frames):
            file.write(block.astype(JOURNAL_DTYPE).tobytes())


def _write_npz(path: Path, header: Header, frames: Array) -> None:
    np.savez(path, header=np.array(header.to_json()), **split(header, frames))


def _read_npz(path: Path) -> tuple[Header, Array]:
    try:
        with np.load(path) as file:
            signals = dict(file)
        header = Header.from_json(str(signals.pop("header")), str(path))
        return header, join(header, signals)
    except (KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: not a recording of this library ({error})") from error


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise MissingExtra("HDF5 files need h5py: pip install 'hapticrender[hdf5]'") from error
    return h5py


def _write_h5(path: Path, header: Header, frames: Array) -> None:
    units = {"drive": "A", "normal_load": "N", "flags": "1"}
    with _h5py().File(path, "w") as file:
        file["header"] = header.to_json()
        for name, values in split(header, frames).items():
            file[name] = values
            file[name].attrs["unit"] = units.get(name, "m")


def _read_h5(path: Path) -> tuple[Header, Array]:
    with _h5py().File(path, "r") as file:
        try:
            header = Header.from_json(file["header"].asstr()[()], str(path))
            return header, join(header, {name: file[name][()] for name in header.slices})
        except (KeyError, AttributeError, TypeError) as error:
            raise ValueError(f"{path}: not a recording of this library ({error})") from error


def _write_mat(path: Path, header: Header, frames: Array) -> None:
    from scipy.io import savemat

    savemat(path, {"header": header.to_json(), "rate": header.rate, **split(header, frames)}, oned_as="column")


def _write_csv(path: Path, header: Header, frames: Array) -> None:
    titles = ["time (s)", *(f"{name} ({unit})" for name, unit in header.channels)]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(titles) + "\n")
        for start, block in zip(range(0, len(frames), CHUNK), _chunks(frames), strict=True):
            time = np.arange(start, start + len(block)) / header.rate
            np.savetxt(file, np.column_stack([time, block]), "%.10g", ",")


def _write_doubles(path: Path, header: Header, frames: Array) -> None:
    """All columns as 64-bit float channels; the comment, where the format has one, is the header if it fits."""
    container = SOUND_CONTAINERS[path.suffix]
    comment = header.to_json()
    if len(comment) > COMMENT_LIMIT:
        comment = json.dumps({"rate": header.rate, "columns": header.widths})
    _write_audio(path, container, "DOUBLE", frames, header.rate, comment)


def _write_flac(path: Path, header: Header, frames: Array) -> None:
    """Drive, sensed and motion as 24-bit channels (FLAC holds eight, and no floats); the comment states the scales."""
    signals = {name: column(header, frames, name) for name in ("drive", "sensed", "motion")}
    width = sum(signal.shape[1] for signal in signals.values())
    if width > FLAC_CHANNELS:
        raise ValueError(f"{path}: {width} channels, but FLAC holds at most {FLAC_CHANNELS}: choose .w64 or .au")
    scales = {name: float(np.nanmax(np.abs(signal), initial=0.0)) or 1.0 for name, signal in signals.items()}
    names = ", ".join(name for name, _ in header.channels[:width])
    units = {"drive": "A", "sensed": "m", "motion": "m"}
    stated = ", ".join(f"{name} {scale:.6g} {units[name]}" for name, scale in scales.items())
    scaled = np.hstack([signal / scales[name] for name, signal in signals.items()])
    comment = f"channels: {names}; full scale: {stated}; rate = {header.rate!r} Hz; the other signals do not fit"
    _write_audio(path, "FLAC", "PCM_24", np.nan_to_num(scaled), header.rate, comment)


def _write_audio(path: Path, container: str, subtype: str, frames: Array, rate: float, comment: str) -> None:
    import soundfile

    channels = 1 if frames.ndim == 1 else frames.shape[1]
    with soundfile.SoundFile(path, "w", max(1, round(rate)), channels, subtype, format=container) as file:
        if container != "W64":  # has no room for text
            file.comment = comment
        for block in _chunks(frames):
            file.write(block)


SOUND_CONTAINERS = {".wav": "WAV", ".w64": "W64", ".rf64": "RF64", ".flac": "FLAC"}
READERS: dict[str, Callable[[Path], tuple[Header, Array]]] = {".au": read_journal, ".npz": _read_npz, ".h5": _read_h5}
WRITERS: dict[str, Callable[[Path, Header, Array], None]] = {
    ".au": _write_journal,
    ".npz": _write_npz,
    ".h5": _write_h5,
    ".mat": _write_mat,
    ".csv": _write_csv,
    ".wav": _write_doubles,
    ".w64": _write_doubles,
    ".rf64": _write_doubles,
    ".flac": _write_flac,
}
