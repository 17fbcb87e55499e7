"""The recording of what a loop plays live."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from hapticrender.live_loop import LiveLoop
from hapticrender.loop import recorder_of
from hapticrender.protocols import Array, Flag
from hapticrender.recordings.recording import Recording

SHORTEST = 1e-3  # s: duration of a scene without an end, as a recording says


class LiveRecorder:
    """Keeps the signals of a loop in a journal; samples that came too late are marked, and a full disk ends it.

    Parameters
    ----------
    path : path
        Of the journal (.au); an older one is replaced.
    loop : LiveLoop
        That plays when it begins.
    endless : bool
        Whether its scene has no duration.

    Raises
    ------
    OSError
        The file cannot be written.
    """

    def __init__(self, path: str | Path, loop: LiveLoop, *, endless: bool) -> None:
        rendering = loop.rendering
        scene = replace(rendering.scene, duration=SHORTEST) if endless else rendering.scene
        bands = replace(rendering.bands.select(np.zeros(0, int)), envelope=None, unfelt=())
        self.error: OSError | None = None  # why it has ended
        self._recorder = recorder_of(replace(rendering, model=loop.model), path, scene=scene, bands=bands)
        self._recorder.begin()

    def append(self, signals: dict[str, Array], gap: int, motion_source: str) -> None:
        """Append signals after `gap` samples that nobody has kept."""
        if self.error is not None:
            return
        try:
            if gap > 0:
                self._recorder.append(motion_source=motion_source, **_missing(signals, gap))
            self._recorder.append(motion_source=motion_source, **signals)
        except OSError as error:
            self.error = error
            self.close()

    def finish(self) -> Recording:
        """Close the journal and return the recording; the OSError that has ended it before."""
        if self.error is not None:
            raise self.error
        return self._recorder.finish()

    def close(self, stopped: bool = False) -> None:
        """Close the journal, whatever the disk says; `stopped`: by an error or a signal."""
        with suppress(OSError):
            self._recorder.close(stopped)


def _missing(signals: dict[str, Array], count: int) -> dict[str, Array]:
    """Signals of samples that nobody has kept: no numbers, and `Flag.OVERRUN`."""
    found = {name: np.full((count, *each.shape[1:]), np.nan) for name, each in signals.items() if name != "target"}
    found |= {name: np.zeros((count, *signals[name].shape[1:])) for name in ("drive", "reference", "normal_load")}
    return found | {"flags": np.full(count, int(Flag.OVERRUN)), "target": np.zeros((count, 0), complex)}
