"""What a player does at the moment, for the application and for the terminal."""

import math
from dataclasses import dataclass

from hapticrender.protocols import Flag


@dataclass(frozen=True)
class BandState:
    """What a band does: its frequency (Hz), target and achieved amplitude, and |achieved - target|/|target|.

    The latter are NaN where no motion is sensed.
    """

    frequency: float
    target: float
    achieved: float
    error: float


@dataclass(frozen=True)
class PlayerState:
    """What a player does: `time` (s played), bands over the last quarter of a second, and all flags so far.

    A texture that is a whole waveform has one band of frequency 0, whose amplitudes are rms.  `lost` counts callbacks
    in which the device lost samples, and samples of a texture that were not computed in time; `load` is the share of
    its time that a callback takes (NaN where unknown).
    """

    time: float
    unit: str
    bands: tuple[BandState, ...]
    flags: Flag
    lost: int
    load: float

    def __str__(self) -> str:
        """One line a band, flags and load."""
        lines = []
        for band in self.bands:
            label = f"{band.frequency:7.1f} Hz" if band.frequency > 0.0 else "  rms of all"
            kind = "error" if band.frequency > 0.0 else "difference"
            achieved = "not sensed" if math.isnan(band.achieved) else f"achieved {band.achieved:9.3g} {self.unit}"
            error = "  -" if math.isnan(band.error) else f"{100 * band.error:6.2f} %"
            lines.append(f"{label}  target {band.target:9.3g} {self.unit}  {achieved}  {kind} {error}")
        load = "" if math.isnan(self.load) else f", load {100 * self.load:.0f} %"
        return "\n".join([*lines, f"{self.time:.1f} s, {self.flags.name or 'no flags'}, {self.lost} lost{load}"])
