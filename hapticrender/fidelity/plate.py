"""What the model of the vibrotactile plate can leave out for a scene, and the error bound of a scene that does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from hapticrender.bands import Bands
from hapticrender.fidelity.windows import BETWEEN, compared_with, fade, look
from hapticrender.plants.fidelity import FingerPath, PlateModel, forgetting_time, held, sag, stray
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array
from hapticrender.recordings.judge import LOWEST_FREQUENCY
from hapticrender.touch.mechanics import FingerMechanics
from hapticrender.touch.motion import Nowhere, Sliding, Still, Swiping
from hapticrender.touch.scene import Scene

FASTEST_STEPS = 20e3  # Hz: a plate of a higher rate is followed in steps of several samples
STEPS_PER_PERIOD = 8
ACCURACY = 5e-5  # relative error below which nothing is told
NEGLIGIBLE = ACCURACY / 10  # relative size below which what is left of a touch is not followed
SETTLING = 10.0  # time constants between the last touch and the judgement, at least
TOUCHING = 10.0  # a touch rings by less than so many times what it settles to
LOOK_AHEAD = 60.0  # s of a scene that are followed; what comes later has to be a repetition
FIT_FREQUENCIES = 50  # at which a lesser finger is fitted, at most
COARSE = 2000  # times at which a path is looked at before it is followed
NUMBERS = ("mass", "damping", "stiffness", "phalanx_mass", "phalanx_damping", "phalanx_stiffness")


class _Times(NamedTuple):
    """Times (s) to follow the plate at, when the judgement begins (s), and whether the plate is at rest at first."""

    steps: Array
    begin: float
    from_rest: bool


class NoBound(Exception):
    """The scene is such that no tight bound is known."""


class Option(NamedTuple):
    """Something to leave out: its name, its value and meaning, and what makes of a scene the lesser one.

    `reduced` returns None where there is nothing to leave out, and a reason where it cannot be.
    """

    name: str
    value: str
    meaning: str
    reduced: Callable[[Scene], Scene | str | None]


def bound(scene: Scene, lesser: Scene) -> float:
    """Largest relative error (1) of the plate's motion in a lesser model; see `hapticrender.fidelity.choice.fidelity`.

    Both models' difference is put together, sag and all bands, and looked at through the judge's windows.  The plant
    holds the finger over each sample, so what it does comes half a sample late; of the drive the controller knows that.
    """
    bands = _bands(scene)
    envelope = _envelope(bands)
    if not envelope.any():
        return 0.0
    times = _times(scene, lesser, bands)
    path, felt = _touch(scene, times.steps), np.maximum(times.steps - 0.5 / _parameters(scene).rate, 0.0)
    paths = [_touch(each, felt)._replace(time=times.steps) for each in (scene, lesser)]
    full, less = (_model(each, on, times.from_rest) for each, on in zip((scene, lesser), paths, strict=True))
    plate, omega = full.parameters, _omega(bands, path)
    weight = fade(bands, omega / (2 * math.pi), _highest(plate), plate.rate)
    carrier = envelope * np.exp(1j * bands.carrier_phase(path.time, path.position))
    apart, worst = np.zeros((len(path.time), 3)) + sag(full) - sag(less), np.zeros((3, len(bands)))
    for k in np.flatnonzero(envelope):
        parted = stray(full, less, omega[:, k], weight[:, k]) + held(full, less, omega[:, k], weight[:, k])
        apart += (parted * carrier[:, k, None]).real
        worst[:, k] = abs(parted[-1] * envelope[k])
    target = abs(envelope)
    if len(path.time) > 2:
        many = max(1, round(1 / (path.step * plate.rate)))  # steps a sample, of which the judge sees one
        late = np.arange(0, len(path.time), many)[path.time[::many] >= times.begin - path.step / 2]
        phase, wanted = bands.carrier_phase(path.time[late], path.position[late]), (weight * carrier).real.sum(axis=1)
        signals, rates = (apart[late], wanted[late]), (1 / (many * path.step), plate.rate)
        seen = look(bands, rates, path.position[late], phase, signals, weight[late] > 0.0)
        worst, target = BETWEEN * seen.apart.max(axis=0, initial=0.0), seen.target
    target = compared_with(target, scene.tolerance) * abs(1.0 + scene.gradient * _places(plate))[:, None]
    return float((worst / target).max()) + ACCURACY


def _envelope(bands: Bands) -> Array:
    """Wanted envelopes (m, (bands,)), which do not change."""
    if bands.envelope is None:
        raise NoBound("its texture has no constant envelopes, so no tight bound is known")
    return bands.envelope


def _highest(plate: PlateParameters) -> float:
    """Frequency (Hz) above which targets fade."""
    return plate.band_model(plate.rate, plate.delay).highest_frequency


def _places(plate: PlateParameters) -> Array:
    """Where centre and ends are (m)."""
    return plate.glass_length / 2 * np.array([0.0, -1.0, 1.0])


def _parameters(scene: Scene) -> PlateParameters:
    return PlateParameters.with_overrides(scene.plant)


def _model(scene: Scene, path: FingerPath, from_rest: bool = False) -> PlateModel:
    return PlateModel(_parameters(scene), scene.finger.mechanics, path, scene.gradient, from_rest)


def _bands(scene: Scene) -> Bands:
    return scene.texture.bands(_parameters(scene).rate)


def _omega(bands: Bands, path: FingerPath) -> Array:
    """Angular frequency (rad/s, shape (n, bands)) of every carrier along the path."""
    return 2 * math.pi * bands.instantaneous_frequency(np.gradient(path.position, path.step))


def _times(scene: Scene, lesser: Scene, bands: Bands) -> _Times:
    """Times to follow the plate at: two of them where nothing changes any more."""
    begin = scene.settle if scene.duration >= 2 * scene.settle else scene.duration / 2
    end = min(scene.duration, begin + LOOK_AHEAD)
    if end < scene.duration and not isinstance(scene.finger.motion, Nowhere | Still | Sliding | Swiping):
        raise NoBound(f"its finger's path is longer than {LOOK_AHEAD:g} s and no repetition")
    coarse = np.linspace(0.0, end, COARSE)
    models = [_model(each, _touch(each, coarse)) for each in (scene, lesser)]
    forgets, rate = forgetting_time(*models), models[0].parameters.rate
    rest, top = SETTLING * forgets, float(abs(_omega(bands, models[0].path)).max(initial=1.0)) / (2 * math.pi)
    late = f"it is judged from {begin:.3g} s on, less than {rest:.3g} s after its finger last came or went"
    if rest > begin:
        raise NoBound(late)
    if top > rate / 2:
        raise NoBound(f"it reaches {top:.4g} Hz, more than half the rate of {rate:g} Hz")
    step, first = _step(rate, top), max(begin - 2 * rest, 0.0)
    many = max(1, round(1 / (step * rate)))
    steps = step * np.arange(math.floor(first / (many * step)) * many, math.ceil(end / step))
    down = np.isfinite(scene.finger.position(steps))
    changed = steps[1:][down[1:] != down[:-1]].max(initial=steps[0])
    if begin - changed < rest:
        raise NoBound(late)
    omega = _omega(bands, _touch(scene, steps))
    if abs(omega[2:] - omega[:-2]).max(initial=0.0) > 2 * math.pi * LOWEST_FREQUENCY:
        raise NoBound("its finger changes its speed at once, and the texture's frequency with it")
    late_paths = [_touch(each, steps[steps >= max(changed, begin - rest)]) for each in (scene, lesser)]
    if all(path.constant for path in late_paths):
        ring = TOUCHING * math.exp(-(begin - changed) / forgets)
        models = [_model(each, path) for each, path in zip((scene, lesser), late_paths, strict=True)]
        sagging = sum(float(abs(sag(model)).max()) for model in models)
        if ring * (1.0 + sagging / abs(_envelope(bands)).max()) < NEGLIGIBLE:
            return _Times(np.array([begin, begin + step]), begin, False)
    return _Times(steps, begin, first == 0.0)


def _step(rate: float, top: float) -> float:
    """Step (s) that follows a carrier of `top` (Hz): a whole number of samples, or a whole part of one."""
    wanted = max(min(rate, FASTEST_STEPS), STEPS_PER_PERIOD * top)
    return math.floor(rate / wanted) / rate if wanted <= rate else 1 / (math.ceil(wanted / rate) * rate)


def _touch(scene: Scene, time: Array) -> FingerPath:
    """The finger at `time` (s); while it is up it counts as resting where it is seen first, with no load."""
    position, load, strength = scene.finger.touch(time).T
    down = np.isfinite(position)
    seen = position[down.argmax()] if down.any() else 0.0
    return FingerPath(time, np.where(down, position, seen), load, strength)


def _still(scene: Scene) -> Scene | str | None:
    """Rest the finger in the middle of its path."""
    finger = scene.finger
    if isinstance(finger.motion, Nowhere | Still):
        return None
    if _bands(scene).wavenumber.any():
        return "the texture is read at the finger's position"
    if finger.normal_load is None:
        return "the finger's load is recorded with its path"
    position = finger.position(np.linspace(0.0, min(scene.duration, LOOK_AHEAD), COARSE))
    if not np.isfinite(position).any():
        return None
    middle = (np.nanmin(position) + np.nanmax(position)) / 2
    return replace(scene, finger=replace(finger, motion=Still(float(middle))))


def _level(scene: Scene) -> int:
    """Order of the finger's mechanics as modelled; 0 where there is no finger."""
    if isinstance(scene.finger.motion, Nowhere) or not scene.plant.get("finger_dynamics", 1):
        return 0
    return scene.finger.mechanics.order


