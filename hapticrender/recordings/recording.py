"""What happened: kept while it happens, then saved, judged and drawn."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from hapticrender.bands import Bands
from hapticrender.protocols import Array
from hapticrender.recordings import formats, journal, judge
from hapticrender.recordings.journal import Header

if TYPE_CHECKING:
    from hapticrender.touch.scene import Scene


class Recorder:
    """Keeps a run while it happens.

    With a path, every block goes to the operating system the moment it is
    appended: a killed process loses nothing that was appended.  The file is
    made at the first block, so that a run which never starts leaves an older
    journal of that name untouched; a run that starts replaces it.  Without a
    path, blocks are kept in memory.

    Parameters
    ----------
    path : path-like or None
        Journal to write, suffix .au; None keeps the run in memory.
    scene : Scene
        What is rendered.
    method : str
        Name of the control method.
    seed : int
        Seed of the run.
    rate : float
        Sampling rate (Hz), > 0.
    bands : Bands
        Carriers of the run.
    drive_channels, sensed_channels : int
        Channels of the device.
    places : tuple of str
        Names of the judged places, the centre first; one column of motion each.
    drive_limit : float or None
        Largest drive that the device takes, where it is known.
    unit, drive_unit : str
        Of sensors, motion and targets; of the drive.
    profile : tuple of float, or None
        What is wanted at each place, as a multiple of the target; None: the same everywhere.

    Raises
    ------
    ValueError
        The path does not end in .au, or the rate is not positive.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        *,
        scene: Scene,
        method: str,
        seed: int,
        rate: float,
        bands: Bands,
        drive_channels: int = 2,
        sensed_channels: int = 2,
        places: tuple[str, ...] = ("centre", "end 1", "end 2"),
        drive_limit: float | None = None,
        unit: str = "m",
        drive_unit: str = "A",
        profile: tuple[float, ...] | None = None,
    ) -> None:
        self.path = None if path is None else Path(path)
        if self.path is not None and self.path.suffix.lower() != ".au":
            raise ValueError(f"{self.path}: a journal is a Sun AU file, its name must end in .au")
        if not 0 < rate < np.inf:
            raise ValueError(f"{rate=} Hz must be finite and > 0")
        self.header = Header.of(
            scene,
            method=method,
            seed=int(seed),
            rate=float(rate),
            bands=bands,
            drive_channels=int(drive_channels),
            sensed_channels=int(sensed_channels),
            places=tuple(places),
            drive_limit=None if drive_limit is None else float(drive_limit),
            unit=unit,
            drive_unit=drive_unit,
            profile=profile,
        )
        self._scene = scene
        self._file: BinaryIO | None = None
        self._blocks: list[Array] = []

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def append(
        self,
        drive: Array,
        sensed: Array,
        motion: Array,
        position: Array,
        normal_load: Array,
        target: Array,
        flags: Array,
    ) -> None:
        """Keep the next n samples.

        Parameters
        ----------
        drive : ndarray, shape (n, drive_channels), A
            What the device was handed for each interval.
        sensed : ndarray, shape (n, sensed_channels), m
        motion : ndarray, shape (n, places), m
            True motion, or what comes nearest where the device knows no truth.
        position : ndarray, shape (n,), m
            Finger from the middle of the surface, NaN while it is lifted.
        normal_load : ndarray, shape (n,), N
        target : ndarray of complex, shape (n, n_bands), m
            Wanted envelopes.
        flags : ndarray of int, shape (n,)
            Status words (``protocols.Flag``).
        """
        signals = {
            "drive": drive,
            "sensed": sensed,
            "motion": motion,
            "position": position,
            "normal_load": normal_load,
            "target": target,
            "flags": flags,
        }
        if self.path is None:
            self._blocks.append(journal.join(self.header, signals))
            return
        frames = journal.join(self.header, signals, journal.JOURNAL_DTYPE)
        if self._file is None:
            self._file = self._create(self.path)
        self._file.write(frames.data)
        self._file.flush()

    def close(self) -> None:
        """Close the journal; what was appended stays."""
        if self._file is not None:
            self._file.close()

    def finish(self) -> Recording:
        """Close the journal and return what was kept; with a path it is mapped from the file, not held in memory."""
        if self.path is None:
            frames = np.concatenate(self._blocks) if self._blocks else np.empty((0, len(self.header.channels)))
            self._blocks = [frames]
            return Recording(self.header, frames, self._scene)
        if self._file is None:
            self._file = self._create(self.path)
        self.close()
        return Recording(*journal.read_journal(self.path), self._scene)

    def _create(self, path: Path) -> BinaryIO:
        path.unlink(missing_ok=True)  # a recording may still map the old file: replace it, never write into it
        file = path.open("xb")
        file.write(journal.journal_head(self.header))
        return file


