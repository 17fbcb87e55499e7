"""The formats in which a recording leaves the house, and comes back."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.errors import HapticError
from hapticrender.protocols import Array
from hapticrender.recordings.journal import Header, chunks, column, join, read_journal, split, write_journal

COMMENT_LIMIT = 4000  # characters; libsndfile drops a longer WAV comment without a word
FLAC_CHANNELS = 8


class MissingExtra(HapticError, ImportError):
    """An optional part is not installed: says which extra brings it."""


def read(path: str | os.PathLike[str]) -> tuple[Header, Array]:
    """Header and frames of a recording in any format that can be read back.

    Parameters
    ----------
    path : path-like
        A file whose name ends in .au, .npz, .h5 or .hdf5.

    Returns
    -------
    header : Header
    frames : ndarray, shape (n, columns)
        Mapped from the file where it is a journal.

    Raises
    ------
    OSError
        The file is not there or may not be read.
    ValueError
        It is damaged, or no recording of this library.
    MissingExtra
        Reading it takes an optional part that is not installed.
    """
    path = Path(path)
    reader = _known(path, READERS, "read")
    with path.open("rb"):  # what is not there is told in the same words for every format
        return reader(path)


def write(path: str | os.PathLike[str], header: Header, frames: Array) -> None:
    """Write a recording in the format that the suffix of `path` names; an older file goes only when this one is whole.

    Parameters
    ----------
    path : path-like
        Suffix .au (journal), .npz, .h5 or .hdf5, .mat, .csv, .wav, .w64, .rf64 or .flac.
    header : Header
    frames : ndarray, shape (n, columns)
    """
    path = Path(path)
    writer = _known(path, WRITERS, "written")
    with replacing(path) as scratch:
        writer(scratch, header, frames)


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


def _write_npz(path: Path, header: Header, frames: Array) -> None:
    signals: dict[str, Any] = split(header, frames)
    np.savez(path, header=np.array(header.to_json()), **signals)


def _read_npz(path: Path) -> tuple[Header, Array]:
    with path.open("rb") as raw, _blaming(path), np.load(raw) as file:
        header = str(file["header"])
        signals = {name: file[name] for name in file if name != "header"}
    return _assembled(path, header, signals)


def _assembled(path: Path, text: str, signals: dict[str, Any]) -> tuple[Header, Array]:
    header = Header.from_json(text, str(path))
    with _blaming(path):
        return header, join(header, signals)


@contextmanager
def _blaming(path: Path) -> Iterator[None]:
    """Name the file, whatever a damaged one makes numpy, zipfile or h5py raise."""
    try:
        yield
    except (MemoryError, HapticError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: not a recording ({reason})") from error


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise MissingExtra("HDF5 files need h5py: pip install 'hapticrender[hdf5]'") from error
    return h5py


def _write_h5(path: Path, header: Header, frames: Array) -> None:
    units = {"drive": header.drive_unit, "position": "m", "normal_load": "N", "flags": "1"}
    with _h5py().File(path, "w") as file:
        file["header"] = header.to_json()
        for name, values in split(header, frames).items():
            file[name] = values
            file[name].attrs["unit"] = units.get(name, header.unit)


def _read_h5(path: Path) -> tuple[Header, Array]:
    h5py = _h5py()
    with _blaming(path), h5py.File(path, "r") as file:
        header = file["header"].asstr()[()]
        signals = {name: entry[()] for name, entry in file.items() if name != "header"}
    return _assembled(path, header, signals)


def _write_mat(path: Path, header: Header, frames: Array) -> None:
    from scipy.io import savemat

    savemat(path, {"header": header.to_json(), "rate": header.rate, **split(header, frames)}, oned_as="column")


def _write_csv(path: Path, header: Header, frames: Array) -> None:
    titles = ["time (s)", *(f"{name} ({unit})" for name, unit in header.channels)]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(titles) + "\n")
        done = 0
        for block in chunks(frames):
            time = np.arange(done, done + len(block)) / header.rate
            np.savetxt(file, np.column_stack([time, block]), "%.10g", ",")
            done += len(block)


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
    units = {"drive": header.drive_unit}
    stated = ", ".join(f"{name} {scale:.6g} {units.get(name, header.unit)}" for name, scale in scales.items())
    scaled = np.hstack([signal / scales[name] for name, signal in signals.items()])
    comment = f"channels: {names}; full scale: {stated}; rate = {header.rate!r} Hz; the other signals do not fit"
    _write_audio(path, "FLAC", "PCM_24", np.nan_to_num(scaled), header.rate, comment)


def _write_audio(path: Path, container: str, subtype: str, frames: Array, rate: float, comment: str) -> None:
    import soundfile

    channels = 1 if frames.ndim == 1 else frames.shape[1]
    with soundfile.SoundFile(path, "w", max(1, round(rate)), channels, subtype, format=container) as file:
        if container != "W64":  # has no room for text
            file.comment = comment
        for block in chunks(frames):
            file.write(block)


SOUND_CONTAINERS = {".wav": "WAV", ".w64": "W64", ".rf64": "RF64", ".flac": "FLAC"}
READERS: dict[str, Callable[[Path], tuple[Header, Array]]] = {
    ".au": read_journal,
    ".npz": _read_npz,
    ".h5": _read_h5,
    ".hdf5": _read_h5,
}
WRITERS: dict[str, Callable[[Path, Header, Array], None]] = {
    ".au": write_journal,
    ".npz": _write_npz,
    ".h5": _write_h5,
    ".hdf5": _write_h5,
    ".mat": _write_mat,
    ".csv": _write_csv,
    ".wav": _write_doubles,
    ".w64": _write_doubles,
    ".rf64": _write_doubles,
    ".flac": _write_flac,
}
