"""Read recordings of other programs: name the columns of a CSV, MAT, HDF5 or NPZ file, with their scales."""

import csv
import os
from array import array
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import number, require, show
from hapticrender.protocols import Array
from hapticrender.recordings.formats import CONTAINERS, naming_damage
from hapticrender.recordings.journal import Header, join
from hapticrender.touch.scene import Custom, Scene

METHOD = "recorded elsewhere"
EVEN = 0.5  # samples: farthest that a time may be from its place on an even grid
Scale = float | tuple[float, float]
Chosen = str | Sequence[str] | Mapping[str, Scale]


def read_columns(path: str | os.PathLike[str]) -> dict[str, Array]:
    """Read every numeric array of a file by name: .csv, .txt, .mat, .h5, .hdf5 or .npz.

    A CSV file (UTF-8) has one line of titles, between any lines that begin with # and the numbers; without it the
    columns are "1", "2" and so on.  An empty field is NaN.  Columns of a table, shape (n, k), are named "table[0]" and
    so on; its longer side is time.

    An OSError where the file is not there or may not be read; a ValueError where the format is not known, the file is
    damaged, or a field of a CSV file is no number; a `MissingExtra` for an HDF5 file, or a MAT file of version 7.3,
    without h5py.
    """
    path = Path(path)
    ending, text = path.suffix.lower(), (".csv", ".txt")
    require(ending in (*text, *CONTAINERS), "path", str(path), f"a file that ends in {', '.join((*text, *CONTAINERS))}")
    with path.open("rb"):  # a missing file is the same OSError for every format
        if ending in text:
            found: Mapping[str, Any] = _read_text(path)
        else:
            arrays, what = CONTAINERS[ending]
            with naming_damage(path, f"damaged, or not {what}"), arrays(path) as opened:
                found = {name: load() for name, (_, load) in opened.items()}
    columns: dict[str, Array] = {}
    others = []
    for name, values in found.items():
        values = np.squeeze(np.asarray(values))
        if values.dtype.kind not in "iufb" or values.ndim > 2:
            others.append(f"{name} ({values.dtype}, shape {values.shape})")
            continue
        if values.ndim < 2:
            columns[name] = np.atleast_1d(values)
        else:
            long = values if values.shape[0] >= values.shape[1] else values.T
            columns |= {f"{name}[{i}]": long[:, i] for i in range(long.shape[1])}
    if not columns:
        raise ValueError(f"{path}: has no columns of numbers: there are {', '.join(others) or 'none'}")
    return columns


def assemble(
    columns: Mapping[str, Any] | str | os.PathLike[str],
    chosen: Mapping[str, Chosen | None],
    rate: float | None,
    carriers: float | Sequence[float],
    **header: Any,
) -> tuple[Header, Array]:
    """Header and frames from the columns `chosen` for drive, sensed, time, position and normal_load.

    See ``Recording.from_columns``.
    """
    source = "columns" if isinstance(columns, Mapping) else Path(columns).name
    table = columns if isinstance(columns, Mapping) else read_columns(columns)
    found = {key: _columns(table, key, each) for key, each in chosen.items() if each is not None}
    lengths = {name: len(values) for pairs in found.values() for name, values in pairs}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"columns differ in length: {listed} samples: all must be of one clock")
    count = max(lengths.values(), default=0)
    require(count >= 2, "columns", count, "at least 2 samples")
    rate = _rate(rate, found["time"][0][1] if "time" in found else None, count)
    own = {"name": Path(source).stem} | {key: header.pop(key) for key in ("name", "device") if key in header}
    scene = Scene(texture=Custom(f"what {source} was recorded with"), duration=count / rate, settle=0.0, **own)
    several = carriers if isinstance(carriers, Iterable) and getattr(carriers, "shape", None) != () else [carriers]
    band = np.array([number("carriers", each, "Hz", above=0, most=rate / 2) for each in several])
    drive, sensed = (np.array([values for _, values in found[key]]).reshape(-1, count).T for key in ("drive", "sensed"))
    made = Header.of(
        scene,
        **{"method": METHOD, "seed": 0, "motion_source": "sensors", "places": tuple(dict(found["sensed"])), **header},
        rate=rate,
        bands=Bands(frequency=band, wavenumber=0 * band, phase=0 * band),
        drive_channels=drive.shape[1],
        sensed_channels=sensed.shape[1],
    )
    signals = {key: found[key][0][1] if key in found else np.full(count, np.nan) for key in ("position", "normal_load")}
    signals |= {"drive": drive, "sensed": sensed, "motion": sensed, "target": np.zeros((count, len(band)), complex)}
    return made, join(made, signals | {"flags": np.zeros(count), "reference": np.zeros(count)})


