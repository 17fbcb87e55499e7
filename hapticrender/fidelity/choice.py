"""The least model of a device that a scene needs, and how far it may stray from the full one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hapticrender.fidelity import friction as fidelity_friction
from hapticrender.fidelity import plate as fidelity_plate
from hapticrender.fidelity.plate import NoBound, Option
from hapticrender.touch.finger import Finger
from hapticrender.touch.scene import PlantValue, Scene
from hapticrender.wording import percent

SHARE = 0.1  # of the scene's tolerance that the model may use up; the rest is the controller's


class Ladder(NamedTuple):
    """How a device's model can be made less: its options, tried in order, and the error bound of a lesser scene."""

    options: tuple[Option, ...]
    bound: Callable[[Scene, Scene], float]


LADDERS: dict[str, Ladder] = {
    "vt-plate": Ladder(fidelity_plate.OPTIONS, fidelity_plate.bound),
    "electroadhesion": Ladder(fidelity_friction.SCREEN_OPTIONS, fidelity_friction.bound),
    "ultrasonic": Ladder(fidelity_friction.SURFACE_OPTIONS, fidelity_friction.bound),
}


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One thing that a model may leave out.

    Parameters
    ----------
    option, value : str
        What would be set to what, as "finger order" and "2".
    meaning : str
        What is left out, in words.
    taken : bool
        Whether the least model leaves it out.
    bound : float or None
        Relative error (1) of a model that leaves out this and everything taken before it; None where there is none.
    reason : str
        Why there is no bound.
    """

    option: str
    value: str
    meaning: str
    taken: bool
    bound: float | None
    reason: str = ""

    def text(self, used: bool = False) -> str:
        """Say in a line what became of it; `used` where the least model was the one that played."""
        end = self.reason if self.bound is None else f"off by at most {percent(self.bound)}"
        verdict = ("left out" if used else "may be left out") if self.taken else "needed"
        return f"{verdict}: {self.meaning} ({self.option} {self.value}: {end})"


@dataclass(frozen=True, kw_only=True)
class Fidelity:
    """The least model for a scene.

    Parameters
    ----------
    scene : Scene
        The scene, with the model that it asks for.
    least : Scene
        The same with the least model: its `plant` and `finger` hold what was left out.
    tolerance : float
        Relative error (1) that the model may have.
    choices : tuple of Choice
        Everything that was tried, in order.
    note : str
        Why nothing could be tried; empty otherwise.
    """

    scene: Scene
    least: Scene
    tolerance: float
    choices: tuple[Choice, ...]
    note: str = ""

    @property
    def taken(self) -> tuple[Choice, ...]:
        """What the least model leaves out."""
        return tuple(choice for choice in self.choices if choice.taken)

    @property
    def bound(self) -> float:
        """Largest relative error (1) of the least model; 0 where it is the full one."""
        last = self.taken[-1].bound if self.taken else None
        return 0.0 if last is None else last

    @property
    def plant(self) -> Mapping[str, PlantValue]:
        """The plant's parameters that the least model sets otherwise than the scene does."""
        return {key: value for key, value in self.least.plant.items() if self.scene.plant.get(key) != value}

    @property
    def finger(self) -> Finger:
        """The least model's finger."""
        return self.least.finger

    def text(self, used: bool = False) -> str:
        """Say what may be left out (or is, where `used`), what is needed, and by how much each would be wrong."""
        if self.note:
            return f"least model: the full one; {self.note}"
        lines = [choice.text(used) for choice in self.choices] or ["nothing can be left out"]
        return "\n  ".join([f"least model, off by at most {percent(self.tolerance)}:", *lines])


def fidelity(scene: Scene, tolerance: float | None = None) -> Fidelity:
    """Find the least model of a scene's device whose error bound stays inside a tolerance.

    Options are tried from the one that saves most; each is kept if the model
    without it, and without all that was left out before, stays inside.

    Parameters
    ----------
    scene : Scene
        What is rendered; its `plant` and `finger` are the full model.
    tolerance : float, optional
        Relative error that the model may have, > 0 and <= 10; a tenth of the scene's by default.

    Returns
    -------
    Fidelity
        A device that has no lesser models gets its full one, and a note.

    Raises
    ------
    ValueError
        For a tolerance out of its bound, or a scene that the device cannot have.

    Notes
    -----
    The error is the largest difference, in any window that the judge may read, of
    the envelopes of motion or friction at the judged places, in the worst band,
    relative to its target, while both models get the drive with which the lesser
    one reaches the target.  The verdict's figure, an rms over time, then differs by
    no more under that drive; that the loop finds it on both is not part of the bound.
    It is at most 1.5 times the error that two played devices show, where that
    is 2e-4 or more.  In noise the error is chance: on an ultrasonic surface both
    models are played, which takes seconds, and what is told is for the worst of
    many runs, 40 say.  Where noise alone wakes the amplitude loop, in one run of
    thirty, most runs show a half of it or less.

    Examples
    --------
    >>> from hapticrender.touch.builtin import builtin_scenes
    >>> [choice.taken for choice in fidelity(builtin_scenes()["grating-20"]).choices]
    [False]
    """
    allowed = SHARE * scene.tolerance if tolerance is None else tolerance
    if isinstance(allowed, bool) or not isinstance(allowed, (int, float)):
        raise TypeError(f"tolerance = {allowed!r}: must be a number")
    if not 0.0 < allowed <= 10.0:
        raise ValueError(f"tolerance = {allowed!r}: must be > 0 and <= 10")
    ladder = LADDERS.get(scene.device)
    if ladder is None:
        return _full(scene, allowed, f"{scene.device} has no lesser ones")
    least, choices = scene, list[Choice]()
    try:
        for option in ladder.options:
            lesser = option.reduced(least)
            if lesser is None:
                continue
            choice = _judge(ladder, option, scene, lesser, allowed)
            choices.append(choice)
            if choice.taken and isinstance(lesser, Scene):
                least = lesser
    except NoBound as problem:
        return _full(scene, allowed, str(problem))
    return Fidelity(scene=scene, least=least, tolerance=allowed, choices=tuple(choices))


def _judge(ladder: Ladder, option: Option, scene: Scene, lesser: Scene | str, allowed: float) -> Choice:
    """Take or refuse an option; `lesser` is the scene with it, or why it cannot be had."""
    told = {"option": option.name, "value": option.value, "meaning": option.meaning}
    if isinstance(lesser, str):
        return Choice(**told, taken=False, bound=None, reason=lesser)
    bound = ladder.bound(scene, lesser)
    return Choice(**told, taken=math.isfinite(bound) and bound <= allowed, bound=bound)


def _full(scene: Scene, allowed: float, note: str) -> Fidelity:
    return Fidelity(scene=scene, least=scene, tolerance=allowed, choices=(), note=note)
