"""The figures of ``python -m benchmarks.bounds``, against equations solved by another way and closed forms."""

import numpy as np
import pytest

from benchmarks.bounds import bent, sag
from hapticrender.accuracy.plate import BENT
from hapticrender.touch.mechanics import HEAVY, NONE


@pytest.mark.parametrize("share", [1.0, 0.0], ids=["ends", "heave"])
@pytest.mark.parametrize("finger", [NONE, HEAVY], ids=["free", "heavy"])
def test_what_a_bending_mode_leaves_solves_the_equations_of_motion(finger, share):
    """In x_c, e and F, solved as they stand, the ends or heave at 1."""
    frequency, place = 261.0, 12e-3
    omega, mode, coil = 2 * np.pi * frequency, 2 * np.pi * BENT.bending_frequency, BENT.bending_coil
    phi, tissue = BENT.displacement(place)[2], 1j * omega * finger.impedance(np.array(frequency))
    heave = BENT.stiffness_1 + BENT.stiffness_2 - BENT.mass * omega**2
    heave += 1j * omega * (BENT.damping_1 + BENT.damping_2)
    bend = BENT.bending_mass * (mode**2 - omega**2 + 2j * BENT.bending_damping * mode * omega)
    equations = [[1.0, share, 0.0], [heave + tissue, phi * tissue, -1.0], [phi * tissue, bend + phi**2 * tissue, -coil]]
    x, e, _ = np.linalg.solve(np.array(equations), [1.0, 0.0, 0.0])
    found = bent(np.array([frequency]), finger, np.array([place]), share)
    np.testing.assert_allclose(np.ravel(found), [x + phi * e - 1, x + e - 1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("finger", [NONE, HEAVY], ids=["free", "heavy"])
def test_a_sag_is_the_load_over_the_stiffness(finger):
    """After 0.5 s; the damper has no static force, and a heavy finger gives way with skin and phalanx in series."""
    lever = 20e-3 / BENT.half_spacing
    sides = (1 - lever) ** 2 / BENT.stiffness_1 + (1 + lever) ** 2 / BENT.stiffness_2
    tissue = 1 / (1 / HEAVY.stiffness + 1 / HEAVY.phalanx_stiffness) if finger.order else 0.0
    assert sag(20e-3, finger)[-1] == pytest.approx(-0.8 / (4 / sides + tissue), rel=1e-6)
