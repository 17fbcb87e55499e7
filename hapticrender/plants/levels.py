"""Choose the least model of a device whose difference from the full model stays inside a tolerance.

Each level of a model is a linear model at the scene's carriers, loads and finger positions.  A level is compared with
the full model under the same drive, the one with which the lesser level reaches its target: with D the dynamic
stiffness of the lesser level in heave and rocking, the force D r for the target r.  The predicted difference is the
largest of their envelopes, over bands, places and path, relative to the band's target.  Nothing is simulated.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from hapticrender.bands import Bands
from hapticrender.defaults import LOWEST_FREQUENCY
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.gap_estimator import VACUUM
from hapticrender.plants.plate import PlateParameters, structure
from hapticrender.plants.ultrasonic_surface import SurfaceParameters
from hapticrender.protocols import Array
from hapticrender.touch.finger import Finger
from hapticrender.touch.mechanics import NONE, FingerMechanics
from hapticrender.touch.motion import Nowhere, Still
from hapticrender.touch.scene import Scene, Value

SHARE = 0.1  # of the scene's tolerance; the rest is the controller's
MARGIN = 1.35  # on the quasi-static difference: transients of a load or a position that changes at once
NEAREST = 20.0  # Hz: carriers closer than this exchange sidebands under a moving finger, and are not predicted
FOLLOWED = 60.0  # s of a scene whose path is looked at
STEADY = 0.02  # share by which a carrier may change; one that sweeps does not settle, and is not predicted
LEAK = 0.2  # share of a change of the finger's sag that may come into a carrier's window; beyond, nothing is predicted
SLOW = 1e-4  # Hz: at which the sag is computed
POINTS = 600  # along the path
FIT_FREQUENCIES = 50  # at which a finger of lower order is fitted, at most
JUDGED = 0.999 * LOWEST_FREQUENCY  # Hz: slower carriers are not judged

UNPREDICTED = "the difference cannot be predicted: carriers too near, that sweep or pass the rate, or a load that moves"


@dataclass(frozen=True)
class Level:
    """A simplification by name, whether it is taken, and its predicted relative difference (1), or why there is none.

    The difference is that from the full model with everything taken before; infinite where it is not predicted, since
    carriers are near each other, sweep or pass the rate, or a load that moves may leak into them.
    """

    name: str
    taken: bool
    difference: float
    reason: str = ""

    def __str__(self) -> str:
        verdict = "taken" if self.taken else "not taken"
        found = f"predicted difference {100 * self.difference:.2g} %" if self.difference < math.inf else UNPREDICTED
        return f"{self.name}: {verdict}, {self.reason or found}"


@dataclass(frozen=True)
class LeastModel:
    """The scene with the least model, every simplification tried in order, and the largest allowed difference (1)."""

    scene: Scene
    levels: tuple[Level, ...]
    tolerance: float

    @property
    def text(self) -> str:
        """One line for every level tried."""
        lines = [str(level) for level in self.levels] or [f"no lesser level of this {self.scene.device!r} is known"]
        return "\n  ".join([f"least model within {100 * self.tolerance:.2g} %:", *lines])


def least_model(scene: Scene, tolerance: float | None = None) -> LeastModel:
    """Choose the least model of a scene's device that differs from its own, the full one, by at most a tolerance.

    That is relative, > 0 and <= 10; a tenth of the scene's tolerance by default.
    """
    allowed = SHARE * scene.tolerance if tolerance is None else float(tolerance)
    if not 0.0 < allowed <= 10.0:
        raise ValueError(f"{tolerance=}: must be > 0 and <= 10")
    least, levels = scene, list[Level]()
    for name, reduce in REDUCTIONS.get(scene.device, {}).items():
        lesser = reduce(least)
        if isinstance(lesser, str):
            levels.append(Level(name, False, math.inf, lesser))
        elif lesser is not None:
            found = difference(scene, lesser)
            levels.append(Level(name, found <= allowed, found))
            least = lesser if found <= allowed else least
    return LeastModel(least, tuple(levels), allowed)


def difference(scene: Scene, lesser: Scene) -> float:
    """Predict the largest relative difference (1) of the envelopes of two levels; infinite where not quasi-static."""
    predict = {"electroadhesion": _screen_difference, "ultrasonic": _surface_difference}.get(scene.device)
    return MARGIN * (_plate_difference(scene, lesser) if predict is None else predict(scene))


def _plate_difference(scene: Scene, lesser: Scene) -> float:
    """Largest difference (1) of the plate's envelopes, quasi-static; infinite where they are not."""
    plate = _plate(lesser)
    bands = lesser.texture.bands(plate.rate)
    position, load, frequency = _path(scene, bands)
    near = np.diff(np.sort(frequency[0])).min(initial=math.inf) < NEAREST and np.ptp(position) > 0.0
    sweeps = (np.ptp(frequency, axis=0) > STEADY * frequency.max(axis=0, initial=0.0)).any()
    if bands.envelope is None or near or sweeps or frequency.max(initial=0.0) > plate.rate / 2:
        return math.inf
    target = np.array([1.0, scene.gradient * plate.half_spacing])
    grown = np.abs(1.0 + scene.gradient * np.array([0.0, *plate.ends]))
    amplitude = np.abs(bands.envelope)
    share = np.maximum(amplitude, scene.tolerance * amplitude.max(initial=0.0))
    worst = 0.0
    for k in np.flatnonzero(amplitude):
        judged = frequency[:, k] >= JUDGED
        if judged.any():
            path = frequency[judged, k], position[judged], load[judged]
            stiffness = plate.dynamic_stiffness(path[0], _impedance(lesser, path[0], path[2]), path[1])
            force = stiffness @ target
            if plate.degrees_of_freedom == 1 or plate.coils == 1:  # on heave alone; one coil leaves rocking free
                alone = stiffness if plate.degrees_of_freedom == 1 else 1.0 / np.linalg.inv(stiffness)
                force = alone[:, 0, :1] * [1.0, 0.0]
            apart = _motion(scene, *path, force) - _motion(lesser, *path, force)
            worst = max(worst, float((np.abs(apart) / grown).max()) * amplitude[k] / share[k])
    pressed = -load[:, None] * plate.displacement(position)[:, :2]
    full, less = (_motion(each, np.full(POINTS, SLOW), position, load, pressed) for each in (scene, lesser))
    leak = LEAK * float(np.ptp((full - less).real, axis=0).max()) / share.max()
    return worst if leak <= worst else math.inf


