"""What the model of the vibrotactile plate can leave out for a scene, and the error bound of a scene that does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from hapticrender.bands import Bands
from hapticrender.judge import LARGEST_INFLATION, LOWEST_FREQUENCY, fit, window_length
from hapticrender.plants.fidelity import FingerPath, PlateModel, forgetting_time, held, sag, stray
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array
from hapticrender.touch.mechanics import FingerMechanics
from hapticrender.touch.motion import Nowhere, Sliding, Still, Swiping
from hapticrender.touch.scene import Scene

LONGEST_STEP = 0.5e-3  # s: the plate's modes turn by less than 0.6 rad in it
STEPS_PER_PERIOD = 8
ACCURACY = 5e-5  # relative error below which nothing is told
SETTLING = 10.0  # time constants between the last touch and the judgement, at least
TOUCHING = 10.0  # a touch rings by less than so many times what it settles to
LOOK_AHEAD = 60.0  # s of a scene that are followed; what comes later has to be a repetition
FIT_FREQUENCIES = 50  # at which a lesser finger is fitted, at most
HOPS = 16  # window starts in a window's length: the worst window is sought, not a mean
COARSE = 2000  # times at which a path is looked at before it is followed
CHUNK_VALUES = 2**20  # numbers in one batch of regressors
NUMBERS = ("mass", "damping", "stiffness", "phalanx_mass", "phalanx_damping", "phalanx_stiffness")


class _Times(NamedTuple):
    """Times (s) to follow the plate at, when the judgement begins (s), and what is left of a touch by then (1)."""

    steps: Array
    begin: float
    left: float


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
    """Largest relative error (1) of the plate's motion in a lesser model; see `hapticrender.fidelity.fidelity`.

    What it is off by for the length of its steps is added: three times the
    error that the difference to steps of twice the length foretells (order 2).
    """
    bands, wanted = _bands(scene)
    if not (wanted > 0.0).any():
        return 0.0
    times = _times(scene, lesser, bands)
    fine = _error(scene, lesser, times)
    if _touch(scene, times.steps).constant:
        return fine
    return fine + abs(fine - _error(scene, lesser, times._replace(steps=times.steps[::2])))


def _error(scene: Scene, lesser: Scene, times: _Times) -> float:
    """Largest relative error once the judgement has begun, as found with these steps."""
    full, less = (_model(each, _touch(each, times.steps)) for each in (scene, lesser))
    bands, wanted = _bands(scene)
    omega, judged = _omega(bands, full.path), times.steps >= times.begin
    window = window_length(bands, 1 / full.path.step, full.path.position[judged], np.ptp(times.steps[judged]) / 2)
    leak, ring = _leak(full, less, bands, times.begin, window), times.left * _sagging(full, less)
    worst = 0.0
    for k in np.flatnonzero(wanted):
        read = _readable(omega[:, k], full.parameters)[judged]
        if read.any():
            parted = stray(full, less, omega[:, k])[judged]
            apart = _worst_mean(parted, read, round(window / 2 / full.path.step)) + held(full, less, omega[:, k])
            apart *= abs(bands.envelope[k])  # type: ignore[index]
            worst = max(worst, times.left + float((apart + leak[:, k] + ring).max() / wanted[k]))
    return worst + ACCURACY


def _worst_mean(values: Array, read: Array, many: int) -> Array:
    """Largest magnitude (3,) of the mean of envelopes `values` (n, 3) over `many` rows of which one is `read` (n,).

    Half a window of the judge's: the mean over a whole one is never larger than that over its worse half.
    """
    many = max(1, min(many, len(values)))
    running = np.cumsum(np.column_stack([values, read]), axis=0)
    total = np.vstack([running[many - 1], running[many:] - running[:-many]])
    return abs(total[total[:, 3].real > 0.5, :3]).max(axis=0) / many


def _sagging(*models: PlateModel) -> float:
    """Displacement (m) of the plate by its finger's load, of all models together, at the worst place."""
    return sum(float(abs(sag(model)).max()) for model in models)


def _model(scene: Scene, path: FingerPath) -> PlateModel:
    return PlateModel(PlateParameters.with_overrides(scene.plant), scene.finger.mechanics, path)


def _bands(scene: Scene) -> tuple[Bands, Array]:
    """Bands of a scene, and the amplitude (m) that an error of each is compared with, as the verdict does."""
    bands = scene.texture.bands(PlateParameters.with_overrides(scene.plant).rate)
    if bands.envelope is None:
        raise NoBound("its texture has no constant envelopes, so no tight bound is known")
    wanted = abs(bands.envelope)
    return bands, np.where(wanted > 0.0, np.maximum(wanted, scene.tolerance * wanted.max(initial=0.0)), 0.0)


