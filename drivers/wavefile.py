"""Drive as a sound file, written while it plays.

A file is a device without sensors: the controller drives it open loop.  A sample of 1.0 in the file is `full_scale`.
"""

from contextlib import suppress
from pathlib import Path

import numpy as np
import soundfile

from hapticrender.checks import number
from hapticrender.drivers.base import BaseDriver
from hapticrender.errors import DeviceLost, DeviceNotFound, DriverError
from hapticrender.protocols import Array, Flag, Sensed

FORMATS = {".wav": "WAV", ".w64": "W64", ".rf64": "RF64", ".aiff": "AIFF", ".aif": "AIFF", ".flac": "FLAC"}
SUBTYPES = {"PCM_16": 16, "PCM_24": 24, "PCM_32": 32, "FLOAT": None, "DOUBLE": None}  # bits of the integers
MARK = "hapticrender drive"  # the comment of a file of this driver begins with it
WIDTH = 32  # soundfile takes integers of any width left-justified in 32 bits


class WaveFileDriver(BaseDriver):
    """Writes every block of drive to a WAV, FLAC, W64, RF64 or AIFF file while it plays.

    A killed process leaves all that was played in WAV and W64, all but the last 4096 samples at most in FLAC; RF64 and
    AIFF then report 0 frames.  Drive beyond `full_scale` is held exactly by FLOAT and DOUBLE; integers cut it to their
    range, `clipped` counts the samples, and ``Sensed.flags`` has `Flag.SATURATED`.

    Parameters
    ----------
    path : str or Path
        File to write, anew; its ending chooses the format: .wav, .flac, .w64, .rf64, .aiff, .aif.  One that is there is
        refused unless it has this driver's comment, for which W64 has no room, or `overwrite` is True.
        W64 and RF64 hold more than 4 GB.
    rate : float, Hz, > 0
        The file's header holds the nearest whole number of Hz.
    full_scale : float, A, > 0
        Drive that stands in the file as 1.0.  An integer format ends one step short of it upwards.
    subtype : {"PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE"}, optional
        FLOAT unless given, for FLAC PCM_24 (which holds integers of 16 and 24 bits only).
    drive_channels, block : int, >= 1
        Columns of drive, and samples a call.
    overwrite : bool
        Whether any file of that name may be replaced.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        rate: float = 48000.0,
        full_scale: float = 3.0,
        subtype: str | None = None,
        drive_channels: int = 2,
        block: int = 1024,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.full_scale = number("full_scale", full_scale, "A", above=0.0)
        self.clipped = 0  # samples that the file holds cut to its range
        self._format, self._subtype = _file_form(self.path, subtype)
        if not overwrite and not _is_own(self.path):
            raise ValueError(
                f"{path}: is there and no file of this driver: choose another name, or overwrite (--force)"
            )
        super().__init__(rate=rate, drive_channels=drive_channels, sensed_channels=0, block=block)

    def _open(self) -> None:
        if not self.path.parent.is_dir():
            raise DeviceNotFound(f"{self.path}: open: no folder {self.path.parent}")
        try:
            self._file = soundfile.SoundFile(
                self.path, "w", round(self.rate), self.drive_channels, self._subtype, format=self._format
            )
            if self._format != "W64":
                self._file.comment = f"{MARK}, full scale = {self.full_scale:g} A"
        except (OSError, soundfile.SoundFileError) as error:
            form = f"{self._format} {self._subtype}, {self.drive_channels} channels, {self.rate:g} Hz"
            raise DriverError(f"{self.path}: open: {_reason(error)} ({form})") from error

    def _play(self, drive: Array) -> Sensed:
        samples, bits, flags = drive / self.full_scale, SUBTYPES[self._subtype], None
        if bits is not None:  # integers are rounded to nearest and cut, so that soundfile writes them unchanged
            top, beyond = 2.0 ** (bits - 1), np.abs(samples) > 1
            self.clipped += int(np.count_nonzero(beyond))
            flags = np.where(beyond.any(axis=1), int(Flag.SATURATED), 0) if beyond.any() else None
            steps = np.clip(np.rint(samples * top), -top, top - 1)
            samples = (steps.astype(np.int64) << (WIDTH - bits)).astype(np.int32)
        try:
            self._file.write(samples)
        except (OSError, AssertionError, soundfile.SoundFileError) as error:  # soundfile asserts that all was written
            raise DeviceLost(f"{self.path}: write: {_reason(error)}") from error
        return Sensed(np.empty((len(drive), 0)), flags=flags)

    def _close(self) -> None:
        self._file.close()

    def __str__(self) -> str:
        return str(self.path)


def _is_own(path: Path) -> bool:
    """Whether this driver wrote the file, or nothing is in it or there."""
    if not path.is_file() or not path.stat().st_size:
        return True
    with suppress(OSError, soundfile.SoundFileError), soundfile.SoundFile(path) as file:
        return str(file.comment).startswith(MARK)
    return False


def _file_form(path: Path, subtype: str | None) -> tuple[str, str]:
    """Format by the path's ending, and the subtype if that format holds it."""
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise ValueError(f"{path}: the ending {path.suffix!r} must be one of {', '.join(FORMATS)}")
    if subtype is None:
        subtype = "PCM_24" if kind == "FLAC" else "FLOAT"
    known = [name for name in SUBTYPES if soundfile.check_format(kind, name)]
    if subtype not in known:
        raise ValueError(f"{path}: {subtype=} must be one of {', '.join(known)} for {kind}")
    return kind, subtype


def _reason(error: Exception) -> object:
    """Message of libsndfile, without the path that it repeats."""
    return getattr(error, "error_string", str(error)) or "not every sample was written"
