"""How far a lesser model of the plate strays from the fuller one, without playing either at its own rate.

A model is driven by generalised forces ``f e^{j phi(t)}`` with phi' = w(t) and
answers with an envelope zeta(t) of its states (displacements and their rates)::

    zeta' = (A(p) - j w) zeta + B f          p: the finger's position

Its quasi-static answer zeta_s(t) = (j w - A)^-1 B f is closed form (the dynamic
stiffness at every position); what is left, delta = zeta - zeta_s, obeys
delta' = (A - j w) delta - zeta_s' and is followed in steps much longer than a
sample, with the exact exponential of A - j w.  The finger's static load is one
more such drive, with w = 0.

The drive compared is the one with which the lesser model reaches its target: a
loop that is closed round the lesser model ends there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from hapticrender.compiled.jit import kernel
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.touch.mechanics import FingerMechanics

PLACE_STEP, GRIP_STEP = 0.1e-3, 0.01  # m, 1: resolution at which A is tabled; zeta_s knows the finger exactly
IMAGES, IMAGES_SEEN = 3, 500  # of the hold on either side; places along the path at which they are looked at
SERIES = 13  # terms of the exponential of a matrix of norm 1/2 or less: what is left out is below rounding


class FingerPath(NamedTuple):
    """The finger at equally spaced times: seconds, m, N, and the factor on its impedance (all of shape (n,))."""

    time: Array
    position: Array
    load: Array
    strength: Array

    @property
    def step(self) -> float:
        """Time between two entries (s)."""
        return float(self.time[1] - self.time[0])

    @property
    def constant(self) -> bool:
        """Whether nothing changes along it."""
        return not any(np.ptp(column) for column in (self.position, self.load, self.strength))


@kernel
def follow_run(half, index, turn, settled, out):
    """Envelope of the states, (n, s): quasi-static answer plus what its change and `out[0]` at first leave behind."""
    many = settled.shape[1]
    left, moved = out[0], out[1]
    for n in range(settled.shape[0]):
        for part in range(2 if n > 0 else 0):  # Simpson's rule over the step
            share = (1 + 3 * part) / 6
            for i in range(many):
                left[i] -= share * (settled[n, i] - settled[n - 1, i])
            for i in range(many):
                total = 0j
                for j in range(many):
                    total += half[index[n - 1], i, j] * left[j]
                moved[i] = turn[n - 1] * total
            for i in range(many):
                left[i] = moved[i]
        if n > 0:
            for i in range(many):
                left[i] -= (settled[n, i] - settled[n - 1, i]) / 6
        for i in range(many):
            out[2 + n, i] = settled[n, i] + left[i]


@dataclass(frozen=True)
class PlateModel:
    """A plate at some level of modelling with a finger of some mechanics on some path.

    Parameters
    ----------
    parameters : PlateParameters
        The plate and its level.
    mechanics : FingerMechanics
        Of the finger.
    path : FingerPath
        Where it is.
    gradient : float, 1/m
        By which the wanted amplitude grows along the plate.
    from_rest : bool
        Whether the plate is at rest when the path begins; else it has long been driven as at its first entry.
    """

    parameters: PlateParameters
    mechanics: FingerMechanics
    path: FingerPath
    gradient: float = 0.0
    from_rest: bool = False

    @property
    def order(self) -> int:
        """Order of the finger's mechanics, 0 where only its load acts."""
        return self.mechanics.order if self.parameters.finger_dynamics else 0

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array]:
        """M, C, K in heave, rocking (unless locked) and bending (unless rigid)."""
        plate = self.parameters
        keep = slice(0, plate.degrees_of_freedom)
        omega, own = 2 * math.pi * plate.bending_frequency, plate.bending_mass
        bending = (own, 2 * plate.bending_damping * omega * own, omega**2 * own)
        rigid = (plate.mass_matrix, plate.damping_matrix, plate.stiffness_matrix)
        parts = [matrix[keep, keep] for matrix in rigid]
        if omega:
            parts = [block_diag(part, value) for part, value in zip(parts, bending, strict=True)]
        return parts[0], parts[1], parts[2]

    def contact(self, position: Array) -> Array:
        """What a displacement of each coordinate is at the finger, shape (n, coordinates)."""
        plate = self.parameters
        columns = [np.ones_like(position)]
        if plate.degrees_of_freedom == 2:
            columns.append(position / plate.half_spacing)
        if plate.bending_frequency:
            columns.append(plate.bending_shape(position))
        return np.stack(columns, axis=-1)

    @cached_property
    def places(self) -> Array:
        """Motion of centre, end 1 and end 2 from the coordinates, shape (3, coordinates)."""
        plate = self.parameters
        reach = plate.glass_length / plate.coil_spacing
        rows = np.array([[1.0, 0.0], [1.0, -reach], [1.0, reach]])[:, : plate.degrees_of_freedom]
        bend = np.array([[float(plate.bending_shape(0.0))], [1.0], [1.0]])
        return np.hstack([rows, bend]) if plate.bending_frequency else rows

    def pushed(self, force: Array) -> Array:
        """Generalised forces on the coordinates by the coils' common and opposed force `force` (N, shape (n, 2))."""
        plate = self.parameters
        columns = [force[:, : plate.degrees_of_freedom]]
        if plate.bending_frequency:
            columns.append(plate.bending_coil * force[:, :1])
        return np.hstack(columns)

    def finger(self, s: Array) -> tuple[Array, Array]:
        """Stiffness s Z_f (N/m) of the finger at `s` (1/s), and the phalanx's displacement per surface's."""
        own = self.mechanics
        if not self.order:
            return np.zeros_like(s), np.zeros_like(s)
        tissue = own.damping * s + own.stiffness
        if self.order == 2:
            return own.mass * s**2 + tissue, np.zeros_like(s)
        phalanx = own.phalanx_mass * s**2 + own.phalanx_damping * s + own.phalanx_stiffness
        whole = tissue + phalanx
        share = np.where(whole == 0.0, 1.0, tissue / np.where(whole == 0.0, 1.0, whole))
        return own.mass * s**2 + phalanx * share, share

    def wanted_force(self, omega: Array) -> Array:
        """Common and opposed force (N/m, shape (n, 2)) that makes the target at `omega`, were the plate rigid.

        The target is a heave of 1 m, and a rocking where the amplitude is to grow along the plate.  One coil makes the
        heave alone, and lets the plate rock as it will.
        """
        s, plate = 1j * omega, self.parameters
        many, lever = plate.degrees_of_freedom, self.path.position / plate.half_spacing
        contact = np.stack([np.ones_like(lever), lever], axis=1)[:, :many]
        grip = self.path.strength * self.finger(s)[0]
        stiffness: Array = grip[:, None, None] * contact[:, :, None] * contact[:, None, :]
        for matrix, power in zip(self.matrices, (s**2, s, np.ones_like(s)), strict=True):
            stiffness = stiffness + power[:, None, None] * matrix[:many, :many]
        force = np.zeros((len(s), 2), complex)
        if plate.coils == 2:
            force[:, :many] = stiffness @ np.array([1.0, self.gradient * plate.half_spacing])[:many]
        else:
            force[:, 0] = stiffness[:, 0, 0]
            force[:, 0] -= stiffness[:, 0, 1] ** 2 / stiffness[:, 1, 1] if many == 2 else 0.0
        return force

    def quasi_static(self, omega: Array, force: Array) -> Array:
        """States zeta_s (n, s) under `force` (N, shape (n, coordinates)), as if nothing changed with time.

        Sherman and Morrison: D = D_0 + g h h^T with the plate's own D_0, the finger's g = s Z_f at h.
        """
        mass, damping, stiffness = self.matrices
        s = 1j * np.atleast_1d(omega)
        grip, share = (column * np.ones(len(force)) for column in self.finger(s))
        grip = grip * self.path.strength
        h = self.contact(self.path.position)
        s = np.broadcast_to(s, len(force))
        same = not np.ptp(omega)
        at = s[:1, None, None] if same else s[:, None, None]
        free = np.linalg.inv(mass * at**2 + damping * at + stiffness)
        moved, yields = ((free @ column[:, :, None])[:, :, 0] for column in (force, h))
        felt = (h * moved).sum(axis=1) / (1.0 + grip * (h * yields).sum(axis=1))
        moved = moved - yields * (grip * felt)[:, None]
        if self.order == 4:
            moved = np.hstack([moved, (share * felt)[:, None]])
        return np.hstack([moved, s[:, None] * moved])

    def propagators(self) -> tuple[Array, Array]:
        """Exponential of half a step of A at each tabled grip and place (m, s, s), and the entry for each step."""
        middle = (self.path.position[1:] + self.path.position[:-1]) / 2
        grip = (self.path.strength[1:] + self.path.strength[:-1]) / 2
        tabled = np.stack([np.rint(middle / PLACE_STEP), np.rint(grip / GRIP_STEP)], axis=1)
        keys, index = np.unique(tabled, axis=0, return_inverse=True)
        system = self._system(keys[:, 0] * PLACE_STEP, keys[:, 1] * GRIP_STEP)
        return _exponential(system * (self.path.step / 2)), index.ravel()

    def _system(self, position: Array, strength: Array) -> Array:
        """A (m, s, s) for a finger at each of `position` (m) of `strength`."""
        own, h = self.mechanics, self.contact(position)
        surface = strength[:, None, None] * h[:, :, None] * h[:, None, :]
        held = [own.mass, own.damping, own.stiffness] if self.order else [0.0, 0.0, 0.0]
        mass, damping, stiffness = (a + b * surface for a, b in zip(self.matrices, held, strict=True))
        if self.order == 4:
            behind = (own.phalanx_mass, own.damping + own.phalanx_damping, own.stiffness + own.phalanx_stiffness)
            links = (0.0, own.damping, own.stiffness)
            mass, damping, stiffness = (
                _bordered(part, -link * strength[:, None] * h, -link * h, corner)
                for part, link, corner in zip((mass, damping, stiffness), links, behind, strict=True)
            )
        many = mass.shape[1]
        system = np.zeros((len(h), 2 * many, 2 * many))
        system[:, :many, many:] = np.eye(many)
        system[:, many:, :many] = -np.linalg.solve(mass, stiffness)
        system[:, many:, many:] = -np.linalg.solve(mass, damping)
        return system

    def answer(self, omega: Array, force: Array) -> Array:
        """Envelopes at centre and ends (m, shape (n, 3)) under `force` (N, coordinates); `omega` in rad/s, (n,)."""
        settled = self.quasi_static(omega, force)
        constant = not (np.ptp(settled.real, axis=0).any() or np.ptp(settled.imag, axis=0).any())
        if constant and not self.from_rest:
            return self.moved(settled)
        half, index = self._table
        turn = np.exp(-0.25j * self.path.step * (omega[1:] + omega[:-1]))
        out = np.zeros((len(settled) + 2, settled.shape[1]), complex)
        out[0] = -settled[0] if self.from_rest else 0.0
        follow_run(half, index, turn, settled, out)
        return self.moved(out[2:])

    def moved(self, states: Array) -> Array:
        """Displacement (m, shape (n, 3)) of centre and ends in `states` (n, s)."""
        return states[:, : self.places.shape[1]] @ self.places.T

    def _at(self, few: Array) -> PlateModel:
        """The model at some of the times of its path."""
        return replace(self, path=FingerPath(*(column[few] for column in self.path)))

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        return self.propagators()


