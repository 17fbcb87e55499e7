"""Recordings of runs: written while a run happens, then saved, judged and drawn."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from hapticrender.bands import Bands
from hapticrender.checks import integer, require
from hapticrender.protocols import Array, Flag
from hapticrender.recordings import formats, journal
from hapticrender.recordings.columns import Chosen, assemble
from hapticrender.recordings.journal import Header
from hapticrender.touch.scene import Scene

if TYPE_CHECKING:
    from hapticrender.recordings.envelopes import Envelopes


FLUSH = 0.25  # s of signal: the most that a killed process loses
READ_AT_ONCE = 2**17  # samples


class Recorder:
    """Write a run while it happens, into a journal or into memory.

    With a path, the file is made at the first block, so that a run which never starts leaves an older journal of that
    name untouched.  Later blocks are collected and handed to the operating system every 0.25 s of signal, and when the
    recorder closes, also after an exception: a killed process loses 0.25 s at most, a failing one nothing.

    `path` is that of the journal, suffix .au; None keeps the run in memory.  ``requested(time, position, velocity)``
    gives the reference (see ``protocols.Rendering``), a quarter of a second at a time, so that no block waits for it;
    without it the reference is appended like the other signals.  `header` holds the other fields of `journal.Header`:
    method, seed, rate (Hz) and bands, and whatever differs from two coils (A) and two sensors (m) with places "centre",
    "end 1" and "end 2" of known motion.

    A ValueError or TypeError where the path does not end in .au, a file of that name is no journal, or a field is out
    of its bounds.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        *,
        scene: Scene,
        requested: Callable[[Array, Array, Array], Array] | None = None,
        **header: Any,
    ) -> None:
        self.path = None if path is None else Path(path)
        if self.path is not None and self.path.suffix.lower() != ".au":
            raise ValueError(f"{self.path}: a journal is a Sun AU file, its name must end in .au")
        if self.path is not None:
            journal.refuse_others(self.path)
        self.header = Header.of(scene, **header)
        self._scene, self._requested = scene, requested
        self._done, self._before = 0, np.full(2, np.nan)  # samples with a reference; the finger's last positions (m)
        self._file: BinaryIO | None = None
        self._begun = False  # whether the file has its header, which says what the first block says
        self._blocks: list[Array] = []  # what is not in the file yet; without a path, everything
        self._waiting = 0  # samples in them
        self._closed = False

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        self.close(stopped=kind is not None)

    def append(self, *, motion_source: str | None = None, gap: int = 0, **signals: Array) -> None:
        """Append n samples of every signal, after `gap` samples that nobody has kept (`Flag.OVERRUN`).

        `drive` (n, channels) as commanded in each interval; `sensed` (n, channels); `motion` (n, places), true or the
        best estimate; finger `position` (n,), m, NaN while lifted; `normal_load` (n,), N; `reference` (n,), the texture
        as the scene specifies it; `target` (n, n_bands), the envelopes that the controller makes of it; `flags` (n,),
        ``protocols.Flag``.  Units are those of the header.  The first block's `motion_source` replaces that of the
        header.
        """
        if motion_source is not None and not self._begun and not self._blocks:
            self.header = replace(self.header, motion_source=motion_source)
        if gap > 0:
            self._append_unknown(gap, Flag.OVERRUN)
        if self._requested is not None:
            signals["reference"] = np.zeros(len(signals["drive"]))
        self._blocks.append(journal.join(self.header, signals))
        self._waiting += len(signals["drive"])
        if not self._begun or self._waiting + len(signals["drive"]) > FLUSH * self.header.rate:  # with the next block
            self.flush()

    def begin(self) -> None:
        """Make the file of `path` now, not at the first block; an OSError states why it cannot be written."""
        path = Path(self.path or "")
        journal.refuse_open(path)
        path.unlink(missing_ok=True)  # a recording may still read the old file: replace it, never write into it
        self._file = path.open("xb")
        journal.OPEN[os.path.realpath(path)] = self._file

    def flush(self) -> None:
        """Hand everything appended so far to the operating system; without a path, do nothing."""
        if self.path is None or not self._blocks:
            return
        blocks, self._blocks, self._waiting = self._blocks, [], 0
        try:
            frames = self._frames(blocks)
        except (KeyboardInterrupt, SystemExit):  # a signal: they are written on closing
            self._blocks = blocks
            raise
        self._write(frames.astype(journal.JOURNAL_DTYPE).data)

    def close(self, stopped: bool = False) -> None:
        """Write what is left and close the journal.

        A run that was `stopped` by an error or a signal ends with a sample of zero drive that has ``Flag.STOPPED``;
        what was sensed then is not known.
        """
        try:
            if stopped and not self._closed and (self._file is not None or self._blocks):
                self._append_unknown(1, Flag.STOPPED)
            self._closed = True
            self.flush()
            if self._file is not None and not self._begun:
                self._write(b"")
        finally:
            if self._file is not None:
                self._file.close()

    def _append_unknown(self, count: int, flag: Flag) -> None:
        """Append samples of zero drive with a flag, of which nothing else is known."""
        unknown, columns = np.zeros((count, len(self.header.channels))), self.header.slices
        for name in ("sensed", "motion", "position"):
            unknown[:, columns[name]] = np.nan
        unknown[:, columns["flags"]] = int(flag)
        self._blocks.append(unknown)
        self._waiting += count

    def finish(self) -> Recording:
        """Close the journal and return the recording; with a path it is read from the file, not held in memory."""
        if self.path is None:
            frames = self._frames(self._blocks) if self._blocks else np.empty((0, len(self.header.channels)))
            self._blocks, self._requested = [frames], None
            return Recording(self.header, frames, self._scene)
        self.close()
        if self._file is None:
            self._write(b"").close()
        return Recording(*journal.read_journal(self.path), self._scene)

    def _frames(self, blocks: list[Array]) -> Array:
        """Frames of blocks with their reference, for the finger's velocity of second order (0 at edges of a touch)."""
        frames = np.concatenate(blocks)
        if self._requested is not None:
            position, rate = journal.column(self.header, frames, "position"), self.header.rate
            path = np.concatenate([self._before, position])
            velocity = np.nan_to_num(np.gradient(path, edge_order=2)[2:] * rate)
            time = (self._done + np.arange(len(frames))) / rate
            frames[:, self.header.slices["reference"]] = self._requested(time, position, velocity)[:, None]
            self._done, self._before = self._done + len(frames), path[-2:]
        return frames

    def _write(self, data: Any) -> BinaryIO:
        if self._file is None:
            self.begin()
        file: Any = self._file
        if not self._begun:
            file.write(journal.journal_head(self.header))
            self._begun = True
        file.write(data)
        file.flush()
        return file  # type: ignore[no-any-return]


