"""What renderers share where a device kind has nothing to say of its own."""

from __future__ import annotations

from collections.abc import Callable

from hapticrender.bands import Bands
from hapticrender.control.bandmodel import BandModel
from hapticrender.protocols import Array, Controller, Driver, Method
from hapticrender.touch.scene import Scene

Waveform = Callable[[Array, Array], Array]


class BaseRenderer:
    """Renderer of a device that takes and gives what its controller does; see ``protocols.Renderer``."""

    needs = "a driver"  # of a real device of this kind, in a few words

    def connect(self, scene: Scene, driver: Driver) -> Driver:
        """Return `driver` as the controller is to see it."""
        return driver

    def waveform(self, scene: Scene) -> Waveform:
        """Return the wanted waveform over time (s) and position (m), in the device's quantity."""
        return scene.texture.waveform

    def design(self, method: Method, model: BandModel, bands: Bands, *, feedback: bool = True) -> Controller:
        """Return a controller of `method` for the whole device."""
        return method.design(model, bands, feedback=feedback)