def _columns(table: Mapping[str, Any], key: str, chosen: Chosen) -> list[tuple[str, Array]]:
    """Names and values, ``scale (column - offset)``, of the columns of a signal; one named twice is there twice.

    All are finite in drive and sensed; elsewhere there is one, perhaps with NaN.  Unsigned integers of a counter, of
    time or position, are unwrapped.
    """
    chosen = [chosen] if isinstance(chosen, str) else chosen
    scales = dict(chosen) if isinstance(chosen, Mapping) else dict.fromkeys(chosen, 1.0)
    names, several, found = list(chosen), key in ("drive", "sensed"), []
    if key == "sensed":
        require(0 < len(names) == len(scales), key, chosen, "at least one column, and each once")
    require(several or len(names) == 1, key, chosen, "one column")
    for name in names:
        given = scales[name]
        pair = given if isinstance(given, tuple | list) else (given, 0.0)
        require(len(pair) == 2, f"columns[{name!r}]", pair, "a scale, or a scale and an offset")
        scale, offset = number(f"scale of {name}", pair[0]), number(f"offset of {name}", pair[1])
        if name not in table:
            there = ", ".join(map(str, table)) or "none"
            raise ValueError(f"column {show(name)} is missing: there are {there}")
        values = np.squeeze(np.asarray(table[name]))
        good = values.ndim == 1 and values.dtype.kind in "iufb" and not np.ma.is_masked(table[name])
        require(good, f"column {name}", table[name], "numbers, one a sample, none of them masked")
        if not several and key != "normal_load" and values.dtype.kind == "u":
            values = unwrap_counts(values)
        values = scale * (values.astype(float) - offset)
        bad: Array = np.flatnonzero(~np.isfinite(values) & several)
        if bad.size:
            cure = "cut the recording there, or interpolate"
            raise ValueError(f"{key}: column {name}: {bad.size} values are not finite, first in row {bad[0]}: {cure}")
        require(not np.isinf(values).any(), f"{key}: column {name}", np.inf, "finite, or NaN where there is no value")
        found.append((name, values))
    return found


def unwrap_counts(counts: Array) -> Array:
    """Positions (int64) of a counter of unsigned integers that wraps both ways, from the first count, signed, on."""
    counts = counts.astype(counts.dtype.newbyteorder("="))
    signed = f"i{counts.itemsize}"
    return np.cumsum(np.append(counts[:1].view(signed), np.diff(counts).view(signed)), dtype=np.int64)


def _rate(rate: float | None, time: Array | None, count: int) -> float:
    """Sampling rate (Hz) as given, or from the first and last time; every time (s) must be on that grid."""
    if time is None:
        require(rate is not None, "rate", None, "a sampling rate in Hz, or else name a column of times with time=")
        return number("rate", rate, "Hz", least=1e-3, most=1e9)
    for bad in np.flatnonzero(~(np.diff(time) > 0))[:1]:
        raise ValueError(f"time: must rise, but row {bad + 1} has {time[bad + 1]:.9g} s after {time[bad]:.9g} s")
    measured = (count - 1) / float(time[-1] - time[0])
    chosen = measured if rate is None else number("rate", rate, "Hz", least=1e-3, most=1e9)
    off = np.abs((time - time[0]) * chosen - np.arange(count))
    if off.max() > EVEN:
        usual = float(np.median(np.diff(time)))
        missed = np.abs(np.diff(time, prepend=time[0] - usual) / usual - 1.0)  # by each row, after the one before
        if (missed > EVEN).any():
            off, chosen = missed, 1 / usual if rate is None else chosen
        row = int(np.argmax(off > EVEN))
        raise ValueError(
            f"time: row {row} is {off[row]:.3g} samples off an even grid of {chosen:.9g} Hz (mean rate {measured:.9g} "
            "Hz): samples are missing, or the rate varies: cut the recording there, or resample it"
        )
    return chosen


def _read_text(path: Path) -> dict[str, Array]:
    """Columns of a text with commas, semicolons, tabs or spaces between them; empty rows at its end are left out."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start} is no UTF-8 text: save the table as text in UTF-8") from error
    lines = [(at, line) for at, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip(" ")]
    lines[1:] = [(at, line.split("#")[0]) for at, line in lines[1:]]  # a title may hold a #
    while lines and not lines[-1][1].strip(' ,;\t"'):
        lines.pop()
    if not lines:
        raise ValueError(f"{path}: the file is empty, or has comments alone: must be lines of numbers")
    between = _separator([line for _, line in lines[:2]])
    start, first = lines[0][0], _split(lines[0][1], between)
    titled = any(_number(each) is None for each in first)
    names = [each.strip() for each in first] if titled else [str(i + 1) for i in range(len(first))]
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: line {start} has the titles {', '.join(names)}: one different one for each column")
    if len(lines) == titled:
        raise ValueError(f"{path}: nothing follows the titles in line {start}: must be lines of numbers")
    values = array("d")
    for at, line in lines[titled:]:
        fields = _split(line, between)
        if len(fields) != len(names):
            raise ValueError(f"{path}, line {at}: {len(fields)} fields: must be {len(names)}, one a column")
        for name, field in zip(names, fields, strict=True):
            if (value := _number(field)) is None:
                bound = "must be a number, or empty (NaN), decimals after a point"
                raise ValueError(f"{path}, line {at}, column {name}: {show(field)}: {bound}")
            values.append(value)
    return dict(zip(names, np.array(values).reshape(-1, len(names)).T, strict=True))


def _separator(lines: Sequence[str]) -> str | None:
    """What separates the columns, by the first two lines; None: spaces.

    It splits both into equally many fields, more than one, if possible into numbers in the second line: a tab or a
    semicolon rather than a comma, which may be a decimal mark.
    """
    present = [each for each in "\t;," if each in lines[0]]
    split = {each: [_split(line, each) for line in lines] for each in present}
    even = [each for each in present if len({len(fields) for fields in split[each]}) == 1]
    numeric = [each for each in even if None not in map(_number, split[each][-1])]
    return next(iter([*numeric, *even, *present]), None)


def _split(line: str, between: str | None) -> list[str]:
    """Fields of a line; the separator may stand in quotes."""
    return next(csv.reader([line], delimiter=between)) if between and '"' in line else line.split(between)


def _number(text: str) -> float | None:
    """Number of a field, NaN where it is empty; None where it is no number."""
    text = text.strip().strip('"')
    try:
        return None if "_" in text else float(text or "nan")
    except ValueError:
        return None
