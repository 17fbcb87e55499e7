"""Choose the least model of a device whose difference from the full model stays inside a tolerance.

Each level of a model is a linear model at the scene's carriers, loads and finger positions. Two neighbouring levels are
compared under the same drive, the one with which the lesser level reaches its target; the predicted difference is the
largest difference of their envelopes, over bands, places and path, relative to the band's target. Nothing is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from hapticrender.bands import Bands
from hapticrender.defaults import LOWEST_FREQUENCY
from hapticrender.plants.electroadhesion import ElectroadhesionParameters
from hapticrender.plants.plate import PlateParameters
from hapticrender.plants.surface import SurfaceParameters
from hapticrender.protocols import Array
from hapticrender.touch.finger import Finger
from hapticrender.touch.mechanics import FingerMechanics
from hapticrender.touch.motion import Nowhere, Still
from hapticrender.touch.scene import Scene, Value

SHARE = 0.1  # of the scene's tolerance; the rest is the controller's
MARGIN = 1.35  # on the quasi-static difference: transients of a load or a position that changes at once
NEAREST = 20.0  # Hz: carriers closer than this exchange sidebands under a moving finger, and are not predicted
FOLLOWED = 60.0  # s of a scene whose path is looked at
STEADY = 0.02  # share by which a carrier may change; one that sweeps does not settle, and is not predicted
LEAK = 0.2  # share of a change of the finger's sag that may come into a carrier's window; beyond, nothing is predicted
POINTS = 600  # along the path
FIT_FREQUENCIES = 50  # at which a finger of lower order is fitted, at most


@dataclass(frozen=True)
class Level:
    """One simplification: what is left out, whether it is taken, and the predicted difference (1) or why there is none.

    Parameters
    ----------
    name : str
        Of the lesser level, such as "finger of 2nd order".
    taken : bool
    difference : float
        Predicted relative difference from the full model, with everything taken before; infinite where not predicted.
    reason : str
        Why no difference is predicted.
    """

    name: str
    taken: bool
    difference: float
    reason: str = ""

    def __str__(self) -> str:
        verdict = "taken" if self.taken else "not taken"
        return f"{self.name}: {verdict}, {self.reason or f'predicted difference {100 * self.difference:.2g} %'}"


@dataclass(frozen=True)
class LeastModel:
    """The least model of a scene.

    Parameters
    ----------
    scene : Scene
        The scene with the least model.
    levels : tuple of Level
        Every simplification that was tried, in order.
    tolerance : float
        Largest allowed difference (1).
    """

    scene: Scene
    levels: tuple[Level, ...]
    tolerance: float

    @property
    def difference(self) -> float:
        """Predicted relative difference (1) of the least model from the full one; 0 where they are the same."""
        return max((level.difference for level in self.levels if level.taken), default=0.0)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the levels taken."""
        return tuple(level.name for level in self.levels if level.taken)

    @property
    def text(self) -> str:
        """One line for every level tried."""
        lines = [str(level) for level in self.levels] or ["the device has one level only"]
        return "\n  ".join([f"least model within {100 * self.tolerance:.2g} %:", *lines])


def least_model(scene: Scene, tolerance: float | None = None) -> LeastModel:
    """Choose the least model of a scene's device that differs from the full one by at most a tolerance.

    Parameters
    ----------
    scene : Scene
        The scene with the full model.
    tolerance : float, optional
        Largest relative difference, > 0 and <= 10; a tenth of the scene's tolerance by default.

    Returns
    -------
    LeastModel

    Raises
    ------
    ValueError
        For a tolerance outside its bounds.

    Examples
    --------
    >>> from hapticrender.touch.builtin import builtin_scenes
    >>> least_model(builtin_scenes()["grating-20"]).left_out
    ()
    """
    allowed = SHARE * scene.tolerance if tolerance is None else float(tolerance)
    if not 0.0 < allowed <= 10.0:
        raise ValueError(f"{tolerance=}: must be > 0 and <= 10")
    least, levels = scene, list[Level]()
    for name, reduce in REDUCTIONS.get(scene.device, {}).items():
        lesser = reduce(least)
        if lesser is None:
            continue
        if isinstance(lesser, str):
            levels.append(Level(name, False, math.inf, lesser))
            continue
        found = difference(scene, lesser)
        levels.append(Level(name, found <= allowed, found))
        least = lesser if found <= allowed else least
    return LeastModel(least, tuple(levels), allowed)


