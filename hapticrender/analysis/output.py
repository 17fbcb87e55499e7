"""Write what the analysis of a recording found: tables as CSV, the rest as JSON, and a summary as text."""

from pathlib import Path
from typing import Any

import numpy as np

from hapticrender.analysis.records import KINDS, LOADED, FingerRecord, Series
from hapticrender.analysis.samples import weighted_mean
from hapticrender.formatting import as_json, table
from hapticrender.protocols import Array

FILES = ("finger.csv", "impedance.csv", "finger.json")
ROWS = 100.0  # a second, in finger.csv
SERIES = {"normal_load": "N", "position": "m", "velocity": "m/s"}


def write(record: FingerRecord, folder: Path) -> list[Path]:
    """Write `FILES` into a folder, which is made where it is not there, and return their paths.

    ``finger.csv`` has 100 rows a second of load, position, velocity, their standard errors and contact (0 unloaded, 1
    doubtful, 2 loaded); ``impedance.csv`` a row a window and band; ``finger.json`` segments, plate, bandwidths, notes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in FILES]
    step = max(round(1 / (ROWS * (record.time[1] - record.time[0]))), 1) if len(record.time) > 1 else 1
    columns, names = [record.time], ["time (s)"]
    for name, unit in SERIES.items():
        each = getattr(record, name)
        columns += [each.value, each.standard_error]
        names += [f"{name} ({unit})", f"its standard error ({unit})"]
    _write_csv(paths[0], [*names, "contact"], np.column_stack([*columns, record.contact])[::step])
    z = record.impedance
    bands = z.frequency.shape[1]
    of_window = [np.repeat(each, bands) for each in (z.time, z.normal_load, z.position)]
    of_band = [each.ravel() for each in (z.frequency, z.value.real, z.value.imag, z.standard_error)]
    names = ["time (s)", "normal load (N)", "position (m)", "frequency (Hz)", "real part (N s/m)"]
    names += ["imaginary part (N s/m)", "standard error of each (N s/m)"]
    _write_csv(paths[1], names, np.column_stack([*of_window, *of_band]))
    figures = {
        "name": record.name,
        "bandwidth": {name: getattr(record, name).bandwidth for name in SERIES},
        "least_load": record.least_load,
        "segments": [{"kind": KINDS[each.kind], "start": each.start, "stop": each.stop} for each in record.segments],
        "plate": vars(record.plate),
        "notes": record.notes,
    }
    paths[2].write_text(as_json(figures), encoding="utf-8")
    return paths


def _write_csv(path: Path, names: list[str], rows: np.ndarray[Any, Any]) -> None:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="", encoding="utf-8")


def text(record: FingerRecord) -> str:
    """Summary for the terminal: a line a touch, a band and a parameter, each number with its standard error."""
    blocks = [_touches(record), _bands(record), _plate(record), "\n".join(f"note: {note}" for note in record.notes)]
    least = f"position is good to 1 mm from {record.least_load:.3f} N on"
    return "\n\n".join([each for each in blocks if each] + [least])


def _touches(record: FingerRecord) -> str:
    """Mean load and range of the position of each touch, with the standard error of one sample."""
    rows = [["touch", "from (s)", "to (s)", "load (N)", "se", "position (mm)", "se"]]
    for number, each in enumerate(record.of_kind(LOADED), 1):
        at = slice(*record.at(np.array([each.start, each.stop])))
        load, load_error = _finite(record.normal_load, at)
        place, place_error = (1e3 * part for part in _finite(record.position, at))
        cells = [f"{load.mean():.3f}", f"{np.median(load_error):.3f}"] if load.size else ["undefined", ""]
        span = f"{place.min():.1f} to {place.max():.1f}" if place.size else "undefined"
        cells += [span, f"{np.median(place_error):.2f}" if place.size else ""]
        rows.append([f"{number}", f"{each.start:.3f}", f"{each.stop:.3f}", *cells])
    return table(rows) + "\n(se: standard error of one sample, median of the touch)" if len(rows) > 1 else ""


def _finite(series: Series, at: slice) -> tuple[Array, Array]:
    """Values of a span, and their standard errors, where they are defined."""
    value, error = series.value[at], series.standard_error[at]
    good = np.isfinite(value) & np.isfinite(error)
    return value[good], error[good]


def _bands(record: FingerRecord) -> str:
    """Mean impedance of each band over the windows, with its own standard error."""
    z = record.impedance
    rows = [["band (Hz)", "|Z| (N s/m)", "se", "phase (deg)", "se", "windows"]]
    for k in range(z.frequency.shape[1]):
        good = np.isfinite(z.value[:, k])
        if good.any():
            mean, error = weighted_mean(z.value[good, k], z.standard_error[good, k])
            size = [f"{abs(mean):.3g}", f"{error:.2g}"]
            phase = [f"{np.degrees(np.angle(mean)):.1f}", f"{np.degrees(error / abs(mean)):.1f}"]
            rows.append([f"{np.median(z.frequency[good, k]):.1f}", *size, *phase, f"{good.sum()}"])
    note = "(se: standard error of the mean over the windows, whose errors are taken as independent)"
    return f"{table(rows)}\n{note}" if len(rows) > 1 else ""


def _plate(record: FingerRecord) -> str:
    """Parameters of the plate at both ends of the recording."""
    plate = record.plate
    rows = [["plate" if plate.measured else "plate (profile)", "at the start", "at the end", "standard errors"]]
    for name, values in plate.values.items():
        errors = plate.standard_errors[name]
        rows.append([name, f"{values[0]:.5g}", f"{values[-1]:.5g}", f"{errors[0]:.2g}, {errors[-1]:.2g}"])
    return table(rows)
