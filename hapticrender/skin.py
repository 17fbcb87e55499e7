"""Predicted skin velocity of a recording on any device, band by band.

A plate moves the skin with it, V = j w X; friction moves it by V = (v/F) F, with v/F as the scene has it.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from hapticrender.protocols import Array
from hapticrender.recordings.envelopes import amplitude_error
from hapticrender.recordings.recording import Recording
from hapticrender.touch.perception import VELOCITY_PER_FORCE, sensation_level


class SkinBand(NamedTuple):
    """Skin velocity of a band (m/s peak), and its level above the classic detection threshold."""

    frequency: float  # Hz: the median while it is judged
    target: float
    achieved: float
    level: float  # dB; NaN where the threshold is not known

    @property
    def error(self) -> float:
        """Relative error of the achieved velocity."""
        return float(amplitude_error(self.achieved, self.target))


def velocity_per_unit(recording: Recording, frequency: Any) -> Array:
    """Skin velocity (m/s, complex) per unit of the device's quantity, at `frequency` (Hz, > 0; any on a plate)."""
    hertz = np.asarray(frequency, float)
    unit = recording.header.unit
    if unit == "m":
        return 2j * np.pi * hertz
    if unit == "m/s":
        return np.ones_like(hertz, complex)
    share = float(recording.scene.rendering.get("velocity_per_force", VELOCITY_PER_FORCE))  # type: ignore[arg-type]
    if share:
        return share * np.ones_like(hertz, complex)
    return recording.scene.finger.mechanics.skin_velocity_per_force(np.maximum(abs(hertz), 1e-9))


def skin_bands(recording: Recording) -> list[SkinBand]:
    """Predicted skin velocity of every judged band, at the device's first place.

    >>> import hapticrender as hr
    >>> scene = hr.Scene(texture=hr.Grating(velocity=5e-3, frequency=100.0), duration=1.5)
    >>> [band] = skin_bands(hr.render(scene))
    >>> f"{1e3 * band.target:.2f} mm/s, {band.level:.0f} dB above threshold"
    '5.00 mm/s, 22 dB above threshold'
    """
    found = []
    for band in recording.summary()["bands"]:
        if band["target"] is None or not band["frequency"]:
            continue
        share = float(abs(velocity_per_unit(recording, band["frequency"])))
        achieved = share * band["achieved"]
        level = float(sensation_level(achieved / (2 * math.pi * band["frequency"]), band["frequency"]))
        found.append(SkinBand(band["frequency"], share * band["target"], achieved, level))
    return found