def difference(scene: Scene, lesser: Scene) -> float:
    """Predict the largest relative difference (1) of the envelopes of two levels under the lesser level's drive.

    Notes
    -----
    With D the dynamic stiffness of the lesser level in heave and rocking, force F = D r reaches the target r; the
    motions are W_i (K_i + j w C_i - w^2 M_i)^-1 P_i F for both levels i, with their own input and output matrices P, W.
    """
    if scene.device != "vt-plate":
        return _CARRIERS[scene.device](scene)
    plate, bands = _plate(lesser), lesser.texture.bands(_rate(scene))
    if bands.envelope is None:
        return math.inf
    position, load, frequency = _path(scene, bands)
    spacing = np.diff(np.sort(frequency[0])).min(initial=math.inf)
    if spacing < NEAREST and np.ptp(position) > 0.0 or frequency.max(initial=0.0) > plate.rate / 2:
        return math.inf
    if (np.ptp(frequency, axis=0) > STEADY * frequency.max(axis=0, initial=0.0)).any():
        return math.inf
    target = np.array([1.0, scene.gradient * plate.half_spacing])
    mechanics = _mechanics(lesser)
    worst = 0.0
    wanted = np.abs(bands.envelope)
    share = np.maximum(wanted, scene.tolerance * wanted.max(initial=0.0))
    place = plate.glass_length / 2 * np.array([0.0, -1.0, 1.0])
    grown = np.abs(1.0 + scene.gradient * place)
    for k in np.flatnonzero(wanted):
        w = 2 * np.pi * frequency[:, k]
        judged = w >= 2 * np.pi * LOWEST_FREQUENCY * 0.999
        if not judged.any():
            continue
        w, at, pressed = w[judged], position[judged], load[judged]
        lever = _lever(plate, at)
        stiffness = plate.dynamic_stiffness(w / (2 * np.pi))
        if mechanics.order:
            impedance = 1j * w * mechanics.impedance(w / (2 * np.pi)) * _strength(lesser, pressed)
            stiffness = stiffness + impedance[:, None, None] * lever[:, :, None] * lever[:, None, :]
        force = stiffness @ target
        if plate.degrees_of_freedom == 1 or plate.coils == 1:
            force = np.stack([_heave_force(stiffness, plate), np.zeros(len(w))], axis=1)
        apart = _motion(scene, w, at, pressed, force) - _motion(lesser, w, at, pressed, force)
        worst = max(worst, float((np.abs(apart) / grown).max()) * wanted[k] / share[k])
    sag = [_motion(each, np.full(len(load), 1e-3), position, load, -load[:, None] * _lever(plate, position)) for each in
           (scene, lesser)]  # fmt: skip
    leak = LEAK * float(np.ptp((sag[0] - sag[1]).real, axis=0).max()) / share.max()
    return MARGIN * worst if leak <= worst else math.inf


def _lever(plate: PlateParameters, position: Array) -> Array:
    """Share (n, 2) of a force at `position` (m) that acts on heave and on rocking."""
    return np.stack([np.ones_like(position), position / plate.half_spacing], axis=1)


def _heave_force(stiffness: Array, plate: PlateParameters) -> Array:
    """Force (N/m) on heave alone that moves heave by 1."""
    return stiffness[:, 0, 0] if plate.degrees_of_freedom == 1 else 1.0 / np.linalg.inv(stiffness)[:, 0, 0]


