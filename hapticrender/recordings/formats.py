"""Read and write recordings in several formats."""

import itertools
import math
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.errors import HapticError
from hapticrender.protocols import Array
from hapticrender.recordings.journal import Header, chunks, column, join, read_journal, refuse_open, write_journal

Arrays = dict[str, tuple[float, Callable[[], Any]]]  # of a file, by name: bytes (NaN: not here), and what reads it


class MissingExtra(HapticError, ImportError):
    """An optional part is not installed: states which extra has it."""


def read(path: str | os.PathLike[str]) -> tuple[Header, Any]:
    """Read header and frames (n, columns) of a recording: .au, .npz, .h5, .hdf5, .mat or .csv.

    An OSError where the file is not there or may not be read, a ValueError where it is damaged, compressed, or no
    recording of this library, a `MissingExtra` where reading it takes an optional part that is not installed.
    """
    path = Path(path)
    reader = _by_suffix(path, READERS, "read (load the .au of the run instead)")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ValueError(f"{path}: must be a regular file")
    with path.open("rb"), naming_damage(path):  # a missing file is the same OSError for every format
        return reader(path)


def write(path: str | os.PathLike[str], header: Header, frames: Any) -> None:
    """Write a recording in the format of the suffix of `path`; an older file is replaced when the new one is whole."""
    path = Path(path)
    writer = _by_suffix(path, WRITERS, "written")
    refuse_open(path)
    with replacing(path) as scratch:
        writer(scratch, header, frames)


def write_sound(path: Path, signal: Array, rate: float, unit: str) -> float:
    """Write a signal (n, channels) as a 24-bit WAV file; return its full scale, which the file's comment states.

    That is 1, 2 or 5 times a power of ten above the peak, in `unit`; what is not finite becomes silence.  Sound files
    hold the `rate` (Hz) rounded.
    """
    import soundfile

    signal = np.nan_to_num(np.asarray(signal, float), nan=0.0, posinf=0.0, neginf=0.0)
    full_scale, whole = round_up(float(np.abs(signal).max(initial=0.0))), max(1, round(rate))
    with replacing(path) as scratch:
        try:
            with soundfile.SoundFile(scratch, "w", whole, signal.shape[1], "PCM_24", format="WAV") as file:
                file.comment = f"full scale = {full_scale:.6g} {unit}"
                file.write(signal / full_scale)
        except soundfile.SoundFileError as error:
            raise OSError(f"{path}: {error}") from error
    return full_scale


