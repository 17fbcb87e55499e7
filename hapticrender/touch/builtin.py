"""The scenes that the library brings along; the demo renders them and ``validate`` judges by them."""

from __future__ import annotations

from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.recorded import Synthetic
from hapticrender.touch.scene import Scene

DEVICES = ("vt-plate", "electroadhesion", "ultrasonic", "hybrid")
PAPER_FREQUENCIES = (20.0, 31.0, 47.0, 72.0, 111.0, 170.0, 261.0, 400.0)  # Hz, of the paper's eight gratings


def builtin_scenes() -> dict[str, Scene]:
    """Every built-in scene under its name."""
    scenes = [*map(_grating, PAPER_FREQUENCIES), _spatial(), _recorded(), _sliding(), _pressing(), _swiping()]
    scenes += [*one_texture().values(), _screen(), _screen_recorded(), _ultrasonic(), _warming()]
    return {scene.name: scene for scene in scenes}


def _grating(frequency: float) -> Scene:
    """Return one of the paper's gratings on the free plate."""
    texture = Grating(amplitude=10e-6, frequency=frequency)
    return Scene(texture=texture, duration=5.0, tolerance=0.02, name=f"grating-{frequency:g}")


def _spatial() -> Scene:
    """Return ridges of 1 mm under a finger that slides, reverses, lifts and touches again: 80 Hz while it moves."""
    finger = Finger.sliding(speed=0.08, normal_load=0.6, span=0.08, touches=[(0.5, 3.4), (3.8, 6.0)], mechanics="heavy")
    return Scene(texture=Grating(amplitude=10e-6, wavelength=1e-3), finger=finger, duration=6.0, name="spatial-grating")


def _recorded() -> Scene:
    """Return a texture as if recorded at 80 mm/s, under a light finger that sweeps to and fro at up to that speed."""
    finger = Finger.swiping(frequency=0.5, speed=0.08, normal_load=0.3, mechanics="light")
    texture = Synthetic(amplitude=20e-6, speed=0.08)
    return Scene(texture=texture, finger=finger, duration=5.0, name="recorded-texture")


def _sliding() -> Scene:
    """Return a grating near the rocking mode, under a heavy finger that wanders over the plate."""
    finger = Finger.sliding(speed=0.1, normal_load=0.8, span=0.05, mechanics="heavy")
    return Scene(texture=Grating(amplitude=50e-6, frequency=143.0), finger=finger, duration=5.0, name="sliding")


def _pressing() -> Scene:
    """Return a small slow grating, too small to be felt, under a press whose sag is many times larger."""
    finger = Finger.still(normal_load=0.5, touches=[(0.5, 5.0)], mechanics="auto")
    texture = Grating(amplitude=1e-6, frequency=20.0)
    return Scene(texture=texture, finger=finger, duration=5.0, keep_unfelt=True, name="pressing")


def _swiping() -> Scene:
    """Return ridges of 1 mm under fast swipes: up to 940 Hz/s, and through 0 Hz at each reversal."""
    finger = Finger.swiping(frequency=3.0, speed=0.05, normal_load=0.4, mechanics="light")
    return Scene(texture=Grating(amplitude=10e-6, wavelength=1e-3), finger=finger, duration=5.0, name="swiping")


def one_texture() -> dict[str, Scene]:
    """One texture under the same sliding finger on every kind of device, by the device's name."""
    partials = ((1.0, 1.0, 0.0), (2.4, 1 / 2.4, 1.0), (5.0, 0.2, 2.0))  # equal in skin velocity
    texture = Grating(velocity=8e-3, frequency=50.0, partials=partials)
    finger = Finger.sliding(speed=0.08, normal_load=0.4, mechanics="light")
    return {
        device: Scene(
            texture=texture, finger=finger, device=device, duration=3.0, tolerance=0.05, name=f"one-texture-{device}"
        )
        for device in DEVICES
    }


def _screen() -> Scene:
    """Return ridges of 1 mm on an electroadhesion screen, under a finger that slides, reverses, lifts and returns."""
    finger = Finger.sliding(speed=0.08, normal_load=0.6, span=0.08, touches=[(0.5, 3.4), (3.8, 6.0)], mechanics="heavy")
    texture = Grating(velocity=8e-3, wavelength=1e-3, speed=0.08)
    return Scene(texture=texture, finger=finger, device="electroadhesion", duration=6.0, name="screen-spatial")


def _screen_recorded() -> Scene:
    """Return a texture as if recorded, on an electroadhesion screen under a sweeping finger."""
    finger = Finger.swiping(frequency=0.5, speed=0.08, normal_load=0.3, mechanics="light")
    texture = Synthetic(amplitude=40e-6, speed=0.08)
    return Scene(texture=texture, finger=finger, device="electroadhesion", duration=5.0, name="screen-recorded")


def _ultrasonic() -> Scene:
    """Return ridges of 1 mm on an ultrasonic plate, under swipes that pass through 0 Hz at each reversal."""
    finger = Finger.swiping(frequency=1.0, speed=0.15, normal_load=0.5, mechanics="light")
    texture = Grating(velocity=8e-3, wavelength=1e-3, speed=0.1)
    return Scene(texture=texture, finger=finger, device="ultrasonic", duration=4.0, name="ultrasonic-swiping")


def _warming() -> Scene:
    """Return a grating on an ultrasonic plate that warms up by 10 K, which takes its resonance 30 Hz away."""
    finger = Finger.sliding(speed=0.08, normal_load=0.5, mechanics="light")
    texture = Grating(velocity=10e-3, frequency=111.0)
    plant = {"temperature_rise": 10.0, "temperature_time": 3.0}
    return Scene(
        texture=texture, finger=finger, device="ultrasonic", duration=4.0, tolerance=0.02, name="ultrasonic-warming",
        plant=plant,
    )  # fmt: skip