def _motion(scene: Scene, w: Array, position: Array, load: Array, force: Array) -> Array:
    """Motion (n, 3) of centre and ends under forces (n, 2) on heave and rocking, by the level of a scene."""
    plate, mechanics = _plate(scene), _mechanics(scene)
    place = plate.glass_length / 2 * np.array([0.0, -1.0, 1.0])
    lever, watch = _lever(plate, position), _lever(plate, place)
    dynamic, push = plate.dynamic_stiffness(w / (2 * np.pi)), np.eye(2)
    if plate.degrees_of_freedom == 1:
        dynamic, lever, watch, push = dynamic[:, :1, :1], lever[:, :1], watch[:, :1], push[:1]
    if plate.bending_frequency:
        mode = 2 * np.pi * plate.bending_frequency
        modal = plate.bending_mass * (mode**2 - w**2 + 2j * plate.bending_damping * mode * w)
        dynamic = np.pad(dynamic, ((0, 0), (0, 1), (0, 1)))
        dynamic[:, -1, -1] = modal
        lever = np.column_stack([lever, plate.bending_shape(position)])
        watch = np.column_stack([watch, plate.bending_shape(place)])
        push = np.vstack([push, [plate.bending_coil, 0.0]])
    if mechanics.order:
        impedance = 1j * w * mechanics.impedance(w / (2 * np.pi)) * _strength(scene, load)
        dynamic = dynamic + impedance[:, None, None] * lever[:, :, None] * lever[:, None, :]
    return np.linalg.solve(dynamic, (force @ push.T)[:, :, None])[:, :, 0] @ watch.T


def _mechanics(scene: Scene) -> FingerMechanics:
    """The finger's mechanics at the level of a scene; of order 0 where there are none."""
    absent = isinstance(scene.finger.motion, Nowhere) or not _plate(scene).finger_dynamics
    return FingerMechanics(order=0) if absent else scene.finger.mechanics


def _strength(scene: Scene, load: Array) -> Array:
    """Factor (n,) on the finger's impedance under a load (N)."""
    if not scene.finger.load_scaling:
        return np.where(load > 0.0, 1.0, 0.0)
    return np.where(load > 0.0, scene.finger.mechanics.load_factor(load), 0.0)


def _plate(scene: Scene) -> PlateParameters:
    """The simulated plate of a scene."""
    return PlateParameters.with_overrides({**scene.profile, **scene.simulation})


def _rate(scene: Scene) -> float:
    return _plate(scene).rate


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
    if not isinstance(scene.finger.motion, Still) or scene.texture.bands(_rate(scene)).wavenumber.any():
        return "the finger moves: its load moves the plate, or the texture follows it"
    if scene.finger.touches is not None:
        return "the finger comes or goes: its load moves the plate"
    return replace(scene, finger=Finger.absent())


def _static_finger(scene: Scene) -> Scene | None:
    """Keep only the load of the finger."""
    return _changed(scene, finger_dynamics=0) if _mechanics(scene).order else None


def _second_order(scene: Scene) -> Scene | str | None:
    """Replace a finger of 4th order by the nearest one of 2nd order at the scene's carriers."""
    mechanics = _mechanics(scene)
    if mechanics.order != 4:
        return None
    frequency = np.unique(_path(scene, scene.texture.bands(_rate(scene)))[2].round(3))
    frequency = frequency[frequency >= LOWEST_FREQUENCY * 0.999]
    if not frequency.size:
        return "no carrier is fast enough to be judged"
    frequency = frequency[np.unique(np.linspace(0, frequency.size - 1, FIT_FREQUENCIES).astype(int))]
    impedance, w = mechanics.impedance(frequency), 2 * np.pi * frequency
    rows = np.stack([1j * w, np.ones_like(w), -1j / w], axis=1) / impedance[:, None]
    mass, damping, stiffness = nnls(np.vstack([rows.real, rows.imag]), np.repeat([1.0, 0.0], len(w)))[0]
    if not mass + damping + stiffness > 0.0:
        return "no finger of 2nd order comes near it"
    fitted = replace(
        FingerMechanics(order=2, mass=mass, damping=damping, stiffness=stiffness),
        reference_load=mechanics.reference_load,
    )
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


