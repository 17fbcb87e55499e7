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
from hapticrender.protocols import Array, Sensed

FORMATS = {".wav": "WAV", ".w64": "W64"}
MARK = "hapticrender drive"  # the comment of a file of this driver begins with it


class WaveFileDriver(BaseDriver):
    """Writes every block of drive to a WAV or W64 file of 32-bit floats while it plays.

    A killed process leaves all that was played; drive beyond `full_scale` is held exactly.

    Parameters
    ----------
    path : str or Path
        File to write, anew; its ending chooses the format: .wav, or .w64 for more than 4 GB.  One that is there is
        refused unless it has this driver's comment, for which W64 has no room, or `overwrite` is True.
    rate : float, Hz, > 0
        The file's header holds the nearest whole number of Hz.
    full_scale : float, A, > 0
        Drive that stands in the file as 1.0.
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
        drive_channels: int = 2,
        block: int = 1024,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.full_scale = number("full_scale", full_scale, "A", above=0.0)
        if self.path.suffix.lower() not in FORMATS:
            raise ValueError(f"{path}: the ending {self.path.suffix!r} must be one of {', '.join(FORMATS)}")
        if not overwrite and not _is_own(self.path):
            raise ValueError(
                f"{path}: is there and no file of this driver: choose another name, or overwrite (--force)"
            )
        super().__init__(rate=rate, drive_channels=drive_channels, sensed_channels=0, block=block)

    def _open(self) -> None:
        if not self.path.parent.is_dir():
            raise DeviceNotFound(f"{self.path}: open: no folder {self.path.parent}")
        kind = FORMATS[self.path.suffix.lower()]
        try:
            self.path.open("ab").close()  # which says why it fails, where libsndfile has a "System error"
            self._file = soundfile.SoundFile(
                self.path, "w", round(self.rate), self.drive_channels, "FLOAT", format=kind
            )
            if kind != "W64":
                self._file.comment = f"{MARK}, full scale = {self.full_scale:g} A"
        except (OSError, soundfile.SoundFileError) as error:
            form = f"{self.drive_channels} channels, {self.rate:g} Hz"
            raise DriverError(f"{self.path}: open: {_reason(error)} ({form})") from error

    def _play(self, drive: Array) -> Sensed:
        try:
            self._file.write(drive / self.full_scale)
        except (OSError, AssertionError, soundfile.SoundFileError) as error:  # soundfile asserts that all was written
            raise DeviceLost(f"{self.path}: write: {_reason(error)}") from error
        return Sensed(np.empty((len(drive), 0)))

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


def _reason(error: Exception) -> object:
    """Message of libsndfile or of the system, without the path that it repeats."""
    said = getattr(error, "error_string", None) or getattr(error, "strerror", None) or str(error)
    return said or "not every sample was written"
