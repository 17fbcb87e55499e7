"""Scenes of a player: of its device, and of any texture that it is given."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from hapticrender.devices import registered
from hapticrender.touch.finger import Finger
from hapticrender.touch.grating import Grating
from hapticrender.touch.scene import Scene

ANY = Grating(frequency=100.0, amplitude=1e-6)
NOMINAL = Finger.sliding(speed=0.08, normal_load=0.4)  # for which a device is designed where none is stated
LONGEST = 3600.0  # s: duration of a scene that has no end, as it is designed


def scenes_of(device: str | Scene, finger: Finger | None, tables: Mapping[str, Any]) -> Callable[..., Scene]:
    """Return what makes the scene of a texture, ``scenes(texture=...)``; see `hapticrender.Player` for the arguments.

    A ValueError or TypeError where no texture could be played.
    """
    if "texture" in tables:
        raise TypeError("texture: a player has none of its own: call play(texture)")
    if tables.get("touch_panel"):
        cure = "pass positions to `finger` that hr.TouchPanel(...).estimator() has estimated"
        raise ValueError(f"touch_panel: has no effect on the positions that the application sets: {cure}")
    if isinstance(device, Scene):
        scenes = partial(replace, replace(device, finger=finger or device.finger, **tables))
    else:
        scenes = partial(Scene, **{"device": device, "finger": finger or NOMINAL, "duration": LONGEST, **tables})
    scene = scenes(texture=ANY)
    renderer = registered("renderers", scene.device)()
    if hasattr(renderer, "check"):
        renderer.check(scene)
    return scenes