def _rigid_glass(scene: Scene) -> Scene | None:
    """Leave out the bending mode."""
    return _changed(scene, bending_frequency=0.0) if _plate(scene).bending_frequency else None


def _envelope(scene: Scene) -> Scene | str | None:
    """Leave out the carrier of a friction device."""
    default = (ElectroadhesionParameters if scene.device == "electroadhesion" else SurfaceParameters).level
    if {**scene.profile, **scene.simulation}.get("level", default) == "envelope":
        return None
    if {**scene.profile, **scene.simulation}.get("sensor") == "impedance":
        return "the sensor measures the gap's impedance at the carrier"
    return _changed(scene, level="envelope")


def _screen_difference(scene: Scene) -> float:
    """Attraction of the carrier level over that of the envelope level, less one, at the scene's modulation frequencies.

    A step of the current's envelope leaves a charge p on the gap, which decays with tau = R C. With modulation i at w,
    p = Re(Q) j w tau/(1 + j w tau) i over I; the carrier level adds 2 I <Re(Q e^(j w_c t)) e^(-t/tau)> p to the
    attraction I^2 |Q|^2/2, Q = 1/(j w_c + 1/tau); a direct current i_dc adds 2 i_dc tau <e^(-t/tau)> p.
    """
    p = ElectroadhesionParameters.with_overrides({**scene.profile, **scene.simulation})
    bands = scene.texture.bands(p.rate)
    _, _, frequency = _path(scene, bands)
    tau = max(p.gap_resistance * _VACUUM / p.gap_thickness, 1e-12)
    charge = 1 / (1j * p.omega + 1 / tau)
    time = np.arange(1, p.oversampling + 1) / (p.rate * p.oversampling)
    decay = np.exp(-time / tau)
    w = 2 * np.pi * frequency.max(initial=0.0)
    step = abs(charge.real) * w / p.rate / abs(1 - decay[-1] * np.exp(-1j * w / p.rate))
    swing = abs(np.mean((charge * np.exp(1j * p.omega * time)).real * decay))
    direct = abs(p.current_offset) * tau * np.mean(decay) / p.current_limit
    return MARGIN * float(step * 2 * (swing + direct) / abs(charge) ** 2)


def _surface_difference(scene: Scene) -> float:
    """Response of the mode at its carrier over that of the transposed mode, at the scene's modulation frequencies.

    Adds the phase over the difference of the two amplitude loops' delays, which a loop of longer samples has.
    """
    p = SurfaceParameters.with_overrides({**scene.profile, **scene.simulation})
    carrier, envelope = (replace(p, level=level).carrier_mode for level in ("carrier", "envelope"))
    _, load, frequency = _path(scene, scene.texture.bands(p.rate))
    offset = np.unique(frequency[frequency > 0.0].round(1))
    if not offset.size:
        return 0.0
    late = abs((envelope.delay + 0.5) / envelope.rate - (carrier.delay + 0.5) / carrier.rate)
    moved = max(
        float(np.abs(carrier.envelope_error(sign * offset, each)).max())
        for sign in (-1, 1) for each in np.unique([load.min(), load.max()])
    )  # fmt: skip
    return MARGIN * (moved + 2 * np.pi * float(offset.max()) * late)


_VACUUM = 8.8541878128e-12  # F/m
_CARRIERS: Mapping[str, Callable[[Scene], float]] = {
    "electroadhesion": _screen_difference,
    "ultrasonic": _surface_difference,
}
REDUCTIONS: Mapping[str, Mapping[str, Callable[[Scene], Scene | str | None]]] = {
    "vt-plate": {
        "no finger": _no_finger,
        "finger's load only": _static_finger,
        "finger of 2nd order": _second_order,
        "one coordinate (heave)": _one_coordinate,
        "rigid glass": _rigid_glass,
    },
    "electroadhesion": {"envelope of the carrier": _envelope},
    "ultrasonic": {"envelope of the carrier": _envelope},
}
