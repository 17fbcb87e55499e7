"""Where each method is stable: a finger on the plate as a structure, and the map over frequency and bandwidth."""

from __future__ import annotations

import numpy as np

from hapticrender.control.bank_loop import Structure
from hapticrender.plants.vibrotactile import PlateParameters
from hapticrender.touch.mechanics import NONE, FingerMechanics


def loaded_plate(
    parameters: PlateParameters,
    mechanics: FingerMechanics = NONE,
    *,
    position: float = 0.0,
    strength: float = 1.0,
) -> Structure:
    """Structure of the plate with a finger resting on it.

    Parameters
    ----------
    parameters : PlateParameters
    mechanics : FingerMechanics
        Order 0, 2 or 4; a phalanx becomes a coordinate of its own and needs a mass.
    position : float, m
        Of the finger, from the middle.
    strength : float
        Factor on the finger's impedance, >= 0; 0 is no finger.
    """
    mass, damping, stiffness = (
        matrix.copy() for matrix in (parameters.mass_matrix, parameters.damping_matrix, parameters.stiffness_matrix)
    )
    if mechanics.order and strength > 0:
        place = np.array([1.0, position / parameters.half_spacing])
        mass += strength * mechanics.mass * np.outer(place, place)
        if mechanics.order == 4:
            if not mechanics.phalanx_mass > 0:
                raise ValueError(f"phalanx_mass = {mechanics.phalanx_mass!r} kg: must be > 0")
            relative = np.append(place, -1.0)
            mass, damping, stiffness = (np.pad(matrix, (0, 1)) for matrix in (mass, damping, stiffness))
            mass[2, 2] = strength * mechanics.phalanx_mass
            damping[2, 2] = strength * mechanics.phalanx_damping
            stiffness[2, 2] = strength * mechanics.phalanx_stiffness
        else:
            relative = place
        damping += strength * mechanics.damping * np.outer(relative, relative)
        stiffness += strength * mechanics.stiffness * np.outer(relative, relative)
    return Structure(mass=mass, damping=damping, stiffness=stiffness, controlled=2)
