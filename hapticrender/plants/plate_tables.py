"""The vibrotactile plate as its compiled kernels take it: numbers from parameters and finger, and state at rest."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticrender.compiled.lanes import aligned
from hapticrender.plants.kernels import PlateState, PlateTables, plate_matrix
from hapticrender.plants.propagator import COLUMNS, NODES, STATES, WIDEST, identity, shifts
from hapticrender.protocols import Array

if TYPE_CHECKING:
    from hapticrender.plants.vibrotactile import PlateParameters
    from hapticrender.touch.finger import Finger
    from hapticrender.touch.mechanics import FingerMechanics

MOST_LOAD = 20.0  # N: hardest that a finger presses
NOMINAL_AMPLIFIER = (1 - 2e3 / 1.0) / 10e3  # A/V: the gain that a drive in A is turned into volts with
TAYLOR_ROUNDING = 1e-17  # the first term left out of the series, relative to the state


def plate_state(latency: int) -> PlateState:
    """A plate at rest whose drive takes `latency` samples to act."""
    return PlateState(
        z=aligned((1, STATES)),
        step=aligned((1, COLUMNS, STATES)),
        frozen=np.full(2, np.nan),
        seen=np.full(2, np.nan),
        powers=aligned((NODES, COLUMNS, STATES)),
        window=np.array([0.0, WIDEST, -1.0]),
        nodes=aligned((NODES + 1, COLUMNS, STATES)),
        one=identity(),
        system=shifts(),
        square=aligned((STATES, STATES)),
        cube=aligned((STATES, STATES)),
        series=aligned((STATES, STATES)),
        push=np.zeros((3, 3)),
        pending=np.zeros((latency, 2)),
        cursor=np.zeros(1, np.int64),
        current=np.zeros(2),
    )


def plate_tables(parameters: PlateParameters, finger: Finger) -> PlateTables:
    """Numbers of the compiled plate with this finger on it; a sweep plays the same plate again and again."""
    plain = all(type(each).__module__.startswith("hapticrender.") for each in (parameters, finger.mechanics))
    make = _tables_of if plain else _tables_of.__wrapped__  # what others derive may hold more than it is equal by
    return make(parameters, finger.mechanics, finger.load_scaling)


@lru_cache(maxsize=1024)
def _tables_of(parameters: PlateParameters, mechanics: FingerMechanics, load_scaling: bool) -> PlateTables:
    order = mechanics.order if parameters.finger_dynamics else 0
    rocking = parameters.degrees_of_freedom == 2
    flexible = parameters.bending_frequency > 0.0
    omega = 2 * math.pi * parameters.bending_frequency
    wavenumber, grow, wave = parameters._bar()
    mass = parameters.mass_matrix.diagonal()
    stiffness, damping = parameters.stiffness_matrix, parameters.damping_matrix
    if not rocking:
        stiffness, damping = np.diag(stiffness.diagonal()), np.diag(damping.diagonal())
    tables = PlateTables(
        period=float(1.0 / parameters.rate),
        terms=0,
        inverse_mass=(
            float(1.0 / mass[0]),
            float(1.0 / mass[1]) if rocking else 0.0,
            1.0 / parameters.bending_mass if flexible else 0.0,
        ),
        stiffness=_upper(stiffness),
        damping=_upper(damping),
        force_constant=parameters.force_constant * parameters.coils / 2,
        lever=1.0 / parameters.half_spacing,
        reach=parameters.glass_length / parameters.coil_spacing,
        skin=(mechanics.mass, mechanics.damping, mechanics.stiffness) if order else (0.0, 0.0, 0.0),
        phalanx=(1.0 / mechanics.phalanx_mass, mechanics.phalanx_damping, mechanics.phalanx_stiffness)
        if order == 4
        else (0.0, 0.0, 0.0),
        flexible=flexible,
        flexure=(omega**2 * parameters.bending_mass, 2 * parameters.bending_damping * omega * parameters.bending_mass),
        coil_shape=parameters.bending_coil,
        centre_shape=float(parameters.bending_shape(0.0)),
        shape=(wavenumber * parameters.half_spacing, grow, wave),
        amplifier=parameters.amplifier_gain / NOMINAL_AMPLIFIER,
        current_limit=parameters.current_limit,
        current_step=parameters.current_step,
        sensor_limit=parameters.sensor_range / 2,
        sensor_step=parameters.sensor_step,
        sensor_noise=parameters.sensor_noise,
        sensor_gain=(float(parameters.sensor_gain_1), float(parameters.sensor_gain_2)),
    )
    tables = PlateTables(*(_as_float(value) for value in tables))  # else every mix of types compiles anew
    strongest = float(mechanics.load_factor(np.array(MOST_LOAD))) if load_scaling else 1.0
    return tables._replace(terms=_taylor_terms(tables._replace(terms=0), strongest))


def _as_float(value: Any) -> Any:
    """Floats for integers, also inside tuples; flags and the number of terms stay."""
    if isinstance(value, tuple):
        return tuple(float(each) for each in value)
    return value if isinstance(value, (bool, np.bool_)) else float(value)


def _upper(matrix: Array) -> tuple[float, float, float]:
    """Upper triangle of a symmetric 2 x 2 matrix."""
    return float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])


@lru_cache(maxsize=1024)
def _taylor_terms(tables: PlateTables, strongest: float) -> int:
    """Terms after which the exponential series has converged to rounding, wherever and however hard it is pressed."""
    most = 2
    for lever, strength in itertools.product((0.0, tables.reach), (0.0, 1.0, strongest)):
        system = plate_matrix(tables, lever, strength)
        term, n = system, 1
        while abs(term).max() > TAYLOR_ROUNDING:
            n += 1
            term = system @ term / n
        most = max(most, n)
    return most