def _bordered(matrix: Array, column: Array, row: Array, corner: float) -> Array:
    """`matrix` (m, c, c) with one more column, row and corner."""
    many = matrix.shape[1]
    out = np.empty((len(column), many + 1, many + 1))
    out[:, :many, :many], out[:, :many, many], out[:, many, :many], out[:, many, many] = matrix, column, row, corner
    return out


def _exponential(matrix: Array) -> Array:
    """e^matrix of each of shape (m, s, s), by squaring a Taylor series."""
    norm = float(abs(matrix).sum(axis=2).max())
    doublings = max(0, math.ceil(math.log2(max(norm, 1e-300))) + 1)
    small = matrix / 2.0**doublings
    total = np.broadcast_to(np.eye(matrix.shape[1]), matrix.shape)
    for n in range(SERIES, 0, -1):
        total = np.eye(matrix.shape[1]) + small @ total / n
    for _ in range(doublings):
        total = total @ total
    return total


def stray(full: PlateModel, lesser: PlateModel, omega: Array, weight: Array) -> Array:
    """How far two models part at centre and ends (n, 3), per metre of target, under the lesser one's own drive.

    Parameters
    ----------
    full, lesser : PlateModel
        Both with paths of the same times.
    omega : ndarray, shape (n,), rad/s
        Angular frequency of the carrier along the path; its sign follows the finger.
    weight : ndarray, shape (n,)
        Share of the target that is asked for.
    """
    drive = lesser.wanted_force(omega) * weight[:, None]
    return full.answer(omega, full.pushed(drive)) - lesser.answer(omega, lesser.pushed(drive))