def _unscaled(scene: Scene) -> Scene | None:
    """Give the finger the impedance of its mean load throughout."""
    finger = scene.finger
    if not (finger.load_scaling and _level(scene)):
        return None
    strength = finger.strength(np.linspace(0.0, min(scene.duration, LOOK_AHEAD), COARSE))
    if not strength.any():
        return None
    mean = float(strength[strength > 0.0].mean())
    scaled = {name: mean * getattr(finger.mechanics, name) for name in NUMBERS}
    return replace(scene, finger=replace(finger, mechanics=replace(finger.mechanics, **scaled), load_scaling=False))


def _load_only(scene: Scene) -> Scene | None:
    """Leave of the finger its load."""
    return replace(scene, plant={**scene.plant, "finger_dynamics": 0}) if _level(scene) else None


def _second_order(scene: Scene) -> Scene | str | None:
    """Replace a finger of order 4 by the one of order 2 that comes nearest where the scene's bands lie."""
    if _level(scene) != 4:
        return None
    own = scene.finger.mechanics
    bands = _bands(scene)
    path = _touch(scene, np.linspace(0.0, min(scene.duration, LOOK_AHEAD), COARSE))
    frequency = np.unique(abs(_omega(bands, path))) / (2 * math.pi)
    frequency = frequency[frequency >= LOWEST_FREQUENCY * 0.99]
    if not frequency.size:
        return "no band is fast enough to be judged"
    frequency = frequency[np.unique(np.linspace(0, frequency.size - 1, FIT_FREQUENCIES).astype(int))]
    impedance, omega = own.impedance(frequency), 2 * math.pi * frequency
    rows = np.array([[1j * w, 1.0, -1j / w] for w in omega]) / impedance[:, None]
    found = nnls(np.vstack([rows.real, rows.imag]), np.repeat([1.0, 0.0], len(omega)))[0]
    if not found.any():
        return "no finger of order 2 comes near it"
    mechanics = FingerMechanics(
        order=2, mass=found[0], damping=found[1], stiffness=found[2], reference_load=own.reference_load
    )
    return replace(scene, finger=replace(scene.finger, mechanics=mechanics))


def _heave_only(scene: Scene) -> Scene | str | None:
    """Lock the rocking."""
    if scene.gradient:
        return "its amplitude grows along the plate"
    if scene.plant.get("degrees_of_freedom", 2) == 1:
        return None
    return replace(scene, plant={**scene.plant, "degrees_of_freedom": 1})


OPTIONS = (
    Option("finger", "static", "where on its path the finger is", _still),
    Option("finger order", "0", "the finger's mechanics, all but its load", _load_only),
    Option("load scaling", "off", "how the finger's impedance follows its load", _unscaled),
    Option("finger order", "2", "the phalanx behind the skin", _second_order),
    Option("degrees of freedom", "1", "rocking", _heave_only),
)