def _omega(bands: Bands, path: FingerPath) -> Array:
    """Angular frequency (rad/s, shape (n, bands)) of every carrier along the path."""
    velocity = np.diff(path.position) / path.step
    return 2 * math.pi * bands.instantaneous_frequency(np.append(velocity, velocity[-1:]))


def _readable(omega: Array, parameters: PlateParameters) -> Array:
    """Where a carrier is neither too slow to be judged nor faded out."""
    highest = parameters.band_model(parameters.rate, parameters.delay).highest_frequency
    frequency = abs(omega) / (2 * math.pi)
    return (frequency >= LOWEST_FREQUENCY * (1 - 1e-6)) & (frequency <= max(highest, 1.0))


def _times(scene: Scene, lesser: Scene, bands: Bands) -> _Times:
    """Times to follow the plate at."""
    begin = scene.settle if scene.duration >= 2 * scene.settle else scene.duration / 2
    end = min(scene.duration, begin + LOOK_AHEAD)
    if end < scene.duration and not isinstance(scene.finger.motion, Nowhere | Still | Sliding | Swiping):
        raise NoBound(f"its finger's path is longer than {LOOK_AHEAD:g} s and no repetition")
    coarse = np.linspace(0.0, end, COARSE)
    forgets = forgetting_time(*(_model(each, _touch(each, coarse)) for each in (scene, lesser)))
    rest, rate = SETTLING * forgets, PlateParameters.with_overrides(scene.plant).rate
    late = f"it is judged from {begin:.3g} s on, less than {rest:.3g} s after its finger last came or went"
    top = float(abs(_omega(bands, _touch(scene, coarse))).max(initial=1.0)) / (2 * math.pi)
    if rest > begin:
        raise NoBound(late)
    if top > rate / 2:
        raise NoBound(f"it reaches {top:.4g} Hz, more than half the rate of {rate:g} Hz")
    step = min(LONGEST_STEP, 1 / (STEPS_PER_PERIOD * top))
    steps = begin + step * np.arange(-math.floor(min(begin, 2 * rest) / step), math.ceil((end - begin) / step))
    down = np.isfinite(scene.finger.position(steps))
    changed = steps[1:][down[1:] != down[:-1]].max(initial=steps[0])
    if begin - changed < rest:
        raise NoBound(late)
    steps = steps[steps >= begin - rest]
    if abs(np.diff(_omega(bands, _touch(scene, steps)), axis=0)).max(initial=0.0) > 2 * math.pi * LOWEST_FREQUENCY:
        raise NoBound("its finger changes its speed at once, and the texture's frequency with it")
    if all(_touch(each, steps).constant for each in (scene, lesser)):
        steps = np.array([begin, begin + step])  # one time tells all
    return _Times(steps, begin, TOUCHING * math.exp(-(begin - changed) / forgets))


def _touch(scene: Scene, time: Array) -> FingerPath:
    """The finger at `time` (s); while it is up it counts as resting where it is seen first, with no load."""
    position, load, strength = scene.finger.touch(time).T
    down = np.isfinite(position)
    seen = position[down.argmax()] if down.any() else 0.0
    return FingerPath(time, np.where(down, position, seen), load, strength)


def _leak(full: PlateModel, less: PlateModel, bands: Bands, begin: float, window: float) -> Array:
    """Amplitude (m, shape (3, bands)) that the sag under a moving load feigns in each band, in the worst window."""
    worst = np.zeros((3, len(bands)))
    path = full.path
    apart = np.zeros((1, 3)) if path.constant else sag(full) - sag(less)
    if not apart.any():
        return worst
    late = path.time >= begin
    time, position, apart = path.time[late], path.position[late], apart[late]
    size = max(2, round(window / path.step))
    phase, frequency = bands.carrier_phase(time, position), abs(_omega(bands, path)[late]) / (2 * math.pi)
    first = np.arange(0, len(time) - size + 1, max(1, size // HOPS))
    for starts in np.array_split(first, 1 + len(first) * size * len(bands) // CHUNK_VALUES):
        index = starts[:, None] + np.arange(size)
        envelope, inflation, _ = fit(phase[index], apart[index])
        told = (inflation <= LARGEST_INFLATION) & (frequency[index].mean(axis=1) >= LOWEST_FREQUENCY * (1 - 1e-6))
        worst = np.maximum(worst, np.where(told[:, None, :], abs(envelope), 0.0).max(axis=0, initial=0.0))
    return worst


def _still(scene: Scene) -> Scene | str | None:
    """Rest the finger in the middle of its path."""
    finger = scene.finger
    if isinstance(finger.motion, Nowhere | Still):
        return None
    if _bands(scene)[0].wavenumber.any():
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
    bands = _bands(scene)[0]
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


def _heave_only(scene: Scene) -> Scene | None:
    """Lock the rocking."""
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