def round_up(peak: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten; 1 for silence.

    >>> round_up(1.3), round_up(0.5), round_up(0.0)
    (2.0, 0.5, 1.0)
    """
    if not 1e-12 < peak < 1e12:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(peak))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= peak))


def _by_suffix(path: Path, table: dict[str, Any], verb: str) -> Any:
    suffix = path.suffix.lower()
    if suffix not in table:
        raise ValueError(f"{path}: suffix {suffix!r} cannot be {verb}, known are {', '.join(sorted(table))}")
    return table[suffix]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a scratch file beside `path` that takes its place only if the block succeeds."""
    scratch = path.with_name(f".{path.stem}-{uuid.uuid4().hex}{path.suffix.lower()}")
    try:
        scratch.touch()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        yield scratch
        if path.exists():
            scratch.chmod(path.stat().st_mode)
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def _values(header: Header, frames: Any) -> dict[str, Any]:
    """All signals by name, with header, time and rate."""
    rows = frames[:]
    signals = {name: column(header, rows, name) for name in header.slices}
    return {"header": header.to_json(), "rate": header.rate, "time": np.arange(len(frames)) / header.rate, **signals}


@contextmanager
def naming_damage(path: Path, problem: str = "not a recording") -> Iterator[None]:
    """Name the file and the `problem` in whatever a damaged one makes numpy, zipfile, scipy or h5py raise."""
    try:
        yield
    except HapticError:
        raise
    except Exception as error:
        if str(error).startswith(f"{path}: "):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: {problem} ({reason})") from error


@contextmanager
def npz_arrays(path: Path) -> Iterator[Arrays]:
    """Provide the arrays of an NPZ file."""
    with path.open("rb") as opened, np.load(opened) as file:  # numpy leaves open what is no archive
        size = {each.filename: each.file_size for each in file.zip.infolist()}
        yield {name: (size.get(f"{name}.npy", math.nan), partial(file.__getitem__, name)) for name in file.files}


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise MissingExtra("HDF5 files need h5py: pip install 'hapticrender[hdf5]'") from error
    return h5py


def _write_h5(path: Path, header: Header, frames: Any) -> None:
    units = {"drive": header.drive_unit, "position": "m", "normal_load": "N", "flags": "1", "time": "s", "rate": "Hz"}
    with _h5py().File(path, "w") as file:
        for name, values in _values(header, frames).items():
            file[name] = values
            if name != "header":
                file[name].attrs["unit"] = units.get(name, header.unit)


@contextmanager
def h5_arrays(path: Path) -> Iterator[Arrays]:
    """Provide the arrays of an HDF5 file; one that lies in another file has no size."""
    h5py, found = _h5py(), Arrays()

    def take(name: str, entry: Any) -> None:
        if isinstance(entry, h5py.Dataset):
            size = math.nan if entry.external or entry.is_virtual else math.prod(entry.shape) * entry.dtype.itemsize
            found[name] = size, partial(entry.__getitem__, ())

    with h5py.File(path, "r") as file:
        file.visititems(take)  # which follows no link
        yield found


@contextmanager
def mat_arrays(path: Path) -> Iterator[Arrays]:
    """Provide the arrays of a MAT file; those of version 7.3 are HDF5."""
    from scipy.io import loadmat, whosmat

    try:
        found = whosmat(path, appendmat=False)
    except NotImplementedError:
        with h5_arrays(path) as arrays:
            yield arrays
        return

    def load(name: str) -> Any:
        return loadmat(path, appendmat=False, variable_names=[name])[name]

    yield {name: (math.prod(shape) * (1 if kind == "char" else 8), partial(load, name)) for name, shape, kind in found}


def _reader(arrays: Callable[[Path], Any]) -> Callable[[Path], tuple[Header, Array]]:
    """Reader of recordings that `write` has saved as arrays by name, never compressed."""

    def read(path: Path) -> tuple[Header, Array]:
        with arrays(path) as found:

            def load(name: str) -> Any:
                size, values = found.get(name, (math.nan, tuple))
                most = path.stat().st_size
                if math.isnan(size):
                    raise ValueError(f"{name}: is missing, or no data set of this file")
                if size > most:
                    raise ValueError(f"{name} has {size} bytes, the file {most}: compressed recordings are not read")
                return values()

            text = np.asarray(load("header")).ravel()[0]
            header = Header.from_json(text.decode() if isinstance(text, bytes) else str(text), str(path))
            return header, join(header, {name: load(name) for name in header.slices})

    return read


def _write_mat(path: Path, header: Header, frames: Any) -> None:
    from scipy.io import savemat

    savemat(path, _values(header, frames), oned_as="column")


def _write_csv(path: Path, header: Header, frames: Any) -> None:
    """A comment line with the header, a line of titles, and a line a sample with ten digits."""
    titles = ["time (s)", *(f"{name} ({unit})" for name, unit in header.channels)]
    with path.open("w", encoding="utf-8") as file:
        file.write(f"# {header.to_json()}\n" + ",".join(titles) + "\n")
        done = 0
        for block in chunks(frames, len(header.channels)):
            time = np.arange(done, done + len(block)) / header.rate
            np.savetxt(file, np.column_stack([time, block]), "%.10g", ",")
            done += len(block)


def _read_csv(path: Path) -> tuple[Header, Array]:
    with path.open(encoding="utf-8") as file:
        comment, _, first = (file.readline() for _ in range(3))
        if not comment.startswith("# "):
            raise ValueError("the first line is no comment with a header")
        header = Header.from_json(comment[2:], str(path))
        columns = 1 + len(header.channels)
        lines = itertools.chain([first], file)
        numbers = np.loadtxt(lines, delimiter=",", ndmin=2) if first else np.empty((0, columns))
    if numbers.shape[1] != columns:
        raise ValueError(f"{path}: {numbers.shape[1]} columns, expected {columns}")
    return header, numbers[:, 1:]


CONTAINERS: dict[str, tuple[Callable[[Path], Any], str]] = {  # what reads their arrays, and what they are
    ".mat": (mat_arrays, "a MAT file"),
    **dict.fromkeys((".h5", ".hdf5"), (h5_arrays, "an HDF5 file")),
    ".npz": (npz_arrays, "an NPZ file of arrays"),
}
READERS: dict[str, Callable[[Path], tuple[Header, Any]]] = {
    ".au": read_journal,
    ".csv": _read_csv,
    **{suffix: _reader(arrays) for suffix, (arrays, _) in CONTAINERS.items()},
}
WRITERS: dict[str, Callable[[Path, Header, Any], None]] = {
    ".au": write_journal,
    ".npz": lambda path, header, frames: np.savez(path, **_values(header, frames)),
    ".h5": _write_h5,
    ".hdf5": _write_h5,
    ".mat": _write_mat,
    ".csv": _write_csv,
}