class Recording:
    """What happened in a run, with all signals on one clock.

    Parameters
    ----------
    header : Header
        What the columns mean and where they come from.
    frames : ndarray, shape (n, columns)
        The signals, possibly mapped from a file: then every access to a signal reads it afresh.
    scene : Scene or None
        The scene; None parses it from the header when it is asked for.

    Attributes
    ----------
    method, seed, rate, bands
        As given to `Recorder`; `rate` in Hz.
    time : ndarray, shape (n,), s
    drive : ndarray, shape (n, drive_channels), A
    sensed : ndarray, shape (n, sensed_channels), m
    motion : ndarray, shape (n, places), m
    position : ndarray, shape (n,), m; NaN while the finger is lifted
    normal_load : ndarray, shape (n,), N
    target : ndarray of complex, shape (n, n_bands), m
    flags : ndarray of int, shape (n,)
    """

    def __init__(self, header: Header, frames: Array, scene: Scene | None = None) -> None:
        self.header = header
        self.frames = frames
        if scene is not None:
            self.scene = scene

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        return (
            f"<Recording of {self.header.name!r} by {self.method!r}: {len(self) / self.rate:.3g} s at {self.rate} Hz>"
        )

    @cached_property
    def scene(self) -> Scene:
        """The scene that was rendered."""
        from hapticrender.touch.scene import Scene

        return Scene.from_toml_text(self.header.scene, where="recording")

    @property
    def method(self) -> str:
        """Name of the control method."""
        return self.header.method

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.header.seed

    @property
    def rate(self) -> float:
        """Sampling rate (Hz)."""
        return self.header.rate

    @property
    def bands(self) -> Bands:
        """Carriers of the run."""
        return self.header.bands

    @property
    def time(self) -> Array:
        """Time since the start (s, shape (n,))."""
        return np.arange(len(self)) / self.rate

    @property
    def drive(self) -> Array:
        """What was sent (A, shape (n, drive_channels))."""
        return self.read("drive")

    @property
    def sensed(self) -> Array:
        """What the sensors said (m, shape (n, sensed_channels))."""
        return self.read("sensed")

    @property
    def motion(self) -> Array:
        """True motion at the judged places (m, shape (n, places))."""
        return self.read("motion")

    @property
    def position(self) -> Array:
        """Finger from the middle of the surface (m, shape (n,)), NaN while lifted."""
        return self.read("position")

    @property
    def normal_load(self) -> Array:
        """Load of the finger (N, shape (n,))."""
        return self.read("normal_load")

    @property
    def target(self) -> Array:
        """Wanted envelopes (m, complex, shape (n, n_bands))."""
        return self.read("target")

    @property
    def flags(self) -> Array:
        """Status words (int, shape (n,)), see ``protocols.Flag``."""
        return self.read("flags")

    def read(self, name: str, start: int = 0, stop: int | None = None) -> Array:
        """Read samples `start` to `stop` of one signal, so that a long run need not fit into memory."""
        return journal.column(self.header, self.frames[start:stop], name)

    @cached_property
    def envelopes(self) -> judge.Envelopes:
        """Wanted and achieved envelopes over time (computed once)."""
        return judge.analyse(self)

    def summary(self) -> dict[str, Any]:
        """Figures and verdict as plain numbers, ready for JSON (see ``judge.summary``)."""
        return judge.summary(self)

    def text(self) -> str:
        """Write the summary as a table for the terminal."""
        return judge.text(self.summary())

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Draw target, achieved motion, drive and finger into one PNG; needs matplotlib."""
        from hapticrender.charts import picture

        picture.plot(self, path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to .au, .npz, .h5 or .hdf5 (these can be loaded again), .mat, .csv, .wav, .w64, .rf64 or .flac."""
        formats.write(path, self.header, self.frames)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Open a recording (.au, .npz, .h5, .hdf5); a journal is mapped, also while another process writes it."""
        return cls(*formats.read(path))