def held(full: PlateModel, lesser: PlateModel, omega: Array, weight: Array) -> Array:
    """How far two models part (n, 3) besides, per metre of target, for the drive's being held over each sample.

    The hold's images at w + n w_s, n = +-1, +-2, ..., carry w/(w + n w_s) of the drive each, and sampling folds them
    back on w.  The plate's mass lets them through with 1/n^2, and those of either sign nearly cancel.
    """
    some = np.unique(np.linspace(0, len(omega) - 1, min(len(omega), IMAGES_SEEN)).astype(int))
    rate, both = 2 * math.pi * full.parameters.rate, (full._at(some), lesser._at(some))
    drive = both[1].wanted_force(omega[some]) * weight[some, None]
    apart = np.zeros((len(some), 3), complex)
    for n in range(1, IMAGES + 1):
        for image in (omega[some] - n * rate, omega[some] + n * rate):
            moved = [model.moved(model.quasi_static(image, model.pushed(drive))) for model in both]
            apart += (moved[0] - moved[1]) * (omega[some] / image)[:, None]
    place = np.arange(len(omega))
    return np.stack([np.interp(place, some, column) for column in apart.T], axis=1)


def sag(model: PlateModel) -> Array:
    """Motion of centre and ends (m, shape (n, 3)) under the finger's load alone, which moves with it."""
    weight = -model.path.load[:, None] * model.contact(model.path.position)
    return model.answer(np.zeros(len(weight)), weight + 0j).real


def forgetting_time(*models: PlateModel) -> float:
    """Longest time constant (s) of the models, at either end of the path and between."""
    slowest = math.inf
    for model in models:
        position, strength = model.path.position, model.path.strength
        ends = np.array([position.min(), (position.min() + position.max()) / 2, position.max()])
        system = model._system(ends, np.full(3, strength.mean()))
        slowest = min(slowest, float(-np.linalg.eigvals(system).real.max()))
    return 1.0 / slowest if slowest > 0.0 else math.inf
