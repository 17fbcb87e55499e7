"""Write what one rendered scene leaves in a folder: sound, picture, journal, figures, itself."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from hapticrender.errors import PlateMismatch
from hapticrender.formatting import as_json
from hapticrender.loop import Progress, run
from hapticrender.protocols import Driver, Rendering
from hapticrender.recordings.formats import MissingExtra, replacing, write_sound
from hapticrender.recordings.journal import read_journal, refuse_others
from hapticrender.recordings.recording import Recording
from hapticrender.report import picture
from hapticrender.touch.scene import Scene

JOURNAL = "recording.au"
GENERATOR = '<meta name="generator" content="hapticrender">'  # in every page
FILES = ("scene.toml", JOURNAL, "drive.wav", "sensed.wav", "picture.png", "summary.json")


def check_folder(option: str, folder: Path) -> None:
    """Refuse a folder that could not be made or written into, without making it."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists() or path.is_symlink())
    if not nearest.is_dir():
        raise ValueError(f"{option} = {str(folder)!r}: {str(nearest)!r} is a file, must be a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{option} = {str(folder)!r}: no permission to write into {str(nearest)!r}")


def check_file(option: str, path: Path) -> None:
    """Refuse a report file that could not be written."""
    if path.is_dir():
        raise ValueError(f"{option} = {str(path)!r}: is a folder, must be a file")
    if path.exists() and not os.access(path, os.W_OK):
        raise ValueError(f"{option} = {str(path)!r}: no permission to write it")
    check_folder(option, path.parent)


def write_report(path: str | Path, data: bytes) -> None:
    """Write a report, which replaces an older file when it is whole; a link, a pipe or a device is written into."""
    path = Path(path)
    if path.is_symlink() or (path.exists() and not path.is_file()):
        path.write_bytes(data)
        return
    with replacing(path) as scratch:
        scratch.write_bytes(data)


def written_in(folder: Path) -> list[Path]:
    """Files in `folder` that have the names of a run's files."""
    return [folder / name for name in FILES if (folder / name).exists()]


def text_of(path: Path) -> str:
    """Text of a file; nothing where there is none."""
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def refuse_other_page(folder: Path) -> None:
    """Refuse a folder whose ``index.html`` this package has not written."""
    path = folder / "index.html"
    if path.exists() and GENERATOR not in text_of(path):
        raise ValueError(f"{str(path)!r}: is there and from no earlier run: choose another folder, or add --force")


def refuse_to_overwrite(folder: Path, source: Path | None = None) -> None:
    """Refuse a folder in which files would be overwritten that no earlier run has written, or the scene `source`."""
    present = written_in(folder)
    if present == [folder / "summary.json"] and GENERATOR in text_of(folder / "index.html"):
        return  # the page of `play`, `demo` or `validate`
    for path in present:
        if source is not None and source.exists() and path.samefile(source):
            raise ValueError(f"{str(path)!r}: would overwrite the scene itself: choose another folder")
    if present:
        try:
            read_journal(folder / JOURNAL)
        except (OSError, ValueError):
            cure = "is there and from no earlier run: choose another folder, or add --force"
            raise ValueError(f"{str(present[0])!r}: {cure}") from None


@contextmanager
def naming_full(folder: str | Path) -> Iterator[None]:
    """Name `folder` in the error of a disk that is full, which has no name of its own."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT) and error.filename is None:
            error.filename = str(folder)
        raise


def run_to_end(folder: Path, rendering: Rendering, progress: Progress | None = None) -> Recording:
    """Run a prepared `rendering`, its journal in `folder`, which is made where it is not there.

    Files of an earlier run are removed once the device is open and probed: all files are then of this run, also after
    an interruption.  A device that differs from its model is no error where warnings are.
    """
    journal = folder / JOURNAL
    with ExitStack() as at_end:

        def begin(device: Driver) -> None:
            if rendering.probe is not None:
                rendering.probe(device)
            at_end.callback(lambda: None if journal.exists() else remove_outputs(folder))
            begin_outputs(folder, rendering.scene)

        try:
            refuse_others(journal)
        except ValueError:  # `refuse_to_overwrite` has refused it, but for --force
            journal.unlink()
        try:
            return run(replace(rendering, probe=begin), journal=journal, progress=progress)
        except PlateMismatch as mismatch:
            if mismatch.recording is None:
                raise
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.warn(str(mismatch), PlateMismatch, stacklevel=2)
            return mismatch.recording


def run_into(folder: Path, rendering: Rendering, *, progress: Progress | None = None) -> dict[str, Any]:
    """Run a prepared `rendering` and write everything about it into `folder`; see `run_to_end`, `write_outputs`."""
    with naming_full(folder):
        return write_outputs(folder, run_to_end(folder, rendering, progress))


def begin_outputs(folder: Path, scene: Scene) -> Path:
    """Make `folder`, remove the files of an earlier run, write the scene, and return the path of the journal."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in written_in(folder):
        path.unlink()
    (folder / "scene.toml").write_text(scene.to_toml(), encoding="utf-8")
    return folder / JOURNAL


def remove_outputs(folder: Path) -> None:
    """Remove what `run_to_end` wrote, and `folder` where nothing else is in it."""
    for path in written_in(folder):
        path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def write_outputs(folder: Path, recording: Recording) -> dict[str, Any]:
    """Write sounds, picture and figures of a recording whose scene and journal are in `folder`.

    Returns ``Recording.summary()`` and, under "sound", the full scale (SI) of each WAV.
    """
    header, sound = recording.header, {}
    for name, unit in (("drive", header.drive_unit), ("sensed", header.unit)):
        if header.columns[name]:
            full_scale = write_sound(folder / f"{name}.wav", recording.read(name), header.rate, unit)
            sound[f"{name}.wav"] = {"full_scale": full_scale, "unit": unit}
    with suppress(MissingExtra):
        picture.plot(recording, folder / "picture.png")
    summary = {**recording.summary(), "sound": sound}
    (folder / "summary.json").write_text(as_json(summary), encoding="utf-8")
    return summary