def _motion(scene: Scene, frequency: Array, position: Array, load: Array, force: Array) -> Array:
    """Motion (n, 3) of centre and ends under forces (n, 2) on heave and rocking, by the level of a scene."""
    plate = _plate(scene)
    body, s = structure(plate), 2j * np.pi * frequency[:, None, None]
    lever = plate.displacement(position)[:, [True, plate.degrees_of_freedom == 2, plate.bending_frequency > 0.0]]
    finger = s * _impedance(scene, frequency, load)[:, None, None] * lever[:, :, None] * lever[:, None, :]
    inputs = body.inputs[:, :-1] @ np.linalg.pinv(plate.force_from_drive)
    stiffness = body.mass * s**2 + body.damping * s + body.stiffness + finger
    return np.linalg.solve(stiffness, (force @ inputs.T)[:, :, None])[:, :, 0] @ body.outputs[:3].T


def _impedance(scene: Scene, frequency: Array, load: Array) -> Array:
    """Impedance (N s/m, shape (n,)) of the finger under a load (N), by the level of a scene."""
    factor = scene.finger.mechanics.load_factor(load) if scene.finger.load_scaling else 1.0
    return np.where(load > 0.0, factor, 0.0) * _mechanics(scene).impedance(frequency)


def _mechanics(scene: Scene) -> FingerMechanics:
    """The finger's mechanics at the level of a scene; of order 0 where there are none."""
    absent = isinstance(scene.finger.motion, Nowhere) or not _plate(scene).finger_dynamics
    return NONE if absent else scene.finger.mechanics


def _numbers(scene: Scene) -> dict[str, Value]:
    """Numbers of the simulated device that differ from the defaults."""
    return {**scene.profile, **scene.simulation}


def _plate(scene: Scene) -> PlateParameters:
    """The simulated plate of a scene."""
    return PlateParameters.with_overrides(_numbers(scene))


def _path(scene: Scene, bands: Bands) -> tuple[Array, Array, Array]:
    """Position (m) and load (N) of the finger (n,), and carrier frequencies (Hz, (n, bands)), over the judged time."""
    begin = scene.settle if scene.duration >= 2 * scene.settle else scene.duration / 2
    time = np.linspace(begin, min(scene.duration, begin + FOLLOWED), POINTS)
    position, load, _ = scene.finger.touch(time).T
    step = 1e-4
    with np.errstate(invalid="ignore"):
        velocity = np.nan_to_num((scene.finger.position(time + step) - scene.finger.position(time)) / step)
    down = np.isfinite(position)
    frequency = np.abs(bands.instantaneous_frequency(velocity))
    return np.where(down, position, 0.0), np.where(down, load, 0.0), frequency


def _changed(scene: Scene, **plant: Value) -> Scene:
    """The scene with other numbers of the simulated device."""
    return replace(scene, simulation={**scene.simulation, **plant})


def _no_finger(scene: Scene) -> Scene | str | None:
    """Remove a finger that rests on the plate and whose position no band follows."""
    if isinstance(scene.finger.motion, Nowhere):
        return None
    if not isinstance(scene.finger.motion, Still) or scene.texture.bands(_plate(scene).rate).wavenumber.any():
        return "the finger moves: its load moves the plate, or the texture follows it"
    if scene.finger.touches is not None:
        return "the finger comes or goes: its load moves the plate"
    return replace(scene, finger=Finger.absent())


