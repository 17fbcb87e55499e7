"""What one rendered scene leaves in a folder: sound, picture, journal, figures, and the scene itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticrender.loop import Session, run
from hapticrender.protocols import Array
from hapticrender.recordings.formats import write_sound
from hapticrender.recordings.recording import Recording
from hapticrender.validate import as_json

FILES = ("scene.toml", "recording.au", "drive.wav", "sensed.wav", "picture.png", "summary.json")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """A folder with one rendered scene.

    Parameters
    ----------
    name : str
        Name of the scene.
    folder : Path
        Where its files lie.
    summary : mapping
        ``Recording.summary()`` and, under "sound", the full scale (SI) of each WAV.
    toml : str
        The scene as TOML.
    picture : bool
        Whether there is a picture; it takes the ``plot`` extra.
    """

    name: str
    folder: Path
    summary: Mapping[str, Any]
    toml: str
    picture: bool


def run_into(folder: Path, session: Session, *, progress: Callable[[float, float], None] | None = None) -> Outputs:
    """Run a prepared `session` and write everything about it into `folder`, which is made where it is not there.

    Files of an earlier run are removed first, so that what a broken-off run
    leaves is of that run.

    Raises
    ------
    OSError
        Where the folder cannot be written.
    DriverError
        Where the device failed.
    """
    toml = session.scene.to_toml()
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        (folder / name).unlink(missing_ok=True)
    (folder / "scene.toml").write_text(toml, encoding="utf-8")
    recording = run(session, journal=folder / "recording.au", progress=progress)
    header = recording.header
    sound = {
        name: {"full_scale": _write_sound(folder / name, samples, recording.rate, unit), "unit": unit}
        for name, samples, unit in (
            ("drive.wav", recording.drive, header.drive_unit),
            ("sensed.wav", recording.sensed, header.unit),
        )
    }
    picture = _plotted(recording, folder / "picture.png")
    summary = {**recording.summary(), "sound": sound}
    (folder / "summary.json").write_text(as_json(summary), encoding="utf-8")
    return Outputs(name=session.scene.name, folder=folder, summary=summary, toml=toml, picture=picture)


def _write_sound(path: Path, samples: Array, rate: float, unit: str) -> float:
    """Write `samples` as 24-bit sound, with a round full scale above their peak, and return that."""
    import soundfile

    full_scale = round_up(max(abs(samples.min(initial=0.0)), samples.max(initial=0.0)))
    try:
        return write_sound(path, samples, rate, full_scale, unit=unit, bits=24)
    except soundfile.SoundFileError as error:
        raise OSError(f"{path}: {error}") from error


def round_up(peak: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten; 1 for silence.

    Examples
    --------
    >>> round_up(1.3), round_up(0.5), round_up(0.0)
    (2.0, 0.5, 1.0)
    """
    if not 1e-12 < peak < 1e12:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(peak))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= peak))


def _plotted(recording: Recording, path: Path) -> bool:
    """Plot where matplotlib is installed."""
    try:
        recording.plot(path)
    except ImportError:
        return False
    return True