def _of_header(name: str, doc: str) -> Any:
    return property(lambda self: getattr(self.header, name), doc=doc)


def _signal(name: str, doc: str) -> Any:
    return property(lambda self: self.read(name), doc=doc)


class Recording:
    """The result of a run, with all signals on one clock.

    `drive`, `sensed`, `motion`, `position`, `normal_load`, `flags`, `reference` and `target` read a whole signal,
    `read` a part of one; units are `header.unit` and `header.drive_unit`, and `header.motion_source` states the
    source of the motion.

    `header` has meaning and origin of the columns of `frames` (n, columns); those of a journal are read from its file
    at every access.  Without a `scene` it is parsed from the header at the first access.
    """

    def __init__(self, header: Header, frames: Array | journal.JournalFrames, scene: Scene | None = None) -> None:
        self.header = header
        self.frames = frames
        self.warnings: tuple[str, ...] = ()  # of the run that has just made it, by its `PlateMismatch`
        self.least_scale = 1.0  # of that run: by which its law scaled the texture at the least, for the drive's limit
        if scene is not None:
            self.scene = scene

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        length = f"{len(self) / self.rate:.3g} s at {self.rate} Hz"
        return f"<Recording of {self.header.name!r} by {self.method!r}: {length}>"

    @cached_property
    def scene(self) -> Scene:
        """The scene that was rendered."""
        return Scene.from_toml_text(self.header.scene, where="recording")

    method: str = _of_header("method", "Name of the control method.")
    seed: int = _of_header("seed", "Seed of the run.")
    rate: float = _of_header("rate", "Sampling rate (Hz).")
    bands: Bands = _of_header("bands", "Carriers of the run.")
    drive: Array = _signal("drive", "Commanded drive (drive unit, shape (n, drive_channels)).")
    sensed: Array = _signal("sensed", "Sensed signals (unit, shape (n, sensed_channels)).")
    motion: Array = _signal("motion", "Motion at the evaluation points (unit, shape (n, places)).")
    position: Array = _signal("position", "Finger from the middle of the surface (m, shape (n,)), NaN while lifted.")
    normal_load: Array = _signal("normal_load", "Load of the finger (N, shape (n,)).")
    reference: Array = _signal("reference", "Texture as the scene specifies it, unscaled (unit, shape (n,)).")
    target: Array = _signal("target", "Reference envelopes (unit, complex, shape (n, n_bands)).")
    flags: Array = _signal("flags", "Status words (int, shape (n,)), see ``protocols.Flag``.")

    @property
    def time(self) -> Array:
        """Time since the start (s, shape (n,))."""
        return np.arange(len(self)) / self.rate

    def read(self, name: str, start: int = 0, stop: int | None = None, step: int = 1) -> Array:
        """Read every `step`-th sample (>= 1) of a signal from `start` to `stop`, a bounded number at a time.

        `name` is "drive", "sensed", "motion", "position", "normal_load", "flags", "reference" or "target".
        """
        require(name in self.header.slices, "name", name, f"one of {', '.join(self.header.slices)}")
        step = integer("step", step, "samples", least=1)
        if isinstance(self.frames, np.ndarray):
            return journal.column(self.header, self.frames[start:stop:step], name)
        columns = len(self.header.channels)
        blocks = journal.chunks(self.frames, columns, start, stop, step)
        parts = [journal.column(self.header, block, name).copy() for block in blocks]  # not a view of all columns
        return np.concatenate(parts) if parts else journal.column(self.header, np.empty((0, columns)), name)

    @cached_property
    def touched(self) -> bool:
        """Whether a finger is on the surface in any sample (found once)."""
        pieces = range(0, len(self), READ_AT_ONCE)
        return any(np.isfinite(self.read("position", start, start + READ_AT_ONCE)).any() for start in pieces)

    @cached_property
    def envelopes(self) -> Envelopes:
        """Reference and achieved envelopes over time (computed once)."""
        from hapticrender.recordings.envelopes import analyse

        return analyse(self)

    @cached_property
    def waveform(self) -> dict[str, Any]:
        """Figures of the motion against the reference (computed once), see ``waveform_figures``."""
        from hapticrender.recordings.waveform_figures import waveform_figures

        return waveform_figures(self)

    def summary(self) -> dict[str, Any]:
        """Figures and verdict as plain numbers, ready for JSON (see ``judge.summary``)."""
        from hapticrender.recordings import judge

        return judge.summary(self)

    def text(self) -> str:
        """Summary as a table for the terminal."""
        from hapticrender.report.text import figures

        return figures(self.summary())

    def plot(self, path: str | os.PathLike[str]) -> bool:
        """Draw target, achieved motion, drive and finger into one .png, .svg or .pdf; False without matplotlib.

        Then a warning states how to install it, so that a script goes on to save the run.
        """
        from hapticrender.report import picture

        try:
            picture.plot(self, path)
        except formats.MissingExtra as error:
            warnings.warn(f"{path} is not drawn: {error}; the recording can be saved", stacklevel=2)
            return False
        return True

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to .au, .npz, .h5, .hdf5, .mat or .csv, which can be loaded again; sound programs open .au."""
        formats.write(path, self.header, self.frames)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Open a recording (.au, .npz, .h5, .hdf5, .mat, .csv); a journal also while another process writes it."""
        return cls(*formats.read(path))

    @classmethod
    def from_columns(
        cls,
        columns: Mapping[str, Any] | str | os.PathLike[str],
        *,
        drive: Chosen,
        sensed: Chosen,
        rate: float | None = None,
        time: Chosen | None = None,
        position: Chosen | None = None,
        normal_load: Chosen | None = None,
        carriers: float | Sequence[float] = (),
        **header: Any,
    ) -> Recording:
        """Make a recording of what another program has recorded, for analysis, pictures and `save`.

        A column is chosen by its name, with a scale, or a scale and an offset: ``{"adc1": (122e-9, 8192)}`` is ``122e-9
        (adc1 - 8192)``; a name, or a list of names, is scaled by 1.  A ValueError or TypeError where a column is
        missing, has no numbers or another length; a value is not finite; times are not even.

        Parameters
        ----------
        columns : mapping of str to array, or path
            Arrays of one length by name; or a .csv, .txt, .mat, .h5, .hdf5 or .npz file of them, see
            `hapticrender.recordings.columns.read_columns`.
        drive, sensed : columns
            In A and m of the device's channels, in its order (a plate: coil 1 and 2, sensor 1 and 2 at the ends of the
            glass), after the scale.  All values must be finite.  A row of the drive is held until the next (a command;
            a current that was measured at the same instant has acted half a sample before).  A column that drives
            both coils is named twice; ``drive=[]``: no drive.
        rate : float, Hz
            Sampling rate; it may be left out where there is a column of times.
        time : column, s
            Every time must be within half a sample of an even grid.
        position : column, m from the middle of the surface
            NaN while the finger is away; default: not known.  A column of unsigned integers is unwrapped.
        normal_load : column, N
            Default: not known.
        carriers : number or sequence of float, Hz
            Frequencies that were driven: the impedance is analysed at these.
        **header
            `name`, `device` (kind, or file of a profile), `unit` of the sensors ("m"), `drive_unit` ("A"),
            `sensed_noise`, and other fields of `hapticrender.recordings.journal.Header`.

        Examples
        --------
        >>> import numpy as np
        >>> theirs = {"volt": np.array([0.0, 0.5]), "adc": np.array([8192, 8200])}
        >>> made = Recording.from_columns(theirs, rate=5000.0, drive={"volt": -0.2}, sensed={"adc": (122e-9, 8192)})
        >>> made.drive[:, 0].tolist(), made.sensed[:, 0].round(9).tolist()
        ([-0.0, -0.1], [0.0, 9.76e-07])
        """
        chosen: Any = {"drive": drive, "sensed": sensed, "time": time, "position": position, "normal_load": normal_load}
        return cls(*assemble(columns, chosen, rate, carriers, **header))