def _second_order(scene: Scene) -> Scene | str | None:
    """Replace a finger of 4th order by the nearest one of 2nd order at the scene's carriers."""
    mechanics = _mechanics(scene)
    if mechanics.order != 4:
        return None
    frequency = np.unique(_path(scene, scene.texture.bands(_plate(scene).rate))[2].round(3))
    frequency = frequency[frequency >= JUDGED]
    if not frequency.size:
        return "no carrier is fast enough to be judged"
    frequency = frequency[np.unique(np.linspace(0, frequency.size - 1, FIT_FREQUENCIES).astype(int))]
    impedance, w = mechanics.impedance(frequency), 2 * np.pi * frequency
    rows = np.stack([1j * w, np.ones_like(w), -1j / w], axis=1) / impedance[:, None]
    mass, damping, stiffness = nnls(np.vstack([rows.real, rows.imag]), np.repeat([1.0, 0.0], len(w)))[0]
    if not mass + damping + stiffness > 0.0:
        return "no finger of 2nd order comes near it"
    load = mechanics.reference_load
    fitted = FingerMechanics(order=2, mass=mass, damping=damping, stiffness=stiffness, reference_load=load)
    return replace(scene, finger=replace(scene.finger, mechanics=fitted))


def _one_coordinate(scene: Scene) -> Scene | str | None:
    """Leave out rocking."""
    if _plate(scene).degrees_of_freedom == 1:
        return None
    if scene.gradient:
        return "the amplitude grows along the plate"
    if not isinstance(scene.finger.motion, Nowhere | Still):
        return "the load of a moving finger tilts the plate"
    return _changed(scene, degrees_of_freedom=1)


def _envelope(scene: Scene) -> Scene | str | None:
    """Leave out the carrier of a friction device."""
    kind = ElectroadhesionParameters if scene.device == "electroadhesion" else SurfaceParameters
    device = kind.with_overrides(_numbers(scene))
    if device.level == "envelope":
        return None
    if device.sensor == "impedance":
        return "the sensor measures the gap's impedance at the carrier"
    if not len(scene.texture.bands(device.rate)):
        return "the texture has no carriers at which it could be predicted"
    return _changed(scene, level="envelope")


def _screen_difference(scene: Scene) -> float:
    """Attraction of the carrier level over that of the envelope level, less one, at the scene's modulation frequencies.

    A step of the current's envelope leaves a charge p on the gap, which decays with tau = R C. With modulation i at w,
    p = Re(Q) j w tau/(1 + j w tau) i over I; the carrier level adds 2 I <Re(Q e^(j w_c t)) e^(-t/tau)> p to the
    attraction I^2 |Q|^2/2, Q = 1/(j w_c + 1/tau).
    """
    p = ElectroadhesionParameters.with_overrides(_numbers(scene))
    w = 2 * np.pi * _path(scene, scene.texture.bands(p.rate))[2].max(initial=0.0)
    tau = max(p.gap_resistance * VACUUM / p.gap_thickness, 1e-12)
    charge = 1 / (1j * p.omega + 1 / tau)
    time = np.arange(1, p.oversampling + 1) / (p.rate * p.oversampling)
    decay = np.exp(-time / tau)
    step = abs(charge.real) * w / p.rate / abs(1 - decay[-1] * np.exp(-1j * w / p.rate))
    swing = abs(np.mean((charge * np.exp(1j * p.omega * time)).real * decay))
    return float(step * 2 * swing / abs(charge) ** 2)


def _surface_difference(scene: Scene) -> float:
    """Response of the mode at its carrier over that of the transposed mode, at the scene's modulation frequencies.

    Adds the phase over the difference of the two amplitude loops' delays, which a loop of longer samples has.
    """
    p = SurfaceParameters.with_overrides(_numbers(scene))
    carrier, envelope = (replace(p, level=level).carrier_mode for level in ("carrier", "envelope"))
    _, load, frequency = _path(scene, scene.texture.bands(p.rate))
    offset = np.unique(frequency.round(1))
    late = abs((envelope.delay + 0.5) / envelope.rate - (carrier.delay + 0.5) / carrier.rate)
    both = np.concatenate([-offset, offset])
    moved = max(float(np.abs(carrier.envelope_error(both, each)).max(initial=0.0)) for each in (load.min(), load.max()))
    return moved + 2 * np.pi * float(offset.max(initial=0.0)) * late


REDUCTIONS: Mapping[str, Mapping[str, Callable[[Scene], Scene | str | None]]] = {
    "vt-plate": {
        "no finger": _no_finger,
        "finger's load only": lambda scene: _changed(scene, finger_dynamics=0) if _mechanics(scene).order else None,
        "finger of 2nd order": _second_order,
        "one coordinate (heave)": _one_coordinate,
        "rigid glass": lambda scene: (
            _changed(scene, bending_frequency=0.0) if _plate(scene).bending_frequency else None
        ),
    },
    "electroadhesion": {"envelope of the carrier": _envelope},
    "ultrasonic": {"envelope of the carrier": _envelope},
}
