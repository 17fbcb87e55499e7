"""The built-in scenes: the demo renders them and ``validate`` judges by them."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.recorded import Recorded
from hapticrender.touch.scene import Scene

DEVICES = ("vt-plate", "electroadhesion", "ultrasonic", "hybrid")
PARTIALS = np.array([43.0, 105.0, 171.0, 240.0, 326.0, 398.0])  # Hz, at 80 mm/s: of the recordings
PAPER_FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0)  # Hz: the gratings of Grigorii et al. 2021
SWEEPING = Finger.swiping(frequency=0.5, speed=0.08, normal_load=0.3, mechanics="light")  # to and fro, up to 80 mm/s
LIFTING = Finger.sliding(  # slides, reverses, lifts and touches again
    speed=0.08, normal_load=0.6, span=0.08, touches=[(0.5, 3.4), (3.8, 6.0)], mechanics="heavy"
)


def builtin_scenes(*, carriers: int | None = None) -> dict[str, Scene]:
    """Every built-in scene under its name; recordings with `carriers`, which methods that work by bands need."""
    every = *_on_the_plate(carriers), *one_texture().values(), *_by_friction(carriers)
    return {scene.name: scene for scene in every}


def one_texture() -> dict[str, Scene]:
    """One texture under the same sliding finger on every kind of device, by the device's name."""
    partials = ((1.0, 1.0, 0.0), (2.4, 1 / 2.4, 1.0), (5.0, 0.2, 2.0))  # equal in skin velocity
    texture = Grating(velocity=8e-3, frequency=50.0, partials=partials)
    finger = Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
    return {
        device: _scene(f"one-texture-{device}", texture, finger, 3.0, device=device, tolerance=0.05)
        for device in DEVICES
    }


def _scene(name: str, texture: Any, finger: Finger, duration: float, **fields: Any) -> Scene:
    return Scene(name=name, texture=texture, finger=finger, duration=duration, **fields)


def _recording(amplitude: float, carriers: int | None) -> Recorded:
    """64 mm of a surface, recorded at 80 mm/s, of partials that swell, with a peak of `amplitude` (m)."""
    phase, start = np.random.default_rng(0).uniform(0.0, 2 * np.pi, (2, len(PARTIALS)))
    turn = 2 * np.pi * np.arange(800)[:, None] / 1000
    values = ((1 + 0.5 * np.cos(0.5 * turn + start)) * np.cos(PARTIALS * turn + phase)).sum(axis=1)
    samples = (values / (1.5 * len(PARTIALS))).round(3).tolist()
    return Recorded(samples=tuple(samples), rate=1000.0, speed=0.08, amplitude=amplitude, carriers=carriers)


def _on_the_plate(carriers: int | None) -> Iterator[Scene]:
    """The paper's gratings on the free plate, ridges of 1 mm, a recording, a slide, a press, and fast swipes."""
    for frequency in PAPER_FREQUENCIES:
        texture = Grating(amplitude=10e-6, frequency=frequency)
        yield _scene(f"grating-{frequency:g}", texture, Finger.absent(), 5.0, tolerance=0.02)
    ridges = Grating(amplitude=10e-6, wavelength=1e-3)  # 80 Hz at 80 mm/s
    yield _scene("spatial-grating", ridges, LIFTING, 6.0)
    yield _scene("recorded-texture", _recording(13.97e-6, carriers), SWEEPING, 5.0)
    wandering = Finger.sliding(speed=0.1, normal_load=0.8, span=0.05, mechanics="heavy")
    yield _scene("sliding", Grating(amplitude=50e-6, frequency=143.0), wandering, 5.0)  # near the rocking mode
    press = Finger.still(normal_load=0.5, touches=[(0.5, 5.0)], mechanics="auto")  # its sag is many times the target
    yield _scene("pressing", Grating(amplitude=1e-6, frequency=20.0), press, 5.0, keep_unfelt=True)
    swipes = Finger.swiping(frequency=3.0, speed=0.05, normal_load=0.4, mechanics="light")  # up to 940 Hz/s
    yield _scene("swiping", ridges, swipes, 5.0)


def _by_friction(carriers: int | None) -> Iterator[Scene]:
    """Ridges and a recording on a screen, swipes on an ultrasonic plate, and one that warms up."""
    ridges = Grating(velocity=8e-3, wavelength=1e-3, speed=0.08)
    yield _scene("screen-spatial", ridges, LIFTING, 6.0, device="electroadhesion")
    yield _scene("screen-recorded", _recording(27.94e-6, carriers), SWEEPING, 5.0, device="electroadhesion")
    swipes = Finger.swiping(frequency=1.0, speed=0.15, normal_load=0.5, mechanics="light")
    slower = Grating(velocity=8e-3, wavelength=1e-3, speed=0.1)
    yield _scene("ultrasonic-swiping", slower, swipes, 4.0, device="ultrasonic")
    heat = {"temperature_rise": 10.0, "temperature_time": 3.0}  # takes the resonance 30 Hz away
    sliding = Finger.sliding(speed=0.08, normal_load=0.5, mechanics="light")
    texture = Grating(velocity=10e-3, frequency=111.0)
    yield _scene("ultrasonic-warming", texture, sliding, 4.0, device="ultrasonic", tolerance=0.02, simulation=heat)
